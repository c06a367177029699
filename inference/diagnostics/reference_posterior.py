"""Comparison of a guide with a reference posterior, which is exact or sampled by NUTS.

    q(z | x)   versus   p(z | x) ~ p(x, z):   means, standard deviations, correlations, each with its Monte Carlo error

The posterior of a linear-Gaussian model is known (`dvae.Oracle`). For any other model, Pyro's NUTS (Hoffman and Gelman,
2014, arXiv 1111.4246) samples it, in units of the guide's standard deviations. The chains of a sequence run as one
chain on the product of copies of its posterior. A step of all chains is then one evaluation of the model, whose cost
hardly depends on the number of rows. The chains share step sizes and trees, but not momenta or starts. Every other
chain starts at a draw from the prior, so that R-hat reveals a mode that the guide does not cover.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, partial
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from pyro.infer.mcmc import MCMC, NUTS
from rich.console import Group
from torch import Tensor
from typing_extensions import override

from ...program.batch import AnyBatch
from ...program.model import DynamicalVAE
from ...program.oracle import Oracle
from ..evaluation.evaluation_windows import seeded_evaluation
from ..evaluation.record import Dims
from ..evaluation.result import Result, Table, new_figure, progress_bar, styled
from .latents import Inferred, Shapes, quantities, some_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RHAT, EFFECTIVE = 1.01, 100
"""Criteria of convergence: largest R-hat, and smallest effective sample size per chain (Vehtari et al., 2021).

