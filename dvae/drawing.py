"""Pictures of unrolled graphs: time from left to right, latents open, data shaded, context squares."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import networkx as nx
import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Node = tuple[str, int | None]
"""A variable at a step, or a static one."""
Edge = tuple[Node, Node]

RADIUS = 0.3
ARROW: dict[str, Any] = {"shrinkA": 0, "shrinkB": 0, "arrowstyle": "-|>", "mutation_scale": 9, "zorder": 2}
EDGE: dict[str, Any] = {"color": "0.35", "linestyle": "-", "linewidth": 0.9}
MISSING: dict[str, Any] = {"color": "#c0392b", "linestyle": "--", "linewidth": 1.3}
REDUNDANT: dict[str, Any] = {"color": "0.6", "linestyle": ":", "linewidth": 1.2}


def draw_dag(
    dag: nx.DiGraph, ax: Axes | None = None, missing: Iterable[Edge] = (), redundant: Iterable[Edge] = ()
) -> Axes:
    """Draws an unrolled graph: time left to right, latents open, data shaded, context squares.

    Args:
        dag: nodes (name, t), (name, None) with attribute `kind`, as `Factorization.dag` makes them.
        ax: matplotlib axes; a new figure if None.
        missing: arrows to add, dashed red.
        redundant: arrows of the graph to show dotted grey.
    """
    import matplotlib.pyplot as plt
    from matplotlib.patches import Circle, FancyArrowPatch, Patch, Rectangle

    place = _layout(dag)
    if ax is None:
        right, down = max(x for x, _ in place.values()), -min(y for _, y in place.values())
        _, ax = plt.subplots(figsize=(0.85 * right + 1.2, 0.85 * down + 1.4), layout="constrained")
    patches: dict[Node, Patch] = {}
    for node, (x, y) in place.items():
        kind = dag.nodes[node].get("kind", "latent")
        corner, side = (x - RADIUS, y - RADIUS), 2 * RADIUS
        shape = Rectangle(corner, side, side) if kind == "context" else Circle((x, y), RADIUS)
        shape.set(facecolor="0.85" if kind == "data" else "white", edgecolor="black", zorder=3)
        patches[node] = ax.add_patch(shape)
        name, t = node
        symbol = name if len(name) == 1 else rf"\mathrm{{{name}}}".replace("_", r"\_")
        ax.text(x, y, f"${symbol}_{{{t}}}$" if t else f"${symbol}$", ha="center", va="center", zorder=4)
    dotted = set(redundant)
    arrows = [(edge, REDUNDANT if edge in dotted else EDGE) for edge in dag.edges]
    for (source, target), style in arrows + [(edge, MISSING) for edge in missing]:
        ends: dict[str, Any] = {"patchA": patches[source], "patchB": patches[target]}
        curve = f"arc3,rad={_bend(source, target, place)}"
        ax.add_patch(FancyArrowPatch(place[source], place[target], connectionstyle=curve, **ends, **ARROW, **style))
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.margins(0.05)
    ax.axis("off")
    return ax


def _layout(dag: nx.DiGraph) -> dict[Node, tuple[float, float]]:
    """Static nodes on top, then a row per local variable, data last; shifted rows part their arrows."""
    T = max((t for _, t in dag if t is not None), default=1)
    static = [node for node in dag if node[1] is None]
    last = {name for name, t in dag if dag.nodes[name, t].get("kind") == "data"}
    names = sorted(dict.fromkeys(name for name, t in dag if t is not None), key=lambda name: name in last)
    place = {}
    for i, node in enumerate(static):
        place[node] = (1.7 * (T + 1) * (i + 1) / (len(static) + 1), 0.0)
    for row, name in enumerate(names, start=bool(static)):
        for t in range(1, T + 1):
            place[name, t] = (1.7 * t + 0.3 * (row % 3 - 1), -1.6 * row)
    return place


def _bend(source: Node, target: Node, place: dict[Node, tuple[float, float]]) -> float:
    """The least curvature with which an arrow passes no other node; outwards along the first and last row."""
    start, end = np.array(place[source]), np.array(place[target])
    others = np.array([xy for node, xy in place.items() if node not in (source, target)]).reshape(-1, 2)
    (dx, dy), along = end - start, np.linspace(0, 1, 60)[:, None]
    lowest = min(y for _, y in place.values()) == start[1]
    outwards = (1 if lowest else -1) * np.sign(dx) if dy == 0 else 1
    least = 0.3 if dy == 0 and abs(dx) > 2 else 0.0

    def clearance(bend: float) -> float:
        # matplotlib's arc3: a quadratic Bezier curve whose control point lies off the middle.
        control = (start + end) / 2 + bend * np.array([dy, -dx])
        curve = (1 - along) ** 2 * start + 2 * along * (1 - along) * control + along**2 * end
        return float(np.linalg.norm(curve[:, None] - others, axis=-1).min(initial=math.inf))

    bends = [float(side * size) for size in np.arange(least, 0.8, 0.05) for side in (outwards, -outwards)]
    return next((bend for bend in bends if clearance(bend) > 1.5 * RADIUS), max(bends, key=clearance))
