"""Fit every method for motion on every set, score it on the test windows, and rank the methods.

Options and training are the presets', chosen with the tuning protocol (`benchmarks.studies.tuning`). Runs are stored in
`RUNS/SET/METHOD-seedN`. Scores by clip, from which the tables are made, are stored in `SCORES/SET` with the metric
models that computed them. An interrupted script therefore continues, also on another machine, and scores further
methods with the same metric models. Without `--data` nothing is fitted.
"""

from __future__ import annotations

import fnmatch
import itertools
import json
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import tyro
from matplotlib.figure import Figure
from torch import nn

import dvae
from dvae import Evaluation, Training, files, motion
from dvae.inference.evaluation.estimates import TwoWayErrors
from dvae.inference.evaluation.metrics import average_pairwise_distance
from dvae.inference.evaluation.multiple_comparisons import confidence_set
from dvae.inference.evaluation.result import new_figure, styled
from dvae.inference.evaluation.scores import Measure
from dvae.inference.training.checkpoints import Run
from dvae.models import registry
from dvae.motion.data.dataset import MotionData
from dvae.motion.geometry.parts import UNIONS, body_parts
from dvae.runs.directory import load

from .engine import Archive, Row, cell, folder, settings, sweep_seeds
from .results import DOCS, Table, refuse_unknown, require_gpu, same, write

SCORES = Path(__file__).parents[1] / "scores"
Accelerator = Literal["cpu", "cuda"]

_SETTINGS = settings(__file__)
FUTURES: dict[str, dict[str, Any]] = _SETTINGS["futures"]
PATHS: dict[str, dict[str, Any]] = _SETTINGS["paths"]
STEPS: dict[str, int] = _SETTINGS["steps"]
CURVES: dict[str, dict[str, Any]] = _SETTINGS["curves"]
ALIKE, ALIKE_PATHS = (
    {row: {**options, "steps": STEPS[row]} for row, options in methods.items()} for methods in (FUTURES, PATHS)
)
"""The same methods with the same training time."""


@dataclass(frozen=True)
class View:
    """Conditions and options of a prediction of the test windows.

    Args:
        given: number of joints with given paths, in the order of `JOINTS`; None for methods without paths.
        single: whether to predict one motion from the prior's mean instead of draws.
        exchanged: largest distance in metres of the given joints in another window's pose, used as the start; 0 for
            the window's own.
        own: whether windows with such a pose keep their own one.
        truth: see `motion.ExchangedWindows`.
        observed: number of observed frames; None for the protocol's.
        metric_models: names joined by +; empty for the set's.
        parts: diversity of body parts, in "free" futures, in futures with the first draw of the lower body
            "held", or in the futures with the lower body "nearest" to the first one's.
    """

    given: int | None = None
    single: bool = False
    exchanged: float = 0.0
    own: bool = False
    truth: Literal["path", "pose"] = "path"
    observed: int | None = None
    metric_models: str = ""
    parts: Literal["", "free", "held", "nearest"] = ""

    def windows(self, data: MotionData, split: str) -> Any:
        """Return the windows of a split, with the given paths."""
        observed = self.observed or data.protocol.observed
        windows = motion.windows(data.motion, replace(data.protocol, observed=observed), split)
        if self.given is None:
            return windows
        others = [name for name in windows.joints if name not in JOINTS]
        conditioned = windows.given([*JOINTS, *others][: self.given])
        if not self.exchanged or split != "test":
            return conditioned
        return motion.ExchangedWindows(conditioned, self.exchanged, own_pose=self.own, truth=self.truth)

    def evaluate(self, samples: int) -> dict[str, Any]:
        """Return arguments of `dvae.evaluate`."""
        return {"samples": 1, "options": {"temperature": 0}} if self.single else {"samples": samples}

    def member(self, run: str) -> str:
        """Return the name of the scores of a run in an archive."""
        parts = (f"{name}-{value}" for name, value in vars(self).items() if value != getattr(View, name))
        return f"{run}/{'-'.join(['scores', *parts])}.json"


