"""GradNorm: weights balance gradients as in the paper, belong to one run, and are restored on resuming."""

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


def single_process_mean(value):
    """Return the mean over one process."""
    return value


def energies(**values):
    """Return terms of two frames with the given energies."""
    tables = {name: value.reshape(1) for name, value in values.items()}
    return dvae.Terms({}, {}, tables, torch.full((1,), 2.0).double())


class Linear(torch.nn.Module):
    """Three tasks on one matrix, with losses L_i = scale_i |W x - y_i|^2 / 2 over two frames."""

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
        losses = [s * ((self.shared @ self.x - y) ** 2).sum() for s, y in zip(self.scales, self.y)]
        return energies(**dict(zip(self.names, losses)))

    def terms_tensor(self):
        return torch.stack(list(self.terms().energies.values())).flatten() / 2

    def losses(self):
        return torch.stack(list(self.terms().energies.values())).flatten().detach() / 2

    def norms(self):
        """Return the norms of the gradients of s |W x - y|^2 / 2, which are s (W x - y) x^T."""
        miss = self.shared.detach() @ self.x - self.y
        return torch.tensor(self.scales).double() * miss.norm(dim=1) * self.x.norm()


def run(model=None, **options):
    """Run a short, quiet fit of a model with two energies."""
    defaults = {"batch_size": 8, "log_every": 1, "validate_every": 20, "progress": False, "learning_rate": 0.02}
    if "stages" not in options:
        defaults |= {"steps": 30, "objective": BALANCED}
    return fit(model or build(kind=Scaled), TRAIN, **(defaults | options))


class Scaled(DynamicalVAE):
    """Energies of three tasks; two of them have the same gradient."""

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
def test_a_step_descends_the_loss_of_the_paper(asymmetry):
    """Compare with central differences in log w of sum_i |w_i |grad L_i| - target_i| / Gbar."""
    model = Linear(scales=(1.0, 2.0, 0.5))
    balance = GradNorm(model.names, "shared", asymmetry=asymmetry, learning_rate=0.05).begin(model)
    first, expected, h = model.losses(), torch.ones(3).double(), 1e-6
    for step in range(40):
        norms, ratios = model.norms(), model.losses() / first
        mean = (expected * norms).mean()
        target = mean * (ratios / ratios.mean()) ** asymmetry

        def imbalance(logarithms, norms=norms, target=target, mean=mean):
            return (logarithms.exp() * norms - target).abs().sum() / mean

        updated = [
            (imbalance(expected.log() + h * axis) - imbalance(expected.log() - h * axis)) / (2 * h)
            for axis in torch.eye(3).double()
        ]
        expected = (expected.log() - 0.05 * torch.stack(updated)).exp()
        expected = expected * 3 / expected.sum()
        balance.adapt(balance.measure(model.terms()), single_process_mean)
        torch.testing.assert_close(balance.task_weights, expected, rtol=1e-7, atol=0)
        with torch.no_grad():  # tasks train at different rates
            model.shared += 0.05 * torch.outer(model.y[0] - model.shared @ model.x, model.x)


@pytest.mark.parametrize("asymmetry", [0.12, 1.5])
def test_the_published_update_is_the_algorithm_of_the_paper(asymmetry):
    """Compare with a few lines of algorithm 1 by automatic differentiation, on squared errors of unequal scale."""
    model = Linear(scales=(1.0, 2.0, 0.5))
    objective = GradNorm(model.names, "shared", asymmetry=asymmetry, learning_rate=0.002, update="published")
    balance, w, first = objective.begin(model), torch.ones(3).double(), model.losses()
    for step in range(60):
        w.requires_grad_()
        losses = model.terms_tensor()
        norms = torch.stack(
            [torch.autograd.grad(w[i] * losses[i], model.shared, create_graph=True)[0].norm() for i in range(3)]
        )
        ratios = losses.detach() / first
        target = (norms.mean() * (ratios / ratios.mean()) ** asymmetry).detach()
        (gradient,) = torch.autograd.grad((norms - target).abs().sum(), w)
        w = w.detach() - 0.002 * gradient
        w = w * 3 / w.sum()
        balance.adapt(balance.measure(model.terms()), single_process_mean)
        torch.testing.assert_close(balance.task_weights, w, rtol=1e-10, atol=0)
        (step_direction,) = torch.autograd.grad((w * model.terms_tensor()).sum(), model.shared)
        with torch.no_grad():  # a step of the network with these weights
            model.shared -= 0.02 * step_direction
    assert (w - 1).abs().max() > 0.1


