"""The README: its example has the scores that it prints, and its commands for a table run."""

import re
import shlex

import numpy as np
import pytest

from benchmarks.studies.overview import DOCS, example
from dvae.cli import main

README = (DOCS.parent / "README.md").read_text(encoding="utf-8")
SMALL = {"fit": "--steps 4 --batch-size 4 --validate-every 2", "evaluate": "--samples 39", "forecast": "--samples 4"}


@pytest.mark.slow
def test_the_example_beats_every_reference_and_is_calibrated():
    scores = example()["scores"]
    references = [name for name in scores.rows if name != "model"]
    assert references == ["last value", "mean", "climatology", "nearest neighbours"]
    for name in references:
        difference = scores.difference("model", name, "CRPS")
        assert difference.mean < -3 * difference.standard_error, name
    coverage = scores["model"]["coverage 90 %"]
    assert abs(coverage.mean - 0.9) < 2 * coverage.standard_error


def test_the_readme_is_short():
    assert README.count("\n") <= 120


@pytest.mark.filterwarnings("ignore:.*it is shortened to:UserWarning")
def test_the_commands_for_a_table_run(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    rows = [
        f"country{place},{'ab'[place % 2]},{year},{rng.normal(60, 5):.1f},"
        f"{rng.integers(10**5, 10**7)},{rng.gamma(2):.2f}\n"
        for place in range(30)
        for year in range(1952, 2012, 5)
    ]
    header = "country,continent,year,lifeExp,pop,gdpPercap\n"
    (tmp_path / "countries.csv").write_text("".join([header, *rows]), encoding="utf-8")
    (section,) = re.findall(r"## A CSV in four commands\n(.*?)\n## ", README, re.DOTALL)
    commands = [shlex.split(line, comments=True) for line in re.findall(r"^dvae (.*)", section, re.MULTILINE)]
    assert [name for name, *_ in commands] == ["data", "fit", "evaluate", "forecast"]
    for arguments in commands:
        assert main([*arguments, *shlex.split(SMALL.get(arguments[0], ""))]) == 0, capsys.readouterr().err
    assert "climatology" in capsys.readouterr().out
    assert (tmp_path / "next.csv").read_text(encoding="utf-8").count("country29") > 1
    assert (tmp_path / "next.png").read_bytes().startswith(b"\x89PNG")
