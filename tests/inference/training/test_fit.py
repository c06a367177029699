"""The shared loop: what it minimises, that it resumes bit for bit, where it stops, that files stay whole."""

import contextlib
import io
import json
import math
import os
import pickle
import signal
import subprocess
import sys
from pathlib import Path

import matplotlib
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from safetensors.torch import load_file
from stopping import At, interrupt

from dvae.data.sequences import Sequences
from dvae.inference.bounds.elbo import SequenceELBO, Terms
from dvae.inference.training import checkpoints
from dvae.inference.training.checkpoints import CheckpointError, Run, load_weights, save_weights, weights
from dvae.inference.training.fit import Callback, Interrupted, fit
from dvae.inference.training.objectives import Evidence
from dvae.inference.training.options import Stage, Training
from dvae.inference.training.schedules import Piecewise, Ramp, from_config
from dvae.inference.training.svi import NonFiniteError
from dvae.inference.training.trackers import InMemory, JSONLines, TensorBoard, Terminal
from dvae.networks import Dense
from dvae.program.model import DynamicalVAE

matplotlib.use("agg")


def build(seed=0, latent=2, kind=DynamicalVAE):
    torch.manual_seed(seed)
    equations = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)"
    return kind(*equations, {"z": latent, "x": 3}, network=Dense(widths=(8,))).double()


