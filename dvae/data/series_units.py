"""View of each sequence relative to its own level and scale, which are estimated from its earlier values.

    u_t = f(x_t) - f(x_{t-L})          L = 0: u_t = f(x_t); f: the identity, or the logarithm of positive data
    y_t = (u_t - m_t) / s_t            the model's x

m_t and s_t are the location and scale of the one-step prediction of u_t under a normal distribution with unknown mean
and variance, given u_1, ..., u_{t-1} (Gelman et al., Bayesian Data Analysis, 2013, section 3.3):

    m_t = (k m + sum u) / (k + n)      s_t^2 = v_t (1 + 1 / (k + n))
    v_t = (d v + S + k n / (k + n) (mean u - m)^2) / (d + n)

n is the number of earlier values and S the sum of their squares about their mean. The prior (m, k, v, d) is estimated
from training sequences. After `observed` steps, m_t and s_t no longer change, as in RevIN (Kim et al., 2022), so a
forecast has one level and one scale.

The map is triangular with diagonal f'(x_t) / s_t, so densities and bounds of a model with this view are densities of
the data. L = 1 makes the mean of a forecast the last value plus what the model adds, and L = a season the seasonal
naive forecast plus what the model adds.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import brentq
from scipy.special import digamma, polygamma
from torch import Tensor
from typing_extensions import override

from ..factorization.notation import Factorization
from .batch import WHOLE, Batch
from .views import View

WINDOWS = 4096
"""Maximum number of windows from which a prior is estimated."""
LOCATION, SCALE, STATE = "x_location", "x_scale", "x_state"
"""Names of the entries that the view adds: location and scale of each step, and the state after the last step."""


class SeriesPrior(NamedTuple):
    """Prior of the level and scale of one coordinate's u_t; the module docstring defines the symbols.

    Args:
        mean: m.
        weight: k, in steps: the variance within sequences divided by the variance of their means.
        variance: v.
        freedom: d, in steps.
        level, spread: mean and standard deviation of f(x), which standardise a value without an earlier one if L > 0.
        logarithm: whether f is the logarithm.
    """

    mean: float = 0.0
    weight: float = 1.0
    variance: float = 1.0
    freedom: float = 1.0
    level: float = 0.0
    spread: float = 1.0
    logarithm: bool = False

    @classmethod
    def estimate(
        cls, sequences: Iterable[np.ndarray], lag: int = 0, steps: int | None = None, logarithm: bool = False
    ) -> SeriesPrior:
        """Estimate the prior from training sequences, by moments (Smyth, 2004, section 6, for d and v).

        Args:
            sequences: values (T,) of each sequence, NaN where missing.
            lag: L.
            steps: length of the windows for which models have one level and scale; None for whole sequences.
            logarithm: whether f is the logarithm.
        """
        values = [np.log(x) if logarithm else np.asarray(x, np.float64) for x in sequences]
        level, spread = np.nanmean(np.concatenate(values)), np.nanstd(np.concatenate(values))
        differences = [x[lag:] - x[: len(x) - lag] if lag else x for x in values]
        windows = [u[n : n + (steps or len(u))] for u in differences for n in range(0, len(u), steps or max(len(u), 1))]
        windows = windows[:: -(-len(windows) // WINDOWS) or 1]
        windows = [u[~np.isnan(u)] for u in windows]
        several = [u for u in windows if len(u) > 2] or [np.concatenate([*windows, np.zeros(3)])]
        means, variances = np.array([u.mean() for u in several]), np.array([u.var(ddof=1) for u in several])
        degrees = np.array([len(u) - 1.0 for u in several])
        within = max(float((degrees * variances).sum() / degrees.sum()), 1e-12 * float(spread) ** 2, 1e-36)
        between = float(means.var() - (within / (degrees + 1)).mean())
        freedom, variance = _inverse_chi_square(variances, degrees, within)
        return cls(
            mean=float(means.mean()),
            weight=float(np.clip(within / max(between, 1e-9 * within), 1e-6, 100.0)),
            variance=variance,
            freedom=freedom,
            level=float(level),
            spread=float(spread) or 1.0,
            logarithm=logarithm,
        )


def _inverse_chi_square(variances: np.ndarray, degrees: np.ndarray, within: float) -> tuple[float, float]:
    """Return d and v of the scaled inverse chi-square prior of variances, each estimated with its degrees of freedom.

    The logarithm of an estimated variance has the variance psi'(degrees / 2) + psi'(d / 2) and a known mean.
    """
    positive = variances > 1e-9 * within  # windows without variation have no logarithm
    if positive.sum() < 2:
        return 1.0, within
    half = degrees[positive] / 2
    logarithms = np.log(variances[positive]) - digamma(half) + np.log(half)
    excess = float(logarithms.var(ddof=1) - polygamma(1, half).mean())
    least, most = 2.0, 100.0
    bounds = polygamma(1, [least / 2, most / 2])
    freedom = least if excess >= bounds[0] else most
    if bounds[1] < excess < bounds[0]:
        freedom = float(brentq(lambda d: float(polygamma(1, d / 2)) - excess, least, most))
    return freedom, float(np.exp(logarithms.mean() + digamma(freedom / 2) - np.log(freedom / 2)))


@dataclass(frozen=True)
class SeriesUnits(View):
    """Values of each sequence relative to its own level and scale; the module docstring gives the equations.

    A forecast from fewer than `observed` steps keeps the level and scale of its last step. The state that continues a
    sequence has 3 + 2 L rows: count, sum and sum of squares of u - m; then, for each of the next L steps, whether an
    earlier value was observed; then this value.

    Args:
        priors: prior of each coordinate of x; None for a coordinate that the view does not change.
        lag: L, in steps.
        observed: number of steps after which level and scale no longer change; None for never.
    """

    priors: tuple[SeriesPrior | None, ...]
    lag: int = 0
    observed: int | None = None
    names = (LOCATION, SCALE, STATE)
    exact = names
    by_coordinate = True

    def __post_init__(self) -> None:
        if self.observed is not None and self.lag > self.observed:
            raise ValueError(f"lag is {self.lag} and observed {self.observed}; lag must be at most observed")

    @override
    def check(self, sizes: Mapping[str, int], context: Collection[str], generative: Factorization) -> None:
        if sizes.get(WHOLE) != len(self.priors):
            raise ValueError(f"the view has priors of {len(self.priors)} coordinates, but x has {sizes.get(WHOLE)}")

    @override
    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        if WHOLE not in data or LOCATION in data:
            return data
        if view_inputs is not None:
            location, scale = self._frozen(self._transform(data), view_inputs[STATE])
            return data | {WHOLE: (self._transform(data) - location) / scale}
        location, scale, state = self._units(data)
        y = (self._transform(data) - location) / scale
        return data | {WHOLE: y, LOCATION: location, SCALE: scale, STATE: state}

    @override
    def inverse(self, model_values: Batch) -> Batch:
        y = model_values[WHOLE]
        if STATE not in model_values:
            return model_values | {WHOLE: self._original(self._generate(y))}
        state = model_values[STATE]
        known = model_values[LOCATION].shape[1] if LOCATION in model_values else 0
        z = y[..., :known, :]
        if known:
            z = model_values[LOCATION][:, : y.shape[-2]] + model_values[SCALE][:, : y.shape[-2]] * z
        if y.shape[-2] > known:
            z = torch.cat([z, self._continue(y[..., known:, :], state)], -2)
        others = {name: value for name, value in model_values.items() if name not in self.names}
        return Batch(others) | {WHOLE: self._original(z)}

    @override
    def following(self, data: Batch) -> Batch:
        return Batch({name: value for name, value in data.items() if name not in (LOCATION, SCALE)})

    @override
    def log_det(self, data: Batch) -> Tensor:
        _, scale, _ = self._units(data)
        use_log = self._constants(scale)["logarithm"] > 0
        return -scale.log() - torch.where(use_log, self._transform(data), 0.0)

    def _constants(self, like: Tensor) -> dict[str, Tensor]:
        """Return the fields of the priors, (D,) each, and whether each coordinate changes."""
        rows = [prior or SeriesPrior() for prior in self.priors]
        table = torch.tensor([[float(each) for each in row] for row in rows], dtype=torch.float64, device=like.device)
        changed = torch.tensor([prior is not None for prior in self.priors], device=like.device)
        return {**dict(zip(SeriesPrior._fields, table.T, strict=True)), "changed": changed}

    def _transform(self, data: Batch) -> Tensor:
        """Return f(x) (B, T, D) in float64, 0 at missing entries."""
        x, mask = data[WHOLE].double(), data.mask()
        use_log = self._constants(x)["logarithm"] > 0
        present = torch.ones_like(x, dtype=torch.bool) if mask is None else mask
        return torch.where(present, torch.where(use_log, torch.where(present & use_log, x, 1.0).log(), x), 0.0)

    def _original(self, z: Tensor) -> Tensor:
        """Invert f."""
        use_log = self._constants(z)["logarithm"] > 0
        return torch.where(use_log, torch.where(use_log, z, 0.0).exp(), z)

    def _units(self, data: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Return location and scale (B, T, D) of each step, and the state (B, R, D) after the last step."""
        z, mask, lag = self._transform(data), data.mask(), self.lag
        steps, constants = z.shape[1], self._constants(z)
        present = torch.ones_like(z, dtype=torch.bool) if mask is None else mask
        base, has, last = torch.zeros_like(z), torch.ones_like(present), z[:, :0]
        if lag:
            base, has, last = self._bases(z, present, constants["level"])
        counted = present & has
        deviation = torch.where(counted, z - base - constants["mean"], 0.0)
        sums = torch.stack([counted.double(), deviation, deviation.square()], 1).cumsum(2)
        sums = torch.cat([torch.zeros_like(sums[:, :, :1]), sums], 2)  # entry t: the sums over the first t steps
        sums = sums[:, :, : None if self.observed is None else self.observed + 1]
        place = torch.arange(steps, device=z.device).clamp(max=sums.shape[2] - 1)
        location, scale = self._predict(sums[:, :, place].unbind(1), base, has, constants)
        return location, scale, torch.cat([sums[:, :, -1], last], 1)

    def _bases(self, z: Tensor, present: Tensor, level: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return x_{t-L} (B, T, D), or if it is missing the latest value a multiple of L steps earlier, else the level.

        Also returns where there is such a value, and the rows of the state: for the next L steps, first where there is
        an earlier value and then the value.
        """
        lag, steps = self.lag, z.shape[1]
        more = -steps % lag  # steps that complete the last period

        def by_period(values: Tensor) -> Tensor:
            return torch.cat([values, values[:, :1].expand(-1, more, -1)], 1).unflatten(1, (-1, lag))

        present = torch.cat([present, torch.zeros_like(present[:, :1]).expand(-1, more, -1)], 1).unflatten(1, (-1, lag))
        periods = torch.arange(present.shape[1], device=z.device)[:, None, None]
        latest = torch.where(present, periods, -1).cummax(1).values  # period of the latest value at each phase
        latest = torch.cat([torch.full_like(latest[:, :1], -1), latest], 1)
        values = torch.where(latest >= 0, by_period(z).gather(1, latest.clamp(min=0)), level)
        has, base = ((each[:, :-1].flatten(1, 2)[:, :steps]) for each in (latest >= 0, values))
        following = [each[:, -1].roll(more, 1) for each in (latest >= 0, values)]
        return base, has, torch.cat([following[0].double(), following[1]], 1)

    def _predict(
        self, sums: Sequence[Tensor], base: Tensor, has: Tensor, constants: Mapping[str, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return location and scale of f(x_t) from the count, the sum and the sum of squares of u - m.

        Args:
            sums: sums over earlier steps (..., D).
            base: f(x_{t-L}) (..., D).
            has: whether there is such a value.
            constants: result of `_constants`.
        """
        count, total, squares = sums
        weight = constants["weight"] + count
        variance = constants["freedom"] * constants["variance"] + squares - total.square() / weight
        variance = (variance / (constants["freedom"] + count)).clamp(min=1e-36)
        location = torch.where(has, base + constants["mean"] + total / weight, constants["level"])
        scale = torch.where(has, (variance * (1 + 1 / weight)).sqrt(), constants["spread"])
        changed = constants["changed"]
        return torch.where(changed, location, 0.0), torch.where(changed, scale, 1.0)

    def _following(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return base, location and scale (..., B, L, D) of the L steps after a state; one step if L is 0."""
        lag = self.lag
        if lag:
            has, base = state[..., 3 : 3 + lag, :] > 0, state[..., 3 + lag :, :]
        else:
            base = torch.zeros_like(state[..., :1, :])
            has = torch.ones_like(base, dtype=torch.bool)
        sums = [each[..., None, :] for each in state[..., :3, :].unbind(-2)]
        return base, *self._predict(sums, base, has, self._constants(state))

    def _frozen(self, z: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return location and scale of known values z (B, H, D) after a state, which does not change."""
        _, first, scale = self._following(state)
        if not self.lag:
            return first.expand_as(z), scale.expand_as(z)
        lag, horizon, constants = self.lag, z.shape[1], self._constants(z)
        sums = [each[:, None] for each in state[:, :3].unbind(1)]
        has = torch.ones_like(z, dtype=torch.bool)
        later = self._predict(sums, torch.cat([z[:, :lag], z], 1)[:, :horizon], has, constants)
        location, scale = (
            torch.cat([start, rest[:, lag:]], 1)[:, :horizon]
            for start, rest in zip((first, scale), (later[0], later[1].expand_as(z)), strict=True)
        )
        return location, scale

    def _continue(self, y: Tensor, state: Tensor) -> Tensor:
        """Return f(x) (..., B, H, D) after a state (B, R, D); later steps read the earlier ones."""
        _, location, scale = self._following(state)
        if not self.lag:
            return location + scale * y
        lag, horizon, constants = self.lag, y.shape[-2], self._constants(y)
        more = -horizon % lag
        y = torch.cat([y, torch.zeros_like(y[..., :1, :]).expand(*y.shape[:-2], more, -1)], -2).double()
        y = y.unflatten(-2, (-1, lag))
        first = location + scale * y[..., 0, :, :]
        sums = [each[:, None] for each in state[:, :3].unbind(1)]
        has = torch.ones_like(first, dtype=torch.bool)
        mean, scale = self._predict(sums, torch.zeros_like(first), has, constants)
        z = torch.cat([first[..., None, :, :], mean[..., None, :, :] + scale[..., None, :, :] * y[..., 1:, :, :]], -3)
        z = torch.where(constants["changed"], z.cumsum(-3), z)
        return z.flatten(-3, -2)[..., :horizon, :]

    def _generate(self, y: Tensor) -> Tensor:
        """Return f(x) (..., T, D) of sequences from their first step on."""
        lag, constants, values = self.lag, self._constants(y), []
        state = y.new_zeros(*y.shape[:-2], 3 + 2 * lag, y.shape[-1], dtype=torch.float64)
        state[..., 3 + lag :, :] = constants["level"]
        for t, each in enumerate(y.double().unbind(-2)):
            base, location, scale = (part[..., 0, :] for part in self._following(state))
            values.append(location + scale * each)
            deviation = values[-1] - base - constants["mean"]
            state = state.clone()
            if t >= lag and (self.observed is None or t < self.observed):
                state[..., :3, :] += torch.stack([torch.ones_like(deviation), deviation, deviation.square()], -2)
            if lag:
                value, one = values[-1][..., None, :], torch.ones_like(deviation)[..., None, :]
                rows = [state[..., :3, :], state[..., 4 : 3 + lag, :], one, state[..., 4 + lag :, :], value]
                state = torch.cat(rows, -2)
        return torch.stack(values, -2)
