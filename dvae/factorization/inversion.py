"""Faithful inversion: derive a guide from the graph of a model, for a given drawing order.

The posterior of latents that are drawn one after the other is prod_i p(v_i | v_{<i}, data). Each factor depends only on
its Markov boundary among the given variables. d-separation is a compositional graphoid, so this boundary is unique: it
contains v if v is not d-separated from v_i by all other given variables (Pearl, 1988).

A guide that reads exactly the boundary misses no dependency, and all of its edges are necessary. Each order has its own
such guide (Webb, Golinski, Zinkov, Siddharth, Rainforth, Teh and Wood, 2018, arXiv 1712.00287). Boundaries are computed
in the graph unrolled over time, by the moral-graph criterion (Lauritzen, Dawid, Larsen and Leimer, 1990), and converted
back into relations.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from itertools import permutations

import networkx as nx
import numpy as np

from .drawing import Node
from .notation import Block, Factor, Factorization, Parent, unrolled
from .relations import ALL, MaskFunction, Relation

FAITHFUL = "faithful"
"""Text that can replace the equations of a guide; it selects the guide that `faithful_inverse` derives."""
Order = tuple[Block, ...]
"""Blocks of latents in drawing order; all steps of a block are drawn before the next block."""


class MarkovBoundaries:
    """Markov boundaries of the nodes of a graph.

    Sets of nodes are stored as integers with one bit per node.

    Args:
        dag: directed acyclic graph with edges from parent to child.
    """

    def __init__(self, dag: nx.DiGraph):
        self.nodes: list[Node] = list(dag)
        self.bits = {node: 1 << index for index, node in enumerate(self.nodes)}
        self.parents = [self._to_bits(dag.pred[node]) for node in self.nodes]
        self.children = [self._to_bits(dag.succ[node]) for node in self.nodes]

    def of(self, node: Node, conditioning_set: AbstractSet[Node]) -> set[Node]:
        """Return the Markov boundary of a node.

        It is the smallest subset of the conditioning set that makes the node independent of the rest of this set. It
        contains a given node u exactly if the other given nodes do not d-separate `node` from u. All nodes that are not
        given are integrated out.

        Args:
            node: a node that is not in `conditioning_set`.
            conditioning_set: nodes whose values are known.
        """
        start, given_bits = self.bits[node], self._to_bits(conditioning_set)
        ancestors = frontier = start | given_bits
        while frontier:
            parents = 0
            for index in _bit_indices(frontier):
                parents |= self.parents[index]
            frontier = parents & ~ancestors
            ancestors |= frontier
        # In the moral graph of these nodes, a child and its parents (a family) are neighbours. Given nodes block paths.
        boundary, families, visited, frontier = 0, 0, start, start
        while frontier:
            candidates = frontier
            for index in _bit_indices(frontier):
                candidates |= self.children[index]
            families |= (new := candidates & ancestors & ~families)
            neighbours = new
            for index in _bit_indices(new):
                neighbours |= self.parents[index]
            boundary |= neighbours & given_bits
            frontier = neighbours & ~given_bits & ~visited
            visited |= frontier
        return {self.nodes[index] for index in _bit_indices(boundary)}

    def _to_bits(self, nodes: Iterable[Node]) -> int:
        return sum(self.bits[node] for node in nodes)


def _bit_indices(bits: int) -> Iterator[int]:
    while bits:
        lowest = bits & -bits
        yield lowest.bit_length() - 1
        bits ^= lowest


@dataclass(frozen=True)
class Unrolled:
    """The inner steps of an unrolled graph, whose dependencies become relations.

    The first and last steps of the graph are margins. Results exclude them, because their past or future is cut off.

    Args:
        local: dictionary from variable to whether it has one value per step (True) or per sequence (False).
        width: W, number of inner steps.
        margin: number of steps before and after the inner steps.
    """

    local: Mapping[str, bool]
    width: int
    margin: int

    @property
    def length(self) -> int:
        """Number of steps T of the graph, including both margins."""
        return self.width + 2 * self.margin

    def nodes(self, name: str) -> list[Node]:
        """Return the nodes of a variable at all steps, margins included; the only node of a static variable."""
        return unrolled(name, self.local[name], self.length)

    def inner(self, name: str) -> list[Node]:
        """Return the nodes of a variable at the inner steps; the only node of a static variable."""
        return self.nodes(name)[self.margin : self.margin + self.width] or self.nodes(name)

    def drawn(self, order: Sequence[Block]) -> Iterator[Node]:
        """Yield the nodes of the latents in drawing order.

        The nodes of a block that is drawn at all steps at once are yielded forward in time.
        """
        for block in order:
            for step in zip(*(self.nodes(name)[:: block.direction or 1] for name in block.names), strict=True):
                yield from step

    def offsets(self, edges: Mapping[Node, Iterable[Node]], child: str, parent: str) -> np.ndarray:
        """Return for each offset s - t whether the child at any inner step t depends on the parent at step s.

        Args:
            edges: parent nodes of each child node.
            child: name of the child.
            parent: name of the parent.

        Returns:
            Bool array (2 W - 1,) for the offsets -(W-1), ..., W-1. If the child or the parent is static, the array has
            shape (1,) and contains whether there is any edge.
        """
        rows, columns = map(self.inner, (child, parent))
        reads = np.array([[column in edges[row] for column in columns] for row in rows])
        if not self.in_time(child, parent):
            return np.array([reads.any()])
        return np.array([reads.diagonal(offset).any() for offset in range(1 - self.width, self.width)])

    def parent(self, child: str, name: str, offsets: np.ndarray) -> Parent:
        """Return a parent that is read at these offsets.

        The most distant offset of the inner steps represents all offsets beyond it, so its relation has no bound.

        Args:
            child: name of the child.
            name: name of the parent.
            offsets: result of `offsets`.
        """
        relation = ALL if self.local[name] else None
        if self.in_time(child, name):
            far = self.width - 1
            steps = [int(index) - far for index in np.flatnonzero(offsets)]
            relation = Relation.of((-math.inf if k == -far else k, math.inf if k == far else k) for k in steps)
        return Parent(name, self.local[name], relation)

    def in_time(self, child: str, parent: str) -> bool:
        """Return whether the edges between two variables have offsets, which requires that both are local."""
        return self.local[child] and self.local[parent]


def faithful_inverse(
    generative: Factorization | str,
    observed: Iterable[str] = ("x",),
    order: Sequence[Block] | None = None,
    summed: Iterable[str] = (),
) -> Factorization:
    """Return the smallest guide that contains every dependency of the exact posterior in a drawing order.

    Every edge is necessary for exactness, with one exception. A dependency may be periodic in time: for example, with
    a lag of 2 and no lag of 1, a posterior depends on every second step. The notation cannot express this for all
    steps. The guide then reads every step beyond the distance 2 L K, which is more than it needs. L is the sum of the
    model's different lags, and K is the number of latents.

    Args:
        generative: p, a factorization or its text.
        observed: names of the observed variables.
        order: drawing order of the latents, such as one of `orders`. By default, static latents are drawn first. The
            local latents follow together, step by step forward in time, within a step in the order of the model.
        summed: names of latents that are summed out (`Discrete`), which no guide draws.

    Returns:
        The guide q.

    Raises:
        ValueError: an observed variable is not in the model; the order does not contain each latent once, or mixes
            static and local latents in a block; the model has a custom mask, which is known only at a given length.
        TypeError: the order contains an item that is not a `Block`.

    >>> print(dvae.faithful_inverse("p(z_t | z_{t-1}) p(x_t | z_t)").text)
    q(z_t | z_{t-1}, x_{>=t})
    """
    generative = Factorization.parse(generative)
    data = tuple(observed)
    latents = _latents(generative, data, summed := tuple(summed))
    order = tuple(order) if order is not None else next(iter(orders(generative, data, summed)))
    if not all(isinstance(block, Block) for block in order):
        raise TypeError(
            "`order` must contain only Block objects, like the results of dvae.factorization.inversion.orders, got "
            f"{order!r}"
        )
    if mixed_blocks := [b for b in order if len({generative.local(n) for n in b.names if n in latents}) > 1]:
        raise ValueError(
            f"the block '{describe_order(mixed_blocks[:1])}' of the order mixes static and local latents; put static "
            "latents in separate blocks"
        )
    if sorted(name for block in order for name in block.names) != sorted(latents):
        raise ValueError(
            f"the order must contain the latents {', '.join(latents)}, each exactly once, got '{describe_order(order)}'"
        )
    relations = [p.relation for f in generative.factors for p in f.parents if p.relation is not None]
    if custom := [relation for relation in relations if relation.intervals is None]:
        raise ValueError(
            f"the model has the custom mask {custom[0]}, which may differ between lengths, but a derived guide must "
            "hold at every length; write the guide yourself and check it with audit(model, guide, steps=T)"
        )
    reach = sum({relation.lag for relation in relations}) * max(1, len(latents))
    names = (*latents, *data, *generative.context)
    view = Unrolled({name: generative.local(name) for name in names}, width=4 * reach + 3, margin=2 * reach + 2)
    boundaries = MarkovBoundaries(generative.dag(view.length))
    given = {node for name in (*data, *generative.context) for node in view.nodes(name)}
    inner = {node for name in latents for node in view.inner(name)}
    needs = {}
    for node in view.drawn(order):
        if node in inner:
            needs[node] = boundaries.of(node, given)
        given.add(node)

    def factor(child: str) -> Factor:
        parents = []
        for name in sorted(names, key=lambda name: not view.local[name]):  # static parents last, as in papers
            offsets = view.offsets(needs, child, name)
            if view.in_time(child, name):  # a dependency this far away repeats periodically
                far = np.flatnonzero(offsets) - (view.width - 1)
                for side in (-1, 1):
                    if (beyond := far[side * far > 2 * reach]).size:
                        start = side * int(abs(beyond).min())
                        tail = range(start, side * view.width, side)
                        offsets[[offset + view.width - 1 for offset in tail]] = True
            if offsets.any():
                parents.append(view.parent(child, name, offsets))
        return Factor("q", child, view.local[child], tuple(parents))

    return Factorization("q", tuple(factor(name) for block in order for name in block.names))


def orders(
    generative: Factorization | str, observed: Iterable[str] = ("x",), summed: Iterable[str] = ()
) -> Iterator[Order]:
    """Yield the drawing orders of the latents: static ones first or last, the others forward or backward in time.

    Several local latents are drawn together step by step, with every order within a step, or one after the other, each
    at all of its steps.

    Args:
        generative: p, a factorization or its text.
        observed: names of the observed variables.
        summed: names of latents that are summed out, as in `faithful_inverse`.

    Raises:
        ValueError: a name in `observed` or `summed` is not a variable of the model.

    >>> [describe_order(order) for order in orders("p(w) p(z_t | z_{t-1}, w) p(x_t | z_t)")]
    ['w, z forward', 'w, z backward', 'z forward, w', 'z backward, w']
    """
    generative = Factorization.parse(generative)
    latents = _latents(generative, tuple(observed), tuple(summed))
    statics = tuple(Block((name,), 0) for name in latents if not generative.local(name))
    local = [name for name in latents if generative.local(name)]
    for statics_last in (False, True) if statics and local else (False,):
        for names in permutations(local):
            for separately in (False, True) if len(names) > 1 else (False,):
                for direction in (1, -1) if names else (1,):
                    groups = [(name,) for name in names] if separately else [names] if names else []
                    locals_ = tuple(Block(group, 1 if direction > 0 else -1) for group in groups)
                    yield (*locals_, *statics) if statics_last else (*statics, *locals_)


def describe_order(order: Sequence[Block]) -> str:
    """Return a drawing order in words, such as "w, z forward"."""
    ways = {1: " forward", -1: " backward", 0: ""}
    return ", ".join(" with ".join(block.names) + ways[block.direction] for block in order)


def _latents(generative: Factorization, observed: tuple[str, ...], summed: tuple[str, ...]) -> list[str]:
    """Return the latents in the model's drawing order, without latents that are summed out."""
    for name in (*observed, *summed):
        generative.factor(name)
    return [name for block in generative.blocks for name in block.names if name not in (*observed, *summed)]


def guide(
    generative: Factorization,
    inference: Factorization | str | None,
    observed: Iterable[str] = ("x",),
    masks: Mapping[str, Relation | MaskFunction] | None = None,
    summed: Iterable[str] = (),
) -> Factorization:
    """Return the factorization of the guide that the argument `inference` of a model selects.

    Args:
        generative: factorization of the model.
        inference: a factorization or its text; "faithful" for the guide that `faithful_inverse` derives; None for the
            prior as a guide; "" for a guide without factors, for a model without latents.
        observed: names of the observed variables.
        masks: custom relations by name, as in `Factorization.parse`.
        summed: names of latents that are summed out, as in `faithful_inverse`.

    Raises:
        NotationError, ValueError, TypeError: as in `Factorization.parse` and `faithful_inverse`.
    """
    if inference is None:
        return generative.prior_guide((*observed, *summed))
    if isinstance(inference, str) and not inference.strip():
        return Factorization("q", ())
    if isinstance(inference, str) and inference.strip() == FAITHFUL:
        return faithful_inverse(generative, observed, summed=summed)
    return Factorization.parse(inference, masks)
