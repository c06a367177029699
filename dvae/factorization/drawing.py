"""Figures of the graph of a factorization, unrolled over time or for one step.

Time runs from left to right. Latents are open circles, data shaded circles and context variables squares.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import networkx as nx
import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.patches import Patch

Node = tuple[str, int | None]
"""Node of a graph: (name, t) for a local variable at step t, (name, None) for a static variable."""
Edge = tuple[Node, Node]
"""Edge of a graph: (parent, child)."""

WIDTH = 7.0
"""Largest width of a new figure in inches: the width of a page."""
RADIUS = 0.3
ARROW: dict[str, Any] = {"shrinkA": 0, "shrinkB": 0, "arrowstyle": "-|>", "mutation_scale": 9, "zorder": 2}
EDGE: dict[str, Any] = {"color": "0.35", "linestyle": "-", "linewidth": 0.9}
MISSING: dict[str, Any] = {"color": "#c0392b", "linestyle": "--", "linewidth": 1.3}
REDUNDANT: dict[str, Any] = {"color": "0.6", "linestyle": ":", "linewidth": 1.2}
LEAST = 1e-3
"""An edge is drawn dotted, as if its KL gap were zero, if the gap is at most this share of the highest gap."""


def draw_dag(
    dag: nx.DiGraph, ax: Axes | None = None, missing: Iterable[Edge] = (), redundant: Iterable[Edge] = ()
) -> Axes:
    """Draw a graph that is unrolled over time.

    Args:
        dag: graph from `Factorization.dag`, with nodes (name, t) or (name, None) and node attribute `kind`.
        ax: matplotlib axes; a new figure if None.
        missing: edges between nodes of the graph that the graph does not contain, drawn dashed and red.
        redundant: edges of the graph that are drawn dotted and grey.

    Returns:
        The matplotlib axes.
    """
    import matplotlib.pyplot as plt

    positions = _layout(dag)
    if ax is None:
        right, down = max(x for x, _ in positions.values()), -min(y for _, y in positions.values())
        width, height = 0.85 * right + 1.2, 0.85 * down + 1.4
        scale = min(1, WIDTH / width)
        ax = plt.subplots(figsize=(scale * width, scale * height), layout="constrained")[1]

    def symbol(name: str, t: int | None) -> str:
        word = name if len(name) == 1 else rf"\mathrm{{{name}}}".replace("_", r"\_")
        return f"${word}_{{{t}}}$" if t else f"${word}$"

    patches = {
        node: _draw_node(ax, xy, symbol(*node), dag.nodes[node].get("kind", "latent")) for node, xy in positions.items()
    }
    dotted = set(redundant)
    edges = [(edge, REDUNDANT if edge in dotted else EDGE) for edge in dag.edges]
    for (source, target), style in edges + [(edge, MISSING) for edge in missing]:
        _draw_edge(ax, (source, target), positions, patches, style)
    return _hide_axes(ax)


def draw_slice(
    graph: nx.DiGraph,
    costs: Mapping[tuple[Any, Any], float],
    ax: Axes,
    top: float = 0.0,
    unsure: Collection[tuple[Any, Any]] = (),
) -> Axes:
    """Draw the graph of one step, with the past on the left and the future on the right.

    The width of an edge increases with its KL gap.

    Args:
        graph: graph from `Factorization.slice`.
        costs: KL gap of each edge in nats, from (parent node, child node); it is printed on the edge. Edges with a gap
            of about 0 or less are dotted. Edges that are not in `costs` are thin and without a number.
        ax: matplotlib axes.
        top: KL gap in nats that is drawn with the greatest width, so that several figures can share one scale. The
            highest gap in `costs` is used if it is larger.
        unsure: edges that are drawn in a lighter colour, such as those with an insignificant gap.

    Returns:
        The matplotlib axes.
    """
    positions = _slice_layout(graph)
    patches = {
        node: _draw_node(ax, xy, graph.nodes[node]["label"], graph.nodes[node]["kind"])
        for node, xy in positions.items()
    }
    top = max([top, *costs.values()])
    for edge in graph.edges:
        cost = costs.get(edge)
        style = {**EDGE, "color": "0.7"} if edge in unsure else EDGE
        if cost is not None:
            thick = {"linewidth": 0.9 + 5 * cost / top, "mutation_scale": 9 + 8 * cost / top} if cost > 0 else {}
            style = REDUNDANT if cost <= LEAST * top else {**style, **thick}
        bend = _draw_edge(ax, edge, positions, patches, style)
        if cost is not None:
            (x, y), (to_x, to_y) = (positions[node] for node in edge)
            middle = (x + to_x + bend * (to_y - y)) / 2, (y + to_y - bend * (to_x - x)) / 2
            box = {"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
            text_style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 8, "bbox": box, "zorder": 5}
            ax.text(middle[0], middle[1], f"{round(cost, 3) + 0.0:.3f}", **text_style)
    return _hide_axes(ax)


def _draw_node(ax: Axes, xy: tuple[float, float], symbol: str, kind: str) -> Patch:
    """Draw a node with its label and return its outline; edges end there."""
    from matplotlib.patches import Circle, Rectangle

    (x, y), side = xy, 2 * RADIUS
    shape = Rectangle((x - RADIUS, y - RADIUS), side, side) if kind == "context" else Circle(xy, RADIUS)
    shape.set(facecolor="0.85" if kind == "data" else "white", edgecolor="black", zorder=3)
    ax.text(x, y, symbol, ha="center", va="center", zorder=4)
    return ax.add_patch(shape)


def _draw_edge(
    ax: Axes, edge: tuple[Any, Any], positions: Mapping[Any, Any], patches: Mapping[Any, Patch], style: dict[str, Any]
) -> float:
    """Draw an edge between two nodes and return its curvature."""
    from matplotlib.patches import FancyArrowPatch

    source, target = edge
    bend = _bend(source, target, positions)
    ends: dict[str, Any] = {"patchA": patches[source], "patchB": patches[target]}
    curve = f"arc3,rad={bend}"
    ax.add_patch(
        FancyArrowPatch(positions[source], positions[target], connectionstyle=curve, **ends, **{**ARROW, **style})
    )
    return bend


def _hide_axes(ax: Axes) -> Axes:
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.margins(0.05)
    ax.axis("off")
    return ax


def _layout(dag: nx.DiGraph) -> dict[Node, tuple[float, float]]:
    """Return the position (x, y) of each node of an unrolled graph.

    Static nodes are in the top row. Each local variable has a row below, and data have the last rows. Rows are shifted
    horizontally, so that edges between different rows do not overlap.
    """
    T = max((t for _, t in dag if t is not None), default=1)
    static = [node for node in dag if node[1] is None]
    last = {name for name, t in dag if dag.nodes[name, t].get("kind") == "data"}
    names = sorted(dict.fromkeys(name for name, t in dag if t is not None), key=lambda name: name in last)
    positions = {}
    for i, node in enumerate(static):
        positions[node] = (1.7 * (T + 1) * (i + 1) / (len(static) + 1), 0.0)
    for row, name in enumerate(names, start=bool(static)):
        for t in range(1, T + 1):
            positions[name, t] = (1.7 * t + 0.3 * (row % 3 - 1), -1.6 * row)
    return positions


def _slice_layout(graph: nx.DiGraph) -> dict[Any, tuple[float, float]]:
    """Return the position (x, y) of each node in the graph of one step.

    Static nodes are in the top row. Each local variable has a row below, and data have the last rows. Past steps are on
    the left, step t is in the middle, and future steps are on the right.
    """
    local = {name: graph.nodes[name, sub]["kind"] == "data" for name, sub in graph if sub is not None}
    rows = {name: row for row, name in enumerate(sorted(local, key=local.__getitem__), start=1)}
    positions: dict[Any, tuple[float, float]] = {}
    counts: dict[Any, int] = {}
    static = [node for node in graph if node[1] is None]
    for i, node in enumerate(static):
        positions[node] = (1.9 * (i - (len(static) - 1) / 2) + 0.6, 0.0)
    for node in graph:
        if node not in positions:
            side = graph.nodes[node]["side"]
            distance = counts[node[0], side] = counts.get((node[0], side), 0) + 1
            positions[node] = (2.2 * side * distance + 0.3 * (rows[node[0]] % 3 - 1), -1.8 * rows[node[0]])
    return positions


def _bend(source: Any, target: Any, positions: Mapping[Any, tuple[float, float]]) -> float:
    """Return the smallest curvature of an edge that does not touch other nodes, as the `rad` of matplotlib's arc3.

    Edges within the lowest row preferably bend downwards, edges within other rows upwards.
    """
    start, end = np.array(positions[source]), np.array(positions[target])
    others = np.array([xy for node, xy in positions.items() if node not in (source, target)]).reshape(-1, 2)
    (dx, dy), along = end - start, np.linspace(0, 1, 60)[:, None]
    lowest = min(y for _, y in positions.values()) == start[1]
    outwards = (1 if lowest else -1) * np.sign(dx) if dy == 0 else 1
    least = 0.3 if dy == 0 and abs(dx) > 2 else 0.0

    def clearance(bend: float) -> float:
        # matplotlib's arc3: a quadratic Bezier curve whose control point lies off the middle.
        control = (start + end) / 2 + bend * np.array([dy, -dx])
        curve = (1 - along) ** 2 * start + 2 * along * (1 - along) * control + along**2 * end
        return float(np.linalg.norm(curve[:, None] - others, axis=-1).min(initial=math.inf))

    bends = [float(side * size) for size in np.arange(least, 0.8, 0.05) for side in (outwards, -outwards)]
    return next((bend for bend in bends if clearance(bend) > 1.5 * RADIUS), max(bends, key=clearance))
