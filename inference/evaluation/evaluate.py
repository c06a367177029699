"""Evaluation on held-out windows: forecasts and bounds.

Two kinds of scores are kept apart. *Free-running*: the model reads the observed steps and forecasts K futures, which
`Measure`s compare with the true one; the *log score* is the density of such forecasts at the true future.
*Teacher-forced*: the model reads every step of the window, and its bound on log p(x_{1:T}) is reported in nats per
step.

Every evaluation includes reference rows that any method should beat, such as repeating the last value; `References`
lists them. A model without latents, passed as one of the models, is another reference. Some scores add a row with the
true futures for comparison, which no method is expected to beat. All rows are scored on the same windows. Windows of
one cluster overlap, so standard errors are clustered and `Evaluation.difference` is paired.
"""

import dataclasses
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from reprlib import repr as brief
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ...capture import Captured, replayed
from ...data.batch import Batch
from ...data.sequences import HeldOutWindows, axis_names
from ...options import Count, Delay, require
from ...program.model import DynamicalVAE
from ...program.protocols import Emitting, Forecasting
from ..bounds.elbo import SequenceELBO, bound_notes, iwae_bound
from ..bounds.predictive import has_ode, predictive_bound
from .baselines import Forecaster
from .evaluation import Evaluation, Row
from .evaluation_windows import (
    EvaluationWindows,
    on_device_of,
    prepare_windows,
    refuse_non_finite,
    require_readable,
    seeded_evaluation,
)
from .external import ForecastSamples
from .record import plain
from .references import References
from .result import progress_bar
from .scores import KL, LOG_SCORE, TEACHER_FORCED, Measure, Metric, Scores, cluster_means, proper


