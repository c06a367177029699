"""Factorizations as graphs: audit whether a guide can represent the exact posterior, and draw both.

The exact posterior of a latent, given the data and the latents that the guide has already drawn, depends on its Markov
boundary among them (`dvae.factorization.inversion`). If a guide cannot read the whole boundary, its bound is not tight,
however large its networks are.
"""

from __future__ import annotations

import html
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Any, ClassVar

import networkx as nx

from .drawing import Edge, Node, draw_dag
from .inversion import MarkovBoundaries, Order, Unrolled, describe_order, faithful_inverse, guide, orders
from .notation import Factor, Factorization, Parent, check_pair
from .relations import Relation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from rich.table import Table


def analytic_kl(
    generative: Factorization, inference: Factorization, hidden: Iterable[str] = (), steps: int | None = None
) -> dict[str, bool]:
    """Return for which latents the bound may use the analytic KL(q(z_t | ...) || p(z_t | ...)).

    The analytic form fixes the parents of z_t in the model and averages over z_t. It is therefore unbiased exactly if
    no such parent is a descendant of z_t in the guide. A backward guide q(z_t | z_{>t}, ...) for p(z_t | z_{t-1}) draws
    z_{t-1} from z_t, so the analytic form would be biased and the log-ratio is averaged instead.

    The model replaces hidden data by its own mean, a function of the parents of that mean. These parents then count as
    parents of z_t too.

    Args:
        generative, inference: p and q.
        hidden: names of the data with entries replaced by the model's own means (missing, or scheduled sampling).
        steps: T of the run. If None, the answer holds at every length; with custom masks, at T = 16.

    Returns:
        {latent: True if the analytic form is unbiased}, in the guide's drawing order.
    """
    relations, hidden = _relations(generative, inference), frozenset(hidden)
    if any(relation.intervals is None for relation in relations):
        T = steps or 16
    else:
        reach = sum(relation.lag for relation in relations)
        T = 3 + (reach**2 if hidden else reach)  # repeated sums of lags meet within the product of the lags
        T = min(T, steps or T)
    model, guide = generative.dag(T), inference.dag(T)
    bits = {node: 1 << index for index, node in enumerate({**model.nodes, **guide.nodes})}
    reads: dict[Node, int] = {}  # sets of nodes, as the bits of an integer
    for node in nx.topological_sort(model):
        parents = model.pred[node]
        reads[node] = reduce(or_, (bits[p] | (reads[p] if p[0] in hidden else 0) for p in parents), 0)
    moves: dict[Node, int] = {}
    for node in reversed(list(nx.topological_sort(guide))):
        moves[node] = reduce(or_, (bits[child] | moves[child] for child in guide.succ[node]), 0)
    latents = [name for block in inference.blocks for name in block.names]
    return {latent: not any(moves[n] & reads[n] for n in guide if n[0] == latent) for latent in latents}


def _relations(*factorizations: Factorization) -> list[Relation]:
    parents = (p for f in factorizations for factor in f.factors for p in factor.parents)
    return [parent.relation for parent in parents if parent.relation is not None]


# ------------------------------------------------------------------------------------------------------ audit


class _TextTable:
    """A result that prints as lines of text and, in a notebook, as an HTML table with a caption."""

    header: ClassVar[tuple[str, ...]]
    rows: Any
    verdict: Any

    def __str__(self) -> str:
        rows = [self.header, *self.rows]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
        return "\n".join(line.rstrip() for line in [*lines, self.verdict])

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{cell}</th>" for cell in self.header)
        body = "".join(f"<tr>{''.join(f'<td>{html.escape(c)}</td>' for c in row)}</tr>" for row in self.rows)
        return f"<table><caption>{self.verdict}</caption><tr>{head}</tr>{body}</table>"


