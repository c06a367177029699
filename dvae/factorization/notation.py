r"""Parse equations, written as in papers, into factorizations.

A factorization is a product of factors. Each factor lists the variables and the time steps that it reads:

    p(w) p(z_t | z_{<t}, x_{t-1}, w) p(x_t | x_{<t}, z_t, w)

The notation follows Girin, Leglaive, Bie, Diard, Hueber and Alameda-Pineda, *Dynamical variational
autoencoders: a comprehensive review* (arXiv 2008.12595).

    factorization := factor+            factor := ("p"|"q") "(" variable [ "|" parent ("," parent)* ] ")"
    variable := name | name "_t"        one per sequence (static) | one per time step (local)
                | name "_{1:T}"         all steps: p(x_{1:T} | w) is read as its chain rule, p(x_t | x_{<t}, w)
    parent   := name | name "_" relation
    relation := t | {t-k} | {t+k} | {<t} | {<=t} | {>t} | {>=t} | {a:b} | {1:T} | {a name given in masks}
                where a is 1, t, t-k or t+k and b is T, t, t-k or t+k

The parser understands LaTeX spellings (\mid, \leq, \geq, \prod_t) and ignores fonts (\mathbf{z}_t). A parent without
a factor is *context*: it is given and never drawn.
"""

from __future__ import annotations

import html
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal, NoReturn

import networkx as nx
import numpy as np

from .drawing import Node, draw_dag
from .relations import ALL, FUTURE, NOW, PAST, MaskFunction, NotationError, Relation

if TYPE_CHECKING:
    from matplotlib.axes import Axes


RESERVED = {
    "lengths": "the numbers of valid steps in a batch",
    "log_det": "the log-determinants of a view in a batch",
    "mask": "the mask of observed entries in a batch",
    "sequences": "the Pyro plate over the sequences of a batch",
}
FONT = r"\\(?:math(?:bf|rm|it|sf)|boldsymbol|bm)(?![a-z])\s*"


# ---------------------------------------------------------------------------------------- parents and factors


@dataclass(frozen=True)
class Parent:
    """A variable that a factor reads.

    Args:
        name: name of the variable.
        local: True for one value per time step, False for one value per sequence (static).
        relation: steps of the variable that are read; None for a static variable.
    """

    name: str
    local: bool
    relation: Relation | None = None

    @property
    def pieces(self) -> tuple[tuple[str, str | None], ...]:
        """Pairs (name, subscript), such as `(("x", "<t"), ("x", ">t"))`, one for each term in the equation.

        The subscript of a static variable is None.
        """
        if self.relation is None:
            return ((self.name, None),)
        return tuple((self.name, part.name[1:-1]) for part in self.relation.parts)

    @property
    def terms(self) -> tuple[str, ...]:
        """The `pieces` as text, such as `("x_{<t}", "x_{>t}")`."""
        return tuple(_plain(*piece) for piece in self.pieces)

    def __str__(self) -> str:
        return ", ".join(self.terms)


@dataclass(frozen=True)
class Factor:
    """One conditional distribution of a factorization, such as `p(z_t | z_{t-1}, w)`.

    Args:
        kind: "p" in a model, "q" in a guide.
        child: name of the variable whose distribution this is.
        local: True if the child has one value per time step, False if it has one value per sequence (static).
        parents: variables that the factor reads, each at most once.
    """

    kind: Literal["p", "q"]
    child: str
    local: bool
    parents: tuple[Parent, ...] = ()

    def parent(self, name: str) -> Parent | None:
        """Return the parent with this name, or None if the factor does not read it."""
        return next((parent for parent in self.parents if parent.name == name), None)

    def mask(self, parent: str, T: int) -> np.ndarray:
        """Return which steps of a parent (columns) each step of the child (rows) reads.

        Args:
            parent: name of the parent.
            T: number of time steps.

        Returns:
            Bool array (T or 1, T or 1): T for a local variable, 1 for a static one.

        Raises:
            ValueError: the factor does not read this variable, or a custom mask has a wrong shape or dtype.
        """
        reads = self.parent(parent)
        if reads is None:
            raise ValueError(f"{self} does not read {parent}; it reads {_names(each.name for each in self.parents)}")
        rows, columns = T if self.local else 1, T if reads.local else 1
        if reads.relation is None or (reads.relation == ALL and not self.local):
            return np.ones((rows, columns), dtype=bool)
        mask = reads.relation.mask(T) if self.local else reads.relation.rows(T)
        if len(mask) != rows:
            raise ValueError(
                f"the mask {reads.relation} of {self} has the shape {mask.shape} at T={T}, but {self.child} is static; "
                f"its function must return a single row, a bool array of shape (1, {T})"
            )
        return mask

    def edges(self, T: int) -> list[tuple[Node, Node]]:
        """Return the edges of this factor in the graph unrolled over T steps.

        Each edge is a pair of nodes (parent, child). Nodes are pairs, as in `Factorization.dag`.
        """
        edges, children = [], unrolled(self.child, self.local, T)
        for parent in self.parents:
            parents = unrolled(parent.name, parent.local, T)
            edges += [(parents[s], children[t]) for t, s in np.argwhere(self.mask(parent.name, T)).tolist()]
        return edges

    def render(self, variable: Callable[[str, str | None], str], bar: str = " | ") -> str:
        """Return the factor as text.

        Args:
            variable: function that formats a variable from its name and its subscript, which is None if static.
            bar: text between the child and its parents.
        """
        child = variable(self.child, "t" if self.local else None)
        conditions = ", ".join(variable(*piece) for parent in self.parents for piece in parent.pieces)
        return f"{self.kind}({child}{bar + conditions if conditions else ''})"

    def __str__(self) -> str:
        return self.render(_plain)


