"""`elbo_regression`: its rate of false alarms, power, records, and the pytest plugin."""

import json
import math
import re
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from scipy import stats

import dvae
from dvae import DynamicalVAE, Oracle, linear_gaussian_surrogate, networks
from dvae.testing.regression import Change, ElboRegression, Record, measure

pytest_plugins = ["pytester"]

DOCS = Path(__file__).parents[2] / "docs"
PAIR = ("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_t)")


@pytest.fixture(scope="module")
def exact():
    """A linear-Gaussian model, data, and its oracle."""
    model = linear_gaussian_surrogate(*PAIR, {"z": 1, "x": 1}, 3)
    torch.manual_seed(7)
    return model, model.sample(4, 3)["x"], Oracle(model, 3)


def regression(folder, notes=None, test="test_it", **options):
    options = {"update": False, "strict": False, "owners": {}, **options}
    return ElboRegression(folder, test, note=[].append if notes is None else notes.append, **options)


def repeated(model, x, times, particles, seed):
    """Return records of independent measurements of the same bounds."""
    bounds = measure(model.model, model.guide, x.repeat(times, 1, 1), particles, seed)
    return [Record.of(part, {}) for part in np.split(bounds, times, axis=1)]


def worsen(model, by):
    """Return the model with a guide whose scales are exp(by) times as large."""
    other = linear_gaussian_surrogate(*PAIR, {"z": 1, "x": 1}, 3)
    other.load_state_dict(model.state_dict())
    with torch.no_grad():
        other.encoder["z"].head.log_scale += by
    return other


# ------------------------------------------------------------------------------------------------- error and power


@pytest.mark.parametrize("particles", [20, 100])
def test_false_alarms_are_rare_after_skewed_draws_become_exact(particles):
    """With one sequence, as if a sampled KL became analytic: old draws have a long lower or upper tail."""
    n, alpha = 1000, 0.01
    old = np.exp(1.5 * np.random.default_rng(0).normal(size=(n, particles))) - math.exp(1.125)
    exact = Record(np.zeros(1), np.zeros(1), np.zeros(particles), {})
    for sign in (-1, 1):
        changes = [Change(Record(row[:1], row[:1], row, {}), exact, alpha) for row in sign * old]
        for alarms in ([change.worse for change in changes], [change.better for change in changes]):
            assert np.mean(alarms) < 2 * alpha + 4 * math.sqrt(alpha / n)


@pytest.mark.parametrize(("particles", "coupling", "noise"), [(4, -1.0, 1e-2), (4, 0.0, 1e2), (100, 0.9, 1e-2)])
def test_false_alarms_are_rare_for_every_coupling_and_spread(particles, coupling, noise):
    random = np.random.default_rng(0)
    n, alpha, size = 2000, 0.05, 5
    level = random.normal(scale=10.0, size=size)  # of the sequences
    scale = noise * np.geomspace(1, 30, size)  # of their Monte Carlo errors
    first, second = random.normal(size=(2, n, particles, size))
    second = coupling * first + math.sqrt(1 - coupling**2) * second
    alarms = [
        Change(Record.of(level + scale * a, {}), Record.of(level + scale * b, {}), alpha).worse
        for a, b in zip(first, second, strict=True)
    ]
    assert np.mean(alarms) < alpha + 4 * math.sqrt(alpha * (1 - alpha) / n)


def test_the_noted_loss_is_found_with_probability_ninety_percent(tmp_path, exact):
    """Simulate the test with independent draws."""
    model, x, _ = exact
    notes, particles, n = [], 100, 1000
    regression(tmp_path, notes).check(model.model, model.guide, x, particles=particles, alpha=0.05)
    fall = float(re.search(r"a loss of (\S+) would be detected with probability 0.9", notes[0])[1])
    scale = Record.loads((tmp_path / "test_it.json").read_text()).mean_error * math.sqrt(particles)
    old, new = np.random.default_rng(0).normal(scale=scale, size=(2, n, particles, 1))
    detections = [Change(Record.of(a, {}), Record.of(b - fall, {}), 0.05).worse for a, b in zip(old, new, strict=True)]
    assert 0.88 < np.mean(detections) < 0.97


