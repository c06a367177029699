"""The loop by hand: steps of one's own are those of `fit`, bit for bit, and leave the caller's random state alone."""

import pytest
import torch

import dvae
from dvae.data.sequences import Sequences
from dvae.inference.training.checkpoints import Run, weights
from dvae.inference.training.objectives import Evidence
from dvae.inference.training.options import Stage
from dvae.inference.training.resuming import restore, store
from dvae.inference.training.schedules import Piecewise, Ramp
from dvae.networks import Dense

STEPS = 24


def build(seed=0):
    torch.manual_seed(seed)
    equations = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_t)"
    return dvae.DynamicalVAE(*equations, {"z": 2, "x": 3}, network=Dense(widths=(8,))).double()


def walks(n, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(n, 4, 3, generator=generator, dtype=torch.float64).cumsum(1)


TRAIN, HELD_OUT = walks(24), walks(7, seed=1)
SHARED = {"batch_size": 8, "log_every": 1, "validate_every": 6, "learning_rate": 0.02, "progress": False}
WARM_UP = Evidence(kl_weight=Ramp(0.0, 1.0, 10), free_bits=0.1)
RUNS = {
    "clipped": {"steps": STEPS, "objective": WARM_UP, "gradient_clip": 0.5, "decay": 0.5, "particles": 2},
    "staged": {
        "stages": [
            Stage(10, WARM_UP, frozen=("generator.z.",)),
            Stage(14, learning_rate=0.01, self_feeding=Piecewise(((10, 0.0), (21, 0.5)))),
        ],
        "optimizer": "adamw",
        "weight_decay": 0.01,
    },
}


def by_hand(loop, until=STEPS):
    """Steps up to one, with validations; the rows of the log. What else the caller does changes nothing."""
    source, rows = Sequences({"x": TRAIN}), []
    while loop.state.step < until:
        loop.step(source.sample(8, loop.generator))
        rows.append({"step": loop.state.step, **loop.row()})
        torch.rand(3)
        loop.model.eval()
        if loop.state.step % 6 == 0:
            loop.evaluate(TRAIN)
            rows.append({"step": loop.state.step, **loop.validate(HELD_OUT)})
    return rows


def same(first, second):
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("options", RUNS.values(), ids=RUNS)
def test_steps_by_hand_repeat_a_fit_bit_for_bit(options):
    fitted, mine = build(), build()
    result = dvae.fit(fitted, TRAIN, HELD_OUT, **SHARED, **options)
    loop = dvae.SVI(mine, **SHARED, **options)
    loop.init()
    assert by_hand(loop) == result.history
    assert (loop.state.best_step, loop.state.best_bound) == (result.best_step, result.best_bound)
    assert same(loop.state.best, weights(fitted))


@pytest.mark.parametrize("options", RUNS.values(), ids=RUNS)
def test_a_run_goes_on_by_hand_from_its_checkpoint(tmp_path, options):
    whole = dvae.SVI(build(), **SHARED, **options)
    whole.init()
    rows = by_hand(whole)
    first = dvae.SVI(build(), **SHARED, **options)
    first.init()
    before = by_hand(first, until=15)
    store(first, Run(tmp_path))
    second = dvae.SVI(build(seed=9), **SHARED, **options)
    second.init()
    restore(second, Run(tmp_path))
    assert before + by_hand(second) == rows
    assert same(weights(second.model), weights(whole.model))
    assert same(second.state.best, whole.state.best)


def test_the_callers_random_state_is_left_alone():
    loop, before = dvae.SVI(build(), steps=STEPS), torch.get_rng_state()
    loop.init()
    loop.step(TRAIN)
    loop.evaluate(HELD_OUT)
    assert torch.equal(torch.get_rng_state(), before)


def test_what_comes_too_early_is_refused_in_a_sentence():
    loop = dvae.SVI(build())
    for early in (lambda: loop.step(TRAIN), lambda: loop.evaluate(HELD_OUT), lambda: loop.state):
        with pytest.raises(RuntimeError, match="begun"):
            early()
    loop.init()
    with pytest.raises(RuntimeError, match="taken since"):
        loop.row()
