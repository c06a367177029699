"""Comparison of models on held-out sequences.

Every model is scored teacher-forced on the same sequences: evidence lower bound, IWAE bound with the Pareto diagnostic
of its weights, optionally the FIVO bound, KL of every latent, and information of the latents about the data.
Free-running scores come from `evaluate`. Models are ranked by the IWAE bound per step. `comparison` computes the
uncertainty of their differences.
"""

import dataclasses
import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ...data.batch import Batch
from ...data.sequences import HeldOutWindows, Listed, axis_names, cluster_keys, sequences, take_split
from ...options import Count, require
from ...program.model import DynamicalVAE
from ..bounds.elbo import bound_notes, require_densities, require_likelihood
from ..bounds.leave_future_out import LeaveFutureOut, mixture
from ..bounds.leave_future_out import leave_future_out as left_out_densities
from ..bounds.particles import obstacle
from ..bounds.teacher_forced import bounds, filtered, information, length_of, variances
from .comparison import Comparison, ModelResult
from .ensemble import Ensemble, require_same
from .evaluate import evaluate
from .evaluation_windows import on_device_of, refuse_non_finite, require_readable, seeded_evaluation
from .record import plain
from .result import progress_bar
from .scores import Measure, Scores, proper

_PAIRS = 4096  # largest number of sequences times contrasts in memory


