"""Errors of angles by action: the windows of the benchmark, and means over them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import dvae
from dvae import motion
from dvae.motion.geometry.euler import euler_errors
from dvae.motion.scoring.by_action import action_windows, errors_by_action

ACTIONS, TIMES = ("eating", "walking"), (80, 1000)


def people(frames=180, clips=2):
    """Return two clips of each action of S5, at 25 frames per second, with rotations."""
    simulated = motion.simulate(clips=2 * clips, frames=frames, seed=1).with_rotations()
    names = [f"{action}_{number + 1}" for action in ACTIONS for number in range(clips)]
    labelled = [
        replace(clip, split="S5", name=name, labels={"action": name[:-2]}, truth={})
        for clip, name in zip(simulated, names, strict=True)
    ]
    return motion.MotionSet(labelled[::-1], replace(simulated.skeleton, fps=25.0), "people")


def test_windows(**options):
    protocol = replace(motion.PROTOCOLS["h36m-angles"], representation="quaternion")
    return motion.windows(people(**options), protocol, "test")


test_windows.__test__ = False


@pytest.fixture(scope="module")
def windows():
    return action_windows(test_windows())


def test_windows_start_where_those_of_the_public_code_do(windows):
    """First numbers of the generator seeded with 1234567890, for clips of 180 frames; 16 frames are observed."""
    assert [key[:2] for key in windows.keys] == [
        ("S5", f"{action}_{n % 2 + 1}") for action in ACTIONS for n in range(8)
    ]
    random = np.random.RandomState(1234567890)
    drawn = [random.randint(16, 180 - 50 - 100) for _ in range(8)]
    assert [start for *_, start in windows.keys] == [start + 50 - 16 for start in drawn] * 2


def test_errors_of_an_action_are_means_over_its_windows(windows):
    torch.manual_seed(0)
    models = {"mix": dvae.method("mix-and-match", width=8).build(windows).eval()}
    options = {"times": TIMES, "counts": (1, 3), "progress": False}
    evaluation = euler_errors(models, windows, **options)
    table = errors_by_action(evaluation, windows, "mix", 3)
    first, *others = ([*map(str, column.cells)] for column in table.columns)
    assert first == [*ACTIONS, "mean"]
    for time, cells in zip(TIMES, others, strict=True):
        name = f"{time} ms, best of 3"
        errors = dict(zip(evaluation.clusters, evaluation.rows["mix"].cluster_means[name], strict=True))
        for action, cell in zip(ACTIONS, cells, strict=False):
            of_action = windows.at([key for key in windows.keys if key[1].startswith(action)])
            alone = [errors[f"S5/{action}_{n}"] for n in (1, 2)]
            assert len(of_action) == 8
            assert cell == f"{np.mean(alone):.2f} ± {abs(alone[0] - alone[1]) / 2:.2f}"
        assert cells[-1].split()[0] == f"{evaluation['mix'][name].mean:.2f}"


def test_other_windows_are_refused(windows):
    for chosen, message in (
        (test_windows(frames=166), "more than 166 frames"),
        (test_windows(clips=1), "needs two clips of each action"),
        (windows.with_protocol(replace(windows.protocol, fps=50.0)), "has 50, 16 and 60"),
    ):
        with pytest.raises(ValueError, match=message):
            action_windows(chosen)
