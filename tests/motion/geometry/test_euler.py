"""Errors of Euler angles: the angles of the public protocol, the best of K, and rotations inferred from positions."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

import dvae
from dvae import motion
from dvae.motion.geometry.euler import Angles, euler_errors
from dvae.motion.geometry.rotations import from_matrix, to_matrix
from dvae.motion.geometry.views import ROTATIONS

PROTOCOL = replace(motion.PROTOCOLS["simulated"], observed=5, predicted=12, test_stride=6, representation="quaternion")
TIMES = (80, 160, 320, 400)


@pytest.fixture(scope="module")
def people():
    """Return people with recorded rotations, including a twist that positions do not determine."""
    people_with_rotations = motion.simulate(clips=10, frames=60, test=0.4).with_rotations()
    twist = torch.zeros(people_with_rotations.skeleton.joints, 3)
    twist[people_with_rotations.skeleton.names.index("LElbow")] = torch.tensor([0.4, 0.1, 0.0])
    clips = []
    for clip in people_with_rotations:
        matrices = to_matrix(torch.from_numpy(clip.rotations), "quaternion")
        more = from_matrix(matrices @ to_matrix(twist.to(matrices), "vector"), "quaternion").numpy()
        clips.append(replace(clip, rotations=more))
    return motion.MotionSet(clips, people_with_rotations.skeleton, "people")


@pytest.fixture(scope="module")
def windows(people):
    return motion.windows(people, PROTOCOL, "test")


def mix(windows, **options):
    torch.manual_seed(0)
    return dvae.method("mix-and-match", width=16, **options).build(windows).eval()


def euler_of_public_code(matrix):
    """Return Euler angles of matrices that act on rows, as in the public code for Human3.6M."""
    e2 = -np.arcsin(matrix[0, 2])
    e1 = np.arctan2(matrix[1, 2] / np.cos(e2), matrix[2, 2] / np.cos(e2))
    e3 = np.arctan2(matrix[0, 1] / np.cos(e2), matrix[0, 0] / np.cos(e2))
    return e1, e2, e3


def test_the_angles_equal_those_of_the_public_protocol(windows):
    matrices = to_matrix(torch.randn(40, 3, dtype=torch.float64), "vector")
    expected = [euler_of_public_code(turn.T.numpy())[::-1] for turn in matrices]
    angles = Angles(windows, TIMES).of(matrices[:, None])
    np.testing.assert_allclose(angles, expected, atol=1e-9)


def by_hand(windows, futures, joints):
    """Return errors (K, N, times) of rotations (K, N, T, J, 3, 3), in numpy from the rotations of the file."""
    truth = to_matrix(windows.all()["view_inputs"][ROTATIONS].unflatten(-1, (-1, 4)), "quaternion")
    frames = [round(time * 30 / 1000) + 4 for time in TIMES]  # 2, 5, 10 and 12 frames after the fifth
    true, predicted = (
        from_matrix(each[..., frames, :, :, :][..., joints, :, :], "euler-zyx") for each in (truth, futures)
    )
    varying = true.flatten(0, 1).flatten(1).std(0) > 1e-4
    return (predicted - true).flatten(-2)[..., varying].norm(dim=-1)


def test_errors_of_zero_velocity_by_hand_and_zero_for_the_truth(windows):
    result = euler_errors({}, windows, times=TIMES, counts=(1, 5), progress=False)
    skeleton = windows.skeleton
    joints = sorted(set(skeleton.parents) - {-1, skeleton.root})
    matrices = to_matrix(windows.all()["view_inputs"][ROTATIONS].unflatten(-1, (-1, 4)), "quaternion")
    still = by_hand(windows, matrices[:, 4:5].expand(-1, 17, -1, -1, -1), joints)
    for place, time in enumerate(TIMES):
        for count in (1, 5):
            score = result["zero velocity"][f"{time} ms, best of {count}"]
            assert score.mean == pytest.approx(still[:, place].mean().item(), rel=1e-4)
            assert score.standard_error > 0
    assert by_hand(windows, matrices, joints).max() == 0
    assert result.data["angles"] < 3 * len(joints)  # two angles of a hinge do not vary
    assert "without the root" in result.notes[0]


def test_the_best_of_k_futures_has_the_lowest_mean_over_the_times(windows, monkeypatch):
    model, counts, draws = mix(windows, noise="step", velocity=True), (1, 3, 8), []
    to_data_space = model.to_data_space
    monkeypatch.setattr(
        model, "to_data_space", lambda values, data: draws.append(values["x"]) or to_data_space(values, data)
    )
    result = euler_errors({"mix": model}, windows, times=TIMES, counts=counts, progress=False)
    turning = sorted(set(windows.skeleton.parents) - {-1})
    matrices = to_matrix(torch.cat(draws, 1).unflatten(-1, (len(turning), 4)), "quaternion")
    assert matrices.shape[:3] == (8, len(windows), 12)
    all_matrices = torch.eye(3).repeat(8, len(windows), 17, windows.skeleton.joints, 1, 1)
    all_matrices[:, :, 5:, turning] = matrices
    errors = by_hand(windows, all_matrices, sorted(set(turning) - {windows.skeleton.root}))
    for count in counts:
        best = errors[:count].mean(-1).argmin(0)
        expected = errors[best, torch.arange(len(windows))].mean(0)
        for place, time in enumerate(TIMES):
            assert result["mix"][f"{time} ms, best of {count}"].mean == pytest.approx(expected[place].item(), rel=1e-4)


class Shifts(nn.Module):
    """Forecasts positions: the true futures, or with noise."""

    likelihood = False

    def __init__(self, windows, noise):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(()))
        self.x, self.noise = windows.all()["x"], noise
        self.generative = self.inference = dvae.Factorization.parse("p(x_t | x_{t-1})")

    def forecast(self, batch, horizon, samples=1, *, draw_emission):
        index = torch.cdist(batch["x"].flatten(1), self.x[:, :5].flatten(1)).argmin(1)
        future = self.x[index, 5 : 5 + horizon]
        return {"x": future + self.noise * torch.randn(samples, *future.shape)}


def test_positions_are_scored_by_their_inferred_rotations(people, windows):
    models = {"true": Shifts(windows, 0.0), "near": Shifts(windows, 0.01), "far": Shifts(windows, 0.05)}
    options = {"times": TIMES, "counts": (4,), "inverse": True, "progress": False}
    result = euler_errors(models | {"mix": mix(windows)}, windows, **options)
    errors = {name: result[name]["320 ms, best of 4"].mean for name in result.rows}
    assert errors["true"] == pytest.approx(0, abs=1e-3)
    assert 0 < errors["near"] < errors["far"]
    plain = replace(PROTOCOL, representation="positions")
    bare = motion.MotionSet([replace(clip, rotations=None) for clip in people], people.skeleton, "people")
    positions = motion.windows(bare, plain, "test")  # without a twist, or without rotations
    again = euler_errors(models, positions, **options)
    for name in again.rows:
        assert again[name]["320 ms, best of 4"].mean == pytest.approx(errors[name], abs=1e-3)
    past = Angles(windows, TIMES).all()["motion"]  # a model does not get the future
    assert past["x"].shape[1] == past["view_inputs"][ROTATIONS].shape[1] == 5


def test_wrong_arguments_are_errors(people, windows):
    for options, message in (
        ({"times": (80, 1000)}, "nearest to 1000 ms: windows of simulated predict 12 frames at 30 frames per second"),
        ({"times": ()}, "nearest to no time"),
        ({"counts": (0, 5)}, "`counts` needs numbers of at least 1"),
        (
            {"models": {"near": Shifts(windows, 0.1)}},
            "a model of positions predicts no rotations; score it with inverse=True",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            euler_errors(**{"models": {}, "windows": windows, "times": TIMES, "progress": False, **options})
    plain = motion.windows(people, replace(PROTOCOL, representation="positions"), "test")
    with pytest.raises(ValueError, match="have positions, which do not determine all rotations"):
        Angles(plain, TIMES)
    bare = motion.simulate(clips=6, frames=40, test=0.4)
    with pytest.raises(ValueError, match=r"no rest pose, .* MotionSet.with_rotations\(\) computes both"):
        Angles(motion.windows(bare, replace(PROTOCOL, representation="positions"), "test"), TIMES, inverse=True)
    incomplete = motion.windows(motion.occlude(bare, 0.2, 5.0), replace(PROTOCOL, representation="positions"), "test")
    with pytest.raises(ValueError, match="a missing joint leaves the rotations of others undetermined"):
        Angles(incomplete, TIMES, inverse=True)