def test_the_power_equals_the_noncentral_t_formula(exact):
    model, x, oracle = exact
    n, alpha, particles = 500, 0.05, 40
    poor = worsen(model, 0.15)
    fall = (Oracle(poor, 3).bound(x) - oracle.bound(x)).mean().item()
    assert fall < 0
    pairs = zip(repeated(model, x, n, particles, seed=1), repeated(poor, x, n, particles, seed=2), strict=True)
    changes = [Change(old, new, alpha) for old, new in pairs]
    differences = np.array([change.difference for change in changes])
    error = differences.std()
    assert abs(differences.mean() - fall) < 4 * error / math.sqrt(n)
    assert np.mean([change.error for change in changes]) == pytest.approx(error, rel=0.15)
    power = stats.nct.cdf(stats.t.ppf(alpha, particles - 1), particles - 1, fall / error)
    assert 0.2 < power < 0.99
    rate = np.mean([change.worse for change in changes])
    assert abs(rate - power) < 4 * math.sqrt(power * (1 - power) / n)


def test_coupled_draws_find_a_loss_below_the_error_of_either_bound(tmp_path, exact):
    model, x, oracle = exact
    poor = worsen(model, 0.05)
    fall = (Oracle(poor, 3).bound(x) - oracle.bound(x)).mean().item()
    old, new = (Record.of(measure(m.model, m.guide, x, 150, seed=3), {}) for m in (model, poor))
    change = Change(old, new, 0.001)
    assert change.worse
    assert abs(fall) < 2 * old.mean_error
    assert abs(change.difference - fall) < 5 * change.error


def test_an_additional_random_number_uncouples_one_draw_only():
    x, more = torch.linspace(-1, 2, 6, dtype=torch.float64), []
    model, guide = normal(0.3, 0.9)

    def other(x):
        if not more:
            more.append(torch.randn_like(x))
        guide(x)

    before, after = (measure(model, each, x, 5, 1) for each in (guide, other))
    np.testing.assert_array_equal(after[1:], before[1:])
    assert (after[0] != before[0]).all()


def test_rounding_is_no_loss_and_an_exact_bound_has_no_error():
    def compare(fall):
        old = Record.of(np.full((10, 3), -1000.0), {})
        return Change(old, Record.of(np.full((10, 3), -1000.0 - fall), {}), 0.001)

    assert not compare(0.0).worse
    assert not compare(5e-4).worse
    assert compare(2e-3).worse
    assert compare(1e9).worse
    assert not compare(2e-3).better
    assert compare(-2e-3).better


# ------------------------------------------------------------------------------------------------------- the record


def test_the_first_use_writes_and_the_same_model_passes(tmp_path, exact):
    model, x, _ = exact
    notes = []
    for _ in range(3):
        torch.manual_seed(len(notes))
        before = torch.get_rng_state()
        regression(tmp_path / "deep", notes).check(model.model, model.guide, x, particles=20, name="a name/of mine[1]")
        assert torch.equal(torch.get_rng_state(), before)
    (file,) = (tmp_path / "deep").iterdir()
    assert file.name == "a_name_of_mine_1.json"
    (note,) = notes
    assert note.startswith("new, to be committed: ")
    stored = Record.loads(file.read_text())
    assert stored.dumps() == file.read_text()
    assert (len(stored.bound), len(stored.draws)) == (4, 20)
    assert stored.mean == pytest.approx(stored.bound.mean(), abs=1e-5)


