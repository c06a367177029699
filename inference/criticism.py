"""Criticism of a model and its guide: is it calibrated, do replicated motions look real, what does a latent do?

`calibrate` is simulation-based calibration (Talts et al., 2018, arXiv 1804.06788) of a guide, with the exact
simultaneous test and envelope for discrete ranks of Säilynoja et al. (2022, arXiv 2103.10522), and with the log joint
as a quantity that depends on the data (Modrák et al., 2023, arXiv 2211.02383). `predictive_checks` compares statistics
of real motion with those of forecasts and of draws from the posterior predictive distribution (Gelman, Meng and Stern,
1996). `traverse` moves one coordinate of a latent and decodes.
"""

from __future__ import annotations

import json
import math
import re
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal

import matplotlib.figure
import numpy as np
import torch
from pyro import poutine
from rich.text import Text
from scipy import fft, special
from torch import Tensor

from ..motion import Skeleton
from ..program.batch import Batch, repeat
from ..program.model import DynamicalVAE
from ..turns import alone
from .bounds import require_likelihood
from .evaluate import evaluating, hold, on_device_of, plain
from .result import Result, Table, as_they_are, progress_bar

__all__ = [
    "Calibration",
    "Check",
    "PredictiveChecks",
    "Statistic",
    "Traversal",
    "calibrate",
    "motion_statistics",
    "predictive_checks",
    "traverse",
]

LOG_JOINT = "log joint"

