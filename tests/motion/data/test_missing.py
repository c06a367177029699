"""Motion that lacks joints: read, cut, turned, fitted by every method, forecast, scored and filled in."""

import base64
import json
import zlib
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest
import torch

import dvae
from dvae import motion
from dvae.cli import main
from dvae.cli.app import COMMANDS, command
from dvae.cli.console import Missing
from dvae.cli.help import Expert
from dvae.inference.diagnostics.checks import STATISTICS
from dvae.inference.evaluation import metrics
from dvae.inference.evaluation.evaluation_windows import clip_index
from dvae.inference.evaluation.references import distances, last_value
from dvae.models.motion.trajectories import TrajectoryMethod
from dvae.models.registry import METHODS
from dvae.motion.data.clips import Clip, MotionSet
from dvae.motion.drawing.player import MISSING, _scene
from dvae.motion.drawing.plot import make_scene
from dvae.motion.scoring import energies
from dvae.motion.scoring import metrics as errors

PEOPLE = motion.simulate(clips=10, frames=90, seed=1)
GAPS = motion.occlude(PEOPLE, seed=1)
WALKER = PEOPLE.skeleton
SMALL = {
    "hit-dvae": {"samples": 2, "width": 8, "heads_count": 2, "decoder": 8, "pose_width": 2, "pose_prior": 0.0},
    "gsps": {"width": 8, "blocks": 1, "draws": (2, 2), "coefficients": 4, "pose_prior": 0.0},
    "trajevae": {"width": 8, "feedforward": 8, "components": 4},
    "erd": {"width": 4, "encoder": (5,), "decoder": (6,)},
    "aclstm": {"width": 4},
    "cvae-rnn": {"latent": 4, "summary": 4, "width": 8, "hidden": (8,)},
    "motion-infilling": {"maps": (4, 6)},
    **{name: {"latent": 4, "width": 8, "hidden": (8,)} for name in ("cvae", "bom", "pose-knows", "rhp")},
    "mt-vae": {"latent": 4, "width": 8},
    "bom-parts": {"width": 8, "blocks": 1, "coefficients": 4},
    **{
        name: {"latent": 4, "width": 8, "hidden": (8,), "modes": 3, "sampler_width": 8, "sampler_hidden": (8,)}
        for name in ("dlow", "dsf")
    },
}


def without(clips, **joints):
    """Clips whose joints are NaN in some frames."""
    found = []
    for clip in clips:
        positions = clip.positions.copy()
        for name, frames in joints.items():
            positions[frames, WALKER.names.index(name)] = np.nan
        found.append(Clip(clip.split, clip.name, positions, clip.labels))
    return MotionSet(found, WALKER, "some", missing=True)


# ------------------------------------------------------------------------------------------------------ sets and files


def test_missing_joints_are_refused_unless_they_are_allowed():
    clips = list(GAPS)
    with pytest.raises(ValueError, match=r"has NaN or infinite positions.*missing=True \(--missing\) keeps the clip"):
        MotionSet(clips, WALKER)
    assert MotionSet(clips, WALKER, missing=True).fingerprint() == GAPS.fingerprint()


@pytest.mark.parametrize(
    ("value", "message"),
    [(np.inf, "has infinite positions"), (np.nan, "has no joint that is observed in any of its 90 frames")],
)
def test_what_is_no_gap_is_refused(value, message):
    clip = Clip("a", "b", np.full_like(PEOPLE.clips[0].positions, value))
    with pytest.raises(ValueError, match=message):
        MotionSet([clip], WALKER, missing=True)


