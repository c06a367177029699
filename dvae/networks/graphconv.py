"""GraphConv: residual graph convolutions over nodes, on the cosine coefficients of their trajectories.

    H' = tanh(BN(A H W + b))

A is a free adjacency matrix over nodes, learned separately for each layer. The layers read the first C cosine
coefficients of each node's trajectory, and output all steps together.

Mao, Liu, Salzmann and Li, 2019, arXiv 1908.05436 (the network); Mao, Liu and Salzmann, 2021, arXiv 2108.08422 (one
network for every part of the nodes), with the layers of its public implementation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from typing_extensions import override

from ..constants import indices
from .base import FixedLengthNetwork, Input
from .cosine import cosine_basis


@dataclass(frozen=True)
class GraphConv:
    """A network from trajectories of nodes and static parents to trajectories of the child's nodes.

    Every node reads all static parents. The features are the coordinates of the child.

    Args:
        nodes: {name of a local variable: indices of its nodes}, for the child and all local parents. All nodes have
            the same number of coordinates. One parent must contain all nodes. Its trajectories are the input; the other
            parents replace the trajectories of their nodes in it.
        child: name of the child.
        length: T, number of steps of every sequence.
        coefficients: C, number of cosine coefficients per trajectory, at most T.
        width: number of features of a node.
        blocks: number of residual blocks with two convolutions each.
    """

    nodes: Mapping[str, Sequence[int]]
    child: str
    length: int
    coefficients: int = 10
    width: int = 256
    blocks: int = 4

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> GraphConvNetwork:
        """Return the network of a factor, as in `NetworkSpec.build`.

        Args:
            inputs: the parents of the factor.
            local: whether the child has a value at every step; otherwise it is static.
            size: D, dimension of the child.

        Raises:
            ValueError: the child is static, a size does not match the number of nodes, or no parent contains all nodes.
                Also if the factor does not read the same first steps of a parent at every t, or `coefficients` is not
                between 1 and `length`.
        """
        return GraphConvNetwork(self, inputs, local, size)


class GraphConvNetwork(FixedLengthNetwork):
    """Network of `GraphConv`; the features (B, T, D) are the child's coordinates."""

    def __init__(self, spec: GraphConv, inputs: Sequence[Input], local: bool, size: int):
        super().__init__(inputs, local, size)
        child_nodes, coefficients = list(spec.nodes[spec.child]), spec.coefficients
        self.spec, self.own, self.coordinates = spec, child_nodes, size // len(child_nodes)
        if not local or size % len(child_nodes):
            raise ValueError(
                f"GraphConv needs a local child whose size is a multiple of its {len(child_nodes)} nodes, but "
                f"{spec.child} is {'local' if local else 'static'} and has size {size}"
            )
        self.trajectories: list[tuple[str, list[int], int]] = []
        for parent in self.inputs:
            if parent.relation is None:
                continue
            nodes_of_parent = list(spec.nodes.get(parent.name, ()))
            if parent.size != self.coordinates * len(nodes_of_parent):
                raise ValueError(
                    f"{parent.name} has size {parent.size}, but `nodes` lists {len(nodes_of_parent)} nodes with "
                    f"{self.coordinates} coordinates each, {nodes_of_parent}; list all nodes of {parent.name}"
                )
            self.trajectories.append((parent.name, nodes_of_parent, _visible_steps(parent, spec.length)))
        self.trajectories.sort(key=lambda trajectory: -len(trajectory[1]))
        if not self.trajectories or sorted(self.trajectories[0][1]) != list(range(len(self.trajectories[0][1]))):
            raise ValueError(
                "GraphConv needs a parent whose `nodes` are all nodes, such as the history h_{1:O}; the parents are "
                f"{', '.join(parent.name for parent in self.inputs)}"
            )
        cosine_basis(spec.length, coefficients)  # raises an error for too many coefficients
        self.statics = [parent.name for parent in self.inputs if parent.relation is None]
        nodes = len(self.trajectories[0][1])
        self.inner = self.coordinates * coefficients
        into = self.inner + sum(parent.size for parent in self.inputs if parent.relation is None)
        self.first: Any = _Convolution(nodes, into, spec.width, normalised=True)
        self.rest: Any = nn.ModuleList(
            nn.Sequential(*(_Convolution(nodes, spec.width, spec.width, bias=False, normalised=True) for _ in range(2)))
            for _ in range(spec.blocks)
        )
        self.last = _Convolution(nodes, spec.width, into)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        """Return the child's coordinates (B, T, D).

        Raises:
            ValueError: the batch is ragged, T differs from the specified `length`, or a training batch has one row.
        """
        self.refuse_ragged(lengths)
        if length != self.spec.length:
            raise ValueError(
                f"GraphConv(length={self.spec.length}) was given {length} steps; build it with length={length}"
            )
        if self.training and len(parents[self.trajectories[0][0]]) == 1:
            raise ValueError(
                "GraphConv normalises over the batch, so training needs at least 2 rows, got 1; use a larger batch or "
                "more draws"
            )
        with torch.autocast(self.last.weight.device.type, enabled=False):  # half precision is too coarse for positions
            coefficients = self._coefficients(parents)
        static = [parents[name][:, None].expand(-1, coefficients.shape[1], -1) for name in self.statics]
        inputs = torch.cat([coefficients, *static], dim=-1)
        hidden = self.first(inputs)
        for block in self.rest:
            hidden = hidden + block(hidden)
        outputs: Tensor = (self.last(hidden) + inputs)[..., : self.inner].index_select(1, indices(self.own, hidden))
        outputs = outputs.unflatten(-1, (self.coordinates, -1)).flatten(1, 2).to(coefficients.dtype)
        with torch.autocast(outputs.device.type, enabled=False):
            return (outputs @ self._transform(length, outputs)).transpose(1, 2)

    def _coefficients(self, parents: Mapping[str, Tensor]) -> Tensor:
        """Return (B, nodes, coordinates * C): coefficients of the first coordinate, then of the second, and so on."""
        total: Tensor | None = None
        for name, nodes, n_steps in self.trajectories:
            values, node_indices = parents[name][:, :n_steps], indices(nodes, self.last.weight)
            coefficients = (self._transform(n_steps, values) @ values).transpose(1, 2)  # (B, nodes * coordinates, C)
            coefficients = coefficients.unflatten(1, (-1, self.coordinates)).flatten(2)
            total = (
                coefficients.index_select(1, node_indices.argsort())
                if total is None
                else total.index_copy(1, node_indices, coefficients)
            )
        assert total is not None
        return total

    def _transform(self, n_steps: int, like: Tensor) -> Tensor:
        return _transform(n_steps, self.spec.length, self.spec.coefficients, like.dtype, like.device)


