"""Segments of AMASS on bodies of SMPL's layout: the file's own rotations and betas, and chi with 124 numbers."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import smpl
import torch
from scipy.spatial.transform import Rotation

import dvae
from dvae import motion
from dvae.cli import main
from dvae.inference.training.checkpoints import CheckpointError
from dvae.motion import bodies
from dvae.motion.files.smpl import JOINTS
from dvae.motion.geometry import rotations
from dvae.motion.segments.completion import simulate_observations
from dvae.motion.segments.dataset import hold_out_sources
from dvae.motion.segments.embodied import SegmentSchema

TAKES = {"SFU/0005/walk": "female", "CMU/01/walk": "male", "CMU/02/walk": "male", "KIT/3/walk": "female"}
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up to y up


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with recordings, and a body of each layout; tests do not write to it."""
    path = tmp_path_factory.mktemp("smpl")
    for joints in (24, 52, 55):
        smpl.write_body(path / f"{joints}.npz", joints)
    smpl.write_recordings(path / "amass", TAKES)
    return path


@pytest.fixture(scope="module")
def data(folder):
    return motion.SegmentData.open(folder / "amass", body=folder / "52.npz", hold_out=["SFU"], bodies=0.0)


def published(folder, take, joints, shapes=8):
    """Return vertices (F, V, 3) with z up: SMPL's equations in NumPy, with all joints, and hands at rest."""
    body, file = np.load(folder / f"{joints}.npz"), np.load((folder / "amass" / take).with_suffix(".npz"))
    shaped = body["v_template"] + body["shapedirs"][..., :shapes] @ file["betas"][:shapes]
    pivots, parents = body["J_regressor"] @ shaped, body["kintree_table"][0].astype(np.int32)
    local = np.tile(np.eye(3), (len(file["poses"]), joints, 1, 1))
    local[:, :22] = Rotation.from_rotvec(file["poses"][:, :66].reshape(-1, 3)).as_matrix().reshape(-1, 22, 3, 3)
    world, places = [local[:, 0]], [np.tile(pivots[0], (len(local), 1))]
    for joint in range(1, joints):
        parent = parents[joint]
        places.append(places[parent] + world[parent] @ (pivots[joint] - pivots[parent]))
        world.append(world[parent] @ local[:, joint])
    moved = [
        weight[:, None] * ((shaped - pivot) @ turn.swapaxes(-1, -2) + place[:, None])
        for weight, pivot, turn, place in zip(body["weights"].T, pivots, world, places, strict=True)
    ]
    return sum(moved) + file["trans"][:, None]


def vertices(clip, body, shape):
    """Return vertices (F, V, 3) of a clip on the body's joints."""
    turns = rotations.to_matrix(torch.from_numpy(clip.rotations), "quaternion")
    translation = torch.from_numpy(clip.positions[:, 0]) - body.joints_at_rest(shape)[0]
    return body(shape, turns, translation)[0].numpy()


@pytest.mark.parametrize("joints", [24, 52, 55])
def test_takes_of_amass_move_the_surface_as_published(folder, joints):
    body = bodies.read_body(folder / f"{joints}.npz")
    takes = motion.read_motion(folder / "amass")
    embodied = bodies.fit_to_body(takes, body)
    shapes = bodies.shapes_of(embodied, body)
    for take, clip, shape in zip(sorted(TAKES), embodied, shapes, strict=True):
        file = np.load((folder / "amass" / take).with_suffix(".npz"))
        # equal although no joint determines the girth: nothing is estimated
        np.testing.assert_array_equal(shape.numpy(), file["betas"][:8])
        expected = published(folder, take, joints) @ UPRIGHT.T
        np.testing.assert_allclose(vertices(clip, body, shape.float()), expected, atol=2e-5)
        assert clip.labels["gender"] == TAKES[take]


