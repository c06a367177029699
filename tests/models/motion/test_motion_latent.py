"""The latent space of 4D motion: its two guides, its energy of surfaces and its two phases."""

from dataclasses import replace

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


def test_published_training_is_of_squared_errors_in_the_phases_of_the_paper(segments):
    """5,000 epochs in batches of 256 at 1e-3, then 200 in batches of 16 at 1e-4, for 13,121 segments."""
    method = replace(SMALL, published=True)
    training = method.training(segments)
    assert (training.steps, training.batch_size, training.learning_rate) == (5000 * 52 + 200 * 821, 256, 1e-3)
    first, second = method.train(segments, steps=training.steps).stages
    assert (first.steps, first.batch_size, first.learning_rate) == (5000 * 52, None, None)
    assert (second.steps, second.batch_size, second.learning_rate) == (200 * 821, 16, 1e-4)
    assert {stage.objective.asymmetry for stage in (first, second)} == {0.12}
    model, batch = build(segments, method).double(), {n: v.double() for n, v in segments.all().items()}
    torch.manual_seed(0)
    terms = dvae.SequenceELBO().terms(model, batch, draws={"z": 1})
    torch.manual_seed(0)
    x = model.reconstruct(batch)["x"][0]
    frames, places = len(batch["x"]) * 100, model.timed.parts
    squares = {name: (x - batch["x"])[..., columns].square().sum() / frames for name, columns in places.items()}
    distances = (model.vertices(x, batch[SHAPE]) - model.vertices(batch["x"], batch[SHAPE])).square().sum(-1).mean(-1)
    squares[SURFACE] = 6890 * distances.sum() / frames
    for stage in (first, second):
        for task, loss in zip(stage.objective.tasks, stage.objective.losses(terms), strict=True):
            torch.testing.assert_close(loss, squares[task], rtol=1e-5, atol=1e-7)
    loss = sum(squares[task] for task in second.objective.tasks) + 0.01 * terms.kl["z"].sum() / frames
    torch.testing.assert_close(second.objective(terms, 0), loss, rtol=1e-5, atol=1e-7)
    assert replace(method, finish=0.0).train(segments, steps=10).stages[-1].steps == 10  # given options are kept


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