@dataclass(frozen=True)
class Set:
    """A file of clips below the data folder, with the methods and views to fit and score.

    Args:
        file: path of the clips below the data folder.
        methods: options of the methods by row.
        views: views of each method.
        metric_models: names in `METRIC_MODELS`.
        like: name of the set that provides the protocol, metric models and reference rows; empty for its own.
    """

    file: str
    methods: Mapping[str, Mapping[str, Any]]
    views: tuple[View, ...] = (View(),)
    metric_models: tuple[str, ...] = ()
    like: str = ""


BANDAI, CMU = "bandai/bandai2.npz", "cmu/cmu8.npz"
GIVEN = tuple(View(count) for count in range(5))
SETS = {
    "bandai2-by-style": Set(BANDAI, FUTURES, metric_models=("prior", "content")),
    "bandai2-by-style-alike": Set(BANDAI, ALIKE, metric_models=("prior", "content"), like="bandai2-by-style"),
    "bandai2-by-take": Set(BANDAI, ALIKE, metric_models=("prior", "content")),
    "bandai2-by-take-curves": Set(BANDAI, CURVES, metric_models=("prior", "content"), like="bandai2-by-take"),
    "cmu8": Set(CMU, ALIKE, metric_models=("prior", "content")),
    "bandai2-trajectories": Set(BANDAI, PATHS, GIVEN),
    "bandai2-trajectories-alike": Set(BANDAI, ALIKE_PATHS, GIVEN, like="bandai2-trajectories"),
    "cmu8-trajectories": Set(CMU, ALIKE_PATHS, GIVEN),
}
JOINTS = ("RToe", "LToe", "LWrist", "RWrist")
"""Joints with given paths, in the order of TrajeVAE's tables."""
CLASSIFIER = Training(steps=3000, learning_rate=3e-3, decay=0.5, validate_every=250)
METRIC_MODELS: dict[str, tuple[str, dict[str, Any], Training]] = {
    "prior": ("pose-prior", {"heading": True}, Training(steps=1000, learning_rate=0.01, decay=0.8)),
    "content": ("action-classifier", {}, CLASSIFIER),
    "group": ("action-classifier", {"label": "group"}, CLASSIFIER),
}
"""Metric models, their options and their training."""
COLUMNS = ("energy score", "ADE", "FDE", "ADEm", "MMADE", "APD", "APDE", "CMD", "limb stretch", "limb jitter")
METRIC_MODEL_COLUMNS = ("ACC content", "FID content", "pose NLL")
OTHERS = ("FDEm", "MMFDE", "MMADEm", "MMFDEm", "path error", "global ADE")
"""Further scores in the tables of papers."""
GROUPED = ("ACC group", "FID group")
PARTED = tuple(f"APD {part}" for part in UNIONS)
SHOWN = {*COLUMNS, *METRIC_MODEL_COLUMNS, *OTHERS, *GROUPED, *PARTED}
RANKED = "energy score"
"""Score that orders the rows: a proper scoring rule, lower is better."""
NEIGHBOURS = "nearest neighbours"
ENOUGH = 3
"""Number of seeds a row needs to be called the best; fewer seeds estimate their spread poorly."""
LEVEL = 0.9
"""Level of intervals and of the model confidence set."""


def stored_part(evaluation: Evaluation, run: Path | None) -> dict[str, Any]:
    """Return the stored part of an evaluation: scores by clip of a run, or of all reference rows.

    Returns:
        `basis`, windows, draws and metric models, which all rows of a table share; windows by clip; scores, of four
        digits, by row and clip; `minutes` of processor time that the fit took; and `config`, method and training,
        without paths.
    """
    rows = {
        name: {
            score: [float(f"{value:.4g}") for value in values]
            for score, values in row.cluster_means.items()
            if score in SHOWN
        }
        for name, row in evaluation.rows.items()
    }
    result = {"basis": same(evaluation), "clips": evaluation.clusters, "rows": rows, "minutes": 0.0, "config": {}}
    if run is not None:
        fitted_run = Run(run)
        options = {name: value for name, value in fitted_run.config["method"].items() if not name.endswith("_run")}
        result["config"] = {"method": options, "training": fitted_run.config["training"]}
        result["minutes"] = fitted_run.state.get("processor_seconds", 0.0) / 60
    return result


