"""The latent space of 4D motion: its two guides, its energy of surfaces and its two phases."""

import pytest
import torch

import dvae
from dvae import motion
from dvae.inference.training.gradnorm import GradNorm
from dvae.models.motion.motion_latent import PARTS, SURFACE, MotionLatent
from dvae.motion import bodies
from dvae.motion.segments.embodied import SHAPE, Segments

SMALL = MotionLatent(latent=4, widths=(32, 16))


@pytest.fixture(scope="module")
def people():
    return bodies.fit_to_body(motion.simulate(clips=4, frames=90, seed=1), bodies.human())


@pytest.fixture(scope="module")
def segments(people):
    return Segments(motion.gait_cycles(people))


def build(segments, method=SMALL):
    torch.manual_seed(0)
    return method.build(segments).eval()


def test_only_the_guide_with_shape_is_exact(segments):
    for shaped in (False, True):
        model = build(segments, MotionLatent(latent=4, widths=(32, 16), shaped=shaped))
        audit = dvae.audit(model.generative, model.inference, observed=model.observed)
        assert audit.exact == shaped
        batch = segments.all()
        torch.manual_seed(1)
        first = model.guide(batch)["z"]
        torch.manual_seed(1)
        other = model.guide({**batch, SHAPE: batch[SHAPE] + 1})["z"]
        assert torch.equal(first, other) != shaped


def test_the_energy_is_the_mean_squared_distance_of_vertices(segments):
    model, batch = build(segments), segments.all()
    torch.manual_seed(0)
    terms = dvae.SequenceELBO().terms(model, batch, draws={"z": 1})
    torch.manual_seed(0)
    means = model.reconstruct(batch)["x"][0]
    differences = model.vertices(means, batch[SHAPE]) - model.vertices(batch["x"], batch[SHAPE])
    expected = differences.square().sum(-1).mean(-1).sum(-1) / (2 * 0.05**2)
    torch.testing.assert_close(terms.energies[SURFACE], expected, rtol=1e-4, atol=1e-4)
    assert not dvae.SequenceELBO().terms(model, batch).energies  # computed only on request


def test_training_has_two_phases_of_adaptive_weights(segments, tmp_path):
    recipe = SMALL.train(segments, segments, 30)
    first, second = recipe.stages
    assert (first.steps, second.steps) == (18, 12)
    assert isinstance(first.objective, GradNorm)
    assert (first.objective.tasks, second.objective.tasks) == (PARTS, (SURFACE, "time"))
    model = build(segments)
    result = dvae.fit(model, recipe, out=tmp_path, batch_size=8, validate_every=6, log_every=1, progress=False)
    assert result.best_step >= 18
    for row in result.history:
        weights = [value for name, value in row.items() if name.startswith("weight/")]
        assert not weights or sum(weights) == pytest.approx(len(weights))
    last = max((row for row in result.history if "weight/surface" in row), key=lambda row: row["step"])
    assert last["weight/surface"] != 1
