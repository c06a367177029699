"""Bracket of the evidence between two bounds, and a decomposition of the gap between ELBO and evidence.

    evidence - ELBO = (ELBO of the best semi-amortized guide - ELBO)                         amortisation
                    + (the same with all edges - ELBO of the best semi-amortized guide)      missing edges
                    + (evidence - ELBO of the best semi-amortized guide with all edges)      family

A semi-amortized guide is the model's own guide with free parameters for every sequence (`semi_amortized_guide`).
Amortisation is the cost of everything that the network fails to infer from the data, or cannot read. With all edges,
the guide also reads the latents that the posterior depends on and its equations omit. The remaining gap is the cost of
normals whose locations depend linearly on the added latents.

The decomposition follows Cremer, Li and Duvenaud (2018, arXiv 1801.03558), whose approximation gap is the sum of the
last two parts. Each part is at least 0, except for noise and an incomplete search, whose error counts in a later part.
Both semi-amortized guides are fitted for the same number of steps from the model's own.

The evidence is bracketed. The lower bound is annealed importance sampling that starts at the semi-amortized guide with
all edges. The upper bound is the same run in reverse, for sequences simulated from the model (`annealed_bound`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from rich.console import Group
from torch import Tensor
from typing_extensions import override

from ...data.batch import Batch
from ...data.sequences import HeldOutWindows, Listed, axis_names, cluster_keys, sequences, take_split
from ...program.batch import AnyBatch, repeat
from ...program.model import DynamicalVAE
from ..bounds.annealing import annealed_bound
from ..bounds.elbo import joint_and_guide, require_densities, require_latents
from ..bounds.particles import fivo_bound, obstacle
from ..bounds.semi_amortized import missing_latents, require_local, semi_amortized_guide
from ..bounds.teacher_forced import length_of
from ..evaluation.estimates import Estimate, TwoWayErrors, decimals, number
from ..evaluation.evaluation_windows import cluster_index, refuse_non_finite, seeded_evaluation
from ..evaluation.record import Dims
from ..evaluation.result import Result, Table, new_figure, progress_bar, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OWN, ALL = "semi-amortized ELBO", "semi-amortized ELBO, all edges"
BOUNDS = ("ELBO", "IWAE", "FIVO", OWN, ALL, "AIS", "upper")
"""Names of the bounds: lower bounds from the loosest to the tightest, then the upper bound."""
PARTS = {
    "amortisation": ("ELBO", OWN),
    "missing edges": (OWN, ALL),
    "family": (ALL, "AIS"),
    "unknown": ("AIS", "upper"),
}
"""Parts of the gap, each from one bound to another.