def compare(
    models: Mapping[str, DynamicalVAE | Sequence[DynamicalVAE] | Ensemble],
    data: HeldOutWindows | Listed | Tensor | np.ndarray | Batch,
    *,
    scores: Scores = proper,
    particles: int = 100,
    estimates: int = 1,
    filter_particles: int = 0,
    leave_future_out: tuple[int, int] | None = None,
    contrasts: int = 128,
    samples: int = 50,
    draw_emission: bool | None = None,
    seed: int = 0,
    batch_size: int = 32,
    configs: Mapping[str, Mapping[str, Any]] | None = None,
    progress: bool = True,
) -> Comparison:
    """Compare models on held-out sequences: bounds, differences with their errors, use of latents, forecasts.

    All models are scored on the same sequences, and each draws from the same seed. Scores therefore do not depend on
    which other models are compared. They do depend on `batch_size`, because draws are made by batch.

    *Active units* of a latent (Burda et al., 2016) are coordinates whose posterior mean varies over the data with a
    variance above 0.01. For a local latent, the variance is over sequences at the same step, pooled over steps, so a
    pattern that all sequences share, such as a clock, does not count. If a guide reads its own past, its posterior mean
    is averaged over 8 draws of that past, and the variance due to the draws is subtracted. The threshold is meant for
    latents of about unit scale.

    *Information* of a latent about the data, among M sequences (`contrasts`), with the same M for all models:

        mean over n of  log q(z_n | own past, x_n) - log (1/M) sum_m q(z_n | own past, x_m)

    z_n is drawn for x_n, "own past" denotes the latents that q reads, and x_m includes its context. The information is
    0 if q ignores the data, and at most log M. For a static latent whose factor reads only data, it is the mutual
    information under the guide among these sequences (Hoffman and Johnson, 2016). In expectation it is then a lower
    bound of the mutual information over the population (Poole et al., 2019, section 2.4).

    For a local latent it is computed by step, in nats per step, with the limit log M at each. A whole trajectory of z
    nearly always identifies its sequence, so its information would be log M for every model. If q reads only data, this
    is I(x; z_t). If q reads other latents too, it is the information that x adds to them. The contrasts are not
    weighted by how well they explain the past of the latents. It is therefore at least I(x; z_t | past), by the
    divergence of the two mixtures, and does not vanish when the past already identifies the sequence. If overlapping
    windows of one cluster are among the contrasts, nothing distinguishes their common part, and the information stays
    below log M.

    Args:
        models: a model by name, or several that differ only in their training seed. An `Ensemble` is one row, of the
            bounds and forecasts of its mixture, with the largest k-hat of its models.
        data: windows (such as `ArrayWindows`), x `(N, T, D)`, or a batch of `N` sequences, which may be ragged.
        scores: scores of forecasts, as in `evaluate`.
        particles: K of the IWAE bound. k-hat needs 25, and 100 or more to be meaningful for single sequences. K is 1
            for all models if one has a bound in place of a density (`distributions.Diffusion`).
        estimates: number of independent IWAE estimates of every sequence, each with K particles. The bound is their
            mean. `Comparison.to_arviz` needs 25 or more.
        filter_particles: K of the FIVO bound (`fivo_bound`); 0 omits it. For a model without a FIVO bound, such as
            one with a backward guide, a note gives the reason.
        leave_future_out: (L, M) to add "LFO", the log density of each M steps given all earlier ones, from L observed
            steps on (module `leave_future_out`), with K particles for each of its estimates. The bound compares models
            by evidence, LFO by forecasts.
        contrasts: M, number of randomly drawn sequences among which information is measured; all sequences if there are
            fewer. 0 omits information.
        samples: number of forecasts per window for the free-running scores, which take longest; 0 omits them. Tensors,
            batches and whole sequences have none.
        draw_emission: whether forecasts are draws of x (True) or its means (False); None as in `evaluate`.
        seed: seed of every model's draws, and of the choice of contrasts.
        batch_size: number of sequences in a batch.
        configs: `{name: configuration}`, stored with the rows; any JSON value.
        progress: whether to show a progress bar.

    Returns:
        The comparison; print it, or use its `table`, `plot`, `difference`, `to_json` and `to_arviz`.

    Raises:
        ValueError: when `models` is empty, models in one row differ in equations or sizes, a number is out of range,
            the data have no sequences, or windows to forecast are ragged.
        TypeError: when the data are of another kind, or a value in `models` is not a model.
        FloatingPointError: when a bound is not finite, naming model and sequence.

    Example:
        >>> pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})"
        >>> model = dvae.linear_gaussian_surrogate(*pair, {"z": 1, "x": 2}, 4)
        >>> result = dvae.compare({"surrogate": model}, torch.randn(6, 4, 2), particles=32, contrasts=0, progress=False)
        >>> result.ranking
        ['surrogate']
    """
    if min(particles, estimates, batch_size) < 1 or min(filter_particles, contrasts, samples) < 0:
        raise ValueError(
            "particles, estimates and batch_size must be at least 1, filter_particles, contrasts and samples at least "
            f"0, got {particles}, {estimates}, {batch_size}, {filter_particles}, {contrasts} and {samples}"
        )
    require(tuple[Count, Count] | None, leave_future_out=leave_future_out)
    data = take_split(data, "test")
    windows = data if isinstance(data, HeldOutWindows) else None
    is_whole = windows is not None and windows.protocol.observed is None
    samples = 0 if windows is None or is_whole else samples
    contenders = _contenders(models)
    labelled = {label: model for label, _, model in _each(contenders)}
    mixtures = {name: value for name, value in models.items() if isinstance(value, Ensemble)}
    labels: dict[str, str] = {}
    for label, model in labelled.items():
        labels.setdefault(model.view.quantity or "the data", label)
    if len(labels) > 1:
        raise ValueError(
            "bounds are comparable only as densities of the same data, but these are "
            f"{', '.join(f'of {quantity} for {label}' for quantity, label in labels.items())}; use evaluate to compare "
            "forecasts"
        )
    if any(model.bounded for model in labelled.values()):
        particles = 1  # the same bound for all models
    batch = sequences(data).batch
    for label, model in labelled.items():
        require_readable(label, model, batch)
    sequence_ids = batch.group.tolist() if batch.group is not None else range(length_of(batch))
    keys = [("data", str(n), 0) for n in sequence_ids] if windows is None else cluster_keys(windows)
    contrast_indices = torch.randperm(len(keys), generator=torch.Generator().manual_seed(seed))[:contrasts]
    shared: dict[str, Any] = {"seed": seed, "batch_size": batch_size, "progress": progress}
    free_running: dict[str, dict[str, Any]] = {label: {} for label in (*labelled, *mixtures)}
    measures: Sequence[Measure] = ()
    emission = "drawn" if draw_emission else "mean"
    if windows is not None and samples:
        forecast_options: dict[str, Any] = {"samples": samples, "draw_emission": draw_emission, "references": False}
        measures = [measure for measure in scores(windows) if measure.least <= samples and not measure.bins]
        forecasters = {label: model for label, name, model in _each(contenders) if name not in mixtures} | mixtures
        evaluation = evaluate(forecasters, windows, scores=lambda _: measures, **forecast_options, **shared)
        emission = evaluation.emission
        free_running |= {
            label: {m.name: np.array(evaluation.rows[label].cluster_means[m.name]) for m in measures}
            for label in forecasters
        }
    measured: dict[Any, dict[str, Any]] = {}
    counts = particles, estimates, filter_particles, leave_future_out
    for label, model in labelled.items():
        if model not in measured:  # it may also be part of a mixture
            measured[model] = _score_model(label, model, batch, keys, contrast_indices, *counts, **shared)
    rows = {}
    for name, versions in contenders.items():
        labels_of_row = [name] if name in mixtures else [label for label, row, _ in _each(contenders) if row == name]
        scored, forecast = [measured[model] for model in versions], [free_running[label] for label in labels_of_row]
        config = dict((configs or {}).get(name, {}))
        rows[name] = _contender(versions[0], scored, forecast, config, name in mixtures)
    x = batch[next(iter(labelled.values())).observed[0]]
    return Comparison(
        rows=rows,
        keys=keys,
        n_steps=next(iter(measured.values()))["steps"],
        data={
            "fingerprint": windows.fingerprint if windows is not None else _fingerprint(batch),
            "sequences": len(keys),
            "steps": x.shape[1],
            "coordinates": x.shape[2],
            **(
                {"axis_names": list(axis_names(windows.description))}
                if windows and "axis_names" in windows.description
                else {}
            ),
        },
        protocol=plain(dataclasses.asdict(windows.protocol)) if windows is not None else {},
        particles=particles,
        filter_particles=filter_particles,
        leave_future_out=tuple(leave_future_out or ()),
        n_forecast=_future_columns(next(iter(measured.values()))["left out"]).get("steps"),
        mixtures={name: len(value.models) for name, value in mixtures.items()},
        contrasts=len(contrast_indices),
        samples=samples,
        emission=emission,
        seed=seed,
        shown={measure.name: measure.unit for measure in measures if measure.headline},
        better={measure.name: measure.better for measure in measures},
        notes=["no forecasts: whole sequences have no future"]
        if is_whole
        else list(dict.fromkeys(measure.note for measure in measures if measure.headline and measure.note)),
    )


