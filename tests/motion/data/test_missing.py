"""Motion with missing joints: reading, windows, representations, fitting, forecasts, scores and imputation."""

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
from dvae.inference.evaluation.evaluation_windows import cluster_index
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
    "csdi": {"width": 8, "heads_count": 2, "layers": 1, "sampler_steps": 2},
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
    """Return clips whose joints are NaN in some frames."""
    clips_with_gaps = []
    for clip in clips:
        positions = clip.positions.copy()
        for name, frames in joints.items():
            positions[frames, WALKER.names.index(name)] = np.nan
        clips_with_gaps.append(Clip(clip.split, clip.name, positions, clip.labels))
    return MotionSet(clips_with_gaps, WALKER, "some", missing=True)


# ------------------------------------------------------------------------------------------------------ sets and files


def test_missing_joints_are_errors_unless_allowed():
    clips = list(GAPS)
    with pytest.raises(ValueError, match=r"has NaN or infinite positions.*missing=True \(--missing\) keeps the clip"):
        MotionSet(clips, WALKER)
    assert MotionSet(clips, WALKER, missing=True).fingerprint() == GAPS.fingerprint()


@pytest.mark.parametrize(
    ("value", "message"),
    [(np.inf, "has infinite positions"), (np.nan, "has no joint that is observed in any of its 90 frames")],
)
def test_other_invalid_positions_are_errors(value, message):
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
        loaded = motion.read_motion(path, skeleton=WALKER, missing=True, onto=onto)
        assert loaded.missing
        for clip in GAPS:
            loaded_positions = next(other for other in loaded if other.key == clip.key).positions
            assert np.array_equal(np.isnan(loaded_positions), np.isnan(clip.positions))
            np.testing.assert_allclose(loaded_positions, clip.positions, atol=1e-5)


def test_resampling_and_dividing_keep_missing_values():
    parts, half = GAPS.assign_splits(0.3), GAPS.resample(WALKER.fps / 2)
    assert parts.missing
    assert half.missing
    assert sum(np.isnan(clip.positions).sum() for clip in parts) == sum(np.isnan(clip.positions).sum() for clip in GAPS)
    doubled = GAPS.resample(2 * WALKER.fps)  # its even frames are the original ones
    for clip, slow, fast in zip(GAPS, half, doubled, strict=True):
        np.testing.assert_array_equal(slow.positions, clip.positions[::2])
        np.testing.assert_array_equal(fast.positions[::2], clip.positions)


def test_rotations_require_complete_bodies(tmp_path):
    needs = "has missing joints, so rotations cannot be computed"
    protocol = replace(motion.PROTOCOLS["simulated"], representation="6d")
    for call in (GAPS.with_rotations, lambda: motion.windows(GAPS, protocol, "train")):
        with pytest.raises(ValueError, match=needs):
            call()
    quaternions = motion.MotionData("simulated", GAPS, replace(protocol, representation="quaternion"))
    with pytest.raises(ValueError, match=f"{needs}; .* fill in the missing joints first"):
        dvae.method("mix-and-match").build(quaternions.windows("train"))
    people = replace(PEOPLE.with_rotations(), missing=True)
    batch = motion.windows(people, protocol, "test").all()
    with pytest.raises(ValueError, match="leaves the rotations of others undetermined"):
        motion.windows(people, protocol, "test").schema.view(batch | {"mask": {"x": batch["mask"]}})
    for format in ("bvh", "amass"):
        with pytest.raises(
            ValueError, match=f"has missing joints, which {format} cannot represent; fill them in first.*or write npz"
        ):
            motion.write_motion(tmp_path / "folder", GAPS, format)


def _future_with_gaps():
    """Return forecasts, the observed past, and the truth."""
    clip, gaps = PEOPLE.clips[0].positions, without(PEOPLE, LElbow=slice(3, 30), RKnee=slice(25, 40)).clips[0].positions
    return clip[None, None, 10:40], gaps[None, :10], gaps[None, 10:40]


