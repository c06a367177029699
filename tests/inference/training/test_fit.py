"""The training loop: its objective, bit-for-bit resuming, stopping, and intact files."""

import contextlib
import io
import json
import math
import pickle
import signal
import sys
import warnings
from pathlib import Path

import matplotlib
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from safetensors.torch import load_file
from stopping import At, interrupt
from walks import HELD_OUT, TRAIN, build, same

from dvae.data.sequences import Sequences
from dvae.inference.bounds.elbo import SequenceELBO, Terms
from dvae.inference.training import checkpoints
from dvae.inference.training.checkpoints import CheckpointError, Run, load_weights, weights
from dvae.inference.training.fit import Interrupted, fit
from dvae.inference.training.objectives import Evidence
from dvae.inference.training.options import Stage
from dvae.inference.training.schedules import Piecewise, Ramp, from_config
from dvae.inference.training.svi import SVI, NonFiniteError
from dvae.inference.training.trackers import InMemory, JSONLines, TensorBoard, Terminal
from dvae.program.model import DynamicalVAE

matplotlib.use("agg")

fit_module = sys.modules[fit.__module__]


def run(model=None, train=TRAIN, validation=None, **options):
    """A short quiet run."""
    defaults = {"batch_size": 8, "log_every": 5, "validate_every": 20, "progress": False, "learning_rate": 0.02}
    if "stages" not in options:
        defaults["steps"] = 60
    return fit(model or build(), train, validation, **(defaults | options))


def ruin(state):
    """Leave weights that are finite but worse."""
    with torch.no_grad():
        for parameter in state.model.parameters():
            parameter.add_(3.0)


# The objective --------------------


def terms(frames=(4.0, 2.0), **tables):
    tables = {"log_likelihood": {"x": [-8.0, -4.0]}, "kl": {"w": [0.3, 0.9], "z": [2.0, 4.0]}, "energies": {}} | tables
    tables = {table: {k: torch.tensor(v).double() for k, v in values.items()} for table, values in tables.items()}
    return Terms(**tables, n_steps=torch.tensor(frames).double())


def test_kl_weights_free_bits_and_energies_enter_the_loss_as_documented():
    energy = terms(energies={"feet": [1.0, 5.0]})
    assert Evidence()(terms(), step=0).item() == pytest.approx(-terms().bound.sum().item() / 6)
    assert Evidence(kl_weight=0.5)(terms(), 0).item() == pytest.approx((12 + 0.5 * 7.2) / 6)
    assert Evidence(kl_weight={"z": Ramp(0.0, 1.0, 10)})(terms(), 5).item() == pytest.approx((12 + 1.2 + 3) / 6)
    assert Evidence(free_bits=0.5)(terms(), 0).item() == pytest.approx((12 + 6) / 6 + 0.5)
    assert Evidence(free_bits={"w": 0.5})(terms(), 0).item() == pytest.approx((12 + 6) / 6 + 0.5)
    assert Evidence(energy_weights={"feet": 2.0})(energy, 0).item() == pytest.approx((12 + 7.2 + 12) / 6)
    assert Evidence()(energy, 0).item() == pytest.approx((12 + 7.2 + 6) / 6)
    assert Evidence(likelihood_weight=0.5)(terms(), 0).item() == pytest.approx((6 + 7.2) / 6)


def test_free_bits_stop_the_gradient_and_a_negative_kl_estimate_stays_unbiased():
    rate = torch.tensor([0.1, 0.1], requires_grad=True)
    Evidence(free_bits=1.0)(Terms({"x": rate * 0}, {"z": rate}, {}, torch.ones(2)), 0).backward()
    assert torch.equal(rate.grad, torch.zeros(2))
    assert Evidence()(terms(kl={"z": [-1.0, -2.0]}), 0).item() == pytest.approx((12 - 3) / 6)


@pytest.mark.parametrize("option", ["kl_weight", "free_bits", "energy_weights"])
def test_a_weight_for_an_unknown_term_is_an_error(option):
    with pytest.raises(ValueError, match=f"{option} names 'y', but the terms are"):
        Evidence(**{option: {"y": 1.0}})(terms(), 0)


def test_an_objective_survives_json():
    with pytest.raises(ValueError, match="select"):
        Evidence(select="best")
    kl_weight, energies = {"z": Piecewise(((0, 0.0), (9, 1.0)))}, {"feet": 2.0}
    objective = Evidence(kl_weight, free_bits=0.1, energy_weights=energies, draws={"z": 3}, select="loss")
    config = from_config(json.loads(json.dumps(objective.to_config())))
    assert config.pop("objective") == "Evidence"
    assert Evidence(**config) == objective