def walks(n, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(n, 4, 3, generator=generator, dtype=torch.float64).cumsum(1)


TRAIN, HELD_OUT = walks(24), walks(7, seed=1)


def run(model=None, train=TRAIN, validation=None, **options):
    """A short quiet run."""
    defaults = {
        "batch_size": 8,
        "log_every": 5,
        "validate_every": 20,
        "progress": False,
        "learning_rate": 0.02,
    }
    if "stages" not in options:
        defaults["steps"] = 60
    return fit(model or build(), train, validation, **(defaults | options))


def ruin(state):
    """Leave weights that are finite but worse."""
    with torch.no_grad():
        for parameter in state.model.parameters():
            parameter.add_(3.0)


def same(first, second):
    assert first.keys() == second.keys()
    return all(torch.equal(first[name], second[name]) for name in first)


# The objective --------------------


def terms(frames=(4.0, 2.0), **tables):
    tables = {
        "log_likelihood": {"x": [-8.0, -4.0]},
        "kl": {"w": [0.3, 0.9], "z": [2.0, 4.0]},
        "energies": {},
    } | tables
    tables = {table: {k: torch.tensor(v).double() for k, v in values.items()} for table, values in tables.items()}
    return Terms(**tables, frames=torch.tensor(frames).double())


def test_the_unweighted_objective_is_minus_the_bound_per_frame():
    assert Evidence()(terms(), step=0).item() == pytest.approx(-terms().bound.sum().item() / 6)


def test_kl_weights_free_bits_and_energies_enter_the_loss_as_documented():
    energy = terms(energies={"feet": [1.0, 5.0]})
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
def test_a_weight_for_an_unknown_term_is_refused(option):
    with pytest.raises(ValueError, match=f"{option} names 'y', but the terms are"):
        Evidence(**{option: {"y": 1.0}})(terms(), 0)


def test_an_objective_survives_json():
    with pytest.raises(ValueError, match="select is 'best'; it must be 'bound' or 'loss'"):
        Evidence(select="best")
    objective = Evidence(
        {"z": Piecewise(((0, 0.0), (9, 1.0)))},
        free_bits=0.1,
        energy_weights={"feet": 2.0},
        draws={"z": 3},
        select="loss",
    )
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
        if not prefix:  # the weight is that of the global step before the update, the recorded bound has none
            weight = min(0.2 + 0.8 * (row["step"] - 1) / 40, 1.0)
            assert row["loss"] == pytest.approx(weight * row["kl/z"] - row["log_likelihood/x"])


def test_validation_losses_have_the_weights_of_the_end():
    """So that those of a warm-up are not the lowest for costing less."""
    result = run(validation=HELD_OUT, objective=Evidence(kl_weight=Ramp(0.0, 1.0, 60), select="loss"))
    rows = [row for row in result.history if "validation/loss" in row]
    assert len(rows) > 1
    for row in rows:
        assert row["validation/loss"] == pytest.approx(-row["validation/bound"])


def test_validation_scores_held_out_data_in_frames_and_without_weights():
    model = build()
    lengths = torch.tensor([4, 1, 2, 3, 4, 4, 1])
    held_out = {"x": HELD_OUT, "lengths": lengths}
    result = run(model, validation=held_out, objective=Evidence(kl_weight=0.0), steps=20, batch_size=24, seed=3)
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(3)
        scored = SequenceELBO().terms(model, held_out)
    assert result.best_bound == pytest.approx(scored.bound.sum().item() / lengths.sum().item(), abs=1e-12)


def test_validating_changes_neither_training_nor_the_callers_random_state(tmp_path):
    before = torch.get_rng_state()
    model, other = build(), build()
    torch.set_rng_state(before)
    run(model, out=tmp_path / "without")
    run(other, validation=HELD_OUT, validate_every=7, out=tmp_path / "with")
    assert torch.equal(torch.get_rng_state(), before)
    assert same(*(load_file(tmp_path / name / "last.safetensors") for name in ("with", "without")))


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_a_fit_takes_gradients_wherever_it_is_called(mode):
    model = build()
    with mode():
        inside = run(model, train=walks(24), validation=walks(7, seed=1), steps=3)
        assert not torch.is_grad_enabled()
    assert inside.best_bound == run(steps=3, validation=HELD_OUT).best_bound


def test_the_seed_decides_everything():
    first, second, third = build(), build(), build()
    for model, seed in ((first, 1), (second, 1), (third, 2)):
        run(model, seed=seed, steps=10)
    assert same(weights(first), weights(second))
    assert not same(weights(first), weights(third))


def test_the_model_ends_in_evaluation_mode_with_the_best_weights_and_best_is_a_copy(tmp_path):
    model, kept = build(), {}
    callbacks = [At(20, lambda state: kept.update(weights(state.model))), At(21, ruin)]
    result = run(model, validation=HELD_OUT, out=tmp_path, callbacks=callbacks, learning_rate=1e-3)
    assert result.best_step == 20
    assert not model.training
    assert same(weights(model), kept)
    assert same(load_file(tmp_path / "best.safetensors"), kept)
    assert not same(load_file(tmp_path / "last.safetensors"), kept)
    restored = build(seed=5)
    load_weights(restored, tmp_path)
    assert same(weights(restored), kept)


def test_early_stopping_counts_validations_without_a_better_bound():
    result = run(validation=HELD_OUT, learning_rate=0.0, validate_every=5, patience=3)
    assert (result.status, result.best_step, result.step) == ("stopped early", 5, 20)


def test_a_callback_can_end_the_run():
    result = run(callbacks=[At(7, lambda state: setattr(state, "stop", True))])
    assert (result.status, result.step) == ("stopped early", 7)


def test_numbers_that_a_callback_returns_are_rows_of_the_log_and_change_nothing_else(tmp_path):
    class Weighs(Callback):
        def on_step(self, state):
            torch.randn(3)
            return {"weight/sum": float(state.step)} if state.step % 20 == 0 else None

        def on_end(self, state):
            return {"weight/end": 1.0}

    plain, told = run(validation=HELD_OUT), run(validation=HELD_OUT, out=tmp_path / "told", callbacks=[Weighs()])
    assert told.series("weight/sum") == ([20, 40, 60], [20.0, 40.0, 60.0])
    assert told.series("weight/end") == ([60], [1.0])
    assert [row for row in told.history if not any(name.startswith("weight") for name in row)] == plain.history
    assert JSONLines(tmp_path / "told" / "log.jsonl").read() == told.history


def test_momentum_is_that_of_sgd_and_goes_on_after_a_resume(tmp_path):
    options = {"optimizer": "sgd", "momentum": 0.9, "learning_rate": 1e-3, "gradient_clip": None}
    weights, gradients = [], []

    class Watches(Callback):
        def on_step(self, state):
            weights.append(torch.cat([parameter.detach().flatten() for parameter in state.model.parameters()]))
            gradients.append(torch.cat([parameter.grad.flatten() for parameter in state.model.parameters()]))

    whole = run(out=tmp_path / "whole", steps=8, callbacks=[Watches()], **options)
    velocity = gradients[0]
    for before, after, gradient in zip(weights, weights[1:], gradients[1:]):
        velocity = 0.9 * velocity + gradient
        torch.testing.assert_close(after, before - 1e-3 * velocity)
    run(out=tmp_path / "parts", steps=3, **options)
    assert run(out=tmp_path / "parts", steps=8, resume=True, **options).step == whole.step
    assert same(*(load_file(tmp_path / name / "last.safetensors") for name in ("whole", "parts")))


def test_the_best_weights_are_of_the_last_objective_that_tells_them():
    """A loss in other units, however small, is no better and no worse."""
    small, large = (Evidence(kl_weight=weight, select="loss") for weight in (1e-3, 1e3))
    for first, second in ((small, large), (large, small)):
        result = run(validation=HELD_OUT, stages=[Stage(40, first), Stage(40, second)])
        assert result.best_step >= 40
    result = run(validation=HELD_OUT, stages=[Stage(40, large), Stage(40, large, learning_rate=0.5)])
    assert result.best_step == 40  # the one that came before, where it is the same


def test_stages_follow_one_another_on_one_global_step():
    seen = []

    def spying(name):
        return lambda terms, step: (seen.append((name, step)), Evidence()(terms, step))[1]

    stages = [Stage(3, spying("a")), Stage(2, spying("b"), learning_rate=Ramp(0.0, 1.0, 5))]
    result = run(stages=stages, log_every=1)
    assert seen == [("a", 0), ("a", 1), ("a", 2), ("b", 3), ("b", 4)]
    assert result.series("learning_rate")[1] == pytest.approx([0.02, 0.02, 0.02, 0.6, 0.8])
    with pytest.raises(ValueError, match="steps is 9, but the stages take 5"):
        run(stages=stages, steps=9)
    with pytest.raises(ValueError, match="either objective or stages"):
        run(stages=stages, objective=Evidence())


def test_a_stage_keeps_what_it_freezes_also_across_a_resume(tmp_path):
    stages = [Stage(30, frozen=("generator.z.", "generator.x.law")), Stage(30)]
    start = build().state_dict()

    def moved(state):
        now = state.model.state_dict()
        return {name for name in now if not torch.equal(now[name], start[name])}

    seen = {}
    watch = [At(step, lambda state, step=step: seen.update({step: moved(state)})) for step in (30, 31)]
    run(out=tmp_path / "whole", stages=stages, callbacks=watch)
    assert seen[30] == {name for name in start if not name.startswith(stages[0].frozen)}
    assert seen[31] == set(start)
    with pytest.raises(Interrupted):
        run(out=tmp_path / "parts", stages=stages, callbacks=[At(20, interrupt)])
    run(build(seed=9), out=tmp_path / "parts", stages=stages, resume=True)
    assert same(*(load_file(tmp_path / name / "last.safetensors") for name in ("whole", "parts")))
    with pytest.raises(ValueError, match=r"no parameter's name starts with decoder\.; they are generator\.z"):
        run(stages=[Stage(2, frozen=("decoder.",))])
    with pytest.raises(ValueError, match="a stage of 2 steps has every parameter frozen"):
        run(stages=[Stage(2, frozen=("generator", "encoder"))])


def test_the_program_receives_the_scheduled_probability_of_self_feeding():
    seen = []

    class Spy(DynamicalVAE):
        def model(self, batch=None, **options):
            seen.append(options.get("self_feeding", 0.0))
            return super().model(batch, **options)

    run(build(kind=Spy), validation=HELD_OUT, steps=4, validate_every=4, self_feeding=Ramp(0.0, 0.4, 4))
    assert seen == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.0, 0.3])  # validated without, then as it ends


