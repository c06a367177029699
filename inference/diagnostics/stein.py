"""Kernel Stein discrepancy between a guide's draws and the posterior: a test that needs no draws from the posterior.

    h(u, v) = s(u)'s(v) k(u, v) + s(u)' dk/dv + s(v)' dk/du + sum_p d2k / du_p dv_p,    s = d log p(x, u) / du,
    KSD^2   = mean of h over pairs of different draws: unbiased, and 0 on average if they are from the posterior

(Liu, Lee and Jordan, 2016, arXiv 1602.03253; Chwialkowski, Strathmann and Gretton, 2016, arXiv 1602.02964). The kernel
is inverse multiquadric, k(u, v) = (1 + |u - v|^2 / b^2)^(-1/2). Its tails are heavy enough to detect draws that do not
converge to the posterior (Gorham and Mackey, 2017, arXiv 1703.01717). The latents u are preconditioned: each number is
in standard deviations of the guide, estimated from separate draws. The bandwidth is b^2 = 2 P, the mean squared
distance between two draws of P such numbers. The score does not depend on the evidence, and costs one gradient of the
model.

p-values use the wild bootstrap: the mean of h with random signs of the draws has the distribution of KSD^2 for draws
from the posterior. The joint test compares sums over sequences, and has more power than tests of single sequences.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from ...program.batch import AnyBatch
from ...program.model import DynamicalVAE
from ..evaluation.evaluation_windows import seeded_evaluation
from ..evaluation.record import Dims
from ..evaluation.result import Result, Table, new_figure, progress_bar, styled
from .latents import Inferred, some_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCALED = 1000
"""Number of draws from the guide for its standard deviations."""


@dataclass(frozen=True, eq=False, repr=False)
class SteinDiscrepancy(Result):
    """Distance of a guide's draws from the posterior of each of S sequences, with a test of its significance.

    Attributes:
        squared: KSD^2, (S,); unbiased, so it may be negative.
        critical: value that draws from the posterior exceed in 5 % of cases, (S,).
        p_values: share of bootstrap values, with `squared` itself among them, that are at least `squared`, (S,).
        p_value: p-value of all sequences together, by the sum of their KSD^2.
        numbers: P, number of latent values of each sequence, (S,).
        sequences: indices of the sequences in the batch.
        draws: K, number of draws.
        bootstrap: replicates of the wild bootstrap.
        seed: seed of all draws.
        equations: equations of model and guide; without the guide's if it is a custom program.
    """

    squared: Annotated[np.ndarray, Dims("sequence")]
    critical: Annotated[np.ndarray, Dims("sequence")]
    p_values: Annotated[np.ndarray, Dims("sequence")]
    p_value: float
    numbers: Annotated[np.ndarray, Dims("sequence", kind=int)]
    sequences: tuple[int, ...]
    draws: int
    bootstrap: int
    seed: int
    equations: dict[str, str]

    @property
    def verdict(self) -> str:
        """Result of the test in one sentence."""
        count = len(self.sequences)
        which = "1 sequence" if count == 1 else f"all {count} sequences together"
        number = f"p = {self.p_value:.2g} for {which}, {self.draws} draws of each"
        if self.p_value <= 0.05:
            individual = (
                f"; at 5 %, {(self.p_values <= 0.05).sum()} of {count} are significant alone" if count > 1 else ""
            )
            return f"the guide is not the posterior ({number}{individual})"
        return f"no evidence against the guide ({number})"

    def table(self) -> Table:
        """Return a table with a row for each sequence."""
        guide = self.equations.get("inference", "custom guide")
        table = Table(title=f"kernel Stein discrepancy · {guide}", caption=self.verdict)
        for column in ("sequence", "latent numbers", "KSD²", "5 % critical", "p"):
            table.add_column(column, justify="right", no_wrap=True)
        columns = (self.sequences, self.numbers, self.squared, self.critical, self.p_values)
        for sequence, number, *rest in zip(*columns, strict=True):
            table.add_row(str(sequence), str(number), *(f"{value:.3g}" for value in rest))
        return table

    @styled
    def plot(self) -> Figure:
        """Draw KSD^2 of every sequence relative to its 5 % critical value."""
        figure = new_figure(2.5 + 0.3 * len(self.sequences), 3.2)
        panel = figure.subplots()
        panel.plot([str(sequence) for sequence in self.sequences], self.squared / self.critical, "o")
        panel.axhline(1, color="0.4", linewidth=0.8)
        panel.set_xlabel("sequence")
        panel.set_ylabel("KSD² / its 5 % critical value")
        figure.suptitle(self.equations.get("inference", "custom guide"), parse_math=False)
        return figure

    @override
    def summary(self) -> dict[str, Any]:
        return {"verdict": self.verdict}

    @override
    def labels(self) -> dict[str, Sequence[str]]:
        return {"sequence": [*map(str, self.sequences)]}

    @override
    def check(self) -> None:
        if self.extents != {"sequence": {len(self.sequences)}} or not self.sequences:
            raise ValueError(
                f"expected at least one sequence, and a value for each of {len(self.sequences)} sequences; got "
                f"{self.extents}"
            )


@torch.inference_mode(False)
def stein_discrepancy(
    model: DynamicalVAE,
    batch: AnyBatch,
    sequences: Sequence[int] | None = None,
    *,
    guide: Callable[..., Any] | None = None,
    draws: int = 500,
    bootstrap: int = 1000,
    seed: int = 0,
    progress: bool = True,
) -> SteinDiscrepancy:
    """Test for each sequence whether a guide's draws are from the posterior, on data of any kind.

    The test uses the gradient of the log joint at the guide's draws, and no draws from the posterior. A small p-value
    shows that the guide is wrong. A large one is weak evidence if there are many latent values: see
    benchmarks/results/criticism for the power of the test.

    Args:
        model: generative model; its own guide is tested by default.
        batch: batch as in `DynamicalVAE.model`, which may be ragged or have missing entries and context.
        sequences: indices of sequences in the batch, from 0; all by default.
        guide: Pyro program of the batch, with a site (B, T, D) or (B, D) for every latent.
        draws: K, number of draws from the guide for each sequence; memory grows with its square.
        bootstrap: replicates of the wild bootstrap: p-values are at least 1 / (1 + bootstrap).
        seed: seed of all draws.
        progress: whether to show a progress bar.

    Returns:
        Squared discrepancy, critical value and p-value of each of S sequences, (S,) each, and a joint p-value.

    Raises:
        ValueError: when the model has no latents or likelihood, or a latent is shared by sequences or cannot take every
            real value. Also when a sequence is not in the batch, data are missing, or a number is too small.
        FloatingPointError: when a gradient is not finite.

    Example:
        >>> pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})"
        >>> model = dvae.linear_gaussian_surrogate(*pair, {"z": 1, "x": 2}, 4)
        >>> result = dvae.stein_discrepancy(model, model.sample(3, 4)["x"])
        >>> result.p_values.shape, result.p_value < 0.05  # a guide that was not fitted
        ((3,), True)
    """
    if draws < 2 or bootstrap < 1:
        raise ValueError(f"draws must be at least 2 and bootstrap at least 1, got {draws} and {bootstrap}")
    results, total = [], torch.zeros(bootstrap + 1, dtype=torch.float64)
    with seeded_evaluation(model, seed), progress_bar(progress) as bar:
        batches = some_of(model, batch, sequences)
        for data in bar.track(batches, description="scores of draws"):
            inferred = Inferred(model, data, guide, SCALED)
            u = inferred.whitened(inferred.drawn(draws))
            pairs = _stein(u, inferred.score(u))
            if not pairs.isfinite().all():
                raise FloatingPointError(
                    "the gradient of the log joint is not finite at a draw of the guide; check whether the model has "
                    "been fitted to data of this scale"
                )
            signs = 2.0 * torch.randint(2, (bootstrap + 1, draws)).to(pairs) - 1
            signs[0] = 1  # KSD^2 itself
            means = ((signs @ pairs) * signs).sum(1).cpu() / (draws * (draws - 1))
            results.append((float(means[0]), float(means.quantile(0.95)), _share(means), u.shape[1]))
            total += means
    squared, critical, p_values, numbers = map(np.array, zip(*results, strict=True))
    equations = {"generative": model.generative.text} | ({} if guide else {"inference": model.inference.text})
    indices = tuple(range(len(batches)) if sequences is None else sequences)
    tests = squared, critical, p_values, _share(total), numbers
    return SteinDiscrepancy(*tests, indices, draws, bootstrap, seed, equations)


def _share(means: Tensor) -> float:
    """Return the share of values, including the first, that are not below the first."""
    return float((means >= means[0]).double().mean())


def _stein(u: Tensor, score: Tensor) -> Tensor:
    """Return h (K, K) of all pairs of draws u (K, P) with scores (K, P), 0 on the diagonal."""
    u, score = u.double(), score.double()
    width = 2 * u.shape[1]
    base = 1 / (1 + torch.cdist(u, u).square() / width)
    kernel = base.sqrt()
    along = score @ u.T  # s(u)'v
    toward = along.diagonal()[:, None] - along  # s(u)'(u - v)
    slope = kernel * base / width  # dk/dv = slope (u - v) and dk/du = -slope (u - v)
    trace = slope * u.shape[1] - 3 * (slope * base) * torch.cdist(u, u).square() / width
    return (score @ score.T * kernel + slope * (toward + toward.T) + trace).fill_diagonal_(0.0)
