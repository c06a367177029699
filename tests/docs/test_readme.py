"""The README's section on tables: its commands run unchanged, on the file that it creates."""

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
def test_the_commands_of_the_readme_on_tables_run(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    (section,) = re.findall(r"## Any table\n(.*?)\n## ", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    (script,) = re.findall(r'python -c "(.*)"', section)
    exec(compile(script, "README.md", "exec"), {})
    (command,) = re.findall(r"`dvae (data info .*)`", section)
    assert main(shlex.split(command)) == 0
    assert (tmp_path / "countries.toml").read_text(encoding="utf-8").startswith('id = ["country"]\ntime = "year"\n')
    rows = [re.findall(r"[\w.+-]+", row) for row in re.findall(r"^    │.*", section, re.MULTILINE)]
    printed_rows = [re.findall(r"[\w.+-]+", row) for row in capsys.readouterr().out.splitlines()]
    assert rows
    assert all(row in printed_rows for row in rows)

    (schema,) = re.findall(r"```toml\n(.*?)```", section, re.DOTALL)
    (tmp_path / "countries.toml").write_text(schema, encoding="utf-8")
    commands = [shlex.split(line) for line in re.findall(r"^    dvae (.*)", section, re.MULTILINE)]
    assert [name for name, *_ in commands] == ["sweep", "compare", "evaluate", "forecast"]
    for name, *words in commands:
        arguments = [str(path) for word in words for path in (sorted(tmp_path.glob(word)) if "*" in word else [word])]
        assert main([name, *arguments, *shlex.split(SMALL[name])]) == 0, capsys.readouterr().err
    output = capsys.readouterr().out
    for text in (
        "IWAE bound",
        "climatology",
        "CRPS, lifeExp ↓ (years)",
        "CRPS, gdpPercap ↓ ($)",
        "coverage 90 %",
    ):
        assert text in section
        assert text in output
    table = (tmp_path / "next.csv").read_text(encoding="utf-8").splitlines()
    assert len(table) == 1 + 142 * 3 * 3
    assert (tmp_path / "next.png").read_bytes().startswith(b"\x89PNG")