See arXiv 1903.08008.
"""

_MOST = 2**22  # largest number of correlations; a file contains twice as many


@dataclass(frozen=True, eq=False)
class LatentMoments:
    """Moments of the latents of S sequences with Q numbers each; NaN at padding.

    Args:
        mean, deviation: mean and standard deviation, (S, Q).
        correlation: correlations (S, Q, Q).
        mean_error, deviation_error: Monte Carlo standard errors (S, Q); 0 if exact.
    """

    mean: Annotated[np.ndarray, Dims("sequence", "quantity")]
    deviation: Annotated[np.ndarray, Dims("sequence", "quantity")]
    correlation: Annotated[np.ndarray, Dims("sequence", "quantity", "other quantity")]
    mean_error: Annotated[np.ndarray, Dims("sequence", "quantity")]
    deviation_error: Annotated[np.ndarray, Dims("sequence", "quantity")]

    @property
    def correlation_error(self) -> np.ndarray:
        """Monte Carlo standard error of correlations, (S, Q, Q).

        It is (1 - r^2) / sqrt(n) as for a normal distribution, with n effective draws from the error of the deviations.
        """
        spread = np.sqrt(2) * self.deviation_error / self.deviation
        return (1 - self.correlation**2) * np.maximum(spread[:, :, None], spread[:, None, :])  # type: ignore[no-any-return]


@dataclass(frozen=True, eq=False)
class Sampling:
    """Convergence statistics of NUTS on S sequences.

    Args:
        rhat: rank-normalised R-hat, (S, Q); NaN at padding.
        effective: effective draws of the bulk, (S, Q).
        divergences: number of divergent transitions after the warm-up, (S,).
        evaluations: number of gradients of the model, each of all chains of a sequence, (S,).
        chains, draws, warmup: number of chains per sequence, of draws per chain, and of warm-up steps per chain.
    """

    rhat: Annotated[np.ndarray, Dims("sequence", "quantity")]
    effective: Annotated[np.ndarray, Dims("sequence", "quantity")]
    divergences: Annotated[np.ndarray, Dims("sequence", kind=int)]
    evaluations: Annotated[np.ndarray, Dims("sequence", kind=int)]
    chains: int
    draws: int
    warmup: int

    @property
    def converged(self) -> np.ndarray:
        """Whether R-hat is at most 1.01, and the effective draws at least 100 for each chain, (S,)."""
        return (np.nanmax(self.rhat, 1) <= RHAT) & (np.nanmin(self.effective, 1) >= EFFECTIVE * self.chains)  # type: ignore[no-any-return]

    @property
    def verdict(self) -> str:
        """Convergence of the reference in one sentence."""
        numbers = f"R-hat up to {np.nanmax(self.rhat):.3f}, effective draws from {np.nanmin(self.effective):.0f}"
        count = int(self.divergences.sum())
        narrow = f"; {count} divergences: it may have missed narrow regions of the posterior" if count else ""
        if self.converged.all():
            return f"the reference is by NUTS, which converged ({numbers}){narrow}"
        failed = f"{(~self.converged).sum()} of {len(self.converged)} sequences"
        return (
            f"the reference did not converge for {failed} ({numbers}){narrow}. Use more draws and warm-up "
            "before you interpret the comparison"
        )


@dataclass(frozen=True, eq=False, repr=False)
class ReferencePosterior(Result):
    """Comparison of a guide with the posterior, on some sequences.

    Attributes:
        guide, reference: moments of the latents.
        shapes: number of steps (0 if static) and dimension of each latent.
        names: names of the Q numbers: "w[0]", "z_3[1]" (step from 1, coordinate from 0).
        sequences: indices of the sequences in the batch.
        sampling: convergence of the reference; None if it is exact.
        guide_draws: K, number of draws for the guide's moments.
        seed: seed of all draws.
        equations: equations of model and guide; without the guide's if it is a custom program.
    """

    guide: LatentMoments
    reference: LatentMoments
    shapes: Shapes
    names: tuple[str, ...]
    sequences: tuple[int, ...]
    sampling: Sampling | None
    guide_draws: int
    seed: int
    equations: dict[str, str]

    @property
    def exact(self) -> bool:
        """Whether the reference is a closed form."""
        return self.sampling is None

    @property
    def bias(self) -> np.ndarray:
        """Difference of the means of guide and reference, in standard deviations of the reference, (S, Q)."""
        return (self.guide.mean - self.reference.mean) / self.reference.deviation  # type: ignore[no-any-return]

    @property
    def bias_error(self) -> np.ndarray:
        """Monte Carlo standard error of `bias`, (S, Q)."""
        return np.hypot(self.guide.mean_error, self.reference.mean_error) / self.reference.deviation  # type: ignore[no-any-return]

    @property
    def ratio(self) -> np.ndarray:
        """Ratio of the standard deviations of guide and reference, (S, Q); below 1: too narrow."""
        return self.guide.deviation / self.reference.deviation  # type: ignore[no-any-return]

    @property
    def ratio_error(self) -> np.ndarray:
        """Monte Carlo standard error of `ratio`, (S, Q)."""
        each = (part.deviation_error / part.deviation for part in (self.guide, self.reference))
        return self.ratio * np.hypot(*each)  # type: ignore[no-any-return]

    @property
    def correlation_difference(self) -> np.ndarray:
        """Difference of the correlations of reference and guide, (S, Q, Q)."""
        return self.reference.correlation - self.guide.correlation  # type: ignore[no-any-return]

    @property
    def correlation_difference_error(self) -> np.ndarray:
        """Monte Carlo standard error of `correlation_difference`, (S, Q, Q)."""
        return np.hypot(self.guide.correlation_error, self.reference.correlation_error)  # type: ignore[no-any-return]

    @property
    def pairs(self) -> dict[str, np.ndarray]:
        """Masks (Q, Q) of pairs of numbers by kind, such as "z, between steps" or "w with z"; each pair occurs once."""
        latent, step, _ = self._places
        valid, same_step = (
            np.isfinite(self.correlation_difference).any(0) & np.tri(len(latent), k=-1, dtype=bool).T,
            np.equal.outer(step, step),
        )
        masks = {}
        for (one, name), (other, after) in combinations_with_replacement(enumerate(self.shapes), 2):
            both = valid & np.logical_and.outer(latent == one, latent == other)
            if one < other:
                masks[f"{name} with {after}"] = both
            elif self.shapes[name][0]:
                masks |= {f"{name}, within steps": both & same_step, f"{name}, between steps": both & ~same_step}
            else:
                masks[name] = both
        return {kind: mask for kind, mask in masks.items() if mask.any()}

    @property
    def verdict(self) -> str:
        """Quality of the reference in one sentence."""
        return (
            "the reference is exact, because the model is linear-Gaussian"
            if self.sampling is None
            else self.sampling.verdict
        )

    def table(self) -> Group:
        """Return tables of bias and deviations by latent, correlations by kind of pair, and convergence."""
        guide = self.equations.get("inference", "custom guide")
        title = f"{guide} compared with the posterior of {len(self.sequences)} sequences"
        moments = Table(
            title=title, caption="bias in standard deviations of the reference; noise: its Monte Carlo error"
        )
        for column in ("latent", "bias (rms)", "noise (rms)", "largest bias", "number", "deviation / reference"):
            moments.add_column(column, justify="left" if column in ("latent", "number") else "right", no_wrap=True)
        for place, name in enumerate(self.shapes):
            mask = self._places[0] == place
            bias, ratio = np.where(mask, self.bias, np.nan), np.log(self.ratio[:, mask])
            worst = np.unravel_index(np.nanargmax(abs(bias)), bias.shape)
            least, mean, most = (f"{np.exp(reduce(ratio)):.2f}" for reduce in (np.nanmin, np.nanmean, np.nanmax))
            numbers = f"{_rms(bias):.3f}", f"{_rms(self.bias_error[:, mask]):.3f}", f"{bias[worst]:+.2f}"
            moments.add_row(name, *numbers, self._label(*map(int, worst)), f"{mean} ({least} to {most})")
        correlations = Table(title="correlations", caption=self.verdict)
        for column in (
            "correlations",
            "pairs",
            "reference (rms)",
            "guide (rms)",
            "largest difference",
            "reference",
            "guide",
        ):
            correlations.add_column(
                column, justify="left" if column in ("correlations", "largest difference") else "right", no_wrap=True
            )
        for kind, pairs in self.pairs.items():
            lack = np.where(pairs, abs(self.correlation_difference), np.nan)
            sequence, one, other = np.unravel_index(np.nanargmax(lack), lack.shape)
            both = [part.correlation for part in (self.reference, self.guide)]
            error = self.reference.correlation_error[sequence, one, other]
            correlations.add_row(
                kind,
                str(pairs.sum()),
                *(f"{_rms(each[:, pairs]):.2f}" for each in both),
                f"{self.names[one]}, {self._label(int(sequence), int(other))}",
                f"{both[0][sequence, one, other]:+.2f}" + ("" if self.exact else f" ± {error:.2f}"),
                f"{both[1][sequence, one, other]:+.2f}",
            )
        return Group(moments, correlations, *([] if self.sampling is None else [self._convergence(self.sampling)]))

    def _convergence(self, sampling: Sampling) -> Table:
        title = f"NUTS: {sampling.chains} chains of {sampling.draws} draws after {sampling.warmup} of warm-up"
        table = Table(title=title)
        for column in ("sequence", "R-hat", "at", "effective draws", "divergences", "evaluations"):
            table.add_column(column, justify="left" if column == "at" else "right", no_wrap=True)
        for place, sequence in enumerate(self.sequences):
            worst = int(np.nanargmax(sampling.rhat[place]))
            numbers = (
                f"{np.nanmin(sampling.effective[place]):.0f}",
                sampling.divergences[place],
                sampling.evaluations[place],
            )
            table.add_row(str(sequence), f"{sampling.rhat[place, worst]:.3f}", self.names[worst], *map(str, numbers))
        return table

    @styled
    def plot(self, sequence: int = 0, panels: int = 4) -> Figure:
        """Draw means with bands of two standard deviations, deviations of all numbers, and correlations.

        Bands are for the coordinates where guide and reference differ most, by bias and log ratio together.

        Args:
            sequence: index in `sequences`, for bands and correlations.
            panels: number of coordinates with bands.
        """
        latent, step, coordinate = self._places
        difference = self.bias[sequence] ** 2 + 2 * np.log(self.ratio[sequence]) ** 2
        rows: dict[tuple[str, str], np.ndarray] = {}
        for place, (name, (steps, size)) in enumerate(self.shapes.items()):
            mask = latent == place
            rows |= (
                {(name, f"{name}[{d}]"): mask & (coordinate == d) for d in range(size)}
                if steps
                else {(name, name): mask}
            )
        worst = sorted(rows.items(), key=lambda row: -float(np.nanmean(difference[row[1]])))[:panels]
        figure = new_figure(7, 5.4)
        top, bottom = figure.subfigures(2, 1, squeeze=False)[:, 0]
        for panel, ((name, title), numbers) in zip(top.subplots(1, len(worst), squeeze=False)[0], worst, strict=True):
            local = self.shapes[name][0] > 0
            across = (step if local else coordinate)[numbers]
            for part, colour, called in ((self.reference, "0.35", "reference"), (self.guide, "C0", "guide")):
                mean, deviation = part.mean[sequence, numbers], part.deviation[sequence, numbers]
                if local:
                    panel.fill_between(
                        across, mean - 2 * deviation, mean + 2 * deviation, color=colour, alpha=0.25, lw=0
                    )
                    panel.plot(across, mean, color=colour, label=called)
                else:
                    panel.errorbar(
                        across + 0.2 * (called == "guide"), mean, 2 * deviation, fmt="o", color=colour, label=called
                    )
            panel.set_title(title, parse_math=False)
            panel.set_xlabel("step" if local else "coordinate")
            panel.set_xlim(across[0] - 0.5, across[-1] + 0.5)
            panel.xaxis.get_major_locator().set_params(integer=True)
        top.axes[0].legend()
        scatter, *images = bottom.subplots(1, 3)
        for place, name in enumerate(self.shapes):
            mask = latent == place
            scatter.plot(
                self.reference.deviation[:, mask].ravel(), self.guide.deviation[:, mask].ravel(), ".", label=name
            )
        ends = [f(part.deviation) for f, part in ((np.nanmin, self.reference), (np.nanmax, self.reference))]
        scatter.plot(ends, ends, color="0.4", linewidth=0.8)
        scatter.set_xlabel("deviation, reference")
        scatter.set_ylabel("deviation, guide")
        scatter.legend()
        for panel, part, called in zip(images, (self.reference, self.guide), ("reference", "guide"), strict=True):
            image = panel.imshow(part.correlation[sequence], cmap="RdBu_r", vmin=-1, vmax=1, interpolation="nearest")
            panel.set_title(f"correlations, {called}")
        figure.colorbar(image, ax=images, shrink=0.8)
        title = f"sequence {self.sequences[sequence]} · {self.equations.get('inference', 'custom guide')}"
        figure.suptitle(f"{title}\n{self.verdict}", parse_math=False)
        return figure

    @override
    def summary(self) -> dict[str, Any]:
        return {"verdict": self.verdict}

    @override
    def labels(self) -> dict[str, Sequence[str]]:
        return {"sequence": [*map(str, self.sequences)], "quantity": self.names}

    @override
    def check(self) -> None:
        count = sum(max(steps, 1) * size for steps, size in self.shapes.values())
        if count != len(self.names) or min(count, len(self.sequences)) < 1 or min(map(min, self.shapes.values())) < 0:
            raise ValueError(
                f"expected at least one sequence, and a name for each of {count} numbers; got {len(self.sequences)} "
                f"sequences and {len(self.names)} names"
            )
        expected = {"sequence": {len(self.sequences)}, "quantity": {count}, "other quantity": {count}}
        if self.extents != expected:
            raise ValueError(f"expected arrays of {expected}, got {self.extents}")

    @cached_property
    def _places(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Index of the latent, step from 1 (0 if static) and coordinate of each number, (Q,) each."""
        places = [
            (place, t, d)
            for place, (steps, size) in enumerate(self.shapes.values())
            for t in (range(1, steps + 1) if steps else [0])
            for d in range(size)
        ]
        latent, step, coordinate = np.array(places).T
        return latent, step, coordinate

    def _label(self, sequence: int, number: int) -> str:
        many = len(self.sequences) > 1
        return f"{self.names[number]} of {self.sequences[sequence]}" if many else self.names[number]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