@dataclass(frozen=True)
class Audit(_TextTable):
    """Comparison of what a guide reads with what the exact posterior depends on.

    Args:
        generative: the model.
        inference: the guide.
        observed: names of the observed variables.
        missing_parents: for each latent, the parents that the exact posterior depends on and the guide factor does not
            read. Without them the bound cannot be tight.
        redundant_parents: for each latent, parents of the guide factor of which the latent is independent given the
            other parents. Dropping them loses nothing.
        steps: the only length T for which the audit holds if there are custom masks, which may differ between lengths;
            None if it holds for all lengths.
        summed: names of latents that are summed out.

    Example:
        >>> result = dvae.audit("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})")
        >>> result.exact, result.missing
        (False, {'z': ('z_{t-1}',)})
    """

    header = ("guide factor", "missing", "redundant")

    generative: Factorization
    inference: Factorization
    observed: tuple[str, ...]
    missing_parents: dict[str, tuple[Parent, ...]] = field(repr=False)
    redundant_parents: dict[str, tuple[Parent, ...]] = field(repr=False)
    steps: int | None = None
    summed: tuple[str, ...] = ()

    @property
    def missing(self) -> dict[str, tuple[str, ...]]:
        """{latent: relations as text}, such as `{"z": ("z_{<t}",)}`, for latents with missing parents."""
        return _terms(self.missing_parents)

    @property
    def redundant(self) -> dict[str, tuple[str, ...]]:
        """{latent: relations as text}, for latents with redundant parents."""
        return _terms(self.redundant_parents)

    @property
    def exact(self) -> bool:
        """True if nothing is missing: with a flexible enough family the bound can equal the evidence."""
        return not self.missing

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        """Rows (guide factor, missing, redundant) as text, in the guide's drawing order."""
        names = [name for block in self.inference.blocks for name in block.names]
        return [
            (
                str(self.inference.factor(name)),
                ", ".join(self.missing.get(name, ())) or "-",
                ", ".join(self.redundant.get(name, ())) or "-",
            )
            for name in names
        ]

    @property
    def verdict(self) -> str:
        """A sentence: whether the guide misses dependencies, and which of its variables the model does not contain."""
        model_names = {*self.generative.variables, *self.generative.context}
        unknown = [name for name in self.inference.context if name not in model_names]
        note = f"; {', '.join(unknown)} in the guide has no factor and is context that the data give" if unknown else ""
        scope = "" if self.steps is None else f" at T = {self.steps} (custom masks may differ at other lengths)"
        if self.exact:
            return f"exact{scope}: the guide reads everything the posterior depends on{note}"
        reason = "the guide misses what the posterior depends on, so the bound stays below the evidence"
        return f"not exact{scope}: {reason}{note}"

    def table(self) -> Table:
        """Return a rich table with one row per guide factor."""
        from rich.table import Table
        from rich.text import Text

        table = Table(title=f"audit: {'exact' if self.exact else 'not exact'}", title_justify="left")
        for name in self.header:
            table.add_column(name)
        for factor, missing, redundant in self.rows:
            table.add_row(Text(factor), Text(missing, style="" if missing == "-" else "red"), Text(redundant))
        return table

    @property
    def repaired(self) -> Factorization:
        """The guide with the missing and without the redundant parents, in the same drawing order; see
        `faithful_inverse`.

        Raises:
            ValueError: the model contains a custom mask.
        """
        return faithful_inverse(self.generative, self.observed, self.inference.blocks, self.summed)

    def draw(self, T: int = 3, ax: Axes | None = None) -> Axes:
        """Draw the guide over T steps: missing edges dashed red, redundant edges dotted grey."""
        dag = self.inference.dag(T, self.observed)
        redundant = self._edges(self.redundant_parents, T)
        missing = self._edges(self.missing_parents, T)
        unread = {source for source, _ in missing} - set(dag)
        for name, t in sorted(unread, key=lambda node: node[1] or 0):
            dag.add_node((name, t), kind="data" if name in self.observed else "context")
        return draw_dag(dag, ax=ax, missing=missing, redundant=redundant)

    def _edges(self, parents: dict[str, tuple[Parent, ...]], T: int) -> list[Edge]:
        factors = [Factor("q", name, self.inference.local(name), reads) for name, reads in parents.items()]
        return [edge for factor in factors for edge in factor.edges(T)]


