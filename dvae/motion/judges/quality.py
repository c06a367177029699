"""The judge of quality: a classifier that tells windows of real motion from those whose future a model made.

    p(c | x_{1:T})        c = 1 of real motion, 0 where x_{O+1:T} was forecast from x_{1:O}

A GRU reads the whole window, observed frames and future, and three layers its last state:

    p(c | x_{1:T}) = Bernoulli(sigmoid(FC(relu(FC(relu(FC(GRU(x_{1:T})_T)))))))

It is fitted to windows of the training split, as they are and with the futures that one model makes of them, and judges
held-out ones. A model whose motion nobody can tell from real motion leaves it at guessing:

    quality = 100 % - accuracy        50 % is the best; 0 % where every window is told

the mean of the share of real windows that are taken for made, and of made ones that are taken for real. The second
alone, "taken for real", is given beside it; it would also be high of a classifier that takes everything for real, as it
may in styles of motion that it has not seen.

Aliakbarian, Saleh, Salzmann, Petersson and Gould, 2020, arXiv 1908.00733, sections 3.3 and 4.1 and figure 5: a GRU of
1024, layers of 512, 128 and 1, stochastic gradient descent with a rate of .01 and momentum .9, 5000 steps, 256 windows
in a batch, 25,000 windows of each kind. Ours:

* All futures are those of the model as it is, one each, means of the emission. The paper's are from different steps of
  its training, so that early ones are easier to tell.
* The width is an option, 128 by default; the layers are its half and eighth, as the paper's are.
* What is seen are positions relative to the pelvis, without it, each window turned to one heading at its last observed
  frame: who faces where tells nobody apart. The paper says nothing of either.
* Numbers are standardised with mean and scale of the real training windows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
import pyro
import torch
from pyro import distributions
from torch import Tensor, nn
from typing_extensions import override

from ...data.batch import Batch
from ...data.schema import Schema
from ...data.units import Units
from ...inference.evaluation.estimates import Crossed, Estimate
from ...inference.evaluation.held import Held, clip_places, hold, on_device_of, refuse_non_finite, reproducibly
from ...inference.evaluation.record import MODELS, Dims, plain
from ...inference.evaluation.references import last_value
from ...inference.evaluation.result import Result, Table, progress_bar
from ...inference.evaluation.scores import clip_means
from ...inference.training.fit import fit
from ...inference.training.options import Stage
from ...inference.training.recipe import Recipe, Trainable
from ...inference.training.trackers import Bar
from ...networks.cells import GRU
from ...options import Size, nearest
from ...turns import seeded
from ..data.protocols import Poses, Windows
from ..geometry.skeleton import Skeleton
from ..geometry.views import Heading

REAL = "c"
TRAINING: Mapping[str, Any] = {
    "optimizer": "sgd",
    "learning_rate": 0.01,
    "momentum": 0.9,
    "batch_size": 256,
    "gradient_clip": None,
}
"""The paper's, of `Training`."""
SCORES = ("quality", "taken for real")
STILL = "zero velocity"


@dataclass(frozen=True)
class RealOrMade(Trainable):
    """See the file.

    Args:
        width: units of the GRU; the layers have its half and its eighth.
        heading: turn every window so that its last observed frame has heading zero.
    """

    name: ClassVar[str] = "real-or-made"
    source: ClassVar[str] = "Aliakbarian, Saleh, Salzmann, Petersson and Gould, 2020, arXiv 1908.00733"
    width: Size = 128
    heading: bool = True

    def build(self, data: Any) -> RealOrMadeModel:
        """The model for poses of the data's skeleton, whatever models see of them."""
        who = "a judge of quality"
        schema = Poses.of(Schema.of(data, who).windows, who)
        return RealOrMadeModel(self, schema.skeleton, schema.protocol.observed)

    def train(self, train: Any, validation: Any = None, steps: int = 5000) -> Recipe:
        """Minimises minus the log-likelihood of what windows are, in nats a window.

        Args:
            train: `Examples`.
            validation: others.
            steps: of the optimiser.
        """

        def standardise(model: RealOrMadeModel) -> None:
            model.units.fit(model.seen(train.real))

        return Recipe(train, validation, [Stage(steps)], prepare=standardise)