def test_with_self_feeding_the_best_is_by_the_self_fed_bound_from_its_last_value_on():
    feeding = Piecewise(((0, 0.0), (9, 0.5)))
    result = run(validation=HELD_OUT, steps=20, validate_every=5, self_feeding=feeding)
    steps, bounds = result.series("validation/self_fed/bound")
    assert steps == [5, 10, 15, 20]
    assert result.best_step in (10, 15, 20)
    assert result.best_bound == max(bounds[1:])


def test_a_warm_up_longer_than_the_run_is_clamped_with_a_message():
    with pytest.warns(UserWarning, match="of objective.kl_weight needs 500 steps, and training has 10"):
        run(objective=Evidence(kl_weight=Ramp(0.0, 1.0, 500)), steps=10)


def test_the_gradient_is_clipped_in_norm():
    model = build()
    before = torch.nn.utils.parameters_to_vector(model.parameters()).clone()
    result = run(model, steps=1, log_every=1, optimizer="sgd", learning_rate=1.0, gradient_clip=0.01)
    moved = torch.nn.utils.parameters_to_vector(model.parameters()) - before
    assert result.history[0]["gradient_norm"] > 0.01
    assert moved.norm().item() == pytest.approx(0.01)


def test_ragged_and_masked_data_train():
    x = TRAIN.clone()
    x[0, 1, 2], x[1, 3] = math.nan, math.nan
    mask, lengths = torch.ones_like(x, dtype=torch.bool), torch.full((24,), 4)
    mask[0, 1, 2], lengths[1] = False, 3
    result = run(train={"x": x, "mask": mask, "lengths": lengths}, steps=20)
    assert math.isfinite(result.history[-1]["bound"])
    by_name = run(train={"x": x, "mask": {"x": mask}, "lengths": lengths}, steps=20)
    assert by_name.history == result.history


