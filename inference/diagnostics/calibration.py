"""Simulation-based calibration of a guide (Talts et al., 2018, arXiv 1804.06788).

The simultaneous test and envelope for discrete ranks are exact (Säilynoja et al., 2022, arXiv 2103.10522). Two
quantities of all latents together depend on the data: the log joint (Modrák et al., 2023, arXiv 2211.02383) and the
distance from a point (TARP: Lemos et al., 2023, arXiv 2302.03026).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Annotated, Any, Self

import numpy as np
import scipy
import torch
from pyro import poutine
from torch import Tensor
from typing_extensions import override

from ...program.batch import repeat
from ...program.model import DynamicalVAE
from ..bounds.elbo import require_likelihood
from ..evaluation.evaluation_windows import on_device_of, seeded_evaluation
from ..evaluation.record import Dims
from ..evaluation.result import Result, Table, new_figure, progress_bar, styled
from .latents import quantities

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOG_JOINT, TARP = "log joint", "TARP"

_MOST = 2**24  # largest product of simulations and draws, or quantities, read from a file


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Result):
    """Ranks of simulated latents among the guide's draws; uniform on 0..L if the guide is the exact posterior.

    Uniform ranks of single coordinates are necessary, not sufficient: a guide that ignores the data and draws from the
    prior has them. The rank of the log joint, log p(x, latents), detects such a guide, and one that misses dependence
    between coordinates. The rank of the latents' distance from a point that depends on the data (TARP) does so too.
    This point is the latents of the simulation with the nearest data, among L additional simulations.

    Attributes:
        ranks: number of the L draws below the truth, (N, Q).
        names: names of the Q quantities: "w[0]", "z_3[1]" (step from 1, coordinate from 0), "TARP", "log joint".
        draws: L, number of draws.
        length: T of the simulated sequences.
        seed: seed of simulations and draws.
        equations: equations of model and guide; without the guide's if it is a custom program.
    """

    ranks: Annotated[np.ndarray, Dims("simulation", "quantity", kind=int)]
    names: tuple[str, ...]
    draws: int
    length: int
    seed: int
    equations: dict[str, str]

    @cached_property
    def counts(self) -> np.ndarray:
        """Number of occurrences of each rank, (Q, L + 1)."""
        return np.stack([np.bincount(ranks, minlength=self.draws + 1) for ranks in self.ranks.T])

    @cached_property
    def p_values(self) -> np.ndarray:
        """Exact p-values of uniformity, (Q,); at most alpha if and only if the ECDF leaves its envelope at alpha."""
        tails = _tails(len(self.ranks), self.draws)
        below = self.counts.cumsum(1)[:, :-1]
        least, inverse = np.unique(tails[np.arange(self.draws), below].min(1), return_inverse=True)
        return _ecdf_test(least, len(self.ranks), self.draws)[inverse]

    @property
    def adjusted(self) -> np.ndarray:
        """P-values times the number of quantities (Bonferroni), at most 1, (Q,)."""
        return np.minimum(1.0, self.p_values * len(self.names))

    @property
    def p_value(self) -> float:
        """P-value of uniformity of all quantities together, valid under any dependence."""
        return float(self.adjusted.min())

    @property
    def bias(self) -> np.ndarray:
        """Mean of the truth minus the guide's mean, in standard deviations of the guide, (Q,).

        It is estimated by maximum likelihood from the ranks, like `spread`.
        """
        return self._normals[:, 0]

    @property
    def spread(self) -> np.ndarray:
        """Standard deviation of the truth about the guide's mean, divided by the guide's, (Q,).

        Above 1, the guide is too narrow. Bias and spread are maximum likelihood estimates: the mean and standard
        deviation of a normal truth, given its ranks among L standard normal draws. They are accurate if guide and
        posterior are normal. If ranks accumulate at 0 or L, the likelihood has no finite maximum; a prior with less
        weight than one simulation keeps the estimates finite.
        """
        return np.exp(self._normals[:, 1])

    @property
    def readings(self) -> tuple[str, ...]:
        """Interpretation of the shape of the ranks; "" if uniformity is not rejected at 5 % (adjusted)."""
        return tuple(
            _reading(self.names[q], self.counts[q], self.draws) if adjusted <= 0.05 else ""
            for q, adjusted in enumerate(self.adjusted)
        )

    @property
    def verdict(self) -> str:
        """Result of the test in one sentence."""
        rejected = int((self.adjusted <= 0.05).sum())
        number = f"{len(self.names)} quantities, {len(self.ranks)} simulations, p = {self.p_value:.2g}"
        if not rejected:
            return f"no evidence against the guide ({number})"
        return f"the guide is not the posterior: {rejected} of {number}"

    def envelope(self, alpha: float = 0.05) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the simultaneous envelope of the ECDF of a quantity's ranks, with probability at least 1 - alpha.

        Returns:
            Points k / (L + 1), and the smallest and largest share of ranks below k inside the envelope, (L,) each.
        """
        return envelope(len(self.ranks), self.draws, alpha)

    def table(self, worst: int = 20) -> Table:
        """Return a table of the quantities, those with the smallest p-values first."""
        order = np.argsort(self.p_values, kind="stable")[:worst]
        table = Table(title=self._title, caption=self.verdict)
        for column in ("quantity", "p", "p (Bonferroni)", "bias", "spread", "the guide"):
            table.add_column(column, justify="left" if column in ("quantity", "the guide") else "right", no_wrap=True)
        for q in order:
            numbers = f"{self.p_values[q]:.2g}", f"{self.adjusted[q]:.2g}", f"{self.bias[q]:+.3f}"
            table.add_row(self.names[q], *numbers, f"{self.spread[q]:.2f}", self.readings[q])
        if len(self.names) > worst:
            table.add_row(f"and {len(self.names) - worst} more", style="dim")
        return table

    @styled
    def plot(self, worst: int = 8) -> Figure:
        """Draw rank histograms above ECDF differences, for the quantities with the smallest p-values.

        Histograms are relative to uniform, with a band that contains a bin in 99 % of cases. ECDF differences have a
        simultaneous envelope for all quantities and points, with 95 % probability (Bonferroni over quantities).
        """
        order = np.argsort(self.p_values, kind="stable")[:worst]
        columns = min(3, len(order))
        rows = math.ceil(len(order) / columns)
        figure = new_figure(0.8 + 2.4 * columns, 0.6 + 3.1 * rows)
        panels = figure.subplots(2 * rows, columns, squeeze=False, sharex=True, sharey="row")
        points, low, high = self.envelope(0.05 / len(self.names))
        levels, count = self.draws + 1, len(self.ranks)
        edges = np.linspace(0, levels, min(20, levels) + 1).round().astype(int)
        width = np.diff(edges) / levels
        band = [scipy.stats.binom.ppf(level, count, width) / (count * width) for level in (0.005, 0.995)]
        for place, q in enumerate(order):
            row, column = divmod(place, columns)
            top, bottom = panels[2 * row, column], panels[2 * row + 1, column]
            share = np.add.reduceat(self.counts[q], edges[:-1]) / (count * width)
            top.stairs(band[1], edges / levels, baseline=band[0], fill=True, color="0.88")
            top.stairs(share, edges / levels, color="C0")
            top.axhline(1, color="0.4", linewidth=0.8)
            reading = f"\n{self.readings[q]}" if self.readings[q] else ""
            top.set_title(f"{self.names[q]}, p = {self.adjusted[q]:.2g}{reading}", parse_math=False)
            bottom.fill_between(points, low - points, high - points, color="0.88", step="mid", linewidth=0)
            below = self.counts[q].cumsum()[:-1] / count
            bottom.plot(points, below - points, color="C0")
            bottom.axhline(0, color="0.4", linewidth=0.8)
            bottom.tick_params(labelbottom=True)
            if column == 0:
                top.set_ylabel("ranks\n/ uniform")
                bottom.set_ylabel("ECDF\n− uniform")
        for place in range(len(order), rows * columns):
            row, column = divmod(place, columns)
            panels[2 * row, column].set_axis_off()
            panels[2 * row + 1, column].set_axis_off()
        selection = "" if len(order) == len(self.names) else f" · worst {len(order)} of {len(self.names)}"
        figure.suptitle(f"{self._title}{selection}", parse_math=False)
        figure.supxlabel(f"rank among {self.draws} draws, scaled to [0, 1]")
        return figure

    @override
    def summary(self) -> dict[str, Any]:
        columns = {"p": self.p_values, "p_adjusted": self.adjusted, "bias": self.bias, "spread": self.spread}
        columns["reading"] = np.array(self.readings)
        quantities = {name: {key: each[q] for key, each in columns.items()} for q, name in enumerate(self.names)}
        return {"p_value": self.p_value, "verdict": self.verdict, "quantities": quantities}

    @override
    def labels(self) -> dict[str, Sequence[str]]:
        return {"quantity": self.names}

    @override
    def check(self) -> None:
        count, quantities = self.ranks.shape
        if len(self.names) != quantities or not count or not 1 <= self.draws <= _MOST / max(count, quantities):
            raise ValueError(
                f"expected ranks of {len(self.names)} quantities, at least one simulation and 1 to "
                f"{_MOST // max(count, quantities, 1)} draws; got {quantities} quantities, {count} simulations and "
                f"{self.draws} draws"
            )
        if (self.ranks < 0).any() or (self.ranks > self.draws).any():
            raise ValueError(f"ranks must be between 0 and {self.draws}")

    @property
    def _title(self) -> str:
        return f"simulation-based calibration · {self.equations.get('inference', 'custom guide')}"

    @cached_property
    def _normals(self) -> np.ndarray:
        """Bias and logarithm of spread, (Q, 2)."""
        return np.stack([_likeliest_normal(counts, self.draws)[0] for counts in self.counts])


