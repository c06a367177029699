"""Stored scores agree with the present options of methods, and contain no paths of machines."""

import json
import re
import zipfile

import pytest

import dvae
from benchmarks import bench
from benchmarks.studies import engine, pairs, papers, ranking, results, tuning
from dvae.inference.training.checkpoints import Run
from dvae.models.motion.poses import PoseMethod
from dvae.motion import WALKER
from dvae.runs.directory import read_config

SETS = sorted(file.stem for file in ranking.SCORES.glob("*.zip"))
RUNS = [
    (of, run)
    for of in SETS
    for run in dict.fromkeys(name.partition("/")[0] for name in ranking.archive(ranking.SCORES, of).names)
]

LATER = {"published": False, "start_token": True, "positions": "biases"}
"""Options that did not exist when stored runs were fitted, with the values that they had in effect."""
BY_BANDWIDTH = {"coefficients": 15}
"""Options that are None in presets, with their values for 75 frames at 30 Hz."""


DECIMAL = re.compile(r"\d+\.\d+")


def named(file):
    return "/".join(file.relative_to(ranking.SCORES).parts)


@pytest.mark.parametrize("of", SETS)
def test_scores_contain_no_paths(of):
    with zipfile.ZipFile(ranking.SCORES / f"{of}.zip") as archive:
        texts = {name: archive.read(name).decode() for name in archive.namelist()}
    for name, text in texts.items():
        assert '"/' not in text, name
        measurement = json.loads(text)
        (clips,) = {len(means) for row in measurement["rows"].values() for means in row.values()}
        assert clips == len(measurement["clips"]), name


@pytest.mark.parametrize("file", sorted(ranking.SCORES.rglob("metric_models/*/config.json")), ids=named)
def test_metric_models_contain_no_paths(file):
    assert '"/' not in file.read_text(encoding="utf-8")
    assert (file.parent / "best.safetensors").stat().st_size < 2**20
    read_config(file.parent)
    assert Run(file.parent).state["status"] in ("finished", "stopped early")  # of the present format


@pytest.mark.parametrize(("of", "run"), [(of, run) for of, run in RUNS if "seed" in run])
def test_scores_have_the_options_of_their_rows(of, run):
    """If a preset changes, its rows must be fitted again."""
    archive, row = ranking.archive(ranking.SCORES, of), run.rpartition("-seed")[0]
    (options,) = {
        json.dumps(options): options
        for methods in (ranking.SETS[of].methods, *(paper.rows for paper in papers.PAPERS.values() if paper.set == of))
        for name, options in methods.items()
        if engine.folder(name) == row
    }.values()
    method_options, training = ranking.split_options(options)
    method = dvae.method(method_options.pop("method", row), **method_options)
    stored_runs = archive.read(name for name in archive.names if name.startswith(f"{run}/"))
    (stored,) = {json.dumps(each["config"]) for each in stored_runs}
    stored = json.loads(stored)
    if "learned_prior" in stored["method"]:  # former name of the option `prior` of trajevae
        stored["method"]["prior"] = "learned" if stored["method"]["learned_prior"] else "standard"
    now = {name: value for name, value in method.config().items() if value is not None and not name.endswith("_run")}
    preset = method.preset(WALKER) if isinstance(method, PoseMethod) else {}
    for name, value in json.loads(json.dumps({**preset, **now})).items():
        if name.startswith("pseudo_") and stored["method"]["multimodal"] == 0:
            continue  # only the multimodal term reads it
        assert {**LATER, **stored["method"]}[name] == (BY_BANDWIDTH[name] if value is None else value), name
    now = {**vars(method.trainings[""]), **training}
    for name in ("steps", "batch_size", "learning_rate", "decay"):
        assert stored["training"][name] == now[name], name


def test_tables_agree_with_the_scores(tmp_path):
    """Compare all tables from stored scores with the files."""
    tuning.main(tmp_path, results=tmp_path)
    papers.main(tmp_path, results=tmp_path, pictures=tmp_path)
    ranking.main(tmp_path, results=tmp_path, picture=tmp_path / "ranking.png")
    pairs.main(results=tmp_path)
    bench.tabulate(json.loads(bench.HISTORY.read_text()), tmp_path)
    files = [*tmp_path.glob("*/*.csv"), *tmp_path.glob("*/*.txt")]
    assert {file.parent.name for file in files} == {"gsps", "hit_dvae", "index", "speed", "trajevae", "tuning"}
    for file in files:
        made, stored = file.read_text(), (results.RESULTS / file.relative_to(tmp_path)).read_text()
        assert DECIMAL.sub("#", made) == DECIMAL.sub("#", stored), file
        for one, other in zip(DECIMAL.findall(made), DECIMAL.findall(stored), strict=True):
            digits = len(one.partition(".")[2])  # versions of NumPy round a mean such as 2.3825 differently
            assert len(other.partition(".")[2]) == digits, file
            assert abs(float(one) - float(other)) < 1.5 * 10.0**-digits, file


@pytest.mark.parametrize("name", ["metric_models", *tuning.SECTIONS])
def test_every_tuned_case_is_in_a_table(name):
    """Tables have a row for each scored case."""
    scores = tuning.Store(ranking.SCORES / "tuning.json", name).scores
    assert scores
    assert scores.keys() <= set(tuning.OF_METRIC_MODELS if name == "metric_models" else tuning.SECTIONS[name].cases)
    assert scores.keys() <= {row[0] for row in results.read(f"tuning/{name}").rows}


def test_deviations_over_seeds_agree_with_the_rows_on_test_windows():
    deviations = {row: float(deviation) for row, _, deviation, _ in tuning.spread().rows}
    rows = ranking.SETS["bandai2-by-style"].methods
    for row, entry in ranking.entries(ranking.SCORES, "bandai2-by-style", ranking.View(), rows).items():
        if row in rows:
            error = entry.estimate("energy score").seeds
            assert deviations[row] == pytest.approx(error * len(entry.runs) ** 0.5, abs=6e-4)


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
