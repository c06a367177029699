"""A self-contained HTML page with text, tables, pictures and trusted scripts.

All content is escaped, unless it is `Markup`, which only this package and players of applications create. As a second
defence, a content security policy lets the browser load nothing and run only the scripts whose hashes the page lists.
"""

from __future__ import annotations

import base64
import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import rich.table
from markupsafe import Markup
from rich.console import Group, RenderableType
from rich.text import Text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLE = Path(__file__).with_name("page.css").read_text(encoding="utf-8")

DPI = 160
"""Resolution of pictures; their text then has the size of the page's text."""

COLOURS = 64
"""Number of colours of a picture."""

COLUMNS = 6
"""Number of columns of a table at first sight, with the names of its rows; a click opens the others."""


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Args:
        title: heading.
        cells: dictionary from run name to content; equal contents are shown once.
        about: explanation of one or two sentences.
        before: content for all runs together.
    """

    title: str
    cells: Mapping[str, str] = field(default_factory=dict)
    about: str = ""
    before: str = ""


def document(title: str, sections: Sequence[Section], scripts: Sequence[str] = (), style: str = "") -> str:
    """Return the page.

    Args:
        title: title of the page.
        sections: sections from top to bottom.
        scripts: scripts of the page, which must not come from a run.
        style: further style sheet.
    """
    hashes = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    allowed = " ".join(f"'sha256-{digest}'" for digest in hashes) or "'none'"
    links = Markup(" ").join(
        Markup('<a href="#part{}">{}</a>').format(n, section.title) for n, section in enumerate(sections)
    )
    return _PAGE.format(
        title=title,
        policy=f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {allowed}",
        style=Markup(STYLE + style),
        links=links,
        sections=Markup().join(_section(n, section) for n, section in enumerate(sections)),
        scripts=Markup().join(Markup("<script>{}</script>").format(Markup(script)) for script in scripts),
    )


_PAGE = Markup(
    """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<header><h1>{title}</h1><nav>{links}</nav></header>
<main>{sections}</main>
{scripts}
</body>
</html>
"""
)


def _section(number: int, section: Section) -> Markup:
    explanation = paragraph(section.about) if section.about else ""
    owners: dict[str, list[str]] = {}
    for name, cell in section.cells.items():
        owners.setdefault(cell, []).append(name)
    headed = len(section.cells) > 1
    cells = Markup().join(
        Markup("<article>{}{}</article>").format(Markup("<h3>{}</h3>").format(", ".join(names)) if headed else "", cell)
        for cell, names in owners.items()
    )
    columns = Markup('<div class="runs">{}</div>').format(cells) if cells else ""
    inner = Markup("<h2>{}</h2>{}{}{}").format(section.title, explanation, section.before, columns)
    return Markup('<section id="part{}">{}</section>').format(number, inner)


def paragraph(text: str) -> Markup:
    """Return a paragraph."""
    return Markup("<p>{}</p>").format(text)


def missing_part(text: str) -> Markup:
    """Return a paragraph that reports a missing result."""
    return Markup('<p class="lacking">{}</p>').format(text)


def command(*words: str) -> Markup:
    """Return a shell command that the reader can copy."""
    return Markup("<code>{}</code>").format(" ".join(words))


def tabulated(table: RenderableType, omitted: Sequence[str] = ()) -> Markup:
    """Return a rich table, or a group of them, with title and caption.

    Args:
        table: table or group of tables.
        omitted: starts of the headers of columns to omit.
    """
    if isinstance(table, Group):
        return Markup().join(tabulated(each, omitted) for each in table.renderables)
    assert isinstance(table, rich.table.Table)
    columns = [column for column in table.columns if not _plain(column.header).startswith(tuple(omitted))]
    title = Markup("<figcaption>{}</figcaption>").format(_plain(table.title)) if table.title else ""
    caption = Markup('<p class="note">{}</p>').format(_plain(table.caption)) if table.caption else ""
    others = ""
    if more := columns[COLUMNS:]:
        label = f"{len(more)} more column{'s' * (len(more) > 1)}"
        others = Markup("<details><summary>{}</summary>{}</details>").format(label, _table([columns[0], *more]))
    return Markup("<figure>{}{}{}{}</figure>").format(title, _table(columns[:COLUMNS]), others, caption)


def _table(columns: Sequence[rich.table.Column]) -> Markup:
    rows = zip(*(column.cells for column in columns), strict=True)
    head = Markup().join(Markup("<th>{}</th>").format(_plain(column.header)) for column in columns)
    body = Markup().join(Markup("<tr>{}</tr>").format(_row(row, columns)) for row in rows)
    return Markup('<div class="wide"><table><tr>{}</tr>{}</table></div>').format(head, body)


def _row(cells: Sequence[RenderableType], columns: Sequence[rich.table.Column]) -> Markup:
    kinds = ["number" if column.justify == "right" else "text" for column in columns]
    return Markup().join(
        Markup('<td class="{}">{}</td>').format(
            kind, Markup("<b>{}</b>").format(_plain(cell)) if getattr(cell, "style", "") == "bold" else _plain(cell)
        )
        for kind, cell in zip(kinds, cells, strict=True)
    )


def _plain(cell: RenderableType) -> str:
    return cell.plain if isinstance(cell, Text) else str(cell)


def picture(figure: Figure, about: str) -> Markup:
    """Return a figure as a small PNG.

    Args:
        figure: matplotlib figure.
        about: alternative text.
    """
    from PIL import Image

    original, small = io.BytesIO(), io.BytesIO()
    figure.savefig(original, format="png", dpi=DPI)
    with Image.open(original) as image:
        image.convert("RGB").quantize(COLOURS).save(small, format="png", optimize=True)
    width, height = (96 * figure.get_size_inches()).round().astype(int).tolist()
    return Markup(
        '<div class="wide"><img src="data:image/png;base64,{}" width="{}" height="{}" alt="{}"></div>'
    ).format(base64.b64encode(small.getvalue()).decode(), width, height, about)


def side_by_side(*parts: Markup) -> Markup:
    """Return pictures in rows, as many per row as fit."""
    return Markup('<div class="pictures">{}</div>').format(Markup().join(parts))