# The loop --------------------


def test_a_fit_raises_the_bound_and_reports_terms_that_add_up():
    result = run(validation=HELD_OUT, objective=Evidence(kl_weight=Ramp(0.2, 1.0, 40)))
    assert (result.status, result.step, result.run) == ("finished", 60, None)
    _, bounds = result.series("validation/bound")
    assert bounds[-1] > bounds[0]
    assert result.best_bound == max(bounds)
    for row in result.history:
        prefix = "validation/" if "validation/bound" in row else ""
        assert row[f"{prefix}bound"] == pytest.approx(row[f"{prefix}log_likelihood/x"] - row[f"{prefix}kl/z"])
        if not prefix:  # the weight belongs to the global step before the update; the recorded bound is unweighted
            weight = min(0.2 + 0.8 * (row["step"] - 1) / 40, 1.0)
            assert row["loss"] == pytest.approx(weight * row["kl/z"] - row["log_likelihood/x"])


def test_validation_scores_are_unweighted_bounds_per_step_of_held_out_data():
    model = build()
    lengths = torch.tensor([4, 1, 2, 3, 4, 4, 1])
    held_out = {"x": HELD_OUT, "lengths": lengths}
    result = run(model, validation=held_out, objective=Evidence(kl_weight=0.0), steps=20, batch_size=24, seed=3)
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(3)
        terms_of_all = SequenceELBO().terms(model, held_out)
    assert result.best_bound == pytest.approx(terms_of_all.bound.sum().item() / lengths.sum().item(), abs=1e-12)


def test_validating_changes_neither_training_nor_the_callers_random_state(tmp_path):
    before = torch.get_rng_state()
    model, other = build(), build()
    torch.set_rng_state(before)
    run(model, out=tmp_path / "without")
    run(other, validation=HELD_OUT, validate_every=7, out=tmp_path / "with")
    assert torch.equal(torch.get_rng_state(), before)
    assert same(*(load_file(tmp_path / name / "last.safetensors") for name in ("with", "without")))


def test_runs_with_the_same_seed_are_equal():
    first, second, third = build(), build(), build()
    for model, seed in ((first, 1), (second, 1), (third, 2)):
        run(model, seed=seed, steps=10)
    assert same(weights(first), weights(second))
    assert not same(weights(first), weights(third))


def test_a_loss_and_a_bound_are_not_compared():
    """The bound of the second stage is far below the loss of the first, with its small weights."""
    by_loss = Evidence(likelihood_weight=1e-3, kl_weight=0.0, select="loss")
    result = run(validation=HELD_OUT, stages=[Stage(40, by_loss), Stage(40, Evidence())])
    steps, bounds = result.series("validation/bound")
    later = {step: bound for step, bound in zip(steps, bounds, strict=True) if step >= 40}
    assert (result.best_bound, result.best_step) == (max(later.values()), max(later, key=later.get))


def test_an_infinite_bound_does_not_select_weights(tmp_path, monkeypatch):
    evaluate, values = SVI.evaluate, [1.0, math.inf, 2.0]
    monkeypatch.setattr(SVI, "evaluate", lambda self, data: {**evaluate(self, data), "bound": values.pop(0)})
    result = run(validation=HELD_OUT, out=tmp_path)
    assert (result.best_bound, result.best_step) == (2.0, 60)
    assert Run(tmp_path).state["best_bound"] == 2.0


def test_the_model_ends_in_evaluation_mode_with_the_best_weights_and_best_is_a_copy(tmp_path):
    model, best = build(), {}
    callbacks = [At(20, lambda state: best.update(weights(state.model))), At(21, ruin)]
    result = run(model, validation=HELD_OUT, out=tmp_path, callbacks=callbacks, learning_rate=1e-3)
    assert result.best_step == 20
    assert not model.training
    assert same(weights(model), best)
    assert same(load_file(tmp_path / "best.safetensors"), best)
    assert not same(load_file(tmp_path / "last.safetensors"), best)
    restored = build(seed=5)
    load_weights(restored, tmp_path)
    assert same(weights(restored), best)


def test_early_stopping_counts_validations_without_improvement():
    result = run(validation=HELD_OUT, learning_rate=0.0, validate_every=5, patience=3)
    assert (result.status, result.best_step, result.step) == ("stopped early", 5, 20)