def _score_model(
    label: str,
    model: DynamicalVAE,
    batch: Batch,
    keys: Sequence[tuple[str, str, int]],
    contrast_indices: Tensor,
    particles: int,
    estimates: int,
    filter_particles: int,
    leave_future_out: tuple[int, int] | None,
    *,
    seed: int,
    batch_size: int,
    progress: bool,
) -> dict[str, Any]:
    """Return all teacher-forced scores of one model; each group of scores draws from the seed."""
    with progress_bar(progress) as bar:

        def parts(kind: str, count: int, size: int) -> Iterator[slice]:
            for start in bar.track(range(0, count, size), description=f"{label}, {kind}"):
                yield slice(start, start + size)

        future: list[LeaveFutureOut] = []
        if leave_future_out is not None:  # first, because it refuses some models
            with seeded_evaluation(model, seed):
                for part in parts("leave-future-out", len(keys), batch_size):
                    rows = on_device_of(model, batch.rows(part))
                    future.append(left_out_densities(model, rows, *leave_future_out, particles))
                    refuse_non_finite(label, "leave-future-out density", future[-1].elpd.isfinite(), keys[part])
        with seeded_evaluation(model, seed):
            scores = bounds(label, model, batch, keys, particles, estimates, parts("bounds", len(keys), batch_size))
        scores |= {"left out": future, "notes": list(bound_notes(label, model))}
        if filter_particles and (reason := obstacle(model, model.read(on_device_of(model, batch)))):
            scores["notes"].append(f"no FIVO bound: {reason}")
        elif filter_particles:
            with seeded_evaluation(model, seed):
                pieces = parts("FIVO bound", len(keys), batch_size)
                scores["bounds"] |= filtered(label, model, batch, keys, filter_particles, pieces)
        with seeded_evaluation(model, seed):
            scores["variances"] = variances(model, batch, parts("active units", len(keys), batch_size))
        with seeded_evaluation(model, seed):
            pieces = parts("information", len(contrast_indices), max(1, _PAIRS // max(1, len(contrast_indices))))
            scores["information"] = information(model, batch.rows(contrast_indices), pieces)
    return scores


def _contender(
    model: DynamicalVAE,
    seeds: Sequence[Mapping[str, Any]],
    free_running: Sequence[Mapping[str, Any]],
    config: dict[str, Any],
    is_mixture: bool,
) -> ModelResult:
    """Return a row of the comparison from the scores of all seeds.

    Args:
        model: model of any seed.
        seeds: teacher-forced scores of each seed.
        free_running: scores of the forecasts of each seed; of the mixture alone if the seeds form one.
        config: configuration given by the caller.
        is_mixture: whether the row is an `Ensemble`.
    """
    future = [seed["left out"] for seed in seeds]
    names = ("bounds", "kl_steps", "variances", "information", "estimates")
    scores = _stack([{name: seed[name] for name in names} for seed in seeds])
    if is_mixture:
        bounds = {name: values for name, values in scores["bounds"].items() if name.endswith(("ELBO", "bound"))}
        mixed = {name: np.logaddexp.reduce(values)[None] - math.log(len(seeds)) for name, values in bounds.items()}
        scores = {name: {} for name in names} | {
            "bounds": mixed | {"k-hat": scores["bounds"]["k-hat"].max(0, keepdims=True)},
            "estimates": np.logaddexp.reduce(scores["estimates"])[None] - math.log(len(seeds)),
        }
        future = [[mixture(parts) for parts in zip(*future, strict=True)]]
    columns = _stack([_future_columns(each) for each in future])
    scores["bounds"] |= {name: values for name, values in columns.items() if name != "steps"}
    equations = {"generative": model.generative.text, "inference": model.inference.text}
    scores["estimates"] = scores["estimates"].mean(0)
    return ModelResult(equations, config, **scores, free_running=_stack(free_running), notes=seeds[0]["notes"])


def _future_columns(parts: Sequence[LeaveFutureOut]) -> dict[str, np.ndarray]:
    """Return density, Monte Carlo error, effective particles and forecast steps of N sequences, (N,) each."""
    names = {"LFO": "elpd", "LFO error": "error", "LFO particles": "effective", "steps": "n_steps"}
    return {
        label: torch.cat([getattr(part, name) for part in parts]).double().cpu().numpy()
        for label, name in (names if parts else {}).items()
    }


def _contenders(models: Mapping[str, Any]) -> dict[str, list[DynamicalVAE]]:
    """Return a dictionary from row name to the models of all its seeds."""
    if not isinstance(models, Mapping):
        raise TypeError(f"models must be a mapping such as {{'srnn': model}}, not {type(models).__name__}")
    for name, value in models.items():
        if isinstance(value, Tensor | np.ndarray) or not isinstance(value, nn.Module | Iterable):
            raise TypeError(
                f"{name!r} is a {type(value).__name__}; expected a DynamicalVAE, or a list of them, one for each seed "
                "(`evaluate` scores forecasts without a model)"
            )
    if not models:
        raise ValueError("expected at least one row of models, got none")
    contenders = {
        name: list(value.models if isinstance(value, Ensemble) else [value] if isinstance(value, nn.Module) else value)
        for name, value in models.items()
    }
    for name, versions in contenders.items():
        require_same(repr(name), versions)
        for version in versions:
            (require_densities if isinstance(models[name], Ensemble) else require_likelihood)(version)
    return contenders


def _each(contenders: Mapping[str, list[Any]]) -> Iterator[tuple[str, str, Any]]:
    """Yield, for each seed, its label in messages, the name of its row, and the model."""
    for name, versions in contenders.items():
        for index, model in enumerate(versions):
            yield (name if len(versions) == 1 else f"{name}, model {index + 1}"), name, model


def _fingerprint(batch: Batch) -> str:
    """Return the SHA-256 of the names, shapes, types and values of all tensors of the batch."""
    digest = hashlib.sha256()
    for name, value in sorted(batch.leaves().items()):
        values = np.ascontiguousarray(value.cpu().numpy())
        digest.update(f"{name} {values.shape} {values.dtype}".encode() + values.tobytes())
    return digest.hexdigest()


def _stack(seeds: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Stack the arrays of all seeds along a new first axis, for each name."""
    columns = {key: [seed[key] for seed in seeds] for key in seeds[0]}
    return {
        key: _stack(values) if isinstance(values[0], Mapping) else np.stack(values) for key, values in columns.items()
    }