# Simulation-based calibration ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Result):
    """Ranks of simulated latents among the guide's draws; uniform on 0..L where the guide is the exact posterior.

    Uniform ranks of single coordinates are necessary, not sufficient: a guide that ignores the data and draws from the
    prior has them. The rank of the log joint, log p(x, latents), tells such a guide, and one that misses dependence
    between coordinates.

    Attributes:
        ranks: (N, Q), how many of the L draws lie below the truth.
        names: of the Q quantities: "w[0]", "z_3[1]" (step from 1, coordinate from 0), "log joint".
        draws: L.
        length: T of the simulated sequences.
        seed: of simulations and draws.
        equations: of model and guide; no guide's where it was a program of one's own.
    """

    ranks: np.ndarray
    names: tuple[str, ...]
    draws: int
    length: int
    seed: int
    equations: dict[str, str]

    @cached_property
    def counts(self) -> np.ndarray:
        """(Q, L + 1), how often each rank occurred."""
        return np.stack([np.bincount(ranks, minlength=self.draws + 1) for ranks in self.ranks.T])

    @cached_property
    def p_values(self) -> np.ndarray:
        """(Q,), exact p-values of uniformity: at most alpha just where the ECDF leaves its envelope at alpha."""
        tails = _tails(len(self.ranks), self.draws)
        below = self.counts.cumsum(1)[:, :-1]
        least, which = np.unique(tails[np.arange(self.draws), below].min(1), return_inverse=True)
        return _ecdf_test(least, len(self.ranks), self.draws)[which]

    @property
    def adjusted(self) -> np.ndarray:
        """(Q,), p-values times the number of quantities (Bonferroni), at most 1."""
        return np.minimum(1.0, self.p_values * len(self.names))

    @property
    def p_value(self) -> float:
        """Of uniformity in all quantities at once, however they depend on each other."""
        return float(self.adjusted.min())

    @property
    def bias(self) -> np.ndarray:
        """(Q,), where the truth lies above the guide's mean, in the guide's standard deviations; see `spread`."""
        return self._normals[:, 0]

    @property
    def spread(self) -> np.ndarray:
        """(Q,), standard deviation of the truth about the guide's mean over that of the guide; above 1: too narrow.

        Bias and spread are those of the normal truth most likely to have these ranks among L standard normal draws:
        what they are called, where guide and posterior are normal. Where ranks pile up at an end and leave them open, a
        prior worth less than one simulation keeps them finite.
        """
        return np.exp(self._normals[:, 1])

    @property
    def readings(self) -> tuple[str, ...]:
        """What the shape of the ranks says of the guide; "" where uniformity is not rejected at 5 % (adjusted)."""
        return tuple(
            _reading(self.names[q], self.counts[q], self.draws) if adjusted <= 0.05 else ""
            for q, adjusted in enumerate(self.adjusted)
        )

    @property
    def verdict(self) -> str:
        """One sentence."""
        rejected = int((self.adjusted <= 0.05).sum())
        number = f"{len(self.names)} quantities, {len(self.ranks)} simulations, p = {self.p_value:.2g}"
        if not rejected:
            return f"nothing speaks against the guide ({number})"
        return f"the guide is not the posterior: {rejected} of {number}"

    def envelope(self, alpha: float = 0.05) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where the ECDF of a quantity's ranks lies, at all points at once, with probability at least 1 - alpha.

        Returns:
            Points k / (L + 1), and the least and largest share of ranks below k that still lie within, (L,) each.
        """
        if not 0 < alpha < 1:
            raise ValueError(f"alpha is a probability between 0 and 1, got {alpha}")
        count = len(self.ranks)
        within = _tails(count, self.draws) > _critical(alpha, count, self.draws)
        points = np.arange(1, self.draws + 1) / (self.draws + 1)
        return points, within.argmax(1) / count, 1 - within[:, ::-1].argmax(1) / count

    def table(self, worst: int = 20) -> Table:
        """The quantities with the smallest p-values first."""
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

    def plot(self, worst: int = 8) -> matplotlib.figure.Figure:
        """Rank histogram above ECDF difference, for the quantities with the smallest p-values.

        Histograms are relative to uniform, with a band that holds a bin in 99 % of cases. ECDF differences have the
        envelope that all quantities keep to, at all points, with 95 % probability (Bonferroni over quantities).
        """
        from scipy.stats import binom  # most of a second to import, as below

        order = np.argsort(self.p_values, kind="stable")[:worst]
        columns = min(4, len(order))
        rows = math.ceil(len(order) / columns)
        figure = matplotlib.figure.Figure(figsize=(0.8 + 2.4 * columns, 0.6 + 3.1 * rows), layout="constrained")
        panels = figure.subplots(2 * rows, columns, squeeze=False, sharex=True, sharey="row")
        points, low, high = self.envelope(0.05 / len(self.names))
        levels, count = self.draws + 1, len(self.ranks)
        edges = np.linspace(0, levels, min(20, levels) + 1).round().astype(int)
        width = np.diff(edges) / levels
        band = [binom.ppf(level, count, width) / (count * width) for level in (0.005, 0.995)]
        for place, q in enumerate(order):
            row, column = divmod(place, columns)
            top, bottom = panels[2 * row, column], panels[2 * row + 1, column]
            share = np.add.reduceat(self.counts[q], edges[:-1]) / (count * width)
            top.stairs(band[1], edges / levels, baseline=band[0], fill=True, color="0.88")
            top.stairs(share, edges / levels, color="C0")
            top.axhline(1, color="0.4", linewidth=0.8)
            reading = f"\n{self.readings[q]}" if self.readings[q] else ""
            top.set_title(f"{self.names[q]}, p = {self.adjusted[q]:.2g}{reading}", fontsize=8, parse_math=False)
            bottom.fill_between(points, low - points, high - points, color="0.88", step="mid", linewidth=0)
            below = self.counts[q].cumsum()[:-1] / count
            bottom.plot(points, below - points, color="C0", linewidth=1.2)
            bottom.axhline(0, color="0.4", linewidth=0.8)
            bottom.tick_params(labelbottom=True)
            for panel in (top, bottom):
                panel.tick_params(labelsize=7)
            if column == 0:
                top.set_ylabel("ranks\nover uniform", fontsize=8)
                bottom.set_ylabel("ECDF\nless uniform", fontsize=8)
        for place in range(len(order), rows * columns):
            row, column = divmod(place, columns)
            panels[2 * row, column].set_axis_off()
            panels[2 * row + 1, column].set_axis_off()
        shown = "" if len(order) == len(self.names) else f" · worst {len(order)} of {len(self.names)}"
        figure.suptitle(f"{self._title}{shown}", fontsize=9, parse_math=False)
        figure.supxlabel(f"rank among {self.draws} draws, scaled to [0, 1]", fontsize=8)
        return figure

    def document(self) -> dict[str, Any]:
        """Everything but the single ranks, of which the counts tell all that the tests use, in JSON's types."""
        columns = (self.p_values, self.adjusted, self.bias, self.spread, self.readings, self.counts.tolist())
        return {
            "equations": self.equations,
            "simulations": len(self.ranks),
            "draws": self.draws,
            "length": self.length,
            "seed": self.seed,
            "p_value": self.p_value,
            "verdict": self.verdict,
            "quantities": {
                name: {
                    "p": float(p),
                    "p_adjusted": float(adjusted),
                    "bias": float(bias),
                    "spread": float(spread),
                    "reading": reading,
                    "rank_counts": counts,
                }
                for name, p, adjusted, bias, spread, reading, counts in zip(self.names, *columns, strict=True)
            },
        }

    def to_json(self) -> str:
        """`document` as text."""
        return json.dumps(self.document(), indent=1, allow_nan=False)

    @property
    def _title(self) -> str:
        return f"simulation-based calibration · {self.equations.get('inference', 'guide of one’s own')}"

    @cached_property
    def _normals(self) -> np.ndarray:
        """(Q, 2), bias and logarithm of spread."""
        return np.stack([_likeliest_normal(counts, self.draws)[0] for counts in self.counts])