@pytest.mark.parametrize(("share", "length"), [(0.2, 15.0), (0.5, 4.0)])
def test_bursts_have_their_share_and_length(share, length):
    """Test F independent chains within five standard errors; the variance of a burst is length (length - 1)."""
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
def test_windows_have_masks_and_zeros_at_missing_values(name):
    """Observed values equal the values of complete motion; a joint has all three coordinates or none."""
    protocol = motion.PROTOCOLS[name.replace("turned", "simulated")]
    protocol = motion.Protocol(**{**vars(protocol), "heading": name == "turned", "rotate": False})
    complete, incomplete = (motion.windows(each, protocol, "train").all() for each in (PEOPLE, GAPS))
    mask = incomplete["mask"]
    assert 0.7 < mask.float().mean() < 0.95
    assert torch.equal(mask.unflatten(-1, (-1, 3)).any(-1), mask.unflatten(-1, (-1, 3)).all(-1))
    assert (incomplete["x"][~mask] == 0).all()
    if name != "turned":
        assert torch.equal(incomplete["x"][mask], complete["x"][mask])
    sampled = motion.windows(GAPS, protocol, "train").sample(5, torch.Generator().manual_seed(0))
    assert sampled["x"].isfinite().all()
    assert sampled["mask"].shape == sampled["x"].shape


@pytest.mark.parametrize("unseen", [15, 10])  # frames without a left side: the whole past, or part of it
def test_the_heading_of_the_past_ignores_the_future(unseen):
    incomplete = without(PEOPLE, LHip=slice(unseen), LShoulder=slice(unseen))
    positions_by_clip = [np.concatenate([c.positions[:15], c.positions[15:] * [-1, 1, -1]]) for c in incomplete]
    other = [replace(clip, positions=positions) for clip, positions in zip(incomplete, positions_by_clip, strict=True)]
    protocol = replace(motion.PROTOCOLS["simulated"], heading=True, train_stride=90)  # windows at the first frames
    pasts = [
        motion.windows(MotionSet(clips, WALKER, missing=True), protocol, "train").all()["x"][:, :15]
        for clips in (incomplete.clips, other)
    ]
    torch.testing.assert_close(*pasts)
    plain = motion.windows(incomplete, replace(protocol, heading=False), "train").all()["x"][:, :15]
    assert torch.equal(pasts[0], plain) == (unseen == 15)


def test_listed_windows_have_observations_in_past_and_future():
    some = without(PEOPLE, Pelvis=slice(0, 18))
    windows = motion.windows(some, motion.PROTOCOLS["simulated"], "train")
    assert {start for _, _, start in windows.keys} == {5, 10, 15}  # 15 frames from 5 on end at 19
    assert len(windows.all()["x"]) == len(windows.keys) == len(windows)
    with pytest.raises(ValueError, match="no usable window: the root and another joint"):
        motion.windows(without(PEOPLE, Pelvis=slice(None)), motion.PROTOCOLS["simulated"], "train")


# ----------------------------------------------------------------------------------------- references, scores, energies


def test_zero_velocity_repeats_the_last_observed_positions():
    x, mask = torch.randn(2, 5, 3), torch.ones(2, 5, 3, dtype=torch.bool)
    mask[0, 3:, 1] = mask[1, :, 2] = False
    forecast = last_value(torch.where(mask, x, torch.nan), 4, mask)
    assert torch.equal(forecast[0, :, 0], forecast[0, :, 3])
    assert torch.equal(forecast[0, 0, 0], torch.stack([x[0, 4, 0], x[0, 2, 1], x[0, 4, 2]]))
    assert forecast[0, 1, 0, 2] == 0


def test_distances_use_entries_observed_in_both():
    first, second = torch.randn(5, 6) + 100, torch.randn(4, 6) + 100
    first_mask, second_mask = torch.rand(5, 6) < 0.6, torch.rand(4, 6) < 0.6
    first_mask[0], second_mask[0] = torch.tensor([1, 1, 1, 0, 0, 0]), torch.tensor([0, 0, 0, 1, 1, 1])
    result = distances(torch.where(first_mask, first, torch.nan), second, first_mask.bool(), second_mask.bool())
    assert result[0, 0] == torch.inf
    for n in range(5):
        for m in range(4):
            both = first_mask[n].bool() & second_mask[m].bool()
            if both.any():
                expected = ((first[n] - second[m])[both].square().mean() * 6).sqrt()
                torch.testing.assert_close(result[n, m], expected, atol=1e-4, rtol=1e-4)
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
def test_scores_use_observed_values_only(score):
    """Removing coordinates or frames without observations changes no score."""
    several = (3,) if score in SEVERAL else ()
    samples, truth = torch.randn(2, 4, 6, 5).double(), torch.randn(2, *several, 6, 5).double()
    gaps = truth.clone()
    gaps[..., 2, :], gaps[..., 3] = torch.nan, torch.nan
    rows, coordinates = [0, 1, 3, 4, 5], [0, 1, 2, 4]
    torch.testing.assert_close(
        score(samples, gaps), score(samples[..., rows, :][..., coordinates], truth[..., rows, :][..., coordinates])
    )


