"""Factorizations as graphs: is a guide rich enough for its model, and what do both look like.

The exact posterior of a latent, given what the guide has drawn before it and all that is given, depends on its Markov
boundary among them (`dvae.factorization.inversion`). A guide that cannot read all of it pays in the bound, however
large its networks are.
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
from .inversion import MarkovBoundaries, Order, Unrolled, faithful, guide, orders, spelled
from .notation import Factor, Factorization, Parent, check_pair
from .relations import Relation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from rich.table import Table


def analytic_kl(
    generative: Factorization, inference: Factorization, hidden: Iterable[str] = (), steps: int | None = None
) -> dict[str, bool]:
    """For which latents the bound may use the analytic KL(q(z_t | ...) || p(z_t | ...)).

    That form holds the parents of z_t in the model fixed while it averages over z_t, so it is right exactly
    where no such parent is a descendant of z_t in the guide. A backward guide q(z_t | z_{>t}, ...) for
    p(z_t | z_{t-1}) draws z_{t-1} from z_t: the analytic form would be biased, and the log-ratio has to be
    averaged instead. In place of hidden data the model reads its own mean, a function of that mean's parents: these
    are then parents of z_t too.

    Args:
        generative, inference: p and q.
        hidden: names of the data of which some entries are the model's own means (missing, or fed).
        steps: T of the run. None for the answer that holds at every length; with masks of the user's own, at 16.

    Returns:
        {latent: True where the analytic form is unbiased}, in the order in which the guide draws them.
    """
    relations, hidden = _relations(generative, inference), frozenset(hidden)
    if any(relation.intervals is None for relation in relations):
        T = steps or 16
    else:
        reach = sum(relation.lag for relation in relations)
        T = 3 + (reach**2 if hidden else reach)  # lags that add up again and again meet within their product
        T = min(T, steps or T)
    model, guide = generative.dag(T), inference.dag(T)
    bits = {node: 1 << place for place, node in enumerate({**model.nodes, **guide.nodes})}
    reads: dict[Node, int] = {}  # sets of nodes, as the bits of a number
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


class _Tabled:
    """What prints as lines of text, and in a notebook as a table, with a sentence."""

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
class Audit(_Tabled):
    """What a guide reads, against what the exact posterior depends on.

    Args:
        generative: the model.
        inference: the guide.
        observed: names of the observed variables.
        missing_parents: for each latent, what the exact posterior depends on and the guide factor cannot see.
            The bound cannot be tight.
        redundant_parents: for each latent, what the guide factor reads though the latent is independent of it
            given the rest of what that factor reads. Harmless: nothing is lost by dropping it.
        steps: the one length T that it holds for, where a mask is the user's own and may be another at every length;
            None where it holds for all.
        summed: names of latents that are summed out.

    Example:
        >>> found = dvae.audit("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})")
        >>> found.exact, found.missing
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
        """{latent: relations as text}, such as `{"z": ("z_{<t}",)}`; only latents that miss something."""
        return _terms(self.missing_parents)

    @property
    def redundant(self) -> dict[str, tuple[str, ...]]:
        """{latent: relations as text}; only latents whose factor reads something redundant."""
        return _terms(self.redundant_parents)

    @property
    def exact(self) -> bool:
        """True if nothing is missing: with a rich enough family the bound can reach the evidence."""
        return not self.missing

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        """(guide factor, missing, redundant) as text, in the order in which the guide draws."""
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
        """Whether the guide misses something, and which of its parents no variable of the pair explains."""
        known = {*self.generative.variables, *self.generative.context}
        alone = [name for name in self.inference.context if name not in known]
        said = f"; {', '.join(alone)} in the guide has no factor and is context that the data give" if alone else ""
        where = "" if self.steps is None else f" at T = {self.steps} (masks of your own may differ at other lengths)"
        if self.exact:
            return f"exact{where}: the guide reads everything the posterior depends on{said}"
        found = "the guide misses what the posterior depends on, so the bound stays below the evidence"
        return f"not exact{where}: {found}{said}"

    def table(self) -> Table:
        """A rich table with one row per guide factor."""
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
        """The guide that reads what this one misses and not what is redundant, in the same order (see `faithful`).

        Raises:
            ValueError: a mask of the user's own in the model.
        """
        return faithful(self.generative, self.observed, self.inference.blocks, self.summed)

    def draw(self, T: int = 3, ax: Axes | None = None) -> Axes:
        """Draws the guide over T steps: missing arrows dashed red, redundant ones dotted grey."""
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
    """Compares what each factor of a guide reads with what the exact posterior factor depends on.

    The exact factor is p(latent | latents the guide has drawn before, all data and context); a variable that
    the guide draws at all steps at once counts as drawn forward in time. Relations are read off `steps`
    inner steps of the unrolled graphs, away from the first and the last, where there is no past or no future
    to depend on; steps is widened where a relation reaches further. A pattern that is periodic in time (a lag
    of 2 without one of 1) is listed as far as seen.

    A mask of the user's own is known at one length at a time, and may single out some steps: the graphs are then
    compared at all of exactly `steps` steps, and the audit says so.

    Args:
        generative: p, a factorization or its text.
        inference: q, "" where nothing is latent; the prior if None.
        steps: number of inner steps compared, 5 if None; with masks of the user's own T, the length that they will
            be used at, 16 if None.
        observed: names of the observed variables.
        summed: names of latents that are summed out (`Discrete`), which the posterior of the others does not wait for.

    Raises:
        ValueError: the two do not fit each other (see `dvae.factorization.notation.check_pair`).

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
    model, read = generative.dag(view.length), inference.dag(view.length)
    given = {node for name in (*data, *context) for node in view.nodes(name)}
    model.add_nodes_from(given)
    read.add_nodes_from(given)
    inner = {node for name in latents for node in view.inner(name)}
    boundaries = MarkovBoundaries(model)
    needs, uses = {}, {}
    for node in view.drawn(inference.blocks):
        if node in inner:
            needs[node] = boundaries.of(node, given)
            uses[node] = boundaries.of(node, set(read.predecessors(node)))
        given.add(node)
    lacks = {node: boundary - set(read.predecessors(node)) for node, boundary in needs.items()}

    missing: dict[str, tuple[Parent, ...]] = {}
    redundant: dict[str, tuple[Parent, ...]] = {}
    for child in latents:
        for name in local:
            lacking = view.offsets(lacks, child, name)
            # An offset used anywhere is not redundant: near the edges of a chain any reading may be idle.
            unused = view.offsets(read.pred, child, name) & ~view.offsets(uses, child, name)
            for found, offsets in ((missing, lacking), (redundant, unused)):
                if offsets.any():
                    found[child] = (*found.get(child, ()), view.parent(child, name, offsets))
    return Audit(generative, inference, data, missing, redundant, view.length if custom else None, summed)


# --------------------------------------------------------------------------------------------- derived guides


@dataclass(frozen=True)
class Derived:
    """A guide that misses nothing, as `faithful` derives it.

    Args:
        order: in which it draws.
        inference: the guide.
        arrows: of its graph unrolled, how much it reads.
        looped: latents that it draws step by step; the others are drawn at all steps at once.
        sampled: latents whose KL has no closed form under this guide, so that the bound has the noise of their draws.
    """

    order: Order
    inference: Factorization
    arrows: int
    looped: tuple[str, ...]
    sampled: tuple[str, ...]


@dataclass(frozen=True)
class Alternatives(_Tabled):
    """The guides of a model that miss nothing, the one with the fewest arrows first; those without a loop before it.

    Attributes:
        generative: the model.
        guides: what there is to choose from.
        steps: T of the graphs whose arrows were counted.

    Example:
        >>> found = dvae.alternatives("p(w) p(z_t | z_{t-1}, w) p(x_t | z_t)")
        >>> len(found), found[0].text
        (4, 'q(w | x_{1:T}) q(z_t | z_{t-1}, x_{>=t}, w)')
    """

    header = ("guide", "drawn", "arrows", "looped", "KL by draws")

    generative: Factorization
    guides: tuple[Derived, ...]
    steps: int

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """(guide, order, arrows, latents in a loop, latents whose KL is averaged over draws) as text."""
        return [
            (
                each.inference.text,
                spelled(each.order),
                str(each.arrows),
                ", ".join(each.looped) or "-",
                ", ".join(each.sampled) or "-",
            )
            for each in self.guides
        ]

    @property
    def verdict(self) -> str:
        """One sentence."""
        return f"each reads what the posterior depends on in its order (see `faithful`); arrows of {self.steps} steps"

    def table(self) -> Table:
        """A rich table with one row per guide."""
        from rich.table import Table
        from rich.text import Text

        table = Table(title="guides that miss nothing", title_justify="left", caption=self.verdict)
        for name in self.header:
            table.add_column(name, justify="right" if name == "arrows" else "left")
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
    """All guides that `faithful` derives, one for each order of drawing; one for those that have the same.

    Args:
        generative: p, a factorization or its text.
        observed: names of the observed variables.
        steps: T at which arrows are counted.
        summed: see `faithful`.

    Raises:
        ValueError: as `faithful`; a model without latents.

    Example:
        >>> print(dvae.alternatives("p(z_t | z_{t-1}) p(x_t | z_t)"))
        guide                      drawn       arrows  looped  KL by draws
        q(z_t | z_{t-1}, x_{>=t})  z forward   64      z       -
        q(z_t | z_{t+1}, x_{<=t})  z backward  64      z       z
        each reads what the posterior depends on in its order (see `faithful`); arrows of 10 steps
    """
    generative, observed, summed = Factorization.parse(generative), tuple(observed), tuple(summed)
    if steps < 1:
        raise ValueError(f"arrows are counted in at least 1 step, not {steps}")
    found: dict[frozenset[Factor], Derived] = {}
    for order in orders(generative, observed, summed):
        inference = faithful(generative, observed, order, summed)
        if not inference.factors:
            raise ValueError(f"nothing is latent in {generative.text!r}: there is no guide to derive")
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
        found.setdefault(frozenset(inference.factors), derived)
    guides = sorted(found.values(), key=lambda each: (bool(each.looped), each.arrows, len(each.sampled)))
    return Alternatives(generative, tuple(guides), steps)
