"""Forecasts in chunks, for every kind of model: the same draws, and constant memory."""

from dataclasses import replace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import dvae
from dvae import motion

METHODS = {
    "srnn": {"width": 4, "embed": 3, "hidden": (4,), "decoder": (5,)},
    "hit-dvae": {"width": 8, "heads_count": 2, "decoder": 8, "pose_width": 2, "heading": True},
    "gsps": {"width": 8, "blocks": 1, "latent": 3, "heading": True, "pose_prior": 0.0},
    "trajevae": {"width": 8, "heads_count": 2, "layers": 1, "heading": True},
}
WINDOWS = 3


@pytest.fixture(scope="module")
def people():
    return motion.simulate(clips=10, frames=50, test=0.3)


@pytest.fixture(params=METHODS)
def forecaster(request, people):
    """Return a function that forecasts a part of the windows."""
    paths = request.param == "trajevae"
    protocol = motion.PROTOCOLS["bandai2-trajectories" if paths else "bandai2-by-style"]
    protocol = replace(protocol, split_by="split", train=("train",), test=("test",), predicted=20)
    protocol = protocol if paths else replace(protocol, observed=5)
    windows = motion.windows(people, protocol, "train")
    torch.manual_seed(0)
    model = dvae.method(request.param, **METHODS[request.param]).build(windows).double().eval()
    past = windows.all()["x"][:WINDOWS, : protocol.observed]
    return lambda part, samples, **options: model.forecast(past[part], 20, samples, **options)


def test_chunks_equal_separate_forecasts(forecaster):
    torch.manual_seed(0)
    both = forecaster(slice(None), 2, chunk=2)
    torch.manual_seed(0)
    first, again, last = (forecaster(part, n) for part, n in ((slice(2), 1), (slice(2), 1), (slice(2, None), 2)))
    for name, value in both.items():
        torch.testing.assert_close(value, torch.cat([torch.cat([first[name], again[name]]), last[name]], 1))


class TensorSizes(TorchDispatchMode):
    """Records the sizes in bytes of all tensors that operations create."""

    def __init__(self):
        super().__init__()
        self.sizes = set()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        out = function(*args, **(kwargs or {}))
        self.sizes |= {each.untyped_storage().nbytes() for each in tree_leaves(out) if isinstance(each, torch.Tensor)}
        return out


def test_memory_of_a_chunked_forecast_does_not_grow_with_samples(forecaster):
    largest = []
    for samples in (7, 13):
        with TensorSizes() as allocations:
            out = forecaster(slice(None), samples, chunk=3 * WINDOWS)
        largest.append(max(allocations.sizes - {value.untyped_storage().nbytes() for value in out.values()}))
    assert largest[0] == largest[1]