class _Convolution(nn.Module):
    """The map A H W + b on (B, nodes, features), optionally followed by batch normalisation and tanh."""

    def __init__(self, nodes: int, features: int, out: int, bias: bool = True, normalised: bool = False):
        super().__init__()

        def uniform(*shape: int) -> nn.Parameter:
            return nn.Parameter(torch.empty(shape).uniform_(-1, 1) / math.sqrt(out))

        self.weight, self.adjacency = uniform(features, out), uniform(nodes, nodes)
        self.bias = uniform(out) if bias else None
        self.norm: Any = nn.BatchNorm1d(nodes * out) if normalised else None

    def forward(self, nodes: Tensor) -> Tensor:
        nodes = nodes @ self.weight
        out: Tensor = _Mix.apply(self.adjacency.to(nodes.dtype), nodes)  # under autocast the product has another dtype
        if self.bias is not None:
            out = out + self.bias
        return out if self.norm is None else torch.tanh(self.norm(out.flatten(1)).view(out.shape))


class _Mix(Function):
    """The product A H over (B, nodes, features).

    It is a batched product on a view of A, because matmul and einsum would copy H. The gradient of A is one long
    product instead of B small ones. Forward and backward take a third of the time of einsum.
    """

    @staticmethod
    def forward(ctx: Any, adjacency: Tensor, nodes: Tensor) -> Tensor:
        ctx.save_for_backward(adjacency, nodes)
        return torch.bmm(adjacency.expand(len(nodes), -1, -1), nodes)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        adjacency, nodes = ctx.saved_tensors
        gradients, others = (values.transpose(0, 1).flatten(1) for values in (gradient, nodes))
        return gradients @ others.T, torch.bmm(adjacency.T.expand(len(nodes), -1, -1), gradient)


def _visible_steps(parent: Input, length: int) -> int:
    """Return O if the first O steps of a parent are read at every step; raise a ValueError for any other mask."""
    assert parent.relation is not None
    mask = torch.as_tensor(parent.relation.mask(length))
    count = int(mask[0].sum())
    if not count or (mask != (torch.arange(length) < count)).any():
        raise ValueError(
            f"GraphConv needs parents that are read from their first step on, the same steps at every t, as in "
            f"{parent.name}_{{1:T}}; {parent.name} is read at {parent.relation.name}"
        )
    return count


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # a matrix created in inference mode could not be used under autograd
def _transform(n_steps: int, length: int, coefficients: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the matrix (C, O) from O visible steps to coefficients of T steps, which repeat the last visible one."""
    basis = cosine_basis(length, coefficients)
    folded = torch.cat([basis[:, : n_steps - 1], basis[:, n_steps - 1 :].sum(1, keepdim=True)], dim=1)
    return folded.to(device, dtype)
