"""Animated skeletons: the page plays the motion, forecast files are read back, the command plays both."""

import base64
import html
import io
import json
import re
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from dvae import motion
from dvae.cli import main
from dvae.motion.drawing.player import animate
from dvae.motion.drawing.plot import PAST, TRUTH
from dvae.motion.geometry.skeleton import HUMAN36M, WALKER, Skeleton, rotate_about_up

NOW, HORIZON = 5, 6
MILLIMETRE = 1e-3


@pytest.fixture(scope="module")
def clips():
    return motion.simulate(clips=4, frames=NOW + HORIZON, seed=2)


@pytest.fixture(scope="module")
def bodies(clips):
    """Return (observed, samples, truth) of walking people."""
    positions = np.stack([clip.positions for clip in clips])
    return positions[0, :NOW], positions[1:, NOW:], positions[0, NOW:]


def unpacked(scene):
    """Return positions (people, frames, joints, 3) as the script of the page reads them; NaN after a person's end."""
    planes = np.frombuffer(zlib.decompress(base64.b64decode(scene["packed"])), np.uint8).reshape(2, -1).astype(np.int32)
    steps = (planes[0] | planes[1] << 8).reshape(-1, scene["joints"], 3)
    past, *aheads = np.split(steps, np.cumsum([scene["observed"], *(each["frames"] for each in scene["people"])])[:-1])
    people = np.full((len(aheads), scene["frames"], scene["joints"], 3), np.nan)
    for place, ahead in enumerate(aheads):
        values = np.cumsum(np.concatenate([past, ahead]), 0).astype(np.int16)
        people[place, : len(values)] = scene["unit"] * values
    return people


def scene_of(*arguments, **options):
    """Return the scene of a page as its script reads it."""
    page = animate(*arguments, **options).to_html()
    return json.loads(html.unescape(re.search('data-motion="([^"]*)"', page)[1]))[0]


def project(skeleton, positions, last, view):
    """Return positions as the viewer of the page has them: x to the right, z up."""
    turn = torch.tensor(view - float(skeleton.heading(torch.tensor(last))))
    rotated = rotate_about_up(torch.tensor(positions), turn, skeleton.up).numpy()
    return rotated if skeleton.up == "z" else np.stack([rotated[..., 0], -rotated[..., 2], rotated[..., 1]], -1)


@pytest.mark.parametrize("skeleton", [WALKER, HUMAN36M], ids=["y up", "z up"])
def test_the_page_contains_the_motion(bodies, skeleton):
    observed, samples, truth = bodies
    if skeleton.up == "z":
        observed, samples, truth = (a[..., [2, 0, 1]] for a in bodies)
    scene = scene_of(skeleton, observed, samples, truth, every=1, view=0.3, fixed=[5, 3])
    expected = np.stack([np.concatenate([observed, ahead]) for ahead in (truth, *samples)])
    np.testing.assert_allclose(unpacked(scene), project(skeleton, expected, observed[-1], 0.3), atol=MILLIMETRE)
    assert np.array_equal(scene["bones"], skeleton.edges)
    assert [person["name"] for person in scene["people"]] == ["truth", "sample 1", "sample 2", "sample 3"]
    assert [person["fixed"] for person in scene["people"]] == [[], *[[3, 5]] * 3]  # in samples alone
    assert scene["people"][0]["colour"] == TRUTH
    assert (scene["past"], scene["observed"]) == (PAST, NOW)


def test_skipping_frames_keeps_the_present_and_the_speed(bodies):
    scene = scene_of(WALKER, *bodies, every=3)
    assert (scene["frames"], scene["observed"]) == (4, 2)
    assert scene["milliseconds"] == pytest.approx(3000 / WALKER.fps)
    fast = replace(WALKER, fps=200.0)
    assert scene_of(fast, *bodies)["milliseconds"] == pytest.approx(40)


def test_people_without_a_past_have_their_own_first_pose_and_their_own_end(bodies):
    _, samples, truth = bodies
    ends = [HORIZON, 2, 4]
    padded = samples.copy()
    for ahead, end in zip(padded, ends, strict=True):
        ahead[end:] = np.nan
    scene = scene_of(WALKER, samples[0, :0], padded, truth[:3], every=1, view=0.3)
    assert (scene["observed"], scene["frames"]) == (0, HORIZON)
    assert [person["frames"] for person in scene["people"]] == [3, *ends]
    expected = np.full((4, *samples.shape[1:]), np.nan)
    expected[0, :3], expected[1:] = truth[:3], padded
    np.testing.assert_allclose(unpacked(scene), project(WALKER, expected, truth[0], 0.3), atol=MILLIMETRE)
    film = animate(WALKER, samples[0, :0], padded)
    assert film.scene.seconds(0) == 0
    assert film.to_gif()
    assert scene_of(WALKER, truth[:1])["frames"] == 1  # a single pose


