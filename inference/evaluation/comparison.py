"""Comparisons: several models on the same sequences, with errors over sequences and seeds (`.estimates`)."""

from __future__ import annotations

import dataclasses
import json
import math
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from inspect import signature
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from rich.console import Group
from typing_extensions import override

from ...data.sequences import axis_names
from ...options import nearest
from ..bounds.elbo import KHAT_PARTICLES
from ..bounds.leave_future_out import EFFECTIVE, REPLICATES
from .estimates import Estimate, TwoWayErrors, number
from .evaluation import ARROWS
from .evaluation_windows import cluster_index
from .multiple_comparisons import ConfidenceSet, Pairs, Requirement, confidence_set, pairs, required
from .record import MODELS, Dims
from .result import Result, Table, literal_text, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ACTIVE = 0.01
"""Variance over the data above which the posterior mean of a latent's coordinate counts as active (Burda et al.)."""

ACROSS = 6
"""Largest number of scores in columns; more are shown in rows."""

KHAT = 0.7
"""Pareto shape above which an IWAE bound is unreliable (Vehtari et al.)."""

DIAGNOSTICS = ("k-hat", "LFO error", "LFO particles")
"""Names of the diagnostics among the bounds."""

_LOO_DRAWS = 25  # arviz_stats fits a Pareto tail to a fifth of the draws, and needs five