@torch.inference_mode(False)
def reference_posterior(
    model: DynamicalVAE,
    batch: AnyBatch,
    sequences: Sequence[int] | None = None,
    *,
    guide: Callable[..., Any] | None = None,
    draws: int = 1000,
    chains: int = 4,
    warmup: int = 500,
    guide_draws: int = 4000,
    seed: int = 0,
    progress: bool = True,
) -> ReferencePosterior:
    """Compare a guide with the posterior of the latents of some sequences.

    The posterior of a linear-Gaussian model is exact. For any other model it is sampled by NUTS, which is slow: see
    docs/how-to/calibrate.md for the cost. The result reports whether sampling has converged.

    Args:
        model: generative model; its own guide is tested by default.
        batch: batch as in `DynamicalVAE.model`, which may be ragged or have missing entries and context.
        sequences: indices of sequences in the batch, from 0; all by default.
        guide: Pyro program of the batch, with a site (B, T, D) or (B, D) for every latent.
        draws, chains, warmup: number of draws per chain, chains per sequence and warm-up steps per chain, of NUTS.
        guide_draws: number of draws for the guide's moments.
        seed: seed of all draws.
        progress: whether to show a progress bar.

    Returns:
        Moments of each latent value under the guide and under the posterior, and the convergence of sampling.

    Raises:
        ValueError: when the model has no latents or likelihood, or a latent is shared by sequences or cannot take every
            real value. Also when a sequence is not in the batch, data are missing, or a number is too small.
        FloatingPointError: when the log joint is not finite at the start of a chain.

    Example:
        >>> pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})"
        >>> model = dvae.linear_gaussian_surrogate(*pair, {"z": 1, "x": 2}, 4)
        >>> result = dvae.reference_posterior(model, model.sample(3, 4)["x"], sequences=[0, 2])
        >>> result.exact, result.bias.shape, result.correlation_difference.shape
        (True, (2, 4), (2, 4, 4))
    """
    if min(draws, guide_draws) < 4 or chains < 2 or warmup < 1:  # arviz needs as many for R-hat
        raise ValueError(
            f"draws and guide_draws must be at least 4, chains at least 2 and warmup at least 1; got draws={draws}, "
            f"guide_draws={guide_draws}, chains={chains} and warmup={warmup}"
        )
    with seeded_evaluation(model, seed), progress_bar(progress) as bar:
        batches = some_of(model, batch, sequences)
        guides, references, diagnostics = [], [], []
        task = bar.add_task("drawing from posteriors", total=len(batches) * (warmup + draws))
        for data in batches:
            inferred = Inferred(model, data, guide, guide_draws)
            if len(batches) * len(inferred.valid) ** 2 > _MOST:
                raise ValueError(
                    f"{len(batches)} sequences with {len(inferred.valid)} latent numbers have more than {_MOST} "
                    "correlations; use fewer sequences, or only their first steps"
                )
            guides.append(_moments(inferred, inferred.draws[None]))
            if (exact := _exact(model, data, inferred)) is not None:
                references.append(exact)
                continue
            nuts_draws, divergences, evaluations = _nuts(inferred, draws, chains, warmup, partial(bar.advance, task))
            references.append(_moments(inferred, nuts_draws))
            measured = (inferred.whole(torch.as_tensor(each)).numpy() for each in diagnose(nuts_draws))
            diagnostics.append((*measured, divergences, evaluations))
    sampling = None
    if diagnostics:
        rhat, effective, diverged, evaluated = map(np.array, zip(*diagnostics, strict=True))
        sampling = Sampling(rhat, effective, diverged, evaluated, chains, draws, warmup)
    steps = max(steps for steps, _ in inferred.shapes.values())
    return ReferencePosterior(
        _stack(guides),
        _stack(references),
        inferred.shapes,
        quantities(model, range(1, steps + 1)),
        tuple(range(len(batches)) if sequences is None else sequences),
        sampling,
        guide_draws,
        seed,
        {"generative": model.generative.text} | ({} if guide else {"inference": model.inference.text}),
    )


