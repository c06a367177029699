"""The section of the README on any table: its commands run as they stand, on the file that it makes."""

import re
import shlex
from pathlib import Path

import pytest

from dvae.cli import main

ROOT = Path(__file__).parents[2]
SMALL = {
    "sweep": "--steps 4 --seeds 0 1 --jobs 1 --batch-size 4 --validate-every 2",
    "compare": "--particles 4 --contrasts 0",
    "evaluate": "--samples 39",
    "forecast": "--samples 4",
}


@pytest.mark.filterwarnings("ignore:.*it is shortened to:UserWarning")
@pytest.mark.filterwarnings(
    "ignore:columns left out of the proposed schema. 'iso_alpha' .neither numbers nor:UserWarning"
)
def test_the_commands_on_any_table_run(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    (section,) = re.findall(r"## Any table\n(.*?)\n## ", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    (made,) = re.findall(r'python -c "(.*)"', section)
    exec(compile(made, "README.md", "exec"), {})
    (proposed,) = re.findall(r"`dvae (data info .*)`", section)
    assert main(shlex.split(proposed)) == 0
    assert (tmp_path / "countries.toml").read_text(encoding="utf-8").startswith('id = ["country"]\ntime = "year"\n')
    rows = [re.findall(r"[\w.+-]+", row) for row in re.findall(r"^    │.*", section, re.MULTILINE)]
    printed = [re.findall(r"[\w.+-]+", row) for row in capsys.readouterr().out.splitlines()]
    assert rows
    assert all(row in printed for row in rows)

    (corrected,) = re.findall(r"```toml\n(.*?)```", section, re.DOTALL)
    (tmp_path / "countries.toml").write_text(corrected, encoding="utf-8")
    commands = [shlex.split(line) for line in re.findall(r"^    dvae (.*)", section, re.MULTILINE)]
    assert [name for name, *_ in commands] == ["sweep", "compare", "evaluate", "forecast"]
    for name, *words in commands:
        found = [str(path) for word in words for path in (sorted(tmp_path.glob(word)) if "*" in word else [word])]
        assert main([name, *found, *shlex.split(SMALL[name])]) == 0, capsys.readouterr().err
    judged = capsys.readouterr().out
    for said in (
        "IWAE bound",
        "climatology",
        "CRPS, lifeExp ↓ (years)",
        "CRPS, gdpPercap ↓ ($)",
        "coverage 90 %",
    ):
        assert said in section
        assert said in judged
    table = (tmp_path / "next.csv").read_text(encoding="utf-8").splitlines()
    assert len(table) == 1 + 142 * 3 * 3
    assert (tmp_path / "next.png").read_bytes().startswith(b"\x89PNG")