def test_diversity_uses_numbers_observed_in_both_futures():
    """Futures with the same distance in each number have the same diversity for all missing values."""
    samples, truths = torch.randn(4, 6, 5).double(), torch.arange(3.0).double()[:, None, None].expand(3, 6, 5)
    gaps = torch.where(torch.rand(3, 6, 5) < 0.7, truths, torch.nan)
    diversity = errors.average_pairwise_distance_error(samples, gaps)
    torch.testing.assert_close(diversity, errors.average_pairwise_distance_error(samples, truths))
    gaps[0], gaps[1:, 0] = torch.nan, truths[1:, 0]
    gaps[1, 1:], gaps[2] = torch.nan, torch.nan
    assert errors.average_pairwise_distance_error(samples, gaps).isnan()  # no two futures have a common observed number


def test_forecasts_at_missing_values_change_no_score_and_the_truth_has_error_zero():
    complete, windows = (motion.windows(each, motion.PROTOCOLS["simulated"], "test") for each in (PEOPLE, GAPS))
    observed, x, index = windows.protocol.observed, windows.all().mask_to_nan(), torch.arange(len(windows))
    past, truth, clips = windows.all().past(observed), x[:, observed:], cluster_index(windows.keys)
    forecasts, real = torch.randn(len(x), 3, *truth.shape[1:]), complete.all()["x"][:, None, observed:]
    anywhere = torch.where(truth[:, None].isnan(), 9.0, forecasts)
    measures = {measure.name: measure for measure in motion.scores(windows)}
    assert measures.keys() == {measure.name for measure in motion.scores(complete)}
    for name in ("ADE", "FDE", "jerk", "CMD"):
        score, other = (measures[name].function(each, truth, past, index) for each in (forecasts, anywhere))
        if name == "CMD":
            score, other = (torch.as_tensor(measures[name].pool(each, clips)) for each in (score, other))
        assert torch.equal(other, score), name
    for name in ("ADE", "FDE", "bone-length error", *(name for name in measures if name.startswith("limb"))):
        within = 0.1 if "angle" in name else 1e-4
        assert measures[name].function(real, truth, past, index).abs().max() < within, name


def test_statistics_use_observed_values_only():
    """Removing coordinates without observations changes no statistic; bodies lose a bone or the last frames."""
    x = torch.randn(3, 20, 4).cumsum(1).double()
    gaps = x.clone()
    gaps[..., 2] = torch.nan
    for statistic in STATISTICS.values():
        torch.testing.assert_close(statistic.function(gaps), statistic.function(x[..., [0, 1, 3]]))
    windows = motion.windows(PEOPLE, motion.PROTOCOLS["simulated"], "test")
    x, head = windows.all()["x"], WALKER.find("Head")  # an end joint, which has one bone
    gaps = x.clone()
    gaps[:, 60:], gaps[..., 3 * head - 3 : 3 * head] = torch.nan, torch.nan
    values = {name: statistic.function(gaps) for name, statistic in motion.statistics(windows).items()}
    bones = [n for n, (_, child) in enumerate(WALKER.edges) if child != head]
    lengths = WALKER.bone_lengths(windows.positions(x[:, :60]))[..., bones]
    torch.testing.assert_close(values["bone length"], lengths.mean((1, 2)))
    assert all(value.isfinite().all() for value in values.values())