def test_windows_draw_their_own_batches():
    class Windows:
        def sample(self, batch_size, generator):
            return {"x": TRAIN[torch.randint(24, (batch_size,), generator=generator)].float()}

        def all(self):
            return {"x": HELD_OUT.float()}

    assert run(train=Windows(), validation=Windows(), steps=20).best_step == 20


def test_a_batch_holds_different_sequences_and_all_of_them_if_there_are_few():
    data = Sequences({"x": torch.arange(6.0)[:, None, None], "lengths": torch.arange(6)})
    for size in (1, 4, 6, 9):
        batch = data.sample(size, torch.Generator().manual_seed(0))
        assert len(set(batch["lengths"].tolist())) == min(size, 6)
        assert torch.equal(batch["x"][:, 0, 0], batch["lengths"].float())
    assert torch.equal(torch.cat([batch["x"] for batch in data.batches(4)]), data.batch["x"])


# Resuming --------------------


@pytest.mark.parametrize("how", ["callback", "ctrl-c", "terminate"])
def test_an_interrupted_run_resumes_bit_for_bit(tmp_path, how):
    number = signal.SIGTERM if how == "terminate" else signal.SIGINT
    action = interrupt if how == "callback" else lambda state: signal.raise_signal(number)
    options = {
        "validation": HELD_OUT,
        "objective": Evidence(kl_weight=Ramp(0.0, 1.0, 50)),
        "self_feeding": Ramp(0.0, 0.5, 60),
    }
    whole = run(out=tmp_path / "whole", **options)
    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with pytest.raises(Interrupted, match=r"after step 33; resume with fit.*parts") as stopped:
        run(out=tmp_path / "parts", callbacks=[At(33, action)], **options)
    assert handlers == (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM))
    assert (stopped.value.signal, stopped.value.fit.status) == (number, "interrupted")
    assert Run(tmp_path / "parts").state["status"] == "interrupted"

    resumed = run(build(seed=9), out=tmp_path / "parts", resume=True, **options)
    assert resumed.history == whole.history
    assert (resumed.best_step, resumed.best_bound) == (whole.best_step, whole.best_bound)
    for name in ("last.safetensors", "best.safetensors"):
        assert same(load_file(tmp_path / "whole" / name), load_file(tmp_path / "parts" / name))


def test_half_a_run_and_the_other_half_are_the_whole_run(tmp_path):
    run(out=tmp_path / "whole", steps=100)
    run(out=tmp_path / "halves", steps=50)
    result = run(build(seed=9), out=tmp_path / "halves", steps=100, resume=True)
    assert result.step == 100
    assert same(*(load_file(tmp_path / name / "last.safetensors") for name in ("whole", "halves")))
    again = run(build(seed=9), out=tmp_path / "halves", steps=100, resume=True)
    assert (again.step, again.status, again.history) == (100, "finished", result.history)


def test_a_decay_is_laid_out_over_the_steps_of_the_longer_run(tmp_path):
    options = {"out": tmp_path, "learning_rate": 0.02, "decay": 0.5, "log_every": 1}
    run(steps=10, **options)
    rates = run(build(seed=9), steps=20, resume=True, **options).series("learning_rate")[1]
    assert rates[:11] == pytest.approx([0.02] * 6 + [0.016, 0.012, 0.008, 0.004, 0.02])
    assert rates[10:] == pytest.approx([0.02 - 0.002 * i for i in range(10)])


def test_a_run_interrupted_at_its_last_step_is_finished_when_resumed(tmp_path):
    with pytest.raises(Interrupted):
        run(out=tmp_path, steps=5, callbacks=[At(5, interrupt)])
    assert Run(tmp_path).state["status"] == "interrupted"
    assert run(out=tmp_path, steps=5, resume=True).status == "finished"
    assert Run(tmp_path).state["status"] == "finished"