def test_a_loss_is_an_error_that_lists_the_worst_sequences(tmp_path, exact):
    model, x, _ = exact
    regression(tmp_path).check(model.model, model.guide, x)
    poor = worsen(model, 1.0)
    with pytest.raises(AssertionError) as error:
        regression(tmp_path).check(poor.model, poor.guide, x)
    text = str(error.value)
    parts = ("fell significantly", "old  ", "new  ", "difference  -", "standard error", "--update-elbo and commit")
    assert all(part in text for part in parts)
    rows = re.findall(r"^ +(\d) +\S+ +\S+ +(-\S+) +\S+$", text, re.MULTILINE)
    assert sorted(int(i) for i, _ in rows) == [0, 1, 2, 3]
    assert [float(d) for _, d in rows] == sorted(float(d) for _, d in rows)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda batch: {n: v[:3] for n, v in batch.items()}, r"the shape of lengths was \(4,\), now \(3,\)"),
        (lambda batch: {**batch, "x": batch["x"] + 1e-3 * torch.eye(4)[2, :, None, None]}, "x differs in sequence 2;"),
        (lambda batch: {"x": batch["x"]}, "it has lengths, x, the test has x"),
    ],
)
def test_other_data_are_an_error(tmp_path, exact, change, message):
    model, x, _ = exact
    batch = {"x": x, "lengths": torch.tensor([3, 3, 3, 3])}
    regression(tmp_path).check(model.model, model.guide, batch, particles=5)
    with pytest.raises(ValueError, match=f"was made with other data: .*{message}"):
        regression(tmp_path).check(model.model, model.guide, change(batch), particles=5)


def test_small_changes_are_detected_next_to_large_sequences(tmp_path, exact):
    model, x, _ = exact
    x = x * torch.tensor([1e6, 1.0, 0.0, 1.0], dtype=torch.float64)[:, None, None]
    regression(tmp_path).check(model.model, model.guide, x, particles=5)
    regression(tmp_path).check(model.model, model.guide, x.float(), particles=5)
    other = x * torch.tensor([1.0, 1.001, 1.0, 1.0], dtype=torch.float64)[:, None, None]
    with pytest.raises(ValueError, match="data differs in sequence 1;"):
        regression(tmp_path).check(model.model, model.guide, other, particles=5)


@pytest.mark.parametrize(
    ("text", "message"),
    [("[]", "TypeError"), ("{}", "KeyError"), ("<<<<<<< HEAD\n{}", "not a record of bounds")],
)
def test_a_damaged_record_is_an_error_and_can_be_renewed(tmp_path, exact, text, message):
    model, x, _ = exact
    (tmp_path / "test_it.json").write_text(text)
    with pytest.raises(ValueError, match=f"damaged .*{message}"):
        regression(tmp_path).check(model.model, model.guide, x, particles=3)
    regression(tmp_path, update=True).check(model.model, model.guide, x, particles=3)
    regression(tmp_path).check(model.model, model.guide, x, particles=3)


def test_wrong_arguments_are_errors(tmp_path, exact):
    model, x, _ = exact
    check = regression(tmp_path).check
    with pytest.raises(ValueError, match="particles must be at least 2"):
        check(model.model, model.guide, x, particles=1)
    with pytest.raises(ValueError, match=r"between 0 and 0.5, got 0.7"):
        check(model.model, model.guide, x, alpha=0.7)
    with pytest.raises(AssertionError, match=r"record .* is missing; run without --elbo-strict"):
        regression(tmp_path, strict=True).check(model.model, model.guide, x)
    assert not list(tmp_path.iterdir())
    check(model.model, model.guide, x, particles=5)
    with pytest.raises(ValueError, match=r"has 5 particles, the test 6: .* pass particles=5"):
        regression(tmp_path).check(model.model, model.guide, x, particles=6)


def test_a_record_has_one_owner(tmp_path, exact):
    model, x, _ = exact
    owners = {}
    mine = regression(tmp_path, test="test_a", owners=owners)
    mine.check(model.model, model.guide, x, name="same", particles=3)
    for other in (mine, regression(tmp_path, test="test_b", owners=owners)):
        with pytest.raises(ValueError, match="already the record of test_a; pass another name="):
            other.check(model.model, model.guide, x, name="same", particles=3)


# ------------------------------------------------------------------------------------------- custom models and bounds