def test_operations_on_complete_bodies_raise_errors_with_advice():
    windows = motion.windows(GAPS, motion.PROTOCOLS["simulated"], "test")
    with pytest.raises(
        ValueError, match=r"features of whole futures, but these windows have missing joints.*dvae impute"
    ):
        motion.scores(windows, classifiers={"content": None})
    with_paths = motion.windows(GAPS, motion.PROTOCOLS["simulated-trajectories"], "test").given(["LWrist"])
    with pytest.raises(
        ValueError, match=r"only whole poses can be exchanged, but these windows may have missing joints.*dvae impute"
    ):
        motion.ExchangedWindows(with_paths)
    data, method = small("trajevae")
    pose = GAPS.clips[0].positions[np.isnan(GAPS.clips[0].positions).any((1, 2))][0]
    with pytest.raises(ValueError, match=r"the initial pose has no positions of .*fill them in first") as error:
        method.build(data.schema).complete(pose, frames=5)
    assert "--missing" not in str(error.value)
    flow = dvae.method("moglow", width=4, flow_steps=1)
    data = motion.MotionData("simulated", GAPS, motion.PROTOCOLS["simulated"])
    with pytest.raises(ValueError, match=r"hides some entries of a step and not others, .*; hide all of these or none"):
        dvae.fit(flow.build(data.schema), flow.train(data.windows("train"), None, 1), progress=False)


@pytest.mark.parametrize("heading", [True, False])
@pytest.mark.parametrize("root", ["drop", "relative"])
def test_filled_windows_return_to_their_positions_in_clips(root, heading):
    """Complete poses in window coordinates fill the clips, except where the root is missing and poses drop it."""
    gaps = without(GAPS, Pelvis=slice(30, 36))
    protocol = replace(motion.PROTOCOLS["simulated"], root=root, heading=heading, test_stride=20)
    windows = motion.windows(gaps, protocol, "test")
    observed, true = (
        torch.stack([torch.from_numpy(clips[key[:2]].positions[key[2] :][: windows.length]) for key in windows.keys])
        for clips in (gaps, PEOPLE)
    )
    poses = true - (true[:, :, [WALKER.root]] if root == "drop" else true[:, :1, [WALKER.root]])
    if heading:
        angle = WALKER.heading_near(observed, protocol.observed - 1)[:, None, None]
        poses = motion.rotate_about_up(poses, -angle, WALKER.up)
    filled = windows.fill_missing(poses)
    assert filled.missing == any(np.isnan(clip.positions).any() for clip in filled)
    covered = max(key[2] for key in windows.keys) + windows.length
    for clip in filled:
        true, observed = PEOPLE[clip.key].positions, gaps[clip.key].positions
        assert np.array_equal(clip.positions[~np.isnan(observed)], observed[~np.isnan(observed)])
        assert np.array_equal(np.isnan(clip.positions[covered:]), np.isnan(observed[covered:]))
        bridge = np.linspace(true[29, WALKER.root], true[36, WALKER.root], 8)[1:-1]
        root_error = (bridge - true[30:36, WALKER.root])[:, None] if root == "drop" else 0.0
        expected = np.where(np.isnan(observed), true, observed)[:covered]
        expected[30:36] += np.where(np.isnan(observed[30:36]), root_error, 0.0)
        np.testing.assert_allclose(clip.positions[:covered], expected, atol=1e-5)


def test_energies_use_observed_values_only():
    samples, truth = torch.randn(3, 2, 6, 48).double(), torch.randn(2, 6, 48).double()
    mask = torch.rand(2, 6, 48) < 0.8
    gaps = torch.where(mask, truth, torch.nan)
    errors = torch.where(mask, samples - truth, 0.0).square()
    torch.testing.assert_close(energies.best_of_many(samples, gaps), errors.sum((2, 3)).amin(0))
    torch.testing.assert_close(energies.history_error(samples, gaps), errors.sum(3).mean((0, 2)))
    joint = 3 * (WALKER.names.index("LElbow") - 1)
    pose = truth[:, 0].clone()
    pose[:, joint : joint + 3] = torch.nan
    bones = [n for n, edge in enumerate(WALKER.edges) if WALKER.names.index("LElbow") not in edge]
    lengths, true_lengths = (WALKER.limbs(each).norm(dim=-1) for each in (samples, truth[:, 0]))
    expected = (lengths - true_lengths[:, None]).square()[..., bones].sum(3).mean((0, 2))
    torch.testing.assert_close(energies.limb_length(samples, pose, WALKER), expected)


# -------------------------------------------------------------------------------------------------------- every method


