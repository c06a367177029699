"""WithNoise: append a given noise scale to the features of a network, for `distributions.KnownNoise`.

    p(x_t | z_t, s_t) = N(f(z_t), s_t²)

Examples are instruments that report the precision of each measurement, and averages over a known number of repetitions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from ..distributions.families import KnownNoise
from .base import Input, Network, NetworkSpec
from .loop import select, valid_steps
from .recurrent import Recurrent


@dataclass(frozen=True)
class WithNoise:
    """A network on all parents except the noise scale, which is appended to its features.

    Use it with `distributions.KnownNoise`.

    Args:
        scale: name of the parent with one standard deviation per coordinate, a context variable at t or a static one.
        network: specification of the network on the other parents.

    Example:
        >>> networks = {"p(x)": dvae.networks.WithNoise("s", dvae.networks.Dense((8,)))}
        >>> pair = "p(z_t | z_{t-1}) p(x_t | z_t, s_t)", "q(z_t | z_{t-1}, x_{1:T}, s_{1:T})"
        >>> sizes, distributions = {"z": 2, "x": 3, "s": 3}, {"p(x)": dvae.distributions.KnownNoise()}
        >>> model = dvae.DynamicalVAE(*pair, sizes, networks, distributions)
        >>> model.sample(batch={"s": torch.full((2, 5, 3), 0.1)})["x"].shape
        torch.Size([2, 5, 3])
    """

    scale: str = "s"
    network: NetworkSpec = field(default_factory=Recurrent)

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> WithNoiseNetwork:
        """Return the network of a factor that reads the scale, as in `NetworkSpec.build`.

        Args:
            inputs: the parents of the factor.
            local: whether the child has a value at every step; otherwise it is static.
            size: D, dimension of the child.

        Raises:
            ValueError: the factor does not read the scale, reads it at other steps than t, has no other parents, or the
                scale and the child have different sizes.
        """
        scales = [p for p in inputs if p.name == self.scale and p.size == size and p.lags in (None, (0,))]
        if not scales or (scales[0].relation is not None) != (scales[0].lags == (0,)) or len(inputs) < 2:
            raise ValueError(
                f"WithNoise needs the noise scale {self.scale} of size {size}, read at t or static, and other parents, "
                f"as in p(x_t | z_t, {self.scale}_t); the parents are "
                f"{', '.join(f'{p.name} ({p.size})' for p in inputs)}"
            )
        inner = self.network.build([p for p in inputs if p is not scales[0]], local, size)
        return WithNoiseNetwork(inner, inputs, scales[0], local)


class WithNoiseNetwork(Network):
    """Network of `WithNoise`; its features are the inner network's, followed by the scale."""

    head = KnownNoise

    def __init__(self, inner: Any, inputs: Sequence[Input], scale: Input, local: bool):
        super().__init__(inputs, local, inner.features + scale.size)
        self.inner, self.name, self.stationary = inner, scale.name, inner.stationary

    def _without_scale(self, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {name: value for name, value in values.items() if name != self.name}

    def _scales(self, values: Tensor, length: int, lengths: Tensor | None) -> Tensor:
        """Return the scales (B, T, D) or (B, D), 1 at padding."""
        if values.dim() == 2 and self.local:
            values = values[:, None].expand(-1, length, -1)
        valid = torch.ones_like(values, dtype=torch.bool)
        if lengths is not None and values.dim() == 3:
            valid = valid_steps(lengths, length)[..., None].expand_as(values)
        if (bad := valid & ~(values > 0)).any():
            index = bad.nonzero()[0].tolist()
            raise ValueError(
                f"{self.name} is {values[tuple(index)].item():g} in sequence {index[0]}, but a noise scale must be "
                "above 0"
            )
        return torch.where(valid, values, 1.0)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        features = self.inner(self._without_scale(parents), length, lengths)
        return torch.cat([features, self._scales(parents[self.name], length, lengths)], -1)

    @override
    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        if self.name not in parents:
            raise ValueError(f"the noise scale {self.name} cannot be drawn; give it as context in the batch")
        scales = self._scales(parents[self.name], length, lengths).unbind(1)
        return self.inner.start(self._without_scale(parents), batch, length, lengths), scales

    @override
    def step(self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        inner, scales = state
        features, inner = self.inner.step(inner, t, samples)
        return torch.cat([features, scales[t]], -1), (inner, scales)

    @override
    def select(self, state: Any, rows: Tensor | None) -> Any:
        inner, scales = state
        return self.inner.select(inner, rows), select(scales, rows)