def test_a_person_with_a_missing_root_and_one_of_a_single_joint_are_drawn(bodies):
    motion_without_root = bodies[0].copy()
    motion_without_root[:, WALKER.root] = np.nan
    point = Skeleton(("a",), (-1,))
    for film in (animate(WALKER, motion_without_root), animate(point, np.zeros((3, 1, 3)))):
        with Image.open(io.BytesIO(film.to_gif())) as picture:
            assert picture.n_frames
    pixels = np.asarray(Image.open(io.BytesIO(animate(WALKER, motion_without_root).to_gif())).convert("L"))
    assert (pixels < 200).sum() > 100
    assert point.bone_lengths(np.zeros((3, 1, 3))).shape == (3, 0)


def test_mismatched_arrays_are_errors(bodies):
    observed, samples, truth = bodies
    for wrong in ((observed[..., :2], samples, truth), (observed, samples[:, :3], truth), (observed[:0],)):
        with pytest.raises(ValueError, match=r"expected observed \(O, J, 3\), samples"):
            animate(WALKER, *wrong)
    with pytest.raises(ValueError, match="NaN or infinite"):
        animate(WALKER, observed, np.where(samples > 0.5, np.nan, samples))
    with pytest.raises(ValueError, match="2 names for 3 samples"):
        animate(WALKER, *bodies, names=["a", "b"])
    with pytest.raises(ValueError, match=r"fixed has joints \[-1, 17\]; expected indices from 0 to 16"):
        animate(WALKER, *bodies, fixed=[17, 3, -1])


