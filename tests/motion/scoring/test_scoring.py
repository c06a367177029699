"""Scores of bodies and of their motion: definitions written out with loops, and invariances."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

import dvae
from dvae import motion
from dvae.data.batch import Batch
from dvae.inference.evaluation.evaluate import _measures
from dvae.inference.evaluation.evaluation_windows import prepare_windows
from dvae.inference.evaluation.references import References
from dvae.motion import PROTOCOLS, rotate_about_up

PROTOCOL = replace(PROTOCOLS["simulated"], observed=4, predicted=6, test_stride=20, multimodal_threshold=0.5)
LIMBS = ("limb stretch", "limb stretch RMS", "limb jitter", "limb jitter RMS", "limb-angle error")


@pytest.fixture(scope="module")
def windows():
    return motion.windows(motion.simulate(clips=6, frames=60, test=0.5), PROTOCOL, "test")


@pytest.fixture(scope="module")
def futures(windows):
    """Return three noisy futures of each window (N, K, T, D)."""
    x = windows.all()["x"][:, None, 4:]
    noise = torch.randn(len(x), 3, 6, x.shape[-1], generator=torch.Generator().manual_seed(0))
    return x + 0.03 * noise


class FixedForecasts(torch.nn.Module):
    """Returns given forecasts, window by window."""

    def __init__(self, windows, futures):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.past, self.futures = windows.all()["x"][:, :4], futures
        self.per, self.likelihood, self.view = "frame", False, None
        self.generative = self.inference = dvae.Factorization.parse("p(z) p(x_t | z)")

    def forecast(self, batch, horizon, samples=1, **_):
        rows = [int((self.past - x).abs().sum((1, 2)).argmin()) for x in batch["x"]]
        return {"x": self.futures[rows, :samples].movedim(1, 0)}


def scores(windows, futures, **options):
    model = FixedForecasts(windows, futures)
    evaluation = dvae.evaluate(
        model, windows, scores=motion.scores, samples=futures.shape[1], references=False, progress=False, **options
    )
    (row,) = evaluation.rows
    return {name: score.mean for name, score in evaluation[row].items()}


def by_definition(windows, futures):
    """Return the limb scores by loops over windows, futures, frames and limbs."""
    result = {name: [] for name in LIMBS}
    skeleton, truths = windows.skeleton, windows.positions(windows.all()["x"][:, 4:]).double().numpy()
    joints = windows.positions(futures).double().numpy()
    bones = skeleton.edges
    chains = [(parent, joint, child) for parent, joint in bones for start, child in bones if start == joint]

    def length(pose, bone):
        return np.linalg.norm(pose[bone[1]] - pose[bone[0]])

    def angle(pose, chain):
        a, b, c = (pose[joint] for joint in chain)
        u, v = b - a, c - b
        return np.degrees(np.arccos(u @ v / np.linalg.norm(u) / np.linalg.norm(v)))

    for poses, truth in zip(joints, truths, strict=True):
        for future in poses:
            for bone in bones:
                m = np.mean([length(pose, bone) for pose in truth])
                lengths = [length(pose, bone) for pose in future]
                off = [abs(each - m) / m for each in lengths]
                steps = [abs(after - before) / m for before, after in pairwise(lengths)]
                for name, values in (("limb stretch", off), ("limb jitter", steps)):
                    result[name].append(np.mean(values))
                    result[f"{name} RMS"].append(np.sqrt(np.mean(np.square(values))))
        errors = [
            np.mean([abs(angle(p, c) - angle(q, c)) for p, q in zip(f, truth, strict=True) for c in chains])
            for f in poses
        ]
        result["limb-angle error"].append(min(errors))
    return {name: np.mean(values) for name, values in result.items()}


def moved(windows, x):
    return windows.positions(x)[..., 1:, :].diff(dim=-3).norm(dim=-1).mean(-1)


def test_limb_scores_equal_their_definitions(windows, futures):
    values, expected = scores(windows, futures), by_definition(windows, futures)
    assert {name: values[name] for name in LIMBS} == pytest.approx(expected, rel=1e-4)
    assert scores(windows, futures, batch_size=2) == pytest.approx(values, rel=1e-5)


def test_heading_and_missing_steps_change_no_score(windows, futures):
    """The heading changes no score, and a single predicted frame has no step score."""
    rotated = rotate_about_up(futures.unflatten(-1, (-1, 3)), torch.tensor(1.0), windows.skeleton.up).flatten(-2)
    values, expected = scores(windows, rotated), scores(windows, futures)
    names = (*LIMBS, "CMD")
    assert [values[name] for name in names] == pytest.approx([expected[name] for name in names], rel=1e-4)
    short = motion.windows(motion.simulate(clips=4, frames=40, test=0.5), replace(PROTOCOL, predicted=1), "test")
    measures = {measure.name for measure in _measures(motion.scores, short)}
    assert {"limb stretch", "limb-angle error", "jerk"} <= measures  # with the seam there are four frames
    assert not {"limb jitter", "CMD"} & measures


def test_cmd_is_computed_by_class_for_labelled_clips(windows, futures):
    contents = windows.labels("content") if any("content" in clip.labels for clip in windows.clips) else None
    real, predicted = moved(windows, windows.all()["x"][:, 4:]).mean(-1), moved(windows, futures).mean(1)

    def area(rows):
        return sum((5 - t) * abs(float(predicted[rows, t].mean() - real[rows].mean())) for t in range(5))

    def expected(labels):
        groups = [[n for n, each in enumerate(labels) if each == label] for label in set(labels)]
        return sum(len(rows) / len(labels) * area(rows) for rows in groups)

    everything = [""] * len(windows)
    assert scores(windows, futures)["CMD"] == pytest.approx(expected(contents or everything), rel=1e-4)
    names = {clip.name: "ab"[n % 2] for n, clip in enumerate(windows.clips)}
    clips = [replace(clip, labels={**clip.labels, "content": names[clip.name]}) for clip in windows.clips]
    labelled = motion.windows(motion.MotionSet(clips, windows.skeleton), PROTOCOL, "test")
    labels = [names[clip] for _, clip, _ in labelled.keys]
    assert scores(labelled, futures)["CMD"] == pytest.approx(expected(labels), rel=1e-4)


def test_apde_compares_windows_with_the_same_last_pose(windows, futures):
    """Select truths by a plain loop; a window without similar ones has no score."""
    x = windows.all()["x"].double()
    distances = [[float((a[3] - b[3]).norm()) for b in x] for a in x]
    near = float(np.median([each for row in distances for each in row if each]))
    for threshold in (near, 1e-9):
        some = windows.with_protocol(replace(PROTOCOL, multimodal_threshold=threshold))
        truths = [[m for m in range(len(x)) if distances[n][m] < threshold] for n in range(len(x))]

        def apd(motions):
            return np.mean([float((a - b).norm()) for i, a in enumerate(motions) for b in motions[:i]])

        errors = [
            abs(apd(futures[n].double()) - apd(x[indices, 4:])) for n, indices in enumerate(truths) if len(indices) > 1
        ]
        values = scores(some, futures)
        assert values.get("APDE") == (pytest.approx(np.mean(errors), rel=1e-4) if errors else None)


def test_jerk_is_the_third_derivative_including_the_seam(windows):
    (measure,) = (each for each in motion.scores(windows) if each.name == "jerk")
    x, index, fps = windows.all()["x"].double(), torch.arange(len(windows)), PROTOCOL.fps
    times = torch.arange(10, dtype=torch.float64)[:, None] / fps

    def jerk(path):
        """Return the jerk of a pose whose joints all follow a path (10, 3), in m."""
        future_path = x[:, :1] + path.repeat(1, x.shape[-1] // 3)
        past, future = future_path[:, :4], future_path[:, None, 4:].repeat(1, 3, 1, 1)
        value = measure.function(future, future[:, 0], Batch(x=past), index)
        torch.testing.assert_close(value, value[:1].expand(len(x)))
        return value[0].item()

    assert jerk(torch.cat([times, times**2, 0 * times], -1)) == pytest.approx(0, abs=1e-6)
    assert jerk(torch.cat([0 * times, 2 * times**3, 0 * times], -1)) == pytest.approx(12)
    leap = torch.zeros(10, 3, dtype=torch.float64)
    leap[4:] = 0.1  # a jump between past and future gives 1, -2, 1 in six third differences
    assert jerk(leap) == pytest.approx(0.1 * 3**0.5 * fps**3 * 4 / 6)
    real = np.linalg.norm(np.diff(windows.positions(x)[:, 1:, 1:].numpy(), 3, axis=1), axis=-1).mean() * fps**3
    assert measure.note == f"jerk: real motion has {real:.1f} m/s³"


def test_only_windows_with_several_futures_are_scored_on_request():
    """All scores equal a loop that skips windows without another one in the same pose, as GSPS's evaluation does."""
    standing = motion.simulate(clips=1, frames=10).clips[0]
    changes = 0.1 * torch.randn(5, 10, 17, 3, generator=torch.Generator().manual_seed(0)).numpy()
    changes[:, 3] = 0.0  # the last observed pose is A, B, A, neither, B
    changes[[1, 4], 3, 5], changes[3, 3, 5] = 0.3, 0.6
    clips = [replace(standing, name=str(n), split="test", positions=standing.positions + changes[n]) for n in range(5)]
    windows = motion.windows(motion.MotionSet(clips, motion.WALKER), PROTOCOL, "test")
    kept = motion.several_futures(windows)
    assert [key[1] for key in kept.keys] == ["0", "1", "2", "4"]
    assert kept.fingerprint != windows.fingerprint
    x = windows.all()["x"]
    assert torch.equal(kept.all()["x"], x[[0, 1, 2, 4]])
    assert torch.equal(torch.cat([batch["x"] for batch in kept.batches(3)]), kept.all()["x"])

    futures = x[:, None, 4:] + 0.1 * torch.randn(5, 3, 6, 48, generator=torch.Generator().manual_seed(1))
    errors = (futures[:, :, None] - x[None, None, :, 4:]).norm(dim=-1)  # of a future of one window to another window
    expected = {name: [] for name in ("APD", "ADE", "FDE", "MMADE", "MMFDE")}
    for n in range(5):
        same = [m for m in range(5) if (x[n, 3] - x[m, 3]).norm() < 0.5]
        if len(same) == 1:
            continue
        rows = futures[n].flatten(1)
        expected["APD"].append(torch.stack([(rows[i] - rows[j]).norm() for i in range(3) for j in range(i)]).mean())
        expected["ADE"].append(errors[n, :, n].mean(-1).min())
        expected["FDE"].append(errors[n, :, n, -1].min())
        expected["MMADE"].append(torch.stack([errors[n, :, m].mean(-1).min() for m in same]).mean())
        expected["MMFDE"].append(torch.stack([errors[n, :, m, -1].min() for m in same]).mean())
    model = FixedForecasts(windows, futures)
    evaluation = dvae.evaluate(model, kept, scores=motion.scores, samples=3, references=False, progress=False)
    for name, values in expected.items():
        assert evaluation["model"][name].mean == pytest.approx(torch.stack(values).mean().item(), rel=1e-5), name
    assert evaluation.data["windows"] == 4
    assert evaluation.data["title"] == ["4 of 5 windows, those with several futures"]
    assert evaluation.basis["multimodal"]["alone"] == 0
    assert scores(windows, futures)["ADE"] != pytest.approx(evaluation["model"]["ADE"].mean, rel=1e-3)

    with pytest.raises(ValueError, match="are for evaluation"):
        kept.sample(2, torch.Generator())
    with pytest.raises(ValueError, match="no other stride than 20, got 3"):
        kept.all(3)
    apart = motion.windows(motion.MotionSet([clips[n] for n in (0, 1, 3)], motion.WALKER), PROTOCOL, "test")
    with pytest.raises(ValueError, match="none of the 3 windows has several futures"):
        motion.several_futures(apart)


def test_reference_rows_of_motion_are_the_last_pose_and_neighbours(walkers):
    test, training = walkers.windows("test"), walkers.windows("train")
    rows = References(prepare_windows(test), 3, training=training)
    assert rows.usual == ["zero velocity", "nearest neighbours"]
    assert list(rows.notes) == []
    count, forecaster = rows["zero velocity"]
    observed = test.protocol.observed
    x = test.all()["x"][:4]
    assert count == 1
    torch.testing.assert_close(forecaster(slice(0, 4))[0], x[:, observed - 1 : observed].expand_as(x[:, observed:]))
    assert "drift" not in dvae.evaluate({}, test, training_windows=training, samples=2, progress=False).rows