def test_stages_follow_one_another_on_one_global_step():
    calls = []

    def spying(name):
        return lambda terms, step: (calls.append((name, step)), Evidence()(terms, step))[1]

    stages = [Stage(3, spying("a")), Stage(2, spying("b"), learning_rate=Ramp(0.0, 1.0, 5))]
    result = run(stages=stages, log_every=1)
    assert calls == [("a", 0), ("a", 1), ("a", 2), ("b", 3), ("b", 4)]
    assert result.series("learning_rate")[1] == pytest.approx([0.02, 0.02, 0.02, 0.6, 0.8])
    with pytest.raises(ValueError, match="stages take"):
        run(stages=stages, steps=9)
    with pytest.raises(ValueError, match="either objective or stages"):
        run(stages=stages, objective=Evidence())


def test_a_stage_keeps_frozen_parameters_also_after_resuming(tmp_path):
    stages = [Stage(30, frozen=("generator.z.", "generator.x.head")), Stage(30)]
    start = build().state_dict()

    def moved(state):
        now = state.model.state_dict()
        return {name for name in now if not torch.equal(now[name], start[name])}

    moved_parts = {}
    watch = [At(step, lambda state, step=step: moved_parts.update({step: moved(state)})) for step in (30, 31)]
    run(out=tmp_path / "whole", stages=stages, callbacks=watch)
    assert moved_parts[30] == {name for name in start if not name.startswith(stages[0].frozen)}
    assert moved_parts[31] == set(start)
    with pytest.raises(Interrupted):
        run(out=tmp_path / "parts", stages=stages, callbacks=[At(20, interrupt)])
    run(build(seed=9), out=tmp_path / "parts", stages=stages, resume=True)
    assert same(*(load_file(tmp_path / name / "last.safetensors") for name in ("whole", "parts")))
    with pytest.raises(ValueError, match="starts with"):
        run(stages=[Stage(2, frozen=("decoder.",))])
    with pytest.raises(ValueError, match="parameter is frozen"):
        run(stages=[Stage(2, frozen=("generator", "encoder"))])


def test_the_program_receives_the_scheduled_sampling_probability():
    probabilities = []

    class Spy(DynamicalVAE):
        def model(self, batch=None, **options):
            probabilities.append(options.get("scheduled_sampling", 0.0))
            return super().model(batch, **options)

    run(build(kind=Spy), validation=HELD_OUT, steps=4, validate_every=4, scheduled_sampling=Ramp(0.0, 0.4, 4))
    assert probabilities == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.0, 0.3])  # validated at 0, then at the final value


def test_the_gradient_is_clipped_in_norm():
    model = build()
    before = torch.nn.utils.parameters_to_vector(model.parameters()).clone()
    result = run(model, steps=1, log_every=1, optimizer="sgd", learning_rate=1.0, gradient_clip=0.01)
    step = torch.nn.utils.parameters_to_vector(model.parameters()) - before
    assert result.history[0]["gradient_norm"] > 0.01
    assert step.norm().item() == pytest.approx(0.01)


def test_ragged_and_masked_data_train():
    x = TRAIN.clone()
    x[0, 1, 2], x[1, 3] = math.nan, math.nan
    mask, lengths = torch.ones_like(x, dtype=torch.bool), torch.full((24,), 4)
    mask[0, 1, 2], lengths[1] = False, 3
    result = run(train={"x": x, "mask": mask, "lengths": lengths}, steps=20)
    assert math.isfinite(result.history[-1]["bound"])


def test_a_batch_has_distinct_sequences_and_all_of_a_small_dataset():
    data = Sequences({"x": torch.arange(6.0)[:, None, None], "lengths": torch.arange(6)})
    for size in (1, 4, 6, 9):
        batch = data.sample(size, torch.Generator().manual_seed(0))
        assert len(set(batch["lengths"].tolist())) == min(size, 6)
        assert torch.equal(batch["x"][:, 0, 0], batch["lengths"].float())
    assert torch.equal(torch.cat([batch["x"] for batch in data.batches(4)]), data.batch["x"])


# Resuming --------------------