def _exact(model: DynamicalVAE, data: Mapping[str, Any], inferred: Inferred) -> LatentMoments | None:
    """Return the moments of a linear-Gaussian model, NaN at padding; None for any other model."""
    try:
        mean, covariance = Oracle(model, max(steps for steps, _ in inferred.shapes.values())).posterior(data)
    except ValueError:  # not linear-Gaussian, or with context
        return None
    mean, covariance = mean[0, inferred.valid], covariance.reshape(len(mean.t()), -1)[inferred.valid][:, inferred.valid]
    deviation = covariance.diagonal().sqrt()
    correlation = inferred.whole(inferred.whole(covariance / torch.outer(deviation, deviation)).T)
    mean, deviation, zero = map(inferred.whole, (mean, deviation, torch.zeros_like(deviation)))
    moments = (mean, deviation, correlation, zero, zero)
    return LatentMoments(*(each.detach().double().cpu().numpy() for each in moments))


def _nuts(
    inferred: Inferred, draws: int, chains: int, warmup: int, advance: Callable[[], object]
) -> tuple[Tensor, int, int]:
    """Return draws z (C, N, P) of the posterior, and the numbers of divergent transitions and of evaluations."""
    start = inferred.drawn(chains)
    start[1::2] = inferred.prior(chains)[1::2]
    start = inferred.whitened(start)
    for kind, log_joint in zip(
        ("guide", "prior"), (inferred.log_joint(start)[first::2] for first in (0, 1)), strict=True
    ):
        if not log_joint.isfinite().all():
            raise FloatingPointError(
                f"the log joint is not finite at a draw from the {kind}, where NUTS starts; check whether the model "
                "has been fitted to data of this scale"
            )
    evaluations = 0

    def energy(values: Mapping[str, Tensor]) -> Tensor:
        nonlocal evaluations
        evaluations += 1
        return -inferred.log_joint(values["u"].unflatten(0, start.shape)).double().sum()

    kernel = NUTS(potential_fn=energy)
    initial = {"u": start.flatten()}
    run = MCMC(kernel, draws, warmup, initial, hook_fn=lambda *_: advance(), disable_progbar=True)
    with torch.enable_grad():
        run.run()
    u = run.get_samples()["u"].unflatten(1, start.shape).transpose(0, 1)
    return inferred.center + inferred.scale * u, len(run.diagnostics()["divergences"]["chain 0"]), evaluations


