"""Weights that adapt: they balance what the paper says, belong to one run, and are as they were when it goes on."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load_file, save
from stopping import At, interrupt
from walks import TRAIN, build

import dvae
from dvae.inference.training.checkpoints import OPTIMISER, CheckpointError, Run
from dvae.inference.training.fit import Interrupted, fit
from dvae.inference.training.gradnorm import GradNorm
from dvae.inference.training.objectives import Evidence
from dvae.inference.training.options import Stage
from dvae.inference.training.schedules import Ramp
from dvae.program.model import DynamicalVAE


def alone(value):
    """The mean over one process."""
    return value


def energies(**values):
    """Terms of two frames, each energy as given."""
    tables = {name: value.reshape(1) for name, value in values.items()}
    return dvae.Terms({}, {}, tables, torch.full((1,), 2.0).double())


class Linear(torch.nn.Module):
    """Three tasks on one matrix, each a squared error: L_i = scale_i |W x - y_i|^2 / 2 by two frames."""

    def __init__(self, scales=(1.0, 30.0, 0.2)):
        super().__init__()
        generator = torch.Generator().manual_seed(3)
        draw = lambda *size: torch.randn(*size, generator=generator, dtype=torch.float64)  # noqa: E731
        self.shared = torch.nn.Parameter(draw(2, 3))
        self.own = torch.nn.Parameter(draw(2))
        self.x, self.y, self.scales = draw(3), draw(len(scales), 2), scales

    @property
    def names(self):
        return tuple(f"task{i}" for i in range(len(self.scales)))

    def terms(self):
        found = [s * ((self.shared @ self.x - y) ** 2).sum() for s, y in zip(self.scales, self.y)]
        return energies(**dict(zip(self.names, found)))

    def losses(self):
        return torch.stack(list(self.terms().energies.values())).flatten().detach() / 2

    def norms(self):
        """Of the gradient of s |W x - y|^2 / 2, which is s (W x - y) x^T."""
        miss = self.shared.detach() @ self.x - self.y
        return torch.tensor(self.scales).double() * miss.norm(dim=1) * self.x.norm()


def run(model=None, **options):
    """A short quiet run of a model with two energies."""
    defaults = {"batch_size": 8, "log_every": 1, "validate_every": 20, "progress": False, "learning_rate": 0.02}
    if "stages" not in options:
        defaults |= {"steps": 30, "objective": BALANCED}
    return fit(model or build(kind=Scaled), TRAIN, **(defaults | options))


class Scaled(DynamicalVAE):
    """Energies of one gradient, and one that is another."""

    def penalties(self, rollout, batch, draws):
        means = rollout.parameters("x", rollout.values["x"])[0]
        small = ((means - batch["x"]) ** 2).sum((1, 2))
        return {"small": small, "large": 100 * small, "other": ((means[:, 1:] - means[:, :-1]) ** 2).sum((1, 2))}


BALANCED = GradNorm(("small", "large"), "generator.x.", asymmetry=0.0, learning_rate=0.1)
MIXED = GradNorm(("x", "other", "large"), "generator.x.", Evidence(kl_weight=Ramp(0.0, 0.1, 4)), asymmetry=0.0)


def weighing(result, name):
    return result.series(f"weight/{name}")[1]


# The weights --------------------


@pytest.mark.parametrize("asymmetry", [0.0, 1.5])
def test_a_step_is_down_the_slope_of_the_papers_loss(asymmetry):
    """By central differences in log w of sum_i |w_i |grad L_i| - target_i| / Gbar, with gradients written by hand."""
    model = Linear(scales=(1.0, 2.0, 0.5))
    balance = GradNorm(model.names, "shared", asymmetry=asymmetry, learning_rate=0.05).begin(model)
    first, expected, h = model.losses(), torch.ones(3).double(), 1e-6
    for step in range(40):
        norms, ratios = model.norms(), model.losses() / first
        mean = (expected * norms).mean()
        target = mean * (ratios / ratios.mean()) ** asymmetry

        def imbalance(logarithms, norms=norms, target=target, mean=mean):
            return (logarithms.exp() * norms - target).abs().sum() / mean

        moved = [
            (imbalance(expected.log() + h * axis) - imbalance(expected.log() - h * axis)) / (2 * h)
            for axis in torch.eye(3).double()
        ]
        expected = (expected.log() - 0.05 * torch.stack(moved)).exp()
        expected = expected * 3 / expected.sum()
        balance.measure(model.terms())
        balance.adapt(alone)
        torch.testing.assert_close(balance.weights, expected, rtol=1e-7, atol=0)
        with torch.no_grad():  # tasks train at different rates
            model.shared += 0.05 * torch.outer(model.y[0] - model.shared @ model.x, model.x)


@given(st.data())
def test_weights_are_positive_and_add_up_to_the_number_of_tasks(data):
    """Whatever losses and gradients are, those of 0 among them."""
    tasks = data.draw(st.integers(2, 5))
    size = st.lists(st.sampled_from([0.0, 1e-30, 1e-3, 1.0, 7.0, 1e4, 1e30]), min_size=tasks, max_size=tasks)
    names = tuple(map(str, range(tasks)))
    asymmetry, rate = data.draw(st.sampled_from([0.0, 0.12, 1.5, 10.0])), data.draw(st.sampled_from([0.01, 1.0]))
    weight = torch.nn.Parameter(torch.ones(1).double())
    model = torch.nn.ParameterDict({"shared": weight})
    balance = GradNorm(names, "shared", asymmetry=asymmetry, learning_rate=rate).begin(model)
    for step in range(6):
        slopes, losses = data.draw(size), data.draw(size) if step else [1.0] * tasks
        values = [slope * (weight - weight.detach()) + loss for slope, loss in zip(slopes, losses, strict=True)]
        balance.measure(energies(**dict(zip(names, values, strict=True))))
        balance.adapt(alone)
        assert (balance.weights > 0).all()
        assert balance.weights.sum().item() == pytest.approx(tasks)


def test_the_loss_is_the_weighted_tasks_and_the_other_terms_as_evidence_has_them():
    result = run(objective=MIXED, steps=25)
    for row in result.history:
        kl = min(0.1 * (row["step"] - 1) / 4, 0.1) * row["kl/z"]
        tasks = -row["weight/x"] * row["log_likelihood/x"]
        tasks += row["weight/large"] * row["energy/large"] + row["weight/other"] * row["energy/other"]
        assert row["loss"] == pytest.approx(tasks + kl + row["energy/small"])
    assert [row["weight/x"] for row in result.history[:1]] == [1.0]
    assert weighing(result, "x")[-1] != 1.0


def test_validation_losses_have_weights_of_1_and_can_be_compared():
    objective = GradNorm(("small", "large"), "generator.x.", Evidence(select="loss"), learning_rate=0.1)
    result = run(objective=objective, validation=TRAIN, steps=40)
    for row in result.history:
        if "validation/loss" in row:
            parts = sum(row[f"validation/energy/{name}"] for name in ("small", "large", "other"))
            assert row["validation/loss"] == pytest.approx(parts - row["validation/bound"])
    assert result.best_bound is not None


# Runs --------------------


STAGED = [Stage(9, BALANCED), Stage(8, MIXED, learning_rate=0.01), Stage(4), Stage(9, BALANCED)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The history and the last weights of a run that is not interrupted."""
    place = tmp_path_factory.mktemp("whole")
    return run(stages=STAGED, out=place).history, load_file(place / "last.safetensors")


