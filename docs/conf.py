"""Configuration of the site, which `make docs` builds from the pages of this folder."""

import base64
import json
import os
import re
import shutil
import subprocess
import sys
import urllib.request
from contextlib import suppress
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from docutils import nodes  # noqa: E402
from furo.navigation import get_navigation_tree  # noqa: E402
from sphinx.addnodes import pending_xref  # noqa: E402
from sphinx.application import Sphinx  # noqa: E402
from sphinx.transforms import SphinxTransform  # noqa: E402

import dvae  # noqa: E402
from benchmarks.studies import results  # noqa: E402
from dvae.cli.app import COMMANDS  # noqa: E402

project, author = "dvae", "The dvae authors"
project_copyright = "The dvae authors, Apache License 2.0"
release = version = dvae.__version__
extensions = ["myst_nb"]
extensions += [f"sphinx.ext.{name}" for name in ("autodoc", "autosummary", "intersphinx", "napoleon")]

# Types of other libraries link to their pages if these can be reached; the site builds without a network, too.
intersphinx_mapping = {}
for name, address in {
    "python": "https://docs.python.org/3",
    "torch": "https://docs.pytorch.org/docs/stable",
    "pyro": "https://docs.pyro.ai/en/stable",
    "numpy": "https://numpy.org/doc/stable",
    "pandas": "https://pandas.pydata.org/docs",
    "matplotlib": "https://matplotlib.org/stable",
}.items():
    with suppress(OSError), urllib.request.urlopen(f"{address}/objects.inv", timeout=5):
        intersphinx_mapping[name] = (address, None)
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"dvae {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_js_files = ["sort.js"]
html_theme_options = {"navigation_with_keys": True}
templates_path = ["_templates"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4

# A site has one root folder, so it builds from copies of the notebooks and of two files of the repository.
shutil.copytree(ROOT / "notebooks", ROOT / "docs" / "notebooks", dirs_exist_ok=True)
for name in ("CONTRIBUTING", "CHANGELOG"):
    text = (ROOT / f"{name}.md").read_text(encoding="utf-8")
    text = text.replace("](docs/", "](../").replace("](CHANGELOG.md)", "](changelog.md)")
    (ROOT / "docs" / "project" / f"{name.lower()}.md").write_text(text, encoding="utf-8")

# The page of the command line is the help of its commands.
help_of = {"COLUMNS": "110", "NO_COLOR": "1", "PYTHONPATH": str(ROOT)}
parts = [
    "# Command line\n\nLook up the arguments of each command. `--help-all` lists all options of `fit` and `sweep`.\n"
]
for name in COMMANDS:
    program = [sys.executable, "-c", "import dvae.cli as c; c.main()", *name.split(), "--help"]
    printed = subprocess.run(program, env=os.environ | help_of, capture_output=True, text=True, check=True).stdout
    parts.append(f"\n## dvae {name}\n\n```text\n{printed.strip()}\n```\n")
(ROOT / "docs" / "reference" / "command_line.md").write_text("".join(parts), encoding="utf-8")

# The appendix has all tables of results, each subject below the text of its README.
parts = [
    "# All results\n\nClick on the head of a column to sort a table. `benchmarks/results` contains all tables as CSV.\n"
]
for readme in sorted(results.RESULTS.glob("*/README.md")):
    parts.append("\n#" + readme.read_text(encoding="utf-8"))
    for file in sorted(readme.parent.glob("*.csv")):
        table = results.read(f"{readme.parent.name}/{file.stem}")
        parts.append(f"\n### {readme.parent.name}/{file.stem}\n\n{table.note}\n\n")
        parts.append(f"```{{table}}\n:class: sortable\n\n{table.markdown()}```\n")
(ROOT / "docs" / "results" / "appendix.md").write_text("".join(parts), encoding="utf-8")

# Notebooks run in a temporary folder with this tree's code, and again only after a change.
os.environ.update(PYTHONPATH=str(ROOT), OMP_NUM_THREADS="1", PYTHONWARNINGS="ignore:IProgress not found")
nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "docs" / "_build" / "notebooks")
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 1200
nb_output_stderr = "remove"

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
python_maximum_signature_line_length = 100
napoleon_numpy_docstring = False
napoleon_use_rtype = False
suppress_warnings = ["ref.python"]  # names of two classes

# Docstrings are plain text with `code`, *emphasis*, examples and indented blocks; this makes reStructuredText of them.
_MARKS = re.compile(
    r"`([^`]+)`(?=(\w)?)|(^ *\* |(?<![\w*])\*(?! )[^*]+(?<! )\*(?!\w))|([*|\\])|(_)(?!\w)", re.MULTILINE
)


