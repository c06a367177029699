"""ERD and acLSTM: their contract, layers, training loop and single future."""

import math
from dataclasses import replace
from typing import ClassVar

import pytest
import torch
from torch import nn

import dvae
from dvae import motion
from dvae.data.sequences import Sequences
from dvae.motion.data.protocols import Poses
from dvae.testing import FactorizationContract

SMALL = {"erd": {"width": 6, "encoder": (8, 5), "decoder": (8, 6)}, "aclstm": {"width": 6, "layers": 2}}
NAMES = list(SMALL)
CONSTANT = 0.5 * math.log(math.pi)
"""Minus the log-density of N(m, 1/2) at m."""


def small(name, **options):
    return dvae.method(name, **{**SMALL[name], **options})


class Contract(FactorizationContract):
    name = ""
    options: ClassVar = {}
    missing: ClassVar = {}

    def build(self, size):
        model = small(self.name, **self.options).build({"x": size})
        model.units["x"].fit(1 + 2 * torch.randn(50, size))
        return model


class TestERD(Contract):
    name = "erd"


class TestACLSTM(Contract):
    name = "aclstm"
    options: ClassVar = {"residual": 0.5}


@pytest.fixture(scope="module")
def data():
    """Simulated people, in windows of 6 + 9 frames."""
    protocol = replace(motion.PROTOCOLS["simulated"], observed=6, predicted=9, train_stride=9, test_stride=9)
    return motion.MotionData("simulated", motion.simulate(clips=8, frames=60, test=0.3), protocol)


def fitted(name, data):
    method = small(name)
    train = data.windows("train")
    torch.manual_seed(0)
    model = method.build(data.schema)
    recipe = method.train(train, data.windows("validation"), 3)
    dvae.fit(model, recipe, batch_size=4, validate_every=3, progress=False)
    return model.eval()


# -------------------------------------------------------------------------------------------------- as in the papers


ERD = [(48, 500), (500, 500), (1000, 500), (500, 100), (100, 48)]


@pytest.mark.parametrize(
    ("name", "layers"),
    [
        ("erd", lambda: [*(nn.Linear(*shape) for shape in ERD), nn.LSTM(500, 1000, 2)]),
        ("aclstm", lambda: [nn.LSTM(48, 1024, 3), nn.Linear(1024, 48)]),
    ],
)
def test_layers_for_human36m_match_the_papers(name, layers):
    schema = Poses.from_data(motion.PROTOCOLS["h36m"], motion.HUMAN36M)
    with torch.device("meta"):
        expected = sum(parameter.numel() for layer in layers() for parameter in layer.parameters())
    model = dvae.method(name).build(schema)
    assert sum(parameter.numel() for parameter in model.parameters()) == expected
    assert not model.view.names  # windows are not rotated


def test_erd_is_an_encoder_lstms_and_a_decoder():
    model = small("erd", standardise=False).build({"x": 3}).double()
    network, distribution = model.generator["x"].network, model.generator["x"].head
    x = torch.randn(2, 7, 3, dtype=torch.float64)

    def relu(layers, value):
        for layer in layers:
            value = torch.relu(layer(value)) if isinstance(layer, nn.Linear) else value
        return value

    # the encoder returns zeros for the first step, which has no past
    hidden = torch.cat([x.new_zeros(2, 1, 5), relu(network.extractors["x"], x[:, :-1])], 1)
    for layer in network.past.layers:
        hidden = layer(hidden)[0]
    expected = distribution.out(relu([network.join.first, *network.join.rest], hidden))
    torch.testing.assert_close(model.generator["x"]({"x": x}, 2, 7)[0], expected, rtol=0, atol=1e-12)


def test_aclstm_is_trained_by_the_published_loop():
    """Cell by cell: alternately five frames of the data and five generated ones, with gradients through all."""
    method = dvae.method("aclstm", width=5, standardise=False)
    model = method.build({"x": 3}).double()
    x = torch.randn(2, 23, 3, dtype=torch.float64)
    cells = [nn.LSTMCell(size, 5).double() for size in (3, 5, 5)]
    out = model.generator["x"].head.out
    model.generator["x"].head.log_scale.fill_(math.log(0.5) / 2)  # overwrites the float32 value
    for cell, layer in zip(cells, model.generator["x"].network.past.layers, strict=True):
        cell.load_state_dict({name.removesuffix("_l0"): value for name, value in layer.state_dict().items()})
    states = [(x.new_zeros(2, 5), x.new_zeros(2, 5)) for _ in cells]
    frame, outputs = torch.zeros_like(x[:, 0]), []
    for t in range(x.shape[1]):
        value = frame
        for i, cell in enumerate(cells):
            states[i] = cell(value, states[i])
            value = states[i][0]
        outputs.append(out(value))
        frame = x[:, t] if t % 10 < 5 else outputs[-1]
    loss = (torch.stack(outputs, 1) - x).square().sum((1, 2))

    feeding = method.train(Sequences({"x": x}), steps=50).feeding
    assert feeding == 1.0
    terms = dvae.SequenceELBO().terms(model, x, scheduled_sampling=feeding)
    torch.testing.assert_close(-terms.bound - CONSTANT * x[0].numel(), loss, rtol=0, atol=1e-10)
    expected = torch.autograd.grad(loss.sum(), [cells[0].weight_hh, cells[2].weight_ih, out.weight], retain_graph=True)
    layers = model.generator["x"].network.past.layers
    gradients = torch.autograd.grad(-terms.bound.sum(), [layers[0].weight_hh_l0, layers[2].weight_ih_l0, out.weight])
    torch.testing.assert_close(gradients, expected, rtol=0, atol=1e-9)


# ---------------------------------------------------------------------------------------------------- one future


@pytest.mark.parametrize("name", NAMES)
def test_all_futures_are_equal_so_the_best_is_the_median(name, data):
    model, windows = fitted(name, data), data.windows("test")
    past = windows.all()["x"][:5, :6]
    futures = model.forecast({"x": past}, 9, samples=50)["x"]
    assert torch.equal(futures, futures[:1].expand_as(futures))
    table = dvae.evaluate(model, windows, scores=motion.scores, samples=50, progress=False)
    assert table.emission == "mean"
    scores = table["model"]
    assert scores["APD"].mean == 0
    for error in ("ADE", "FDE", "MMADE", "MMFDE"):
        best, median = scores[error].mean, scores[f"{error}m"].mean
        assert best == pytest.approx(median, rel=1e-6)
    single = dvae.evaluate(model, windows, scores=motion.scores, samples=1, progress=False)["model"]
    assert single["ADE"].mean == pytest.approx(scores["ADE"].mean, rel=1e-5)
