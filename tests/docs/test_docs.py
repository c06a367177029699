"""Pages: their examples run, their commands parse, and their links and names exist."""

import functools
import pkgutil
import re
import shlex
from pathlib import Path

import pytest

import dvae  # noqa: F401  sets up Pyro before an example does
from dvae.cli import app
from dvae.cli import main as command

ROOT = Path(__file__).parents[2]
MADE = ("project/changelog", "project/contributing", "reference/command_line", "results/appendix")  # with the site
GENERATED = {ROOT / "docs" / f"{name}.md" for name in MADE}
PAGES = sorted({*(ROOT / "docs").rglob("*.md")} - GENERATED)
BLOCK = re.compile(r"(<!-- not run: [^\n]+ -->\n+)?^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)


def blocks(page):
    """Return the line and text of every Python block of a page that is not marked as not run."""
    text = page.read_text(encoding="utf-8")
    return [(text.count("\n", 0, match.start(2)), match[2]) for match in BLOCK.finditer(text) if not match[1]]


WITH_EXAMPLES = [page for page in PAGES if blocks(page)]


@pytest.mark.parametrize("page", WITH_EXAMPLES, ids=lambda page: page.stem)
def test_examples_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    variables = {}
    for line, block in blocks(page):
        exec(compile("\n" * line + block, str(page), "exec", dont_inherit=True), variables)


def test_printed_results_are_those_in_comments(capsys, tmp_path, monkeypatch):
    page = ROOT / "docs" / "reference" / "notation.md"
    test_examples_run(page, tmp_path, monkeypatch)
    results = re.findall(r"^print\(.*\)  # (.*[)}])$", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert results
    assert not set(results) - set(capsys.readouterr().out.splitlines())


COMMANDS = {
    f"{path.stem}: {line}": line
    for path in [*PAGES, ROOT / "README.md"]
    for block in re.findall(
        r"^```console\n(.*?)^```|((?:^    dvae .*\n)+)", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )
    for line in "".join(block).replace("\\\n", " ").splitlines()
    if line.strip().startswith("dvae ") and "…" not in line
}


@pytest.mark.parametrize("line", COMMANDS.values(), ids=COMMANDS)
def test_commands_parse(line, monkeypatch, tmp_path):
    """The command exists, and so do its options; it is not run."""

    def parser(given, import_command=app.command):
        function = import_command(given)
        return function and functools.wraps(function)(lambda *_, **__: None)

    monkeypatch.setattr(app, "command", parser)
    monkeypatch.chdir(tmp_path)
    assert command(shlex.split(line, comments=True)[1:]) == 0


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_of_a_page_exist(page):
    for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", page.read_text(encoding="utf-8")):
        linked = (page.parent / target).resolve()
        assert linked.exists() or linked in GENERATED, target
        site = ROOT / "docs", ROOT / "notebooks"
        assert any(map(linked.is_relative_to, site)), f"{target} is not on the site"


@pytest.mark.parametrize("page", sorted(ROOT.glob("*.md")), ids=lambda page: page.stem)
def test_links_of_a_file_of_the_root_exist(page):
    for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", page.read_text(encoding="utf-8")):
        assert (ROOT / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_names_of_the_library_on_a_page_exist(page):
    for name in re.findall(r"\bdvae(?:\.[A-Za-z_]\w*)+", page.read_text(encoding="utf-8")):
        try:
            pkgutil.resolve_name(name)
        except (AttributeError, ImportError):
            pytest.fail(f"{page.name} speaks of {name}")


SECTIONS = {
    "reference/methods.md": "## The papers' own runs",
    "explanation/latent_space.md": "The paper's data and training",
}
PUBLISHED = [
    line
    for page, start in SECTIONS.items()
    for line in re.findall(
        r"^ *dvae ((?:data convert|fit|evaluate) .+)$",
        re.sub(r"\\\n *", "", (ROOT / "docs" / page).read_text(encoding="utf-8").partition(start)[2]).partition(
            "\n## "
        )[0],
        re.MULTILINE,
    )
]


def test_the_methods_of_the_papers_have_published_runs():
    assert {"gsps", "hit-dvae", "trajevae", "dlow", "motion-latent"} <= {line.split()[1] for line in PUBLISHED}


@pytest.mark.parametrize("line", PUBLISHED)
def test_a_published_run_is_missing_only_its_data(line, tmp_path, monkeypatch, capsys):
    """All options of the command are valid."""
    monkeypatch.chdir(tmp_path)
    assert command(shlex.split(line)) == 1
    error = capsys.readouterr().err
    assert re.search(r"^error: (\S+: no such file$|runs/\S+ is not a run directory)", error, re.MULTILINE)


def test_every_page_is_on_the_site():
    trees = re.findall(r"```\{toctree\}\n(.*?)```", (ROOT / "docs" / "index.md").read_text(encoding="utf-8"), re.DOTALL)
    entries = {line for tree in trees for line in tree.splitlines() if line and not line.startswith(":")} - {
        "Start <self>"
    }
    pages = {str(page.relative_to(ROOT / "docs").with_suffix("")) for page in PAGES} - {"index"}
    notebooks = {f"notebooks/{path.stem}" for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert entries == pages | notebooks | {*MADE}