"family" is a lower bound of its part, because AIS is a lower bound on the evidence. "unknown" is the width of the
bracket, for simulated data only.
"""
WIDE = 0.5
"""Width of a bracket, in nats, that may indicate a missed mode; with two equal modes it is log 2."""
DATA = ("real", "simulated")
CHUNK = 4096
"""Largest number of sequences times draws in memory."""


@dataclass(frozen=True, eq=False, repr=False)
class Bracket(Result):
    """Bounds of one model on the same sequences and on as many simulated ones, in nats per sequence.

    Attributes:
        bounds: dictionary from "real" and "simulated" to {name of the bound: values (N,)}. "upper" exists only for
            simulated data, FIVO if the model allows it, and semi-amortized bounds if the guide is normal.
        keys: (split, cluster, first step) of every sequence.
        n_steps: number of steps of every sequence, real and simulated, (N,).
        equations: "generative" and "inference".
        added: for each latent, the additional parents of the guide with all edges.
        data: fingerprint and description of the windows.
        particles: K of IWAE and FIVO, and number of draws for ELBOs.
        temperatures, chains: numbers of temperatures and chains of annealed importance sampling.
        fitting: number of steps of each semi-amortized guide.
        seed: seed of all draws.
        notes: bounds that are not available, with reasons; and warnings.

    Example:
        >>> pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})"
        >>> model = dvae.linear_gaussian_surrogate(*pair, {"z": 1, "x": 2}, 4)
        >>> result = dvae.bracket(model, model.sample(4, 4)["x"], temperatures=5, fitting=100, progress=False)
        >>> gap = result.gap("simulated")
        >>> gap["amortisation"].mean > gap["missing edges"].mean
        True
    """

    bounds: Annotated[dict[str, dict[str, np.ndarray]], Dims("sequence", name="{1} {0}")]
    keys: list[tuple[str, str, int]]
    n_steps: Annotated[np.ndarray, Dims("sequence")]
    equations: dict[str, str]
    added: dict[str, list[str]]
    data: dict[str, Any]
    particles: int
    temperatures: int
    chains: int
    fitting: int
    seed: int
    notes: list[str]

    def estimate(self, bound: str, above: str = "", data: str = "real", *, per_step: bool = False) -> Estimate:
        """Return the mean of a bound, or of its difference to another one.

        Args:
            bound, above: names; with `above`, the result is `bound` minus `above`.
            data: "real", with clustered errors, or "simulated".
            per_step: whether to return nats per step instead of per sequence.

        Returns:
            Mean with its standard error, in nats.

        Raises:
            KeyError: when the bound does not exist for these data.
        """
        bounds = self.bounds[data]
        if missing := [name for name in (bound, above) if name and name not in bounds]:
            raise KeyError(f"there is no bound {missing[0]!r} for {data} data; the bounds are {', '.join(bounds)}")
        values = bounds[bound] - (bounds[above] if above else 0.0)
        weights = self.n_steps if per_step else np.ones(len(values))
        clusters = cluster_index(self.keys).numpy() if data == "real" else np.arange(len(values))
        return TwoWayErrors.by_cluster(values[None], weights, clusters).estimate()

    def gap(self, data: str = "real", *, per_step: bool = False) -> dict[str, Estimate]:
        """Return the parts of the gap between ELBO and evidence by name, in nats per sequence.

        "family" is a lower limit, because it ends at the lower bound on the evidence. "unknown", for simulated data, is
        the distance from this bound to the upper one: the family part may be larger by this amount.

        Args:
            data: "real" or "simulated".
            per_step: whether to return nats per step instead of per sequence.
        """
        bounds = self.bounds[data]
        parts = {name: ends for name, ends in PARTS.items() if all(end in bounds for end in ends)}
        return {name: self.estimate(high, low, data, per_step=per_step) for name, (low, high) in parts.items()}

    def table(self) -> Group:
        """Return tables of bounds for real and simulated data, and of the parts of the gap."""
        return Group(*(self._bounds(data) for data in DATA), self._gap())

    def _bounds(self, data: str) -> Table:
        cluster, step = axis_names(self.data)
        counts = f"{len(self.keys)} sequences of {len({*cluster_index(self.keys).tolist()})} {cluster}s"
        title = f"{self.equations['generative']}\n{self.equations['inference']}\n{counts}" if data == "real" else ""
        caption = f"mean ± standard error over sequences{f', clustered by {cluster}' if data == 'real' else ''}"
        table = Table(title=title, caption="\n".join([caption, *(self.notes if data == "real" else ())]))
        table.add_column(f"{data} data")
        for column in ("nats a sequence", "above the ELBO", f"nats a {step}"):
            table.add_column(column, justify="right")
        for name in self.bounds[data]:
            above = "–" if name == "ELBO" else format_estimate(self.estimate(name, "ELBO", data))
            total, per_step = (format_estimate(self.estimate(name, data=data, per_step=each)) for each in (False, True))
            table.add_row(self._label(name), total, above, per_step)
        return table

    def _label(self, name: str) -> str:
        if name in ("IWAE", "FIVO"):
            return f"{name}, K = {self.particles}"
        return f"{name}, L = {self.temperatures}, K = {self.chains}" if name in ("AIS", "upper") else name

    def _gap(self) -> Table:
        added = "; ".join(f"{name}: {', '.join(terms)}" for name, terms in self.added.items()) or "none"
        table = Table(
            title="evidence above the ELBO, nats a sequence", caption=f"missing edges between latents: {added}"
        )
        table.add_column("")
        for data in DATA:
            table.add_column(f"{data} data", justify="right")
        gaps = {data: self.gap(data) for data in DATA}
        for name, (low, high) in PARTS.items():
            if name in gaps["simulated"]:
                cells = (format_estimate(gaps[data][name]) if name in gaps[data] else "–" for data in DATA)
                at_least = ", at least" if name == "family" else ""
                table.add_row(f"{name}{at_least} ({low} to {high})", *cells)
        return table

    @styled
    def plot(self) -> Figure:
        """Draw all bounds above the ELBO for real and simulated data, the parts of the gap, and the bracket shaded.

        Returns:
            A matplotlib figure.
        """
        figure = new_figure(7, 5.4)
        panels = figure.subplots(2, 1)  # separate axes, because a guide may be far worse on simulated data
        unknown = self.estimate("upper", "AIS", "simulated").mean
        for panel, data in zip(panels, DATA, strict=True):
            names = list(self.bounds[data])
            lower = self.estimate("AIS", "ELBO", data).mean
            shade = {"real": "as wide as on simulated data", "simulated": "evidence"}[data]
            panel.axvspan(lower, lower + max(unknown, 0.0), color="0.5", alpha={"real": 0.15, "simulated": 0.35}[data])
            panel.annotate(shade, (lower, 1), xycoords=("data", "axes fraction"), va="bottom")
            for place, (part, (low, high)) in enumerate(PARTS.items()):
                if part in self.gap(data) and part != "unknown":
                    ends = [self.estimate(name, "ELBO", data).mean for name in (low, high)]
                    panel.barh(len(names), ends[1] - ends[0], left=ends[0], color=f"C{place}", alpha=0.6, label=part)
            for place, name in enumerate(names):
                estimate = self.estimate(name, "ELBO", data)
                panel.errorbar(estimate.mean, place, xerr=_reach(estimate), fmt="o", color="0.4")
            panel.set_yticks(range(len(names) + 1), [*map(self._label, names), "parts of the gap"])
            panel.invert_yaxis()
            panel.set_title(f"{data} data", loc="left")
            panel.grid(axis="x", alpha=0.3)
        panels[1].set_xlabel("nats a sequence above the ELBO (95 % over sequences)")
        figure.legend(*panels[1].get_legend_handles_labels(), loc="outside lower center", ncols=len(PARTS))
        figure.suptitle(f"{self.equations['generative']}\n{self.equations['inference']}", parse_math=False)
        return figure

    @override
    def summary(self) -> dict[str, Any]:
        return {"gap": {data: {name: vars(each) for name, each in self.gap(data).items()} for data in DATA}}

    @override
    def labels(self) -> dict[str, Sequence[str]]:
        return {"sequence": [f"{split}/{cluster} {start}" for split, cluster, start in self.keys]}

    @override
    def check(self) -> None:
        real, simulated = (self.bounds[data] for data in DATA)
        if not {"ELBO", "AIS"} <= real.keys() & simulated.keys() or "upper" not in simulated:
            raise ValueError("bounds are missing; expected ELBO and AIS of real and simulated data, and upper")
        if unknown := (real.keys() | simulated.keys()) - {*BOUNDS}:
            raise ValueError(f"unknown bounds {', '.join(sorted(unknown))}; expected some of {', '.join(BOUNDS)}")
        if self.extents != {"sequence": {len(self.keys)}} or not self.keys:
            raise ValueError(f"every bound must have one value for each of the {len(self.keys)} sequences in `keys`")
        if not all(np.isfinite(values).all() for values in (self.n_steps, *real.values(), *simulated.values())):
            raise ValueError("bounds and numbers of steps must be finite")
        if self.equations.keys() != {"generative", "inference"}:
            raise ValueError("equations must have the keys generative and inference")
        if not all(isinstance(word, str) for word in axis_names(self.data)):
            raise ValueError("the words for a sequence and a step must be text")


def format_estimate(estimate: Estimate) -> str:
    """Return a mean ± its standard error over sequences as text."""
    places = decimals(estimate.mean, estimate.sequences)
    return f"{number(estimate.mean, places)} ± {number(estimate.sequences, places)}"


def _reach(estimate: Estimate) -> float:
    reach = estimate.interval(error="sequences")[1] - estimate.mean
    return 0.0 if math.isnan(reach) else reach


@torch.inference_mode(False)
def bracket(
    model: DynamicalVAE,
    data: HeldOutWindows | Listed | Tensor | np.ndarray | Mapping[str, Any],
    *,
    count: int | None = None,
    particles: int = 64,
    temperatures: int = 50,
    chains: int = 8,
    fitting: int = 300,
    reach: int | None = None,
    seed: int = 0,
    batch_size: int = 32,
    progress: bool = True,
) -> Bracket:
    """Return bounds on a model's evidence from both sides, and the parts of the gap to its ELBO.

    Sequences simulated from the model have the lengths and the context of the real ones, and no missing entries.

    Cost for each sequence, real or simulated: 3 K runs of guide and model for means of weights, and 12 forward and
    backward passes for each step of a semi-amortized guide. There are two such guides, or one if no edges are missing.
    Each chain takes about 7 L gradients of guide and model, nearly twice that for simulated sequences.

    Args:
        model: model with its guide.
        data: windows, x `(N, T, D)`, or a batch of `N` sequences, which may be ragged.
        count: number of randomly chosen sequences to evaluate; None for all.
        particles: K, number of draws for the ELBOs and the IWAE bound, and number of particles of the FIVO bound.
        temperatures, chains: L and K of annealed importance sampling, as in `annealed_bound`.
        fitting: number of steps of the semi-amortized guides (`semi_amortized_guide`); 0 omits them and the parts of
            the gap, and chains start at the model's own guide.
        reach: largest distance in steps of edges in the semi-amortized guides (`semi_amortized_guide`).
        seed: seed of all draws.
        batch_size: number of sequences in a batch.
        progress: whether to show a progress bar.

    Returns:
        Each bound by name, (N,) in nats per sequence, for "real" and for "simulated" data; only the simulated data have
        the upper bound.

    Raises:
        ValueError: when the model has no latents or likelihood, the batch has groups that share latents, or a number is
            out of range.
        TypeError: when the data are of another kind.
        FloatingPointError: when a bound is not finite.

    Example:
        >>> pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})"
        >>> model = dvae.linear_gaussian_surrogate(*pair, {"z": 1, "x": 2}, 4)
        >>> result = dvae.bracket(model, torch.randn(4, 4, 2), temperatures=5, fitting=0, progress=False)
        >>> list(result.bounds["simulated"])
        ['ELBO', 'IWAE', 'FIVO', 'AIS', 'upper']
    """
    if min(particles, temperatures, chains, batch_size, 1 if count is None else count) < 1 or fitting < 0:
        raise ValueError(
            "count, particles, temperatures, chains and batch_size must be at least 1, fitting at least 0, got "
            f"{count}, {particles}, {temperatures}, {chains}, {batch_size} and {fitting}"
        )
    require_densities(model)
    require_latents(model)
    data = take_split(data, "test")
    all_rows, notes = sequences(data).batch, []
    if all_rows.group is not None and model.grouped:
        raise ValueError("sequences of a group have no separate evidence; remove 'group' from the batch")
    windows = data if isinstance(data, HeldOutWindows) else None
    size = length_of(all_rows)
    keys = [("data", str(n), 0) for n in range(size)] if windows is None else cluster_keys(windows)
    generator = torch.Generator().manual_seed(seed)
    indices = torch.randperm(size, generator=generator)[:count]
    batch, keys = all_rows.rows(indices), [keys[n] for n in indices.tolist()]
    parts = [slice(first, first + batch_size) for first in range(0, len(keys), batch_size)]
    batches = [model.read(batch.rows(part)) for part in parts]
    if fitting:
        try:
            require_local(model)
        except ValueError as error:
            fitting = 0
            notes.append(f"no parts of the gap: {error}")
    reason = next(filter(None, (obstacle(model, part) for part in batches)), "")
    if reason:
        notes.append(f"no FIVO: {reason}")
    with seeded_evaluation(model, _seeds(generator, 1)[0]):
        simulations = [_simulate(model, part) for part in batches]
    added = missing_latents(model) if fitting else {}
    work = _Work(model, particles, temperatures, chains, fitting, reach, bool(reason), bool(added))
    results: dict[str, list[dict[str, Tensor]]] = {name: [] for name in DATA}
    unreliable = dict.fromkeys(DATA, 0)
    with progress_bar(progress) as bar:
        task = bar.add_task("bracket", total=len(parts) * 2 * ((1 + bool(added)) * fitting + 1))
        for index, (real, (simulated, latents)) in enumerate(zip(batches, simulations, strict=True)):
            for name, rows, start in (("real", real, None), ("simulated", simulated, latents)):
                bounds, effective = work.bounds(rows, start, _seeds(generator, 3), lambda: bar.advance(task))
                unreliable[name] += int((effective < chains / 2).sum())
                for bound, values in bounds.items():
                    refuse_non_finite(bound, f"bound of {name} data", values.isfinite(), keys[parts[index]])
                results[name].append(bounds)
                bar.advance(task)
    notes += [
        f"AIS of {name} data: less than half of the {chains} chains are effective in {number} of {len(keys)} sequences"
        for name, number in unreliable.items()
        if number
    ]
    result = Bracket(
        bounds={
            name: {bound: torch.cat([part[bound] for part in all_]).double().cpu().numpy() for bound in all_[0]}
            for name, all_ in results.items()
        },
        keys=keys,
        n_steps=torch.cat([_valid_steps(model, part) for part in batches]).double().cpu().numpy(),
        equations={"generative": model.generative.text, "inference": model.inference.text},
        added={name: [term for parent in parents for term in parent.terms] for name, parents in added.items()},
        data={} if windows is None else {"fingerprint": windows.fingerprint, **_axis_words(windows)},
        particles=particles,
        temperatures=temperatures,
        chains=chains,
        fitting=fitting,
        seed=seed,
        notes=notes,
    )
    unknown = result.estimate("upper", "AIS", "simulated")
    if unknown.mean > max(WIDE, 2 * unknown.sequences):
        notes.append(
            f"on simulated data the upper bound lies {format_estimate(unknown)} nats above AIS. AIS and family may be "
            "too low by this amount, for example if all chains stay in one mode"
        )
    return result


def _seeds(generator: torch.Generator, count: int) -> list[int]:
    """Return independent seeds, so that a guide is not evaluated with the draws it was fitted with."""
    return torch.randint(2**31, (count,), generator=generator).tolist()  # type: ignore[no-any-return]


def _axis_words(windows: HeldOutWindows) -> dict[str, Any]:
    return {"axis_names": list(axis_names(windows.description))} if "axis_names" in windows.description else {}


def _valid_steps(model: DynamicalVAE, data: Batch) -> Tensor:
    x: Tensor = data[model.observed[0]]
    return torch.full((len(x),), x.shape[1]) if data.lengths is None else data.lengths


def _simulate(model: DynamicalVAE, real: Batch) -> tuple[Batch, dict[str, Tensor]]:
    """Return sequences drawn from the model with the same lengths and context, as it reads them, and their latents."""
    x = real[model.observed[0]]
    context = Batch({name: value for name, value in real.items() if name not in (*model.observed, "mask", "log_det")})
    draws = model.model(context, length=x.shape[1] if x.dim() == 3 else None, size=len(x))
    latents = {name: draws[name] for name in model.latents}
    simulated = context | {name: draws[name] for name in model.observed}
    return (simulated if model.view.keeps_volume else model.read(model.to_data_space(simulated, context))), latents


@dataclass(frozen=True)
class _Work:
    """Computations for each batch."""

    model: DynamicalVAE
    particles: int
    temperatures: int
    chains: int
    fitting: int
    reach: int | None
    no_filter: bool
    edges_missing: bool

    def bounds(
        self, data: Mapping[str, Any], latents: Mapping[str, Tensor] | None, seeds: Sequence[int], advance: Any
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Return the bounds (B,) by name, and the effective number of chains (B,).

        The draws of all ELBOs have the same seed, so that their differences have less noise.

        Args:
            data: batch of B sequences.
            latents: exact latents of simulated data, which also give an upper bound; None for real data.
            seeds: seeds of evaluation, of fitting the semi-amortized guides, and of annealed importance sampling.
            advance: function called after each part of the work, for the progress bar.
        """
        model, bounds = self.model, {}
        evaluation_seed, fitting_seed, annealing_seed = seeds
        with seeded_evaluation(model, evaluation_seed):
            weights = self._weights(model, data)
            bounds["ELBO"], bounds["IWAE"] = weights.mean(0), weights.logsumexp(0) - math.log(self.particles)
            if not self.no_filter:
                bounds["FIVO"] = fivo_bound(model, data, self.particles, chunk=CHUNK).bound
        for name, missing in ((OWN, False), (ALL, True)) if self.fitting else ():
            if not missing or self.edges_missing:  # otherwise both guides are the same
                options: Any = {"missing": missing, "steps": self.fitting, "reach": self.reach, "seed": fitting_seed}
                model = semi_amortized_guide(self.model, data, **options, progress=advance)
            with seeded_evaluation(model, evaluation_seed):
                bounds[name] = self._weights(model, data).mean(0)
        options = {"temperatures": self.temperatures, "chains": self.chains, "seed": annealing_seed}
        options["chunk"] = self.chains * len(bounds["ELBO"])  # a semi-amortized guide needs all sequences of the batch
        annealed = annealed_bound(model, data, **options)
        bounds["AIS"] = annealed.bound
        if latents is not None:
            bounds["upper"] = annealed_bound(model, data, **options, latents=latents).bound
        return bounds, annealed.effective

    def _weights(self, model: DynamicalVAE, data: AnyBatch) -> Tensor:
        """Return log p(x, z) - log q(z | x) at draws z, (K, B)."""
        size = len(data[model.observed[0]])  # type: ignore[call-overload, index]
        at_once = max(1, CHUNK // size)
        parts = []
        for first in range(0, self.particles, at_once):
            count = min(at_once, self.particles - first)
            rows = repeat(data, count)
            joint, guide = joint_and_guide(model, rows, model.guide(rows))
            parts.append((joint - guide).unflatten(0, (count, size)))
        return torch.cat(parts)
