"""The travel of the root: velocities and poses relative to its heading, and paths that add them up."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest
import torch

import dvae
from dvae import motion
from dvae.cli import main
from dvae.cli.futures import draw_futures
from dvae.data.batch import Batch
from dvae.data.schema import SchemaError
from dvae.motion.geometry.skeleton import rotate_about_up
from dvae.motion.geometry.views import ROTATIONS, START, Travel

PROTOCOL = replace(motion.PROTOCOLS["simulated"], observed=6, predicted=10, root="travel")


@pytest.fixture(scope="module")
def simulated():
    return motion.simulate(clips=10, frames=40, seed=3)


def unnamed(people, z_up=False):
    """Return motion whose joints have no usual names, no sides and another order, with the root in the middle."""
    old = people.skeleton
    order = [*range(3, old.joints), 0, 1, 2]
    parents = tuple(order.index(old.parents[joint]) if old.parents[joint] >= 0 else -1 for joint in order)
    body = motion.Skeleton(tuple(f"b{n}" for n in range(old.joints)), parents, up="z" if z_up else "y", fps=old.fps)
    axes = [2, 0, 1] if z_up else [0, 1, 2]  # y to z
    clips = [replace(clip, positions=clip.positions[:, order][..., axes], rotations=None) for clip in people]
    return motion.MotionSet(clips, body)


def assert_inverse(data):
    """Assert that windows, and futures that follow their pasts, are recovered; return the values that models see."""
    view, batch, observed = data.schema.view, data.all(), data.protocol.observed
    values = view(batch)
    assert values["x"].shape == (*batch["x"].shape[:2], view.size)
    assert view(values) == values  # once
    torch.testing.assert_close(view.inverse(values)["x"], batch["x"], atol=1e-5, rtol=0)
    past = view(batch.past(observed))
    torch.testing.assert_close(past["x"], values["x"][:, :observed])
    following = {name: value for name, value in view.following(past).items() if name in view.names}
    futures = view.inverse(Batch(x=values["x"][None, :, observed:].repeat(2, 1, 1, 1), **following))["x"]
    torch.testing.assert_close(futures, batch["x"][None, :, observed:].repeat(2, 1, 1, 1), atol=1e-5, rtol=0)
    inputs = {name: value[:, observed:] for name, value in batch.view_inputs.items()}
    later = view(Batch(x=batch["x"][:, observed:], view_inputs=inputs), past)
    torch.testing.assert_close(later["x"], values["x"][:, observed:], atol=1e-3, rtol=0)  # rates: per second
    return values


@pytest.mark.parametrize("form", ["positions", "6d", "quaternion"])
@pytest.mark.parametrize("kind", ["walker", "unnamed", "z up"])
def test_windows_are_recovered_from_the_travel_of_their_root(simulated, kind, form):
    people = simulated if kind == "walker" else unnamed(simulated, z_up=kind == "z up")
    if form != "positions":
        people = people.with_rotations()
    assert_inverse(motion.windows(people, replace(PROTOCOL, representation=form), "train"))


@pytest.mark.parametrize("file", ["bandai/bandai2.npz", "cmu/cmu8.npz"])
def test_real_clips_are_recovered_from_the_travel_of_their_root(real, file):
    people = real(file)
    protocol = replace(PROTOCOL, observed=15, predicted=60, test_stride=50)
    assert_inverse(motion.windows(people, protocol, "test"))


@pytest.mark.parametrize("kind", ["walker", "unnamed", "z up"])
def test_values_do_not_depend_on_the_initial_position_and_heading(simulated, kind):
    people = simulated if kind == "walker" else unnamed(simulated, z_up=kind == "z up")
    data = motion.windows(people, PROTOCOL, "train")
    x, view, up = data.all()["x"].double(), data.schema.view, people.skeleton.up
    angle = torch.linspace(-3, 3, len(x), dtype=torch.float64)[:, None, None]
    moved = rotate_about_up(data.positions(x), angle, up) + 5 * torch.randn(len(x), 1, 1, 3, dtype=torch.float64)
    values, moved_values = view(Batch(x=x)), view(Batch(x=moved.flatten(-2)))
    torch.testing.assert_close(moved_values["x"], values["x"], atol=1e-9, rtol=0)
    torch.testing.assert_close(view.inverse(moved_values)["x"], moved.flatten(-2), atol=1e-9, rtol=0)


def test_a_joint_moves_no_other_value_of_earlier_frames(simulated):
    data = motion.windows(simulated, PROTOCOL, "train")
    x, view = data.all()["x"].double(), data.schema.view
    values = view(Batch(x=x))["x"]
    x[:, 9] += torch.randn_like(x[:, 9])
    torch.testing.assert_close(view(Batch(x=x))["x"][:, :9], values[:, :9], atol=0, rtol=0)


def test_constant_rates_are_straight_lines_and_circles():
    view, frames = Travel(motion.WALKER), 60
    fps = motion.WALKER.fps
    x = torch.zeros(1, frames, view.size, dtype=torch.float64)
    x[..., 2] = 1.2  # metres per second along z, the direction of heading zero
    root = view.inverse(Batch(x=x))["x"].unflatten(-1, (-1, 3))[0, :, motion.WALKER.root]
    torch.testing.assert_close(root[-1], torch.tensor([0.0, 0.0, 1.2 * frames / fps], dtype=torch.float64))
    x[..., 3] = 2 * pi * fps / frames  # a whole turn
    path = view.inverse(Batch(x=x))["x"].unflatten(-1, (-1, 3))[0, :, motion.WALKER.root]
    torch.testing.assert_close(path[-1], torch.zeros(3, dtype=torch.float64), atol=1e-12, rtol=0)
    torch.testing.assert_close(path.diff(dim=0).norm(dim=-1), torch.full((frames - 1,), 1.2 / fps, dtype=torch.float64))
    start = {START: torch.tensor([[3.0, 1.0, -2.0, pi / 2]], dtype=torch.float64)}
    turned = view.inverse(Batch(x=x, **start))["x"].unflatten(-1, (-1, 3))[0, :, motion.WALKER.root]
    expected = rotate_about_up(path, torch.tensor(pi / 2), "y") + start[START][0, :3]
    torch.testing.assert_close(turned, expected)


@pytest.mark.parametrize("fps", [30.0, 50.0])
def test_a_straight_walk_has_its_speed_and_covers_its_distance(simulated, fps):
    data = motion.windows(simulated, PROTOCOL, "train")
    view = Travel(replace(data.skeleton, fps=fps))
    time = torch.arange(50, dtype=torch.float64) / fps
    ahead = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    poses = data.positions(data.all()["x"].double())[:, :1] + 1.4 * time[:, None, None] * ahead
    values = view(Batch(x=poses.flatten(-2)))
    torch.testing.assert_close(values["x"][..., [0, 2]].norm(dim=-1), torch.full_like(values["x"][..., 0], 1.4))
    assert values["x"][..., [1, 3]].abs().max() < 1e-9  # height and turns
    continued = view.following(values) | {"x": values["x"][:, -1:].repeat(1, 90, 1)}
    end = view.inverse(continued)["x"][:, -1].unflatten(-1, (-1, 3))
    torch.testing.assert_close(end, poses[:, -1] + 1.4 * 90 / fps * ahead)


def test_a_body_without_two_alike_sides_keeps_the_axes_of_the_data():
    snake = motion.Skeleton(("head", "neck", "trunk"), (1, 2, -1))
    x = torch.randn(2, 5, 9, dtype=torch.float64)
    view = Travel(snake)
    values = view(Batch(x=x))
    assert not values["x"][..., 3].any()
    torch.testing.assert_close(view.inverse(values)["x"], x)


def test_what_the_view_cannot_see_is_an_error(simulated):
    data = motion.windows(simulated, PROTOCOL, "train")
    view, x = data.schema.view, data.all()["x"]
    with pytest.raises(ValueError, match="impute the joints first"):
        view(Batch(x=x, mask=torch.ones_like(x, dtype=torch.bool)))
    with pytest.raises(ValueError, match="with its root have 51 numbers"):
        view(Batch(x=x[..., 3:]))
    with pytest.raises(ValueError, match="at least 2 observed frames, got 1"):
        replace(PROTOCOL, observed=1)
    with pytest.raises(SchemaError, match=r"models see the travel of the root and positions of joints.*--root"):
        dvae.method("hit-dvae", latent=2).build(data)
    with pytest.raises(ValueError, match="remove `Past`"):
        view.following(Batch({START: torch.zeros(1, 4)}))


def test_windows_of_both_representations_of_the_root_are_compared(simulated):
    travel, relative = (motion.windows(simulated, replace(PROTOCOL, root=r), "test") for r in ("travel", "relative"))
    assert travel.schema.windows == relative.schema.windows
    torch.testing.assert_close(travel.all()["x"], relative.all()["x"], atol=0, rtol=0)
    models = {name: dvae.method(name).build(travel) for name in ("erd", "vae")}
    models["relative"] = dvae.method("vae").build(relative)
    table = dvae.evaluate(models, travel, scores=motion.scores, samples=2, references=False, progress=False)
    assert any("bounds of vae: densities of velocities of the root" in note for note in table.notes)


@pytest.mark.filterwarnings("default:bvh has rotations")
@pytest.mark.parametrize("form", ["positions", "6d"])
def test_forecasts_continue_the_path_in_a_bvh_file(people, form, tmp_path, capsys):
    run, out = str(tmp_path / "run"), tmp_path / "future.bvh"
    options = ["--data", str(people), "--root", "travel", "--representation", form, "--latent", "2"]
    assert main(["fit", "vae", *options, "--steps", "4", "--warm-up", "1", "--batch-size", "8", "--out", run]) == 0
    command = ["forecast", run, "--out", str(out), "--clip", "test/person_0013", "--horizon", "70"]
    capsys.readouterr()
    assert main([*command, "--seed", "3"]) == 0
    notes = " ".join(capsys.readouterr().err.split())
    assert "the root travels" in notes
    assert "relative to the root" not in notes
    assert ("bvh has rotations" in notes) == (form == "positions")
    loaded = dvae.load(run)
    clip = loaded.data.motion["test", "person_0013"]
    written = motion.read_motion(out, metres=0.01).clips[0].positions
    start = next(n for n in range(clip.frames) if np.abs(written[0, 0] - clip.positions[n, 0]).max() < 1e-4)
    if form == "6d":  # bones keep their lengths, which a BVH file needs
        np.testing.assert_allclose(written[:15], clip.positions[start : start + 15], atol=1e-4)
    test = loaded.data.windows("test")
    keys = [key for key in test.keys if key[1:] == ("person_0013", start)]
    futures = draw_futures(loaded, test.at(keys), [0], 10, 3, horizon=70)
    expected = test.at(keys).to_world(torch.from_numpy(futures.forecasts[0]))[0].numpy()
    np.testing.assert_allclose(written[15:, 0], expected[:, 0], atol=1e-4)  # the root
    if form == "6d":
        np.testing.assert_allclose(written[15:], expected, atol=1e-3)


def test_forecasts_read_no_rotation_of_the_future(simulated):
    data = motion.windows(simulated.with_rotations(), replace(PROTOCOL, representation="6d"), "train")
    model, batch, forecasts = dvae.method("srnn", latent=2).build(data), data.all(), []
    for altered in (batch.view_inputs[ROTATIONS], batch.view_inputs[ROTATIONS].clone()):
        altered[:, 6:] = torch.randn_like(altered[:, 6:])
        torch.manual_seed(0)
        past = Batch(x=batch["x"], view_inputs={ROTATIONS: altered}).past(6)
        forecasts.append(model.forecast(past, horizon=4)["x"])
    torch.testing.assert_close(*forecasts)
