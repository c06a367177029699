"""Interpolation of segments: ends, straight lines in latent space, measures, other bodies, and the map."""

import numpy as np
import pytest
import torch

import dvae
from dvae import motion
from dvae.motion import Interpolation, falls, interpolate, latent_map, transfer
from dvae.motion.geometry.rotations import from_matrix, to_matrix
from dvae.motion.segments.dataset import SegmentData
from dvae.motion.segments.embodied import SHAPE


@pytest.fixture(scope="module")
def segments():
    return SegmentData("simulated", motion.simulate(clips=8, frames=50, seed=1, test=0.5), "clips").windows("test")


@pytest.fixture(scope="module")
def model(segments):
    torch.manual_seed(0)
    return dvae.method("motion-latent", latent=3, widths=(16,)).build(segments).eval()


def batch_of(segments, indices):
    return {name: value[indices] for name, value in segments.all().items()}


def test_ends_are_reconstructions_and_steps_lie_on_a_line(segments, model):
    first, second = batch_of(segments, [0, 1]), batch_of(segments, [2, 3])
    result, back = interpolate(model, first, second, 5), interpolate(model, second, first, 5)
    for step, batch in ((0, first), (-1, second)):
        torch.testing.assert_close(result.x[:, step], transfer(model, batch, batch[SHAPE]))
        torch.testing.assert_close(result.shape[:, step], batch[SHAPE])
    for value in (result.latent, result.shape):
        torch.testing.assert_close(value.diff(n=2, dim=1), torch.zeros_like(value[:, 2:]), rtol=0, atol=1e-5)
    torch.testing.assert_close(result.x, back.x.flip(1), rtol=1e-4, atol=1e-5)
    assert falls(torch.tensor([[3.0, 2, 1], [3, 3, 1], [1, 2, 3]])).tolist() == [True, False, False]
    assert result.vertices(1).shape == (5, 100, 1486, 3)


def test_each_measure_changes_with_its_own_quantity_only(segments, model):
    """Change in turn the duration, the distance, the heading and one joint."""
    timed, x = segments.timed, segments.all()["x"][:1]
    slow, far, rotated, bent = (x.clone() for _ in range(4))
    slow[..., timed.parts["time"]] *= 1.5
    far[..., timed.parts["translation"]] *= 2
    turn = to_matrix(torch.tensor([0.0, 0.5, 0.0]), "vector")
    for segment, joint in ((rotated, timed.skeleton.root), (bent, timed.turning[-1])):
        places = slice(6 * timed.turning.index(joint), 6 * timed.turning.index(joint) + 6)
        unturned = torch.tensor([1.0, 0, 0, 0, 1, 0])
        matrices = to_matrix((x[..., places] + unturned), "6d")
        segment[..., places] = from_matrix(turn @ matrices, "6d") - unturned
    steps = torch.stack([x, slow, far, rotated, bent], 1)
    result = Interpolation(timed, model.body, torch.linspace(0, 1, 5), steps[..., 0, :3], steps[..., 0, :8], steps)
    seconds, metres, global_angle, local_angle = (value[0] for value in result.measures.values())
    np.testing.assert_allclose(seconds / seconds[0], [1, 1.5, 1, 1, 1], rtol=1e-5)
    np.testing.assert_allclose(metres / metres[0], [1, 1, 2, 1, 1], rtol=1e-5)
    angle = float(torch.tensor(0.5).rad2deg())
    np.testing.assert_allclose(global_angle, [0, 0, 0, angle, 0], atol=1e-2)
    np.testing.assert_allclose(local_angle, [0, 0, 0, 0, angle / (len(timed.turning) - 1)], atol=1e-2)
    assert result.table().row_count == 5


def test_motion_on_another_body_has_its_bone_lengths(segments, model):
    result = interpolate(model, batch_of(segments, [0]), batch_of(segments, [3]), 3)
    clips = result.motion(fps=60)
    for clip, shape, seconds in zip(clips, result.shape[0], result.durations[0], strict=True):
        assert clip.frames == int(float(seconds) * 60 + 1e-3) + 1
        lengths = clips.skeleton.bone_lengths(torch.from_numpy(clip.positions))
        expected = model.body.offsets(shape)[[child for _, child in clips.skeleton.edges]].norm(dim=-1)
        torch.testing.assert_close(lengths, expected.expand_as(lengths), rtol=0, atol=1e-4)
    for first, second, steps in (
        (batch_of(segments, [0]), batch_of(segments, [0]), 1),
        (batch_of(segments, [0]), batch_of(segments, [1, 2]), 3),
    ):
        with pytest.raises(ValueError, match=f"at least 2 steps and two batches of the same size, got {steps}"):
            interpolate(model, first, second, steps)


def test_a_map_shows_labels_and_explained_variance(segments, model):
    labels = ["walk", "walk", "$run$", "walk"]
    figure = latent_map(model, segments.all(), labels)
    (axes,) = figure.axes
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["walk", "$run$"]
    shares = [int(text.partition("%")[0].split()[-1]) for text in (axes.get_xlabel(), axes.get_ylabel())]
    assert 100 >= shares[0] >= shares[1] >= 0
    n_points = sum(len(points.get_offsets()) for points in axes.collections)
    assert n_points == len(segments)
    with pytest.raises(ValueError, match="at least 3 segments and a label for each, got 4 segments and 2 labels"):
        latent_map(model, segments.all(), labels[:2])
    with pytest.raises(ValueError, match="z has one number; a map needs at least two"):
        latent_map(dvae.method("motion-latent", latent=1, widths=(4,)).build(segments.schema), segments.all(), labels)