@pytest.mark.parametrize("format", ["csv", "npz"])
def test_gaps_are_read_from_a_folder_and_an_archive(tmp_path, format):
    path = tmp_path / ("clips" if format == "csv" else "clips.npz")
    motion.write_motion(path, GAPS, format)
    with pytest.raises(ValueError, match=r"NaN.*missing=True"):
        motion.read_motion(path, skeleton=WALKER)
    for onto in (None, WALKER):
        found = motion.read_motion(path, skeleton=WALKER, missing=True, onto=onto)
        assert found.missing
        for clip in GAPS:
            there = next(other for other in found if other.key == clip.key).positions
            assert np.array_equal(np.isnan(there), np.isnan(clip.positions))
            np.testing.assert_allclose(there, clip.positions, atol=1e-5)


def test_gaps_stay_where_motion_is_resampled_or_divided():
    whole, half = GAPS.divided(0.3), GAPS.resampled(WALKER.fps / 2)
    assert whole.missing
    assert half.missing
    assert sum(np.isnan(clip.positions).sum() for clip in whole) == sum(np.isnan(clip.positions).sum() for clip in GAPS)
    doubled = GAPS.resampled(2 * WALKER.fps)  # its even frames are those that were there
    for clip, slow, fast in zip(GAPS, half, doubled, strict=True):
        np.testing.assert_array_equal(slow.positions, clip.positions[::2])
        np.testing.assert_array_equal(fast.positions[::2], clip.positions)


def test_turns_of_joints_need_whole_bodies(tmp_path):
    needs = "has missing joints, so its rotations are not known"
    turned = replace(motion.PROTOCOLS["simulated"], representation="6d")
    for call in (GAPS.with_rotations, lambda: motion.windows(GAPS, turned, "train")):
        with pytest.raises(ValueError, match=needs):
            call()
    quaternions = motion.MotionData("simulated", GAPS, replace(turned, representation="quaternion"))
    with pytest.raises(ValueError, match=f"{needs}; .* fill its gaps first"):
        dvae.method("mix-and-match").build(quaternions.windows("train"))
    found = replace(PEOPLE.with_rotations(), missing=True)
    batch = motion.windows(found, turned, "test").all()
    with pytest.raises(ValueError, match="leaves the rotations of others undetermined"):
        motion.windows(found, turned, "test").schema.view(batch | {"mask": {"x": batch["mask"]}})
    for format in ("bvh", "amass"):
        with pytest.raises(
            ValueError, match=f"has missing joints, but {format} has no gaps; fill them first.*or write npz"
        ):
            motion.write_motion(tmp_path / "folder", GAPS, format)


def _future_with_gaps():
    """Forecasts, what was observed of them, and the truth."""
    clip, gaps = PEOPLE.clips[0].positions, without(PEOPLE, LElbow=slice(3, 30), RKnee=slice(25, 40)).clips[0].positions
    return clip[None, None, 10:40], gaps[None, :10], gaps[None, 10:40]


@pytest.mark.parametrize(("share", "length"), [(0.2, 15.0), (0.5, 4.0)])
def test_bursts_have_their_share_and_length(share, length):
    """Of F independent chains, within five standard errors: a burst has a variance of length (length - 1)."""
    still = np.broadcast_to(PEOPLE.clips[0].positions[:1], (20_000, WALKER.joints, 3))
    (clip,) = motion.occlude(MotionSet([Clip("a", "b", still)], WALKER), share, length, seed=3)
    hidden = np.isnan(clip.positions).any(2)
    assert not hidden[:, WALKER.root].any()
    hidden = np.delete(hidden, WALKER.root, 1)
    begins = np.diff(hidden.astype(int), axis=0) == 1
    count = begins.sum()
    assert abs(hidden.sum() / count - length) < 5 * length / count**0.5
    cycle = length / share
    assert abs(hidden.mean() - share) < 5 * (1 - share) * length / cycle * (2 / count) ** 0.5


# -------------------------------------------------------------------------------------------------------------- windows


