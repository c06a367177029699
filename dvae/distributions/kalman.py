"""Linear-Gaussian chains with time-varying matrices: exact filter, smoother and draws, batched.

    z_1 ~ N(m_1, P_1)        z_t = A_t z_{t-1} + b_t + N(0, Q_t)        weight of z_t: exp(g_t' z_t - z_t' G_t z_t / 2)

The weights are what observations leave of themselves: a_t = C_t z_t + N(0, R) gives G_t = C_t' R^-1 C_t and
g_t = C_t' R^-1 a_t, and a missing one zeros. All work is then in the dimension of z (Kalman, 1960; Rauch, Tung and
Striebel, 1965; in information form, Särkkä, Bayesian Filtering and Smoothing, 2013).

The prediction is one autograd function. With W_t = (I + P_t G_t)^-1 and F_t = A_{t+1} W_t it is

    P_{t+1} = Q_{t+1} + F_t P_t A_{t+1}'        m_{t+1} = F_t m_t + A_{t+1} W_t P_t g_t + b_{t+1}

of which only the first is not linear; its derivative is F_t dP F_t'. So both recursions of the backward pass are linear
with known matrices: three products a step, all else at all steps at once. So are smoother and draws, from the last step
back. Long series run in blocks (`scan.py`).

Where observations are precise, terms cancel: W_t P_t g_t multiplies a small matrix by a large vector. So all work is in
float64, and the m_t are refined once: a filter of single steps finds the error of each, which F carries forward. Then
they are exact to a thousandth of their deviations where the product of variance and information is at most 1e10.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from .scan import Covariances, Recursion, States, backward, from_last, riccati, symmetric


class Moments(NamedTuple):
    """Means (T, B, N) and covariances (T, B, N, N) of every z_t."""

    mean: Tensor
    covariance: Tensor


@dataclass(frozen=True)
class LinearGaussianChain:
    """The chain and its weights, see the file; time comes first. Gradients flow through all its results, in float64.

    Args:
        transition: A_2 to A_T, (T - 1, B, N, N).
        offset: b_2 to b_T, (T - 1, B, N).
        noise: Q, (N, N), or Q_2 to Q_T, (T - 1, B, N, N).
        mean, covariance: m_1 (B, N) and P_1 (B, N, N).
        information: G, (T, B, N, N), symmetric.
        potential: g, (T, B, N).
    """

    transition: Tensor
    offset: Tensor
    noise: Tensor
    mean: Tensor
    covariance: Tensor
    information: Tensor
    potential: Tensor

    def __post_init__(self) -> None:
        for each in fields(self):
            object.__setattr__(self, each.name, getattr(self, each.name).double())

    @cached_property
    def predicted(self) -> Moments:
        """Of z_t given what came before t."""
        return Moments(
            *Predict.apply(
                self.transition,
                self.offset,
                self.noise.expand_as(self.transition),
                self.mean,
                self.covariance,
                self.information,
                self.potential,
            )
        )

    @cached_property
    def filtered(self) -> Moments:
        """Of z_t given what came up to t."""
        return update(*self.predicted, self.information, self.potential)

    @cached_property
    def _gain(self) -> Tensor:
        """(T - 1, B, N, N) coefficient of z_{t+1} in E(z_t | z_{t+1}, what came up to t)."""
        return torch.linalg.solve(self.predicted.covariance[1:], self.transition @ self.filtered.covariance[:-1]).mT

    @cached_property
    def _backward(self) -> tuple[Tensor, Moments]:
        """Of z_t given z_{t+1} and what came up to t, from the last t back: the gain, and moments at z_{t+1} = 0."""
        gain = self._gain
        rest = torch.eye(gain.shape[-1], dtype=gain.dtype, device=gain.device) - gain @ self.transition
        # a sum of squares (Joseph's form), which stays positive where the difference would not
        spread = rest @ self.filtered.covariance[:-1] @ rest.mT + gain @ self.noise @ gain.mT
        mean = self.filtered.mean[:-1] - _times(gain, self.predicted.mean[1:])
        return gain.flip(0), Moments(mean.flip(0), symmetric(spread).flip(0))

    @cached_property
    def smoothed(self) -> Moments:
        """Of z_t given everything."""
        gain, (mean, covariance) = self._backward
        means = States.apply(gain, mean, self.filtered.mean[-1])
        covariances = Covariances.apply(gain, covariance, self.filtered.covariance[-1])
        return Moments(means.flip(0), covariances.flip(0))

    @property
    def lag_one(self) -> Tensor:
        """(T - 1, B, N, N) Cov(z_{t+1}, z_t) given everything."""
        return self.smoothed.covariance[1:] @ self._gain.mT

    def draw(self, noise: Tensor) -> Tensor:
        """Reparameterised draws (T, B, N) of z_{1:T} given everything, from standard normal noise of that shape."""
        gain, (mean, covariance) = self._backward
        roots = torch.linalg.cholesky(torch.cat([self.filtered.covariance[-1:], covariance]))
        values = torch.cat([self.filtered.mean[-1:], mean]) + _times(roots, noise.flip(0).double())
        return States.apply(gain, values[1:], values[0]).flip(0)


def update(mean: Tensor, covariance: Tensor, information: Tensor, potential: Tensor) -> Moments:
    """Moments of N(mean, covariance) times exp(g' z - z' G z / 2); shapes (..., N) and (..., N, N)."""
    identity = torch.eye(mean.shape[-1], dtype=mean.dtype, device=mean.device)
    moved = _column(covariance, potential - _times(information, mean))
    # the covariance after times the difference would be less exact, where that is large
    right = torch.cat([covariance, moved], dim=-1)
    solved = torch.linalg.solve_ex(identity + covariance @ information, right)[0]
    return Moments(mean + solved[..., -1], symmetric(solved[..., :-1]))


class Predict(torch.autograd.Function):
    """The arguments of a `LinearGaussianChain` to m (T, B, N) and P (T, B, N, N); see the file."""

    @staticmethod
    def forward(
        ctx: Any,
        transition: Tensor,
        offset: Tensor,
        noise: Tensor,
        mean: Tensor,
        covariance: Tensor,
        information: Tensor,
        potential: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Run the filter."""
        covariances, shrink, carry = riccati(transition, noise, information[:-1], covariance)
        covariances = symmetric(covariances)
        filtered = shrink @ covariances[:-1]
        gathered = (transition @ _column(filtered, potential[:-1])).add_(offset[..., None])
        recursion = Recursion(carry)
        means = recursion.states(gathered, mean[..., None])[..., 0]
        after = update(means[:-1], covariances[:-1], information[:-1], potential[:-1]).mean
        wrong = _times(transition, after) + offset - means[1:]
        means = means + recursion.states(wrong[..., None], torch.zeros_like(mean)[..., None])[..., 0]
        ctx.save_for_backward(transition, information, potential, means, filtered, shrink, carry)
        return means, covariances

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_mean: Tensor, to_covariance: Tensor) -> tuple[Tensor, ...]:
        """Gradients of the arguments from those of means and covariances.

        That of G is not symmetric; its symmetric part is the gradient, since G is symmetric.
        """
        transition, information, potential, means, filtered, shrink, carry = ctx.saved_tensors
        back = backward(carry)
        total = back.states(*from_last(to_mean[..., None])).flip(0)
        later = total[1:]
        missed = potential[:-1, ..., None] - information[:-1] @ means[:-1, ..., None]
        totals = to_covariance.clone()
        totals[:-1] += (carry.mT @ later) @ (shrink.mT @ missed).mT
        totals = back.covariances(*from_last(symmetric(totals))).flip(0)
        laters = totals[1:]
        to_filtered = transition.mT @ later  # gradient of the filtered mean
        moved = filtered @ to_filtered
        spread = transition.mT @ laters @ transition + to_filtered @ missed.mT
        filtered_mean = means[:-1, ..., None] + filtered @ missed
        to_information, to_potential = torch.zeros_like(information), torch.zeros_like(potential)
        to_potential[:-1] = moved[..., 0]
        to_information[:-1] = -(filtered @ spread @ filtered) - moved @ means[:-1, ..., None].mT
        to_transition = later @ filtered_mean.mT + 2 * (laters @ (transition @ filtered))
        return (
            to_transition,
            later[..., 0],
            laters,
            total[0, ..., 0],
            totals[0],
            to_information,
            to_potential,
        )


def _column(matrix: Tensor, vector: Tensor) -> Tensor:
    return matrix @ vector[..., None]


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return _column(matrix, vector)[..., 0]
