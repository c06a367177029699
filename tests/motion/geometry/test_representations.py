"""Representations of motion: rotations of joints instead of positions, and back with constant bone lengths."""

from dataclasses import replace

import pytest
import torch

import dvae
from dvae import motion
from dvae.cli.futures import draw_futures
from dvae.data.batch import Batch
from dvae.data.schema import SchemaError
from dvae.inference.evaluation.evaluation_windows import cluster_index
from dvae.motion.geometry import kinematics, rotations
from dvae.motion.geometry.views import LENGTHS, ROTATIONS, Rotations
from dvae.motion.scoring import metrics as errors

PROTOCOL = replace(motion.PROTOCOLS["simulated"], observed=5, predicted=7)


@pytest.fixture(scope="module")
def people_of_two_sizes():
    return motion.simulate(clips=12, frames=30, seed=4)


def twisted(people):
    """Return the same motion with other rotations, which inverse kinematics does not find.

    Joints with a single child rotate increasingly about their bone; the child rotates back.
    """
    people = people.with_rotations()
    body, clips = people.skeleton, []
    below = {joint: [child for parent, child in body.edges if parent == joint] for joint in range(body.joints)}
    for clip in people:
        matrices = rotations.to_matrix(torch.from_numpy(clip.rotations).double(), "quaternion")
        angle = torch.linspace(0.5, 3.5, clip.frames, dtype=torch.float64)[:, None]
        for joint, (child, *others) in ((joint, children) for joint, children in below.items() if children):
            if not others:
                axis = torch.nn.functional.normalize(body.offsets[child], dim=-1)
                twist = rotations.to_matrix(angle * axis, "vector")
                matrices[:, joint], matrices[:, child] = matrices[:, joint] @ twist, twist.mT @ matrices[:, child]
        quaternions = rotations.continuous(rotations.from_matrix(matrices, "quaternion"))
        clips.append(replace(clip, rotations=quaternions.numpy()))
    return motion.MotionSet(clips, body)


def windows(people, **options):
    return motion.windows(people, replace(PROTOCOL, **options), "train")


def small(data, method="vae"):
    return dvae.method(method, latent=2).build(data)


