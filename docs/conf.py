"""How the site is made: `make docs`. The pages are those that stand here, the start page is the README."""

import inspect
import os
import pkgutil
import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from sphinx.application import Sphinx  # noqa: E402

import dvae  # noqa: E402

project, author = "dvae", "The dvae authors"
project_copyright = "The dvae authors, Apache License 2.0"
release = version = dvae.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"dvae {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}
templates_path = ["_templates"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4

shutil.copytree(ROOT / "notebooks", ROOT / "docs" / "notebooks", dirs_exist_ok=True)  # a site is of one folder

# Notebooks are run where they leave nothing behind, with this tree's code, and once until they change.
os.environ.update(PYTHONPATH=str(ROOT), OMP_NUM_THREADS="1", PYTHONWARNINGS="ignore:IProgress not found")
nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "docs" / "_build" / "notebooks")
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 1200
nb_output_stderr = "remove"

autosummary_context = {  # of the page of dvae itself
    "names": [name for name in dvae.__all__ if not inspect.ismodule(getattr(dvae, name))],
    "packages": [found.name for found in pkgutil.iter_modules(dvae.__path__) if found.name not in {"command", "cli"}],
}
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
python_maximum_signature_line_length = 100
napoleon_numpy_docstring = False
napoleon_use_rtype = False
suppress_warnings = ["ref.python"]  # names of two classes

# Docstrings are text, not reStructuredText: `code`, *emphasis*, examples, and indented blocks as they stand.
_MARKS = re.compile(
    r"`([^`]+)`(?=(\w)?)|(^ *\* |(?<![\w*])\*(?! )[^*]+(?<! )\*(?!\w))|([*|\\])|(_)(?!\w)", re.MULTILINE
)


def _mark(found: re.Match[str]) -> str:
    code, letter, kept, *signs = found.groups()
    if code:
        return f"``{code}``" + ("\\ " if letter else "")
    return kept or "\\" + "".join(sign or "" for sign in signs)


def _as_text(_app: object, _what: str, _name: str, _object: object, _options: object, lines: list[str]) -> None:
    parts = re.split(r"(^ *>>>(?:.+\n?)+|(?<=\S\n\n)(?:    .*\n+)+)", "\n".join(lines) + "\n", flags=re.MULTILINE)
    for place, part in enumerate(parts):
        before, example = parts[place - 1] if place else "", part.lstrip().startswith(">>>")
        if place % 2 == 0 or (re.search(r"(?:^|\n)(?:[A-Z]\w+:|    .*)\n*\Z", before) and not example):
            parts[place] = _MARKS.sub(_mark, part)  # text, and what a section such as Args holds
        elif not example and not before.rstrip().endswith("::"):
            parts[place] = f"::\n\n{part}\n"
    lines[:] = "".join(parts).split("\n")


def _with_files(_app: object, page: str, source: list[str]) -> None:
    """{{FILE}}, or {{FILE: SECTION}}, is what stands in a file beside this folder, with its links as seen from here.

    Links of notebooks are as seen from the copies.
    """
    if page.startswith("notebooks/"):
        source[0] = source[0].replace("](../docs/", "](../")

    def text(found: re.Match[str]) -> str:
        file, _, section = found[1].partition(": ")
        whole = (ROOT / file).read_text(encoding="utf-8")
        if section:
            whole = whole.partition(f"\n## {section}\n")[2].partition("\n## ")[0]
        return whole.replace("](docs/", "](").replace("](CHANGELOG.md)", "](changelog.md)")

    source[0] = re.sub(r"^\{\{(.+)\}\}$", text, source[0], flags=re.MULTILINE)


def setup(app: Sphinx) -> None:
    """Connect them; docstrings before napoleon, which makes fields of Args, Returns and Raises."""
    app.connect("autodoc-process-docstring", _as_text, priority=400)
    app.connect("source-read", _with_files)