def normal(location, scale, dim=-1):
    """x_i ~ N(z_i, 1), z_i ~ N(0, 1), and the guide N(location x_i, scale^2)."""

    def model(x):
        with pyro.plate("sequences", len(x), dim=dim):
            z = pyro.sample("z", dist.Normal(torch.zeros_like(x), 1.0))
            pyro.sample("x", dist.Normal(z, 1.0), obs=x)

    def guide(x):
        with pyro.plate("sequences", len(x), dim=dim):
            pyro.sample("z", dist.Normal(location * x, scale))

    return model, guide


def test_another_bound_is_tested_by_its_own_draws(tmp_path):
    """With particles, a wide guide loses less than in the ELBO, and the loss is still found."""
    model = linear_gaussian_surrogate(*PAIR, {"z": 1, "x": 1}, 3)
    Oracle(model, 3).fit_guide()
    x = model.sample(4, 3)["x"]

    def weighted(data, seed):
        return dvae.iwae_bound(model, data, 4).bound

    regression(tmp_path).check(model.model, model.guide, x, particles=20, bound=weighted)
    record = (tmp_path / "test_it.json").read_text()
    regression(tmp_path).check(model.model, model.guide, x, particles=20, bound=weighted)
    with torch.no_grad():
        for name, parameter in model.encoder.named_parameters():
            parameter.add_(1.0 if "scale" in name else 0.0)
    with pytest.raises(AssertionError, match="fell significantly"):
        regression(tmp_path).check(model.model, model.guide, x, particles=20, bound=weighted)
    elbo = measure(model.model, model.guide, x, 20, 1).mean()
    assert elbo < measure(model.model, model.guide, x, 20, 1, weighted).mean() < Record.loads(record).mean
    with pytest.raises(ValueError, match=r"the bound is \(3,\), expected one for each sequence"):
        regression(tmp_path).check(model.model, model.guide, x, bound=lambda data, seed: torch.zeros(3))


def test_bounds_must_be_finite_and_one_per_sequence(tmp_path):
    x = torch.linspace(-1, 2, 6)
    with pytest.raises(ValueError, match=r"the bound is \(3,\), expected one for each sequence; data have \[2\] rows"):
        regression(tmp_path).check(
            lambda x: normal(0.5, 1.0)[0](x[0]), lambda x: normal(0.5, 1.0)[1](x[0]), x.view(2, 3)
        )
    bad, unchecked = x.index_fill(0, torch.tensor([1, 4]), torch.inf), {"validate_distributions_torch": False}
    with (
        pyro.settings.context(validate_distributions_pyro=False, **unchecked),
        pytest.raises(ValueError, match="the bound of sequence 1, 4 is not finite"),
    ):
        regression(tmp_path).check(*normal(0.0, 1.0), bad)
    model, guide = ((lambda batch, f=f: f(batch["x"])) for f in normal(0.5, 1.0))
    with pytest.raises(ValueError, match="note is str; expected tensors"):
        regression(tmp_path).check(model, guide, {"x": x, "note": "hm"})
    assert not list(tmp_path.iterdir())


def test_bounds_are_computed_in_evaluation_mode(tmp_path):
    model = DynamicalVAE(*PAIR, {"z": 1, "x": 1}, networks.Recurrent(3, hidden=(3,)))
    model.encoder["z"].register_forward_pre_hook(lambda module, _: None if not module.training else 1 / 0)
    model.train()
    regression(tmp_path).check(model, model.guide, torch.zeros(2, 3, 1), particles=2)
    assert all(module.training for module in model.modules())


# -------------------------------------------------------------------------------------------------------- the plugin

TEST = """
import os, pytest, torch
import pyro, pyro.distributions as dist

def model(x):
    with pyro.plate("sequences", len(x), dim=-1):
        pyro.sample("x", dist.Normal(pyro.sample("z", dist.Normal(torch.zeros_like(x), 1.0)), 1.0), obs=x)

def guide(x):
    with pyro.plate("sequences", len(x), dim=-1):
        pyro.sample("z", dist.Normal(0.5 * x, float(os.environ["SCALE"])))

class TestPair:
    @pytest.mark.parametrize("n", [2, 3])
    def test_bound(self, elbo_regression, n):
        elbo_regression.check(model, guide, torch.linspace(-1, 1, n))
"""


