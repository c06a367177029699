"""Names in files and options are displayed literally: no markup, no HTML tags, no formulas."""

import html
import io
import re

import numpy as np
import pytest
import torch
from rich.console import Console

import dvae
from dvae import motion
from dvae.cli import main
from dvae.data.sequences import ArrayWindows
from dvae.inference.diagnostics.calibration import Calibration
from dvae.inference.diagnostics.checks import Statistic, predictive_checks
from dvae.inference.evaluation.evaluate import evaluate
from dvae.inference.evaluation.result import progress_bar
from dvae.inference.training.fit import Fit
from dvae.inference.training.trackers import Terminal
from dvae.networks import Dense

NAMES = ("[/x]", "[bold]b", "\\[/x]", "<a href=https://example.org>t</a>", "<script>alert(1)</script>", "$\\frac$")
NAMES += ("100 %s {0}", ":smile:", "a&lt;b")
LINES = "one\ntwo"
COLOURED = "\x1b[31mred"


@pytest.fixture(scope="module")
def models():
    torch.manual_seed(0)
    sizes, network = {"z": 1, "x": 3}, Dense((4,))
    model = dvae.DynamicalVAE("p(z_t) p(x_t | z_t)", "q(z_t | x_t)", sizes, network).eval()
    return dict.fromkeys((*NAMES, LINES), model)


@pytest.fixture(scope="module")
def windows():
    clips = [f"[/{n}]" for n in range(6)]
    return ArrayWindows(torch.randn(6, 5, 3, generator=torch.Generator().manual_seed(0)), 2, groups=clips)


def console_output(renderable):
    """Return what a console with markup prints, as a user's console does."""
    console = Console(file=io.StringIO(), width=1000, force_jupyter=False, no_color=True)
    console.print(renderable)
    return console.file.getvalue()


def without_spaces(text):
    """Remove white space, because long names are wrapped."""
    return "".join(text.split())


def assert_displayed_literally(result, names=NAMES):
    text, page = console_output(result), result._repr_html_()
    for name in names:
        assert without_spaces(name) in without_spaces(text), name
        assert without_spaces(html.escape(name)) in without_spaces(re.sub("<[^>]*>", "", page)), name
    assert "<script" not in page
    assert "<a " not in page
    assert "\x1b" not in text


def assert_drawn_literally(figure, names=NAMES):
    figure.savefig(io.BytesIO())  # mathtext raises on $\frac$
    texts = [text.get_text() for text in figure.findobj(lambda artist: hasattr(artist, "get_parse_math"))]
    for name in names:
        assert any(without_spaces(name) in without_spaces(text) for text in texts), name


def evaluation(models, windows):
    result = evaluate(models, windows, samples=2, references=False, options={}, progress=True)
    result.protocol["name"], result.data["title"], result.options["[/o]"] = "[/p] <b>", ["given [/j]"], "[/v]"
    result.notes.extend(NAMES)
    return result, result.plot(["CRPS", "ELBO"]), ("[/p] <b>", "[/j]", "[/o] [/v]")


def comparison(models, windows):
    result = dvae.compare(models, windows, particles=4, samples=2, contrasts=0, progress=True)
    return result, result.plot(), ()


def checks(models, windows):
    statistics = {name: Statistic(lambda x: x.mean((-1, -2)), name) for name in NAMES}
    result = predictive_checks({NAMES[0]: models[NAMES[0]]}, windows, statistics, samples=19)
    return result, result.plot(), ()


def calibration(models, windows):
    ranks = np.random.default_rng(0).integers(0, 4, (20, len(NAMES)))
    result = Calibration(ranks, NAMES, 3, 5, 0, {"inference": "q(z_{[/x]$\\frac$})"})
    return result, result.plot(worst=1), ("q(z_{[/x]$\\frac$})",)


@pytest.mark.parametrize("make", [evaluation, comparison, checks, calibration])
def test_names_in_results_are_literal(models, windows, make):
    result, figure, others = make(models, windows)
    assert_displayed_literally(result, (*NAMES, *others))
    assert_drawn_literally(figure, others if make is calibration else NAMES)  # it draws only the worst statistics