@pytest.mark.parametrize(("form", "root"), [("6d", "drop"), ("quaternion", "relative"), ("vector", "drop")])
def test_positions_are_recovered_from_features(people_of_two_sizes, form, root):
    data = windows(people_of_two_sizes, representation=form, root=root)
    batch = data.sample(6, torch.Generator().manual_seed(0))
    model = small(data).double()
    for inputs in (batch, {"x": batch["x"]}):  # recorded and inferred rotations
        features = model.read(inputs)
        assert features["x"].shape == (6, 12, model.sizes["x"])
        assert model.read(features) == features  # once
        again = model.to_data_space({"x": features["x"]}, features)["x"]
        torch.testing.assert_close(again, batch["x"].double(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("options", [{"heading": True}, {"rotate": True, "root": "relative"}])
def test_rotations_of_windows_reproduce_their_positions(people_of_two_sizes, options):
    data = windows(people_of_two_sizes, representation="6d", **options)
    for batch in (data.sample(6, torch.Generator().manual_seed(0)), data.all()):
        positions = data.positions(batch["x"]).double()
        body = data.skeleton
        matrices = rotations.to_matrix(batch["view_inputs"][ROTATIONS].double().unflatten(-1, (-1, 4)), "quaternion")
        offsets = torch.zeros(len(positions), 1, body.joints, 3, dtype=torch.float64)
        children = [child for _, child in body.edges]
        directions = torch.nn.functional.normalize(body.offsets, dim=-1)[children]
        offsets[:, 0, children] = body.bone_lengths(positions).mean(1)[..., None] * directions
        again, _ = kinematics.forward(body.parents, matrices, offsets, positions[:, :, body.root])
        torch.testing.assert_close(again, positions, atol=1e-5, rtol=0)
        assert (batch.leaves()[f"view_inputs/{ROTATIONS}"][:, 1:] * batch["view_inputs"][ROTATIONS][:, :-1]).unflatten(
            -1, (-1, 4)
        ).sum(-1).min() > 0.5


@pytest.mark.parametrize(("method", "form"), [("vae", "6d"), ("srnn", "quaternion"), ("vae", "vector")])
def test_forecasts_keep_bone_lengths_of_the_past_and_samples_of_the_rest_pose(people_of_two_sizes, method, form):
    data = windows(people_of_two_sizes, representation=form, root="relative")
    with pytest.raises(SchemaError, match=f"hit-dvae reads positions of joints, .* as {form}"):
        small(data, "hit-dvae")
    past, model = data.all()["x"][:, :5], small(data, method)
    futures = model.forecast({"x": past}, horizon=9, samples=3)["x"]
    assert futures.shape == (3, len(past), 9, data.size)
    lengths = data.skeleton.bone_lengths(data.positions(past)).mean(1)
    bone_lengths = data.skeleton.bone_lengths(data.positions(futures))
    torch.testing.assert_close(bone_lengths, lengths[None, :, None].expand_as(bone_lengths), atol=1e-5, rtol=0)
    sampled_lengths = data.skeleton.bone_lengths(data.positions(model.sample(4, 12)["x"]))
    rest = data.skeleton.offsets[[child for _, child in data.skeleton.edges]].norm(dim=-1).float()
    torch.testing.assert_close(sampled_lengths, rest.expand_as(sampled_lengths), atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("form", "with_rotations"), [("6d", True), ("quaternion", False), ("quaternion", True), ("vector", True)]
)
def test_features_have_no_jumps(people_of_two_sizes, form, with_rotations):
    data = windows(twisted(people_of_two_sizes), representation=form)
    model, batch = small(data), data.all()
    batch = batch if with_rotations else Batch(x=batch["x"])
    features = model.read(batch)["x"].unflatten(-1, (-1, rotations.size(form)))
    assert features.diff(dim=1).norm(dim=-1).max() < 1  # a jump is 2 for quaternions, a full turn for vectors
    if form != "6d":  # half of the angle: at most a quarter turn in the first frame
        half = features[..., 0].clamp(-1, 1).arccos() if form == "quaternion" else features.norm(dim=-1) / 2
        assert half[:, 0].max() <= torch.pi / 2 + 1e-3
        assert half.max() > torch.pi / 2 + 0.1 or not with_rotations  # larger in later frames of twisted joints
    past = model.read(batch.past(5))["x"]
    torch.testing.assert_close(past, features[:, :5].flatten(2))


def test_forecasts_do_not_depend_on_future_rotations(people_of_two_sizes):
    data = windows(people_of_two_sizes, representation="6d")
    model, batch = small(data, "srnn"), data.all()
    recorded = batch["view_inputs"][ROTATIONS]
    forecasts = []
    for frames in (slice(0, 0), slice(5, None), slice(4, None)):  # nothing, the future, and the last of the past
        altered = recorded.clone()
        altered[:, frames] = torch.randn_like(altered[:, frames])
        torch.manual_seed(0)
        forecasts.append(model.forecast({"x": batch["x"][:, :5], "view_inputs": {ROTATIONS: altered}}, horizon=4)["x"])
    torch.testing.assert_close(forecasts[1], forecasts[0])
    assert (forecasts[2] - forecasts[0]).abs().max() > 1e-3


def test_a_run_on_rotations_stores_its_rest_pose_and_draws_the_scored_futures(people_of_two_sizes, tmp_path):
    motion.save(
        tmp_path / "people.npz", twisted(people_of_two_sizes)
    )  # inverse kinematics does not find these rotations
    data = motion.MotionData.open(tmp_path / "people.npz", replace(PROTOCOL, representation="6d"))
    training = dvae.Training(steps=2, batch_size=4, progress=False)
    dvae.fit(dvae.method("srnn", latent=2, warm_up=1), data, out=tmp_path / "run", **vars(training))
    run = dvae.load(tmp_path / "run")
    assert isinstance(run.model.view, Rotations)
    assert run.model.view.skeleton == data.schema.skeleton
    assert run.data.protocol.representation == "6d"
    test = run.data.windows("test")
    futures = draw_futures(run, test, range(len(test)), samples=3, seed=0)
    error = errors.average_displacement_error(
        torch.from_numpy(futures.forecasts[..., 1:, :]).movedim(0, 1).flatten(3),  # the root was dropped
        torch.from_numpy(futures.truth[..., 1:, :]).flatten(2),
    )
    evaluation = dvae.evaluate(run.model, test, scores=motion.scores, samples=3, seed=0, progress=False).rows["model"]
    means = [error[places == clip].mean() for places in [cluster_index(test.keys)] for clip in places.unique()]
    torch.testing.assert_close(torch.stack(means), torch.tensor(evaluation.cluster_means["ADE"]).to(error))


def test_data_without_rotations_are_errors(people_of_two_sizes):
    data = windows(people_of_two_sizes, representation="6d")
    model, batch = small(data), data.all()
    with pytest.raises(ValueError, match="positions, which may be masked"):
        model.read({"x": batch["x"], "mask": torch.ones_like(batch["x"], dtype=torch.bool)})
    with pytest.raises(ValueError, match="have 48 numbers"):
        model.read({"x": batch["x"][..., :-3]})
    with pytest.raises(ValueError, match="no rest pose"):
        Rotations(motion.WALKER)
    assert LENGTHS in model.read(batch)


def test_bounds_of_rotations_and_positions_are_not_compared(people_of_two_sizes):
    in_rotations, positions = windows(people_of_two_sizes, representation="6d"), windows(people_of_two_sizes)
    models = {"turns": small(in_rotations), "positions": small(positions)}
    with pytest.raises(ValueError, match=r"these are of joint rotations \(6d\) for turns, of the data for positions"):
        dvae.compare(models, positions, particles=2, samples=0, progress=False)
    table = dvae.evaluate(models, positions, samples=2, references=False, progress=False)
    assert any("bounds of turns: densities of joint rotations (6d)" in note for note in table.notes)
    assert not any("bounds of positions" in note for note in table.notes)
