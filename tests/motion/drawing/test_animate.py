"""Moving skeletons: the page shows the motion itself, bone by bone; forecasts in files; the command that plays both."""

import re

import numpy as np
import plotly.io
import pytest
import torch

from dvae import motion
from dvae.cli import main
from dvae.motion.drawing.plot import FIXED, PAST, TRUTH, animate, futures, save_html
from dvae.motion.geometry.skeleton import HUMAN36M, WALKER, Skeleton, rotate_about_up

NOW, HORIZON = 5, 6
MILLIMETRE = 1e-3


@pytest.fixture(scope="module")
def clips():
    return motion.simulate(clips=4, frames=NOW + HORIZON, seed=2)


@pytest.fixture(scope="module")
def bodies(clips):
    """(observed, samples, truth) of walking people."""
    positions = np.stack([clip.positions for clip in clips])
    return positions[0, :NOW], positions[1:, NOW:], positions[0, NOW:]


def bones(trace):
    """The segments (bones, 2, 3) of a trace of polylines, whatever their order."""
    points = np.stack([np.asarray(trace[axis], np.float64) for axis in "xyz"], -1)
    segments = np.stack([points[:-1], points[1:]], 1)
    return segments[~np.isnan(segments).any((1, 2))]


def skeleton_traces(figure):
    return [trace for trace in figure.data if trace.name != "floor"]


def seen(skeleton, positions, last, view):
    """Positions as the viewer of the page has them: x to the right, z up."""
    turn = torch.tensor(view - float(skeleton.heading(torch.tensor(last))))
    turned = rotate_about_up(torch.tensor(positions), turn, skeleton.up).numpy()
    return turned if skeleton.up == "z" else np.stack([turned[..., 0], -turned[..., 2], turned[..., 1]], -1)


@pytest.mark.parametrize("skeleton", [WALKER, HUMAN36M], ids=["y up", "z up"])
def test_the_page_shows_the_motion_itself(bodies, skeleton):
    observed, samples, truth = bodies
    if skeleton.up == "z":
        observed, samples, truth = (a[..., [2, 0, 1]] for a in bodies)
    figure = animate(skeleton, observed, samples, truth, every=1, view=0.3)
    assert len(figure.frames) == NOW + HORIZON
    edges = np.array(skeleton.edges)
    whole = np.stack([np.concatenate([observed, ahead]) for ahead in (truth, *samples)])
    expected = seen(skeleton, whole, observed[-1], 0.3)[:, :, edges]
    shown = np.stack([[bones(trace) for trace in frame.data] for frame in figure.frames], 1)
    places = (shown - expected).mean((1, 2, 3), keepdims=True)
    np.testing.assert_allclose(shown - places, expected, atol=MILLIMETRE / 10)
    apart = np.diff(places[:, 0, 0, 0], axis=0)
    assert (apart[:, 0] > np.ptp(expected[..., 0])).all()  # nobody stands in another's way
    np.testing.assert_allclose(apart[:, 1:], 0, atol=MILLIMETRE)
    lengths = np.linalg.norm(shown[..., 1, :] - shown[..., 0, :], axis=-1)
    np.testing.assert_allclose(lengths, skeleton.bone_lengths(whole), atol=MILLIMETRE)


def test_the_last_observed_pose_faces_the_viewer(bodies):
    figure = animate(WALKER, *bodies, every=1, view=0.0)
    sides = [WALKER.names.index(name) for name in ("LHip", "RHip", "LShoulder", "RShoulder")]
    points = dict(zip([child for _, child in WALKER.edges], bones(figure.frames[NOW - 1].data[0])[:, 1], strict=True))
    left_hip, right_hip, left, right = (points[joint] for joint in sides)
    across = left_hip + left - right_hip - right
    assert across[0] > 0.1
    assert across[1] == pytest.approx(0, abs=MILLIMETRE)


def test_colours_are_those_of_the_figure_and_the_past_is_black(bodies):
    figure = animate(WALKER, *bodies, every=1)
    colours = [[trace.line.color for trace in frame.data] for frame in figure.frames]
    assert all(set(row) == {PAST} for row in colours[:NOW])
    assert all(row == colours[-1] for row in colours[NOW:])
    assert colours[-1][0] == TRUTH
    assert len(set(colours[-1])) == 4
    assert [label.text for label in figure.layout.scene.annotations] == ["truth", "sample 1", "sample 2", "sample 3"]


def test_frames_are_left_out_but_not_the_present_nor_the_speed(bodies):
    figure = animate(WALKER, *bodies, every=3)
    assert [frame.name for frame in figure.frames] == ["1", "4", "7", "10"]
    (slider,), (menu,) = figure.layout.sliders, figure.layout.updatemenus
    assert [step.label for step in slider.steps] == ["-0.10", "0.00", "0.10", "0.20"]
    assert [step.args[0] for step in slider.steps] == [(frame.name,) for frame in figure.frames]
    assert figure.layout.meta["milliseconds"] == pytest.approx(100)
    assert 80 < menu.buttons[0].args[1]["frame"]["duration"] < 100
    # one frame a refresh, or so: 25 a second, not the 200 of a fast recording
    fast = Skeleton(WALKER.names, WALKER.parents, fps=200.0)
    assert animate(fast, *bodies).layout.meta["milliseconds"] == pytest.approx(40)