@pytest.mark.parametrize("name", ["simulated", "simulated-trajectories", "turned"])
def test_windows_say_what_was_observed_and_hide_the_rest(name):
    """Where it was, they are the windows of the whole motion; of each joint all three coordinates or none."""
    protocol = motion.PROTOCOLS[name.replace("turned", "simulated")]
    protocol = motion.Protocol(**{**vars(protocol), "heading": name == "turned", "rotate": False})
    whole, some = (motion.windows(each, protocol, "train").all() for each in (PEOPLE, GAPS))
    mask = some["mask"]
    assert 0.7 < mask.float().mean() < 0.95
    assert torch.equal(mask.unflatten(-1, (-1, 3)).any(-1), mask.unflatten(-1, (-1, 3)).all(-1))
    assert (some["x"][~mask] == 0).all()
    if name != "turned":
        assert torch.equal(some["x"][mask], whole["x"][mask])
    drawn = motion.windows(GAPS, protocol, "train").sample(5, torch.Generator().manual_seed(0))
    assert drawn["x"].isfinite().all()
    assert drawn["mask"].shape == drawn["x"].shape


@pytest.mark.parametrize("unseen", [15, 10])  # frames of each clip in which no left side is, all of the past or not
def test_the_future_does_not_turn_the_past(unseen):
    lacking = without(PEOPLE, LHip=slice(unseen), LShoulder=slice(unseen))
    turned = [np.concatenate([c.positions[:15], c.positions[15:] * [-1, 1, -1]]) for c in lacking]
    other = [replace(clip, positions=positions) for clip, positions in zip(lacking, turned, strict=True)]
    protocol = replace(motion.PROTOCOLS["simulated"], heading=True, train_stride=90)  # windows at the first frames
    pasts = [
        motion.windows(MotionSet(clips, WALKER, missing=True), protocol, "train").all()["x"][:, :15]
        for clips in (lacking.clips, other)
    ]
    torch.testing.assert_close(*pasts)
    plain = motion.windows(lacking, replace(protocol, heading=False), "train").all()["x"][:, :15]
    assert torch.equal(pasts[0], plain) == (unseen == 15)


def test_listed_windows_have_something_before_and_after_the_present():
    some = without(PEOPLE, Pelvis=slice(0, 18))
    windows = motion.windows(some, motion.PROTOCOLS["simulated"], "train")
    assert {start for _, _, start in windows.keys} == {5, 10, 15}  # 15 frames from 5 on end at 19
    assert len(windows.all()["x"]) == len(windows.keys) == len(windows)
    with pytest.raises(ValueError, match="no window with the root and another joint"):
        motion.windows(without(PEOPLE, Pelvis=slice(None)), motion.PROTOCOLS["simulated"], "train")


# ----------------------------------------------------------------------------------------- references, scores, energies


def test_zero_velocity_stays_where_joints_were_last():
    x, mask = torch.randn(2, 5, 3), torch.ones(2, 5, 3, dtype=torch.bool)
    mask[0, 3:, 1] = mask[1, :, 2] = False
    found = last_value(torch.where(mask, x, torch.nan), 4, mask)
    assert torch.equal(found[0, :, 0], found[0, :, 3])
    assert torch.equal(found[0, 0, 0], torch.stack([x[0, 4, 0], x[0, 2, 1], x[0, 4, 2]]))
    assert found[0, 1, 0, 2] == 0