def _terms(parents: dict[str, tuple[Parent, ...]]) -> dict[str, tuple[str, ...]]:
    return {latent: tuple(t for parent in reads for t in parent.terms) for latent, reads in parents.items() if reads}


def audit(
    generative: Factorization | str,
    inference: Factorization | str | None,
    steps: int | None = None,
    observed: Iterable[str] = ("x",),
    summed: Iterable[str] = (),
) -> Audit:
    """Compare what each factor of a guide reads with what the exact posterior factor depends on.

    The exact factor is p(latent | latents the guide has already drawn, all data and context). A variable that the guide
    draws at all steps at once counts as drawn forward in time.

    The audit unrolls both graphs and compares `steps` inner steps. It excludes the first and last steps, which have no
    past or no future to depend on. More steps are compared if a relation has a longer lag. A pattern that is periodic
    in time (a lag of 2 without a lag of 1) is listed only within these steps.

    A custom mask is known only at a given length and may treat some steps differently. The graphs are then compared at
    all of exactly `steps` steps, and the verdict reports this length.

    Args:
        generative: p, a factorization or its text.
        inference: q, a factorization or its text; "" without latents; the prior if None.
        steps: number of inner steps compared, 5 if None. With custom masks, the length T at which they will be used,
            16 if None.
        observed: names of the observed variables.
        summed: names of latents that are summed out (`Discrete`); the posterior of the others is not conditioned on
            them.

    Raises:
        ValueError: the guide does not fit the model, as defined by `dvae.factorization.notation.check_pair`.

    >>> dvae.audit("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})").missing
    {'z': ('z_{t-1}',)}
    """
    generative = Factorization.parse(generative)
    observed, summed = tuple(observed), tuple(summed)
    inference = guide(generative, inference, observed, summed=summed)
    latents, data, context = check_pair(generative, inference, observed, summed=summed)
    relations = _relations(generative, inference)
    custom = any(relation.intervals is None for relation in relations)
    if custom:
        width, margin = steps or 16, 0
    else:
        lag = max((relation.lag for relation in relations), default=0)
        width, margin = max(steps or 5, 2 * lag + 3), 2 * lag + 2
    local = {name: (inference if name in inference.context else generative).local(name) for name in context}
    local |= {name: generative.local(name) for name in (*data, *latents)}
    view = Unrolled(local, width, margin)
    model_dag, guide_dag = generative.dag(view.length), inference.dag(view.length)
    given = {node for name in (*data, *context) for node in view.nodes(name)}
    model_dag.add_nodes_from(given)
    guide_dag.add_nodes_from(given)
    inner = {node for name in latents for node in view.inner(name)}
    boundaries = MarkovBoundaries(model_dag)
    needs, uses = {}, {}
    for node in view.drawn(inference.blocks):
        if node in inner:
            needs[node] = boundaries.of(node, given)
            uses[node] = boundaries.of(node, set(guide_dag.predecessors(node)))
        given.add(node)
    unread = {node: boundary - set(guide_dag.predecessors(node)) for node, boundary in needs.items()}

    missing: dict[str, tuple[Parent, ...]] = {}
    redundant: dict[str, tuple[Parent, ...]] = {}
    for child in latents:
        for name in local:
            missing_offsets = view.offsets(unread, child, name)
            # An offset that any step needs is not redundant: near the ends of a chain every offset may be unused.
            redundant_offsets = view.offsets(guide_dag.pred, child, name) & ~view.offsets(uses, child, name)
            for parents, offsets in ((missing, missing_offsets), (redundant, redundant_offsets)):
                if offsets.any():
                    parents[child] = (*parents.get(child, ()), view.parent(child, name, offsets))
    return Audit(generative, inference, data, missing, redundant, view.length if custom else None, summed)


# --------------------------------------------------------------------------------------------- derived guides


@dataclass(frozen=True)
class Derived:
    """A guide that misses nothing, derived by `faithful_inverse`.

    Args:
        order: drawing order of the latents.
        inference: the guide.
        edges: number of edges of its unrolled graph.
        looped: latents that are drawn step by step; the others are drawn at all steps at once.
        sampled: latents whose KL has no closed form under this guide, so that the bound contains sampling noise.
    """

    order: Order
    inference: Factorization
    edges: int
    looped: tuple[str, ...]
    sampled: tuple[str, ...]