def test_other_training_data_are_not_resumed_on(tmp_path):
    class Windows(Sequences):
        @property
        def fingerprint(self):
            return f"{self.batch['x'].sum():.6f}"

    run(train=Windows({"x": TRAIN}), out=tmp_path, steps=5)
    with pytest.raises(CheckpointError, match=r"was fitted on other training data: config\.json has the fingerprint"):
        run(train=Windows({"x": TRAIN + 1}), out=tmp_path, steps=10, resume=True)
    assert run(train=Windows({"x": TRAIN}), out=tmp_path, steps=10, resume=True).step == 10


def test_patience_counts_on_across_a_resume(tmp_path):
    options = {"validation": HELD_OUT, "learning_rate": 0.0, "validate_every": 5, "out": tmp_path}
    with pytest.raises(Interrupted):
        run(callbacks=[At(12, interrupt)], patience=3, **options)
    result = run(resume=True, patience=3, **options)
    assert (result.status, result.best_step, result.step) == ("stopped early", 5, 20)


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


def test_the_config_records_what_was_run(tmp_path):
    objective = Evidence(kl_weight=Ramp(0.0, 1.0, 5))
    run(out=tmp_path, steps=10, objective=objective, config={"method": "dkf"})
    run(out=tmp_path, steps=12, objective=objective, resume=True)
    config = Run(tmp_path).config
    assert (config["method"], config["training"]["steps"]) == ("dkf", 12)
    assert config["stages"][0]["objective"] == objective.to_config()


# Stopping at what is not finite --------------------


def test_a_term_that_is_not_finite_stops_the_run_and_leaves_the_last_checkpoint(tmp_path, monkeypatch):
    honest, calls = SequenceELBO.terms, []

    def broken(self, model, batch, **options):
        calls.append(batch)
        result = honest(self, model, batch, **options)
        if len(calls) == 27:
            result.kl["z"] = result.kl["z"] * torch.tensor([1.0, math.nan] * 4)
            result.steps["z"] = result.steps["z"] * torch.tensor([1.0, 1.0, math.nan, math.nan])
        return result

    monkeypatch.setattr(SequenceELBO, "terms", broken)
    model, kept = build(), {}
    with pytest.raises(NonFiniteError, match="step 27: the KL of z is nan in 4 of 8 sequences, frames 2, 3;"):
        run(model, out=tmp_path, callbacks=[At(20, lambda state: kept.update(weights(state.model)))])
    assert Run(tmp_path).state["status"] == "failed"
    assert same(load_file(tmp_path / "last.safetensors"), kept)
    assert all(torch.isfinite(value).all() for value in weights(model).values())
    monkeypatch.setattr(SequenceELBO, "terms", honest)
    assert run(build(seed=9), out=tmp_path, resume=True).step == 60


def test_a_gradient_or_weight_that_is_not_finite_is_named():
    def steep(terms, step):
        return Evidence()(terms, step) + (terms.kl["z"].sum() * 0).sqrt()

    model = build()
    before = weights(model)
    with pytest.raises(NonFiniteError, match=r"step 1: the gradient of \S+ is not finite though the loss is"):
        run(model, objective=steep)
    assert same(weights(model), before)
    with pytest.raises(NonFiniteError, match="step 1: the loss is nan though every term is finite"):
        run(objective=lambda terms, step: Evidence()(terms, step) * math.nan)


def test_weights_that_are_not_finite_are_reported_with_the_step(monkeypatch):
    def poison(state):
        with torch.no_grad():
            next(state.model.parameters()).fill_(math.nan)

    with pytest.raises(NonFiniteError, match="step 4: the KL of z is nan in 8 of 8 sequences, frames 0, 1, 2…"):
        run(callbacks=[At(3, poison)])

    def refused(*arguments, **options):
        return torch.distributions.Normal(torch.tensor(math.nan), 1.0, validate_args=True)

    monkeypatch.setattr(SequenceELBO, "terms", refused)
    with pytest.raises(NonFiniteError, match=r"step 1: Expected parameter loc .* found invalid values"):
        run()


# What is refused --------------------