def test_a_negative_weight_of_the_published_update_is_an_error():
    model = Linear()
    balance = GradNorm(model.names, "shared", learning_rate=1.0, update="published").begin(model)
    with pytest.raises(ValueError, match="published update makes the weight of task1 -"):
        balance.adapt(balance.measure(model.terms()), single_process_mean)


def test_training_rates_are_of_losses_above_their_minimum():
    """With their constants, log densities and squared errors have the same weights."""
    model, constants = Linear(scales=(1.0, 2.0, 0.5)), {"task0": -3.0, "task2": 5.0}
    shifted = GradNorm(model.names, "shared", asymmetry=1.5, lowest=constants).begin(model)
    plain = GradNorm(model.names, "shared", asymmetry=1.5).begin(model)
    for _ in range(5):
        terms = model.terms()
        with_constants = {name: value + 2 * constants.get(name, 0.0) for name, value in terms.energies.items()}
        plain.adapt(plain.measure(terms), single_process_mean)
        shifted.adapt(shifted.measure(energies(**with_constants)), single_process_mean)
        torch.testing.assert_close(shifted.task_weights, plain.task_weights)
        with torch.no_grad():
            model.shared += 0.05 * torch.outer(model.y[0] - model.shared @ model.x, model.x)
    with pytest.raises(ValueError, match="`lowest` includes 'z', but the tasks are task0"):
        GradNorm(model.names, "shared", lowest={"z": 1.0})


@given(st.data())
def test_weights_are_positive_and_add_up_to_the_number_of_tasks(data):
    """Test all losses and gradients, also 0."""
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
        measured = balance.measure(energies(**dict(zip(names, values, strict=True))))
        balance.adapt(measured, single_process_mean)
        assert (balance.task_weights > 0).all()
        assert balance.task_weights.sum().item() == pytest.approx(tasks)


def test_the_loss_is_the_weighted_tasks_plus_the_evidence_terms():
    result = run(objective=MIXED, steps=25)
    for row in result.history:
        kl = min(0.1 * (row["step"] - 1) / 4, 0.1) * row["kl/z"]
        tasks = -row["weight/x"] * row["log_likelihood/x"]
        tasks += row["weight/large"] * row["energy/large"] + row["weight/other"] * row["energy/other"]
        assert row["loss"] == pytest.approx(tasks + kl + row["energy/small"])
    assert [row["weight/x"] for row in result.history[:1]] == [1.0]
    assert weighing(result, "x")[-1] != 1.0


def test_validation_losses_have_weights_of_1():
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
def uninterrupted(tmp_path_factory):
    """Return the history and last weights of an uninterrupted run."""
    place = tmp_path_factory.mktemp("whole")
    return run(stages=STAGED, out=place).history, load_file(place / "last.safetensors")


@pytest.mark.parametrize("stop", [9, 13])
def test_an_interrupted_run_restores_its_weights_bit_for_bit(tmp_path, uninterrupted, stop):
    with pytest.raises(Interrupted):
        run(stages=STAGED, out=tmp_path, callbacks=[At(stop, interrupt)])
    resumed = run(build(9, kind=Scaled), stages=STAGED, out=tmp_path, resume=True)
    last = load_file(tmp_path / "last.safetensors")
    assert resumed.history == uninterrupted[0]
    assert all(torch.equal(value, last[name]) for name, value in uninterrupted[1].items())


def test_every_stage_begins_with_weights_of_1():
    result = run(stages=STAGED)
    rows = {row["step"]: row for row in result.history}
    for step in (1, 10, 22):
        assert {value for name, value in rows[step].items() if name.startswith("weight/")} == {1.0}
    assert rows[9]["weight/small"] > 1.0
    assert set(rows[10]) & {"weight/small", "weight/x"} == {"weight/x"}
    assert not [name for name in rows[18] if name.startswith("weight/")]


# Errors --------------------


def test_a_model_without_the_shared_layer_is_an_error_before_training():
    objective = GradNorm(("small", "large"), "decoder.last")
    with pytest.raises(ValueError, match="starts with"):
        dvae.SVI(build(kind=Scaled), stages=[Stage(5), Stage(5, objective)])


def test_a_task_without_shared_parameters_is_an_error():
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
def test_an_impossible_state_is_an_error(tmp_path, change, message):
    """The file has a valid fingerprint."""
    run(steps=5, objective=BALANCED, out=tmp_path)
    altered = {f"objective/{name}": torch.tensor(value, dtype=torch.float64) for name, value in change.items()}
    Run(tmp_path).commit(Run(tmp_path).state, {OPTIMISER: save(Run(tmp_path).optimiser_state() | altered)})
    with pytest.raises(CheckpointError, match=message):
        run(build(9, kind=Scaled), steps=10, objective=BALANCED, out=tmp_path, resume=True)
