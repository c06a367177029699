"""Pages of the documentation: their examples run from first to last, and their links and names exist."""

import pkgutil
import re
import shlex
from pathlib import Path

import pytest

import dvae  # noqa: F401  importing it changes settings of Pyro, which must not happen in an example
from dvae.cli import main as command

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
EXAMPLES = ("bodies", "families", "latent_space", "new_method", "own_data", "rotations", "tables", "walk")


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_examples_of_a_page_run(name):
    page = ROOT / "docs" / f"{name}.md"
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    assert blocks
    variables = {}
    for block in blocks:
        exec(compile(block, page.name, "exec", dont_inherit=True), variables)


def test_the_outputs_in_comments_of_the_notation_page_are_printed(capsys):
    page = (ROOT / "docs" / "notation.md").read_text(encoding="utf-8")
    test_the_examples_of_a_page_run("notation")
    comments = re.findall(r"^print\(.*\)  # (.*[)}])$", page, re.MULTILINE)
    assert comments
    assert not set(comments) - set(capsys.readouterr().out.splitlines())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_of_a_page_exist(page):
    for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", page.read_text(encoding="utf-8")):
        linked = (page.parent / target).resolve()
        assert linked.exists(), target
        assert linked.is_relative_to(ROOT / "docs"), f"{target} is not on the site"


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


PUBLISHED = re.findall(
    r"^    dvae (fit .+)$",
    (ROOT / "docs" / "methods.md").read_text(encoding="utf-8").partition("## The papers' own runs")[2],
    re.MULTILINE,
)


def test_the_methods_of_the_papers_have_published_runs():
    assert {"gsps", "hit-dvae", "trajevae", "dlow"} <= {line.split()[1] for line in PUBLISHED}


@pytest.mark.parametrize("line", PUBLISHED)
def test_a_published_run_is_missing_only_its_data(line, tmp_path, monkeypatch, capsys):
    """All options of the command are valid."""
    monkeypatch.chdir(tmp_path)
    assert command(shlex.split(line)) == 1
    assert re.search(r"^error: \w+\.npz: no such file$", capsys.readouterr().err, re.MULTILINE)


def test_every_page_is_on_the_site():
    trees = re.findall(r"```\{toctree\}\n(.*?)```", (ROOT / "docs" / "index.md").read_text(encoding="utf-8"), re.DOTALL)
    entries = {line for tree in trees for line in tree.splitlines() if line and not line.startswith(":")} - {
        "Start <self>"
    }
    pages = {str(page.relative_to(ROOT / "docs").with_suffix("")) for page in PAGES} - {"index"}
    notebooks = {f"notebooks/{path.stem}" for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert entries == pages | notebooks