def evaluate(
    model: nn.Module | Mapping[str, Any],
    windows: HeldOutWindows,
    *,
    scores: Scores = proper,
    samples: int = 50,
    seed: int = 0,
    batch_size: int = 32,
    draw_emission: bool | None = None,
    bound_particles: int = 0,
    log_score_particles: int = 0,
    references: bool | Sequence[str] = True,
    training_windows: HeldOutWindows | None = None,
    season: int | None = None,
    configs: Mapping[str, Mapping[str, Any]] | None = None,
    options: Mapping[str, Any] | None = None,
    progress: bool = True,
    cuda_graph: bool = False,
) -> Evaluation:
    """Score one or several models, and the reference rows, on the same windows.

    Every method draws from the same seed, so its scores do not depend on which others are evaluated. They do depend on
    `batch_size`, because draws are made by batch. The models' modes and torch's random state are restored.

    Args:
        model: a model (`Forecasting`), or `{name: model}`. In place of a model, samples of forecasts by other software:
            an array (K, N, T, D) in the order of `windows.keys`, a mapping from these keys to (K, T, D), a list of
            gluonts or darts forecasts, or the path of a file (`inference.evaluation.external`).
        windows: `ArrayWindows`, or any `HeldOutWindows`; for data with parts, such as `dvae.tables.PanelData`, the test
            split is used.
        scores: function from the windows to scores of forecasts: `proper` scoring rules, `calibrated`, which adds
            coverage and PIT, or scores of an application.
        samples: K, number of forecasts per window.
        seed: seed of every method's draws.
        batch_size: number of windows in a batch.
        draw_emission: whether forecasts are draws of x (True) or its means (False). Proper scoring rules assess the
            model's predictive distribution only if x is drawn. None for draws, or for means if a score is published for
            means (`Measure.of_means`); `DynamicalVAE.is_drawn` lists exceptions.
        bound_particles: number of particles of the IWAE bound and its k-hat; 0 omits both. Models with a bound in place
            of a density (`distributions.Diffusion`) have neither, and their ELBO is the mean of as many draws.
        log_score_particles: number of particles of the log score (`predictive_bound`); 0 omits it.
        references: whether to add all available reference rows; or the names of some (`References`).
        training_windows: training data of the reference rows, such as x (N, T, D); by default the training part of a
            table, and else none, so that rows that need them are omitted.
        season: period of the reference rows, in steps; by default from the windows' description.
        configs: `{name: configuration}`, stored with the rows; any JSON value.
        options: further arguments of the models' `forecast`, such as {"temperature": 0} for futures at the mean of the
            prior.
        progress: whether to show a progress bar.
        cuda_graph: on a CUDA GPU, whether to replay forecasts and bounds as CUDA graphs (`dvae.capture`). It has only
            been tested on a simulated GPU.

    Returns:
        The evaluation; print it, or use its `table`, `plot` and `to_json`.

    Raises:
        TypeError: when a model cannot forecast, forecasts have no samples, or the data do not define which steps are
            observed.
        ValueError: when windows are ragged or have no step to predict, a forecast has the wrong shape, or `samples` is
            below one. Also when two scores, or a model and a reference row, have the same name, or a requested
            reference row is not available.
        FloatingPointError: when a forecast or bound is not finite, naming method and window.

    Example:
        >>> model = dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2})
        >>> windows = dvae.ArrayWindows(torch.randn(6, 8, 2), observed=4)
        >>> list(dvae.evaluate(model, windows, samples=5, progress=False)["model"])[:3]
        ['energy score', 'variogram score', 'CRPS']
    """
    models: dict[str, Any] = dict(model) if isinstance(model, Mapping) else {"model": model}
    _check(samples, batch_size, bound_particles, log_score_particles)
    eval_windows = prepare_windows(windows)
    windows = eval_windows.windows
    given = {
        name: ForecastSamples.of(each, name, eval_windows.observed)
        for name, each in models.items()
        if not isinstance(each, Forecasting)
    }
    models = {name: each for name, each in models.items() if name not in given}
    external = {name: each.aligned(eval_windows, name) for name, each in given.items()}
    measures = _measures(scores, windows)
    means = any(measure.of_means for measure in measures)
    is_drawn = {name: _is_drawn(each, draw_emission, means) for name, each in models.items()}
    evaluator = _Evaluator(eval_windows, measures, bound_particles, log_score_particles)
    available = References(eval_windows, samples, seed, training_windows, season)
    baselines = _references(references, available, measures)
    if clash := (models.keys() | given.keys()) & baselines.keys():
        raise ValueError(f"a model must not have the name of a reference row: {', '.join(sorted(clash))}")

    if not (models or given or baselines):
        raise ValueError("expected at least one model, forecast or reference to score, got none")
    for name, each in models.items():
        require_readable(name, each, eval_windows.part(slice(0, 1)))
    rows: dict[str, Row] = {}
    with progress_bar(progress) as bar:

        def parts(label: str) -> Iterator[slice]:
            for start in bar.track(range(0, len(eval_windows.keys), batch_size), description=label):
                yield slice(start, start + batch_size)

        for name, (count, forecaster) in baselines.items():
            rows[name] = Row(count, **evaluator.forecasts(name, forecaster, count, parts(name)))
        for name, (count, forecaster) in external.items():
            config = {**(configs or {}).get(name, {}), **given[name].record()}
            rows[name] = Row(count, **evaluator.forecasts(name, forecaster, count, parts(name)), config=config)
        for name, each in models.items():
            with seeded_evaluation(each, seed):
                forecast_options = {"draw_emission": is_drawn[name], **(options or {})}
                graphs = _graphs_of(name, each) if cuda_graph else None
                forecaster = forecaster_of(each, eval_windows, samples, forecast_options, graphs)
                results = evaluator.forecasts(name, forecaster, samples, parts(f"{name}, forecasts"))
            if each.likelihood:
                with seeded_evaluation(each, seed):
                    results["cluster_means"] |= evaluator.bounds(name, each, parts(f"{name}, bound"), graphs)
            if each.likelihood or has_ode(each):
                with seeded_evaluation(each, seed):
                    results["cluster_means"] |= evaluator.log_score(name, each, parts(f"{name}, log score"), graphs)
            equations = {"generative": each.generative.text, "inference": each.inference.text}
            rows[name] = Row(samples, **results, equations=equations, config=dict((configs or {}).get(name, {})))

    kinds = {"drawn" if each else "mean" for each in is_drawn.values()}
    if not kinds:
        kinds = {"given" if given else "drawn" if _is_drawn(None, draw_emission, means) else "mean"}
    return Evaluation(
        rows=rows,
        metrics=evaluator.metrics(rows),
        clusters=eval_windows.clusters,
        data=eval_windows.description(),
        protocol=plain(dataclasses.asdict(windows.protocol)),
        samples=samples,
        emission=" or ".join(sorted(kinds)),
        bound_particles=bound_particles,
        seed=seed,
        log_score_particles=log_score_particles,
        basis={name: value for measure in measures for name, value in measure.basis.items()},
        notes=[
            *dict.fromkeys([*eval_windows.notes, *(measure.note for measure in measures if measure.note)]),
            *(available.notes if references is True else ()),
            *_given_notes(
                {name: count for name, (count, _) in external.items()},
                [name for name, each in given.items() if each.keys is None],
                samples if models else None,
            ),
            *(
                f"{name} has samples outside the values of a column, which are scored as they are: {'; '.join(columns)}"
                for name, each in given.items()
                if (columns := [*each.outside(windows)])
            ),
            *_forecast_notes(
                measures,
                samples,
                [name for name, each in given.items() if each.emission == "mean"]
                + [name for name, each in is_drawn.items() if not each],
            ),
            *(
                f"{name} is deterministic: its {samples} forecasts of a window are equal, and so is the best of them"
                for name, each in models.items()
                if samples > 1 and _is_deterministic(each, is_drawn[name])
            ),
            *(
                f"bounds of {name}: densities of {each.view.quantity}"
                for name, each in models.items()
                if isinstance(each, DynamicalVAE) and each.likelihood and each.view.quantity
            ),
            *(n for name, each in models.items() if isinstance(each, DynamicalVAE) for n in bound_notes(name, each)),
        ],
        options=dict(options or {}),
    )