@pytest.mark.parametrize(
    ("train", "message"),
    [
        (
            TRAIN[0],
            r"x has shape \(4, 3\), expected \(sequences, frames, features\); a single sequence is x\[None\]",
        ),
        ({"x": TRAIN, "w": TRAIN[:3, 0]}, "same number of sequences, at least one; given {'x': 24, 'w': 3}"),
        (TRAIN[:0], "at least one; given {'x': 0}"),
        ({"x": TRAIN[..., None]}, r"x has shape \(24, 4, 3, 1\); a local variable is"),
        (
            TRAIN.index_fill(0, torch.tensor(2), math.nan),
            "x has 12 entries that are NaN or infinite.* sequence 2;",
        ),
    ],
)
def test_malformed_data_are_refused(train, message):
    with pytest.raises(ValueError, match=message):
        run(train=train)


def test_options_that_do_not_exist_or_make_sense_are_refused():
    with pytest.raises(TypeError, match=r"no option 'step' \(did you mean 'steps'\?\)"):
        run(step=5)
    with pytest.raises(TypeError, match="no option 'qqq'; the options are steps, batch_size"):
        run(qqq=5)
    with pytest.raises(TypeError, match=r"expected x as a tensor .* got str"):
        run(train="data.npz")
    with pytest.raises(ValueError, match="patience counts validations"):
        run(patience=3)
    for wrong in (
        *({"steps": 0}, {"patience": 0}, {"gradient_clip": 0.0}, {"gradient_clip": math.nan}, {"optimizer": "lion"}),
        *({"learning_rate": rate} for rate in (-1, math.nan, math.inf)),
        *({"weight_decay": -1.0}, {"decay": 1.5}, {"self_feeding": 2}, {"self_feeding": -0.1}),
        {"decay": 0.5, "learning_rate": Ramp(1e-3, 0.0, 10)},
        *({"momentum": 0.9}, {"optimizer": "sgd", "momentum": 1.0}),
    ):
        with pytest.raises(ValueError, match=r"must be|unknown optimizer|leave (decay|momentum) 0"):
            Training(**wrong)
    for wrong in ({"steps": 2.5}, {"seed": "one"}, {"learning_rate": "fast"}):
        with pytest.raises(TypeError, match=r"must be a whole number|must be a number"):
            Training(**wrong)


def test_a_model_without_parameters_is_refused():
    with pytest.raises(ValueError, match="no parameters that require gradients"):
        run(build().requires_grad_(False))


def test_what_is_no_model_or_cannot_be_trained_is_refused():
    for wrong, said in ((DynamicalVAE, "the class DynamicalVAE"), (Dense(), "a Dense")):
        with pytest.raises(TypeError, match=f"the model is {said}; expected a module"):
            run(wrong)
    with pytest.raises(TypeError, match=r"the objective is the class Evidence; .* such as dvae.Evidence\(\)"):
        run(objective=Evidence)
    with torch.inference_mode():
        model = torch.nn.Linear(2, 3)
    with pytest.raises(ValueError, match=r"weight was made in `torch.inference_mode\(\)` and cannot be fitted"):
        run(model)


# Checkpoints --------------------


@pytest.fixture
def finished(tmp_path):
    run(out=tmp_path, steps=5, validation=HELD_OUT)
    return tmp_path


def test_a_run_is_neither_overwritten_nor_resumed_by_accident(finished):
    with pytest.raises(CheckpointError, match="already holds a run; continue it with resume=True"):
        run(out=finished)
    state = json.loads((finished / "state.json").read_text())
    (finished / "state.json").write_text(json.dumps({**state, "status": "failed"}))
    with pytest.raises(CheckpointError, match="resume=True and a lower learning_rate, as it failed, or"):
        run(out=finished)
    (finished / "state.json").write_text(json.dumps(state))
    with pytest.raises(CheckpointError, match=r"no run to resume in .*elsewhere"):
        run(out=finished / "elsewhere", resume=True)
    with pytest.raises(CheckpointError, match="fitted with optimizer='adam', not 'sgd'"):
        run(out=finished, resume=True, optimizer="sgd")