@pytest.fixture
def run(pytester, monkeypatch):
    pytester.makepyfile(test_pair=TEST)

    def run(scale, *options, inside=True):
        monkeypatch.setenv("SCALE", str(scale))
        options = ("-p", "dvae.testing.plugin", "-p", "no:cacheprovider", *options)
        return pytester.runpytest_inprocess(*options) if inside else pytester.runpytest_subprocess(*options)

    return run


@pytest.mark.slow
def test_a_record_is_created_checked_and_updated(pytester, run):
    result = run(1.5, "--elbo-strict")
    result.assert_outcomes(failed=2)
    result = run(1.5)
    result.assert_outcomes(passed=2)
    files = [f"elbo_regression/test_pair/TestPair.test_bound_{n}.json" for n in (2, 3)]
    result.stdout.fnmatch_lines(["*evidence bounds*", *[f"new, to be committed: {file}: *" for file in files]])
    assert {json.loads((pytester.path / file).read_text())["particles"] for file in files} == {100}

    result = run(1.5, "--elbo-strict")
    result.assert_outcomes(passed=2)
    result.stdout.no_fnmatch_line("*evidence bounds*")

    result = run(2.0)
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(
        ["E*the evidence bound fell significantly", "E*worst of 2 sequences:", "E*--update-elbo*"]
    )
    result.stdout.no_fnmatch_line("*regression.py:*")  # the traceback ends in the user's test

    result = run(0.7)
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["better by * run with --update-elbo to keep it: elbo_regression/*"])

    result = run(2.0, "--update-elbo")
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines([f"renewed, to be committed: {file}: *" for file in files])
    run(2.0).assert_outcomes(passed=2)


@pytest.mark.slow
def test_workers_report_to_the_summary(pytester, run):
    result = run(1.0, "-n", "1", inside=False)
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["*evidence bounds*", "new, to be committed: *", "new, to be committed: *"])
    assert len(list((pytester.path / "elbo_regression" / "test_pair").iterdir())) == 2


def test_pytest_finds_the_plugin_and_does_not_wait_for_torch():
    pytest.importorskip("pytest_dvae", reason="the plugin is found where the package is installed")
    assert [point.value for point in entry_points(group="pytest11", name="dvae.testing.plugin")] == ["pytest_dvae"]
    code = "import sys, pytest_dvae; sys.exit('torch' in sys.modules or 'dvae' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# ------------------------------------------------------------------------------------------------- used for real


def test_a_mean_field_guide_has_the_same_bound_on_every_machine(elbo_regression):
    model = linear_gaussian_surrogate("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2}, 6)
    with torch.no_grad():
        for parameter in model.generator.parameters():
            parameter.copy_(torch.linspace(-0.5, 0.7, parameter.numel()).view_as(parameter))
    oracle = Oracle(model, 6)
    assert oracle.fit_guide() > 0.01
    x = torch.cos(torch.arange(8 * 6 * 2, dtype=torch.float64) ** 2).view(8, 6, 2)
    elbo_regression.check(model.model, model.guide, x, particles=200)
    record = Record.of(measure(model.model, model.guide, x, 200, seed=1), {})
    assert abs(record.mean - oracle.bound(x).mean().item()) < 5 * record.mean_error


@pytest.mark.slow
def test_the_documented_examples_run(pytester):
    blocks = re.findall(
        r"```python\n(.*?)```", (DOCS / "how-to" / "test_your_model.md").read_text(encoding="utf-8"), re.DOTALL
    )
    pytester.makepyfile(test_documented="\n".join(blocks))
    pytester.makeconftest("from dvae.testing import FactorizationContract as contract\ncontract.training_steps = 2")
    # in a separate process: training loads modules of torch that a process can load only once
    result = pytester.runpytest_subprocess("-p", "dvae.testing.plugin", "-W", "error")
    gpu = torch.cuda.is_available()
    result.assert_outcomes(passed=17 + gpu, skipped=1 - gpu)
    assert len(list(pytester.path.glob("elbo_regression/test_documented/*.json"))) == 1