def _moments(inferred: Inferred, draws: Tensor) -> LatentMoments:
    """Return moments of draws (C, N, P), with errors from their effective number."""
    from arviz_stats.base import array_stats  # the import takes over a second

    values = draws.double().cpu()
    flat = values.flatten(0, 1)
    deviation = flat.std(0)
    unit = (flat - flat.mean(0)) / deviation.clamp(min=1e-12)
    # Errors of deviations use the effective number of squares, because means have a larger one: NUTS alternates sides.
    squares = (values - flat.mean(0)).square() / (2 * deviation.clamp(min=1e-12))
    with np.errstate(invalid="ignore"):  # the error of constant chains is NaN
        errors = [array_stats.mcse(each.numpy(), chain_axis=0, draw_axis=1) for each in (values, squares)]
    across = inferred.whole(inferred.whole(unit.T @ unit / (len(flat) - 1)).T)
    parts = flat.mean(0), deviation, *map(torch.as_tensor, errors)
    mean, spread, *within = (inferred.whole(each).numpy() for each in parts)
    return LatentMoments(mean, spread, across.numpy(), *within)


def diagnose(draws: Tensor) -> Iterator[np.ndarray]:
    """Yield R-hat and effective draws of the bulk (P,) of draws (C, N, P); 1000 and 0 for constant chains."""
    from arviz_stats.base import array_stats

    for measure in (array_stats.rhat, array_stats.ess):
        with np.errstate(divide="ignore", invalid="ignore"):
            values = measure(draws.double().cpu().numpy(), chain_axis=0, draw_axis=1)
        fallback = 1000.0 if measure is array_stats.rhat else 0.0
        yield np.nan_to_num(values, nan=fallback, posinf=fallback)


def _stack(parts: Sequence[LatentMoments]) -> LatentMoments:
    return LatentMoments(
        **{field.name: np.stack([getattr(part, field.name) for part in parts]) for field in fields(LatentMoments)}
    )