@alone
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
    """Simulation-based calibration: draws latents and data from the model, and asks the guide for the latents.

    Says whether the guide is the model's posterior on the model's own data; it knows nothing of real data, nor
    of whether the model is a good one.

    Args:
        model: the generative model; its own guide is examined where no other is given.
        length: T of the simulated sequences.
        simulations: N.
        draws: L, draws from the guide for each simulation.
        guide: a Pyro program of the batch, with a site (B, T, D) or (B, D) for every latent.
        steps: which steps of local latents are ranked, from 1; all without it.
        context: context variables (C, T, D) or (C, D), used in turn.
        seed: of simulations and draws.
        chunk: sequences times draws to hold at once.
        progress: whether to show a progress bar.

    Raises:
        ValueError: numbers below 1, steps beyond the length, context that is missing, or a guide without some latent.
        FloatingPointError: a simulation that is not finite.
    """
    if min(length, simulations, draws, chunk) < 1:
        raise ValueError(
            f"length, simulations, draws and chunk are at least 1, got {length}, {simulations}, {draws} and {chunk}"
        )
    require_likelihood(model)
    kept = list(range(1, length + 1)) if steps is None else list(steps)
    if not kept or len(set(kept)) < len(kept) or not set(kept) <= set(range(1, length + 1)):
        raise ValueError(f"steps are different numbers from 1 to {length}, got {kept}")
    contexts: Mapping[str, Tensor] = context or {}
    if missing := [name for name in model.context if name not in contexts]:
        raise ValueError(f"the model reads the context {', '.join(missing)}; pass context={{name: values}}")
    infer = guide or model.guide
    index = torch.tensor(kept) - 1

    def quantities(batch: Batch, latents: Mapping[str, Tensor]) -> Tensor:
        """(B, Q)."""
        local = model.generative.local
        ranked = [latents[name][:, index] if local(name) else latents[name] for name in model.latents]
        joint = torch.stack(list(model.log_joint(batch, latents).values())).sum(0)
        return torch.cat([*(value.flatten(1) for value in ranked), joint[:, None]], 1)

    at_once = max(1, chunk // draws)
    bar = progress_bar(progress)
    ranks = []
    with evaluating(model, seed), bar:
        parts = range(0, simulations, at_once)
        for start in bar.track(parts, description="simulations"):
            count = min(at_once, simulations - start)
            turn = torch.arange(start, start + count)
            given = on_device_of(model, {name: value[turn % len(value)] for name, value in contexts.items()})
            truth = model.sample(count, length, given or None)
            if wrong := [name for name in (*model.latents, *model.observed) if not truth[name].isfinite().all()]:
                raise FloatingPointError(
                    f"a free run of {length} steps gave {', '.join(wrong)} that are not finite; simulate fewer steps, "
                    "or see whether the model has been fitted"
                )
            batch = {**given, **{name: truth[name] for name in model.observed}}
            repeated = repeat(batch, draws)
            sites = poutine.trace(infer).get_trace(repeated).nodes
            if missing := [name for name in model.latents if name not in sites]:
                raise ValueError(f"the guide draws no {', '.join(missing)}; it needs one site for each latent")
            found: dict[str, Any] = {name: sites[name]["value"] for name in model.latents}
            drawn = quantities(repeated, found)
            true = quantities(batch, {name: truth[name] for name in model.latents})
            ranks.append((drawn.unflatten(0, (draws, count)) < true).sum(0).cpu())
    names = [
        f"{name}{step}[{d}]"
        for name in model.latents
        for step in ([f"_{t}" for t in kept] if model.generative.local(name) else [""])
        for d in range(model.sizes[name])
    ]
    equations = {"generative": model.generative.text} | ({} if guide else {"inference": model.inference.text})
    return Calibration(torch.cat(ranks).numpy(), (*names, LOG_JOINT), draws, length, seed, equations)


@lru_cache(maxsize=8)
def _tails(count: int, draws: int) -> np.ndarray:
    """(L, N + 1): the smaller tail of k in a Binomial(N, i / (L + 1)), which the number of ranks below i follows."""
    points = np.arange(1, draws + 1)[:, None] / (draws + 1)
    number = np.arange(count + 1.0)
    at_least = np.where(number > 0, special.bdtrc(np.maximum(number - 1, 0), count, points), 1.0)
    return np.minimum(special.bdtr(number, count, points), at_least)


def _ecdf_test(least: np.ndarray, count: int, draws: int) -> np.ndarray:
    """P(the smallest tail of a uniform sample's ECDF over all points is at most `least`), elementwise; exact.

    Counts below 1, 2, ... of uniform ranks are a Poisson process given that it ends at N, so the probability to stay
    within bounds is a chain of convolutions (Säilynoja et al. have binomial steps). `arviz_stats` simulates the same
    probability, but drops the upper tail of every simulation with no rank below some point.
    """
    step, size = _poisson(count, count / (draws + 1)), fft.next_fast_len(2 * count + 1, real=True)
    transform = fft.rfft(step, size)
    bound = least[:, None] * (1 + 1e-9)  # tails that are equal but for rounding are equal
    within = np.zeros((len(least), count + 1))
    within[:, 0] = 1
    for tails in _tails(count, draws):
        moved = fft.irfft(fft.rfft(within, size) * transform, size)[:, : count + 1]
        within = np.where(tails > bound, moved, 0.0)
    inside = within @ step[::-1] / _poisson(count, count)[-1]
    # Where rounding hides the difference from 1, the sum over points bounds the probability from above.
    return np.clip(np.where(1 - inside > 1e-10, 1 - inside, 2 * draws * least), 0.0, 1.0)


def _poisson(largest: int, mean: float) -> np.ndarray:
    """Probabilities of 0 to `largest`."""
    number = np.arange(largest + 1)
    return np.exp(special.xlogy(number, mean) - mean - special.gammaln(number + 1))


@lru_cache(maxsize=32)
def _critical(alpha: float, count: int, draws: int) -> float:
    """The largest tail that is rejected at level alpha; 0 where none is."""
    candidates = np.unique(_tails(count, draws))
    place = bisect_right(candidates, alpha, key=lambda least: _ecdf_test(np.array([least]), count, draws)[0])
    return float(candidates[place - 1]) * (1 + 1e-9) if place else 0.0


@lru_cache(maxsize=8)
def _rank_table(draws: int) -> tuple[np.ndarray, np.ndarray]:
    """Edges of fine intervals of the real line, and P(rank | truth in the interval) among standard normal draws."""
    edges = np.linspace(-8, 8, 801)
    middles = np.concatenate([edges[:1], (edges[1:] + edges[:-1]) / 2, edges[-1:]])
    number = np.arange(draws + 1.0)[:, None]
    choices = special.gammaln(draws + 1) - special.gammaln(number + 1) - special.gammaln(draws - number + 1)
    return edges, np.exp(choices + number * special.log_ndtr(middles) + (draws - number) * special.log_ndtr(-middles))


def _likeliest_normal(
    counts: np.ndarray, draws: int, bias: float | None = None, log_spread: float | None = None
) -> tuple[np.ndarray, float]:
    """Mean and log standard deviation, where not given, of the truth that most likely has these ranks; how likely.

    Ranks 0 and L are tails: they do not say how far beyond all draws a truth lies.
    """
    from scipy.optimize import minimize  # slow to import

    edges, table = _rank_table(draws)
    scores = special.ndtri((np.arange(draws + 1) + 0.5) / (draws + 1))

    def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        spread = math.exp(parameters[1])
        t = (edges - parameters[0]) / spread
        density = np.exp(-(t**2) / 2) / math.sqrt(2 * math.pi)
        below = np.stack([special.ndtr(t), -density / spread, -density * t])  # and its two derivatives
        share, *slopes = np.diff(below, prepend=0.0, append=[[1.0], [0.0], [0.0]]) @ table.T
        share = np.maximum(share, 1e-300)
        weak = parameters / (100.0, 1.0)  # gradient of a prior with standard deviations of 10 and 1
        value = -counts @ np.log(share) + parameters @ weak / 2
        return float(value), weak - np.stack(slopes) @ (counts / share)

    mean = counts @ scores / counts.sum()
    ratio = math.sqrt(counts @ (scores - mean) ** 2 / counts.sum() / (scores**2).mean())
    limits = [(-12.0, 12.0) if bias is None else (bias, bias), (-3.0, 3.0) if log_spread is None else (log_spread,) * 2]
    start = np.clip([mean, math.log(max(ratio, 1.0))], *np.transpose(limits))  # wide, so that all ranks have a slope
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=limits)
    return found.x, -float(found.fun)


