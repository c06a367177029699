"""How near segments come back: errors are what they say, and principal components what they are."""

import numpy as np
import pytest
import torch

import dvae
from dvae import motion
from dvae.motion.segments.dataset import SegmentData
from dvae.motion.segments.embodied import SHAPE, Segments
from dvae.motion.segments.reconstruction import (
    DURATION,
    ERROR,
    PrincipalComponents,
    Reconstruction,
    reconstruct_segments,
)


@pytest.fixture(scope="module")
def held():
    data = SegmentData("simulated", motion.simulate(clips=10, frames=60, seed=1, test=0.4), "clips")
    return data.windows("train"), data.windows("test")


@pytest.fixture
def model(held):
    torch.manual_seed(0)
    return dvae.method("motion-latent", latent=3, widths=(8,)).build(held[0])


def test_a_body_that_is_moved_is_off_by_as_much_and_one_that_is_slow_by_its_time(held, model, monkeypatch):
    _, test = held
    timed = test.timed
    x = test.all()["x"].clone()
    x[..., timed.parts["translation"]] += torch.tensor([0.003, 0.0, 0.004]) / timed.metres
    x[..., timed.parts["time"]] *= 1.1
    monkeypatch.setattr(model, "encode", lambda batch: torch.arange(len(batch["x"])))
    monkeypatch.setattr(model, "decode", lambda latent, shape: x[latent])
    found = reconstruct_segments({"moved": model}, test, batch_size=len(test), progress=False)
    np.testing.assert_allclose(found.rows["moved"][ERROR], 5.0, rtol=1e-3)
    np.testing.assert_allclose(found.rows["moved"][DURATION], 100 * timed.lasts(test.all()["x"]), rtol=1e-4)
    assert list(found.rows) == ["moved"]  # nothing was given to take components of


def test_components_come_nearer_with_their_number_and_have_what_they_were_taken_of(held):
    train, _ = held
    batch = train.all()

    def off(components):
        made = PrincipalComponents.of(train, components)(batch)
        return float((made - batch["x"]).norm())

    errors = [off(components) for components in range(1, len(train))]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-3 * errors[0]  # as many directions as there are between them
    known = PrincipalComponents.of(train, 2)
    joined = torch.cat([batch["x"].flatten(1), batch[SHAPE]], -1)
    _, _, exact = torch.linalg.svd(joined - joined.mean(0), full_matrices=False)
    torch.testing.assert_close(known.directions @ known.directions.T @ exact[:2].T, exact[:2].T, rtol=0, atol=1e-3)


def test_models_are_beside_components_of_their_size_and_frames(held, model):
    train, test = held
    other = Segments(train.motion, motion.TimedFrames.of(train.motion, frames=20))
    torch.manual_seed(0)
    coarse = dvae.method("motion-latent", latent=3, widths=(8,)).build(other)
    models = {"a": model, "b": model, "coarse": coarse}
    found = reconstruct_segments(models, test, train, bound_particles=2, progress=False)
    assert list(found.rows) == ["a", "PCA of 11", "b", "coarse", "PCA of 11, frames of coarse"]
    for name in ("a", "coarse"):
        assert {*found.rows[name]} == {ERROR, DURATION, "ELBO", "IWAE bound", "k-hat"}
    for name, values in found.rows["a"].items():
        np.testing.assert_array_equal(values, found.rows["b"][name])  # every model draws from the same seed
    assert found.difference("a", "b").mean == 0
    assert found.difference("PCA of 11", "a").mean < 0  # which has not been trained


def test_a_reconstruction_is_a_table_boxes_and_a_file(held, model, tmp_path):
    train, test = held
    found = reconstruct_segments({"m": model}, test, train, progress=False)
    found.save(tmp_path / "found.json")
    again = Reconstruction.load(tmp_path / "found.json")
    assert str(again) == str(found)
    assert f"{len(test)} segments of {len(test)} takes" in str(found)
    axes = found.plot().axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["m", "PCA of 11"]
    with pytest.raises(KeyError, match="no row 'n'"):
        found["n"]
    with pytest.raises(ValueError, match="at least one model"):
        reconstruct_segments({}, test)
    with torch.no_grad():
        next(iter(model.parameters())).fill_(torch.nan)
    with pytest.raises(FloatingPointError, match=r"segment test/\S+ is not finite"):
        reconstruct_segments({"m": model}, test, progress=False)
