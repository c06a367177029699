"""Scores that are kept are of what methods are today, and tell nothing of the machines that made them."""

import json
import zipfile

import pytest

import dvae
from benchmarks import bench
from benchmarks.studies import engine, pairs, papers, ranking, results, tuning
from dvae.models.motion.poses import PoseMethod
from dvae.motion import WALKER

SETS = sorted(file.stem for file in ranking.SCORES.glob("*.zip"))
RUNS = [
    (of, run)
    for of in SETS
    for run in dict.fromkeys(name.partition("/")[0] for name in ranking.archive(ranking.SCORES, of).names)
]


def named(file):
    return "/".join(file.relative_to(ranking.SCORES).parts)


@pytest.mark.parametrize("of", SETS)
def test_scores_name_no_place(of):
    with zipfile.ZipFile(ranking.SCORES / f"{of}.zip") as archive:
        texts = {name: archive.read(name).decode() for name in archive.namelist()}
    for name, text in texts.items():
        assert '"/' not in text, name
        told = json.loads(text)
        (clips,) = {len(means) for row in told["rows"].values() for means in row.values()}
        assert clips == len(told["clips"]), name


@pytest.mark.parametrize("file", sorted(ranking.SCORES.rglob("metric_models/*/config.json")), ids=named)
def test_judges_name_no_place(file):
    assert '"/' not in file.read_text(encoding="utf-8")
    assert (file.parent / "best.safetensors").stat().st_size < 2**20
    assert json.loads((file.parent / "state.json").read_text(encoding="utf-8"))["status"] in (
        "finished",
        "stopped early",
    )


@pytest.mark.parametrize(("of", "run"), [(of, run) for of, run in RUNS if "seed" in run])
def test_scores_are_of_the_presets(of, run):
    """With the options of their rows, as if fitted now; where a preset changes, its rows are to be made again."""
    archive, row = ranking.archive(ranking.SCORES, of), run.rpartition("-seed")[0]
    (options,) = {
        json.dumps(options): options
        for methods in (ranking.SETS[of].methods, *(paper.rows for paper in papers.PAPERS.values() if paper.set == of))
        for name, options in methods.items()
        if engine.folder(name) == row
    }.values()
    told, training = ranking.parted(options)
    method = dvae.method(told.pop("method", row), **told)
    kept = archive.read(name for name in archive.names if name.startswith(f"{run}/"))
    (stored,) = {json.dumps(each["config"]) for each in kept}
    stored = json.loads(stored)
    now = {name: value for name, value in method.config().items() if value is not None and not name.endswith("_run")}
    preset = method.preset(WALKER) if isinstance(method, PoseMethod) else {}
    for name, value in json.loads(json.dumps({**preset, **now})).items():
        if name.startswith("pseudo_") and stored["method"]["multimodal"] == 0:
            continue  # is read by that term alone
        assert stored["method"][name] == value, name
    now = {**vars(method.trainings[""]), **training}
    for name in ("steps", "batch_size", "learning_rate", "decay"):
        assert stored["training"][name] == now[name], name


def test_tables_are_those_of_the_scores(tmp_path):
    """All tables that studies make from stored scores."""
    tuning.main(tmp_path, results=tmp_path)
    papers.main(tmp_path, results=tmp_path, pictures=tmp_path)
    ranking.main(tmp_path, results=tmp_path, picture=tmp_path / "ranking.png")
    pairs.main(results=tmp_path)
    bench.tabulate(json.loads(bench.HISTORY.read_text()), tmp_path)
    made = [*tmp_path.glob("*/*.csv"), *tmp_path.glob("*/*.txt")]
    assert {file.parent.name for file in made} == {"gsps", "hit_dvae", "index", "speed", "trajevae", "tuning"}
    for file in made:
        assert file.read_text() == (results.RESULTS / file.relative_to(tmp_path)).read_text(), file


@pytest.mark.parametrize("name", ["metric_models", *tuning.SECTIONS])
def test_what_was_tuned_is_in_a_table(name):
    """Every case that was scored, by the name that it has there."""
    found = tuning.Store(ranking.SCORES / "tuning.json", name).found
    assert found
    assert found.keys() <= set(tuning.OF_METRIC_MODELS if name == "metric_models" else tuning.SECTIONS[name].cases)
    assert found.keys() <= {row[0] for row in results.read(f"tuning/{name}").rows}


def test_what_another_seed_does_is_that_of_the_rows_on_test_windows():
    told = {row: float(deviation) for row, _, deviation, _ in tuning.spread().rows}
    rows = ranking.SETS["bandai2-by-style"].methods
    for row, entry in ranking.entries(ranking.SCORES, "bandai2-by-style", ranking.View(), rows).items():
        if row in rows:
            error = entry.estimate("energy score").seeds
            assert told[row] == pytest.approx(error * len(entry.runs) ** 0.5, abs=6e-4)


@pytest.mark.parametrize("readme", sorted(results.RESULTS.glob("*/README.md")), ids=lambda file: file.parent.name)
def test_every_table_can_be_read(readme):
    """A folder has a short text; a table has one name for each column and as many cells in each row."""
    text = readme.read_text(encoding="utf-8")
    assert text.startswith("# ")
    assert len(text.split()) <= 150
    files = sorted(readme.parent.glob("*.csv"))
    assert files
    for file in files:
        table = results.read(f"{readme.parent.name}/{file.stem}")
        assert len({*table.header}) == len(table.header), file
        assert table.rows, file
        assert {len(row) for row in table.rows} == {len(table.header)}, file


def test_every_folder_of_tables_has_a_text():
    folders = {path for path in results.RESULTS.iterdir() if path.is_dir()}
    assert folders == {readme.parent for readme in results.RESULTS.glob("*/README.md")}