def _mark(match: re.Match[str]) -> str:
    code, letter, unchanged, *signs = match.groups()
    if code:
        return f"``{code}``" + ("\\ " if letter else "")
    return unchanged or "\\" + "".join(sign or "" for sign in signs)


def _as_text(_app: object, _what: str, _name: str, _object: object, _options: object, lines: list[str]) -> None:
    parts = re.split(r"(^ *>>>(?:.+\n?)+|(?<=\S\n\n)(?:    .*\n+)+)", "\n".join(lines) + "\n", flags=re.MULTILINE)
    for index, part in enumerate(parts):
        before, example = parts[index - 1] if index else "", part.lstrip().startswith(">>>")
        if index % 2 == 0 or (re.search(r"(?:^|\n)(?:[A-Z]\w+:|    .*)\n*\Z", before) and not example):
            parts[index] = _MARKS.sub(_mark, part)  # text, and sections such as Args
        elif not example and not before.rstrip().endswith("::"):
            parts[index] = f"::\n\n{part}\n"
    lines[:] = "".join(parts).split("\n")


def _skip_tests(_app: object, _what: str, name: str, *_: object) -> bool | None:
    """Leave the tests of `dvae.testing` out of the reference and of the search."""
    return True if name.startswith("test_") else None


def _shorten_sidebar(_app: object, _page: str, _template: str, context: dict[str, Any], _tree: object) -> None:
    """List pages in the sidebar, and not the objects of the reference."""
    if "toctree" in context:
        html = context["toctree"](collapse=True, titles_only=True, maxdepth=1, includehidden=True)
        context["furo_navigation_tree"] = get_navigation_tree(html)


def _adapt_links(_app: object, page: str, source: list[str]) -> None:
    """Adapt links from and to notebooks to their copies, and add pictures and links to the gallery."""
    if page.startswith("notebooks/"):
        source[0] = source[0].replace("](../docs/", "](../")
    else:
        source[0] = (
            source[0].replace("](../notebooks/", "](notebooks/").replace("](../../notebooks/", "](../notebooks/")
        )
    if page == "gallery":
        source[0] = re.sub(r"^\* ([^[].+), `(.+)` \((\w+)\)$", _thumbnail, source[0], flags=re.MULTILINE)


def _thumbnail(entry: re.Match[str]) -> str:
    """Return an entry of the gallery with the first picture of a cell that contains its call."""
    title, call, name = entry.groups()
    (notebook,) = (ROOT / "notebooks").glob(f"[0-9][0-9]_{name}.ipynb")
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    calling = (cell for cell in cells if call.removesuffix(")") in "".join(cell["source"]))
    outputs = (each for cell in calling for each in cell.get("outputs", ()))
    pictures = (each["data"]["image/png"] for each in outputs if "image/png" in each.get("data", ()))
    if (picture := next(pictures, None)) is None:
        raise ValueError(f"the gallery lists {call}, but no cell of {notebook.name} with it shows a picture")
    file = "notebooks/gallery/" + re.sub(r"\W+", "_", title) + ".png"
    (ROOT / "docs" / file).parent.mkdir(exist_ok=True)
    (ROOT / "docs" / file).write_bytes(base64.b64decode("".join(picture)))
    return f"* [![]({file}) {title}](notebooks/{notebook.name}) `{call}`"


class LinkNames(SphinxTransform):
    """Link names of public objects in the text of pages, such as `dvae.evaluate`, to the reference."""

    default_priority = 5

    def apply(self, **_: object) -> None:
        """Replace each such name by a link."""
        for literal in list(self.document.findall(nodes.literal)):
            name, linked = literal.astext().partition("(")[0], nodes.reference | nodes.title | pending_xref
            if not re.fullmatch(r"dvae(\.\w+)+", name) or isinstance(literal.parent, linked):
                continue
            link = pending_xref("", refdomain="py", reftype="obj", reftarget=name, refexplicit=True, refwarn=False)
            literal.replace_self(link)
            link += literal


def setup(app: Sphinx) -> None:
    """Connect the conversions; docstrings before napoleon, which parses their sections."""
    app.connect("autodoc-process-docstring", _as_text, priority=400)
    app.connect("autodoc-skip-member", _skip_tests)
    app.connect("source-read", _adapt_links)
    app.connect("html-page-context", _shorten_sidebar, priority=900)  # after the theme
    app.add_transform(LinkNames)
