"""Factorizations as graphs: audit whether a guide can represent the exact posterior, and list guides that can.

The exact posterior of a latent, given the data and the latents that the guide has already drawn, depends only on some
of these variables: the Markov boundary of the latent (`dvae.factorization.inversion`). If a guide does not read the
whole boundary, its bound is not tight, however large its networks are.
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
    """Return for each latent z whether the bound may use the analytic KL(q(z_t | ...) || p(z_t | ...)).

    The analytic form fixes the parents of z_t in the model and averages over z_t. It is therefore unbiased exactly if
    no such parent is a descendant of z_t in the guide. For example, a backward guide q(z_t | z_{>t}, ...) of
    p(z_t | z_{t-1}) draws z_{t-1} from z_t. The analytic form would then be biased, so the bound averages
    log q - log p over draws.

    The model replaces missing data by its own mean, which is a function of other variables. If z_t depends on replaced
    data, these variables count as parents of z_t too.

    Args:
        generative: p, factorization of the model.
        inference: q, factorization of the guide.
        hidden: names of data variables with entries that the model replaces by its own mean, because they are missing
            or because of scheduled sampling.
        steps: length T of the sequences. If None, the result holds at every length, or only at T = 16 if there are
            custom masks.

    Returns:
        Dictionary from latent to whether the analytic form is unbiased, in the guide's drawing order.
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
    """Comparison of the parents that a guide reads with the parents that the exact posterior depends on.

    Printing an audit shows a table with one row per guide factor.

    Args:
        generative: factorization p of the model.
        inference: factorization q of the guide.
        observed: names of the observed variables.
        missing_parents: parents of each latent that its exact posterior depends on and its guide factor does not read.
            With missing parents, the bound cannot be tight.
        redundant_parents: parents of each latent that its guide factor reads, although the latent is independent of
            them given the other parents. Removing them does not loosen the bound.
        steps: with custom masks, the only length T to which the audit applies. None without custom masks: the audit
            then applies to all lengths.
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
        """Missing parents of each latent as text, such as `{"z": ("z_{<t}",)}`; without any, a latent has no entry."""
        return _terms(self.missing_parents)

    @property
    def redundant(self) -> dict[str, tuple[str, ...]]:
        """Redundant parents of each latent as text, as in `missing`; without any, a latent has no entry."""
        return _terms(self.redundant_parents)

    @property
    def exact(self) -> bool:
        """Whether no parent is missing.

        The bound of an exact guide can equal the log evidence if its distributions are flexible enough.
        """
        return not self.missing

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        """Rows of text (guide factor, missing parents, redundant parents), in the guide's drawing order."""
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
        """Sentence that states whether parents are missing and which variables of the guide are not in the model."""
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
        """Guide with all missing and no redundant parents, derived by `faithful_inverse` for the same drawing order.

        Raises:
            ValueError: the model has a custom mask.
        """
        return faithful_inverse(self.generative, self.observed, self.inference.blocks, self.summed)

    def draw(self, T: int = 3, ax: Axes | None = None) -> Axes:
        """Draw the guide unrolled over time, with missing edges dashed and red, redundant edges dotted and grey.

        Args:
            T: number of time steps.
            ax: matplotlib axes; a new figure if None.

        Returns:
            The matplotlib axes.
        """
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
    """Compare the variables that each factor of a guide reads with those that the exact posterior factor depends on.

    The exact factor is p(latent | latents the guide has already drawn, all data and context). If the guide draws a
    variable at all steps at once, the audit treats its steps as drawn one after the other, forward in time.

    The audit unrolls both graphs and compares `steps` inner steps, or more if a relation has a long lag. It excludes
    the first and last steps, because they have no past or no future to depend on. If a dependency is periodic in time
    (a lag of 2 without a lag of 1), the result lists only the lags within the compared steps.

    A custom mask is known only at a given length and may treat some steps differently. With custom masks, the audit
    therefore unrolls exactly `steps` steps, compares all of them, and names this length in its verdict.

    Args:
        generative: p, a factorization or its text.
        inference: q, a factorization or its text; "faithful" for the guide that `faithful_inverse` derives; None for
            the prior; "" for a model without latents.
        steps: number of compared inner steps, 5 if None. With custom masks, the length T at which the model will be
            used, 16 if None.
        observed: names of the observed variables.
        summed: names of latents that are summed out (`Discrete`). The guide does not draw them, so the posteriors of
            the other latents do not condition on them.

    Returns:
        The missing and the redundant parents of each guide factor.

    Raises:
        ValueError: a text cannot be parsed, or the guide does not fit the model
            (`dvae.factorization.notation.check_pair`).

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
    """A guide without missing parents, derived by `faithful_inverse` for one drawing order.

    Args:
        order: drawing order of the latents.
        inference: factorization of the guide.
        edges: number of edges of the guide's graph, unrolled over `Alternatives.steps` steps.
        sequential: names of latents that are drawn step by step; the others are drawn at all steps at once.
        sampled: names of latents whose KL term has no unbiased closed form under this guide (`analytic_kl`). The bound
            averages these terms over draws, which adds sampling noise.
    """

    order: Order
    inference: Factorization
    edges: int
    sequential: tuple[str, ...]
    sampled: tuple[str, ...]


@dataclass(frozen=True)
class Alternatives(_TextTable):
    """All guides of a model that `faithful_inverse` derives; each reads all that its exact posterior depends on.

    Guides without a loop over time come first, sorted by their number of edges, then guides with a loop, sorted in the
    same way. Index an object with i for the factorization of guide i; `len` returns the number of guides.

    Attributes:
        generative: factorization of the model.
        guides: the guides in this order.
        steps: number of time steps T over which `Derived.edges` are counted.

    Example:
        >>> guides = dvae.alternatives("p(w) p(z_t | z_{t-1}, w) p(x_t | z_t)")
        >>> len(guides), guides[0].text
        (4, 'q(w | x_{1:T}) q(z_t | z_{t-1}, x_{>=t}, w)')
    """

    header = ("guide", "order", "edges", "sequential", "sampled KL")

    generative: Factorization
    guides: tuple[Derived, ...]
    steps: int

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """Rows of text: guide, order of drawing, edges, latents drawn step by step, latents whose KL is sampled."""
        return [
            (
                each.inference.text,
                describe_order(each.order),
                str(each.edges),
                ", ".join(each.sequential) or "-",
                ", ".join(each.sampled) or "-",
            )
            for each in self.guides
        ]

    @property
    def verdict(self) -> str:
        """Caption of the table."""
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
    """Return the distinct guides that `faithful_inverse` derives over all drawing orders.

    Each drawing order in `orders` gives one guide. Orders with equal guides count once.

    Args:
        generative: p, a factorization or its text.
        observed: names of the observed variables.
        steps: number of time steps T over which edges are counted, at least 1.
        summed: names of latents that are summed out, as in `faithful_inverse`.

    Raises:
        ValueError: `steps` is less than 1, the model has no latents, an observed variable is not in the model, or the
            model has a custom mask.

    Example:
        >>> print(dvae.alternatives("p(z_t | z_{t-1}) p(x_t | z_t)"))
        guide                      order       edges  sequential  sampled KL
        q(z_t | z_{t-1}, x_{>=t})  z forward   64     z           -
        q(z_t | z_{t+1}, x_{<=t})  z backward  64     z           z
        each reads what the posterior depends on in its order (see `faithful_inverse`); edges of 10 steps
    """
    generative, observed, summed = Factorization.parse(generative), tuple(observed), tuple(summed)
    if steps < 1:
        raise ValueError(f"`steps` must be at least 1 (number of time steps over which edges are counted), got {steps}")
    unique: dict[frozenset[Factor], Derived] = {}
    for order in orders(generative, observed, summed):
        inference = faithful_inverse(generative, observed, order, summed)
        if not inference.factors:
            raise ValueError(
                f"{generative.text!r} has no latents, so no guide can be derived; give a model with a latent, such as "
                "p(z_t | z_{t-1}) p(x_t | z_t)"
            )
        sequential = tuple(name for block in inference.blocks if block.direction for name in block.names)
        closed = analytic_kl(generative, inference)
        closed |= {f.child: False for f in generative.factors if f.child in closed and any(map(f.parent, summed))}
        derived = Derived(
            order,
            inference,
            inference.dag(steps).number_of_edges(),
            sequential,
            tuple(name for name, exact in closed.items() if not exact),
        )
        unique.setdefault(frozenset(inference.factors), derived)
    guides = sorted(unique.values(), key=lambda each: (bool(each.sequential), each.edges, len(each.sampled)))
    return Alternatives(generative, tuple(guides), steps)