@dataclass(frozen=True)
class Alternatives(_TextTable):
    """The guides of a model that miss nothing. Guides without a loop are first, then those with the fewest edges.

    Attributes:
        generative: the model.
        guides: the guides to choose from.
        steps: T of the graphs whose edges were counted.

    Example:
        >>> guides = dvae.alternatives("p(w) p(z_t | z_{t-1}, w) p(x_t | z_t)")
        >>> len(guides), guides[0].text
        (4, 'q(w | x_{1:T}) q(z_t | z_{t-1}, x_{>=t}, w)')
    """

    header = ("guide", "drawn", "edges", "looped", "KL by draws")

    generative: Factorization
    guides: tuple[Derived, ...]
    steps: int

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """Rows (guide, order, edges, latents drawn in a loop, latents whose KL is averaged over draws) as text."""
        return [
            (
                each.inference.text,
                describe_order(each.order),
                str(each.edges),
                ", ".join(each.looped) or "-",
                ", ".join(each.sampled) or "-",
            )
            for each in self.guides
        ]

    @property
    def verdict(self) -> str:
        """A caption for the table."""
        guides = "each reads what the posterior depends on in its order (see `faithful_inverse`)"
        return f"{guides}; edges of {self.steps} steps"

    def table(self) -> Table:
        """Return a rich table with one row per guide."""
        from rich.table import Table
        from rich.text import Text

        table = Table(title="guides that miss nothing", title_justify="left", caption=self.verdict)
        for name in self.header:
            table.add_column(name, justify="right" if name == "edges" else "left")
        for row in self.rows:
            table.add_row(*map(Text, row))
        return table

    def __getitem__(self, place: int) -> Factorization:
        return self.guides[place].inference

    def __len__(self) -> int:
        return len(self.guides)


def alternatives(
    generative: Factorization | str, observed: Iterable[str] = ("x",), steps: int = 10, summed: Iterable[str] = ()
) -> Alternatives:
    """Return all guides that `faithful_inverse` derives, one for each drawing order, without duplicates.

    Args:
        generative: p, a factorization or its text.
        observed: names of the observed variables.
        steps: T at which edges are counted.
        summed: names of latents that are summed out, as in `faithful_inverse`.

    Raises:
        ValueError: `steps` is less than 1, the model has no latents, or `faithful_inverse` raises it.

    Example:
        >>> print(dvae.alternatives("p(z_t | z_{t-1}) p(x_t | z_t)"))
        guide                      drawn       edges  looped  KL by draws
        q(z_t | z_{t-1}, x_{>=t})  z forward   64     z       -
        q(z_t | z_{t+1}, x_{<=t})  z backward  64     z       z
        each reads what the posterior depends on in its order (see `faithful_inverse`); edges of 10 steps
    """
    generative, observed, summed = Factorization.parse(generative), tuple(observed), tuple(summed)
    if steps < 1:
        raise ValueError(f"steps must be at least 1 to count edges, got {steps}")
    unique: dict[frozenset[Factor], Derived] = {}
    for order in orders(generative, observed, summed):
        inference = faithful_inverse(generative, observed, order, summed)
        if not inference.factors:
            raise ValueError(f"{generative.text!r} has no latents, so no guide can be derived")
        looped = tuple(name for block in inference.blocks if block.direction for name in block.names)
        closed = analytic_kl(generative, inference)
        closed |= {f.child: False for f in generative.factors if f.child in closed and any(map(f.parent, summed))}
        derived = Derived(
            order,
            inference,
            inference.dag(steps).number_of_edges(),
            looped,
            tuple(name for name, exact in closed.items() if not exact),
        )
        unique.setdefault(frozenset(inference.factors), derived)
    guides = sorted(unique.values(), key=lambda each: (bool(each.looped), each.edges, len(each.sampled)))
    return Alternatives(generative, tuple(guides), steps)
