"""Data by their protocols: asking what something is costs nothing, however large it is."""

import pytest
import torch
from typing_extensions import get_protocol_members

from dvae.data import BESIDE, Fingerprinted, HeldOutWindows, InBatches, Listed, Source, leaves, past_of
from dvae.inference.objectives import Asking
from dvae.program.protocols import Forecasting, Program


@pytest.mark.parametrize(
    "protocol", [Source, Listed, InBatches, Fingerprinted, HeldOutWindows, Program, Forecasting, Asking]
)
def test_asking_what_something_is_reads_nothing_of_it(protocol):
    read = []
    members = {name: property(lambda _, name=name: read.append(name)) for name in get_protocol_members(protocol)}
    assert isinstance(type("Whole", (), members)(), protocol)
    members.popitem()
    assert not isinstance(type("Part", (), members)(), protocol)
    assert not read, f"a fingerprint would be computed by this check: {read}"


@pytest.mark.parametrize("named", [False, True])
def test_a_past_holds_no_frame_of_the_future_but_of_context(named):
    x, mask, context = torch.randn(2, 7, 3), torch.rand(2, 7, 3) < 0.5, torch.randn(2, 7, 1)
    batch = {"x": x, "mask": {"x": mask} if named else mask, BESIDE: {"turns": x}, "y": context, "w": torch.randn(2, 4)}
    found, whole = leaves(past_of(batch, 5)), leaves(batch)
    assert found.keys() == whole.keys()
    for name, value in found.items():
        assert torch.equal(value, whole[name] if name in ("y", "w") else whole[name][:, :5])