@dataclass(frozen=True)
class Block:
    """Variables that are drawn together.

    Args:
        names: variables in drawing order within a step.
        direction: +1 if they are drawn step by step forward in time, -1 if backward in time. A direction of 0 is for a
            single variable that is static or drawn at all steps at once.
    """

    names: tuple[str, ...]
    direction: Literal[-1, 0, 1]


def _plain(name: str, subscript: str | None) -> str:
    if subscript is None:
        return name
    return f"{name}_t" if subscript == "t" else f"{name}_{{{subscript}}}"


def _latex(name: str, subscript: str | None) -> str:
    def symbol(word: str) -> str:
        return word if len(word) == 1 else r"\mathrm{" + word.replace("_", r"\_") + "}"

    if subscript is None:
        return symbol(name)
    below = symbol(subscript) if subscript.isidentifier() else subscript
    return f"{symbol(name)}_{{{below}}}".replace("<=", r"\leq ").replace(">=", r"\geq ")


def _html(name: str, subscript: str | None) -> str:
    below = "" if subscript is None else subscript.replace("<=", "≤").replace(">=", "≥").replace("-", "−")
    return f"<i>{html.escape(name)}</i>" + (f"<sub>{html.escape(below)}</sub>" if below else "")


# --------------------------------------------------------------------------------------------- factorizations