@pytest.mark.parametrize("kind", ["callback", "ctrl-c", "terminate"])
def test_an_interrupted_run_resumes_bit_for_bit(tmp_path, kind):
    number = signal.SIGTERM if kind == "terminate" else signal.SIGINT
    action = interrupt if kind == "callback" else lambda state: signal.raise_signal(number)
    options = {
        "validation": HELD_OUT,
        "objective": Evidence(kl_weight=Ramp(0.0, 1.0, 50)),
        "scheduled_sampling": Ramp(0.0, 0.5, 60),
    }
    uninterrupted = run(out=tmp_path / "whole", **options)
    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with pytest.raises(Interrupted, match="resume with") as stopped:
        run(out=tmp_path / "parts", callbacks=[At(33, action)], **options)
    assert handlers == (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM))
    assert (stopped.value.signal, stopped.value.fit.status) == (number, "interrupted")
    assert Run(tmp_path / "parts").state["status"] == "interrupted"

    resumed = run(build(seed=9), out=tmp_path / "parts", resume=True, **options)
    assert resumed.history == uninterrupted.history
    assert (resumed.best_step, resumed.best_bound) == (uninterrupted.best_step, uninterrupted.best_bound)
    for name in ("last.safetensors", "best.safetensors"):
        assert same(load_file(tmp_path / "whole" / name), load_file(tmp_path / "parts" / name))


def test_resuming_on_other_data_is_an_error(tmp_path):
    class Windows(Sequences):
        @property
        def fingerprint(self):
            return f"{self.batch['x'].sum():.6f}"

    train, held_out = Windows({"x": TRAIN}), Windows({"x": HELD_OUT})
    other_train, other_held_out = Windows({"x": TRAIN + 1}), Windows({"x": HELD_OUT + 1})
    run(train=train, validation=held_out, out=tmp_path, steps=5)
    for parts, message in (
        ((other_train, held_out), "was fitted on other training data: .* fingerprint"),
        ((train, other_held_out), "was fitted on other validation data: .* fingerprint"),
    ):
        with pytest.raises(CheckpointError, match=message):
            run(None, *parts, out=tmp_path, steps=10, resume=True)
    with pytest.raises(CheckpointError, match="selects its weights on validation data; pass these data"):
        run(train=train, out=tmp_path, steps=10, resume=True)
    assert run(train=train, validation=held_out, out=tmp_path, steps=10, resume=True).step == 10


def test_a_run_that_another_process_wrote_in_the_meantime_is_not_overwritten(tmp_path, monkeypatch):
    """The other process writes between the first check of the directory and the lock."""
    init, other = SVI.init, []

    def slow(self):
        if not other:
            other.append(None)
            run(out=tmp_path / "run", steps=30)
        return init(self)

    monkeypatch.setattr(SVI, "init", slow)
    with pytest.raises(CheckpointError, match="already holds a run"):
        run(out=tmp_path / "run", steps=10)
    assert Run(tmp_path / "run").state["step"] == 30


def test_rows_after_the_checkpoint_are_dropped_on_resume(tmp_path):
    class Crash(RuntimeError):
        pass

    def crash(state):
        raise Crash

    with pytest.raises(Crash):
        run(out=tmp_path, callbacks=[At(36, crash)])
    assert JSONLines(tmp_path / "log.jsonl").read()[-1]["step"] == 35
    assert Run(tmp_path).state["step"] == 20
    result = run(build(seed=9), out=tmp_path, resume=True)
    assert result.series("loss")[0] == list(range(5, 65, 5))
    assert JSONLines(tmp_path / "log.jsonl").read() == result.history


# Nonfinite values --------------------


def test_a_nonfinite_term_stops_the_run_and_keeps_the_last_checkpoint(tmp_path, monkeypatch):
    honest, calls = SequenceELBO.terms, []

    def broken(self, model, batch, **options):
        calls.append(batch)
        result = honest(self, model, batch, **options)
        if len(calls) == 27:
            result.kl["z"] = result.kl["z"] * torch.tensor([1.0, math.nan] * 4)
            result.steps["z"] = result.steps["z"] * torch.tensor([1.0, 1.0, math.nan, math.nan])
        return result

    monkeypatch.setattr(SequenceELBO, "terms", broken)
    model, checkpoint = build(), {}
    with pytest.raises(NonFiniteError, match="sequences"):
        run(model, out=tmp_path, callbacks=[At(20, lambda state: checkpoint.update(weights(state.model)))])
    assert Run(tmp_path).state["status"] == "failed"
    assert same(load_file(tmp_path / "last.safetensors"), checkpoint)
    assert all(torch.isfinite(value).all() for value in weights(model).values())
    monkeypatch.setattr(SequenceELBO, "terms", honest)
    assert run(build(seed=9), out=tmp_path, resume=True).step == 60


