"""Reconstruction of segments: errors and principal components have known values."""

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
    POSTERIOR,
    PrincipalComponents,
    Reconstruction,
    reconstruct_segments,
)


@pytest.fixture(scope="module")
def segments():
    data = SegmentData("simulated", motion.simulate(clips=10, frames=60, seed=1, test=0.4), "clips")
    return data.windows("train"), data.windows("test")


@pytest.fixture
def model(segments):
    torch.manual_seed(0)
    return dvae.method("motion-latent", latent=3, widths=(8,)).build(segments[0])


def test_a_moved_body_has_that_error_and_a_slow_one_its_time_error(segments, model, monkeypatch):
    _, test = segments
    timed = test.timed
    x = test.all()["x"].clone()
    x[..., timed.parts["translation"]] += torch.tensor([0.003, 0.0, 0.004]) / timed.metres
    x[..., timed.parts["time"]] *= 1.1
    monkeypatch.setattr(model, "encode", lambda batch: torch.arange(len(batch["x"])))
    monkeypatch.setattr(model, "decode", lambda latent, shape: x[latent])
    result = reconstruct_segments({"moved": model}, test, batch_size=len(test), progress=False)
    np.testing.assert_allclose(result.rows["moved"][ERROR], 5.0, rtol=1e-3)
    np.testing.assert_allclose(result.rows["moved"][DURATION], 100 * timed.lasts(test.all()["x"]), rtol=1e-4)
    assert list(result.rows) == ["moved"]  # no data for principal components


def test_more_components_have_smaller_errors_and_enough_have_none(segments):
    train, _ = segments
    batch = train.all()

    def error(components):
        components_model = PrincipalComponents.of(train, components)(batch)
        return float((components_model - batch["x"]).norm())

    errors = [error(components) for components in range(1, len(train))]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-3 * errors[0]  # as many components as directions between the segments
    two_components = PrincipalComponents.of(train, 2)
    features = torch.cat([batch["x"].flatten(1), batch[SHAPE]], -1)
    _, _, exact = torch.linalg.svd(features - features.mean(0), full_matrices=False)
    torch.testing.assert_close(
        two_components.directions @ two_components.directions.T @ exact[:2].T, exact[:2].T, rtol=0, atol=1e-3
    )


def test_models_are_compared_with_components_of_their_size(segments, model):
    train, test = segments
    other = Segments(train.motion, motion.TimedFrames.of(train.motion, frames=20))
    torch.manual_seed(0)
    coarse = dvae.method("motion-latent", latent=3, widths=(8,)).build(other)
    models = {"a": model, "b": model, "coarse": coarse}
    result = reconstruct_segments(models, test, train, bound_particles=2, progress=False)
    assert list(result.rows) == ["a", "PCA of 11", "b", "coarse", "PCA of 11, frames of coarse"]
    for name in ("a", "coarse"):
        assert {*result.rows[name]} == {ERROR, DURATION, "ELBO", "IWAE bound", "k-hat", *POSTERIOR}
    for name, values in result.rows["a"].items():
        np.testing.assert_array_equal(values, result.rows["b"][name])  # every model draws from the same seed
    assert result.difference("a", "b").mean == 0
    assert result.difference("PCA of 11", "a").mean < 0  # an untrained model


def test_a_reconstruction_is_printed_drawn_and_stored(segments, model, tmp_path):
    train, test = segments
    result = reconstruct_segments({"m": model}, test, train, progress=False)
    result.save(tmp_path / "found.json")
    again = Reconstruction.load(tmp_path / "found.json")
    assert str(again) == str(result)
    assert f"{len(test)} segments of {len(test)} takes" in str(result)
    axes = result.plot().axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["m", "PCA of 11"]
    with pytest.raises(KeyError, match="no row 'n'"):
        result["n"]
    with pytest.raises(ValueError, match="at least one model"):
        reconstruct_segments({}, test)
    with torch.no_grad():
        next(iter(model.parameters())).fill_(torch.nan)
    with pytest.raises(FloatingPointError, match=r"segment test/\S+ is not finite"):
        reconstruct_segments({"m": model}, test, progress=False)