def test_vertices_to_chi_with_124_numbers_to_vertices_within_two_millimetres(folder, data):
    test = data.windows("test")
    batch = test.all()
    assert batch["x"].shape[1:] == (100, 124)
    assert test.timed.still == ["L_Foot", "R_Foot"]
    restored = test.back(batch["x"], fps=60)
    truth = published(folder, "SFU/0005/walk", 52) @ UPRIGHT.T
    for clip, back, shape in zip(test.motion, restored, batch["beta"], strict=True):
        start = int(clip.labels["start"])
        expected = truth[start : start + clip.frames]
        error = np.linalg.norm(vertices(back, data.body, shape) - expected, axis=-1)
        assert error.shape[0] == clip.frames
        assert error.max() < 2e-3
    feet = torch.from_numpy(restored.clips[0].rotations[:, [JOINTS.index("L_Foot"), JOINTS.index("R_Foot")]])
    torch.testing.assert_close(feet.abs(), torch.tensor([1.0, 0, 0, 0]).expand_as(feet))


def test_joints_whose_rotation_frames_leave_out_are_reported(data):
    report = data.parts()
    assert "100 frames of 124 numbers: rotations of 20 joints" in report["frames"]
    assert "L_Foot, R_Foot are constant or unknown, and left out" in report["frames"]
    assert "(2 male, 2 female) are used on one body" in report["body"]
    of_positions = motion.SegmentData("simulated", motion.simulate(clips=6, frames=60, seed=1), "clips").parts()
    assert "106 numbers: rotations of 17 joints" in of_positions["frames"]
    assert "rotations of L_Foot, R_Foot, Head, L_Wrist, R_Wrist are constant" in of_positions["frames"]
    assert "body" not in of_positions
    train = data.windows("train").motion
    with pytest.warns(UserWarning, match=r"of Head \(up to 1\d°\), L_Wrist .*, R_Wrist .*, which return as the ident"):
        motion.TimedFrames(train.skeleton).to(train)
    for joints in (["Head"], [*train.skeleton.names, "Tail"]):
        with pytest.raises(ValueError, match=r"`joints` are .*expected names of joints of the skeleton"):
            motion.TimedFrames(train.skeleton, joints=joints)
    rotating_feet = [clip.rotations.copy() for clip in train]
    foot = JOINTS.index("L_Foot")
    for quaternions in rotating_feet:
        angle = np.linspace(0, 0.2, len(quaternions))
        quaternions[:, foot] = np.stack([np.cos(angle), np.sin(angle), 0 * angle, 0 * angle], -1)
    clips = [replace(clip, rotations=turns) for clip, turns in zip(train, rotating_feet, strict=True)]
    assert motion.TimedFrames.of(replace(train, clips=clips)).still == ["R_Foot"]


def test_sources_are_held_out_and_takes_keep_different_names(folder, data):
    splits = {split: {clip.labels["source"] for clip in data.windows(split).motion} for split in ("train", "test")}
    assert splits["test"] == {"SFU-0005-walk"}
    assert splits["train"] < {"CMU-01-walk", "CMU-02-walk", "KIT-3-walk"}
    takes = motion.read_motion(folder / "amass")
    assert [clip.split for clip in hold_out_sources(takes, ["CMU/02", "KIT"])] == ["train", "test", "test", "train"]
    for sources, message in (
        (["SFA"], r"hold_out has 'SFA' .did you mean 'SFU'.*the sources are CMU, KIT, SFU"),
        (["CM"], "'CM'.*is no source"),
        (["CMU", "KIT", "SFU"], "hold_out has all sources"),
    ):
        with pytest.raises(ValueError, match=message):
            hold_out_sources(takes, sources)


