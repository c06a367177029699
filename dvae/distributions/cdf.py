"""Cumulative distribution functions of single coordinates, for the probability integral transform."""

from __future__ import annotations

from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution

from .hurdle import HurdleLogNormal
from .precise import OffsetDistribution, _Wrapped
from .product import ProductDistribution
from .triangular import TriangularNormal

MAX_COUNT = 100_000
"""Largest count up to which probabilities are summed."""


def cdf(distribution: Any, value: Tensor) -> tuple[Tensor, Tensor]:
    """Return P(X < x) and P(X <= x) of each coordinate, (..., D) each; NaN where the distribution has no such function.

    Both are equal for a continuous variable. Coordinates of a joint normal have their marginal distributions. Of a
    one-hot vector, each coordinate is 0 or 1.

    Args:
        distribution: distribution of values (..., D), with one density per coordinate or per step.
        value: x, (..., D).
    """
    if isinstance(distribution, ProductDistribution):
        parts = [cdf(part, value[..., places]) for places, part in distribution.parts]
        return tuple(torch.cat(each, -1)[..., distribution.order] for each in zip(*parts, strict=True))  # type: ignore[return-value]
    if isinstance(distribution, OffsetDistribution):
        return cdf(distribution.base, (value - distribution.offset).to(distribution.dtype))
    if isinstance(distribution, _Wrapped):
        return cdf(distribution.base, value)
    if isinstance(distribution, dist.Bernoulli | dist.OneHotCategorical):
        zero = 1 - distribution.probs
        return torch.where(value > 0.5, zero, 0.0), torch.where(value > 0.5, 1.0, zero)
    if isinstance(distribution, dist.MultivariateNormal | dist.LowRankMultivariateNormal | TriangularNormal):
        distribution = dist.Normal(distribution.mean, distribution.variance.sqrt())
    if distribution.event_shape:
        return (torch.full_like(value, torch.nan),) * 2
    if isinstance(distribution, dist.Poisson):
        below = torch.special.gammaincc(value.clamp(min=1), distribution.rate)
        return torch.where(value > 0, below, 0.0), torch.special.gammaincc(value + 1, distribution.rate)
    if distribution.support.is_discrete:
        return _sums(distribution, value)
    if isinstance(distribution, dist.StudentT | dist.Beta):
        return (_special(distribution, value),) * 2
    if type(distribution).cdf is Distribution.cdf:
        return (torch.full_like(value, torch.nan),) * 2
    upto = distribution.cdf(value)
    return (torch.where(value > 0, upto, 0.0) if isinstance(distribution, HurdleLogNormal) else upto), upto


def _sums(distribution: Any, value: Tensor) -> tuple[Tensor, Tensor]:
    """Sum the probabilities of the whole numbers from 0 to each value."""
    below = upto = torch.zeros_like(value)
    if value.max() > MAX_COUNT:
        return (torch.full_like(value, torch.nan),) * 2
    for number in range(int(value.max()) + 1):
        share = distribution.log_prob(torch.full_like(value, number)).exp()
        below, upto = below + share * (number < value), upto + share * (number <= value)
    return below, upto


def _special(distribution: Any, value: Tensor) -> Tensor:
    from scipy import special  # slow to import

    def array(tensor: Tensor) -> Any:
        return tensor.double().cpu().numpy()

    if isinstance(distribution, dist.Beta):
        shares = special.betainc(array(distribution.concentration1), array(distribution.concentration0), array(value))
    else:
        shares = special.stdtr(array(distribution.df), array((value - distribution.loc) / distribution.scale))
    return torch.as_tensor(shares).to(value)