@pytest.mark.parametrize("name", ["best.safetensors", "last.safetensors", "last.state.safetensors"])
@pytest.mark.parametrize("damage", ["flipped", "truncated", "missing"])
def test_damaged_files_are_refused_by_name(finished, name, damage):
    path = finished / name
    content = bytearray(path.read_bytes())
    content[-5] ^= 1
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(content if damage == "flipped" else content[:-40])
    expected = "is missing; copy the run directory whole" if damage == "missing" else "is damaged or from another run"
    with pytest.raises(CheckpointError, match=f"{name} {expected}"):
        run(out=finished, steps=10, resume=True)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({}, "its fingerprints are no object of texts"),
        ([], "it holds no JSON object but list"),
        (None, "it holds no JSON object but NoneType"),
        ({"fingerprints": 3}, "its fingerprints are no object of texts"),
        ({"fingerprints": {"last.safetensors": None}}, "its fingerprints are no object of texts"),
        ({"fingerprints": {}}, "it has no fingerprint of last.safetensors"),
    ],
)
def test_a_state_that_verifies_nothing_is_refused(finished, state, message):
    (finished / "state.json").write_text(json.dumps(state))
    for path in (finished, finished / "best.safetensors"):
        with pytest.raises(CheckpointError, match=rf"state\.json is damaged[,:] {message}"):
            load_weights(build(), path)
    with pytest.raises(CheckpointError, match=r"state\.json is damaged"):
        run(out=finished, steps=10, resume=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"step": "five"}, "step missing or not a whole number from 0"),
        ({"status": None, "waited": 1.5}, "waited missing or not a whole .*, status missing or not one of"),
        ({"best_bound": "high"}, "best_bound missing"),
        ({"processor_seconds": -1.0}, "processor_seconds missing or not a number from 0"),
    ],
)
def test_a_state_of_wrong_types_is_refused(finished, change, message):
    state = json.loads((finished / "state.json").read_text()) | change
    (finished / "state.json").write_text(json.dumps(state))
    with pytest.raises(CheckpointError, match=f"state.json is damaged: {message}"):
        run(out=finished, steps=10, resume=True)


def test_a_run_knows_how_long_it_took_over_all_its_parts(finished):
    before = json.loads((finished / "state.json").read_text())
    assert before["processor_seconds"] > 0
    took = run(out=finished, steps=before["step"] + 5, resume=True).processor_seconds
    assert took > before["processor_seconds"]
    assert json.loads((finished / "state.json").read_text())["processor_seconds"] == took
    del before["processor_seconds"]  # as earlier versions left it
    (finished / "state.json").write_text(json.dumps(before | {"fingerprints": Run(finished).state["fingerprints"]}))
    assert "processor_seconds" not in Run(finished).state


def test_a_best_checkpoint_without_its_fingerprint_is_refused(finished):
    state = json.loads((finished / "state.json").read_text())
    del state["fingerprints"]["best.safetensors"]
    (finished / "state.json").write_text(json.dumps(state))
    with pytest.raises(CheckpointError, match=r"it has no fingerprint of best\.safetensors"):
        load_weights(build(), finished)
    (finished / "state.json").write_text(json.dumps(state | {"best_step": None}))
    with pytest.raises(CheckpointError, match=r"lists no best\.safetensors"):
        load_weights(build(), finished / "best.safetensors")


