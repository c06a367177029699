"""Predictive checks: do replicated sequences look like real ones?

`predictive_checks` compares statistics of real windows, forecasts and draws from the posterior predictive distribution
(Gelman, Meng and Stern, 1996). `STATISTICS` lists statistics for any sequences, and `default_statistics` returns them
in the unit of the data.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import scipy
import torch
from rich.text import Text
from torch import Tensor
from typing_extensions import override

from ...data.batch import Batch
from ...data.sequences import HeldOutWindows, axis_names, columns_of, mean_of_known, scales_of
from ...program.batch import repeat
from ...program.model import DynamicalVAE
from ..bounds.elbo import require_likelihood
from ..evaluation.evaluation_windows import on_device_of, prepare_windows, seeded_evaluation
from ..evaluation.record import MODELS, Dims, plain
from ..evaluation.result import Result, Table, literal_text, new_figure, progress_bar, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Statistic:
    """Statistic of a sequence.

    Args:
        function: function from x (..., T, D) to (...). Missing entries of x are NaN, in real windows and in their
            replicates.
        unit: unit of the statistic.
        note: line printed below the table.
    """

    function: Callable[[Tensor], Tensor]
    unit: str = ""
    note: str = ""


def variance(x: Tensor) -> Tensor:
    """Return the variance over time, (..., D), of x (..., T, D), ignoring NaN."""
    if not x.isnan().any():
        return x.var(-2, correction=0)
    return mean_of_known((x - mean_of_known(x, -2).unsqueeze(-2)).square(), -2)


def _scale(x: Tensor) -> Tensor:
    return mean_of_known(variance(x), -1).sqrt()


def _roughness(x: Tensor) -> Tensor:
    return mean_of_known(x.diff(dim=-2).square(), (-2, -1)).sqrt()


def _correlation_length(x: Tensor) -> Tensor:
    length = x.shape[-2]
    is_constant = (x == x[..., :1, :]) | x.isnan()  # whose mean rounding errors may shift
    centred = torch.where(is_constant.all(-2, keepdim=True), 0.0, x - mean_of_known(x, -2).unsqueeze(-2))
    products = (centred[..., lag:, :] * centred[..., : length - lag, :] for lag in range(length))
    lags = [(1 - lag / length) * mean_of_known(product, (-2, -1)) for lag, product in enumerate(products)]
    below = torch.stack(lags, -1) < lags[0][..., None] / math.e
    return torch.where(below.any(-1), below.double().argmax(-1), length).double()


def _persistence(x: Tensor) -> Tensor:
    centred = x - mean_of_known(x, -2).unsqueeze(-2)
    power = mean_of_known(centred.square(), (-2, -1))
    return torch.where(power == 0, 1.0, mean_of_known(centred[..., 1:, :] * centred[..., :-1, :], (-2, -1)) / power)


def _zeros(x: Tensor) -> Tensor:
    return mean_of_known(torch.where(x.isnan(), torch.nan, (x == 0).to(x)), (-2, -1))


def _smallest(x: Tensor) -> Tensor:
    return x.where(~x.isnan(), torch.inf).amin((-2, -1))


STATISTICS = {
    "mean": Statistic(lambda x: mean_of_known(x, (-2, -1))),
    "scale": Statistic(_scale),
    "roughness": Statistic(_roughness),
    "correlation length": Statistic(_correlation_length, "steps"),
    "lag-1 correlation": Statistic(_persistence),
    "zeros": Statistic(_zeros, "share"),
    "smallest": Statistic(_smallest),
    "largest": Statistic(lambda x: -_smallest(-x)),
}
"""Statistics for any sequences, of observed numbers:

