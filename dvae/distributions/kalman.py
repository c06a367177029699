"""Linear-Gaussian chains with time-varying matrices: exact filter, smoother and draws, batched.

    z_1 ~ N(m_1, P_1)        z_t = A_t z_{t-1} + b_t + N(0, Q_t)        weight of z_t: exp(g_t' z_t - z_t' G_t z_t / 2)

The weights are the likelihoods of observations: a_t = C_t z_t + N(0, R) gives G_t = C_t' R^-1 C_t and
g_t = C_t' R^-1 a_t. A missing observation gives zeros. All computations have the dimension of z (Kalman, 1960;
Rauch, Tung and Striebel, 1965; in information form, Särkkä, Bayesian Filtering and Smoothing, 2013).

The prediction is one autograd function. With W_t = (I + P_t G_t)^-1 and F_t = A_{t+1} W_t it is

    P_{t+1} = Q_{t+1} + F_t P_t A_{t+1}'        m_{t+1} = F_t m_t + A_{t+1} W_t P_t g_t + b_{t+1}

Only the first recursion is nonlinear; its derivative is F_t dP F_t'. Both recursions of the backward pass are therefore
linear with known matrices. They need three products per step; everything else is computed at all steps at once. The
smoother and the draws, which start at the last step, are also linear recursions. Long series run in blocks (`scan.py`).

Precise observations cause cancellation: W_t P_t g_t multiplies a small matrix by a large vector. All computations
therefore use float64, and the m_t are corrected once: a filter step from each m_t gives the error of m_{t+1}, and the
recursion with F_t accumulates these errors. The means are then exact to a thousandth of their standard deviations if
variance times information is at most 1e10.
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
    """Means (T, B, N) and covariances (T, B, N, N) of z_1 to z_T, in float64."""

    mean: Tensor
    covariance: Tensor


@dataclass(frozen=True)
class LinearGaussianChain:
    """A linear-Gaussian chain z_1 to z_T with weights, in the notation of this module.

    A weight is the likelihood of the observation at step t as a function of z_t. Time is the first dimension of all
    tensors. All results are in float64 and differentiable with respect to all arguments.

    Args:
        transition: matrices A_2 to A_T, (T - 1, B, N, N).
        offset: offsets b_2 to b_T, (T - 1, B, N).
        noise: covariance Q of the noise, (N, N), or Q_2 to Q_T, (T - 1, B, N, N).
        mean: mean m_1 of z_1, (B, N).
        covariance: covariance P_1 of z_1, (B, N, N).
        information: quadratic terms G_1 to G_T of the log weights, (T, B, N, N), symmetric.
        potential: linear terms g_1 to g_T of the log weights, (T, B, N).
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
        """Moments of each z_t given the weights at steps before t."""
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
        """Moments of each z_t given the weights at steps up to t."""
        return update(*self.predicted, self.information, self.potential)

    @cached_property
    def _gain(self) -> Tensor:
        """Matrices (T - 1, B, N, N) that multiply z_{t+1} in E(z_t | z_{t+1}, weights up to t), for t = 1 to T - 1."""
        return torch.linalg.solve(self.predicted.covariance[1:], self.transition @ self.filtered.covariance[:-1]).mT

    @cached_property
    def _backward(self) -> tuple[Tensor, Moments]:
        """The distribution of z_t given z_{t+1} and the weights up to t, for t = T - 1 to 1.

        It consists of the gain, which multiplies z_{t+1}, and the moments of z_t at z_{t+1} = 0.
        """
        gain = self._gain
        remainder = torch.eye(gain.shape[-1], dtype=gain.dtype, device=gain.device) - gain @ self.transition
        # Joseph's form is a sum of squares, so rounding cannot make it negative, unlike the difference
        spread = remainder @ self.filtered.covariance[:-1] @ remainder.mT + gain @ self.noise @ gain.mT
        mean = self.filtered.mean[:-1] - _times(gain, self.predicted.mean[1:])
        return gain.flip(0), Moments(mean.flip(0), symmetric(spread).flip(0))

    @cached_property
    def smoothed(self) -> Moments:
        """Moments of each z_t given all weights."""
        gain, (mean, covariance) = self._backward
        means = States.apply(gain, mean, self.filtered.mean[-1])
        covariances = Covariances.apply(gain, covariance, self.filtered.covariance[-1])
        return Moments(means.flip(0), covariances.flip(0))

    @property
    def lag_one(self) -> Tensor:
        """Covariances Cov(z_{t+1}, z_t) given all weights, (T - 1, B, N, N), for t = 1 to T - 1."""
        return self.smoothed.covariance[1:] @ self._gain.mT

    def draw(self, noise: Tensor) -> Tensor:
        """Return reparameterised draws (T, B, N) of z_{1:T} given all weights.

        Args:
            noise: standard normal noise (T, B, N).
        """
        gain, (mean, covariance) = self._backward
        roots = torch.linalg.cholesky(torch.cat([self.filtered.covariance[-1:], covariance]))
        values = torch.cat([self.filtered.mean[-1:], mean]) + _times(roots, noise.flip(0).double())
        return States.apply(gain, values[1:], values[0]).flip(0)


