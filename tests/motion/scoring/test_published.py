"""Published scores: the definitions of the public evaluation scripts, and forecasts as these scripts hold them."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch

import dvae
from dvae import motion
from dvae.motion.scoring.published import UNITS

N, K, OBSERVED, FRAMES, JOINTS = 12, 5, 4, 10, 16
PACES = {"Sitting": 0.03, "Walking": 0.07}
GOLDEN = {
    "dlow": {
        "APD": 2.1622343292780273,
        "ADE": 0.42061374534468543,
        "FDE": 0.5669227612880298,
        "MMADE": 0.9873191043274745,
        "MMFDE": 1.2221877452636738,
    },
    "gsps": {
        "APD": 2.1441232812847884,
        "ADE": 0.4165958633129466,
        "FDE": 0.5589892381147978,
        "MMADE": 1.172203008623332,
        "MMFDE": 1.4326758834156565,
    },
    "belfusion": {"APDE": 2.816605620927613, "CMD": 1.6691768108910354},
}
"""Results of the metric functions in the public code of the papers on the arrays below, in float64.

HumanMAC's and BeLFusion's APD, ADE, FDE, MMADE and MMFDE equal those of DLow. BeLFusion's CMD has `PACES` in place of
its constants."""


@pytest.fixture(scope="module")
def arrays():
    """Return windows (N, T, D) and forecasts (K, N, T, D); nine windows share their last poses, in threes."""
    random = np.random.Generator(np.random.PCG64(0))
    x = random.normal(size=(N, OBSERVED + FRAMES, 3 * JOINTS)).cumsum(1) * 0.05
    same = np.where(np.arange(N) < 9, np.arange(N) // 3 * 3, np.arange(N))
    x[:, OBSERVED - 1] = x[same, OBSERVED - 1]
    x[:, OBSERVED - 1] += random.normal(size=(N, 3 * JOINTS)) * 0.02
    return x, x[None, :, OBSERVED:] + random.normal(size=(K, N, FRAMES, 3 * JOINTS)).cumsum(2) * 0.03


@pytest.fixture(scope="module")
def windows(arrays):
    """Return the windows as clips of Human3.6M, with a further frame at the end."""
    x, _ = arrays
    joints = np.concatenate([np.zeros((N, OBSERVED + FRAMES, 1, 3)), x.reshape(N, -1, JOINTS, 3)], 2)
    joints = np.concatenate([joints, joints[:, -1:]], 1)
    names = [f"{'Walking' if n % 3 else 'Sitting'} {n}" for n in range(N)]
    clips = [motion.Clip("S9", name, each) for name, each in zip(names, joints, strict=True)]
    protocol = replace(motion.PROTOCOLS["h36m"], observed=OBSERVED, predicted=FRAMES)
    return motion.windows(motion.MotionSet(clips, motion.HUMAN36M), protocol, "test")


def score(forecasts, windows, scores=motion.displacements, **options):
    options = {"references": False, "progress": False} | options
    return dvae.evaluate({"theirs": forecasts}, windows, scores=scores, **options)["theirs"]


def of_numpy(x, forecasts, itself=True):
    """Return the published definitions by name, computed window by window."""
    last, futures = x[:, OBSERVED - 1], x[:, OBSERVED:]
    scores = {name: [] for name in ("APD", "ADE", "FDE", "MMADE", "MMFDE", "APDE")}

    def pairs(motions):
        return np.mean([np.linalg.norm(a - b) for a, b in combinations(motions, 2)])

    for n in range(N):
        errors = [np.linalg.norm(forecasts[:, n] - truth, axis=-1) for truth in futures]
        close = [m for m in range(N) if np.linalg.norm(last[n] - last[m]) < 0.5]
        truths = [m for m in close if itself or m != n]
        best = {"ADE": [e.mean(1).min() for e in errors], "FDE": [e[:, -1].min() for e in errors]}
        for name, values in best.items():
            scores[name].append(values[n])
            scores[f"MM{name}"].append(np.mean([values[m] for m in truths]) if truths else np.nan)
        scores["APD"].append(pairs(forecasts[:, n]))
        scores["APDE"].append(abs(scores["APD"][-1] - pairs(futures[close])) if len(close) > 1 else np.nan)
    return {name: np.nanmean(values) for name, values in scores.items()}


@pytest.mark.parametrize("itself", [True, False])
def test_scores_equal_the_published_definitions(arrays, itself):
    x, forecasts = arrays
    result = score(
        forecasts, dvae.ArrayWindows(x, OBSERVED), scores=lambda windows: motion.displacements(windows, itself=itself)
    )
    for name, value in of_numpy(x, forecasts, itself).items():
        assert result[name].mean == pytest.approx(value, rel=1e-12), name


def test_scores_equal_the_results_of_public_code(arrays, windows):
    x, forecasts = arrays
    result = score(forecasts, dvae.ArrayWindows(x, OBSERVED))
    for name, value in (GOLDEN["dlow"] | {"APDE": GOLDEN["belfusion"]["APDE"]}).items():
        assert result[name].mean == pytest.approx(value, abs=1e-9), name
    scored = motion.published_windows(windows, "gsps")
    assert len(scored) == 9
    kept = forecasts[:, [n for n, key in enumerate(windows.keys) if key in scored.keys]]
    result = score(kept, scored)
    for name, value in GOLDEN["gsps"].items():
        assert result[name].mean == pytest.approx(value, abs=1e-6), name  # clips are in float32


def test_cumulative_motion_has_given_paces_by_action(arrays, windows):
    _, forecasts = arrays
    result = score(forecasts, windows, scores=lambda each: motion.scores(each, paces=PACES))["CMD"]
    assert result.mean == pytest.approx(GOLDEN["belfusion"]["CMD"], abs=1e-6)
    moved = np.linalg.norm(np.diff(forecasts.reshape(K, N, FRAMES, JOINTS, 3), axis=2), axis=-1).mean((0, 3))
    expected = 0.0
    for action, pace in PACES.items():
        rows = [n for n, (_, clip, _) in enumerate(windows.keys) if clip.startswith(action)]
        paces = moved[rows].mean(0)
        expected += len(rows) / N * sum(abs(paces[t - 1] - pace) * (FRAMES - t) for t in range(1, FRAMES))
    assert result.mean == pytest.approx(expected, abs=1e-6)
    with pytest.raises(ValueError, match="paces have no class Walking"):
        motion.scores(windows, paces={"Sitting": 0.03})
    unnamed = motion.windows(motion.simulate(clips=4, frames=90), "simulated", "test")
    with pytest.raises(KeyError, match="no clip has the label 'action'"):
        motion.scores(unnamed, paces=PACES)


def test_published_windows_do_not_end_with_their_clip(windows):
    def of(length):
        clips = [replace(clip, positions=clip.positions[:length]) for clip in windows.clips]
        return motion.windows(motion.MotionSet(clips, motion.HUMAN36M), windows.protocol, "test")

    for paper in ("dlow", "humanmac"):
        assert motion.published_windows(windows, paper).keys == windows.keys
        with pytest.raises(ValueError, match="`keys` is empty"):
            motion.published_windows(of(OBSERVED + FRAMES), paper)
    assert motion.published_windows(windows, "dlow").description["title"] == ["windows of dlow"]
    with pytest.raises(ValueError, match="unknown paper 'trajevae'"):
        motion.published_windows(windows, "trajevae")


LAYOUTS = {
    "HumanMAC": ("kntd", lambda x: x),
    "BeLFusion": ("nkt1jc", lambda x: x.movedim(0, 1).unflatten(-1, (JOINTS, 3))[:, :, :, None]),
    "joints": ("nktjc", lambda x: x.movedim(0, 1).unflatten(-1, (JOINTS, 3))),
    "list": ("kntd", lambda x: list(x.movedim(1, 0))),  # DLow and GSPS forecast one window after another
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("unit", UNITS)
def test_forecasts_in_public_layouts_and_units_are_the_same_forecasts(arrays, windows, layout, unit):
    forecasts = torch.from_numpy(arrays[1])
    axes, arrange = LAYOUTS[layout]
    read = motion.frames_of(arrange(forecasts / UNITS[unit]), windows, axes=axes, unit=unit)
    torch.testing.assert_close(read.values, forecasts, rtol=1e-12, atol=0)


def test_a_root_is_removed_as_requested(arrays, windows):
    forecasts = torch.from_numpy(arrays[1])
    poses = forecasts.unflatten(-1, (JOINTS, 3))
    path = torch.linspace(0, 2, FRAMES, dtype=torch.float64)[:, None, None].expand(K, N, -1, 1, 3)
    still, relative = (torch.cat([root, poses], 3) for root in (0 * path, path))
    world = torch.cat([path, poses + path], 3)
    for values, root in ((still, None), (still, "subtract"), (relative, "ignore"), (world, "subtract")):
        read = motion.frames_of(values, windows, axes="kntjc", root=root)
        torch.testing.assert_close(read.values, forecasts, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match=r"the root, Pelvis, moves in these forecasts.*root='subtract'"):
        motion.frames_of(world, windows, axes="kntjc")
    with pytest.raises(ValueError, match="frames of 48 numbers have no root"):
        motion.frames_of(forecasts, windows, root="ignore")
    with pytest.raises(ValueError, match="unknown unit 'km'"):
        motion.frames_of(forecasts, windows, unit="km")
    with pytest.warns(UserWarning, match=r"positions are 1\.3e\+03 times those of the data; is their unit 'm'"):
        motion.frames_of(1000 * forecasts, windows)


def test_names_of_joints_in_a_file_are_compared(arrays, windows, tmp_path):
    _, forecasts = arrays
    joints = np.concatenate([np.zeros((K, N, FRAMES, 1, 3)), forecasts.reshape(K, N, FRAMES, JOINTS, 3)], 3)
    past = windows.positions(windows.all()["x"]).numpy()
    stored = motion.Forecasts(
        windows.skeleton, windows.keys, joints, past[:, :OBSERVED], past[:, OBSERVED:], emission="mean"
    )
    stored.save(tmp_path / "own.npz")
    read = motion.frames_of(tmp_path / "own.npz", windows)
    assert read.columns == windows.columns
    assert score(read, windows)["ADE"] == score(forecasts, windows)["ADE"]
    noted = dvae.evaluate({"theirs": read}, windows, progress=False).notes
    assert any("forecasts of theirs are means without emission noise" in note for note in noted)
    names = windows.skeleton.names
    order = [0, 2, 1, *range(3, len(names))]
    swapped = replace(stored, skeleton=replace(windows.skeleton, names=tuple(names[j] for j in order)))
    swapped.save(tmp_path / "swapped.npz")
    with pytest.raises(ValueError, match=r"columns \['RKnee_x', .*expected, in this order, \['RHip_x'"):
        score(motion.frames_of(tmp_path / "swapped.npz", windows), windows)
