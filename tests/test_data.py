"""Data by their protocols: asking what something is costs nothing, however large it is."""

import pytest
from typing_extensions import get_protocol_members

from dvae.data import Fingerprinted, HeldOutWindows, Listed, Source
from dvae.inference.objectives import Asking
from dvae.program.protocols import Forecasting, Program


@pytest.mark.parametrize("protocol", [Source, Listed, Fingerprinted, HeldOutWindows, Program, Forecasting, Asking])
def test_asking_what_something_is_reads_nothing_of_it(protocol):
    read = []
    members = {name: property(lambda _, name=name: read.append(name)) for name in get_protocol_members(protocol)}
    assert isinstance(type("Whole", (), members)(), protocol)
    members.popitem()
    assert not isinstance(type("Part", (), members)(), protocol)
    assert not read, f"a fingerprint would be computed by this check: {read}"