def fitted_metric_models(data: MotionData, runs: Path, names: Sequence[str] = ("prior", "content")) -> dict[str, Path]:
    """Fit missing metric models to the training clips, and return the run directories of all."""
    for name in names:
        method, options, training = METRIC_MODELS[name]
        clips = with_groups(data) if options.get("label") == "group" else data
        (metric_model,) = sweep_seeds(
            name, registry.metric_models()[method](**options), clips, runs / "metric_models", (0,), training
        )
        config = metric_model / "config.json"  # stored in the repository, without paths of this machine
        text = config.read_text(encoding="utf-8")
        if (placeless := text.replace(json.dumps(data.path), json.dumps(Path(data.path).name))) != text:
            with files.atomic_write(config) as new:  # atomic, because other processes may read the file
                new.write(placeless.encode())
    return {name: runs / "metric_models" / f"{name}-seed0" for name in names}


def with_groups(data: MotionData) -> MotionData:
    """Return clips with a label for the group of their content, such as all kinds of walks."""
    labels = [{**clip.labels, "group": clip.labels["content"].split("-")[0]} for clip in data.motion]
    clips = [replace(clip, labels=each) for clip, each in zip(data.motion, labels, strict=True)]
    return replace(data, motion=motion.MotionSet(clips, data.motion.skeleton, data.motion.name, copy=False))


def motion_scores(metric_models: Mapping[str, Path]) -> Any:
    """Return the motion scores of the tables, including scores by the given metric models."""
    models = {name: load(path).model for name, path in metric_models.items()}
    prior = models.pop("prior", None)

    def scores(windows: Any) -> list[Measure]:
        return [each for each in motion.scores(windows, prior, models) if each.name in SHOWN]

    return scores


def fit(
    data: MotionData,
    row: str,
    methods: Mapping[str, Mapping[str, Any]],
    seed: int,
    runs: Path,
    prior: Path | None,
    accelerator: Accelerator = "cpu",
) -> Path:
    """Fit a method if its run is missing, and return the run directory; second stages use the CVAE of the same seed."""
    method_options, training = split_options({**methods[row], "accelerator": accelerator})
    method = method_options.pop("method", row)
    if method in ("gsps", "hit-dvae") and prior is not None and method_options.get("pose_prior") != 0:
        method_options["pose_prior_run"] = str(prior.absolute())
    if method in ("dlow", "dsf"):
        method_options["cvae_run"] = str(fit(data, "cvae", methods, seed, runs, prior, accelerator).absolute())
    (path,) = sweep_seeds(row, dvae.method(method, **method_options), data, runs, (seed,), training)
    return path