def _check(samples: int, batch_size: int, *particles: int) -> None:
    require(Count, samples=samples, batch_size=batch_size)
    for name, count in zip(("bound_particles", "log_score_particles"), particles, strict=True):
        require(Delay, **{name: count})


def _measures(scores: Scores, windows: HeldOutWindows) -> list[Measure]:
    if not callable(scores):
        raise TypeError(
            f"scores is {brief(scores)}; expected a function of the windows, such as "
            "dvae.inference.evaluation.scores.proper"
        )
    measures = list(scores(windows))
    names = [measure.name for measure in measures]
    if duplicates := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"scores must have different names, but several are called {', '.join(sorted(duplicates))}")
    return measures


def _is_drawn(model: Any, draw_emission: bool | None, means: bool) -> bool:
    """Return whether a model's forecasts draw the data: `draw_emission`, or if None, the model's default."""
    if draw_emission is not None:
        return draw_emission
    return model.is_drawn(means) if isinstance(model, Emitting) else not means


def _is_deterministic(model: Any, is_drawn: bool) -> bool:
    """Return whether all forecasts of a window are equal: means of a model without latents."""
    return isinstance(model, DynamicalVAE) and not (is_drawn or model.latents or model.summed or model.shared)


def _given_notes(counts: Mapping[str, int], in_order: Sequence[str], samples: int | None) -> Iterator[str]:
    """Yield notes on forecasts of other software: numbers of samples per window, and names of rows without keys."""
    if counts:
        yield f"forecasts of {', '.join(counts)} were given, and not drawn from a model here"
    if in_order:
        yield f"forecasts of {', '.join(in_order)} have no keys: they are read in the order of the windows"
    if other := [f"{name} ({count})" for name, count in counts.items() if samples not in (None, count)]:
        yield f"best-of-K scores are not comparable with those of K = {samples}: {', '.join(other)}"