def small(name):
    kind = dvae.methods()[name]
    protocol = motion.PROTOCOLS["simulated-trajectories" if issubclass(kind, TrajectoryMethod) else "simulated"]
    protocol = replace(protocol, predicted=12, observed=min(protocol.observed, 6), train_stride=15)
    data = motion.MotionData("simulated", GAPS, protocol)
    sizes = {"latent": 4, "warm_up": 1} | ({"width": 8} if name == "equations" else {})
    options = SMALL.get(name, {"width": 4} if name == "autoregressive" else sizes)
    return data, dvae.method(name, **options).resolve_defaults(data.windows("train"))


@pytest.mark.parametrize(
    "name",
    [name for name in METHODS if name not in ("mix-and-match", "motion-latent", "moglow", "moglow-paths", "denoiser")],
)
def test_every_method_supports_missing_values(name):
    """Fit, validate and score; the values at missing entries change nothing."""
    data, method = small(name)
    train, validation, test = map(data.windows, ("train", "validation", "test"))
    torch.manual_seed(0)
    model, recipe = method.build(data.schema), method.train(train, validation, 1)
    dvae.fit(model, recipe, steps=1, batch_size=3, validate_every=1, progress=False)
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
    scores = dvae.evaluate(model, test, scores=motion.displacements, samples=2, training_windows=train, progress=False)
    assert all(np.isfinite(score.mean) for score in scores["model"].values())
    assert scores.data["seen"]["future"] == test.all()["mask"][:, data.protocol.observed :].double().mean()

    sampled, objective = recipe.batches.sample(3, torch.Generator().manual_seed(1)), recipe.objective
    present, drawing = data.protocol.observed, {"draws": objective.draws} if objective.draws else {}
    results = []
    for hidden in (0.0, 7.0, torch.nan):
        batch = {**sampled, "x": torch.where(sampled["mask"], sampled["x"], hidden)}
        past = {"x": batch["x"][:, :present], "mask": batch["mask"][:, :present]}
        model.zero_grad()
        torch.manual_seed(2)
        loss = objective(dvae.SequenceELBO().terms(model.eval(), batch, **drawing), 0)
        loss.backward()
        slopes = [p.grad.clone() for p in model.parameters() if p.grad is not None]
        results.append([loss.detach(), *slopes, model.forecast(past, 5, 2)["x"]])
        to_fill = {n: value for n, value in batch.items() if n not in ("pseudo", "valid")}
        results[-1].append(filled := model.impute(to_fill, 2)["x"])
        assert torch.equal(filled[:, sampled["mask"]], batch["x"][sampled["mask"]].expand(2, -1))
    assert all(value.isfinite().all() for value in results[0])
    assert any(slope.any() for slope in results[0][1:-2])
    for other in results[1:]:
        assert all(
            torch.equal(first_value, other_value) for first_value, other_value in zip(results[0], other, strict=True)
        )


def still_gsps():
    """Return a GSPS model, and windows without motion."""
    data, method = small("gsps")
    torch.manual_seed(0)
    model, x = method.build(data.schema).eval(), data.windows("test").all()["x"][:4]
    return model, x[:, :1].expand_as(x).clone()


def test_gsps_fills_gaps_with_the_motion_nearest_to_all_observations():
    """A motion of the model is recovered from all but some frames of one joint, despite a drift in time."""
    model, x = still_gsps()
    batch, gap = {"x": x, "mask": torch.ones_like(x).bool()}, slice(model.frames + 2, model.frames + 9)
    torch.manual_seed(2)
    futures = model.reconstruct(batch, 4)["x"]
    batch["mask"][:, gap, 9:12] = False
    drift = 1e-4 * torch.arange(model.length - model.frames)[:, None]
    for future in futures[:, :, model.frames :] + drift:
        true = torch.cat([x[:, : model.frames], future], 1)
        torch.manual_seed(2)
        filled = model.impute({**batch, "x": torch.where(batch["mask"], true, torch.nan)}, 1)["x"][0]
        torch.testing.assert_close(filled, true)
    with pytest.raises(ValueError, match="gsps imputes windows of 18 frames, got 12"):
        model.impute({name: value[:, :12] for name, value in batch.items()})


# ------------------------------------------------------------------------------------------------------------- players


def test_players_omit_missing_joints():
    """A missing joint has no position; the others have the positions of complete motion."""
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


