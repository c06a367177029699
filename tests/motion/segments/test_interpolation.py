"""Between segments of a latent space: ends, straight lines, what is measured on the way, other bodies, and a map."""

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
def held():
    return SegmentData("simulated", motion.simulate(clips=8, frames=50, seed=1, test=0.5), "clips").windows("test")


@pytest.fixture(scope="module")
def model(held):
    torch.manual_seed(0)
    return dvae.method("motion-latent", latent=3, widths=(16,)).build(held).eval()


def some(held, places):
    return {name: value[places] for name, value in held.all().items()}


def test_the_ends_are_the_segments_as_they_come_back_and_all_between_is_on_a_line(held, model):
    first, second = some(held, [0, 1]), some(held, [2, 3])
    found, back = interpolate(model, first, second, 5), interpolate(model, second, first, 5)
    for step, batch in ((0, first), (-1, second)):
        torch.testing.assert_close(found.x[:, step], transfer(model, batch, batch[SHAPE]))
        torch.testing.assert_close(found.shape[:, step], batch[SHAPE])
    for value in (found.latent, found.shape):
        torch.testing.assert_close(value.diff(n=2, dim=1), torch.zeros_like(value[:, 2:]), rtol=0, atol=1e-5)
    torch.testing.assert_close(found.x, back.x.flip(1), rtol=1e-4, atol=1e-5)
    assert falls(torch.tensor([[3.0, 2, 1], [3, 3, 1], [1, 2, 3]])).tolist() == [True, False, False]
    assert found.vertices(1).shape == (5, 100, 1486, 3)


def test_measures_are_of_what_changes_alone(held, model):
    """One segment that lasts longer, gets further, is turned as a whole, and in one joint."""
    timed, x = held.timed, held.all()["x"][:1]
    slow, far, turned, bent = (x.clone() for _ in range(4))
    slow[..., timed.parts["time"]] *= 1.5
    far[..., timed.parts["translation"]] *= 2
    turn = to_matrix(torch.tensor([0.0, 0.5, 0.0]), "vector")
    for changed, joint in ((turned, timed.skeleton.root), (bent, timed.turning[-1])):
        places = slice(6 * timed.turning.index(joint), 6 * timed.turning.index(joint) + 6)
        unturned = torch.tensor([1.0, 0, 0, 0, 1, 0])
        own = to_matrix((x[..., places] + unturned), "6d")
        changed[..., places] = from_matrix(turn @ own, "6d") - unturned
    steps = torch.stack([x, slow, far, turned, bent], 1)
    found = Interpolation(timed, model.body, torch.linspace(0, 1, 5), steps[..., 0, :3], steps[..., 0, :8], steps)
    seconds, metres, whole, local = (value[0] for value in found.measures.values())
    np.testing.assert_allclose(seconds / seconds[0], [1, 1.5, 1, 1, 1], rtol=1e-5)
    np.testing.assert_allclose(metres / metres[0], [1, 1, 2, 1, 1], rtol=1e-5)
    angle = float(torch.tensor(0.5).rad2deg())
    np.testing.assert_allclose(whole, [0, 0, 0, angle, 0], atol=1e-2)
    np.testing.assert_allclose(local, [0, 0, 0, 0, angle / (len(timed.turning) - 1)], atol=1e-2)
    assert found.table().row_count == 5


def test_a_motion_on_another_body_has_its_bones(held, model):
    found = interpolate(model, some(held, [0]), some(held, [3]), 3)
    clips = found.motion(fps=60)
    for clip, shape, seconds in zip(clips, found.shape[0], found.durations[0], strict=True):
        assert clip.frames == int(float(seconds) * 60 + 1e-3) + 1
        lengths = clips.skeleton.bone_lengths(torch.from_numpy(clip.positions))
        expected = model.body.offsets(shape)[[child for _, child in clips.skeleton.edges]].norm(dim=-1)
        torch.testing.assert_close(lengths, expected.expand_as(lengths), rtol=0, atol=1e-4)
    for first, second, steps in ((some(held, [0]), some(held, [0]), 1), (some(held, [0]), some(held, [1, 2]), 3)):
        with pytest.raises(ValueError, match=f"at least 2 steps and two batches of the same size, got {steps}"):
            interpolate(model, first, second, steps)


def test_a_map_says_labels_and_shares(held, model):
    labels = ["walk", "walk", "$run$", "walk"]
    figure = latent_map(model, held.all(), labels)
    (axes,) = figure.axes
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["walk", "$run$"]
    shares = [int(text.partition("%")[0].split()[-1]) for text in (axes.get_xlabel(), axes.get_ylabel())]
    assert 100 >= shares[0] >= shares[1] >= 0
    drawn = sum(len(points.get_offsets()) for points in axes.collections)
    assert drawn == len(held)
    with pytest.raises(ValueError, match="at least 3 segments and a label of each, got 4 and 2"):
        latent_map(model, held.all(), labels[:2])
