"""`dvae.SVI`: steps by hand repeat `fit` bit for bit and keep the caller's random state."""

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
            Stage(14, learning_rate=0.01, scheduled_sampling=Piecewise(((10, 0.0), (21, 0.5))), batch_size=3),
        ],
        "optimizer": "adamw",
        "weight_decay": 0.01,
    },
}


def by_hand(loop, until=STEPS):
    """Take steps up to `until`, with validations, while the caller draws random numbers; return the rows of the log."""
    source, rows = Sequences({"x": TRAIN}), []
    while loop.state.step < until:
        loop.step(source.sample(loop.batch_size, loop.generator))
        rows.append({"step": loop.state.step, **loop.row()})
        torch.rand(3)
        loop.model.eval()
        if loop.state.step % 6 == 0:
            loop.evaluate(TRAIN)
            rows.append({"step": loop.state.step, **loop.validate(HELD_OUT)})
    return rows


@pytest.mark.parametrize("options", RUNS.values(), ids=RUNS)
def test_steps_by_hand_repeat_a_fit_and_resume_bit_for_bit(tmp_path, options):
    fit_model = build()
    result = dvae.fit(fit_model, TRAIN, HELD_OUT, **SHARED, **options)
    uninterrupted, resumed = (dvae.SVI(build(seed), **SHARED, **options) for seed in (0, 9))
    for loop in (uninterrupted, resumed):
        loop.init()
    before = by_hand(uninterrupted, until=15)
    store(uninterrupted, Run(tmp_path))
    restore(resumed, Run(tmp_path))
    for loop in (uninterrupted, resumed):
        assert before + by_hand(loop) == result.history
        assert (loop.state.best_step, loop.state.best_bound) == (result.best_step, result.best_bound)
        assert same(loop.state.best, weights(fit_model))
    assert same(weights(resumed.model), weights(uninterrupted.model))


def test_a_stage_has_its_own_batch_size():
    sizes = []

    class Counted(Sequences):
        def sample(self, batch_size, generator):
            sizes.append(batch_size)
            return super().sample(batch_size, generator)

    stages = [Stage(2), Stage(3, batch_size=5), Stage(1)]
    dvae.fit(build(), Counted({"x": TRAIN}), stages=stages, **SHARED)
    assert sizes == [8, 8, 5, 5, 5, 8]
    with pytest.raises(ValueError, match="batch_size of a stage must be at least 1, got 0"):
        Stage(1, batch_size=0)


def test_the_random_state_of_the_caller_is_unchanged():
    loop, before = dvae.SVI(build(), steps=STEPS), torch.get_rng_state()
    loop.init()
    loop.step(TRAIN)
    loop.evaluate(HELD_OUT)
    assert torch.equal(torch.get_rng_state(), before)


def test_steps_before_initialization_are_errors():
    loop = dvae.SVI(build())
    for early in (lambda: loop.step(TRAIN), lambda: loop.evaluate(HELD_OUT), lambda: loop.state):
        with pytest.raises(RuntimeError, match="begun"):
            early()
    loop.init()
    with pytest.raises(RuntimeError, match="taken since"):
        loop.row()


def test_the_best_weights_of_earlier_validations_are_stored(tmp_path):
    loop, run = dvae.SVI(build(), **SHARED), Run(tmp_path)
    loop.init()
    loop.step(TRAIN)
    loop.validate(HELD_OUT)
    store(loop, run)
    for _ in range(4):
        loop.step(TRAIN)
    loop.validate(HELD_OUT)
    assert loop.state.best_step == 5
    with torch.no_grad():
        for parameter in loop.parameters:
            parameter += 1.0
    loop.step(TRAIN)
    loop.validate(HELD_OUT)
    store(loop, run)
    again = dvae.SVI(build(9), **SHARED)
    again.init()
    restore(again, run)
    assert again.state.best_step == 5
    assert same(again.state.best, loop.state.best)