def test_a_nonfinite_gradient_or_weight_is_named():
    def steep(terms, step):
        return Evidence()(terms, step) + (terms.kl["z"].sum() * 0).sqrt()

    model = build()
    before = weights(model)
    with pytest.raises(NonFiniteError, match="gradient"):
        run(model, objective=steep)
    assert same(weights(model), before)
    with pytest.raises(NonFiniteError, match="though every"):
        run(objective=lambda terms, step: Evidence()(terms, step) * math.nan)


# Errors --------------------


def test_unknown_or_invalid_options_are_errors():
    with pytest.raises(TypeError, match="option"):
        run(step=5)
    with pytest.raises(TypeError, match="options"):
        run(qqq=5)
    with pytest.raises(TypeError, match="expected"):
        run(train="data.npz")
    with pytest.raises(ValueError, match="patience counts validations"):
        run(patience=3)


# Checkpoints --------------------


@pytest.fixture
def finished(tmp_path):
    run(out=tmp_path, steps=5, validation=HELD_OUT)
    return tmp_path


def test_an_existing_run_is_never_overwritten_or_resumed_implicitly(finished):
    with pytest.raises(CheckpointError, match="continue"):
        run(out=finished)
    state = json.loads((finished / "state.json").read_text())
    (finished / "state.json").write_text(json.dumps({**state, "status": "failed"}))
    with pytest.raises(CheckpointError, match="failed"):
        run(out=finished)
    (finished / "state.json").write_text(json.dumps(state))
    with pytest.raises(CheckpointError, match="resume"):
        run(out=finished / "elsewhere", resume=True)
    with pytest.raises(CheckpointError, match="fitted with"):
        run(validation=HELD_OUT, out=finished, resume=True, optimizer="sgd")


@pytest.mark.parametrize(
    ("name", "damage"),
    [("best.safetensors", "flipped"), ("last.safetensors", "truncated"), ("last.state.safetensors", "missing")],
)
def test_a_damaged_file_is_an_error_with_its_name(finished, name, damage):
    path = finished / name
    content = bytearray(path.read_bytes())
    content[-5] ^= 1
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(content if damage == "flipped" else content[:-40])
    expected = "is missing; copy the run directory whole" if damage == "missing" else "is damaged or from another run"
    with pytest.raises(CheckpointError, match=f"{name} {expected}"):
        run(validation=HELD_OUT, out=finished, steps=10, resume=True)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ([], "object"),
        ({"fingerprints": {"last.safetensors": None}}, "fingerprints"),
    ],
)
def test_a_state_without_fingerprints_is_an_error(finished, state, message):
    (finished / "state.json").write_text(json.dumps(state))
    for path in (finished, finished / "best.safetensors"):
        with pytest.raises(CheckpointError, match=message):
            load_weights(build(), path)
    with pytest.raises(CheckpointError, match=r"state\.json is damaged"):
        run(validation=HELD_OUT, out=finished, steps=10, resume=True)


def test_weights_of_another_model_are_an_error(finished, tmp_path):
    with pytest.raises(CheckpointError, match="weights"):
        load_weights(build(latent=3), finished)
    with pytest.raises(CheckpointError, match="another model"):
        load_weights(torch.nn.Linear(2, 2), finished)
    with pytest.raises(CheckpointError, match="directory"):
        load_weights(build(), tmp_path / "..")
    with pytest.raises(CheckpointError, match="safetensors file"):
        load_weights(build(), tmp_path / "nowhere")
    (tmp_path / "text.safetensors").write_text("weights")
    with pytest.raises(CheckpointError, match="safetensors file"):
        load_weights(build(), tmp_path / "text.safetensors")
    (finished / "state.json").write_text("{")
    with pytest.raises(CheckpointError, match="damaged"):
        load_weights(build(), finished)


def test_an_optimiser_state_is_never_unpickled(finished):
    class Hostile:
        def __reduce__(self):
            return (exec, ("raise SystemExit('executed')",))

    buffer = io.BytesIO()
    torch.save(Hostile(), buffer)
    for content in (pickle.dumps(Hostile()), buffer.getvalue()):
        Run(finished).commit(Run(finished).state, {"last.state.safetensors": content})
        with pytest.raises(CheckpointError, match="safetensors file"):
            run(validation=HELD_OUT, out=finished, steps=10, resume=True)


STATE = {"step": 0, "best_step": None, "best_bound": None, "waited": 0, "status": "running", "optimizer": "adam"}
STATE |= {"last_value": None, "processor_seconds": 0.0}