def _forecast_notes(measures: Sequence[Measure], samples: int, of_means: Sequence[str]) -> Iterator[str]:
    """Yield notes on scores that are not available or not informative for these forecasts."""
    if omitted := [f"{measure.name} ({measure.least})" for measure in measures if measure.least > samples]:
        yield f"left out, with the number of forecasts that they need, more than {samples}: {', '.join(omitted)}"
    affected = [each.name for each in measures if each.of_draws and not each.of_means and each.least <= samples]
    if of_means and affected:
        names = f"forecasts of {', '.join(of_means)}"
        yield f"{names} are means without emission noise, and too narrow for {', '.join(affected)}"


@dataclass(frozen=True)
class _Evaluator:
    """Computation of the scores of each row, by cluster."""

    eval_windows: EvaluationWindows
    measures: Sequence[Measure]
    bound_particles: int
    log_score_particles: int

    @torch.no_grad()
    def forecasts(self, name: str, forecaster: Forecaster, samples: int, parts: Iterator[slice]) -> dict[str, Any]:
        """Return the `cluster_means`, `histograms` and `counts` of a `Row`.

        Args:
            name: name of the method, for errors.
            forecaster: function from a slice of windows to futures (K, B, H, D).
            samples: K, number of forecasts per window; scores that need more are omitted.
            parts: slices of the windows, evaluated one after another.
        """
        measures = [measure for measure in self.measures if measure.least <= samples]
        eval_windows, results = self.eval_windows, []
        index = torch.arange(len(eval_windows.keys))
        for part in parts:
            forecasts = forecasts_of(name, forecaster, samples, eval_windows, part)
            arguments = forecasts, eval_windows.futures[part], eval_windows.past(part), index[part]
            results.append({measure.name: measure.function(*arguments) for measure in measures})
        values = _concatenate(results)
        results_by_kind: dict[str, dict[str, np.ndarray]] = {"cluster_means": {}, "histograms": {}, "counts": {}}
        for measure in measures:
            kind, of_windows = "histograms" if measure.bins else "cluster_means", values[measure.name]
            results_by_kind[kind][measure.name] = np.array(measure.pool(of_windows, eval_windows.places))
            if measure.partial and (missing := of_windows.isnan().reshape(len(index), -1).any(1)).any():
                counts = np.bincount(eval_windows.places, weights=~missing)
                results_by_kind["counts"][measure.name] = counts.astype(int)
        return results_by_kind

    def bounds(self, name: str, model: Any, parts: Iterator[slice], graphs: Captured | None) -> dict[str, np.ndarray]:
        """Return bounds, KL terms and k-hat by name, in nats per step, for each cluster."""
        results, weighted = [], self.bound_particles > 0 and not getattr(model, "bounded", ())
        elbo = SequenceELBO(1 if weighted else max(self.bound_particles, 1))

        def terms_of(batch: Batch) -> dict[str, Tensor]:
            terms = elbo.terms(model, batch)
            divergences = {f"KL {latent}": kl / terms.n_steps for latent, kl in terms.kl.items()}
            return {"ELBO": terms.per_step, **divergences, "steps": terms.n_steps}

        run = replayed(graphs, "bound", terms_of)
        for part in parts:
            batch = on_device_of(model, self.eval_windows.part(part))
            scores = dict(run(batch))
            steps = scores.pop("steps")
            if weighted:
                iwae = iwae_bound(model, batch, particles=self.bound_particles, graphs=graphs)
                scores |= {"IWAE bound": iwae.bound / steps, "k-hat": iwae.khat}
            refuse_non_finite(name, "bound", scores["ELBO"].isfinite(), self.eval_windows.keys[part])
            results.append({metric: values.cpu() for metric, values in scores.items()})
        return self._means(_concatenate(results))

    def log_score(
        self, name: str, model: Any, parts: Iterator[slice], graphs: Captured | None
    ) -> dict[str, np.ndarray]:
        """Return the log score by its name, in nats per predicted step, for each cluster; empty if not requested."""
        if not self.log_score_particles:
            return {}
        results = []
        for part in parts:
            batch = on_device_of(model, self.eval_windows.part(part))
            options: Any = {"particles": self.log_score_particles, "graphs": graphs}
            bound = predictive_bound(model, batch, self.eval_windows.observed, **options).bound
            refuse_non_finite(name, "log score", bound.isfinite(), self.eval_windows.keys[part])
            results.append({"log score": (bound / self.eval_windows.futures.shape[1]).cpu()})
        return self._means(_concatenate(results))

    def metrics(self, rows: Mapping[str, Row]) -> dict[str, Metric]:
        """Return the metrics of all scores in the rows, in the order of the table."""
        names = {name for row in rows.values() for name in row.cluster_means}
        latents = sorted(name for name in names if name.startswith("KL "))
        _, step = axis_names(self.eval_windows.windows.description)
        bounds = {"log score": LOG_SCORE, **TEACHER_FORCED, **dict.fromkeys(latents, KL)}
        order = {measure.name: measure.metric for measure in self.measures}
        order |= {
            name: dataclasses.replace(each, unit=each.unit.replace("step", step)) for name, each in bounds.items()
        }
        return {name: metric for name, metric in order.items() if name in names}

    def _means(self, scores: dict[str, Tensor]) -> dict[str, np.ndarray]:
        return {name: np.array(cluster_means(values, self.eval_windows.places)) for name, values in scores.items()}