@dataclass(frozen=True)
class Factorization:
    """A joint distribution over sequences, as a product of conditional distributions.

    Create it with `parse`. Construction checks that the variables can be drawn in some order. If variables depend on
    each other in a cycle, the error shows the cycle. The order of the written factors matters only if several drawing
    orders are valid.

    Args:
        kind: "p" for a generative model, "q" for a guide.
        factors: one factor for each variable.

    >>> print(dvae.Factorization.parse("p(w) p(z_t | z_{t-1}, w) p(x_t | z_t)"))
    p(x_{1:T}, z_{1:T}, w) = p(w) ∏_t p(z_t | z_{t-1}, w) p(x_t | z_t)

    Raises:
        ValueError: the factors form a cycle; variables in one loop over time read the future in a model, or both the
            past and the future in a guide; or a custom mask is invalid.
    """

    kind: Literal["p", "q"]
    factors: tuple[Factor, ...]

    def __post_init__(self) -> None:
        for factor in self.factors:
            for parent in factor.parents:
                factor.mask(parent.name, 2)
        _ = self.blocks

    @classmethod
    def parse(
        cls, text: str | Factorization, masks: Mapping[str, Relation | MaskFunction] | None = None
    ) -> Factorization:
        """Parse equations such as `"p(z_t | z_{t-1}) p(x_t | z_t)"`.

        Args:
            text: factors, all p or all q; a `Factorization` is returned unchanged.
            masks: custom relations; `masks={"band": function}` defines `z_{band}`, where function(T) returns a bool
                array (T, T) with rows t and columns s. Values may also be `Relation` objects.

        Returns:
            The factorization.

        Raises:
            NotationError: the text cannot be parsed; the message shows the column.
            ValueError: the text is valid, but the variables cannot be drawn (see the class).
            TypeError: `text` is neither a string nor a `Factorization`.
        """
        if isinstance(text, Factorization):
            return text
        if not isinstance(text, str):
            raise TypeError(f'expected equations as text, such as "p(z_t | z_{{t-1}}) p(x_t | z_t)", got {text!r}')
        return cls(*_Reader(text, masks or {}).factorization())

    # variables and parents ---------------------------------------------------------------------------------

    @cached_property
    def variables(self) -> tuple[str, ...]:
        """Names of the variables with a factor, in the written order of the factors."""
        return tuple(factor.child for factor in self.factors)

    @cached_property
    def context(self) -> tuple[str, ...]:
        """Names of the variables that factors read but that have no factor, in order of appearance.

        The context of a guide includes the data.
        """
        parents = (parent.name for factor in self.factors for parent in factor.parents)
        return tuple(name for name in dict.fromkeys(parents) if name not in self.variables)

    def factor(self, name: str) -> Factor:
        """Return the factor of a variable.

        Args:
            name: name of the variable.

        Raises:
            ValueError: the variable has no factor.
        """
        for factor in self.factors:
            if factor.child == name:
                return factor
        raise ValueError(f"no factor for {name!r} in {self.text!r}; there are factors for {_names(self.variables)}")

    def prior_guide(self, observed: Iterable[str] = ("x",)) -> Factorization:
        """Return the prior as a guide: the factors of the latents with kind q.

        Args:
            observed: names of the variables whose factors are left out: observed variables and latents that are summed
                out. If no factors remain, the result is a guide without factors.
        """
        observed = tuple(observed)
        return Factorization("q", tuple(replace(f, kind="q") for f in self.factors if f.child not in observed))

    def given(self, local: Iterable[str], static: Iterable[str], but: Collection[str] = ()) -> Factorization:
        """Return the factorization with further context variables, such as covariates, as parents of its factors.

        At step t, a factor of a local variable reads local context at t. A factor of a static variable reads local
        context at all steps. A factor of a static variable without parents, such as p(w), stays unchanged.

        Args:
            local: names of context variables with one value per time step.
            static: names of context variables with one value per sequence.
            but: factors that stay unchanged, by kind and child, such as "p(z)".
        """
        factors = []
        for factor in self.factors:
            if f"{factor.kind}({factor.child})" in but or not (factor.local or factor.parents):
                factors.append(factor)
                continue
            relation = Relation.of([(0, 0)]) if factor.local else ALL
            added = [Parent(name, True, relation) for name in local] + [Parent(name, False) for name in static]
            existing = {parent.name for parent in factor.parents}
            factors.append(replace(factor, parents=(*factor.parents, *(p for p in added if p.name not in existing))))
        return replace(self, factors=tuple(factors))

    def local(self, name: str) -> bool:
        """Return True for a variable with one value per time step, False for one with one value per sequence.

        Args:
            name: name of a variable or of context.

        Raises:
            ValueError: the factorization does not contain this name.
        """
        if name not in self._locality:
            raise ValueError(f"no variable {name!r} in {self.text!r}; there are {_names(self._locality)}")
        return self._locality[name]

    @cached_property
    def _locality(self) -> dict[str, bool]:
        parents = {parent.name: parent.local for factor in self.factors for parent in factor.parents}
        return {factor.child: factor.local for factor in self.factors} | parents

    @property
    def masks(self) -> dict[str, MaskFunction]:
        """Functions of the custom masks in use, by name; `Factorization.parse(f.text, masks=f.masks) == f`."""
        relations = (parent.relation for factor in self.factors for parent in factor.parents)
        parts = (part for relation in relations if relation is not None for part in relation.parts)
        return {part.name[1:-1]: part.function for part in parts if part.function is not None}

    def mask(self, child: str, parent: str, T: int) -> np.ndarray:
        """Return which steps of the parent (columns) each step of the child (rows) may read.

        Args:
            child: name of a variable with a factor.
            parent: name of any variable.
            T: number of time steps.

        Returns:
            Bool array (T or 1, T or 1): T for a local variable, 1 for a static one. The shape is (T, T) for a local
            child and parent, (T, 1) for a static parent and (1, T) for a static child of a local parent. All entries
            are False if the child does not read the parent.

        Raises:
            ValueError: the child has no factor, the factorization has no variable with the name of the parent, or a
                custom mask has a wrong shape or dtype.
        """
        factor = self.factor(child)
        if factor.parent(parent) is None:
            return np.zeros((T if factor.local else 1, T if self.local(parent) else 1), dtype=bool)
        return factor.mask(parent, T)

    @property
    def edges(self) -> tuple[tuple[str, Parent], ...]:
        """The dependencies (child, parent), with the past, the same step and the future as separate edges.

        For q(z_t | x_{1:T}, w) the parents are x_{<t}, x_t, x_{>t} and w. Each parent of a static variable is a single
        edge, and so is a parent with a custom mask.
        """

        def sides(factor: Factor, relation: Relation | None) -> Iterable[Relation | None]:
            if relation is None or relation.intervals is None or not factor.local:
                return (relation,)
            return (part for side in (PAST, NOW, FUTURE) for part in (relation & side).parts)

        return tuple(
            (factor.child, replace(parent, relation=relation))
            for factor in self.factors
            for parent in factor.parents
            for relation in sides(factor, parent.relation)
        )

    def describe_edge(self, child: str, parent: Parent) -> str:
        """Return one of the `edges`, (child, parent), in words, such as "x_{<t} to z_t".

        Args:
            child: name of the variable that reads the parent.
            parent: variable and steps that the child reads.
        """
        return f"{parent} to {_plain(child, 't' if self.local(child) else None)}"

    def without(self, child: str, parent: Parent) -> Factorization:
        """Return the factorization without one of its `edges`.

        Args:
            child: name of the child of the edge.
            parent: parent of the edge, with the relation as in `edges`.

        Raises:
            ValueError: the factorization does not contain this edge.
        """
        factor = self.factor(child)
        if (child, parent) not in self.edges:
            edges = _names(str(each) for name, each in self.edges if name == child)
            raise ValueError(f"{factor} has no edge from {parent}; it has edges from {edges}")

        def subtract(other: Parent) -> Parent | None:
            if other.relation == parent.relation or other.relation is None or parent.relation is None:
                return None
            remaining = other.relation & ~parent.relation
            return None if remaining.intervals == () else replace(other, relation=remaining)

        parents = (subtract(other) if other.name == parent.name else other for other in factor.parents)
        reduced = replace(factor, parents=tuple(other for other in parents if other is not None))
        return replace(self, factors=tuple(reduced if each is factor else each for each in self.factors))

    # sampling order ----------------------------------------------------------------------------------------

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of variables in a valid drawing order; if several orders are valid, the written order decides.

        A block is a strongly connected component of the graph with an edge from v to u if u reads v at any step. Its
        variables are drawn in one loop over time. A single variable that does not read its own values needs no loop: it
        is drawn at all steps at once.
        """
        reads = nx.DiGraph()
        reads.add_nodes_from(self.variables)
        reads.add_edges_from((p.name, f.child) for f in self.factors for p in f.parents if p.name in reads)
        components = nx.condensation(reads)
        first = {c: min(map(self.variables.index, components.nodes[c]["members"])) for c in components}
        order = nx.lexicographical_topological_sort(components, key=first.__getitem__)
        return tuple(self._block(components.nodes[c]["members"]) for c in order)

    def _block(self, members: set[str]) -> Block:
        reads = [(f, p) for f in self.factors if f.child in members for p in f.parents if p.name in members]
        if not reads:
            return Block(tuple(members), 0)
        directions: dict[tuple[str, str], frozenset[int]] = {}
        for factor, parent in reads:
            if parent.relation is None or not factor.local:
                raise self._undrawable(factor, parent, f"{parent.name} is drawn from {factor.child}")
            directions[factor.child, parent.name] = parent.relation.directions
        used = frozenset().union(*directions.values())
        # A generative model runs forward because it must be able to forecast; only a guide may run backward.
        direction: Literal[-1, 1] = -1 if self.kind == "q" and 1 in used and -1 not in used else 1
        for factor, parent in reads:
            if direction in directions[factor.child, parent.name]:
                reason = "a generative model is drawn forward in time"
                if self.kind == "q":
                    past = next(f"{f.child}_t reads {p}" for f, p in reads if -1 in directions[f.child, p.name])
                    reason = f"{past}, and one loop over time cannot run both forward and backward"
                raise self._undrawable(factor, parent, reason, direction)
        now = nx.DiGraph()
        now.add_nodes_from(members)
        now.add_edges_from((p.name, f.child) for f, p in reads if 0 in directions[f.child, p.name])
        try:
            names = tuple(nx.lexicographical_topological_sort(now, key=self.variables.index))
        except nx.NetworkXUnfeasible:
            factor, parent = self._blame(now)
            late = f"drawn after {factor.child}_t" if parent.name != factor.child else "the variable that it draws"
            raise self._undrawable(factor, parent, f"{parent.name}_t is {late}", direction) from None
        return Block(names, direction)

    def _blame(self, now: nx.DiGraph) -> tuple[Factor, Parent]:
        """Return the factor and the parent of a cycle that the error names.

        A variable that reads itself at t is preferred, then a range of steps such as {<=t}, then the written order.

        Args:
            now: graph of the dependencies within a step, which contains a cycle.
        """
        cycle = set(next(nx.simple_cycles(now)))
        edges = [(f, p) for f in self.factors for p in f.parents if {f.child, p.name} <= cycle]
        edges = [(f, p) for f, p in edges if now.has_edge(p.name, f.child)]
        return min(edges, key=lambda edge: (edge[0].child != edge[1].name, edge[1].relation == NOW))

    def _undrawable(self, factor: Factor, parent: Parent, reason: str, direction: int = 0) -> ValueError:
        """Return an error that names the factor, the parent, the reason and the shortest cycle.

        If a direction is given and the parent is local, the error also suggests a valid relation.

        Args:
            factor: the factor that cannot be drawn.
            parent: the parent that it reads.
            reason: text that completes "factor reads parent, but ...".
            direction: direction of the loop over time, +1 or -1; 0 if there is no loop.
        """
        message = f"{factor} reads {parent}, but {reason}"
        if cycle := self._cycle(factor.child, parent.name):
            message += f" (cycle {' -> '.join(_node(*node) for node in cycle)})"
        if parent.relation is not None and direction:
            available = PAST if direction > 0 else FUTURE
            suggestion = parent.relation & available
            if not suggestion.intervals:
                suggestion = Relation.of([(-direction, -direction)]) if parent.relation.pointwise else available
            message += f"; did you mean {Parent(parent.name, True, suggestion)}?"
        return ValueError(message)

    def _cycle(self, child: str, parent: str) -> list[Node]:
        """Return the nodes of the shortest cycle of the unrolled graph with an edge from parent to child.

        Among several shortest cycles, the one closest to step 2 is returned; without a cycle, the list is empty.
        """
        relations = [p.relation for f in self.factors for p in f.parents if p.relation is not None]
        dag = self.dag(max((11 if r.intervals is None else 3 + r.lag for r in relations), default=3))
        cycles: list[list[Node]] = []
        for source, target in dag.edges:
            if source[0] == parent and target[0] == child and nx.has_path(dag, target, source):
                cycles.append([source, *nx.shortest_path(dag, target, source)])
        return min(cycles, key=lambda path: (len(path), abs((path[0][1] or 2) - 2)), default=[])

    def dag(self, T: int, observed: Iterable[str] = ("x",)) -> nx.DiGraph:
        """Return the graph unrolled over T steps, with edges from parent to child.

        Args:
            T: number of time steps.
            observed: names of the observed variables.

        Returns:
            networkx.DiGraph with nodes (name, t), t = 1, ..., T, and (name, None) for static variables. The node
            attribute `kind` is "data" for observed variables, "latent" for other variables with a factor, and "context"
            otherwise.
        """
        dag, observed = nx.DiGraph(), tuple(observed)
        for name in (*self.context, *self.variables):
            kind = "latent" if name in self.variables else "context"
            dag.add_nodes_from(unrolled(name, self.local(name), T), kind="data" if name in observed else kind)
        for factor in self.factors:
            dag.add_edges_from(factor.edges(T))
        return dag

    def slice(self, observed: Iterable[str] = ("x",)) -> nx.DiGraph:
        """Return the graph of one step t, with one edge from parent to child for each of `edges`.

        Args:
            observed: names of the observed variables.

        Returns:
            networkx.DiGraph with nodes (name, subscript), such as ("x", "<t") and ("z", "t"), and (name, None) for
            static variables. The node attribute `kind` is defined in `dag`, `label` is LaTeX, and `side` is -1 for the
            past and for all steps, 0 for t, and 1 for the future. The edge attribute `edge` is the pair (child, parent)
            of `edges`.
        """
        graph, observed = nx.DiGraph(), tuple(observed)

        def add(name: str, subscript: str | None, side: int) -> tuple[str, str | None]:
            kind = "data" if name in observed else "latent" if name in self.variables else "context"
            graph.add_node((name, subscript), kind=kind, side=side, label=f"${_latex(name, subscript)}$")
            return name, subscript

        for factor in self.factors:
            add(factor.child, "t" if factor.local else None, 0)
        for child, parent in self.edges:
            relation = parent.relation
            side = 0 if relation in (None, NOW) else 1 if relation.intervals and relation & FUTURE == relation else -1
            subscript = None if relation is None else relation.name[1:-1]
            reads = add(parent.name, subscript, side), (child, "t" if self.local(child) else None)
            graph.add_edge(*reads, edge=(child, parent))
        return graph

    # text and figures --------------------------------------------------------------------------------------

    @property
    def text(self) -> str:
        """The factors as text in written order and canonical spelling; `parse` reads it, given the same `masks`."""
        return " ".join(map(str, self.factors))

    def _joint(self, variable: Callable[[str, str | None], str], bar: str, product: str) -> str:
        def sequences(names: Iterable[str]) -> str:
            return ", ".join(variable(name, "1:T" if self.local(name) else None) for name in names)

        variables = [name for block in self.blocks for name in block.names]
        context = bar + sequences(self.context) if self.context else ""
        static = [f.render(variable, bar) for f in self.factors if not f.local]
        local = [f.render(variable, bar) for f in self.factors if f.local]
        right = " ".join([*static, *([product] if local else []), *local])
        return f"{self.kind}({sequences(reversed(variables))}{context}) = {right}"

    def __str__(self) -> str:
        return self._joint(_plain, " | ", "∏_t")

    def _repr_latex_(self) -> str:
        return "$$" + self._joint(_latex, r" \mid ", r"\prod_{t=1}^{T}") + "$$"

    def _repr_html_(self) -> str:
        return f"<span>{self._joint(_html, ' | ', '∏<sub><i>t</i></sub>')}</span>"

    def draw(self, T: int = 3, ax: Axes | None = None, observed: Iterable[str] = ("x",)) -> Axes:
        """Draw the graphical model unrolled over time, with time from left to right.

        Latents are open circles, data shaded circles and context variables squares.

        Args:
            T: number of time steps.
            ax: matplotlib axes; a new figure if None.
            observed: names of the observed variables.

        Returns:
            The matplotlib axes.
        """
        return draw_dag(self.dag(T, observed), ax=ax)


def unrolled(name: str, local: bool, T: int) -> list[Node]:
    """Return the nodes of a variable in a graph of T steps: (name, 1) to (name, T), or (name, None) if static."""
    return [(name, t) for t in range(1, T + 1)] if local else [(name, None)]


def _node(name: str, t: int | None) -> str:
    return name if t is None else f"{name}_{t}"


def _names(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"


# ---------------------------------------------------------------------------------------------------- parsing


class _Reader:
    """Recursive-descent parser of the module's grammar; its errors show the column.

    Args:
        text: equations.
        masks: custom relations by name, as in `Factorization.parse`.
    """

    SPACE = re.compile(r"(?:\s|\\[,;:! ]|\\q?quad)*")
    BETWEEN = re.compile(r"(?:\s|\\[,;:! ]|\\q?quad|[*·,]|\\cdot|(?:∏|\\prod)(?:_\{t(?:=1\}\^\{?T)?\}|_t)?)*")
    NAME = re.compile(rf"(?:{FONT})?([^\W\d_]\w*)")
    NAME_IN_BRACES = re.compile(rf"{FONT}\{{\s*([^\W\d_](?:\w|\\_)*)\s*\}}(\w*)")
    SUBSCRIPT = re.compile(r"\{((?:[^{}]|\{[^{}]*\})*)\}")

    def __init__(self, text: str, masks: Mapping[str, Relation | MaskFunction]) -> None:
        self.text, self.position = text, 0
        self.masks = {name: self.custom(name, mask) for name, mask in masks.items()}
        self.local: dict[str, bool] = {}

    @staticmethod
    def custom(name: str, mask: Relation | MaskFunction) -> Relation:
        if not isinstance(mask, Relation):
            return Relation.custom(name, mask)
        return mask if mask.intervals else Relation.custom(name, mask.rows)

    def fail(self, message: str, position: int | None = None) -> NoReturn:
        position = self.position if position is None else position
        start = self.text.rfind("\n", 0, position) + 1
        line = self.text[start:].split("\n", 1)[0]
        raise NotationError(f"{message}\n    {line}\n    {' ' * (position - start)}^")

    def take(self, pattern: str | re.Pattern[str]) -> re.Match[str] | None:
        """Skip spaces, then consume and return a match of the pattern; return None if it does not match."""
        space = self.SPACE.match(self.text, self.position)
        self.position = space.end() if space else self.position
        match = re.compile(pattern).match(self.text, self.position)
        if match:
            self.position = match.end()
        return match

    def factorization(self) -> tuple[Literal["p", "q"], tuple[Factor, ...]]:
        factors: list[Factor] = []
        while self.take(self.BETWEEN) and self.position < len(self.text):
            start = self.position
            factor = self.factor()
            if factors and factor.kind != factors[0].kind:
                self.fail("p and q in one factorization; write the generative model and the guide as two texts", start)
            if any(factor.child == other.child for other in factors):
                self.fail(f"{factor.child} has a second factor; write exactly one factor for each variable", start)
            factors.append(factor)
        if not factors:
            self.fail('the text has no factors; write factors such as "p(z_t | z_{t-1}) p(x_t | z_t)"')
        return factors[0].kind, tuple(factors)

    def factor(self) -> Factor:
        head = self.take(r"([pq])(?:_[^\s()|]+?)?\s*(?:\\left)?\(")
        if head is None:
            self.fail("expected a factor: p(...) or q(...)")
        kind: Literal["p", "q"] = "p" if head[1] == "p" else "q"
        start = self.position
        child = self.variable()
        if child.relation not in (None, NOW, ALL):
            self.fail(f"a factor is for one step: write {kind}({child.name}_t | ...), not {child}", start)
        is_whole = child.relation == ALL
        parents = {child.name: Parent(child.name, True, PAST)} if is_whole else {}
        if self.take(r"\||\\mid(?![a-z])|\\vert(?![a-z])"):
            while True:
                self.take("")
                start = self.position
                parent = self.variable()
                is_relative = parent.relation not in (None, ALL) and parent.relation.intervals is not None
                if is_relative and (is_whole or not child.local):
                    self.fail(
                        f"{child if is_whole else f'{child.name} has one value per sequence and'} has no step t to "
                        f"which {parent} could refer; write {parent.name}_{{1:T}}"
                        + f", or the chain rule {kind}({child.name}_t | {child.name}_{{<t}}, {parent})"
                        * is_whole,
                        start,
                    )
                if (previous := parents.get(parent.name)) and previous.relation and parent.relation:
                    parent = Parent(parent.name, True, previous.relation | parent.relation)
                parents[parent.name] = parent
                if not self.take(","):
                    break
        if not self.take(r"(?:\\right)?\)"):
            self.fail(
                'expected "," or ")"'
                if parents
                else 'expected "|" or ")": a factor has exactly one variable before "|"'
            )
        return Factor(kind, child.name, child.local, tuple(parents.values()))

    def variable(self) -> Parent:
        name = self.take(self.NAME_IN_BRACES) or self.take(self.NAME)
        if name is None:
            self.fail("expected a variable: a name, or a name with a subscript such as z_t or z_{t-1}")
        start, word, relation = name.start(), "".join(name.groups()).replace(r"\_", "_"), None
        if word.endswith("_") and self.text[self.position : self.position + 1] == "{":
            word, relation = word[:-1], self.relation()
        elif word.endswith("_t"):
            word, relation = word[:-2], NOW
            if shift := self.take(r"[+\-\N{MINUS SIGN}]\s*\d+|[:<>=]"):
                self.fail(
                    f"braces are missing: write {word}_{{t{shift[0]}}}"
                    if shift[0][-1].isdigit()
                    else f"braces are missing: write {word}_{{...}}",
                    start,
                )
        elif word.endswith("_"):
            self.fail(f"a subscript needs braces: write {word}{{<t}}, {word}{{t-1}} or {word}t")
        elif subscript := re.search(r"_(\d+|T)$", word):
            stem = word[: subscript.start()]
            self.fail(
                f"{word} names one step; write {stem}_{{1:T}} for all steps, or {stem}{subscript[1]} for a separate "
                "variable",
                start,
            )
        if word in RESERVED:
            self.fail(f"the name {word!r} is reserved for {RESERVED[word]}; choose another name", start)
        local = relation is not None
        if self.local.setdefault(word, local) != local:
            was, now = ("per step", "per sequence") if self.local[word] else ("per sequence", "per step")
            self.fail(
                f"{word} has one value {was} earlier in the text and one value {now} here; give it a subscript, such "
                f"as {word}_t or {word}_{{1:T}}, everywhere or nowhere",
                start,
            )
        return Parent(word, local, relation)

    def relation(self) -> Relation:
        opening = self.position
        subscript = self.take(self.SUBSCRIPT)
        if subscript is None:
            self.fail('"{" without "}"; close the subscript', opening)
        inside = re.sub(FONT + r"\{([^{}]*)\}", r"\1", subscript[1])
        if inside.strip() in self.masks:
            return self.masks[inside.strip()]
        try:
            return Relation.parse(inside)
        except ValueError as error:
            hint = f" ({', '.join(self.masks)})" if self.masks else ""
            self.fail(f"{error}{hint if 'unknown' in str(error) else ''}", opening)


# -------------------------------------------------------------------------------------------- model and guide


def check_pair(
    generative: Factorization,
    inference: Factorization,
    observed: Iterable[str] = ("x",),
    sizes: Mapping[str, int] | None = None,
    summed: Collection[str] = (),
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Check that a guide fits a generative model.

    Args:
        generative: p over latents and observed variables.
        inference: q over the latents, given the data.
        observed: names of the observed variables.
        sizes: dimension of every variable, context included; not checked if None.
        summed: names of latents that are summed out, which the guide may neither draw nor read.

    Returns:
        Names (latents, observed, context), with latents in the guide's drawing order.

    Raises:
        ValueError: the guide or `sizes` do not fit the model. The message names the variable and a correction.
    """
    observed = tuple(observed)
    if generative.kind != "p" or inference.kind != "q":
        raise ValueError(
            "expected p(...) for the generative model and q(...) for the guide, got "
            f"{generative.text!r} and {inference.text!r}"
        )
    latents = tuple(name for name in generative.variables if name not in (*observed, *summed))
    for name in summed:
        if name not in generative.variables or name in observed:
            raise ValueError(
                f"{name} cannot be summed out, because it is not a latent of {generative.text!r}; the latents are "
                f"{_names(each for each in generative.variables if each not in observed)}"
            )
        for factor in inference.factors:
            if name == factor.child or factor.parent(name) is not None:
                raise ValueError(
                    f"{factor} {'draws' if name == factor.child else 'reads'} {name}, but a guide has no values of a "
                    f"latent that is summed out; remove {'this factor' if name == factor.child else name}"
                )
    for name in observed:
        if name not in generative.variables:
            raise ValueError(
                f"the observed variable {name} has no factor in {generative.text!r}; add p({name}_t | ...), or remove "
                f"{name} from `observed`"
            )
    for name in inference.variables:
        if name in observed:
            raise ValueError(f"{inference.factor(name)}: {name} is observed and not a latent; remove this factor")
        if name not in latents:
            raise ValueError(
                f"{inference.factor(name)}: no latent {name} in {generative.text!r}; remove this factor, "
                f"or add {_head('p', name, inference.local(name))} to the generative model"
            )
    for name in latents:
        if name not in inference.variables:
            add = _head("q", name, generative.local(name))
            raise ValueError(
                f"the latent {name} has no factor in the guide; add {add}, or name {name} as observed, or sum {name} "
                f"out if it is discrete: sizes={{{name!r}: dvae.Discrete(states)}}"
            )
    everything = dict.fromkeys((*generative.variables, *generative.context, *inference.context))
    for name in everything:
        locality = {f.kind: f.local(name) for f in (generative, inference) if name in f.variables + f.context}
        if len(set(locality.values())) > 1:
            has = {kind: "per step" if local else "per sequence" for kind, local in locality.items()}
            raise ValueError(
                f"{name} has one value {has['p']} in the generative model and one value {has['q']} in the guide; write "
                f"{name} with a subscript in both, or without one in both"
            )
    context = tuple(name for name in everything if name not in generative.variables)
    if sizes is not None:
        if missing := [name for name in everything if name not in sizes]:
            note = " (context, without a factor in the equations)" if set(missing) <= set(context) else ""
            raise ValueError(f"sizes missing for {_names(missing)}{note}; give the sizes of {_names(everything)}")
        if unknown := [name for name in sizes if name not in everything]:
            raise ValueError(
                f"sizes given for {_names(unknown)}, but the equations have only {_names(everything)}; remove "
                "them, or correct their names"
            )
    return tuple(name for block in inference.blocks for name in block.names), observed, context


def _head(kind: str, name: str, local: bool) -> str:
    return f"{kind}({name}{'_t' if local else ''} | ...)"