def calibrate(
    model: DynamicalVAE,
    length: int,
    simulations: int = 500,
    draws: int = 99,
    *,
    guide: Callable[..., Any] | None = None,
    steps: Sequence[int] | None = None,
    context: Mapping[str, Tensor] | None = None,
    seed: int = 0,
    chunk: int = 4096,
    progress: bool = True,
) -> Calibration:
    """Calibrate a guide by simulation: draw latents and data from the model, and infer the latents with the guide.

    The result shows whether the guide is the model's posterior on the model's own data. It does not depend on real
    data, nor on whether the model is good.

    Args:
        model: generative model; its own guide is tested by default.
        length: T of the simulated sequences.
        simulations: N, number of simulations.
        draws: L, number of draws from the guide for each simulation.
        guide: Pyro program of the batch, with a site (B, T, D) or (B, D) for every latent.
        steps: steps of local latents to rank, from 1; all by default.
        context: context variables (C, T, D) or (C, D) by name; simulations use the C values in turn.
        seed: seed of simulations and draws.
        chunk: largest number of sequences times draws in memory.
        progress: whether to show a progress bar.

    Returns:
        Ranks (N, Q) of the simulated latents among the L draws of the guide, from 0 to L.

    Raises:
        ValueError: when a number is below 1, steps are beyond the length, context is missing, or the guide has no site
            for a latent.
        FloatingPointError: when a simulation is not finite.

    Example:
        >>> pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})"
        >>> model = dvae.linear_gaussian_surrogate(*pair, {"z": 1, "x": 2}, 4)
        >>> result = dvae.calibrate(model, 4, simulations=20, draws=19, steps=(2, 4), progress=False)
    """
    if min(length, simulations, draws, chunk) < 1:
        raise ValueError(
            f"length, simulations, draws and chunk must be at least 1, got {length}, {simulations}, {draws} and {chunk}"
        )
    require_likelihood(model)
    if not model.latents:
        raise ValueError(
            f"{model.generative} has no latents: its likelihood is exact, and it has no guide to calibrate"
        )
    ranked_steps = list(range(1, length + 1)) if steps is None else list(steps)
    if (
        not ranked_steps
        or len(set(ranked_steps)) < len(ranked_steps)
        or not set(ranked_steps) <= set(range(1, length + 1))
    ):
        raise ValueError(f"steps must be different numbers from 1 to {length}, got {ranked_steps}")
    contexts: Mapping[str, Tensor] = context or {}
    if missing := [name for name in model.context if name not in contexts]:
        raise ValueError(f"the model reads the context {', '.join(missing)}; pass context={{name: values}}")
    infer = guide or model.guide
    at_once = max(1, chunk // draws)
    ranks, places = [], torch.tensor(ranked_steps) - 1

    def context_rows(indices: Tensor) -> dict[str, Any]:
        return on_device_of(model, {name: value[indices % len(value)] for name, value in contexts.items()})

    with seeded_evaluation(model, seed + 1):  # independent of the ranked simulations
        points = _Points.of(model, context_rows(torch.arange(draws)), draws, length, places)
    with seeded_evaluation(model, seed), progress_bar(progress) as bar:
        for start in bar.track(range(0, simulations, at_once), description="simulations"):
            indices = torch.arange(start, min(start + at_once, simulations))
            ranks.append(_ranks(model, infer, context_rows(indices), len(indices), length, draws, places, points))
    names = quantities(model, ranked_steps)
    equations = {"generative": model.generative.text} | ({} if guide else {"inference": model.inference.text})
    return Calibration(torch.cat(ranks).numpy(), (*names, TARP, LOG_JOINT), draws, length, seed, equations)


def envelope(count: int, draws: int, alpha: float = 0.05) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the simultaneous envelope of the ECDF of independent uniform ranks, with probability at least 1 - alpha.

    Args:
        count: N, number of ranks.
        draws: L; ranks are on 0..L.
        alpha: probability between 0 and 1.

    Returns:
        Points k / (L + 1), and the smallest and largest share of ranks below k inside the envelope, (L,) each.

    Raises:
        ValueError: when alpha is not between 0 and 1.
    """
    if not 0 < alpha < 1:
        raise ValueError(f"alpha must be a probability between 0 and 1, got {alpha}")
    within = _tails(count, draws) > _critical(alpha, count, draws)
    points = np.arange(1, draws + 1) / (draws + 1)
    return points, within.argmax(1) / count, 1 - within[:, ::-1].argmax(1) / count


@dataclass(frozen=True)
class _Points:
    """Simulations for TARP. The point for some data is the latents of the simulation with the nearest data.

    Args:
        data: data (M, F).
        latents: latents (M, Q).
    """

    data: Tensor
    latents: Tensor

    @classmethod
    def of(cls, model: DynamicalVAE, context: Mapping[str, Tensor], count: int, length: int, steps: Tensor) -> Self:
        """Return points from new simulations.

        Args:
            model: model to simulate.
            context: context variables (C, T, D) or (C, D) by name, empty if none.
            count: M, number of simulations.
            length: T of the simulated sequences.
            steps: indices of the ranked steps of local latents.
        """
        simulated = _simulate(model, context, count, length)
        return cls(_data(model, simulated), _coordinates(model, simulated, steps))

    def distances(self, model: DynamicalVAE, batch: Mapping[str, Any], latents: Tensor) -> Tensor:
        """Return distances (B,) of latents (B, Q) from their points, in standard deviations of the simulations."""
        nearest = torch.cdist(_data(model, batch) / _scale(self.data), self.data / _scale(self.data)).argmin(1)
        return ((latents - self.latents[nearest]) / _scale(self.latents)).norm(dim=1)


def _scale(values: Tensor) -> Tensor:
    """Return the standard deviation of each column of values (N, Q); 1 for a constant column."""
    scale = values.std(0, correction=0)
    return torch.where(scale > 0, scale, 1.0)


def _data(model: DynamicalVAE, batch: Mapping[str, Any]) -> Tensor:
    """Return all data variables of a batch as flat vectors (B, F)."""
    return torch.cat([batch[name].flatten(1) for name in model.observed], 1)


def _coordinates(model: DynamicalVAE, latents: Mapping[str, Tensor], steps: Tensor) -> Tensor:
    """Return all latents, local ones at these steps only, as flat vectors (B, Q)."""
    local = model.generative.local
    return torch.cat(
        [(latents[name][:, steps] if local(name) else latents[name]).flatten(1) for name in model.latents], 1
    )


def _simulate(model: DynamicalVAE, context: Mapping[str, Tensor], count: int, length: int) -> Mapping[str, Tensor]:
    """Return latents and data of `count` simulated sequences."""
    truth = model.sample(count, length, context or None)
    if invalid := [name for name in (*model.latents, *model.observed) if not truth[name].isfinite().all()]:
        raise FloatingPointError(
            f"simulations of {length} steps have values of {', '.join(invalid)} that are not finite; simulate fewer "
            "steps, or check whether the model has been fitted"
        )
    return truth


def _ranks(
    model: DynamicalVAE,
    infer: Callable[..., Any],
    context: Mapping[str, Tensor],
    count: int,
    length: int,
    draws: int,
    steps: Tensor,
    points: _Points,
) -> Tensor:
    """Return ranks (B, Q) of the latents of B simulations among the guide's draws of them."""

    def quantities(batch: Mapping[str, Any], latents: Mapping[str, Tensor]) -> Tensor:
        """Return all quantities, (B, Q)."""
        ranked = _coordinates(model, latents, steps)
        joint = torch.stack(list(model.log_joint(batch, latents).values())).sum(0)
        return torch.cat([ranked, points.distances(model, batch, ranked)[:, None], joint[:, None]], 1)

    truth = _simulate(model, context, count, length)
    batch = {**context, **{name: truth[name] for name in model.observed}}
    repeated = repeat(batch, draws)
    sites = poutine.trace(infer).get_trace(repeated).nodes
    if missing := [name for name in model.latents if name not in sites]:
        raise ValueError(f"the guide has no site for {', '.join(missing)}; it needs one for each latent")
    draws_of_guide: dict[str, Any] = {name: sites[name]["value"] for name in model.latents}
    drawn_values = quantities(repeated, draws_of_guide)
    true_values = quantities(batch, {name: truth[name] for name in model.latents})
    return (drawn_values.unflatten(0, (draws, count)) < true_values).sum(0).cpu()


@lru_cache(maxsize=8)
def _tails(count: int, draws: int) -> np.ndarray:
    """Return the smaller tail (L, N + 1) of k in a Binomial(N, i / (L + 1)), the number of ranks below i."""
    points = np.arange(1, draws + 1)[:, None] / (draws + 1)
    number = np.arange(count + 1.0)
    at_least = np.where(number > 0, scipy.special.bdtrc(np.maximum(number - 1, 0), count, points), 1.0)
    return np.minimum(scipy.special.bdtr(number, count, points), at_least)


def _ecdf_test(least: np.ndarray, count: int, draws: int) -> np.ndarray:
    """Return P(the smallest tail of a uniform sample's ECDF over all points is at most `least`), elementwise; exact.

    The numbers of uniform ranks below 1, 2, ... are a Poisson process conditioned to end at N. The probability of
    staying within bounds is therefore a chain of convolutions (Säilynoja et al. use binomial steps). `arviz_stats`
    simulates the same probability, but drops the upper tail of every simulation with no rank below some point.
    """
    step, size = _poisson(count, count / (draws + 1)), scipy.fft.next_fast_len(2 * count + 1, real=True)
    transform = scipy.fft.rfft(step, size)
    bound = least[:, None] * (1 + 1e-9)  # tails that differ only by rounding are equal
    within = np.zeros((len(least), count + 1))
    within[:, 0] = 1
    for tails in _tails(count, draws):
        convolved = scipy.fft.irfft(scipy.fft.rfft(within, size) * transform, size)[:, : count + 1]
        within = np.where(tails > bound, convolved, 0.0)
    inside = within @ step[::-1] / _poisson(count, count)[-1]
    # Where rounding hides the difference from 1, the sum over points bounds the probability from above.
    return np.clip(np.where(1 - inside > 1e-10, 1 - inside, 2 * draws * least), 0.0, 1.0)


def _poisson(largest: int, mean: float) -> np.ndarray:
    """Return Poisson probabilities of 0 to `largest`, (largest + 1,)."""
    number = np.arange(largest + 1)
    return np.exp(scipy.special.xlogy(number, mean) - mean - scipy.special.gammaln(number + 1))


@lru_cache(maxsize=32)
def _critical(alpha: float, count: int, draws: int) -> float:
    """Return the largest tail that is rejected at level alpha; 0 if no tail is rejected."""
    candidates = np.unique(_tails(count, draws))
    place = bisect_right(candidates, alpha, key=lambda least: _ecdf_test(np.array([least]), count, draws)[0])
    return float(candidates[place - 1]) * (1 + 1e-9) if place else 0.0


@lru_cache(maxsize=8)
def _rank_table(draws: int) -> tuple[np.ndarray, np.ndarray]:
    """Return edges of fine intervals on the line, and P(rank | truth in the interval) among standard normal draws."""
    edges = np.linspace(-8, 8, 801)
    middles = np.concatenate([edges[:1], (edges[1:] + edges[:-1]) / 2, edges[-1:]])
    number, special = np.arange(draws + 1.0)[:, None], scipy.special
    choices = special.gammaln(draws + 1) - special.gammaln(number + 1) - special.gammaln(draws - number + 1)
    return edges, np.exp(choices + number * special.log_ndtr(middles) + (draws - number) * special.log_ndtr(-middles))


def _likeliest_normal(
    counts: np.ndarray, draws: int, bias: float | None = None, log_spread: float | None = None
) -> tuple[np.ndarray, float]:
    """Return mean and log standard deviation of the truth that most likely has these ranks, and the log-likelihood.

    A value that is not None is fixed. Ranks 0 and L do not determine how far outside all draws a truth lies.
    """
    edges, table = _rank_table(draws)
    scores = scipy.special.ndtri((np.arange(draws + 1) + 0.5) / (draws + 1))

    def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        spread = math.exp(parameters[1])
        t = (edges - parameters[0]) / spread
        density = np.exp(-(t**2) / 2) / math.sqrt(2 * math.pi)
        below = np.stack([scipy.special.ndtr(t), -density / spread, -density * t])  # and its two derivatives
        share, *slopes = np.diff(below, prepend=0.0, append=[[1.0], [0.0], [0.0]]) @ table.T
        share = np.maximum(share, 1e-300)
        weak = parameters / (100.0, 1.0)  # gradient of a prior with standard deviations of 10 and 1
        value = -counts @ np.log(share) + parameters @ weak / 2
        return float(value), weak - np.stack(slopes) @ (counts / share)

    mean = counts @ scores / counts.sum()
    ratio = math.sqrt(counts @ (scores - mean) ** 2 / counts.sum() / (scores**2).mean())
    limits = [(-12.0, 12.0) if bias is None else (bias, bias), (-3.0, 3.0) if log_spread is None else (log_spread,) * 2]
    start = np.clip([mean, math.log(max(ratio, 1.0))], *np.transpose(limits))  # wide, so that all ranks have a gradient
    optimum = scipy.optimize.minimize(loss, start, jac=True, method="L-BFGS-B", bounds=limits)
    return optimum.x, -float(optimum.fun)


def _reading(name: str, counts: np.ndarray, draws: int) -> str:
    """Return an interpretation from likelihood ratio tests (three standard errors) of bias and of spread."""
    (bias, log_spread), likelihood = _likeliest_normal(counts, draws)
    biased = 2 * (likelihood - _likeliest_normal(counts, draws, bias=0.0)[1]) > 9
    spread = 2 * (likelihood - _likeliest_normal(counts, draws, log_spread=0.0)[1]) > 9
    if name == LOG_JOINT:  # if all draws are near the mode, the truth is the least probable
        return ("draws improbable latents" if bias > 0 else "is too concentrated") if biased else "has another shape"
    if name == TARP:  # the nearer draws are to each other, the nearer to a point among them
        return ("is too concentrated" if bias > 0 else "is too dispersed") if biased else "has another shape"
    parts = ["is too narrow" if log_spread > 0 else "is too wide"] * spread
    parts += ["draws too low" if bias > 0 else "draws too high"] * biased
    return ", ".join(parts) or "has another shape"