def split_options(options: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split options into options of the method and options of its training."""
    # methods have an option of this name too, which sets the training schedule
    training = Training.__dataclass_fields__.keys() - {"scheduled_sampling"}
    return (
        {name: value for name, value in options.items() if name not in training},
        {name: value for name, value in options.items() if name in training},
    )


def work(
    data: Path,
    runs: Path,
    stored: Path,
    name: str,
    methods: Mapping[str, Mapping[str, Any]],
    views: Mapping[str, Sequence[View]],
    seeds: Sequence[int],
    samples: int,
    accelerator: Accelerator = "cpu",
) -> None:
    """Fit and score missing results, seed by seed, so that each method has one seed before any has two.

    Args:
        data: the folder of files.
        runs: folder of the runs of all sets.
        stored: folder of the scores of all sets.
        name: name of the set.
        methods: options of the methods by row.
        views: views of each method; reference rows are scored in all views.
        seeds: seeds of each method.
        samples: number of futures of each window.
        accelerator: device for training and forecasts.
    """
    if accelerator == "cuda":
        require_gpu("accelerator")
    store, like = archive(stored, name), SETS[name].like or name
    dataset = MotionData.open(data / SETS[name].file, motion.PROTOCOLS[like])
    metric_models = fitted_metric_models(dataset, stored / like, SETS[name].metric_models)

    def score(path: Path | None, row: str, view: View) -> dict[str, Any]:
        data, by = dataset, metric_models
        if view.metric_models:
            data, by = with_groups(dataset), fitted_metric_models(dataset, stored / like, view.metric_models.split("+"))
        elif view.observed:  # a pose prior reads windows rotated at the last observed frame of its own protocol
            by = {metric_model: run for metric_model, run in metric_models.items() if metric_model != "prior"}
        models = {} if path is None else {row: load(path).model.to(accelerator)}
        extra: dict[str, Any] = {"training_windows": view.windows(data, "train+validation")}
        options = {"references": False} if models else extra
        windows, options_of_view = view.windows(data, "test"), view.evaluate(samples)
        if view.parts:
            wrappers: dict[str, Any] = {
                "held": FixedLowerBody,
                "nearest": partial(NearestLowerBody, lower=coordinates_of_parts(windows)["lower"]),
            }
            models = {name: wrappers.get(view.parts, lambda free: free)(model) for name, model in models.items()}
        scores = diversities if view.parts else motion_scores(by)
        return stored_part(
            dvae.evaluate(models, windows, scores=scores, batch_size=64, **options, **options_of_view), path
        )

    references = archive(stored, like)
    for view in dict.fromkeys(view for each in views.values() for view in each):
        member = view.member(REFERENCES)
        if not (view.single or view.exchanged or view.parts in ("held", "nearest") or member in references.names):
            references.add(member, score(None, REFERENCES, view))
    every = {**SETS[name].methods, **methods}  # a second stage uses the set's options of its first stage
    for seed, row in itertools.product(seeds, methods):
        members = {view: view.member(f"{folder(row)}-seed{seed}") for view in views[row]}
        if missing := {view: member for view, member in members.items() if member not in store.names}:
            path = fit(dataset, row, every, seed, runs / name, metric_models.get("prior"), accelerator)
            for view, member in missing.items():
                store.add(member, score(path, row, view))


class WrappedModel(nn.Module):
    """Wrap a model for forecasts; subclasses implement `forecast`."""

    likelihood = False

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model, self.generative, self.inference = model, model.generative, model.inference


class FixedLowerBody(WrappedModel):
    """A model whose futures share the lower-body latent of the first draw."""

    def forecast(self, past: Any, horizon: int, samples: int, **options: Any) -> Any:
        """Return futures of a model with the latent `lower`."""
        lower = self.model.forecast(past, horizon, 1, **options)["lower"][0]
        return self.model.forecast(past, horizon, samples, fix={"lower": lower}, **options)


class NearestLowerBody(WrappedModel):
    """A model that draws `MANY` times as many futures and keeps those with the lower body nearest to the first one's.

    GSPS selects DLow's futures with a fixed lower body in the same way: the nearest 50 of 1,000.
    """

    MANY = 20

    def __init__(self, model: Any, lower: Sequence[int]) -> None:
        super().__init__(model)
        self.lower = lower

    def forecast(self, past: Any, horizon: int, samples: int, **options: Any) -> Any:
        """Return the futures with the smallest squared distance over all frames."""
        candidates = self.model.forecast(past, horizon, self.MANY * samples, **options)["x"]
        lower = candidates[..., self.lower]
        nearest = (lower - lower[0]).square().sum((2, 3)).topk(samples, 0, largest=False).indices
        return {"x": candidates.take_along_dim(nearest[..., None, None], 0)}


def coordinates_of_parts(windows: Any) -> dict[str, list[int]]:
    """Return the indices of the coordinates of each body part."""
    parts = body_parts(windows.skeleton, tuple(UNIONS))
    return {part: [3 * joint + axis for joint in joints for axis in range(3)] for part, joints in parts.items()}


def diversities(windows: Any) -> list[Measure]:
    """Return the diversity of whole futures and of each body part."""

    def of(place: Any) -> Any:
        return lambda forecasts, *_: average_pairwise_distance(forecasts[..., place])

    selections = {"APD": slice(None)} | {f"APD {part}": place for part, place in coordinates_of_parts(windows).items()}
    return [Measure(name, of(place), "m", "higher") for name, place in selections.items()]


REFERENCES = "references"


def archive(stored: Path, name: str) -> Archive:
    """Return the archive of the scores of a set."""
    return Archive(stored / f"{name}.zip")


def entries(stored: Path, name: str, view: View, methods: Iterable[str]) -> dict[str, Row]:
    """Return the rows scored on a set: references, then methods with their seeds.

    Raises:
        ValueError: scores of other windows, samples, or metric models.
    """
    rows, basis = dict[str, Row](), None
    store, like = archive(stored, name), archive(stored, SETS[name].like or name)
    if view.member(REFERENCES) in like.names:
        references = like.read([view.member(REFERENCES)])
        basis = references[0]["basis"]
        rows = {row: Row(references, row, trained=False) for row in references[0]["rows"]}
    names = store.names
    for row in methods:
        if members := fnmatch.filter(names, view.member(f"{folder(row)}-seed*")):
            runs = store.read(members)
            basis = basis or runs[0]["basis"]
            if any(comparable_basis(each["basis"]) != comparable_basis(basis) for each in runs):
                raise ValueError(
                    f"scores of {row} in {store.file} differ from the others in windows, samples, seed or metric models"
                )
            rows[row] = Row(runs, row)
    return rows


def rows_of(stored: Path, name: str, view: View) -> dict[str, Row]:
    """Return the scored rows of a set with the reference rows; empty if no method is scored."""
    rows = entries(stored, name, view, SETS[name].methods)
    return rows if any(entry.trained for entry in rows.values()) else {}


EMISSION = 3
"""Position in a basis of the kind of forecasts: means or draws."""
IDENTITY = "fingerprint", "windows", "given"
"""Entries that identify the windows of a basis."""


def comparable_basis(basis: Sequence[Any]) -> list[Any]:
    """Return the entries of a basis that the rows of a table must share: all except the kind of forecasts.

    Of the windows, only entries that identify them count, because versions describe windows with different entries.
    """
    windows, *others = basis
    return [*(windows.get(name) for name in IDENTITY), *others[: EMISSION - 1], *others[EMISSION:]]


def row_label(name: str, entry: Row) -> str:
    """Return the label of a row, with the options that distinguish it."""
    first = entry.runs[0]
    modes = first["config"].get("method", {}).get("modes")
    details = ["drawn"] * (first["basis"][EMISSION] == "drawn") + ([] if modes is None else [f"{modes} modes"])
    return f"{name} ({', '.join(details)})" if details else name


TRAINED = ("seeds", "CPU minutes")


def training_cells(entry: Row) -> tuple[str, str]:
    """Return the number of seeds and the mean minutes of the fits on a CPU."""
    if not entry.trained:
        return "–", "–"
    here = [run["minutes"] for run in entry.runs if run["config"]["training"]["accelerator"] != "cuda"]
    return str(len(entry.runs)), f"{statistics.fmean(here):.1f}" if here else "GPU"


def rank_by_energy(rows: Mapping[str, Row]) -> dict[str, TwoWayErrors]:
    """Return the energy scores of all rows except real motion, best first."""
    scores = {name: entry.two_way_errors(RANKED) for name, entry in rows.items() if name != "real motion"}
    complete = {name: score for name, score in scores.items() if score is not None}  # every motion method has the score
    return dict(sorted(complete.items(), key=lambda item: item[1].mean))


def ranking(rows: Mapping[str, Row], columns: Sequence[str]) -> Table:
    """Return rows sorted by energy score, with differences to the neighbours and to the row above.

    The note is the model confidence set.
    """
    scores = rank_by_energy(rows)
    header = ["", *TRAINED, f"{RANKED} minus neighbours'", "minus the one above", *columns]
    lines = []
    for name, above in zip(scores, [None, *scores], strict=False):
        row = rows[name]
        minus = [None if name == NEIGHBOURS else NEIGHBOURS, above]
        behind = [None if other is None else scores[name].estimate(scores[other]) for other in minus]
        lines.append([row_label(name, row), *training_cells(row), *map(cell, [*behind, *map(row.estimate, columns)])])
    tested = {name: score for name, score in scores.items() if score.count >= ENOUGH}
    if not any(rows[name].trained for name in tested):
        return Table(header, lines)
    best = f"May be the best, at {100 * LEVEL:.0f} % over clips and seeds, of rows with {ENOUGH} seeds or more"
    return Table(header, lines, f"{best}: {', '.join(confidence_set(tested, level=LEVEL).members)}.")


@styled
def draw_ranking(sets: Mapping[str, Mapping[str, Row]]) -> Figure:
    """Draw the energy scores minus the neighbours' for each set; all panels use the row order of the first."""
    ranks = {name: rank_by_energy(rows_of_set) for name, rows_of_set in sets.items()}
    order = list(dict.fromkeys(row for scores in ranks.values() for row in scores if row != NEIGHBOURS))
    columns = min(2, len(sets))
    rows = math.ceil(len(sets) / columns)
    figure = new_figure(1.8 + 3.4 * columns, rows * (0.6 + 0.2 * len(order)))
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False).flat
    for panel, (name, scores) in zip(panels, ranks.items(), strict=True):
        panel.axvline(0, color="0.6", lw=0.8)
        for row in scores.keys() & order:
            minus, height = scores[row].estimate(scores[NEIGHBOURS]), order.index(row)
            for error, width in (("sequences", 4), ("total", 1)):
                panel.plot(minus.interval(LEVEL, error), [height] * 2, color="C0", lw=width, solid_capstyle="butt")
            face = "C0" if scores[row].count >= ENOUGH else "white"
            panel.plot(minus.mean, height, "o", color="C0", markerfacecolor=face)
        panel.set_title(name)
        panel.set_xlabel(f"{RANKED} minus neighbours' (m)")
        panel.grid(axis="x", alpha=0.3)
    panels[0].set_yticks(range(len(order)), order)
    panels[0].invert_yaxis()
    return figure