@dataclass(frozen=True, eq=False)
class ModelResult:
    """Scores of one model, for S seeds, N sequences in C clusters, T steps.

    Args:
        equations: "generative" and "inference".
        config: configuration given by the caller.
        bounds: (S, N) each: "ELBO", "IWAE bound", "k-hat", "KL z" for every latent z, and "FIVO bound" and "LFO" if
            computed, in nats per sequence. "LFO error" is the Monte Carlo error of "LFO", "LFO particles" their
            effective sample size.
        kl_steps: mean KL over sequences by step, in nats, (S, T), of each local latent.
        variances: variance over the data of each coordinate's posterior mean, (S, D), of each latent.
        information: information of each latent, (S, T) in nats per step, or (S, 1) in nats per sequence if static.
        estimates: independent IWAE bounds in nats per sequence, (E, N), each the mean over seeds.
        free_running: mean of each metric over the windows of each cluster, (S, C).
        notes: requested scores that are not available, with reasons.
    """

    equations: dict[str, str]
    config: dict[str, Any]
    bounds: Annotated[dict[str, np.ndarray], Dims("seed", "sequence", name="{}")]
    kl_steps: Annotated[dict[str, np.ndarray], Dims("seed", "step", name="KL {} by step")]
    variances: Annotated[dict[str, np.ndarray], Dims("seed", "column", name="variance of mean {}")]
    information: Annotated[dict[str, np.ndarray], Dims("seed", "step", name="information of {}")]
    estimates: Annotated[np.ndarray, Dims("estimate", "sequence", name="estimates")]
    free_running: Annotated[dict[str, np.ndarray], Dims("seed", "cluster", name="{}")]
    notes: list[str] = field(default_factory=list)

    @property
    def seeds(self) -> int:
        """Number of seeds S."""
        return len(self.bounds["ELBO"])

    @property
    def latents(self) -> list[str]:
        """Names of the latents."""
        return list(self.variances)

    @property
    def active_units(self) -> dict[str, np.ndarray]:
        """Number of coordinates with a varying posterior mean, (S,), of each latent; NaN for one sequence."""
        return {
            name: np.where(np.isnan(variance).any(-1), math.nan, (variance > ACTIVE).sum(-1))
            for name, variance in self.variances.items()
        }

    @property
    def unreliable(self) -> float:
        """Share of sequences whose k-hat is above 0.7; NaN if it was not estimated."""
        khat = self.bounds["k-hat"]
        return float((khat > KHAT)[~np.isnan(khat)].mean()) if not np.isnan(khat).all() else math.nan


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Result):
    """Scores of several models on the same sequences, with the settings of the measurement.

    Indexing returns the estimates of a model: `comparison["srnn"]["IWAE bound"].mean`, in nats per step.

    Attributes:
        rows: `{name: ModelResult}`.
        keys: (split, cluster, first step) of every sequence.
        n_steps: number of steps of every sequence, (N,).
        data: fingerprint (of windows), sequences, steps and coordinates.
        protocol: fields of the windows' protocol; empty for tensors.
        particles: K of the IWAE bound.
        contrasts: M, number of sequences among which information was measured; its upper limit is log M.
        samples: number of forecasts per window, 0 without free-running scores.
        emission: "mean" or "drawn": kind of forecasts.
        seed: seed of every model's draws.
        shown: unit of each free-running score in the table.
        notes: lines below that table: how to read scores, or why they are missing.
        better: "lower", "higher" or "" for each score of forecasts.
        filter_particles: K of the FIVO bound; 0 if it was not computed.
        leave_future_out: (L, M), numbers of observed and of forecast steps of "LFO"; empty if it was not computed.
        n_forecast: number of forecast steps of all origins in every sequence, (N,).
        mixtures: number of models of each row that is an `Ensemble`; it counts as one seed.

    Example:
        >>> pairs = {"filters": "q(z_t | z_{t-1}, x_{<=t})", "smooths": "q(z_t | z_{t-1}, x_{t:T})"}
        >>> p, sizes = "p(z_t | z_{t-1}) p(x_t | z_t)", {"z": 1, "x": 2}
        >>> models = {name: dvae.linear_gaussian_surrogate(p, q, sizes, 4) for name, q in pairs.items()}
        >>> result = dvae.compare(models, torch.randn(6, 4, 2), particles=32, contrasts=0, progress=False)
        >>> result.difference("smooths", "filters").mean, result.ranking  # doctest: +ELLIPSIS
        (..., [...])
    """

    rows: Annotated[dict[str, ModelResult], MODELS]
    keys: list[tuple[str, str, int]]
    n_steps: Annotated[np.ndarray, Dims("sequence")]
    data: dict[str, Any]
    protocol: dict[str, Any]
    particles: int
    contrasts: int
    samples: int
    emission: str
    seed: int
    shown: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    better: dict[str, str] = field(default_factory=dict)
    filter_particles: int = 0
    leave_future_out: tuple[int, ...] = ()
    n_forecast: Annotated[np.ndarray, Dims("sequence")] | None = None
    mixtures: dict[str, int] = field(default_factory=dict)

    def __getitem__(self, name: str) -> dict[str, Estimate]:
        row = self._row(name)
        metrics = [metric for metric in row.bounds if metric not in DIAGNOSTICS]
        return {metric: self._parts(name, metric).estimate() for metric in (*metrics, *row.free_running)}

    @property
    def ranking(self) -> list[str]:
        """Names in the order of the IWAE bound per step, the best first."""
        return sorted(self.rows, key=lambda name: -self[name]["IWAE bound"].mean)

    def difference(self, first: str, second: str, metric: str = "IWAE bound") -> Estimate:
        """Return the mean paired difference of two models, first minus second; module `estimates` describes its errors.

        Args:
            first, second: names of the models.
            metric: name of the score, such as "IWAE bound" (nats per step).

        Raises:
            KeyError: when a model was not compared, or one of the two has no such metric.
        """
        parts = [self._parts(name, metric) for name in (first, second)]
        if first == second:
            return Estimate(0.0, 0.0, 0.0, 0.0)
        return parts[0].estimate(parts[1])

    def pairs(self, metric: str = "IWAE bound") -> Pairs:
        """Return all paired differences in a metric, with p-values adjusted for their number by Holm's method.

        Args:
            metric: name of a score, such as "IWAE bound".

        Raises:
            KeyError: when a model has no such metric.
        """
        return pairs(self._all(metric))

    def confidence_set(
        self, metric: str = "IWAE bound", level: float = 0.9, *, over_seeds: bool = True
    ) -> ConfidenceSet:
        """Return the models that may be the best in a metric (`multiple_comparisons.confidence_set`).

        Args:
            metric: a metric of all models.
            level: probability that the best model is in the set.
            over_seeds: whether to account for other training seeds; if False, the set is for these weights only.

        Raises:
            KeyError: when a model has no such metric.
            ValueError: when a model has one seed, so that no error over seeds exists, or there is one cluster.
        """
        better = "higher" if metric in next(iter(self.rows.values())).bounds else self.better.get(metric, "lower")
        return confidence_set(self._all(metric), better, level, over_seeds=over_seeds)

    def required(self, first: str, second: str, metric: str = "IWAE bound", **options: Any) -> Requirement:
        """Return how many training seeds and clusters would distinguish two models.

        Args:
            first, second: names of two models with at least two seeds each.
            metric: name of a score.
            options: difference to detect, power, level and seeds, as in `multiple_comparisons.required`.

        Raises:
            KeyError: as `difference`.
            ValueError: when a model has one seed, or an option is out of range.
        """
        return required(self._parts(first, metric), self._parts(second, metric), **options)

    def _all(self, metric: str) -> dict[str, TwoWayErrors]:
        return {name: self._parts(name, metric) for name in self.rows}

    def join(self, other: Comparison) -> Comparison:
        """Return a comparison with the rows of this and another comparison of the same sequences and settings.

        Args:
            other: comparison of other models on the same sequences.

        Raises:
            ValueError: when sequences or settings differ, or both have a model of the same name.
        """
        of_rows = dict.fromkeys(("rows", "n_steps", "n_forecast", "mixtures"))
        settings, other_settings = ({**vars(each), **of_rows} for each in (self, other))
        if different := [name for name, value in settings.items() if value != other_settings[name]]:
            raise ValueError(
                f"comparisons to join may differ only in their models, but differ in {', '.join(different)}"
            )
        if shared := self.rows.keys() & other.rows.keys():
            raise ValueError(f"both comparisons have a model {', '.join(sorted(shared))}; rename one of them")
        rows, mixtures = {**self.rows, **other.rows}, {**self.mixtures, **other.mixtures}
        return dataclasses.replace(self, rows=rows, mixtures=mixtures)

    def table(self) -> Group:
        """Return tables: bounds in the order of the ranking; if any, use of latents and free-running scores."""
        tables = [self._bound_table()]
        tables += [self._latent_table()] if any(row.latents for row in self.rows.values()) else []
        return Group(*tables, *([self._free_running_table()] if self.samples else []))

    @styled
    def plot(self) -> Figure:
        """Draw bounds, paired differences to the best, k-hat, and the KL of every local latent over time.

        Returns:
            A matplotlib figure.
        """
        ranking = self.ranking
        colours = {name: f"C{place % 10}" for place, name in enumerate(self.rows)}
        latents = list(dict.fromkeys(latent for row in self.rows.values() for latent in row.kl_steps))
        rows = math.ceil((3 + len(latents)) / 2)
        labels = {name: textwrap.fill(name, 20) for name in ranking}
        widest = min(20, max(map(len, ranking)))
        lines = sum(label.count("\n") + 1 for label in labels.values())
        heights = [1.4 + 0.25 * lines] + [2.4] * (rows - 1)
        figure = new_figure(7, sum(heights) + 0.3)
        panels = list(figure.subplots(rows, 2, squeeze=False, gridspec_kw={"height_ratios": heights}).flat)
        bounds = {name: self[name]["IWAE bound"] for name in ranking}
        differences = {name: self.difference(name, ranking[0]) for name in ranking}
        for panel, estimates in zip(panels, (bounds, differences), strict=False):
            for place, (name, estimate) in enumerate(estimates.items()):
                for error, width in (("sequences", 3), ("total", 1)):
                    reach = estimate.interval(error=error)[1] - estimate.mean
                    if reach > 0:
                        panel.errorbar(estimate.mean, place, xerr=reach, color=colours[name], elinewidth=width)
                if estimate.freedom[-1] > 0:
                    freedom = f"{estimate.freedom[-1]:.2g} df"
                    above = {"xytext": (-2, 4), "textcoords": "offset points", "ha": "right", "fontsize": 8}
                    panel.annotate(freedom, (1, place), xycoords=("axes fraction", "data"), **above)
                panel.plot(estimate.mean, place, "o", color=colours[name], label=labels[name])
            panel.set_ylim(len(ranking) - 0.5, -0.5)
            panel.set_yticks(range(len(ranking)), labels.values(), parse_math=False)
            unit, _, step = self._words
            panel.set_xlabel(f"nats a {step}; 95 % intervals over\n{unit}s (thick), also seeds (thin)")
            panel.grid(axis="x", alpha=0.3)
        for place, name in enumerate(ranking):
            if "FIVO bound" in self.rows[name].bounds:
                mean = self[name]["FIVO bound"].mean
                panels[0].plot(mean, place, "D", markersize=6, color="black", fillstyle="none")
        title = f"IWAE bound ↑ (K = {self.particles})"
        panels[0].set_title(title + (f"\n◇ FIVO bound (K = {self.filter_particles})" if self.filter_particles else ""))
        panels[1].set_title("difference to\n" + textwrap.shorten(ranking[0], 40), parse_math=False)
        panels[1].axvline(0, color="grey", linewidth=0.8)
        panels[1].set_yticklabels([])
        self._khat_panel(panels[2], colours)
        for panel, latent in zip(panels[3:], latents, strict=False):
            for name in ranking:
                if latent in self.rows[name].kl_steps:
                    steps = self.rows[name].kl_steps[latent].mean(0)
                    panel.plot(range(1, len(steps) + 1), steps, color=colours[name])
            panel.set(title=f"KL of {latent} over time", xlabel="step", ylabel="nats a step")
            values = np.concatenate([line.get_ydata() for line in panel.lines])
            if (top := values.max()) > 0:  # the first step may have a hundred times the KL of the others
                least = max(values[values > 0].min(), top / 1e5)
                panel.set(yscale="log", ylim=(least / 1.5, top * 1.5))
        for panel in panels[3 + len(latents) :]:
            panel.set_axis_off()
        columns = max(1, 75 // (widest + 5))
        handles = panels[0].get_legend_handles_labels()
        legend = figure.legend(*handles, loc="outside lower center", ncols=columns)
        literal_text(legend.get_texts())
        return figure

    def _khat_panel(self, panel: Axes, colours: Mapping[str, str]) -> None:
        khats = {name: self.rows[name].bounds["k-hat"] for name in self.ranking}
        khats = {name: khat[~np.isnan(khat)] for name, khat in khats.items() if not np.isnan(khat).all()}
        values = np.concatenate([np.zeros(1), *khats.values()])
        left, right = max(-1.0, values.min()), max(1.0, min(3.0, values.max()))
        for name, khat in khats.items():
            beyond = (khat > right).mean()
            label = f"{100 * beyond:.3g} % beyond {right:g}" if beyond else None
            panel.ecdf(np.minimum(khat, right + 1), color=colours[name], label=label)  # ecdf cannot draw infinity
        panel.axvline(KHAT, color="grey", linewidth=0.8, linestyle="--")
        panel.set(title="Pareto k-hat of the weights", xlabel=f"k-hat (unreliable above {KHAT})")
        panel.set(ylabel="share of sequences", xlim=(left, right), ylim=(0, 1.02))
        if not khats:
            missing = f"not estimated with fewer\nthan {KHAT_PARTICLES} particles"
            panel.text(0.5, 0.5, missing, transform=panel.transAxes, ha="center")
        if panel.get_legend_handles_labels()[1]:
            panel.legend()

    def monte_carlo_error(self, name: str) -> float:
        """Return the Monte Carlo standard error of a model's mean "LFO", in nats per forecast step.

        Raises:
            KeyError: when the model was not compared.
            ValueError: when there are no leave-future-out densities.
        """
        if self.n_forecast is None:
            raise ValueError("no leave-future-out densities; compare again with leave_future_out=(L, M)")
        error = self._row(name).bounds["LFO error"]
        return float(np.sqrt((error**2).sum()) / len(error) / self.n_forecast.sum())

    def to_elpd(self) -> dict[str, Any]:
        """Return the leave-future-out densities as `{name: ELPDData}`, for `arviz_stats.compare`.

        `elpd_i` is the sum over the origins of each sequence, in nats, as a mean over seeds. `warning` is True if the
        particles of a sequence have a small effective sample size. The standard error assumes independent sequences and
        ignores seeds; the errors of `difference` are clustered. `p` is NaN, because no parameter was fitted to these
        sequences.

        Raises:
            ValueError: when there are no leave-future-out densities.
        """
        from arviz_stats.utils import ELPDData
        from xarray import DataArray

        results, size = {}, len(self.keys)
        options: dict[str, Any] = {"p": math.nan, "scale": "log", "good_k": math.nan, "n_data_points": size}
        if "kind" in signature(ELPDData).parameters:  # in versions of arviz_stats for Python 3.11
            options["kind"] = "lfo"
        for name, row in self.rows.items():
            self.monte_carlo_error(name)  # raises without densities
            by_sequence = DataArray(row.bounds["LFO"].mean(0), {"sequence": self.labels()["sequence"]}, ("sequence",))
            results[name] = ELPDData(
                elpd=float(by_sequence.sum()),
                se=float(by_sequence.std(ddof=1) * math.sqrt(size)),
                n_samples=self.particles * REPLICATES,
                warning=bool((row.bounds["LFO particles"].min(0) < EFFECTIVE).any()),
                elpd_i=by_sequence,
                **options,
            )
        return results

    def to_arviz(self) -> dict[str, Any]:
        """Return `{name: DataTree}` for `arviz_stats.compare` and `arviz_stats.loo`.

        The group `log_likelihood` contains independent IWAE estimates of every sequence's log evidence, as draws of one
        chain. A row of several seeds has the mean over its seeds, which is the score of a typical run. (Seeds as draws
        would be a mixture of runs, whose harmonic mean is dominated by the worst of them.) `constant_data` contains
        ELBO, IWAE bound and k-hat by seed, and steps and cluster of every sequence.

        The results of `loo` have another meaning here. The sequences are held out already, so its elpd is the held-out
        log evidence. Its p ("effective parameters") measures how much the independent estimates differ, in nats; it is
        Monte Carlo error. The elpd is based on a harmonic mean over draws, so it is p nats below the log of their mean.
        More particles reduce p.

        Its k-hat describes the weights of the harmonic mean. It warns if estimates of a sequence differ by a nat or
        more, and nearly always with fewer than 200 draws. Its standard errors assume independent sequences and ignore
        seeds; the standard errors of `difference` are clustered.

        Raises:
            ValueError: when there are fewer than 25 estimates, too few for `loo` to smooth.
        """
        from arviz_base import from_dict

        trees = {}
        for name, row in self.rows.items():
            if len(row.estimates) < _LOO_DRAWS:
                raise ValueError(
                    f"arviz fits a Pareto tail to independent estimates of every sequence's log evidence and needs at "
                    f"least {_LOO_DRAWS}, but this comparison has {len(row.estimates)}; compare again with "
                    "estimates=200 (and fewer particles, because each estimate costs as much as the bound)"
                )
            likelihood = row.estimates[None]
            by_seed = {"elbo": "ELBO", "iwae_bound": "IWAE bound", "khat": "k-hat"}
            constant = {key: row.bounds[metric] for key, metric in by_seed.items()}
            trees[name] = from_dict(
                {
                    "posterior": {"log_evidence": likelihood.sum(-1)},
                    "log_likelihood": {"x": likelihood},
                    "constant_data": {**constant, "steps": self.n_steps, "cluster": np.array(self._clusters)},
                },
                dims={
                    "x": ["sequence"],
                    "steps": ["sequence"],
                    "cluster": ["sequence"],
                    **{key: ["seed", "sequence"] for key in by_seed},
                },
                attrs={"/": {"particles": self.particles, "data": json.dumps(self.data), "seed": self.seed}},
            )
        return trees

    @override
    def summary(self) -> dict[str, Any]:
        """Return the ranking, and for every model its estimates, difference to the best and active units."""
        ranking = self.ranking
        models = {
            name: {
                "scores": {metric: _scored(estimate) for metric, estimate in self[name].items()},
                "difference_to_best": _scored(self.difference(name, ranking[0])),
                "khat_above_0.7": row.unreliable,
                "active_units": row.active_units,
                **({"mixture_of": self.mixtures[name]} if name in self.mixtures else {}),
                **({"LFO_monte_carlo_error": self.monte_carlo_error(name)} if self.leave_future_out else {}),
            }
            for name, row in self.rows.items()
        }
        return {"ranking": ranking, "models": models}

    @override
    def labels(self) -> dict[str, Sequence[str]]:
        return {
            "sequence": [f"{cluster} {start}" for cluster, (_, _, start) in zip(self._clusters, self.keys, strict=True)]
        }

    @override
    def check(self) -> None:
        if self.extents["sequence"] != {len(self.keys)}:
            raise ValueError(f"`keys` lists {len(self.keys)} sequences, but arrays have {self.extents['sequence']}")
        for name, row in self.rows.items():
            if not {"ELBO", "IWAE bound", "k-hat"} <= row.bounds.keys():
                raise ValueError(
                    f"{name} must have ELBO, IWAE bound and k-hat; it has {', '.join(row.bounds) or 'none'}"
                )
            parts = (row.bounds, row.kl_steps, row.variances, row.information, row.free_running)
            if {row.seeds} != {len(each) for part in parts for each in part.values()}:
                raise ValueError(f"all scores of {name} must have {row.seeds} seeds, as its ELBO has")

    # Estimates

    def _row(self, name: str) -> ModelResult:
        if name not in self.rows:
            raise KeyError(
                f"no model {name!r} in this comparison{nearest(name, self.rows)}; it has {', '.join(self.rows)}"
            )
        return self.rows[name]

    @property
    def _clusters(self) -> list[str]:
        return [f"{split}/{cluster}" for split, cluster, _ in self.keys]

    def _parts(self, name: str, metric: str) -> TwoWayErrors:
        row = self._row(name)
        names = [each for each in (*row.bounds, *row.free_running) if each not in DIAGNOSTICS]
        if metric not in names:
            raise KeyError(f"{name!r} has no score {metric!r}{nearest(metric, names)}; it has {', '.join(names)}")
        places = cluster_index(self.keys).numpy()
        if metric in row.free_running:
            valid = ~np.isnan(row.free_running[metric]).any(0)  # clusters with a scored window
            return TwoWayErrors.of(row.free_running[metric][:, valid], np.bincount(places)[valid].astype(float))
        weights = self.n_forecast if metric == "LFO" and self.n_forecast is not None else self.n_steps
        return TwoWayErrors.by_cluster(row.bounds[metric], weights, places)

    # Tables

    @property
    def _words(self) -> tuple[str, str, str]:
        """Words for a scored sequence, for a cluster, and for a step."""
        cluster, step = axis_names(self.data)
        if self.protocol.get("observed", 0) is None:
            return "whole sequence", cluster, step
        return "window" if "axis_names" in self.data and cluster != "clip" else "sequence", cluster, step

    def _title(self) -> str:
        unit, cluster, _ = self._words
        parts = [str(self.protocol.get("name", "")), f"{len(self.keys)} {unit}s"]
        parts[-1] += "" if unit.endswith(cluster) else f" of {len(set(self._clusters))} {cluster}s"
        parts += [f"seed {self.seed}"]
        parts += [f"data {self.data['fingerprint'][:12]}"] if "fingerprint" in self.data else []
        return " · ".join(part for part in parts if part)

    def _bound_table(self) -> Table:
        unit, cluster, step = self._words
        clustered = "" if unit.endswith(cluster) else f" (clustered by {cluster})"
        best = self.ranking[0]
        columns: dict[str, Callable[[str], str]] = {
            "seeds": lambda name: f"mixture of {n}" if (n := self.mixtures.get(name)) else str(self.rows[name].seeds),
            f"IWAE bound ↑\nK = {self.particles}": lambda name: str(self[name]["IWAE bound"]),
            "difference to the best": lambda name: self._behind(name, best, "IWAE bound"),
        }
        filters: dict[str, Callable[[str], str]] = {
            f"FIVO bound ↑\nK = {self.filter_particles}": lambda name: str(self[name].get("FIVO bound", "–"))
        }
        filters = filters if self.filter_particles else {}
        if self.leave_future_out:
            observed, horizon = self.leave_future_out
            first = max(self.rows, key=lambda name: self[name]["LFO"].mean)
            few = {name: (row.bounds["LFO particles"] < EFFECTIVE).mean() for name, row in self.rows.items()}
            columns |= filters | {
                f"LFO ↑\nL = {observed}, M = {horizon}": lambda name: str(self[name]["LFO"]),
                "difference to\nthe best LFO": lambda name: self._behind(name, first, "LFO"),
                "unreliable\nIWAE, LFO": lambda name: f"{_percent(self.rows[name].unreliable)}, {_percent(few[name])}",
            }
            errors = ", ".join(f"{name} {self.monte_carlo_error(name):.2g}" for name in self.ranking)
            lines = [
                f"LFO: log density of M {step}s given all earlier ones, from L {step}s on; its Monte Carlo standard "
                f"error: {errors}",
                f"unreliable: share of {unit}s with k-hat > {KHAT} (IWAE), and with fewer than {EFFECTIVE} effective "
                f"particles at some step, of {self.particles} in each of {REPLICATES} estimates (LFO)",
            ]
        else:
            columns |= {
                "95 % (df)": lambda name: "–" if name == best else _interval(self.difference(name, best)),
                "ELBO ↑": lambda name: str(self[name]["ELBO"]),
                **filters,
                f"k-hat\n> {KHAT}": lambda name: _percent(self.rows[name].unreliable),
            }
            lines = [
                "95 %: confidence interval from both errors (df: degrees of freedom of Student's t)",
                f"k-hat > {KHAT}: share of {unit}s whose IWAE bound is unreliable",
            ]
        lines = [f"mean ± standard error over {unit}s{clustered} ± over seeds", *lines]
        lines += [] if self.samples else self.notes
        lines += [f"{name}: {note}" for name, row in self.rows.items() for note in row.notes]
        table = _table(f"{self._title()}\nteacher-forced, nats a {step}", "\n".join(lines), columns)
        for name in self.ranking:
            table.add_row(name, *(cell(name) for cell in columns.values()))
        return table

    def _behind(self, name: str, best: str, metric: str) -> str:
        return "–" if name == best else str(self.difference(name, best, metric))

    def _latent_table(self) -> Table:
        limit = f"at most log {self.contrasts} = {math.log(self.contrasts):.2f}" if self.contrasts else "not computed"
        table = _table(
            "latents under the guide, teacher-forced",
            f"active units: variance of the posterior mean over the data above {ACTIVE}\ninformation: {limit}",
            ("latent", f"KL\nnats a {self._words[2]}", "active\nunits", "information\nnats"),
        )
        for name in self.ranking:
            row, scores = self.rows[name], self[name]
            for latent in row.latents:
                active = row.active_units[latent].mean()
                units = f"{active:g}" if active.is_integer() else f"{active:.1f}"
                table.add_row(
                    name if latent == row.latents[0] else "",
                    latent,
                    str(scores[f"KL {latent}"]),
                    "–" if math.isnan(active) else f"{units} of {row.variances[latent].shape[-1]}",
                    self._information_cell(row, latent),
                )
        return table

    def _information_cell(self, row: ModelResult, latent: str) -> str:
        if latent not in row.information:
            return "–"
        steps = row.information[latent].mean(0)
        if latent not in row.kl_steps:
            return f"{number(steps[0])} a sequence"
        weights = (self.n_steps[:, None] > np.arange(len(steps))).sum(0)
        return f"{number((weights * steps).sum() / weights.sum())} a step"

    def _free_running_table(self) -> Table:
        scores = {name: self[name] for name in self.ranking}
        lines = [["", *scores]]
        for metric, unit in self.shown.items():
            label = metric + ARROWS[self.better.get(metric, "lower")] + (f" ({unit})" if unit else "")
            lines.append([label, *(str(score[metric]) for score in scores.values())])
        if len(self.shown) <= ACROSS:
            lines = [list(line) for line in zip(*lines, strict=True)]
        table = _table(
            f"free-running, K = {self.samples}, {self.emission} emission",
            "\n".join(
                [f"mean ± standard error over windows (clustered by {self._words[1]}) ± over seeds", *self.notes]
            ),
            lines[0][1:],
        )
        for line in lines[1:]:
            table.add_row(*line)
        return table


def _table(title: str, caption: str, columns: Iterable[str]) -> Table:
    """Return an empty table with a first column for names; cells fold where the terminal is too narrow."""
    table = Table(title=title, caption=caption)
    table.add_column("", overflow="fold")
    for column in columns:
        table.add_column(column, justify="right", overflow="fold")
    return table


def _percent(share: float) -> str:
    return "–" if math.isnan(share) else f"{100 * share:.1f} %"


def _interval(estimate: Estimate) -> str:
    """Return the 95 % interval and its degrees of freedom as text."""
    low, high = map(number, estimate.interval())
    return low if low == "–" else f"{low} to {high} ({estimate.freedom[-1]:.3g})"


def _scored(estimate: Estimate) -> dict[str, Any]:
    return {**dataclasses.asdict(estimate), "interval": estimate.interval(), "p_value": estimate.p_value()}