def test_only_what_changes_is_in_the_frames(bodies):
    figure = animate(WALKER, *bodies, every=1)
    for frame in figure.frames:
        assert frame.layout.to_plotly_json() == {}
        assert set(frame.data[0].to_plotly_json()) == {"type", "x", "y", "z", "line"}
    scene = figure.layout.scene
    shown = np.concatenate([bones(trace).reshape(-1, 3) for frame in figure.frames for trace in frame.data])
    for place, axis in enumerate("xyz"):
        low, high = scene[f"{axis}axis"].range
        assert low < shown[:, place].min() <= shown[:, place].max() < high
        per_metre = scene.aspectratio[axis] / (high - low)
        assert per_metre == pytest.approx(scene.aspectratio.x / np.ptp(scene.xaxis.range), rel=0.02)


def test_fixed_joints_are_told_apart_in_samples_only(bodies):
    observed, samples, truth = bodies
    legs = range(1, 7)
    figure = animate(WALKER, observed, samples, truth, fixed=legs, every=1)
    traces = skeleton_traces(figure)
    assert [trace.name for trace in traces] == ["truth", *(f"sample {k}" for k in (1, 1, 2, 2, 3, 3))]
    assert [len(bones(trace)) for trace in traces] == [16, *[10, 6] * 3]
    assert [trace.line.color for trace in figure.frames[-1].data[2::2]] == [FIXED] * 3
    assert traces[2].line.width > traces[1].line.width
    children = [child for _, child in WALKER.edges]
    whole = bones(animate(WALKER, observed, samples, truth, every=1).frames[-1].data[1])
    np.testing.assert_array_equal(
        bones(figure.frames[-1].data[2]), whole[[c in legs for c in children]], err_msg="not the legs"
    )


def test_a_motion_is_played_alone(clips):
    clip = clips.clips[0]
    figure = animate(clips.skeleton, clip.positions.tolist(), every=1)
    assert len(figure.frames) == clip.frames
    assert len(figure.frames[0].data) == 1
    assert figure.layout.sliders[0].steps[0].label == "0.00"


def test_a_truth_may_end_before_the_forecasts(bodies):
    observed, samples, truth = bodies
    figure = animate(WALKER, observed, samples, truth[:2], every=1)
    assert [len(bones(frame.data[0])) for frame in figure.frames] == [16] * (NOW + 2) + [0] * (HORIZON - 2)
    axes = futures(WALKER, observed, samples, truth[:2], frames=HORIZON)
    assert len(axes.collections) == 2 + HORIZON + 2


def test_many_samples_stand_in_rows(bodies):
    observed, samples, _ = bodies
    figure = animate(WALKER, observed, np.repeat(samples, 3, 0), every=1)
    heights = [label.z for label in figure.layout.scene.annotations]
    assert heights == sorted(heights, reverse=True)
    assert [heights.count(height) for height in dict.fromkeys(heights)] == [5, 4]
    assert sum(trace.name == "floor" for trace in figure.data) == 2


def test_everybody_is_as_large_as_the_window_lets_them_be(bodies):
    observed, samples, _ = bodies
    people = np.repeat(samples[:1], 6, 0)
    for stretch in (0, 3):  # people on the spot, and people who walk away and need room
        walk = np.linspace(0, stretch, HORIZON)[:, None, None] * np.array([1.0, 0.0, 0.0])
        figure = animate(WALKER, observed, people + walk, every=1, view=0.0)
        places = np.array([(label.x, label.z) for label in figure.layout.scene.annotations])
        rows, columns = (len(np.unique(places[:, axis].round(3))) for axis in (1, 0))
        assert rows * columns == 6
        assert rows == (1 if stretch == 0 else 2)
        ratio = figure.layout.scene.aspectratio
        assert max(figure.layout.meta["high"], ratio.x / 2) == pytest.approx(1.9)


def test_the_figure_has_a_key_of_what_it_shows(bodies):
    observed, samples, truth = bodies

    def key(*arguments, **options):
        return [text.get_text() for text in futures(WALKER, *arguments, **options).get_legend().get_texts()]

    assert key(observed, samples, truth) == ["observed", "what happened", "3 samples"]
    assert key(observed, samples[:1]) == ["observed", "1 sample"]
    paths = {"LWrist": np.zeros((HORIZON, 3))}
    assert key(observed, samples, paths=paths) == ["observed", "3 samples", "given paths"]