def main(
    runs: tyro.conf.Positional[Path],
    data: Path | None = None,
    sets: tuple[str, ...] = tuple(SETS),
    methods: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (0, 1, 2),
    samples: int = 50,
    scores: Path = SCORES,
    accelerator: Accelerator = "cpu",
    results: Path | None = None,
    picture: Path = DOCS / "img" / "ranking.png",
) -> None:
    """Fit and score missing results, and write the tables.

    Args:
        runs: folder of the run directories.
        data: the folder with bandai/ and cmu/; without it nothing is fitted.
        sets: names of sets.
        methods: names of methods to fit; all methods of a set if empty.
        seeds: seeds of each method.
        samples: number of futures of each window.
        scores: folder of scores and metric models; an empty folder starts from the beginning.
        accelerator: device for training and forecasts; runs on a GPU record no minutes.
        results: folder of the tables, such as benchmarks/results; None prints them.
        picture: figure of all sets without given paths; drawn only with results.
    """
    refuse_unknown("set", sets, SETS)
    refuse_unknown("method", methods, {**FUTURES, **PATHS, **CURVES})
    for name in sets:
        selected = SETS[name]
        if data is not None:
            selected_methods = {
                row: options for row, options in selected.methods.items() if not methods or row in methods
            }
            work(
                data,
                runs,
                scores,
                name,
                selected_methods,
                dict.fromkeys(selected_methods, selected.views),
                seeds,
                samples,
                accelerator,
            )
        for view in selected.views:
            if rows := rows_of(scores, name, view):
                table = ranking(rows, [*COLUMNS, *(METRIC_MODEL_COLUMNS if selected.metric_models else ())])
                suffix = "" if view.given is None else f"-{view.given}-given"
                write(results, {f"index/{name}{suffix}": table})
    drawn = [name for name, each in SETS.items() if View() in each.views and each.methods is not CURVES]
    sought = {name: rows_of(scores, name, View()) for name in drawn}
    futures = {name: rows for name, rows in sought.items() if rows}
    if results is not None and futures:
        draw_ranking(futures).savefig(picture, dpi=200)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
