"""Forecasts of every kind of model in chunks: the same distribution, and no more memory for more samples."""

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
    """A model, and forecasts of some of the windows by it."""
    paths = request.param == "trajevae"
    protocol = motion.PROTOCOLS["bandai2-trajectories" if paths else "bandai2-by-style"]
    protocol = replace(protocol, split_by="split", train=("train",), test=("test",), predicted=20)
    protocol = protocol if paths else replace(protocol, observed=5)
    windows = motion.windows(people, protocol, "train")
    torch.manual_seed(0)
    model = dvae.method(request.param, **METHODS[request.param]).build(windows).double().eval()
    past = windows.all()["x"][:WINDOWS, : protocol.observed]
    return lambda part, samples, **options: model.forecast(past[part], 20, samples, **options)


def test_a_chunk_is_a_forecast_of_its_own(forecaster):
    torch.manual_seed(0)
    whole = forecaster(slice(None), 2, chunk=2)
    torch.manual_seed(0)
    first, again, last = (forecaster(part, n) for part, n in ((slice(2), 1), (slice(2), 1), (slice(2, None), 2)))
    for name, value in whole.items():
        torch.testing.assert_close(value, torch.cat([torch.cat([first[name], again[name]]), last[name]], 1))


class Made(TorchDispatchMode):
    """The sizes, in bytes, of all that operations make."""

    def __init__(self):
        super().__init__()
        self.sizes = set()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        out = function(*args, **(kwargs or {}))
        self.sizes |= {each.untyped_storage().nbytes() for each in tree_leaves(out) if isinstance(each, torch.Tensor)}
        return out


def test_beside_its_result_a_forecast_is_as_large_for_any_number_of_samples(forecaster):
    largest = []
    for samples in (7, 13):
        with Made() as made:
            out = forecaster(slice(None), samples, chunk=3 * WINDOWS)
        largest.append(max(made.sizes - {value.untyped_storage().nbytes() for value in out.values()}))
    assert largest[0] == largest[1]