def test_masks_in_an_audit_are_literal():
    masks = {"[/x]": lambda T: np.eye(T, dtype=bool)}
    audit = dvae.audit(
        dvae.Factorization.parse("p(z_t) p(x_t | z_t)"),
        dvae.Factorization.parse("q(z_t | x_{[/x]})", masks=masks),
    )
    assert "x_{[/x]}" in console_output(audit.table())


def test_terms_in_learning_curves_and_on_the_terminal_are_literal():
    row = {f"energy/{name}": 1.0 for name in NAMES}
    history = [{"step": step, "loss": 1.0, **row} for step in (1, 2)]
    assert_drawn_literally(Fit(history, 2, None, None, "finished", None).plot())
    for live in (True, False):
        screen = io.StringIO()
        terminal = Terminal(2, Console(file=screen, force_terminal=live, width=1000, no_color=True))
        terminal.start(0)
        terminal.log(1, {"loss": 1.0, **row})
        terminal.close()
        for name in NAMES:
            assert name.replace("/", " ") in screen.getvalue().replace("/", " ")


def test_model_names_in_a_progress_bar_are_literal():
    bar = progress_bar(True)
    for name in NAMES:
        bar.add_task(name)
    text = console_output(bar.get_renderable())
    for name in NAMES:
        assert name in text


def hostile(name):
    """Return a clip, labels and skeleton of that name; a slash separates split and clip.

    The name of the skeleton is printable.
    """
    split, _, clip_name = name.rpartition("/")
    walk = motion.simulate(clips=1, frames=20)
    skeleton_name = name if name.isprintable() else "walker"
    names = tuple(f"{skeleton_name}{j}" for j in range(walk.skeleton.joints))
    skeleton = motion.Skeleton(names, walk.skeleton.parents, fps=30.0, name=skeleton_name)
    clip = motion.Clip(split or "train", clip_name, walk.clips[0].positions, {name: name}, {})
    return motion.MotionSet([clip], skeleton, name)


@pytest.mark.parametrize("name", [*NAMES[::3], LINES, COLOURED])
def test_names_in_the_description_of_a_file_are_literal(name):
    text = console_output(hostile(name).info())
    assert "\x1b" not in text
    for line in name.replace("\x1b", "\\x1b").split("\n"):
        assert text.count(line) >= 4 + name.isprintable()  # title, skeleton, clip, label and its value


@pytest.mark.parametrize("name", [LINES, COLOURED])
def test_unprintable_names_are_errors_on_writing(name, tmp_path):
    with pytest.raises(ValueError, match="is not a valid name of a split and a clip"):
        motion.save(tmp_path / "clips.npz", hostile(name))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", [NAMES[0], NAMES[4], NAMES[5]])
def test_names_in_reports_and_animations_are_literal(name, tmp_path, capsys):
    file, page, figure = (tmp_path / ending for ending in ("[/d].npz", "[/p].html", "[/f].png"))
    clips = hostile(name)
    motion.save(file, clips)
    assert main(["data", "info", str(file)]) == 0
    assert main(["animate", str(file), "--out", str(page)]) == 0
    error = capsys.readouterr().err
    assert "[/p].html" in error
    assert name in error

    positions = clips.clips[0].positions[None]
    parts = positions[None, :, 5:], positions[:, :5], positions[:, 5:]
    motion.Forecasts(clips.skeleton, [("test", name, 0)], *parts).save(tmp_path / "futures.npz")
    assert main(["animate", str(tmp_path / "futures.npz"), "--out", str(page), "--figure", str(figure)]) == 0
    text = page.read_text(encoding="utf-8")
    assert "<a " not in text
    assert "<script>alert" not in text
    assert main(["animate", str(file), "--out", str(page), "--clip", f"{name} else"]) == 1
    assert "no clip" in capsys.readouterr().err