@pytest.mark.parametrize("stop", [9, 13])
def test_an_interrupted_run_has_its_weights_back_bit_for_bit(tmp_path, whole, stop):
    with pytest.raises(Interrupted):
        run(stages=STAGED, out=tmp_path, callbacks=[At(stop, interrupt)])
    resumed = run(build(9, kind=Scaled), stages=STAGED, out=tmp_path, resume=True)
    last = load_file(tmp_path / "last.safetensors")
    assert resumed.history == whole[0]
    assert all(torch.equal(value, last[name]) for name, value in whole[1].items())


def test_every_stage_begins_with_weights_of_1():
    result = run(stages=STAGED)
    rows = {row["step"]: row for row in result.history}
    for step in (1, 10, 22):
        assert {value for name, value in rows[step].items() if name.startswith("weight/")} == {1.0}
    assert rows[9]["weight/small"] > 1.0
    assert set(rows[10]) & {"weight/small", "weight/x"} == {"weight/x"}
    assert not [name for name in rows[18] if name.startswith("weight/")]


# What is refused --------------------


def test_a_model_without_the_shared_layer_is_refused_before_its_stage_comes():
    lost = GradNorm(("small", "large"), "decoder.last")
    with pytest.raises(ValueError, match="starts with"):
        dvae.SVI(build(kind=Scaled), stages=[Stage(5), Stage(5, lost)])


def test_a_task_that_does_not_go_through_the_shared_parameters_is_refused():
    model = Linear(scales=(1.0,))
    balance = GradNorm(("task0", "own"), "shared", asymmetry=0.0).begin(model)
    terms = energies(task0=model.terms().energies["task0"], own=model.own.sum())
    with pytest.raises(ValueError, match="parameters"):
        balance.measure(terms)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weight/huge": 1.0}, "objective"),
        ({"first/large": math.nan}, "objective's format"),
        ({"weight/small": 3.0}, "positive numbers"),
    ],
)
def test_a_state_that_no_run_writes_is_refused_in_a_sentence(tmp_path, change, message):
    """Signed as its author would."""
    run(steps=5, objective=BALANCED, out=tmp_path)
    changed = {f"objective/{name}": torch.tensor(value, dtype=torch.float64) for name, value in change.items()}
    Run(tmp_path).commit(Run(tmp_path).state, {OPTIMISER: save(Run(tmp_path).optimiser_state() | changed)})
    with pytest.raises(CheckpointError, match=message):
        run(build(9, kind=Scaled), steps=10, objective=BALANCED, out=tmp_path, resume=True)
