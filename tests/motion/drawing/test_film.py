"""Films of skeletons: every frame is there, at the motion's own speed, in the colours of the page."""

import weakref

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from dvae import motion
from dvae.cli import main
from dvae.motion.drawing import film
from dvae.motion.drawing.film import save_film
from dvae.motion.drawing.plot import TRUTH, staged

NOW, HORIZON = 3, 6


@pytest.fixture(scope="module")
def clips():
    return motion.simulate(clips=3, frames=NOW + HORIZON, seed=2)


@pytest.fixture(scope="module")
def bodies(clips):
    """(observed, samples, truth)."""
    positions = np.stack([clip.positions for clip in clips])
    return positions[0, :NOW], positions[1:, NOW:], positions[0, NOW:]


def pictures(path):
    with Image.open(path) as film:
        for frame in range(film.n_frames):
            film.seek(frame)
            yield film.info["duration"], np.asarray(film.convert("RGB")) / 255


def has(picture, colour):
    return bool((np.abs(picture - to_rgb(colour)).max(-1) < 0.05).any())


def test_a_gif_has_every_frame_at_the_speed_of_the_motion(clips, bodies, tmp_path):
    path = tmp_path / "deep" / "film.gif"
    save_film(path, clips.skeleton, *bodies, title="$\\frac <b>", every=1)
    durations, frames = zip(*pictures(path), strict=True)
    assert len(frames) == NOW + HORIZON
    # a GIF's frames last whole hundredths of a second, 33.3 ms do not, and the sum must not drift
    ends = np.cumsum(durations) - 1000 / 30 * np.arange(1, len(frames) + 1)
    assert (np.abs(ends) <= 5).all()
    colours = (TRUTH, *staged(clips.skeleton, *bodies).colours)
    assert not any(has(frame, colour) for frame in frames[:NOW] for colour in colours)
    assert all(has(frame, colour) for frame in frames[NOW:] for colour in colours)
    assert all((first != second).any() for first, second in zip(frames[NOW:], frames[NOW + 1 :], strict=False))


@pytest.mark.parametrize("ending", ["gif", "mp4"])
def test_a_film_holds_few_frames_at_once(clips, bodies, tmp_path, monkeypatch, ending):
    if ending == "mp4":
        pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed: pip install '.[video]'")
    drawn, alive, draw = [], [], film._pictures

    def watched(*arguments):
        for picture in draw(*arguments):
            drawn.append(weakref.ref(picture))
            alive.append(sum(each() is not None for each in drawn))
            yield picture

    monkeypatch.setattr(film, "_pictures", watched)
    save_film(tmp_path / f"film.{ending}", clips.skeleton, *bodies, every=1)
    assert len(alive) >= NOW + HORIZON
    assert max(alive) <= 3


def test_an_mp4_has_every_frame_at_the_speed_of_the_motion(clips, bodies, tmp_path):
    coder = pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed: pip install '.[video]'")
    save_film(tmp_path / "film.mp4", clips.skeleton, *bodies, every=1)
    frames, seconds = coder.count_frames_and_secs(str(tmp_path / "film.mp4"))
    assert frames == NOW + HORIZON
    assert seconds == pytest.approx((NOW + HORIZON) / 30, abs=0.02)


def test_what_cannot_be_filmed_leaves_nothing(clips, bodies, tmp_path):
    observed, samples, truth = bodies
    with pytest.raises(ValueError, match=r"end its name in \.gif or \.mp4"):
        save_film(tmp_path / "film.avi", clips.skeleton, *bodies)
    with pytest.raises(ValueError, match="cannot be drawn"):
        save_film(tmp_path / "film.gif", clips.skeleton, observed, samples * np.nan, truth)
    assert not list(tmp_path.iterdir())


def test_the_command_films_a_clip(clips, tmp_path, capsys, monkeypatch):
    motion.save(tmp_path / "people.npz", clips)
    arguments = ["animate", str(tmp_path / "people.npz"), "--out"]
    assert main([*arguments, str(tmp_path / "film.gif"), "--every", "2"]) == 0
    assert len(list(pictures(tmp_path / "film.gif"))) == (NOW + HORIZON + 1) // 2
    monkeypatch.setattr("dvae.cli.futures.find_spec", lambda name: None)
    assert main([*arguments, str(tmp_path / "film.mp4")]) == 2
    assert "pip install 'pyro-dvae[video]'" in capsys.readouterr().err
