"""ERD and acLSTM: their contract, what they read in training, and that their forecast is one future."""

import math
from dataclasses import replace
from typing import ClassVar

import pytest
import torch
from torch import nn

import dvae
from dvae import motion
from dvae.data.schema import SchemaError
from dvae.data.sequences import Sequences
from dvae.motion.data.protocols import Poses
from dvae.testing import FactorizationContract

SMALL = {"erd": {"width": 6, "encoder": (8, 5), "decoder": (8, 6)}, "aclstm": {"width": 6, "layers": 2}}
NAMES = list(SMALL)
CONSTANT = 0.5 * math.log(math.pi)
"""Minus the log-density at its mean of one coordinate of variance 1/2."""


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


class TestACLSTMWithAnotherLaw(Contract):
    name = "aclstm"
    options: ClassVar = {"emission": "normal"}


@pytest.fixture(scope="module")
def data():
    """Simulated people, in windows of 6 + 9 frames."""
    protocol = replace(motion.PROTOCOLS["simulated"], observed=6, predicted=9, train_stride=9, test_stride=9)
    return motion.MotionData("simulated", motion.simulate(clips=8, frames=60, test=0.3), protocol)


def fitted(name, data, **options):
    method = small(name, **options)
    train = data.windows("train")
    torch.manual_seed(0)
    model = method.build(data.schema)
    recipe = method.train(train, data.windows("validation"), 3)
    recipe.fit(model, batch_size=4, validate_every=3, progress=False)
    return model.eval()


# -------------------------------------------------------------------------------------------------- as in the papers


@pytest.mark.parametrize(
    ("name", "layers"),
    [
        (
            "erd",
            lambda: [
                *(nn.Linear(*shape) for shape in ((48, 500), (500, 500), (1000, 500), (500, 100), (100, 48))),
                nn.LSTM(500, 1000, 2),
            ],
        ),
        ("aclstm", lambda: [nn.LSTM(48, 1024, 3), nn.Linear(1024, 48)]),
    ],
)
def test_with_the_skeleton_of_the_papers_data_the_layers_are_the_papers(name, layers):
    schema = Poses.under(motion.PROTOCOLS["h36m"], motion.HUMAN36M)
    with torch.device("meta"):
        expected = sum(parameter.numel() for layer in layers() for parameter in layer.parameters())
    model = dvae.method(name).build(schema)
    assert sum(parameter.numel() for parameter in model.parameters()) == expected
    assert not model.view.names  # windows are not turned


def test_erd_is_a_decoder_of_lstms_of_an_encoder():
    model = small("erd", standardise=False).build({"x": 3}).double()
    network, law = model.generator["x"].network, model.generator["x"].law
    x = torch.randn(2, 7, 3, dtype=torch.float64)
    before = torch.cat([torch.zeros_like(x[:, :1]), x[:, :-1]], 1)

    def relu(layers, value):
        for layer in layers:
            value = torch.relu(layer(value)) if isinstance(layer, nn.Linear) else value
        return value

    # of the first step, which has no past, the encoder has nothing to say
    read = torch.cat(
        [torch.zeros_like(before[:, :1, :1]).expand(-1, 1, 5), relu(network.extractors["x"], x[:, :-1])], 1
    )
    for layer in network.past.layers:
        read = layer(read)[0]
    expected = law.out(relu([network.join.first, *network.join.rest], read))
    torch.testing.assert_close(model.generator["x"]({"x": x}, 2, 7)[0], expected, rtol=0, atol=1e-12)
    assert before.shape == x.shape


def test_aclstm_is_trained_on_what_the_published_loop_makes():
    """Cell by cell: five frames of the data, five of its own, with the gradient of all of it."""
    method = dvae.method("aclstm", width=5, standardise=False)
    model = method.build({"x": 3}).double()
    x = torch.randn(2, 23, 3, dtype=torch.float64)
    cells = [nn.LSTMCell(size, 5).double() for size in (3, 5, 5)]
    out = model.generator["x"].law.out
    model.generator["x"].law.log_scale.fill_(math.log(0.5) / 2)  # which was single precision's
    for cell, layer in zip(cells, model.generator["x"].network.past.layers, strict=True):
        cell.load_state_dict({name.removesuffix("_l0"): value for name, value in layer.state_dict().items()})
    states = [(x.new_zeros(2, 5), x.new_zeros(2, 5)) for _ in cells]
    read, made = torch.zeros_like(x[:, 0]), []
    for t in range(x.shape[1]):
        value = read
        for i, cell in enumerate(cells):
            states[i] = cell(value, states[i])
            value = states[i][0]
        made.append(out(value))
        read = x[:, t] if t % 10 < 5 else made[-1]
    loss = (torch.stack(made, 1) - x).square().sum((1, 2))

    feeding = method.train(Sequences({"x": x}), steps=50).feeding
    assert feeding == 1.0
    terms = dvae.SequenceELBO().terms(model, x, self_feeding=feeding)
    torch.testing.assert_close(-terms.bound - CONSTANT * x[0].numel(), loss, rtol=0, atol=1e-10)
    theirs = torch.autograd.grad(loss.sum(), [cells[0].weight_hh, cells[2].weight_ih, out.weight], retain_graph=True)
    layers = model.generator["x"].network.past.layers
    ours = torch.autograd.grad(-terms.bound.sum(), [layers[0].weight_hh_l0, layers[2].weight_ih_l0, out.weight])
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-9)