def test_what_does_not_fit_is_refused(bodies):
    observed, samples, truth = bodies
    for wrong in (
        (observed[..., :2], samples, truth),
        (observed, samples[0], truth),
        (observed, samples[:, :3], truth),
        (observed[:, :5], samples[..., :5, :], truth[:, :5]),
        (observed[:0], samples, truth),
        (observed[:1],),
    ):
        with pytest.raises(ValueError, match=r"expected observed \(O, J, 3\), samples"):
            animate(WALKER, *wrong)
    with pytest.raises(ValueError, match="NaN or infinite"):
        animate(WALKER, observed, np.where(samples > 0.5, np.nan, samples))
    with pytest.raises(ValueError, match="2 names for 3 samples"):
        animate(WALKER, *bodies, names=["a", "b"])
    with pytest.raises(ValueError, match=r"fixed names joints \[-1, 17\]; they go from 0 to 16"):
        animate(WALKER, *bodies, fixed=[17, 3, -1])
    with pytest.raises(ValueError, match="every is 0"):
        animate(WALKER, *bodies, every=0)


def test_the_page_needs_no_network(bodies, tmp_path):
    save_html(animate(WALKER, *bodies, title="Gehen: größer"), tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert not re.search(r"<script[^>]+src=", page)
    assert not re.search(r"\b(?:src|href)=", re.sub(r"(?s)<script\b.*?</script>", "", page))
    own = page[page.rindex("Plotly.newPlot") :].replace('"plotlyServerURL": "https://plot.ly"', "")
    assert "http" not in own
    assert len(own) < 60_000


def test_a_notebook_shows_it(bodies, monkeypatch):
    monkeypatch.setattr(plotly.io.renderers, "_default_renderers", [plotly.io.renderers["plotly_mimetype"]])
    bundle = animate(WALKER, *bodies)._repr_mimebundle_()
    assert len(bundle["application/vnd.plotly.v1+json"]["frames"]) == NOW + HORIZON


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
    read = motion.Forecasts.load(tmp_path / "deep" / "futures.npz")
    assert read.skeleton == forecasts.skeleton
    assert list(read.keys) == list(forecasts.keys)
    for name in ("forecasts", "observed", "truth"):
        np.testing.assert_array_equal(getattr(read, name), getattr(forecasts, name))
    with np.load(tmp_path / "deep" / "futures.npz", allow_pickle=False) as file:
        assert all(file[name].dtype != object for name in file.files)
    one = read.window(1, samples=2)
    np.testing.assert_array_equal(one.forecasts, forecasts.forecasts[:2, 1:])
    assert one.keys == [("test", "stand", 40)]


def test_arrays_that_do_not_fit_are_no_forecasts(forecasts):
    def made(**changed):
        return motion.Forecasts(**{**vars(forecasts), **changed})

    for changed in (
        {"observed": forecasts.observed[:1]},
        {"forecasts": forecasts.forecasts[0]},
        {"forecasts": forecasts.forecasts[:, :, : HORIZON - 1]},
        {"truth": forecasts.truth[..., :3, :]},
        {"forecasts": forecasts.forecasts[:0]},
    ):
        with pytest.raises(ValueError, match=r"expected forecasts \(S, 2, H, 17, 3\)"):
            made(**changed)


def failure(capsys, *arguments, code=1):
    assert main(["animate", *map(str, arguments)]) == code
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return error


def test_strange_forecast_files_are_refused(forecasts, tmp_path, capsys):
    file, page = tmp_path / "futures.npz", ("--out", tmp_path / "page.html")
    forecasts.save(file)
    with np.load(file) as stored:
        arrays = dict(stored)
    np.savez(file, **{name: array for name, array in arrays.items() if name != "parents"})
    assert "lacks 'parents'" in failure(capsys, file, *page)
    np.savez(file, **{**arrays, "observed": np.array([{"a": 1}], object)})
    assert "pickled objects" in failure(capsys, file, *page)
    np.savez(file, **{**arrays, "parents": np.zeros(17, int)})
    assert "expected one root" in failure(capsys, file, *page)
    file.write_bytes(file.read_bytes()[:-100])
    assert "error" in failure(capsys, file, *page)
    assert "no such file" in failure(capsys, tmp_path / "none.npz", *page)
    assert not page[1].exists()


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
    assert "they go from 0 to 1" in failure(capsys, file, "--out", page, "--window", "2", code=2)
    assert "has 3 of each window" in failure(capsys, file, "--out", page, "--samples", "4", code=2)
    assert "no run directory" in failure(capsys, file, "--out", page, "--data", "simulated", code=2)


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
    assert "is no run directory; name a run, or one motion file" in failure(capsys, tmp_path, "--out", page)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--out page.png", "end its name in .html"),
        ("--out .", "is a directory"),
        ("--out page.html --samples 0", "--samples is 0; it must be at least 1"),
        ("--out page.html --every 0", "--every is 0"),
        ("--out page.html --window -1", "--window is -1; it must be at least 0"),
        ("--out page.html --figure page.xyz", "the end of the name is the format"),
    ],
)
def test_wrong_arguments_exit_with_2_before_any_work(capsys, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert message in " ".join(failure(capsys, "simulated", *arguments.split(), code=2).replace("│", " ").split())
    assert not list(tmp_path.iterdir())