def update(mean: Tensor, covariance: Tensor, information: Tensor, potential: Tensor) -> Moments:
    """Return the moments of the normal distribution proportional to N(z; mean, covariance) exp(g' z - z' G z / 2).

    Args:
        mean: (..., N).
        covariance: (..., N, N).
        information: G, (..., N, N), symmetric.
        potential: g, (..., N).
    """
    identity = torch.eye(mean.shape[-1], dtype=mean.dtype, device=mean.device)
    shift = _column(covariance, potential - _times(information, mean))
    # more exact than updated covariance times difference if the difference is large
    right = torch.cat([covariance, shift], dim=-1)
    solved = torch.linalg.solve_ex(identity + covariance @ information, right)[0]
    return Moments(mean + solved[..., -1], symmetric(solved[..., :-1]))


class Predict(torch.autograd.Function):
    """Autograd function from the arguments of `LinearGaussianChain` to the predicted m (T, B, N) and P (T, B, N, N).

    The noise has the shape (T - 1, B, N, N).
    """

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
        """Return the predicted means m and covariances P, computed by a filter."""
        covariances, shrink, carry = riccati(transition, noise, information[:-1], covariance)
        covariances = symmetric(covariances)
        filtered = shrink @ covariances[:-1]
        offsets = (transition @ _column(filtered, potential[:-1])).add_(offset[..., None])
        recursion = Recursion(carry)
        means = recursion.states(offsets, mean[..., None])[..., 0]
        updated = update(means[:-1], covariances[:-1], information[:-1], potential[:-1]).mean
        errors = _times(transition, updated) + offset - means[1:]
        means = means + recursion.states(errors[..., None], torch.zeros_like(mean)[..., None])[..., 0]
        ctx.save_for_backward(transition, information, potential, means, filtered, shrink, carry)
        return means, covariances

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_mean: Tensor, to_covariance: Tensor) -> tuple[Tensor, ...]:
        """Return the gradients of all arguments, given the gradients of the means and covariances.

        The matrix that is returned for G is not symmetric. Since G is symmetric, only its symmetric part matters.
        """
        transition, information, potential, means, filtered, shrink, carry = ctx.saved_tensors
        back = backward(carry)
        total = back.states(*from_last(to_mean[..., None])).flip(0)
        later = total[1:]
        residual = potential[:-1, ..., None] - information[:-1] @ means[:-1, ..., None]
        totals = to_covariance.clone()
        totals[:-1] += (carry.mT @ later) @ (shrink.mT @ residual).mT
        totals = back.covariances(*from_last(symmetric(totals))).flip(0)
        laters = totals[1:]
        to_filtered = transition.mT @ later  # gradient of the filtered mean
        to_shift = filtered @ to_filtered
        spread = transition.mT @ laters @ transition + to_filtered @ residual.mT
        filtered_mean = means[:-1, ..., None] + filtered @ residual
        to_information, to_potential = torch.zeros_like(information), torch.zeros_like(potential)
        to_potential[:-1] = to_shift[..., 0]
        to_information[:-1] = -(filtered @ spread @ filtered) - to_shift @ means[:-1, ..., None].mT
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
