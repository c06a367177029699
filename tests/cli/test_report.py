"""The report of runs: one complete page, notes for missing parts, animation, and no active content from runs."""

import json
import re
import shutil
from html.parser import HTMLParser
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from browser import browser
from markupsafe import Markup

import dvae
from dvae import motion
from dvae.cli import main
from dvae.inference.evaluation.result import Table
from dvae.motion.data.dataset import MotionData
from dvae.motion.drawing.player import SCRIPT, STYLE, animate, controls, stage
from dvae.motion.drawing.plot import make_scene
from dvae.runs.report import Section, document, missing_part, sections
from dvae.runs.report.page import tabulated

SMALL = ["--windows", "2", "--samples", "3", "--bound-windows", "3", "--particles", "4"]
EVIL = "<script>said=1</script><img src=x onerror=said=1>$\\frac$"
FRAMES = 75  # of a window of simulated people
SIDES = (("left", "right"), ("top", "bottom"))


def report(*arguments, code=0):
    assert main(["report", *SMALL, *map(str, arguments)]) == code


class Tags(HTMLParser):
    """The tags of a page with their attributes, its text, and the contents of script tags."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.scripts, self.text = [], [], ""
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_data(self, data):
        if self.tags and self.tags[-1][0] == "script" and self.lasttag == "script" and data.strip():
            self.scripts.append(data)
        self.text += data


def assert_harmless(page):
    """Assert that the page has only our script, fetches nothing and has no event attributes."""
    tags = Tags(page)
    assert "".join(tags.scripts).strip() == SCRIPT.strip()
    assert sum(tag == "script" for tag, _ in tags.tags) == 1
    for tag, attributes in tags.tags:
        assert not [name for name in attributes if name.startswith("on")]
        assert tag not in ("iframe", "object", "embed", "base", "form")
        for name in ("src", "href"):
            assert attributes.get(name, "#").startswith(("#", "data:")), attributes
    return tags


@pytest.fixture(scope="module")
def page(fitted, tmp_path_factory):
    out = tmp_path_factory.mktemp("page") / "deep" / "report.html"
    report(fitted, "--out", out)
    return out


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("profile")) as tab:
        yield tab


def test_every_section_is_present_and_missing_records_name_their_command(page, fitted):
    text = assert_harmless(page.read_text(encoding="utf-8")).text
    for title in ("Run", "Equations", "Learning curves", "Scores", "Posterior against prior", "Futures"):
        assert title in text
    for name, file in (("evaluate", "evaluation.json"), ("check calibration", "calibration.json")):
        assert f"The run has no {file}" in text
        assert f"dvae {name} {fitted}" in text
    assert "finished at step 10 of 10, seed 0" in text
    assert "exact" in text


def test_the_same_seed_gives_the_same_page(page, fitted, tmp_path):
    report(fitted, "--out", tmp_path / "report.html")
    assert (tmp_path / "report.html").read_bytes() == page.read_bytes()


@pytest.fixture(scope="module")
def people_page(tmp_path_factory):
    people = motion.simulate(clips=3, frames=30, seed=2)
    positions = np.stack([clip.positions for clip in people])
    path = tmp_path_factory.mktemp("people") / "people.html"
    animate(people.skeleton, positions[0, :5], positions[1:, 5:], positions[0, 5:], title="people " * 20).save(path)
    return path


@pytest.mark.parametrize("mode", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390, 360])
@pytest.mark.parametrize("name", ["page", "people_page"])
def test_pages_fit_the_width_and_are_legible_without_network_requests(request, tab, name, width, mode):
    tab.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": mode}])
    tab.open(request.getfixturevalue(name), width)
    tab.wait("document.querySelector('.controls').dataset.frames")
    assert tab.ask("document.documentElement.scrollWidth") <= width
    assert tab.ask("[...document.images].every(image => image.complete && image.naturalWidth)")
    boxes = tab.ask(
        "[...document.querySelector('.controls').children].map(each => each.getBoundingClientRect().toJSON())"
        ".filter(box => box.width)"
    )
    for first, second in combinations(boxes, 2):
        assert any(first[end] <= second[start] or second[end] <= first[start] for start, end in SIDES)
    sizes = "[...document.querySelectorAll('body *')].map(each => parseFloat(getComputedStyle(each).fontSize))"
    assert tab.ask(f"Math.min(...{sizes})") >= 8 * 96 / 72
    paper = tab.ask("getComputedStyle(document.querySelector('.controls')).backgroundColor")
    assert (max(map(int, re.findall(r"\d+", paper)[:3])) < 60) == (mode == "dark")
    assert (tab.said, tab.asked) == ([], [])


def test_the_player_plays_scrubs_and_rotates(page, tab):
    picture = "document.querySelector('canvas').toDataURL()"
    slider = "document.querySelector('.controls input')"
    tab.open(page, 1280)
    tab.wait("document.querySelector('.controls').dataset.frames")
    assert int(tab.ask("document.querySelector('.controls').dataset.frames")) == FRAMES
    pictures = [tab.ask(picture)]
    for action in (
        f"{slider}.value = 20; {slider}.dispatchEvent(new Event('input'))",
        "document.querySelector('canvas').dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowLeft'}))",
        "document.querySelector('select').selectedIndex = 1; "
        "document.querySelector('select').dispatchEvent(new Event('change'))",
    ):
        tab.ask(action)
        tab.wait(f"{picture} !== {json.dumps(pictures[-1])}")
        pictures.append(tab.ask(picture))
    assert len(set(pictures)) == len(pictures)
    middle = tab.ask(
        "(b => [b.x + b.width / 2, b.y + b.height / 2])(document.querySelector('canvas')"
        ".getBoundingClientRect(document.querySelector('canvas').scrollIntoView()))"
    )
    for kind, x in (("mousePressed", 0), ("mouseMoved", 60), ("mouseReleased", 60)):
        position = {"x": middle[0] + x, "y": middle[1]}
        tab.call("Input.dispatchMouseEvent", type=kind, button="left", buttons=1, clickCount=1, **position)
    tab.wait(f"{picture} !== {json.dumps(pictures[-1])}")
    tab.ask("document.querySelector('.controls button').click()")
    tab.wait(f"0 < {slider}.value && {slider}.value < {FRAMES - 1}")
    tab.wait(f"{slider}.value == {FRAMES - 1}")  # the 2.5 s of the window
    assert tab.ask("document.querySelector('.controls button').textContent") == "Play"
    assert tab.said == []


def test_the_browser_decodes_the_motion(tmp_path, tab):
    people = motion.simulate(clips=3, frames=12, seed=2)
    positions = np.stack([clip.positions for clip in people])
    scene = make_scene(people.skeleton, positions[0, :5], positions[1:, 5:], positions[0, 5:9], every=1)
    path = tmp_path / "page.html"
    path.write_text(
        document("motion", [Section("a", before=controls("b") + stage([scene]))], [SCRIPT]), encoding="utf-8"
    )
    tab.open(path, 800)
    script = "opened(JSON.parse(document.querySelector('.stage').dataset.motion)[0])"
    values = tab.ask(
        f"{script}.then(scene => scene.people.map((person, k) => [...Array(12).keys()].map(frame => "
        "[...scene.values.slice(scene.at(person, frame), scene.at(person, frame) + 51)])))"
    )
    decoded = np.array(values).reshape(3, 12, 17, 3) / 1000
    np.testing.assert_allclose(decoded[1:], scene.motion[1:], atol=0.00051)
    np.testing.assert_allclose(decoded[0, :9], scene.motion[0, :9], atol=0.00051)  # the truth ends here
    assert tab.said == []


@pytest.fixture(scope="module")
def scored(fitted, tmp_path_factory):
    """Return a run with all records that a report can show."""
    run = shutil.copytree(fitted, tmp_path_factory.mktemp("scored") / "run")
    assert main(["evaluate", str(run), "--samples", "2"]) == 0
    assert main(["check", "calibration", str(run), "--simulations", "20", "--draws", "9", "--ranked-steps", "1"]) == 0
    few = ["--temperatures", "2", "--chains", "2", "--particles", "2", "--fitting", "2"]
    assert main(["check", "gap", str(run), "--count", "2", *few]) == 0
    assert main(["check", "coverage", str(run), "--samples", "4", "--level", "0.4"]) == 0
    few = ["--draws", "8", "--chains", "2", "--warmup", "2", "--stein-draws", "9"]
    assert main(["check", "posterior", str(run), "--windows", "1", "--frames", "2", *few]) == 0
    return run


def test_records_of_a_run_are_reported(scored, tmp_path):
    run = {"a": dvae.load(scored)}
    evaluation = dvae.Evaluation.load(scored / "evaluation.json")
    makers = (
        sections.overview,
        sections.evaluated,
        sections.calibration,
        sections.bracketed,
        sections.reference_posteriors,
    )
    facts, scores, criticism, bracket, posterior, bands = (
        Tags(document("a", [make(run)])).text for make in (*makers, sections.prediction_bands)
    )
    assert "ADE" not in facts  # each score is shown once
    assert "lowest" in facts or "best bound" in facts
    for row in evaluation.rows:
        assert str(evaluation[row]["ADE"]) in scores
        assert str(evaluation.skill(row)) in scores
    assert len(evaluation.verdicts) == 1  # of one model, which has hardly been trained
    assert evaluation.verdicts[0] in scores
    assert "changed" not in scores
    assert json.loads((scored / "calibration.json").read_text())["calibration"]["summary"]["verdict"] in criticism
    assert "bone stretch (%)" in criticism
    assert "AIS, L = 2, K = 2" in bracket
    assert "amortisation" in bracket
    assert json.loads((scored / "posterior.json").read_text())["stein"]["summary"]["verdict"] in posterior
    assert "compared with the posterior of 1 sequences" in posterior
    assert "calibrated 40 %" in bands
    pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})"
    dvae.ablate(pair, steps=2, surrogates=1).save(tmp_path / "a.json")
    edges = document("a", [sections.edges(dvae.Ablation.load(tmp_path / "a.json"))])
    assert "z_{t-1} to z_t" in Tags(edges).text
    assert "<img" in edges
    (tmp_path / "none.json").write_text("{}")
    assert main(["report", str(scored), "--out", "a.html", "--edges", str(tmp_path / "none.json")]) == 2


def test_bounds_omit_scores_that_are_shown_above(fitted, scored):
    few = sections.SelectedWindows(dvae.load(fitted).data.windows("test"), 3)
    unscored, omitted = (document("a", [sections.weighed({"a": dvae.load(run)}, few, 4)]) for run in (fitted, scored))
    assert "Of 3 test windows, evenly spread, with K = 4 particles each." in unscored
    assert "ELBO ↑" in unscored
    assert "ELBO ↑" not in omitted
    assert "IWAE bound" in omitted


def test_scores_of_an_older_state_of_the_run_are_marked(scored, tmp_path):
    run = shutil.copytree(scored, tmp_path / "run")
    config = json.loads((run / "config.json").read_text())
    config["training"]["steps"] += 1  # as `dvae resume --steps` does
    (run / "config.json").write_text(json.dumps(config))
    runs = {"a": dvae.load(run)}
    assert "The run has changed since it was scored" in document("a", [sections.evaluated(runs)])


def test_several_runs_are_compared_in_one_page(people, fitted, tmp_path):
    other = tmp_path / "other"
    training = dvae.Training(steps=1, batch_size=4, progress=False)
    dvae.fit(dvae.method("storn", latent=3, warm_up=1), MotionData.open(people), out=other, **vars(training))
    report(fitted, other, "--out", tmp_path / "a.html")
    tags = assert_harmless((tmp_path / "a.html").read_text(encoding="utf-8"))
    assert sum(attributes.get("class") == "controls" for _, attributes in tags.tags) == 1
    assert "Runs Futures Scores Equations" in tags.text  # links, in the order of the sections
    assert sum(attributes.get("class") == "stage" for _, attributes in tags.tags) == 2
    assert "difference to the best" in tags.text


def test_a_model_without_a_likelihood_gets_a_note():
    windows = dvae.ArrayWindows(np.zeros((2, 4, 1), np.float32), 2)
    run = SimpleNamespace(model=SimpleNamespace(likelihood=False))
    assert "The model has no likelihood" in sections.weighed({"a": run}, windows).cells["a"]


def test_stages_move_together_at_one_scale(tmp_path, tab):
    people = motion.simulate(clips=2, frames=12, seed=2)
    walk, other = (clip.positions for clip in people)
    near, far = (make_scene(people.skeleton, walk[:5], other[None, 5:] + np.array([x, 0, 0])) for x in (0, 3))
    cells = {"near": stage([near]), "far": stage([far])}
    text = document("a", [Section("b", cells, before=controls("c"))], [SCRIPT], STYLE)
    (tmp_path / "a.html").write_text(text, encoding="utf-8")
    pictures = "[...document.querySelectorAll('canvas')].map(canvas => canvas.toDataURL())"
    tab.open(tmp_path / "a.html", 390)
    tab.wait("document.querySelector('.controls').dataset.frames")
    seen = [tab.ask(pictures)]
    for key in ("ArrowLeft", "ArrowUp"):  # in one stage
        tab.ask(f"document.querySelector('canvas').dispatchEvent(new KeyboardEvent('keydown', {{key: '{key}'}}))")
        seen.append(tab.ask(pictures))
    tab.ask(
        "(slider => { slider.value = 2; slider.dispatchEvent(new Event('input')); })(document.querySelector('input'))"
    )
    seen.append(tab.ask(pictures))
    assert all(len(set(stages)) == len(seen) for stages in zip(*seen, strict=True))
    assert seen[-1][0] == seen[-1][1]  # both observed the same, in the same camera
    assert tab.said == []


def test_more_than_five_columns_of_scores_open_with_a_click():
    table = Table()
    for n in range(8):
        table.add_column(f"column {n}")
    table.add_row(*(f"value {n}" for n in range(8)))
    shown, _, opened = tabulated(table).partition("<details>")
    assert "value 5" in shown
    assert "value 6" not in shown
    assert all(text in opened for text in ("2 more columns", "value 0", "value 6", "value 7"))
    assert "column 1" not in tabulated(table, ["column 1"])


def test_content_shared_by_runs_is_shown_once():
    page = document(
        "a",
        [Section("b", {"first": missing_part("same"), "second": missing_part("same"), "third": missing_part("else")})],
    )
    text = Tags(page).text
    assert text.count("same") == text.count("else") == 1
    assert "first, second" in text


def test_a_run_without_data_or_log_gets_a_partial_report(run, tmp_path):
    config = json.loads((run / "config.json").read_text())
    config["data"]["path"] = str(tmp_path / "gone.npz")
    (run / "config.json").write_text(json.dumps(config))
    (run / "log.jsonl").unlink()
    (run / "evaluation.json").write_text("[1")
    (run / "calibration.json").symlink_to(run / "config.json")
    report(run, "--out", tmp_path / "a.html")
    text = assert_harmless((tmp_path / "a.html").read_text(encoding="utf-8")).text
    for text_part in ("give their path with --data", "no log.jsonl", "not written by Evaluation", "is a link"):
        assert text_part in text


def test_text_of_a_hostile_run_is_escaped(scored, tmp_path, tab):
    run = shutil.copytree(scored, tmp_path / EVIL.replace("/", "⁄"))

    text = (run / "evaluation.json").read_text()
    for name in ("zero velocity", "nearest neighbours", "mm/frame", "ADE", "nats/frame"):
        text = text.replace(json.dumps(name), json.dumps(f"{name}{EVIL}"))
    (run / "evaluation.json").write_text(text)
    criticism = json.loads((run / "calibration.json").read_text())
    ranks, checks = criticism["calibration"]["attributes"], criticism["predictive"]
    ranks["names"][-1] = EVIL
    ranks["equations"] = {"inference": EVIL}
    checks["attributes"]["models"] = {EVIL: checks["attributes"]["models"]["vae"]}
    checks["attributes"]["notes"] = [EVIL]
    checks["models"] = [EVIL]
    (run / "calibration.json").write_text(json.dumps(criticism))
    rows = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    (run / "log.jsonl").write_text("".join(json.dumps({**row, f"kl/{EVIL}": 1.0}) + "\n" for row in rows))
    report(run, "--out", tmp_path / "a.html")
    text = assert_harmless((tmp_path / "a.html").read_text(encoding="utf-8")).text
    assert text.count(EVIL) >= 8
    tab.open(tmp_path / "a.html", 1280)
    tab.wait("document.querySelector('.controls').dataset.frames")
    assert tab.ask("typeof said") == "undefined"
    assert (tab.said, tab.asked) == ([], [])


def test_an_injected_script_does_not_run(tmp_path, tab):
    (tmp_path / "a.html").write_text(document("a", [Section("b", before=Markup(EVIL))], [SCRIPT]), encoding="utf-8")
    tab.open(tmp_path / "a.html", 800)
    assert tab.ask("typeof said") == "undefined"
    assert len([each for each in tab.said if "Content Security Policy" in json.dumps(each)]) >= 2


@pytest.mark.parametrize("before", [None, b"an older page"])
def test_an_interrupted_report_leaves_no_partial_page(fitted, tmp_path, monkeypatch, before):
    class Torn(str):
        def encode(self, *_, **__):
            raise KeyboardInterrupt

    out = tmp_path / "report.html"
    if before is not None:
        out.write_bytes(before)
    monkeypatch.setattr("dvae.cli.report.OF_DIRECTORIES", ())
    monkeypatch.setattr("dvae.cli.report.document", lambda *_: Torn())
    report(fitted, "--out", out, "--windows", 0, code=130)
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"] * (before is not None)
    assert before is None or out.read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--out page.png", "end the name in .html"),
        ("--out page.html --samples 0", "--samples is 0; it must be at least 1"),
        ("--out page.html --windows -1", "--windows is -1; it must be at least 0"),
    ],
)
def test_wrong_arguments_exit_with_2_before_any_work(capsys, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert main(["report", "nowhere", *arguments.split()]) == 2
    assert message in re.sub(r"\s+", " ", capsys.readouterr().err.replace("│", " "))
    assert not list(tmp_path.iterdir())
