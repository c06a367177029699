"""The loop by hand: steps of one's own are those of `fit`, bit for bit, and leave the caller's random state alone."""

import pytest
import torch
from walks import HELD_OUT, TRAIN, build, same

import dvae
from dvae.data.sequences import Sequences
from dvae.inference.training.checkpoints import Run, weights
from dvae.inference.training.objectives import Evidence
from dvae.inference.training.options import Stage
from dvae.inference.training.resuming import restore, store
from dvae.inference.training.schedules import Piecewise, Ramp

STEPS = 24


SHARED = {"batch_size": 8, "log_every": 1, "validate_every": 6, "learning_rate": 0.02, "progress": False}
WARM_UP = Evidence(kl_weight=Ramp(0.0, 1.0, 10), free_bits=0.1)
RUNS = {
    "clipped": {"steps": STEPS, "objective": WARM_UP, "gradient_clip": 0.5, "decay": 0.5, "particles": 2},
    "staged": {
        "stages": [
            Stage(10, WARM_UP, frozen=("generator.z.",)),
            Stage(14, learning_rate=0.01, scheduled_sampling=Piecewise(((10, 0.0), (21, 0.5)))),
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


@pytest.mark.parametrize("options", RUNS.values(), ids=RUNS)
def test_steps_by_hand_repeat_a_fit_and_go_on_from_a_checkpoint_bit_for_bit(tmp_path, options):
    fitted = build()
    result = dvae.fit(fitted, TRAIN, HELD_OUT, **SHARED, **options)
    whole, resumed = (dvae.SVI(build(seed), **SHARED, **options) for seed in (0, 9))
    for loop in (whole, resumed):
        loop.init()
    before = by_hand(whole, until=15)
    store(whole, Run(tmp_path))
    restore(resumed, Run(tmp_path))
    for loop in (whole, resumed):
        assert before + by_hand(loop) == result.history
        assert (loop.state.best_step, loop.state.best_bound) == (result.best_step, result.best_bound)
        assert same(loop.state.best, weights(fitted))
    assert same(weights(resumed.model), weights(whole.model))


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