"mean": mean of all numbers. "scale": standard deviation over time. "roughness": root mean square difference of
successive steps. Both are root mean squares over coordinates. "correlation length": lag at which the autocorrelation,
pooled over coordinates, falls below 1/e, or T if it never does. "lag-1 correlation": autocorrelation at a lag of 1, and
1 for a constant sequence. For counts or positive data, "zeros" is the share of zeros, and "smallest" and "largest" are
the extremes.
"""
_OF_DATA = ("mean", "scale", "roughness", "smallest", "largest")
"""Names of statistics in the unit of the data."""


def default_statistics(windows: HeldOutWindows) -> dict[str, Statistic]:
    """Return `STATISTICS` of all columns together, with units as for the scores of `scores.proper`.

    If the windows name columns that share a unit, statistics are in this unit. If the windows define the scales of
    columns, statistics are of scaled numbers without a unit.
    """
    units = dict.fromkeys(columns_of(windows).values())
    if scales := scales_of(windows):
        unit, note = (
            "scales",
            "scales: statistics over all columns divide each column by its scale in the training data",
        )
    elif len(units) > 1:
        unit, note = "", f"statistics without a unit mix numbers in {', '.join(unit or '1' for unit in units)}"
    else:
        unit, note = next(iter(units), ""), ""
    return {
        name: replace(
            each,
            function=_in_scales(each.function, scales) if scales else each.function,
            unit=unit if name in _OF_DATA else each.unit,
            note=note,
        )
        for name, each in STATISTICS.items()
    }


def _in_scales(function: Callable[[Tensor], Tensor], scales: Sequence[float]) -> Callable[[Tensor], Tensor]:
    return lambda x: function(x / x.new_tensor(scales))


@dataclass(frozen=True, eq=False)
class Check:
    """One statistic of real and of replicated windows.

    Attributes:
        real: values (N,) of the windows where the statistic is defined.
        replicated: values (S, N) of replicates.
        unit: unit of both.
    """

    real: Annotated[np.ndarray, Dims("sequence", name="{0} {2} {1}")]
    replicated: Annotated[np.ndarray, Dims("replicate", "sequence", name="{0} {2} {1}")]
    unit: str

    @property
    def tail_areas(self) -> np.ndarray:
        """Bayesian p-value of each window, (N,): the share of its replicates that are larger, ties counting half."""
        larger, equal = self.replicated > self.real, self.replicated == self.real
        return (larger + 0.5 * equal).mean(0)

    @property
    def outside(self) -> float:
        """Share of windows whose tail area is below .05 or above .95."""
        return float(((self.tail_areas < 0.05) | (self.tail_areas > 0.95)).mean())

    @property
    def expected_outside(self) -> float:
        """Expected `outside` for the true model's forecasts without ties: ranks among S are uniform on 0..S."""
        samples = len(self.replicated)
        return 2 * -(-samples // 20) / (samples + 1)

    @property
    def wasserstein(self) -> float:
        """Wasserstein distance between the distributions of real and replicated values, in their unit."""
        return float(scipy.stats.wasserstein_distance(self.real, self.replicated.ravel()))


_SEAM = 2  # observed steps prepended to a forecast, so that statistics include a jump between them
PROGRAMS = {
    "forecast": "free-running given what was observed",
    "posterior": "free-running given latents inferred from the whole window",
}


@dataclass(frozen=True, eq=False, repr=False)
class PredictiveChecks(Result):
    """Statistics of replicated and of real windows.

    Attributes:
        models: `Check` by model, program and statistic; programs are "forecast" and, for a model with latents,
            "posterior".
        data: fingerprint, windows, steps, coordinates, and the windows' description.
        protocol: fields of the windows' protocol.
        samples: S, number of replicates of each window.
        emission: "mean" or "drawn".
        seed: seed of every model's draws.
        notes: lines below the table on how to read statistics.
    """

    models: Annotated[dict[str, dict[str, dict[str, Check]]], MODELS]
    data: dict[str, Any]
    protocol: dict[str, Any]
    samples: int
    emission: str
    seed: int
    notes: list[str] = field(default_factory=list)

    @cached_property
    def checks(self) -> dict[tuple[str, str, str], Check]:
        """Checks by (model, program, statistic)."""
        return {
            (model, program, name): check
            for model, programs in self.models.items()
            for program, checks in programs.items()
            for name, check in checks.items()
        }

    def __getitem__(self, key: tuple[str, str, str]) -> Check:
        if key not in self.checks:
            raise KeyError(f"no check {key}; there are {', '.join(map(str, self.checks))}")
        return self.checks[key]

    def table(self) -> Table:
        """Return a table of quantiles of real and replicated values, their distance, and tail areas of real values."""
        expected = next(iter(self.checks.values())).expected_outside
        models, programs, names = self._keys
        caption = [
            *(f"{program}: {PROGRAMS[program]}" for program in programs),
            "tail area: share of a window's replicates above the real value, mean over windows",
            "outside: share of windows with a tail area below .05 or above .95",
            f"forecasts of a true model have ½ and, with {self.samples} replicates, {expected:.1%}"
            if self.emission == "drawn"
            else f"means have no emission noise, so even a true model need not have ½ and {expected:.1%}",
            *self.notes,
        ]
        table = Table(title=self._title, caption="\n".join(caption))
        for column in ("statistic", "source", "5 %", "median", "95 %", "Wasserstein", "tail area", "outside"):
            table.add_column(column, justify="left" if column in ("statistic", "source") else "right", no_wrap=True)
        for program in programs:
            table.add_section()
            table.add_row(Text(program, "bold"))
            for name in names:
                first = self.checks[models[program][0], program, name]
                label = Text.assemble(name, (f" ({first.unit})" if first.unit else "", "dim"))
                table.add_row(label, "real", *_quantiles(first.real))
                for model in models[program]:
                    check = self.checks[model, program, name]
                    outcome = (f"{check.wasserstein:.3g}", f"{check.tail_areas.mean():.2f}", f"{check.outside:.0%}")
                    table.add_row("", model, *_quantiles(check.replicated), *outcome)
        return table

    @styled
    def plot(self) -> Figure:
        """Draw the density of each statistic: real windows in grey, replicates as one line per model."""
        models, programs, names = self._keys
        figure = new_figure(0.4 + 3.3 * len(programs), 0.8 + 1.3 * len(names))
        panels = figure.subplots(len(names), len(programs), squeeze=False, sharex="row")
        for row, name in enumerate(names):
            checks = [self.checks[model, program, name] for program in programs for model in models[program]]
            values = [array for check in checks for array in (check.real, check.replicated)]
            # outer bins also contain more extreme values, so that one replicate does not flatten the histogram
            low, high = np.quantile(np.stack([np.quantile(v, (0.005, 0.995)) for v in values]), (0, 1))
            edges = np.linspace(low, high if high > low else low + 1, 41)
            unit = f" ({checks[0].unit})" if checks[0].unit else ""
            for panel, program in zip(panels[row], programs, strict=True):
                real = self.checks[models[program][0], program, name].real
                panel.stairs(_density(real, edges), edges, fill=True, color="0.8", label="real")
                for place, model in enumerate(models["forecast"]):
                    if model not in models[program]:
                        continue
                    replicated = self.checks[model, program, name].replicated
                    panel.stairs(_density(replicated, edges), edges, color=f"C{place}", label=model, linewidth=1.3)
                panel.set_yticks([])
                panel.set_xlabel(name + unit, parse_math=False)
        for panel, program in zip(panels[0], programs, strict=True):
            panel.set_title(program)
        handles, labels = panels[0, 0].get_legend_handles_labels()
        legend = figure.legend(handles, labels, loc="outside lower center", ncols=min(4, len(labels)))
        literal_text(legend.get_texts())
        figure.suptitle(self._title, parse_math=False)
        return figure

    @override
    def summary(self) -> dict[str, Any]:
        """Return distances and tail areas by model, program and statistic."""
        result: dict[str, Any] = {}
        for (model, program, name), check in self.checks.items():
            result.setdefault(model, {}).setdefault(program, {})[name] = {
                "wasserstein": check.wasserstein,
                "tail_area": float(check.tail_areas.mean()),
                "outside": check.outside,
                "expected_outside": check.expected_outside,
            }
        return result

    @override
    def check(self) -> None:
        if not self.checks or {*self._keys[1]} - {*PROGRAMS}:
            given = ", ".join(dict.fromkeys(program for _, program, _ in self.checks)) or "none"
            raise ValueError(f"expected checks of the programs {', '.join(PROGRAMS)}; got {given}")
        for each in self.checks.values():
            if each.replicated.shape != (self.samples, len(each.real)) or not each.real.size:
                raise ValueError(f"expected {self.samples} replicates of every window")

    @property
    def _keys(self) -> tuple[dict[str, list[str]], list[str], list[str]]:
        """Models of each program, programs and statistics."""
        _, programs, names = (list(dict.fromkeys(keys)) for keys in zip(*self.checks, strict=True))
        models = {p: list(dict.fromkeys(model for model, program, _ in self.checks if program == p)) for p in programs}
        return models, programs, names

    @property
    def _title(self) -> str:
        parts = ["predictive checks", self.protocol.get("name", ""), f"{self.data['windows']} windows"]
        parts += [f"{self.samples} replicates", f"{self.emission} emission", f"data {self.data['fingerprint'][:12]}"]
        return " · ".join(part for part in parts if part)


def predictive_checks(
    model: DynamicalVAE | Mapping[str, DynamicalVAE],
    windows: HeldOutWindows,
    statistics: Mapping[str, Statistic] | None = None,
    *,
    samples: int = 20,
    draw_emission: bool = True,
    seed: int = 0,
    batch_size: int = 32,
    progress: bool = True,
) -> PredictiveChecks:
    """Replicate windows with one or several models, and compare statistics of real and replicated windows.

    There are two kinds of replicates, both free-running. "forecast": the steps after the observed ones. The last two
    observed steps are prepended, so that statistics include a jump between them. "posterior", the posterior predictive
    distribution: latents are inferred from the whole window, and all its steps are generated from them. A model
    without latents has no "posterior".

    Missing entries of a window are also missing in its replicates. A window with too few entries for a statistic is not
    counted.

    Args:
        model: a model, or `{name: model}`.
        windows: `ArrayWindows`, or any `HeldOutWindows`.
        statistics: `Statistic` by name, for example from an application; `default_statistics` by default.
        samples: S, number of replicates of each window; at least 19, so that tail areas below .05 have a probability of
            at most a tenth.
        draw_emission: whether replicates are draws of x. If False, they are its means, without emission noise; the
            check then assesses displayed forecasts rather than the model.
        seed: seed of every model's draws.
        batch_size: number of windows in a batch.
        progress: whether to show a progress bar.

    Returns:
        Statistics of real and replicated windows, by model, program and statistic.

    Raises:
        ValueError: when windows are ragged, there are too few samples, or a statistic has the wrong shape or is not
            finite on real windows.
        FloatingPointError: when a statistic is not finite on replicated windows.

    Example:
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2})
        >>> windows = dvae.ArrayWindows(torch.randn(6, 8, 2), observed=4)
        >>> checks = dvae.predictive_checks({"model": model}, windows, progress=False)
    """
    models = dict(model) if isinstance(model, Mapping) else {"model": model}
    if samples < 19 or batch_size < 1 or not models:
        raise ValueError(
            "expected at least one model, 19 samples (for tail areas below .05 to have a probability of at most a "
            f"tenth) and a batch_size of 1; got {len(models)}, {samples} and {batch_size}"
        )
    eval_windows = prepare_windows(windows)
    windows = eval_windows.windows
    statistics = default_statistics(windows) if statistics is None else statistics
    if not statistics:
        raise ValueError("expected at least one statistic to check, got none")
    for each in models.values():
        require_likelihood(each)
    truth = eval_windows.batch.mask_to_nan()
    _, step = axis_names(windows.description)
    firsts = {"forecast": eval_windows.observed - min(_SEAM, eval_windows.observed), "posterior": 0}
    checks: dict[str, dict[str, dict[str, Check]]] = {label: {} for label in models}
    with progress_bar(progress) as bar:
        for program, first in firsts.items():
            real = _measure(statistics, truth[:, first:], "real windows")
            defined = {name: values.isfinite() for name, values in real.items()}
            for label, each in models.items():
                if program == "posterior" and not each.latents:
                    continue  # nothing is inferred
                parts: list[dict[str, Tensor]] = []
                with seeded_evaluation(each, seed):
                    starts = range(0, len(eval_windows.x), batch_size)
                    for start in bar.track(starts, description=f"{label}, {program}"):
                        rows = slice(start, start + batch_size)
                        part = on_device_of(each, eval_windows.part(rows))
                        x = _REPLICATES[program](each, part, eval_windows.observed, samples, draw_emission).to(
                            eval_windows.x
                        )
                        x = x.masked_fill(truth[rows, first:].isnan(), torch.nan)
                        expected = {name: mask[rows] for name, mask in defined.items()}
                        parts.append(_measure(statistics, x, f"replicates of {label} ({program})", expected))
                for name, statistic in statistics.items():
                    values, replicated = real[name], torch.cat([part[name] for part in parts], 1)
                    mask = defined[name]
                    unit = statistic.unit.replace("step", step)
                    checks[label].setdefault(program, {})[name] = Check(
                        values[mask].numpy(), replicated[:, mask].numpy(), unit
                    )
    return PredictiveChecks(
        models=checks,
        data=eval_windows.description(),
        protocol=plain(asdict(windows.protocol)),
        samples=samples,
        emission="drawn" if draw_emission else "mean",
        seed=seed,
        notes=list(dict.fromkeys(each.note for each in statistics.values() if each.note)),
    )


def _forecast(model: DynamicalVAE, batch: Batch, observed: int, samples: int, draw_emission: bool) -> Tensor:
    """Return the last observed steps and the future, (S, B, seam + H, D)."""
    x = batch["x"]
    past, horizon = batch.past(observed), x.shape[1] - observed
    future = model.forecast(past, horizon, samples, draw_emission=draw_emission)["x"]
    return torch.cat([past["x"][None, :, -_SEAM:].expand(samples, -1, -1, -1), future], 2)


def _posterior(model: DynamicalVAE, batch: Batch, observed: int, samples: int, draw_emission: bool) -> Tensor:
    """Return windows generated from inferred latents, (S, B, T, D)."""
    repeated = repeat(batch, samples)
    return decode(model, repeated, model.guide(repeated), not draw_emission).unflatten(0, (samples, -1))


_REPLICATES = {"forecast": _forecast, "posterior": _posterior}


def _measure(
    statistics: Mapping[str, Statistic], x: Tensor, source: str, defined: Mapping[str, Tensor] | None = None
) -> dict[str, Tensor]:
    """Return statistics (..., N) by name; they must be finite where `defined` (N,) is True.

    Without `defined`, windows with missing entries may have NaN.
    """
    values = {}
    for name, statistic in statistics.items():
        values[name] = statistic.function(x).double().cpu()
        if values[name].shape != x.shape[:-2]:
            raise ValueError(
                f"the statistic {name} maps {tuple(x.shape)} to {tuple(values[name].shape)}; expected "
                f"{tuple(x.shape[:-2])}, one number for each sequence (..., T, D)"
            )
        undefined = values[name].isnan() & x.isnan().any(-1).any(-1) if defined is None else ~defined[name]
        if not (values[name].isfinite() | undefined).all() or (defined is None and undefined.all()):
            error = ValueError if defined is None else FloatingPointError
            raise error(f"the statistic {name} is not finite on {source} of {x.shape[-2]} steps")
    return values


def decode(
    model: DynamicalVAE, batch: Mapping[str, Tensor], latents: Mapping[str, Tensor], mean_emission: bool
) -> Tensor:
    """Return x (B, T, D) of a free run given context and latents, in data space instead of the model's view.

    Args:
        model: model to run.
        batch: batch with x, which determines B and T, and context. First steps of x that are context are kept.
        latents: values of latents by name; all others are drawn from the model.
        mean_emission: whether x are means of the emission instead of draws.
    """
    data = model.read(batch)
    context = {name: value for name, value in data.items() if name in model.context}
    length, size = data.get("x", batch["x"]).shape[1], len(batch["x"])
    decoded = model.model({**context, **latents}, length=length, size=size, mean_emission=mean_emission)
    x = model.to_data_space({name: decoded[name] for name in model.observed}, data)["x"]
    before = batch["x"].shape[1] - length
    return torch.cat([batch["x"][:, :before], x], 1) if before else x


def _quantiles(values: np.ndarray) -> list[str]:
    return [f"{value:.3g}" for value in np.quantile(values, (0.05, 0.5, 0.95))]


def _density(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    counts = np.histogram(values.clip(edges[0], edges[-1]), edges)[0]
    return counts / (values.size * np.diff(edges))