def test_the_weights_of_another_model_are_refused(finished, tmp_path):
    with pytest.raises(CheckpointError, match=r"holds the weights of another model: \S+ is \(.*\), the model's is"):
        load_weights(build(latent=3), finished)
    with pytest.raises(CheckpointError, match=r"another model: it has .*, which the model lacks"):
        load_weights(torch.nn.Linear(2, 2), finished)
    with pytest.raises(CheckpointError, match=r"is no run directory: it has no state.json"):
        load_weights(build(), tmp_path / "..")
    with pytest.raises(CheckpointError, match="does not exist; give a run directory or a safetensors file"):
        load_weights(build(), tmp_path / "nowhere")
    (tmp_path / "text.safetensors").write_text("weights")
    with pytest.raises(CheckpointError, match="damaged or no safetensors file"):
        load_weights(build(), tmp_path / "text.safetensors")
    (finished / "state.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"state.json is damaged, it is not JSON"):
        load_weights(build(), finished)


def test_weights_in_a_file_of_their_own_come_back(tmp_path):
    first, second = build(0), build(1)
    save_weights(first, tmp_path / "new" / "weights.safetensors")
    load_weights(second, tmp_path / "new" / "weights.safetensors")
    assert same(weights(first), weights(second))


def test_an_optimiser_state_is_never_unpickled(finished):
    class Hostile:
        def __reduce__(self):
            return (exec, ("raise SystemExit('executed')",))

    buffer = io.BytesIO()
    torch.save(Hostile(), buffer)
    for content in (pickle.dumps(Hostile()), buffer.getvalue()):
        Run(finished).commit(Run(finished).state, {"last.state.safetensors": content})
        with pytest.raises(CheckpointError, match=r"last.state.safetensors is damaged or no safetensors file"):
            run(out=finished, steps=10, resume=True)


STATE = {"step": 0, "best_step": None, "best_bound": None, "waited": 0, "status": "running", "optimizer": "adam"}


@given(st.integers(0, 8))
def test_a_process_killed_at_any_moment_leaves_a_whole_checkpoint(tmp_path_factory, moment):
    path = tmp_path_factory.mktemp("run")
    files = {name: name.encode() * 3 for name in ("last.safetensors", "last.state.safetensors")}
    Run(path).commit(STATE | {"step": 1}, {name: b"1" + content for name, content in files.items()})
    left = [moment]

    class Killed(BaseException):
        pass

    def mortal(function):
        def call(*arguments):
            left[0] -= 1
            if left[0] < 0:
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


def test_json_lines_survive_a_line_that_was_cut_off(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_text('{"step": 1, "loss": 2.0}\n{"step": 2, "loss": 1.0}\n{"step": 3, "lo')
    log = JSONLines(path)
    log.start(2)
    log.log(3, {"loss": 0.5})
    log.close()
    assert [row["loss"] for row in log.read()] == [2.0, 1.0, 0.5]


def test_away_from_a_terminal_there_are_few_lines_and_on_one_a_bar():
    for terminal, lines in ((False, 10), (True, None)):
        screen = io.StringIO()
        display = Terminal(1000, Console(file=screen, force_terminal=terminal, width=160))
        display.start(0)
        for step in range(1, 1001):
            display.log(step, {"bound": -1.0, "kl/z": 0.25})
        display.log(1000, {"validation/bound": -2.0, "validation/self_fed/bound": -3.0})
        display.close()
        bounds = "bound -1.000  validation bound -2.000  validation bound with scheduled sampling -3.000"
        assert f"kl z 0.250  {bounds}" in screen.getvalue()
        assert "1000/1000" in screen.getvalue()
        assert lines in (None, len(screen.getvalue().splitlines()))


def test_learning_curves_are_drawn():
    figure = run(validation=HELD_OUT, steps=20).plot()
    bound, divergence = figure.axes
    assert bound.get_ylabel() == "bound (nats per frame)"
    assert [line.get_label() for line in divergence.lines] == ["z"]
    matplotlib.pyplot.close(figure)


# Several processes --------------------

SCRIPT = """
import hashlib
import sys
import torch
from dvae.inference.training.fit import fit
from dvae.program.model import DynamicalVAE
from dvae.networks import Dense

def run(name, steps, resume=False):
    torch.manual_seed(0)
    equations = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)"
    model = DynamicalVAE(*equations, {"z": 2, "x": 3}, network=Dense(widths=(8,)))
    x = torch.randn(24, 4, 3).cumsum(1)
    options = {"devices": 2, "accelerator": "cpu", "batch_size": 8, "validate_every": 2, "progress": False}
    fit(model, x, x[:8], steps=steps, out=f"{sys.argv[1]}/{name}", resume=resume, **options)
    return torch.nn.utils.parameters_to_vector(model.parameters())

whole = run("whole", 4)
run("halves", 2)
halves = run("halves", 4, resume=True)
digest = hashlib.sha256(whole.numpy(force=True)).hexdigest()
sys.stdout.write(f"weights {torch.equal(whole, halves)} {digest}\\n")  # in one piece, as both write at once
"""


@pytest.mark.skipif(not torch.distributed.is_available(), reason="this torch is built without torch.distributed")
@pytest.mark.slow
def test_two_processes_agree_draw_differently_and_resume_bit_for_bit(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3]), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(script), str(tmp_path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    first, second = [line for line in done.stdout.splitlines() if line.startswith("weights")]
    assert first.startswith("weights True")
    assert first == second
    drawn = Run(tmp_path / "whole").optimiser_state()["random/generator"]
    assert not torch.equal(drawn[0], drawn[1])


def test_a_run_is_fitted_by_one_process_at_a_time(tmp_path):
    with Run(tmp_path).locked(), pytest.raises(CheckpointError, match="is being fitted by another process"):
        run(out=tmp_path)
    assert run(out=tmp_path).status == "finished"