@given(st.integers(0, 8))
def test_a_process_killed_at_any_moment_leaves_an_intact_checkpoint(tmp_path_factory, moment):
    path = tmp_path_factory.mktemp("run")
    files = {name: name.encode() * 3 for name in ("last.safetensors", "last.state.safetensors")}
    Run(path).commit(STATE | {"step": 1}, {name: b"1" + content for name, content in files.items()})
    remaining = [moment]

    class Killed(BaseException):
        pass

    def mortal(function):
        def call(*arguments):
            remaining[0] -= 1
            if remaining[0] < 0:
                raise Killed
            function(*arguments)

        return call

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoints.files, "write", mortal(checkpoints.files.write))
        patch.setattr(checkpoints.os, "replace", mortal(checkpoints.os.replace))
        with contextlib.suppress(Killed):
            Run(path).commit(STATE | {"step": 2}, {name: b"2" + content for name, content in files.items()})
    step = Run(path).state["step"]
    assert step == (1 if moment < 4 else 2)
    for name, content in files.items():
        assert Run(path).read(name) == str(step).encode() + content
    Run(path).commit(STATE | {"step": 3}, {"last.state.safetensors": b"3"})
    assert Run(path).read("last.safetensors") == str(step).encode() + files["last.safetensors"]


# Trackers --------------------


def test_every_tracker_receives_every_row(tmp_path):
    memory, board = InMemory(), TensorBoard(tmp_path / "board")
    result = run(trackers=[memory, board], out=tmp_path / "run", steps=10)
    assert memory.rows == result.history == JSONLines(tmp_path / "run" / "log.jsonl").read()
    assert list((tmp_path / "board").glob("events.*"))


def test_json_lines_ignore_a_truncated_last_line(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_text('{"step": 1, "loss": 2.0}\n{"step": 2, "loss": 1.0}\n{"step": 3, "lo')
    log = JSONLines(path)
    log.start(2)
    log.log(3, {"loss": 0.5})
    log.close()
    assert [row["loss"] for row in log.read()] == [2.0, 1.0, 0.5]


def test_learning_curves_are_drawn():
    figure = run(validation=HELD_OUT, steps=20).plot()
    bound, divergence = figure.axes
    assert bound.get_ylabel() == "bound (nats per step)"
    assert [line.get_label() for line in divergence.lines] == ["z"]
    matplotlib.pyplot.close(figure)


# Several processes --------------------


def test_a_run_is_fitted_by_one_process_at_a_time(tmp_path):
    with Run(tmp_path).locked(), pytest.raises(CheckpointError, match="another process"):
        run(out=tmp_path)
    assert run(out=tmp_path).status == "finished"


# Threads --------------------


@pytest.mark.parametrize(
    ("threads", "cores", "load", "warned"),
    [(8, 4, 0.0, True), (4, 4, 6.0, True), (4, 4, 4.5, False), (1, 4, 9.0, False)],
)
def test_a_fit_warns_of_threads_that_wait_for_a_core(threads, cores, load, warned, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(cores)), raising=False)
    monkeypatch.setattr("os.getloadavg", lambda: (load, 0.0, 0.0))
    monkeypatch.setattr(fit_module, "CPU_LIMIT", Path("no file"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run(steps=2)
    messages = [str(each.message) for each in caught]
    assert bool(messages) == warned
    assert all(f"torch uses {threads} threads on {cores} cores" in message for message in messages)


def test_a_fit_counts_the_cores_that_a_container_may_use(monkeypatch, tmp_path):
    limit = tmp_path / "cpu.max"
    limit.write_text("150000 100000\n")
    monkeypatch.setattr(fit_module, "CPU_LIMIT", limit)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 4)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(8)), raising=False)
    with pytest.warns(UserWarning, match="torch uses 4 threads on 2 cores"):
        run(steps=2)


def test_a_line_of_progress_shows_validation_scores_only_when_they_are_new():
    screen = io.StringIO()
    terminal = Terminal(30, Console(file=screen, width=200, no_color=True))
    terminal.start(0)
    for step in range(1, 31):
        terminal.log(step, {"bound": float(step)})
        if step in (2, 6, 30):
            terminal.log(step, {"validation/bound": step + 0.5})
    terminal.close()
    lines = screen.getvalue().splitlines()
    assert [line for line in lines if "validation" in line] == [lines[0], lines[1], lines[-1]]
    assert lines[:2] == [  # a line has all rows of its step
        "step 3/30  bound 3.000  validation bound 2.500",
        "step 6/30  bound 6.000  validation bound 6.500",
    ]
    assert len(lines) == 10
