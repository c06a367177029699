"""Draw docs/img/packages.png of docs/project/architecture.md: packages as boxes, imports as edges.

The imports come from the files. Every box is above the boxes that it imports. Edges that follow from others are left
out. Edges that point upward are errors in the layout, and are red.
"""

from __future__ import annotations

import ast
from glob import glob
from pathlib import Path

import networkx as nx
import tyro
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

from dvae.inference.evaluation.result import new_figure, styled

from .results import DOCS

ROOT = DOCS.parent / "dvae"
EVERYWHERE = {"__main__", "capture", "command", "files", "options", "locking", "lazy", "constants"}
"""Small modules that many packages use; the picture leaves them out."""

WALK = {
    "motion": "files to windows",
    "tables": "tables to windows",
    "data": "windows to batches",
    "program": "equations to a run",
    "networks": "parents to features",
    "distributions": "features to distributions",
    "inference": "a run to bound and step",
}
"""Packages on the way from x in a file to the loss, in this order."""

CAPTIONS = {
    "cli": "the program dvae",
    "runs": "directories of fits",
    "testing": "tests for your models",
    "models": "one file per method",
    "factorization": "equations, masks, audits",
}


def package(module: str) -> str:
    """Return the package of a module: "a" for dvae.a.b, "" for dvae."""
    return module.split(".")[1] if "." in module else ""


def imports() -> nx.DiGraph:
    """Return the graph of imports between packages; the attribute "lines" of a node is its number of lines."""
    graph = nx.DiGraph()
    for file in sorted(glob("**/*.py", root_dir=ROOT, recursive=True)):  # follows symbolic links
        parts = ("dvae", *Path(file).with_suffix("").parts)
        here, text = package(".".join(parts)), (ROOT / file).read_text(encoding="utf-8")
        if here in EVERYWHERE | {"__init__"}:
            continue
        graph.add_node(here, lines=graph.nodes.get(here, {}).get("lines", 0) + text.count("\n"))
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom):
                base = parts[: len(parts) - node.level] if node.level else ()
                module = ".".join([*base, *([node.module] if node.module else [])])
                names = [module] if "." in module else [f"{module}.{alias.name}" for alias in node.names]
            else:
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            graph.add_edges_from((here, package(name)) for name in names if name.startswith("dvae."))
    graph.remove_nodes_from([name for name in graph if "lines" not in graph.nodes[name]])
    graph.remove_edges_from(list(nx.selfloop_edges(graph)))
    return graph


def levels_of(graph: nx.DiGraph) -> list[list[str]]:
    """Return packages by level, each on the lowest level above its imports; import cycles share a level."""
    circles = nx.condensation(graph)
    floors = nx.topological_generations(circles.reverse())
    return [sorted(name for circle in floor for name in circles.nodes[circle]["members"]) for floor in floors]


def draw(graph: nx.DiGraph, ax: Axes) -> None:
    """Draw packages as boxes on their levels, with imports as edges."""
    floors, width, height = levels_of(graph), 2.3, 0.62
    places: dict[str, tuple[float, float]] = {}
    for level, floor in enumerate(floors):
        known = {n: [places[m][0] for m in graph.successors(n) if m in places] for n in floor}
        order = sorted(floor, key=lambda n: sum(known[n]) / len(known[n]) if known[n] else 0.0)
        for place, name in enumerate(order):
            places[name] = ((place - (len(order) - 1) / 2) * 2.75, level * 1.15)
    circles = nx.condensation(graph)
    needed = nx.transitive_reduction(circles)
    numbers = {name: number for number, name in enumerate((name for name in WALK if name in graph), 1)}
    for one, other in graph.edges:
        up = places[other][1] >= places[one][1]
        if up or needed.has_edge(circles.graph["mapping"][one], circles.graph["mapping"][other]):
            (x, y), (u, v) = places[one], places[other]
            ax.annotate(
                "",
                (u + 0.12 * (x - u), v + height / 2),
                (x + 0.12 * (u - x), y - height / 2),
                arrowprops={
                    "arrowstyle": "-|>",
                    "color": "tab:red" if up else "0.55",
                    "linewidth": 1.1,
                    "shrinkA": 0,
                    "shrinkB": 1,
                    "connectionstyle": f"arc3,rad={0.0 if abs(y - v) < 1.5 else 0.12}",
                },
                zorder=1,
            )
    for name, (x, y) in places.items():
        walked = name in numbers
        face, edge = ("#fdf1d8", "#c98a1b") if walked else ("#eef2f7", "#8c9bb0")
        box = FancyBboxPatch((x - width / 2, y - height / 2), width, height, "round,pad=0.02,rounding_size=0.08")
        box.set(facecolor=face, edgecolor=edge, linewidth=1.2, zorder=2)
        ax.add_patch(box)
        ax.text(x, y + 0.1, name, ha="center", va="center", fontsize=11, fontweight="bold", zorder=3)
        caption = WALK.get(name) or CAPTIONS.get(name, "")
        ax.text(x, y - 0.15, caption, ha="center", va="center", fontsize=8, color="0.25", zorder=3)
        if walked:
            spot = {"boxstyle": "circle,pad=0.25", "facecolor": edge, "edgecolor": "white"}
            ax.text(
                x - width / 2, y + height / 2, str(numbers[name]), color="white", fontsize=9, bbox=spot, ha="center",
                va="center", zorder=4,
            )  # fmt: skip
    ax.set_xlim(min(x for x, _ in places.values()) - 1.4, max(x for x, _ in places.values()) + 1.4)
    ax.set_ylim(-0.5, max(y for _, y in places.values()) + 0.5)
    ax.set_aspect("equal")
    ax.axis("off")


@styled
def main(out: Path = DOCS / "img" / "packages.png") -> None:
    """Draw the picture.

    Args:
        out: file of the picture.
    """
    graph = imports()
    figure = new_figure(7, len(levels_of(graph)))
    draw(graph, figure.subplots())
    figure.savefig(out, dpi=200)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