def test_a_run_names_its_body_and_reopens_it(folder, capsys, tmp_path):
    body, out = tmp_path / "body.npz", tmp_path / "run"
    shutil.copy(folder / "52.npz", body)
    fit = ["fit", "motion-latent", "--latent", "3", "--widths", "16", "8", "--steps", "4", "--batch-size", "4"]
    files = ["--data", folder / "amass", "--body", body, "--betas", "6", "--bodies", "0", "--hold-out", "SFU", "KIT"]
    assert main([*map(str, [*fit, *files, "--out", out])]) == 0
    assert "124 numbers" in capsys.readouterr().err
    run = dvae.load(out)
    original = bodies.read_body(body, 6)
    assert torch.equal(run.model.body.shapes, original.shapes)
    assert not any("body" in name for name in run.model.state_dict())
    test = run.data.windows("test")
    assert {clip.labels["source"] for clip in test.motion} == {"SFU-0005-walk", "KIT-3-walk"}
    surface = run.model.vertices(test.all()["x"][:2], test.all()["beta"][:2])
    assert surface.shape == (2, 100, len(original.template), 3)
    assert main(["evaluate", str(out)]) == 0
    with pytest.raises(ValueError, match="default markers are vertices of the bundled person"):
        simulate_observations(run.model, test.all()["x"], test.all()["beta"], "markers")
    name = next(clip.name for clip in test.motion)
    marked = ["impute", str(out), "--from", f"test/{name}", "--seen", "markers", "--frames", "4", "--steps", "2"]
    assert main([*marked, "--marker-vertices", "0", "5", "9", "--out", str(tmp_path / "whole.npz")]) == 0
    other = run.with_data(folder / "amass" / "CMU")  # no source of it was held out
    assert {*other.motion.splits} == {"train", "test"}

    smpl.write_body(body, seed=1)
    with pytest.raises(
        CheckpointError, match=r"the run uses another body than .*body.npz contains .*schema\.body\.path"
    ):
        dvae.load(out)
    body.unlink()
    with pytest.raises(FileNotFoundError, match=r"body.npz, which does not exist here; .*licences.*schema\.body\.path"):
        dvae.load(out)
    config = json.loads((out / "config.json").read_text())
    config["schema"]["body"]["path"] = str(folder / "52.npz")
    (out / "config.json").write_text(json.dumps(config))
    assert torch.equal(dvae.load(out).model.body.template, original.template)


def test_runs_on_different_bodies_have_different_windows(folder, data):
    schema = data.schema
    again = SegmentSchema.from_config(json.loads(json.dumps(schema.config())))
    assert again == schema
    moved = replace(schema, body=replace(schema.body, path="elsewhere.npz"))
    assert moved.windows == schema.windows
    other = SegmentSchema.from_data(schema.timed, bodies.human())
    assert other.windows != schema.windows
    config = other.config()
    del config["body"]  # as in runs of earlier versions
    assert SegmentSchema.from_config(config) == other
    person = bodies.human()
    person.source = None
    with pytest.raises(ValueError, match="the body was made in Python"):
        SegmentSchema.from_data(schema.timed, person)
    with pytest.raises(ValueError, match="has no path, and is not the bundled person"):
        bodies.reopen_body(bodies.BodySource(shapes=5))


def test_files_that_do_not_fit_are_errors(folder, tmp_path):
    smpl.write_body(tmp_path / "many.npz", shapes=20)
    takes, body = motion.read_motion(folder / "amass"), bodies.read_body(tmp_path / "many.npz", 20)
    with pytest.raises(ValueError, match="CMU/01/walk has 16 betas, expected 20; files of AMASS contain 10 or 16"):
        bodies.fit_to_body(takes, body)
    with pytest.raises(ValueError, match="betas is 6, but only a body in a file has a choice"):
        motion.SegmentData.open(folder / "amass", betas=6)
    with pytest.raises(ValueError, match=r"SMPL_NEUTRAL\.pkl: a pickle is a program, and is not read"):
        bodies.read_body("SMPL_NEUTRAL.pkl")
    with pytest.raises(FileNotFoundError, match=r"nobody\.npz"):
        motion.SegmentData.open(folder / "amass", body="nobody.npz")


def test_motion_without_rotations_is_fitted_to_a_body_in_a_file(folder):
    body = bodies.read_body(folder / "24.npz")
    people = bodies.fit_to_body(motion.simulate(clips=3, frames=40, seed=1), body)
    shapes = bodies.shapes_of(people, body)
    torch.testing.assert_close(bodies.betas(people), shapes)
    taller = bodies.retarget(people, body, shapes + torch.eye(8)[0])
    torch.testing.assert_close(bodies.shapes_of(taller, body), shapes + torch.eye(8)[0], atol=1e-4, rtol=0)