def _references(
    requested: bool | Sequence[str], available: References, measures: Sequence[Measure]
) -> dict[str, tuple[int, Forecaster]]:
    """Return the number of forecasts and the forecaster of each reference row."""
    futures = available.held.futures
    truths: dict[str, tuple[int, Forecaster]] = {
        measure.truth: (1, lambda part: futures[part][None]) for measure in measures if measure.truth
    }
    if isinstance(requested, bool):
        requested = available.usual if requested else []
        truths = truths if requested else {}
    return truths | {name: available[name] for name in requested}


def _graphs_of(name: str, model: nn.Module) -> Captured | None:
    """Return CUDA graphs for a model on a GPU; warn if it is elsewhere."""
    device = next(model.parameters()).device
    if device.type == "cuda":
        return Captured(f"the evaluation of {name}", device)
    warnings.warn(f"{name} is evaluated without CUDA graphs: the device is {device.type}, not cuda", stacklevel=3)
    return None


def forecaster_of(
    model: Any,
    windows: EvaluationWindows,
    samples: int,
    options: Mapping[str, Any],
    graphs: Captured | None = None,
) -> Forecaster:
    """Return a function that forecasts futures (K, B, H, D) of a slice of windows.

    Args:
        model: model that forecasts.
        windows: windows to forecast.
        samples: K, number of futures per window.
        options: further arguments of the model's `forecast`.
        graphs: CUDA graphs by which to replay the forecasts.
    """

    def forecast(batch: Batch) -> dict[str, Tensor]:
        return {"x": model.forecast(batch, windows.futures.shape[1], samples, **options)["x"]}

    run = replayed(graphs, "forecast", forecast)
    return lambda part: run(on_device_of(model, windows.past(part)))["x"]


def forecasts_of(name: str, forecaster: Forecaster, samples: int, windows: EvaluationWindows, part: slice) -> Tensor:
    """Return futures `(B, K, H, D)` of some windows, on the CPU.

    Args:
        name: name of the method, for errors.
        forecaster: function from a slice of windows to futures (K, B, H, D).
        samples: K, number of futures per window.
        windows: all windows.
        part: slice of the windows to forecast.

    Raises:
        ValueError: when forecasts have another shape.
        FloatingPointError: when forecasts are not finite.
    """
    forecasts = forecaster(part).cpu()
    expected = (samples, *windows.futures[part].shape)
    if forecasts.shape != expected:
        raise ValueError(f"forecasts of {name} must be (K, B, T, D) = {expected}, got {tuple(forecasts.shape)}")
    if not forecasts.sum().isfinite():  # 40 times faster than a test of each value
        refuse_non_finite(name, "forecast", forecasts.isfinite().all(-1).all(-1).all(0), windows.keys[part])
    return forecasts.movedim(0, 1)


def _concatenate(parts: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