def test_the_noise_of_erd_grows_to_its_scale_and_stays():
    method = small("erd", noise=0.4)
    recipe = method.train(Sequences({"x": torch.randn(4, 6, 3)}), steps=100)
    assert [recipe.feeding(step) for step in (0, 10, 43, 99)] == pytest.approx([0, 0, 1, 1], abs=0.02)
    assert method.build({"x": 3}).feeding == dvae.InputNoise(0.4)
    assert small("erd", noise=0.0).train(Sequences({"x": torch.randn(4, 6, 3)}), steps=100).feeding == 0.0
    fed = small("erd", noise=0.0, self_feeding=0.3)
    assert fed.build({"x": 3}).feeding == dvae.SelfFeeding(0.0, gradient=False)
    assert fed.train(Sequences({"x": torch.randn(4, 6, 3)}), steps=100).feeding(99) == pytest.approx(0.3)


# ---------------------------------------------------------------------------------------------------- one future


@pytest.mark.parametrize("name", NAMES)
def test_all_futures_are_the_one_and_the_best_is_no_better(name, data):
    model, windows = fitted(name, data), data.windows("test")
    past = windows.all()["x"][:5, :6]
    futures = model.forecast({"x": past}, 9, samples=50)["x"]
    assert torch.equal(futures, futures[:1].expand_as(futures))
    table = dvae.evaluate(model, windows, scores=motion.scores, samples=50, progress=False)
    assert table.emission == "mean"
    found = table["model"]
    assert found["APD"].mean == 0
    for error in ("ADE", "FDE", "MMADE", "MMFDE"):
        best, median = found[error].mean, found[f"{error}m"].mean
        assert best == pytest.approx(median, rel=1e-6)
    (single,) = (dvae.evaluate(model, windows, scores=motion.scores, samples=1, progress=False)["model"],)
    assert single["ADE"].mean == pytest.approx(found["ADE"].mean, rel=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_a_forecast_goes_on_from_its_own_means(name):
    model = small(name).build({"x": 3}).double().eval()
    x = torch.randn(4, 5, 3, dtype=torch.float64)
    longer = x
    for _ in range(6):
        known = torch.cat([longer, longer[:, :1]], 1)  # what is made does not read the last frame
        longer = torch.cat([longer, model.generator["x"]({"x": known}, 4, known.shape[1])[0][:, -1:]], 1)
    torch.testing.assert_close(model.forecast(x, 6)["x"][0], longer[:, 5:], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_turned_people_have_turned_futures(name, data):
    model, x = fitted(name, data), data.windows("test").all()["x"][:4, :6]
    angle = torch.full((4,), 0.7)
    turned = motion.rotate_about_up(x.unflatten(-1, (-1, 3)), angle[:, None, None], data.schema.skeleton.up)
    both = [model.forecast({"x": each}, 9)["x"][0].unflatten(-1, (-1, 3)) for each in (x, turned.flatten(-2))]
    expected = motion.rotate_about_up(both[0], angle[:, None, None], data.schema.skeleton.up)
    torch.testing.assert_close(both[1], expected, rtol=0, atol=1e-4)
    plain = fitted(name, data, heading=False)
    assert (plain.forecast({"x": turned.flatten(-2)}, 9)["x"][0].unflatten(-1, (-1, 3)) - expected).abs().max() > 0.01


@pytest.mark.parametrize("name", NAMES)
def test_units_are_those_of_training_poses(name, data):
    model, train = fitted(name, data), data.windows("train")
    assert not torch.equal(model.units["x"].mean, torch.zeros_like(model.units["x"].mean))
    x = model.read(train.all())["x"].flatten(0, 1)
    torch.testing.assert_close(model.units["x"].mean, x.mean(0), rtol=0, atol=0.05)
    torch.testing.assert_close(model.units["x"].scale, x.var(0).mean().sqrt(), rtol=0.1, atol=0)


@pytest.mark.parametrize("name", NAMES)
def test_mixed_precision_trains(name):
    model = small(name).build({"x": 3})
    with torch.autocast("cpu", torch.bfloat16):
        bound = dvae.SequenceELBO().terms(model, torch.randn(4, 17, 3), self_feeding=1.0).bound.mean()
    bound.backward()
    assert torch.isfinite(torch.cat([p.grad.flatten() for p in model.parameters()])).all()


# ----------------------------------------------------------------------------------------------------- other data


@pytest.mark.parametrize("name", NAMES)
def test_turns_of_joints_are_sequences_like_any(name, quaternions):
    method = small(name).suited(quaternions["train"])
    assert method.heading is False
    model = method.build(quaternions["train"])
    method.train(quaternions["train"], steps=1).fit(model, batch_size=3, progress=False)
    table = dvae.evaluate(model, quaternions["test"], scores=motion.scores, samples=2, progress=False)
    assert table["model"]["limb stretch"].mean < 1e-3


def test_another_law_is_a_density_whose_draws_are_forecast():
    model = small("aclstm", emission="normal").build({"x": 2})
    assert model.forecast(torch.randn(3, 5, 2), 2, samples=5)["x"].std(0).min() > 0


def test_a_skeleton_without_sides_has_no_headings(data):
    skeleton = replace(data.schema.skeleton, name="nobody", left=(), right=())
    schema = Poses.under(data.schema.protocol, skeleton)
    assert small("erd").suited(schema).heading is False
    assert small("erd").suited(data.schema).heading is True


def test_options_that_do_not_go_together_are_refused():
    with pytest.raises(ValueError, match=r"noise is 0\.5 and self_feeding is 0\.3, but in training a model reads data"):
        small("erd", noise=0.5, self_feeding=0.3)
    with pytest.raises(SchemaError, match="aclstm needs to know what poses are"):
        small("aclstm", heading=True).build({"x": 6})
    with pytest.raises(ValueError, match="own is 0; it must be at least 1"):
        small("aclstm", own=0)