def _reading(name: str, counts: np.ndarray, draws: int) -> str:
    """What three standard errors, by the likelihood ratio, tell of bias at any spread and of spread at any bias."""
    (bias, log_spread), likelihood = _likeliest_normal(counts, draws)
    biased = 2 * (likelihood - _likeliest_normal(counts, draws, bias=0.0)[1]) > 9
    spread = 2 * (likelihood - _likeliest_normal(counts, draws, log_spread=0.0)[1]) > 9
    if name == LOG_JOINT:  # of draws that are all near the mode, the truth is the least probable
        return ("draws improbable latents" if bias > 0 else "is too concentrated") if biased else "has another shape"
    parts = ["is too narrow" if log_spread > 0 else "is too wide"] * spread
    parts += ["draws too low" if bias > 0 else "draws too high"] * biased
    return ", ".join(parts) or "has another shape"


# Predictive checks ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Statistic:
    """A number that says something of a motion.

    Args:
        function: positions (..., T, J, 3) in metres -> (...).
        unit: of the number.
    """

    function: Callable[[Tensor], Tensor]
    unit: str = ""


def motion_statistics(skeleton: Skeleton) -> dict[str, Statistic]:
    """The statistics that are checked where none are named.

    * speed: mean over frames and joints, by first differences.
    * acceleration: the same by second differences.
    * bone length: mean over frames and bones.
    * bone stretch: standard deviation of a bone's length over time by its mean, mean over bones; 0 for real bones.
    * foot height: of the feet above the lowest joint in the same frame, mean over frames and feet. Where one foot
      stands it is the height above the ground; it needs no ground, so that it means the same with and without the
      pelvis's own motion. Feet are the ends of the chains whose names say foot, toe, ankle or heel; a skeleton without
      such names has no foot height.
    """
    up, fps = skeleton.vertical, skeleton.fps
    ends = set(range(skeleton.joints)) - set(skeleton.parents)
    feet = [j for j in sorted(ends) if re.search("foot|toe|ankle|heel", skeleton.names[j], re.IGNORECASE)]

    def speed(positions: Tensor) -> Tensor:
        return fps * positions.diff(dim=-3).norm(dim=-1).mean((-2, -1))

    def acceleration(positions: Tensor) -> Tensor:
        return fps**2 * positions.diff(n=2, dim=-3).norm(dim=-1).mean((-2, -1))

    def bone_length(positions: Tensor) -> Tensor:
        return skeleton.bone_lengths(positions).mean((-2, -1))

    def bone_stretch(positions: Tensor) -> Tensor:
        lengths = skeleton.bone_lengths(positions)
        return 100 * (lengths.std(-2, correction=0) / lengths.mean(-2)).mean(-1)

    def foot_height(positions: Tensor) -> Tensor:
        heights = positions[..., up]
        return (heights[..., feet] - heights.amin(-1, keepdim=True)).mean((-2, -1))

    return {
        "speed": Statistic(speed, "m/s"),
        "acceleration": Statistic(acceleration, "m/s²"),
        "bone length": Statistic(bone_length, "m"),
        "bone stretch": Statistic(bone_stretch, "%"),
        **({"foot height": Statistic(foot_height, "m")} if feet else {}),
    }