def test_all_commands_on_motion_have_the_same_option_for_missing_values():
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
    """Return a run on motion with missing joints."""
    run = str(tmp_path_factory.mktemp("runs") / "run")
    assert main(["fit", "vae", "--data", gaps, "--missing", "--out", run, "--protocol", "simulated", *QUICK]) == 0
    return run


def test_commands_forecast_report_and_impute_motion_with_gaps(fitted, tmp_path):
    assert json.loads(Path(fitted, "config.json").read_text())["data"]["missing"] is True
    futures, page, imputed = (str(tmp_path / name) for name in ("f.npz", "r.html", "i.npz"))
    assert main(["forecast", fitted, "--out", futures, "--samples", "2"]) == 0
    forecasts = motion.Forecasts.load(futures)
    assert np.isnan(forecasts.truth).any()
    assert np.isfinite(forecasts.forecasts).all()
    assert main(["animate", futures, "--out", str(tmp_path / "f.html")]) == 0
    few = ["--windows", "1", "--samples", "2", "--bound-windows", "2", "--particles", "2"]
    assert main(["report", fitted, "--out", page, *few]) == 0
    assert "cannot be shown" not in Path(page).read_text()

    clip = GAPS.clips[-1]
    assert main(["impute", fitted, "--out", imputed, "--clip", clip.name, "--samples", "3"]) == 0
    with np.load(imputed) as file:
        forecasts = dict(file)
    observed = ~np.isnan(clip.positions).any(-1)
    assert np.array_equal(forecasts["observed"][0], observed)
    relative = clip.positions - clip.positions[:, [WALKER.root]]
    np.testing.assert_array_equal(forecasts["filled"][1, 0][observed], relative[observed])
    assert (forecasts["spread"][0][observed] == 0).all()
    spread = forecasts["filled"].var(0).sum(-1) ** 0.5
    np.testing.assert_allclose(forecasts["spread"][~forecasts["observed"]], spread[~forecasts["observed"]], rtol=1e-5)


@pytest.mark.filterwarnings("default:bvh has rotations")
def test_impute_writes_filled_motion_files(fitted, tmp_path, capsys):
    impute = ["impute", fitted, "--samples", "1"]
    assert main([*impute, "--filled", str(tmp_path / "all.npz")]) == 0
    filled = motion.read_motion(tmp_path / "all.npz", missing=True)
    assert {each.key for each in filled} == {each.key for each in GAPS if each.split == "test"}
    for each in filled:
        observed = GAPS[each.key].positions
        assert np.array_equal(each.positions[~np.isnan(observed)], observed[~np.isnan(observed)])
        assert np.isfinite(each.positions[:75]).all()
    clip, one = GAPS.clips[-1], tmp_path / "one.bvh"
    assert main([*impute, "--clip", clip.name, "--filled", str(one)]) == 0
    bvh = motion.read_motion(one, metres=0.01)  # a model of one step has implausible bone lengths
    assert (bvh.clips[0].frames, bvh.skeleton.fps) == (clip.frames, WALKER.fps)
    capsys.readouterr()
    for arguments, message in (
        (["--filled", str(tmp_path / "all.bvh")], "can contain one of"),
        (["--particles", "2", "--out", str(tmp_path / "i.npz")], "--particles applies to tables only"),
        ([], "name it with --out or --filled"),
    ):
        assert main([*impute, *arguments]) == 2
        assert message in capsys.readouterr().err


def test_a_run_is_scored_and_reported_on_other_motion_with_gaps(gaps, tmp_path, capsys):
    run, other, few = str(tmp_path / "run"), ["--data", gaps, "--missing"], ["--samples", "2"]
    assert main(["fit", "vae", "--data", "simulated", *QUICK, "--out", run]) == 0
    forecast = ["forecast", run, "--out", str(tmp_path / "f.npz"), *few]
    assert main([*forecast, *other[:2]]) == 1
    assert main([*forecast, *other]) == 0
    assert main([*forecast, "--missing"]) == 2
    assert "--missing is for other data" in capsys.readouterr().err
    assert main(["evaluate", run, *other, *few, "--log-score-particles", "2", "--out", str(tmp_path / "e.json")]) == 0
    assert np.isfinite(json.loads((tmp_path / "e.json").read_text())["summary"]["vae"]["log score"]["mean"])