@pytest.mark.parametrize("title", ["Gehen: größer", "</script><b>"])
def test_the_page_needs_no_network_and_escapes_its_title(bodies, tmp_path, title):
    player = animate(WALKER, *bodies, title=title)
    player.save(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert html.escape(title) in page
    assert "<b>" not in page
    assert "http" not in re.sub("(?s)<script>.*", "", page).replace("http-equiv", "")


@pytest.mark.parametrize(("frames", "fps"), [(1, 30.0), (1, 28.0), (1, 45.0), (50, 30.0)])
def test_a_notebook_shows_a_gif_at_original_speed(bodies, frames, fps):
    observed, samples, truth = bodies
    walker = replace(WALKER, fps=fps)
    film = animate(walker, observed, samples.repeat(frames, 1), truth, fixed=[1, 2], title='"<b>', every=1)
    html_of_film = film._repr_mimebundle_()["text/html"]
    assert "<b>" not in html_of_film
    gif = base64.b64decode(re.search('src="data:image/gif;base64,([^"]*)"', html_of_film)[1])
    assert gif == film.to_gif()
    with Image.open(io.BytesIO(gif)) as picture:
        assert 10 < picture.n_frames <= 40
        seconds = 0
        for frame in range(picture.n_frames):
            picture.seek(frame)
            seconds += picture.info["duration"] / 1000
        assert picture.info["loop"] == 0  # without end
        length = NOW + HORIZON * frames
        every = -(-length // 40)
        assert seconds == pytest.approx(-(-length // every) * every / fps, abs=0.006)


def test_the_colours_of_a_gif_follow_the_observed_frames(bodies):
    with Image.open(io.BytesIO(animate(WALKER, *bodies, every=1).to_gif())) as picture:
        for frame in range(picture.n_frames):
            picture.seek(frame)
            pixels = np.asarray(picture.convert("RGB")).astype(int).reshape(-1, 3)
            assert (pixels.max(1) - pixels.min(1) > 60).any() == (frame >= NOW)
            assert (pixels == 255).all(1).mean() > 0.8  # the background


@pytest.fixture
def forecasts(clips, bodies):
    observed, samples, truth = bodies
    return motion.Forecasts(
        clips.skeleton,
        [("test", "walk", 0), ("test", "stand", 40)],
        np.stack([samples, samples[:, :1].repeat(HORIZON, 1)], 1),
        np.stack([observed, observed[:1].repeat(NOW, 0)]),
        np.stack([truth, observed[:1].repeat(HORIZON, 0)]),
    )


def test_a_forecast_file_is_read_back(forecasts, tmp_path):
    forecasts.save(tmp_path / "deep" / "futures.npz")
    loaded = motion.Forecasts.load(tmp_path / "deep" / "futures.npz")
    assert loaded.skeleton == forecasts.skeleton
    assert list(loaded.keys) == list(forecasts.keys)
    for name in ("forecasts", "observed", "truth"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(forecasts, name))
    with np.load(tmp_path / "deep" / "futures.npz", allow_pickle=False) as file:
        assert all(file[name].dtype != object for name in file.files)
    one = loaded.window(1, samples=2)
    np.testing.assert_array_equal(one.forecasts, forecasts.forecasts[:2, 1:])
    assert one.keys == [("test", "stand", 40)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parents": np.zeros(17, int)}, "expected one root"),
        ({"observed": np.array([{"a": 1}], object)}, "pickled objects"),
        ({"truth": np.zeros((2, 6, 3, 3), np.float32)}, "expected forecasts (S, 2, H, 17, 3)"),
    ],
)
def test_invalid_forecast_files_are_errors(forecasts, tmp_path, capsys, change, message):
    file, page = tmp_path / "futures.npz", tmp_path / "page.html"
    forecasts.save(file)
    with np.load(file) as stored:
        arrays = dict(stored)
    np.savez(file, **{**arrays, **change})
    assert message in " ".join(failure(capsys, file, "--out", page).split())
    file.write_bytes(file.read_bytes()[:-100])
    assert "error" in failure(capsys, file, "--out", page)
    assert not page.exists()


def failure(capsys, *arguments, code=1):
    assert main(["animate", *map(str, arguments)]) == code
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return error


def test_the_command_plays_what_dvae_forecast_wrote(forecasts, tmp_path, capsys):
    file, page, drawing = tmp_path / "futures.npz", tmp_path / "deep" / "page.html", tmp_path / "futures.png"
    forecasts.save(file)
    assert main(["animate", str(file), "--out", str(page), "--samples", "2", "--figure", str(drawing)]) == 0
    assert "window 0, test/walk from frame 0: 2 futures" in capsys.readouterr().err  # of two, the one that moves
    assert "walk from frame 0: 2 futures" in page.read_text(encoding="utf-8")
    assert drawing.read_bytes().startswith(b"\x89PNG")
    assert main(["animate", str(file), "--out", str(page), "--clip", "test/stand"]) == 0
    assert "window 0, test/stand from frame 40: 3 futures" in capsys.readouterr().err
    assert main(["animate", str(file), "--out", str(page), "--window", "1"]) == 0
    assert "window 1, test/stand" in capsys.readouterr().err
    assert "no window of a clip 'run'" in failure(capsys, file, "--out", page, "--clip", "run")
    assert "it must be from 0 to 1" in failure(capsys, file, "--out", page, "--window", "2", code=2)
    assert "has only 3 futures of each window" in failure(capsys, file, "--out", page, "--samples", "4", code=2)
    assert "not a run directory" in failure(capsys, file, "--out", page, "--data", "simulated", code=2)


def test_the_command_plays_a_run_and_its_data(run, tmp_path, capsys):
    data, page = tmp_path / "people.npz", tmp_path / "page.html"
    motion.save(data, motion.simulate(clips=14, frames=80, seed=1))
    options = ["--out", str(page), "--every", "15"]
    assert main(["animate", str(run), *options, "--samples", "2"]) == 0
    assert re.search(r"window \d, test/person_\d+ from frame \d+: 2 futures", capsys.readouterr().err)
    assert main(["animate", str(run), *options, "--clip", "person_0000", "--window", "0"]) == 0
    assert "window 0, train/person_0000 from frame 0: 5 futures" in capsys.readouterr().err
    assert main(["animate", str(data), *options, "--clip", "train/person_0001"]) == 0
    assert "train/person_0001, 80 frames" in capsys.readouterr().err
    assert "futures" in failure(capsys, data, "--out", page, "--samples", "2", code=2)
    assert "no clip 'nobody'" in failure(capsys, data, "--out", page, "--clip", "nobody")
    assert "is a folder but not a run directory; name a run, or a motion file" in failure(
        capsys, tmp_path, "--out", page
    )