@dataclass(frozen=True, eq=False)
class Check:
    """One statistic of real and of replicated windows.

    Attributes:
        real: (N,).
        replicated: (S, N).
        unit: of both.
    """

    real: np.ndarray
    replicated: np.ndarray
    unit: str

    @property
    def tail_areas(self) -> np.ndarray:
        """(N,), each window's Bayesian p-value: the share of its replicates that are larger, ties counting half."""
        larger, equal = self.replicated > self.real, self.replicated == self.real
        return (larger + 0.5 * equal).mean(0)

    @property
    def outside(self) -> float:
        """Share of windows whose tail area is below .05 or above .95."""
        return float(((self.tail_areas < 0.05) | (self.tail_areas > 0.95)).mean())

    @property
    def expected_outside(self) -> float:
        """`outside` of the true model's forecasts, ties apart: the window's rank among its S is uniform on 0..S."""
        samples = len(self.replicated)
        return 2 * -(-samples // 20) / (samples + 1)

    @property
    def wasserstein(self) -> float:
        """Distance between the distributions of real and replicated values, in their unit."""
        from scipy.stats import wasserstein_distance

        return float(wasserstein_distance(self.real, self.replicated.ravel()))

    def document(self) -> dict[str, Any]:
        """What the table shows and the tail area of every window, in JSON's types."""
        levels = (0.05, 0.25, 0.5, 0.75, 0.95)
        return {
            "unit": self.unit,
            "quantiles": list(levels),
            "real": np.quantile(self.real, levels).tolist(),
            "replicated": np.quantile(self.replicated, levels).tolist(),
            "wasserstein": self.wasserstein,
            "tail_area": float(self.tail_areas.mean()),
            "outside": self.outside,
            "expected_outside": self.expected_outside,
            "tail_areas": self.tail_areas.tolist(),
        }


PROGRAMS = {
    "forecast": "free-running given the observed frames",
    "posterior": "free-running given latents inferred from the whole window",
}


@dataclass(frozen=True, eq=False, repr=False)
class PredictiveChecks(Result):
    """Statistics of replicated windows beside those of the real ones.

    Attributes:
        checks: (model, program, statistic) to `Check`; programs are "forecast" and "posterior".
        data: fingerprint, windows, frames, coordinates and joints.
        protocol: the fields of the windows' protocol.
        samples: S, replicates of each window.
        emission: "mean" or "drawn".
        seed: of every model's draws.
    """

    checks: dict[tuple[str, str, str], Check]
    data: dict[str, Any]
    protocol: dict[str, Any]
    samples: int
    emission: str
    seed: int

    def __getitem__(self, key: tuple[str, str, str]) -> Check:
        if key not in self.checks:
            raise KeyError(f"no check {key}; there are {', '.join(map(str, self.checks))}")
        return self.checks[key]

    def table(self) -> Table:
        """Quantiles of real and replicated values, their distance, and where real values lie among replicates."""
        expected = next(iter(self.checks.values())).expected_outside
        caption = [
            *(f"{name}: {meaning}" for name, meaning in PROGRAMS.items()),
            "tail area: share of a window's replicates above the real value, mean over windows",
            "outside: share of windows with a tail area below .05 or above .95",
            f"forecasts of a true model have ½ and, with {self.samples} replicates, {expected:.1%}"
            if self.emission == "drawn"
            else f"means lack the emission's noise: even a true model's need not have ½ and {expected:.1%}",
        ]
        table = Table(title=self._title, caption="\n".join(caption))
        for column in ("", "", "5 %", "median", "95 %", "Wasserstein", "tail area", "outside"):
            table.add_column(column, justify="right" if column else "left", no_wrap=True)
        models, programs, names = (list(dict.fromkeys(keys)) for keys in zip(*self.checks, strict=True))
        for program in programs:
            table.add_section()
            table.add_row(Text(program, "bold"))
            for name in names:
                first = self.checks[models[0], program, name]
                label = Text.assemble(name, (f" ({first.unit})" if first.unit else "", "dim"))
                table.add_row(label, "real", *_quantiles(first.real))
                for model in models:
                    check = self.checks[model, program, name]
                    outcome = (f"{check.wasserstein:.3g}", f"{check.tail_areas.mean():.2f}", f"{check.outside:.0%}")
                    table.add_row("", model, *_quantiles(check.replicated), *outcome)
        return table

    def plot(self) -> matplotlib.figure.Figure:
        """Densities of each statistic: real windows grey, replicates as one line per model."""
        models, programs, names = (list(dict.fromkeys(keys)) for keys in zip(*self.checks, strict=True))
        size = (0.6 + 2.3 * len(names), 0.8 + 2.0 * len(programs))
        figure = matplotlib.figure.Figure(figsize=size, layout="constrained")
        panels = figure.subplots(len(programs), len(names), squeeze=False, sharex="col")
        for column, name in enumerate(names):
            checks = [self.checks[model, program, name] for program in programs for model in models]
            values = [found for check in checks for found in (check.real, check.replicated)]
            # the outer bins take what is more extreme: a wild replicate must not flatten the rest
            low, high = np.quantile(np.stack([np.quantile(v, (0.005, 0.995)) for v in values]), (0, 1))
            edges = np.linspace(low, high if high > low else low + 1, 41)
            for row, program in enumerate(programs):
                panel = panels[row, column]
                real = self.checks[models[0], program, name].real
                panel.stairs(_density(real, edges), edges, fill=True, color="0.8", label="real")
                for place, model in enumerate(models):
                    replicated = self.checks[model, program, name].replicated
                    panel.stairs(_density(replicated, edges), edges, color=f"C{place}", label=model, linewidth=1.3)
                panel.set_yticks([])
                panel.tick_params(labelsize=7)
            unit = checks[0].unit
            panels[-1, column].set_xlabel(f"{name} ({unit})" if unit else name, fontsize=9, parse_math=False)
        for row, program in enumerate(programs):
            panels[row, 0].set_ylabel(program, fontsize=9)
        handles, labels = panels[0, 0].get_legend_handles_labels()
        below: dict[str, Any] = {"loc": "outside lower center", "ncols": len(labels), "frameon": False}
        legend = figure.legend(handles, labels, fontsize=8, **below)
        as_they_are(legend.get_texts())
        figure.suptitle(self._title, fontsize=9, parse_math=False)
        return figure

    def document(self) -> dict[str, Any]:
        """Summaries of every check and what they rest on, in JSON's types."""
        nested: dict[str, Any] = {}
        for (model, program, name), check in self.checks.items():
            nested.setdefault(model, {}).setdefault(program, {})[name] = check.document()
        rest = {name: getattr(self, name) for name in ("data", "protocol", "samples", "emission", "seed")}
        return {**rest, "programs": PROGRAMS, "checks": nested}

    def to_json(self) -> str:
        """`document` as text."""
        return json.dumps(self.document(), indent=1, allow_nan=False)

    @property
    def _title(self) -> str:
        parts = ["predictive checks", self.protocol.get("name", ""), f"{self.data['windows']} windows"]
        parts += [f"{self.samples} replicates", f"{self.emission} emission", f"data {self.data['fingerprint'][:12]}"]
        return " · ".join(part for part in parts if part)


@alone
def predictive_checks(
    model: DynamicalVAE | Mapping[str, DynamicalVAE],
    windows: Any,
    statistics: Mapping[str, Statistic] | None = None,
    *,
    samples: int = 20,
    draw_emission: bool = True,
    seed: int = 0,
    batch_size: int = 32,
    progress: bool = True,
) -> PredictiveChecks:
    """Replicates windows with one model or several, and compares statistics of the motion with those of the real ones.

    Two replications, both free-running. "forecast": the frames after the observed ones; the last two observed frames
    are joined to them, so that a jump at the seam counts. "posterior", the posterior predictive distribution proper:
    latents are inferred from the whole window, and all its frames are generated anew from them.

    Args:
        model: a model, or `{name: model}`.
        windows: of `dvae.motion`, or anything alike with `positions(x)`: (..., T, D) -> (..., T, J, 3).
        statistics: name to `Statistic`; `motion_statistics` of the windows' skeleton without it.
        samples: S, replicates of each window; at least 19, for tail areas below .05 to be a tenth.
        draw_emission: replicate draws of x. Its means, as forecasts are shown, lack the noise of the emission: with
            them the motion that is shown is examined, and no longer the model.
        seed: of every model's draws.
        batch_size: windows replicated at once.
        progress: whether to show a progress bar.

    Raises:
        ValueError: incomplete windows, too few samples, a statistic of the wrong shape or not finite on real windows.
        FloatingPointError: a statistic that is not finite on replicated windows.
    """
    models = dict(model) if isinstance(model, Mapping) else {"model": model}
    if samples < 19 or batch_size < 1 or not models:
        raise ValueError(
            "expected a model, at least 19 samples, for tail areas below .05 to be no more than a tenth, and a "
            f"batch_size of at least 1; got {len(models)}, {samples} and {batch_size}"
        )
    if not hasattr(windows, "positions") or (statistics is None and not hasattr(windows, "skeleton")):
        raise ValueError(
            f"{type(windows).__name__} are no windows of motion: checks need positions(x), (..., T, D) to "
            "(..., T, J, 3), and a skeleton where no statistics= are given"
        )
    statistics = dict(statistics) if statistics is not None else motion_statistics(windows.skeleton)
    if not statistics:
        raise ValueError("there is no statistic to check")
    for each in models.values():
        require_likelihood(each)
    held = hold(windows)
    seam = min(2, held.observed)
    horizon = held.x.shape[1] - held.observed

    def forecast(each: DynamicalVAE, batch: dict[str, Tensor]) -> Tensor:
        """(S, B, seam + H, D)."""
        seen = {**batch, "x": batch["x"][:, : held.observed]}
        future = each.forecast(seen, horizon, samples, draw_emission=draw_emission)["x"]
        return torch.cat([seen["x"][None, :, -seam:].expand(samples, -1, -1, -1), future], 2)

    def posterior(each: DynamicalVAE, batch: dict[str, Tensor]) -> Tensor:
        """(S, B, T, D)."""
        repeated = repeat(batch, samples)
        return _decode(each, repeated, each.guide(repeated), not draw_emission).unflatten(0, (samples, -1))

    def measure(x: Tensor, whose: str) -> dict[str, Tensor]:
        positions, found = windows.positions(x), {}
        for name, statistic in statistics.items():
            found[name] = statistic.function(positions).double().cpu()
            if found[name].shape != x.shape[:-2]:
                raise ValueError(
                    f"the statistic {name} maps {tuple(positions.shape)} to {tuple(found[name].shape)}; expected "
                    f"{tuple(x.shape[:-2])}, one number for each motion (..., T, J, 3)"
                )
            if not found[name].isfinite().all():
                error = ValueError if whose == "real windows" else FloatingPointError
                raise error(f"the statistic {name} is not finite on {whose} of {x.shape[-2]} frames")
        return found

    programs = {"forecast": (forecast, held.observed - seam), "posterior": (posterior, 0)}
    checks = {}
    bar = progress_bar(progress)
    with bar:
        for program, (replicate, first) in programs.items():
            real = measure(held.x[:, first:], "real windows")
            for label, each in models.items():
                parts: list[dict[str, Tensor]] = []
                with evaluating(each, seed):
                    starts = range(0, len(held.x), batch_size)
                    for start in bar.track(starts, description=f"{label}, {program}"):
                        part = {name: value[start : start + batch_size] for name, value in held.batch.items()}
                        x = replicate(each, on_device_of(each, part))
                        parts.append(measure(x.to(held.x), f"replicates of {label} ({program})"))
                for name, statistic in statistics.items():
                    replicated = torch.cat([part[name] for part in parts], 1).numpy()
                    checks[label, program, name] = Check(real[name].numpy(), replicated, statistic.unit)
    return PredictiveChecks(
        checks={(m, p, s): checks[m, p, s] for m in models for p in programs for s in statistics},
        data=held.description(),
        protocol=plain(asdict(windows.protocol)),
        samples=samples,
        emission="drawn" if draw_emission else "mean",
        seed=seed,
    )


def _decode(
    model: DynamicalVAE, batch: Mapping[str, Tensor], latents: Mapping[str, Tensor], mean_emission: bool
) -> Tensor:
    """x (B, T, D) run free from its own past, given context and latents; latents that are not given are drawn.

    First frames that are context, as a pose from which motion starts, stay as they are.
    """
    data = model.read(batch)
    known = {name: value for name, value in data.items() if name in model.context}
    length, size = data.get("x", batch["x"]).shape[1], len(batch["x"])
    x = model.model({**known, **latents}, length=length, size=size, mean_emission=mean_emission)["x"]
    return torch.cat([batch["x"][:, : batch["x"].shape[1] - length], x], 1)


def _quantiles(values: np.ndarray) -> list[str]:
    return [f"{value:.3g}" for value in np.quantile(values, (0.05, 0.5, 0.95))]


def _density(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    counts = np.histogram(values.clip(edges[0], edges[-1]), edges)[0]
    return counts / (values.size * np.diff(edges))


# Latent traversals ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Traversal:
    """Motions decoded while one coordinate of a latent moves.

    Attributes:
        latent: its name.
        coordinates: the C coordinates that were moved, one at a time.
        offsets: (M,) in units of `scale`; 0 is the latent as inferred.
        scale: (C,) the standard deviation of each coordinate under the prior or the posterior.
        frames: (C, M, B, T, D), x decoded.
        unit: "prior" or "posterior".
    """

    latent: str
    coordinates: tuple[int, ...]
    offsets: Tensor
    scale: Tensor
    frames: Tensor
    unit: str

    @property
    def effect(self) -> Tensor:
        """(C,), root mean square over sequences, steps and dimensions of how far x moves about its mean."""
        return self.frames.var(1, correction=0).mean((1, 2, 3)).sqrt()

    def plot(self, windows: Any, frame: int = -1, sequence: int = 0, rows: int = 6) -> matplotlib.figure.Figure:
        """Poses of one sequence at one frame: a row for each coordinate, that of most effect first.

        Args:
            windows: as of `dvae.motion`; their `positions` and `skeleton` turn x into poses.
            frame: which frame of the sequence, the last by default.
            sequence: which sequence of the batch.
            rows: how many coordinates to draw.
        """
        from ..motion.plot import SPACING, pose

        order = self.effect.argsort(descending=True, stable=True)[:rows]
        skeleton = windows.skeleton
        poses = windows.positions(self.frames[order, :, sequence])[:, :, frame].double().cpu()
        poses = poses - poses[..., skeleton.root : skeleton.root + 1, :]
        middle = int(self.offsets.abs().argmin())
        sided = bool(skeleton.left and skeleton.right)
        azimuth = math.pi / 5 - (float(skeleton.heading(poses[0, middle])) if sided else 0.0)
        size = (0.5 + 0.95 * len(self.offsets), 0.6 + 1.9 * len(order))
        figure = matplotlib.figure.Figure(figsize=size, layout="constrained")
        panels = figure.subplots(len(order), 1, squeeze=False, sharex=True, sharey=True)[:, 0]
        for panel, chosen, row in zip(panels, order.tolist(), poses, strict=True):
            for column, drawn in enumerate(row):
                at = (column * SPACING, 0.0)
                pose(panel, row[middle], skeleton, at=at, azimuth=azimuth, colors="0.8", linewidths=1.6)
                pose(panel, drawn, skeleton, at=at, azimuth=azimuth, colors="C0", linewidths=1.4)
            panel.autoscale_view()
            panel.set_aspect("equal")
            moved = f"{self.latent}[{self.coordinates[chosen]}], which moves x by {float(self.effect[chosen]):.2g} m"
            panel.set_title(moved, loc="left", fontsize=8)
            panel.set_yticks([])
            panel.tick_params(length=0, labelsize=8)
            for spine in panel.spines.values():
                spine.set_visible(False)
        panels[-1].set_xticks(
            SPACING * np.arange(len(self.offsets)), [f"{o:+.2g}" if o else "0" for o in self.offsets.tolist()]
        )
        panels[-1].set_xlabel(f"offset of {self.latent}, {self.unit} standard deviations", fontsize=9)
        return figure


@alone
@torch.no_grad()
def traverse(
    model: DynamicalVAE,
    batch: Batch,
    latent: str,
    coordinates: Sequence[int] | None = None,
    span: tuple[float, float] = (-3.0, 3.0),
    steps: int = 7,
    *,
    unit: Literal["prior", "posterior"] = "prior",
    free: Sequence[str] = (),
    draws: int = 256,
    seed: int = 0,
) -> Traversal:
    """Moves one coordinate of a latent at a time, a local one at all steps alike, and decodes.

    Latents are drawn once from the guide. One coordinate is then shifted, the rest stays, and x runs free from its own
    past, set to its mean: all that changes between two decoded motions is what x reads of that coordinate.

    Args:
        model: the model with its guide.
        batch: sequences (B, T, D) to start from, or a mapping with context.
        latent: which latent moves.
        coordinates: of it; all without.
        span: smallest and largest offset, in standard deviations.
        steps: M, the number of offsets, evenly spaced; 0, the latent as inferred, is to be one of them.
        unit: whose standard deviation: that of the prior (over free runs and steps), or the guide's given the batch.
        free: other latents, drawn anew from the model with the same noise, so that they follow the one that moves.
            Needed to see a latent that acts on x through others only.
        draws: from which the standard deviation is estimated.
        seed: of all draws.

    Raises:
        ValueError: an unknown latent or coordinate, offsets without 0, or a latent that nothing on the way to x reads.
    """
    if latent not in model.latents or not set(free) <= set(model.latents) - {latent}:
        raise ValueError(
            f"the latents are {', '.join(model.latents)}; expected one to move and others to be free, got {latent} "
            f"and free={tuple(free)}"
        )
    chosen = tuple(range(model.sizes[latent]) if coordinates is None else coordinates)
    if not chosen or not set(chosen) <= set(range(model.sizes[latent])) or steps < 2 or draws < 2:
        raise ValueError(
            f"coordinates of {latent} go from 0 to {model.sizes[latent] - 1}, steps is at least 2, draws at least 2; "
            f"got {chosen}, {steps} and {draws}"
        )
    offsets = torch.linspace(*span, steps, dtype=torch.float64)
    offsets[offsets.abs() < 1e-9 * offsets.abs().max()] = 0
    if (offsets != 0).all():
        raise ValueError(
            f"{steps} offsets from {span[0]:g} to {span[1]:g} leave out 0, the latent as inferred, with which others "
            "are compared; take an odd number of steps, and a span about 0"
        )
    if unit not in ("prior", "posterior"):
        raise ValueError(f"unit is 'prior' or 'posterior', got {unit!r}")
    _check_path(model, latent, free)
    data = on_device_of(model, model.read(batch))
    if partial := {"lengths", "mask"} & data.keys():
        raise ValueError(f"a traversal needs complete sequences, but these have {', '.join(sorted(partial))}")
    with evaluating(model, seed):
        scale = _scale(model, data, latent, unit, draws)[list(chosen)]
        torch.manual_seed(seed)
        inferred = model.guide(data)
        offsets = offsets.to(scale)
        kept = {name: value for name, value in inferred.items() if name not in (*free, latent)}
        frames = []
        for coordinate, unit_scale in zip(chosen, scale, strict=True):
            moved = repeat(inferred[latent], steps).unflatten(0, (steps, -1))
            moved[..., coordinate] += (offsets * unit_scale).reshape(steps, *[1] * (moved.dim() - 2))
            # Draws of free latents have the same noise only in runs of their own.
            for group in moved.split(1 if free else steps):
                torch.manual_seed(seed)
                latents = {**repeat(kept, len(group)), latent: group.flatten(0, 1)}
                frames.append(_decode(model, repeat(data, len(group)), latents, True))
    shape = (len(chosen), steps, -1)
    return Traversal(latent, chosen, offsets.cpu(), scale.cpu(), torch.cat(frames).unflatten(0, shape).cpu(), unit)


def _check_path(model: DynamicalVAE, latent: str, free: Sequence[str]) -> None:
    moving, reach = {latent}, True
    while reach:
        readers = {name for name in (*free, *model.observed) if moving & set(model.generator[name].parents)}
        reach = bool(readers - moving)
        moving |= readers
    if not moving & set(model.observed):
        readers = {name for name in model.latents if latent in model.generator[name].parents}
        raise ValueError(
            f"x does not read {latent}, so nothing would move; let the latents on the way be free: "
            f"free={tuple(sorted(readers))}"
        )


def _scale(model: DynamicalVAE, data: dict[str, Tensor], latent: str, unit: str, draws: int) -> Tensor:
    """(D,), the standard deviation of a latent's coordinates, pooled over steps (and sequences, of the posterior)."""
    if unit == "prior":
        size, length = data["x"].shape[:2]
        rows = torch.arange(draws) % size
        context = {name: value[rows] for name, value in data.items() if name in model.context}
        values = model.sample(draws, length, context or None)[latent]
        return values.flatten(0, -2).std(0)
    values = model.guide(repeat(data, draws))[latent].unflatten(0, (draws, -1))
    return values.var(0).flatten(0, -2).mean(0).sqrt()


# Shared --------------------------------------------------------------------------------------------------------------
