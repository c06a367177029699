"""Pseudo ground truth: equal to a comparison of all pairs, sampled uniformly, with bone lengths of the window."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dvae import motion
from dvae.motion import PROTOCOLS, PseudoTruths, rotate_about_up

OBSERVED, STRIDE, NEAR, APART = 4, 7, 0.8, 0.15
SMALL = replace(PROTOCOLS["simulated"], observed=OBSERVED, predicted=8)


@pytest.fixture(scope="module")
def people():
    """Return people with different limb lengths."""
    return motion.simulate(clips=10, frames=60, seed=1)


@pytest.fixture(scope="module")
def windows(people):
    return motion.windows(people, SMALL, "train")


@pytest.fixture(scope="module")
def truths(windows):
    return PseudoTruths(windows, NEAR, APART, stride=STRIDE)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def drawn(windows, count=12, seed=0):
    return windows.sample(count, generator(seed))["x"]


def posed(windows, positions, lengths):
    """Return positions (T, J, 3) with other limb lengths, joint by joint from the root."""
    skeleton = windows.skeleton
    length = dict(zip([child for _, child in skeleton.edges], lengths.tolist(), strict=True))
    result = positions.clone()
    for joint in skeleton.order[1:]:
        parent = skeleton.parents[joint]
        limb = positions[:, joint] - positions[:, parent]
        result[:, joint] = result[:, parent] + length[joint] * limb / limb.norm(dim=-1, keepdim=True)
    return result


def shared_futures(windows, x, near=NEAR, apart=APART, heading=False):
    """Return all admissible futures (F, D) of a window (T, D) by comparing all candidates."""
    joints = [
        j for j in range(windows.skeleton.joints) if windows.protocol.root != "drop" or j != windows.skeleton.root
    ]
    positions = windows.positions(x).double()
    futures = []
    for candidate in windows.positions(windows.all(STRIDE)["x"]).double():
        if heading:
            angle = windows.skeleton.heading(candidate[OBSERVED - 1])
            candidate = rotate_about_up(candidate, -angle, windows.skeleton.up)
        other = posed(windows, candidate, windows.skeleton.bone_lengths(positions[0]))
        distances = (other - positions)[:, joints].norm(dim=-1)
        if distances[OBSERVED - 1].norm() < near and distances[OBSERVED:].mean() >= apart:
            futures.append(other[OBSERVED:, joints].flatten(1).float())
    return futures


def find(future, futures):
    (place,) = [n for n, other in enumerate(futures) if torch.allclose(future, other, atol=1e-4)]
    return place


@pytest.mark.parametrize(("heading", "root"), [(False, "relative"), (True, "drop")])
def test_futures_equal_those_of_comparing_all_pairs(people, root, heading):
    windows = motion.windows(people, replace(SMALL, root=root), "train")
    truths = PseudoTruths(windows, NEAR, APART, most=30, stride=STRIDE, heading=heading)
    x = drawn(windows, 20)
    x = truths.turn(x) if heading else x
    pseudo, valid = truths.of(x, generator())
    assert pseudo.shape == (20, 30, *x.shape[1:])
    n_matches = 0
    for window, others, real in zip(x, pseudo, valid, strict=True):
        expected = shared_futures(windows, window, heading=heading)
        assert len(expected) < 30
        places = [find(other[OBSERVED:], expected) for other in others[real]]
        assert sorted(places) == list(range(len(expected)))
        n_matches += len(places)
    assert n_matches > 10


def test_at_most_m_futures_are_sampled_uniformly_without_replacement(windows):
    x = drawn(windows)
    counts = [len(shared_futures(windows, window)) for window in x]
    place = int(np.argmax(counts))
    futures = shared_futures(windows, x[place])
    assert len(futures) > 4
    pseudo, valid = PseudoTruths(windows, NEAR, APART, most=2, stride=STRIDE).of(
        x[place].expand(600, -1, -1), generator()
    )
    assert valid.all()
    places = torch.tensor([[find(other[OBSERVED:], futures) for other in others] for others in pseudo])
    assert (places[:, 0] != places[:, 1]).all()
    share = 2 / len(futures)
    deviation = (600 * share * (1 - share)) ** 0.5
    assert (places.flatten().bincount(minlength=len(futures)) - 600 * share).abs().max() < 4 * deviation


def test_pseudo_truths_keep_the_past_and_are_padded_with_zeros(windows, truths):
    x = drawn(windows, 40)
    pseudo, valid = truths.of(x, generator())
    assert valid.any()
    assert not valid.all()
    past = x[:, None, :OBSERVED].expand(-1, truths.most, -1, -1)
    assert torch.equal(pseudo[valid][:, :OBSERVED], past[valid])
    assert not pseudo[~valid].any()
    assert (valid.int().diff(dim=1) <= 0).all()  # real ones first


def test_limbs_of_length_zero_give_no_nan(people):
    clips = []
    for clip in people:
        positions = clip.positions.copy()
        positions[:, 13] = positions[:, 12]
        positions[::2, 16] = positions[::2, 15]  # in every second frame
        clips.append(replace(clip, positions=positions))
    windows = motion.windows(motion.MotionSet(clips, people.skeleton), SMALL, "train")
    pseudo, valid = PseudoTruths(windows, NEAR, APART, stride=STRIDE).of(drawn(windows), generator())
    assert valid.any()
    assert torch.isfinite(pseudo).all()


def test_windows_without_futures_or_heading_are_errors(people, windows, truths):
    for options, message in (({"threshold": 0}, "`threshold` must be above 0"), ({"most": 0}, "`stride` at least 1")):
        with pytest.raises(ValueError, match=message):
            PseudoTruths(windows, **options)
    with pytest.raises(ValueError, match="no future"):
        PseudoTruths(motion.windows(people, SMALL, "train", length=OBSERVED))
    with pytest.raises(ValueError, match=r"\(B, 12, 48\)"):
        truths.of(torch.zeros(12, 48), generator())
    nameless = motion.MotionSet(people.clips, replace(people.skeleton, left=(), right=()))
    with pytest.raises(ValueError, match="no left and right"):
        PseudoTruths(motion.windows(nameless, SMALL, "train"), heading=True)