def test_distances_are_over_what_both_have():
    first, second = torch.randn(5, 6) + 100, torch.randn(4, 6) + 100
    seen, also = torch.rand(5, 6) < 0.6, torch.rand(4, 6) < 0.6
    seen[0], also[0] = torch.tensor([1, 1, 1, 0, 0, 0]), torch.tensor([0, 0, 0, 1, 1, 1])
    found = distances(torch.where(seen, first, torch.nan), second, seen.bool(), also.bool())
    assert found[0, 0] == torch.inf
    for n in range(5):
        for m in range(4):
            both = seen[n].bool() & also[m].bool()
            if both.any():
                expected = ((first[n] - second[m])[both].square().mean() * 6).sqrt()
                torch.testing.assert_close(found[n, m], expected, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(distances(first, second, torch.ones(5, 6).bool()), torch.cdist(first, second))


SCORES = [
    errors.average_displacement_error,
    errors.final_displacement_error,
    errors.median_average_displacement_error,
    errors.median_final_displacement_error,
    metrics.energy_score,
    metrics.continuous_ranked_probability_score,
    metrics.variogram_score,
]
SEVERAL = [
    errors.multimodal_average_displacement_error,
    errors.multimodal_final_displacement_error,
    errors.median_multimodal_average_displacement_error,
    errors.median_multimodal_final_displacement_error,
]


@pytest.mark.parametrize("score", [*SCORES, *SEVERAL])
def test_scores_are_of_what_was_observed(score):
    """A coordinate that was never observed, or a frame of which nothing was, might as well not be there."""
    several = (3,) if score in SEVERAL else ()
    samples, truth = torch.randn(2, 4, 6, 5).double(), torch.randn(2, *several, 6, 5).double()
    gaps = truth.clone()
    gaps[..., 2, :], gaps[..., 3] = torch.nan, torch.nan
    kept, coordinates = [0, 1, 3, 4, 5], [0, 1, 2, 4]
    torch.testing.assert_close(
        score(samples, gaps), score(samples[..., kept, :][..., coordinates], truth[..., kept, :][..., coordinates])
    )


def test_a_diversity_with_gaps_is_that_of_what_pairs_share():
    """Futures that lie equally far apart in all numbers have the same diversity, whatever is missing."""
    samples, truths = torch.randn(4, 6, 5).double(), torch.arange(3.0).double()[:, None, None].expand(3, 6, 5)
    gaps = torch.where(torch.rand(3, 6, 5) < 0.7, truths, torch.nan)
    found = errors.average_pairwise_distance_error(samples, gaps)
    torch.testing.assert_close(found, errors.average_pairwise_distance_error(samples, truths))
    gaps[0], gaps[1:, 0] = torch.nan, truths[1:, 0]
    gaps[1, 1:], gaps[2] = torch.nan, torch.nan
    assert errors.average_pairwise_distance_error(samples, gaps).isnan()  # no two share anything


def test_what_is_forecast_in_gaps_changes_no_score_and_the_truth_errs_in_nothing():
    whole, windows = (motion.windows(each, motion.PROTOCOLS["simulated"], "test") for each in (PEOPLE, GAPS))
    observed, x, index = windows.protocol.observed, windows.all().mask_to_nan(), torch.arange(len(windows))
    past, truth, clips = windows.all().past(observed), x[:, observed:], clip_index(windows.keys)
    forecasts, real = torch.randn(len(x), 3, *truth.shape[1:]), whole.all()["x"][:, None, observed:]
    anywhere = torch.where(truth[:, None].isnan(), 9.0, forecasts)
    measures = {measure.name: measure for measure in motion.scores(windows)}
    assert measures.keys() == {measure.name for measure in motion.scores(whole)}
    for name in ("ADE", "FDE", "jerk", "CMD"):
        found, other = (measures[name].function(each, truth, past, index) for each in (forecasts, anywhere))
        if name == "CMD":
            found, other = (torch.as_tensor(measures[name].pool(each, clips)) for each in (found, other))
        assert torch.equal(other, found), name
    for name in ("ADE", "FDE", "bone-length error", *(name for name in measures if name.startswith("limb"))):
        within = 0.1 if "angle" in name else 1e-4
        assert measures[name].function(real, truth, past, index).abs().max() < within, name


def test_statistics_are_of_what_was_observed():
    """A coordinate that was never observed might as well not be there; of bodies, a bone or the last frames."""
    x = torch.randn(3, 20, 4).cumsum(1).double()
    gaps = x.clone()
    gaps[..., 2] = torch.nan
    for statistic in STATISTICS.values():
        torch.testing.assert_close(statistic.function(gaps), statistic.function(x[..., [0, 1, 3]]))
    windows = motion.windows(PEOPLE, motion.PROTOCOLS["simulated"], "test")
    x, head = windows.all()["x"], WALKER.find("Head")  # an end, so that one bone goes with it
    gaps = x.clone()
    gaps[:, 60:], gaps[..., 3 * head - 3 : 3 * head] = torch.nan, torch.nan
    found = {name: statistic.function(gaps) for name, statistic in motion.statistics(windows).items()}
    kept = [n for n, (_, child) in enumerate(WALKER.edges) if child != head]
    lengths = WALKER.bone_lengths(windows.positions(x[:, :60]))[..., kept]
    torch.testing.assert_close(found["bone length"], lengths.mean((1, 2)))
    assert all(value.isfinite().all() for value in found.values())


def test_what_needs_whole_bodies_says_what_to_do():
    windows = motion.windows(GAPS, motion.PROTOCOLS["simulated"], "test")
    with pytest.raises(
        ValueError, match=r"features of whole futures, but these windows have missing joints.*dvae impute"
    ):
        motion.scores(windows, classifiers={"content": None})
    told = motion.windows(GAPS, motion.PROTOCOLS["simulated-trajectories"], "test").given(["LWrist"])
    with pytest.raises(
        ValueError, match=r"only whole poses can be exchanged, but these windows may have missing joints.*dvae impute"
    ):
        motion.ExchangedWindows(told)
    data, method = small("trajevae")
    pose = GAPS.clips[0].positions[np.isnan(GAPS.clips[0].positions).any((1, 2))][0]
    with pytest.raises(ValueError, match=r"the initial pose has no positions of .*fill the gaps first") as refused:
        method.build(data.schema).complete(pose, frames=5)
    assert "--missing" not in str(refused.value)
    flow = dvae.method("moglow", width=4, flow_steps=1)
    data = motion.MotionData("simulated", GAPS, motion.PROTOCOLS["simulated"])
    with pytest.raises(ValueError, match=r"hides some entries of a step and not others, .*; hide them together"):
        dvae.fit(flow.build(data.schema), flow.train(data.windows("train"), None, 1), progress=False)


@pytest.mark.parametrize("heading", [True, False])
@pytest.mark.parametrize("root", ["drop", "relative"])
def test_windows_are_put_back_where_they_were(root, heading):
    """Whole poses, turned and moved as windows are, fill the clips; but for the root's own gap, where poses lack it."""
    gaps = without(GAPS, Pelvis=slice(30, 36))
    protocol = replace(motion.PROTOCOLS["simulated"], root=root, heading=heading, test_stride=20)
    windows = motion.windows(gaps, protocol, "test")
    read, true = (
        torch.stack([torch.from_numpy(clips[key[:2]].positions[key[2] :][: windows.length]) for key in windows.keys])
        for clips in (gaps, PEOPLE)
    )
    made = true - (true[:, :, [WALKER.root]] if root == "drop" else true[:, :1, [WALKER.root]])
    if heading:
        angle = WALKER.heading_near(read, protocol.observed - 1)[:, None, None]
        made = motion.rotate_about_up(made, -angle, WALKER.up)
    found = windows.fill_missing(made)
    assert found.missing == any(np.isnan(clip.positions).any() for clip in found)
    covered = max(key[2] for key in windows.keys) + windows.length
    for clip in found:
        true, read = PEOPLE[clip.key].positions, gaps[clip.key].positions
        assert np.array_equal(clip.positions[~np.isnan(read)], read[~np.isnan(read)])
        assert np.array_equal(np.isnan(clip.positions[covered:]), np.isnan(read[covered:]))
        bridge = np.linspace(true[29, WALKER.root], true[36, WALKER.root], 8)[1:-1]
        moved = (bridge - true[30:36, WALKER.root])[:, None] if root == "drop" else 0.0
        expected = np.where(np.isnan(read), true, read)[:covered]
        expected[30:36] += np.where(np.isnan(read[30:36]), moved, 0.0)
        np.testing.assert_allclose(clip.positions[:covered], expected, atol=1e-5)


def test_energies_are_of_what_was_observed():
    samples, truth = torch.randn(3, 2, 6, 48).double(), torch.randn(2, 6, 48).double()
    seen = torch.rand(2, 6, 48) < 0.8
    gaps = torch.where(seen, truth, torch.nan)
    errors = torch.where(seen, samples - truth, 0.0).square()
    torch.testing.assert_close(energies.best_of_many(samples, gaps), errors.sum((2, 3)).amin(0))
    torch.testing.assert_close(energies.history_error(samples, gaps), errors.sum(3).mean((0, 2)))
    joint = 3 * (WALKER.names.index("LElbow") - 1)
    pose = truth[:, 0].clone()
    pose[:, joint : joint + 3] = torch.nan
    kept = [n for n, edge in enumerate(WALKER.edges) if WALKER.names.index("LElbow") not in edge]
    lengths, own = (WALKER.limbs(each).norm(dim=-1) for each in (samples, truth[:, 0]))
    expected = (lengths - own[:, None]).square()[..., kept].sum(3).mean((0, 2))
    torch.testing.assert_close(energies.limb_length(samples, pose, WALKER), expected)


# -------------------------------------------------------------------------------------------------------- every method


def small(name):
    kind = dvae.methods()[name]
    protocol = motion.PROTOCOLS["simulated-trajectories" if issubclass(kind, TrajectoryMethod) else "simulated"]
    protocol = replace(protocol, predicted=12, observed=min(protocol.observed, 6), train_stride=15)
    data = motion.MotionData("simulated", GAPS, protocol)
    own = {"latent": 4, "warm_up": 1} | ({"width": 8} if name == "equations" else {})
    options = SMALL.get(name, {"width": 4} if name == "autoregressive" else own)
    return data, dvae.method(name, **options).resolve_defaults(data.windows("train"))


@pytest.mark.parametrize("name", [name for name in METHODS if name not in ("mix-and-match", "motion-latent", "moglow")])
def test_every_method_goes_the_whole_way_with_gaps(name):
    """Fitted, validated, scored; and whatever stands where nothing was observed changes nothing."""
    data, method = small(name)
    train, validation, test = map(data.windows, ("train", "validation", "test"))
    torch.manual_seed(0)
    model, recipe = method.build(data.schema), method.train(train, validation, 1)
    dvae.fit(model, recipe, steps=1, batch_size=3, validate_every=1, progress=False)
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
    scores = dvae.evaluate(model, test, scores=motion.displacements, samples=2, training_windows=train, progress=False)
    assert all(np.isfinite(score.mean) for score in scores["model"].values())
    assert scores.data["seen"]["future"] == test.all()["mask"][:, data.protocol.observed :].double().mean()

    drawn, objective = recipe.batches.sample(3, torch.Generator().manual_seed(1)), recipe.objective
    present, drawing = data.protocol.observed, {"draws": objective.draws} if objective.draws else {}
    results = []
    for hidden in (0.0, 7.0, torch.nan):
        batch = {**drawn, "x": torch.where(drawn["mask"], drawn["x"], hidden)}
        past = {"x": batch["x"][:, :present], "mask": batch["mask"][:, :present]}
        model.zero_grad()
        torch.manual_seed(2)
        loss = objective(dvae.SequenceELBO().terms(model.eval(), batch, **drawing), 0)
        loss.backward()
        slopes = [p.grad.clone() for p in model.parameters() if p.grad is not None]
        results.append([loss.detach(), *slopes, model.forecast(past, 5, 2)["x"]])
        whole = {n: value for n, value in batch.items() if n not in ("pseudo", "valid")}
        results[-1].append(filled := model.impute(whole, 2)["x"])
        assert torch.equal(filled[:, drawn["mask"]], batch["x"][drawn["mask"]].expand(2, -1))
    assert all(value.isfinite().all() for value in results[0])
    assert any(slope.any() for slope in results[0][1:-2])
    for other in results[1:]:
        assert all(torch.equal(here, there) for here, there in zip(results[0], other, strict=True))


def still_gsps():
    """A model of GSPS, and windows in which all joints rest."""
    data, method = small("gsps")
    torch.manual_seed(0)
    model, x = method.build(data.schema).eval(), data.windows("test").all()["x"][:4]
    return model, x[:, :1].expand_as(x).clone()


def test_gsps_fills_gaps_by_what_comes_near_to_all_that_was_seen():
    """Of many motions of the model, that of which all but some frames of a joint was seen, if for a drift in time."""
    model, x = still_gsps()
    batch, gap = {"x": x, "mask": torch.ones_like(x).bool()}, slice(model.frames + 2, model.frames + 9)
    torch.manual_seed(2)
    made = model.reconstruct(batch, 4)["x"]
    batch["mask"][:, gap, 9:12] = False
    drift = 1e-4 * torch.arange(model.length - model.frames)[:, None]
    for future in made[:, :, model.frames :] + drift:
        true = torch.cat([x[:, : model.frames], future], 1)
        torch.manual_seed(2)
        filled = model.impute({**batch, "x": torch.where(batch["mask"], true, torch.nan)}, 1)["x"][0]
        torch.testing.assert_close(filled, true)
    with pytest.raises(ValueError, match="gsps fills gaps in windows of 18 frames, not 12"):
        model.impute({name: value[:, :12] for name, value in batch.items()})


# ------------------------------------------------------------------------------------------------------- what is shown


def test_players_have_gaps():
    """A joint that is missing is nowhere; all others are where they are in whole motion."""
    samples, observed, truth = (each[:, 0] if each.ndim == 5 else each[0] for each in _future_with_gaps())
    stage = make_scene(WALKER, observed, samples, truth, every=1)
    gaps = np.isnan(np.concatenate([observed, truth])).any(-1)
    assert np.array_equal(np.isnan(stage.motion[0]).any(-1), gaps)
    scene = _scene(stage)
    planes = np.frombuffer(zlib.decompress(base64.b64decode(scene["packed"])), np.uint8).reshape(2, -1).astype(np.int32)
    steps = (planes[0] | planes[1] << 8).reshape(-1, WALKER.joints, 3)
    assert [person["frames"] for person in scene["people"]] == [30, 30]
    person = np.cumsum(steps[:40], 0).astype(np.int16)
    assert np.array_equal((person == MISSING).any(-1), gaps)
    np.testing.assert_allclose(scene["unit"] * person[~gaps], stage.motion[0][~gaps], atol=0.51 * scene["unit"])
    with pytest.raises(ValueError, match="NaN"):
        make_scene(WALKER, observed, truth[None])


# ----------------------------------------------------------------------------------------------------- the command line


QUICK = ["--steps", "1", "--batch-size", "2", "--warm-up", "1"]


def test_every_command_that_reads_motion_takes_gaps_the_same_way():
    for name in COMMANDS:
        hints = get_type_hints(command(name.split()), include_extras=True)
        if "source" in hints and is_dataclass(hints["source"]):
            hints |= get_type_hints(hints["source"], include_extras=True)
        reads = {"data", "files"} & hints.keys() and name != "resume"
        assert (hints.get("missing") in (Missing, Expert[Missing])) == bool(reads), name


@pytest.fixture(scope="module")
def gaps(tmp_path_factory):
    path = tmp_path_factory.mktemp("gaps") / "gaps.npz"
    motion.save(path, GAPS)
    return str(path)


@pytest.fixture(scope="module")
def fitted(gaps, tmp_path_factory):
    """A run on motion with gaps."""
    run = str(tmp_path_factory.mktemp("runs") / "run")
    assert main(["fit", "vae", "--data", gaps, "--missing", "--out", run, "--protocol", "simulated", *QUICK]) == 0
    return run


def test_commands_forecast_show_and_fill_motion_with_gaps(fitted, tmp_path):
    assert json.loads(Path(fitted, "config.json").read_text())["data"]["missing"] is True
    futures, page, filled = (str(tmp_path / name) for name in ("f.npz", "r.html", "i.npz"))
    assert main(["forecast", fitted, "--out", futures, "--samples", "2"]) == 0
    found = motion.Forecasts.load(futures)
    assert np.isnan(found.truth).any()
    assert np.isfinite(found.forecasts).all()
    assert main(["animate", futures, "--out", str(tmp_path / "f.html")]) == 0
    few = ["--windows", "1", "--samples", "2", "--bound-windows", "2", "--particles", "2"]
    assert main(["report", fitted, "--out", page, *few]) == 0
    assert "cannot be shown" not in Path(page).read_text()

    clip = GAPS.clips[-1]
    assert main(["impute", fitted, "--out", filled, "--clip", clip.name, "--samples", "3"]) == 0
    with np.load(filled) as file:
        found = dict(file)
    there = ~np.isnan(clip.positions).any(-1)
    assert np.array_equal(found["observed"][0], there)
    relative = clip.positions - clip.positions[:, [WALKER.root]]
    np.testing.assert_array_equal(found["filled"][1, 0][there], relative[there])
    assert (found["spread"][0][there] == 0).all()
    spread = found["filled"].var(0).sum(-1) ** 0.5
    np.testing.assert_allclose(found["spread"][~found["observed"]], spread[~found["observed"]], rtol=1e-5)


def test_gaps_are_filled_in_the_motion_itself(fitted, tmp_path, capsys):
    impute = ["impute", fitted, "--samples", "1"]
    assert main([*impute, "--filled", str(tmp_path / "all.npz")]) == 0
    whole = motion.read_motion(tmp_path / "all.npz", missing=True)
    assert {each.key for each in whole} == {each.key for each in GAPS if each.split == "test"}
    for each in whole:
        read = GAPS[each.key].positions
        assert np.array_equal(each.positions[~np.isnan(read)], read[~np.isnan(read)])
        assert np.isfinite(each.positions[:75]).all()
    clip, one = GAPS.clips[-1], tmp_path / "one.bvh"
    assert main([*impute, "--clip", clip.name, "--filled", str(one)]) == 0
    bvh = motion.read_motion(one, metres=0.01)  # bones are as long as a model of one step has them
    assert (bvh.clips[0].frames, bvh.skeleton.fps) == (clip.frames, WALKER.fps)
    capsys.readouterr()
    for arguments, message in (
        (["--filled", str(tmp_path / "all.bvh")], "can contain one of"),
        (["--particles", "2", "--out", str(tmp_path / "i.npz")], "--particles chooses among fillings of tables"),
        ([], "name it with --out or --filled"),
    ):
        assert main([*impute, *arguments]) == 2
        assert message in capsys.readouterr().err


def test_a_run_is_scored_and_shown_on_other_motion_with_gaps(gaps, tmp_path, capsys):
    run, other, few = str(tmp_path / "run"), ["--data", gaps, "--missing"], ["--samples", "2"]
    assert main(["fit", "vae", "--data", "simulated", *QUICK, "--out", run]) == 0
    forecast = ["forecast", run, "--out", str(tmp_path / "f.npz"), *few]
    assert main([*forecast, *other[:2]]) == 1
    assert main([*forecast, *other]) == 0
    assert main([*forecast, "--missing"]) == 2
    assert "--missing is for other data" in capsys.readouterr().err
    assert main(["evaluate", run, *other, *few, "--log-score-particles", "2", "--out", str(tmp_path / "e.json")]) == 0
    assert np.isfinite(json.loads((tmp_path / "e.json").read_text())["summary"]["vae"]["log score"]["mean"])