class RealOrMadeModel(nn.Module):
    """The classifier.

    Args:
        method: its options.
        skeleton: of J joints.
        observed: frames O that are real in every window.
    """

    likelihood, per = True, "window"  # see `dvae.program.protocols.Program`

    def __init__(self, method: RealOrMade, skeleton: Skeleton, observed: int) -> None:
        super().__init__()
        self.skeleton = skeleton
        self.view = Heading(skeleton, observed) if method.heading else None
        size, half, eighth = 3 * (skeleton.joints - 1), max(method.width // 2, 1), max(method.width // 8, 1)
        self.units = Units(size)
        self.gru = GRU(size, method.width, batch_first=True)
        self.layers = nn.Sequential(
            *(nn.Linear(method.width, half), nn.ReLU(), nn.Linear(half, eighth), nn.ReLU(), nn.Linear(eighth, 1))
        )

    def model(self, batch: Batch, **_: Any) -> dict[str, Tensor]:
        """The Pyro program: one site c, batch (B,), observed.

        Args:
            batch: holds x (B, T, D), and c (B,), 1 of real windows and 0 of others.

        Raises:
            ValueError: padded sequences or missing entries, of which there are none in windows of motion.
        """
        if extra := {"lengths", "mask"} & batch.keys():
            raise ValueError(f"a judge of quality reads whole windows; leave {' and '.join(sorted(extra))} out")
        logits = self.logits(batch["x"])
        with pyro.plate("windows", len(logits)):
            return {REAL: pyro.sample(REAL, distributions.Bernoulli(logits=logits), obs=batch[REAL].to(logits))}

    def guide(self, batch: Batch, **_: Any) -> dict[str, Tensor]:
        """Nothing is latent."""
        return {}

    def forward(self, batch: Batch, **options: Any) -> dict[str, Tensor]:
        """The program, which bounds take."""
        return self.model(batch, **options)

    def seen(self, x: Tensor) -> Tensor:
        """What is read of windows (..., T, D), with the pelvis or without: (..., T, 3 (J - 1)).

        Raises:
            ValueError: windows of another skeleton.
        """
        skeleton, size = self.skeleton, x.shape[-1]
        if size not in (3 * skeleton.joints, 3 * (skeleton.joints - 1)):
            raise ValueError(
                f"frames have {size} numbers; those of the skeleton {skeleton.name!r} have {3 * skeleton.joints}, or "
                f"{3 * (skeleton.joints - 1)} without the root"
            )
        if size == 3 * skeleton.joints:
            joints = x.unflatten(-1, (-1, 3))
            x = skeleton.without_root(joints - joints[..., skeleton.root, None, :]).flatten(-2)
        return x if self.view is None else self.view.face(x)

    def logits(self, x: Tensor) -> Tensor:
        """Log-odds (B,) that windows (B, T, D) are real."""
        states, _ = self.gru(self.units(self.seen(x)))
        found: Tensor = self.layers(states[:, -1])[:, 0]
        return found


@dataclass(frozen=True, eq=False)
class Examples:
    """Windows as they are, and with a future that a model made of them.

    Args:
        real, made: (N, T, D).
    """

    real: Tensor
    made: Tensor

    def sample(self, batch_size: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Half of them real, half of them made, each drawn by itself: {"x": (B, T, D), "c": (B,)}."""
        drawn = torch.randint(len(self.real), (batch_size,), generator=generator)
        half = batch_size // 2
        return _labelled(self.real[drawn[:half]], self.made[drawn[half:]])

    def all(self) -> dict[str, Tensor]:
        """All real ones, then all others."""
        return _labelled(self.real, self.made)


def _labelled(real: Tensor, made: Tensor) -> dict[str, Tensor]:
    return {"x": torch.cat([real, made]), REAL: torch.arange(len(real) + len(made)) < len(real)}


@dataclass(frozen=True, repr=False, eq=False)
class Qualities(Result):
    """The quality of models on the same held-out windows, in per cent.

    Indexing gives the scores of a model, `found["srnn"]["quality"].interval()`: estimates over clips and over seeds of
    the classifier, crossed (see `dvae.inference.evaluation.comparison`).

    Attributes:
        rows: `{model: {score: (S, C)}}`, by seed of the classifier and clip.
        clips: `{"split/clip": number of its windows}`, in the order of C.
        record: what they rest on.
    """

    rows: Annotated[dict[str, Annotated[dict[str, np.ndarray], Dims("seed", "clip", name="{}")]], MODELS]
    clips: dict[str, int]
    record: dict[str, Any]

    def __getitem__(self, model: str) -> dict[str, Estimate]:
        return {score: self._parts(model, score).estimate() for score in SCORES}

    def difference(self, first: str, second: str, score: str = "quality") -> Estimate:
        """Paired difference of two models over clips, first minus second, seeds of their classifiers independent."""
        return self._parts(first, score).estimate(self._parts(second, score))

    def _parts(self, model: str, score: str) -> Crossed:
        if model not in self.rows:
            raise KeyError(f"no model {model!r} here{nearest(model, self.rows)}; there are {', '.join(self.rows)}")
        return Crossed.of(self.rows[model][score], np.array(list(self.clips.values())))

    @override
    def table(self) -> Table:
        """Scores with their errors over clips and over seeds, and the interval of the quality from both."""
        windows = f"{sum(self.clips.values())} windows of {len(self.clips)} clips"
        title = f"{self.record['protocol']['name']} · {windows} · {self.record['seeds']} classifiers each"
        caption = "quality: 100 % - accuracy of a classifier that tells real from made; 50 % is the best\n"
        caption += "± standard error over clips ± over seeds of the classifier; 95 %: from both, by Student's t"
        table = Table(title=title, caption=caption)
        for header in ("", "quality (%)", "95 %", "taken for real (%)"):
            table.add_column(header, justify="right")
        for name in self.rows:
            found = self[name]
            low, high = found["quality"].interval()
            interval = "–" if math.isnan(low) else f"{low:.1f} to {high:.1f}"
            table.add_row(name, _said(found["quality"]), interval, _said(found["taken for real"]))
        return table

    @override
    def labels(self) -> dict[str, Sequence[str]]:
        return {"clip": [*self.clips]}

    @override
    def check(self) -> None:
        if self.extents.get("clip") != {len(self.clips)} or any(row.keys() != {*SCORES} for row in self.rows.values()):
            raise ValueError(f"expected {', '.join(SCORES)} of {len(self.clips)} clips")
        self.table()


def _said(found: Estimate) -> str:
    return " ± ".join(
        "–" if math.isnan(value) else f"{value:.1f}" for value in (found.mean, found.sequences, found.seeds)
    )


def quality(
    models: Mapping[str, Any],
    train: Windows,
    test: Windows,
    *,
    method: RealOrMade | None = None,
    examples: int = 10_000,
    steps: int = 5000,
    seeds: Sequence[int] = (0, 1, 2),
    seed: int = 0,
    forecast: Mapping[str, Any] | None = None,
    references: bool = True,
    progress: bool = True,
    **training: Any,
) -> Qualities:
    """How well the futures that models make pass for real: see the file.

    Each model has classifiers of its own, one for each seed, which differ in their first weights and in their batches;
    the futures are the same for all of them.

    Args:
        models: by name, each with a `forecast` as in `dvae.program.protocols.Forecasting`; none saw a test clip.
        train: windows to draw the classifiers' examples from, those that the models were fitted to.
        test: held-out windows, of which each is judged as it is and with a future of the model's.
        method: the classifier.
        examples: windows of each kind that it is fitted to; 25,000 in the paper.
        steps: of its optimiser.
        seeds: of the classifiers.
        seed: of windows and futures.
        forecast: options of the models' `forecast`.
        references: whether to judge zero velocity too, of which little passes a classifier that has learned anything.
        progress: whether to show progress bars.
        **training: of `Training`, in place of `TRAINING`.

    Raises:
        ValueError: windows that lack joints, of another protocol or skeleton than the others; no seed or example; or a
            model with the name of the reference row.
        FloatingPointError: a forecast that is not finite.
    """
    method = method or RealOrMade()
    if train.missing or test.missing:
        raise ValueError("quality is of whole windows, but these lack joints; fill the gaps first (`dvae impute`)")
    if (train.skeleton, train.protocol.observed, train.length) != (test.skeleton, test.protocol.observed, test.length):
        raise ValueError(f"training and test windows differ in skeleton or frames: {train} and {test}")
    if examples < 1 or not seeds:
        raise ValueError(f"quality needs at least one example and one seed, got {examples} and {list(seeds)}")
    if references and STILL in models:
        raise ValueError(f"a model must not have the name of a reference row: {STILL}")
    held, places = hold(test), clip_places(test.keys)
    drawn = train.sample(examples, torch.Generator().manual_seed(seed))
    known = Held(train, drawn, held.observed, [(train.split, "drawn", n) for n in range(examples)])
    rows: dict[str, dict[str, np.ndarray]] = {}
    forecasters = {name: _forecaster(model, held.futures.shape[1], forecast or {}) for name, model in models.items()}
    forecasters |= {STILL: lambda past: last_value(past["x"], held.futures.shape[1])[0]} if references else {}
    for name, futures in forecasters.items():
        with reproducibly(models[name], seed) if name in models else nullcontext():
            learned, judged = (_examples(name, futures, each, progress) for each in (known, held))
        found: dict[str, list[Sequence[float]]] = {score: [] for score in SCORES}
        for number in seeds:
            with seeded(number):
                judge = method.build(train)
            bar = Bar(f"judge of {name}, seed {number}", steps, progress)
            options = {**TRAINING, "seed": number, "progress": False, "trackers": [bar], **training}
            fit(judge, method.train(learned, steps=steps), **options)
            real, made = (_taken_for_real(judge, x) for x in (judged.real, judged.made))
            for score, values in zip(SCORES, ((1 - real + made) / 2, made), strict=True):
                found[score].append(clip_means(100 * values, places))
        rows[name] = {score: np.array(values) for score, values in found.items()}
    record = {
        "classifier": method.config(),
        "training": {"steps": steps, "examples": examples, **TRAINING, **training},
        "seeds": len(seeds),
        "seed": seed,
        "forecast": dict(forecast or {}),
        "data": held.description(),
        "trained on": train.fingerprint,
        "protocol": asdict(test.protocol),
    }
    return Qualities(rows, held.clips, plain(record))


def _forecaster(model: Any, horizon: int, options: Mapping[str, Any]) -> Callable[[Batch], Tensor]:
    """From pasts to one future of each."""

    def futures(past: Batch) -> Tensor:
        found = model.forecast(on_device_of(model, past), horizon, 1, **{"draw_emission": False, **options})
        made: Tensor = found["x"][0].cpu()
        return made

    return futures


def _examples(name: str, forecast: Callable[[Batch], Tensor], held: Held, progress: bool) -> Examples:
    """Windows, and what a model makes of them."""
    made = []
    with progress_bar(progress) as bar:
        for start in bar.track(range(0, len(held.keys), 256), description=f"{name}, forecasts"):
            part = slice(start, start + 256)
            futures = forecast(held.past(part))
            refuse_non_finite(name, "forecast", futures.isfinite().all(-1).all(-1), held.keys[part])
            made.append(torch.cat([held.x[part, : held.observed], futures], 1))
    return Examples(held.x, torch.cat(made))


def _taken_for_real(judge: RealOrMadeModel, x: Tensor) -> Tensor:
    """(N,) 1 where a window (T, D) is taken for real."""
    with reproducibly(judge, 0):
        return torch.cat(
            [judge.logits(on_device_of(judge, {"x": part})["x"]).cpu() > 0 for part in x.split(256)]
        ).double()
