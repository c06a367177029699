"""Runs of methods on data: resume and load a run directory, which says all it takes to do so.

`config.json` of such a run (format 2) holds the method with its options; the schema of the data, from which the model
is built again without them; where the data were, with the fingerprint of their content; and the options of training. A
relative path stays relative, so that a project folder can be moved.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from reprlib import repr as brief
from typing import Any

from ..data.schema import Schema
from ..inference.training.checkpoints import CONFIG, ENDED, CheckpointError, Run, at_most, load_weights
from ..inference.training.fit import Callback, Fit, fit
from ..inference.training.options import Training
from ..inference.training.recipe import FORMAT, Trainable, run_config
from ..inference.training.schedules import from_config as option_from_config
from ..inference.training.trackers import Tracker
from ..models.registry import configured
from ..options import flat
from .kinds import DATA, SCHEMAS, Dataset, opened


@dataclass(frozen=True)
class Config:
    """What `config.json` of a run says.

    Args:
        method: with its options.
        schema: of the data.
        kind: of the data.
        data: where they were, as they `recorded` it.
        training: how it was fitted.
    """

    method: Trainable
    schema: Schema
    kind: str
    data: Any
    training: Training

    def written(self) -> dict[str, Any]:
        """Return it in JSON's types, but for the training, which `fit` adds."""
        return run_config(self.method, self.schema, self.kind, self.data)


@dataclass
class Loaded:
    """A run, read back: `loaded.model.forecast(...)`, `loaded.data.windows("test")`.

    Args:
        path: the run directory.
        config: what it says.
        model: the model with the run's best weights, in evaluation mode.
        where: path of the data, if the one in the run no longer leads there.
    """

    path: Path
    config: Config
    model: Any
    where: str | None = None

    @property
    def method(self) -> Any:
        """The method with its options."""
        return self.config.method

    @property
    def schema(self) -> Any:
        """Of the data that it was fitted on."""
        return self.config.schema

    @cached_property
    def data(self) -> Any:
        """The data that it was fitted on, opened when they are first asked for.

        Raises:
            CheckpointError: they are not here, or have changed.
        """
        return opened(self.path, self.config.kind, self.config.data, self.schema, self.where)

    @property
    def failed(self) -> bool:
        """Whether the weights are of a fit that failed or has not made a step."""
        state = Run(self.path).state
        return state["status"] == "failed" or (state["step"] == 0 and state["status"] not in ENDED)

    @property
    def unfinished(self) -> str:
        """A sentence on a run that has not ended; "" for one that has."""
        state = Run(self.path).state
        if state["status"] in ENDED:
            return ""
        reached = f"{state['status']} at step {state['step']} of {self.config.training.steps}"
        initial = "" if state["step"] else "; its weights are the initial ones"
        return f"{self.path} has not ended ({reached}){initial}; {advice(self.path)}"

    def alike(self, other: Loaded) -> bool:
        """Whether another run was fitted on the same windows of the same data, whatever the models see of them."""
        data, others = self.config.data.fingerprint, other.config.data.fingerprint
        return bool(data == others and self.schema.windows == other.schema.windows)

    def on(self, path: str | os.PathLike[str], **read: Any) -> Any:
        """Other data of the same kind, under the run's schema.

        Args:
            path: where they are.
            **read: fields of the run's source that are others for them, such as missing=True.

        Raises:
            ValueError: data with another schema, such as other joints.
        """
        other = DATA[self.config.kind].reopened(replace(self.config.data, **read), self.schema, path)
        here, there = (dict(flat(schema.config())) for schema in (self.schema, other.schema))
        if differing := [name for name in here | there if here.get(name) != there.get(name)]:
            values = (f"{name} is {brief(there.get(name))}, not {brief(here.get(name))}" for name in differing)
            more = f"; and {len(differing) - 3} more" if len(differing) > 3 else ""
            raise ValueError(f"{os.fspath(path)} does not fit {self.path}: {'; '.join(islice(values, 3))}{more}")
        return other


def advice(path: str | os.PathLike[str]) -> str:
    """Return how a run is continued: after a failure, which the same steps would repeat, at a lower learning rate."""
    run = Run(path)
    if run.state["status"] != "failed":
        return f"continue it with: dvae resume {path}"
    rate = run.config.get("training", {}).get("learning_rate")
    lower = f"{rate / 10:g}" if isinstance(rate, int | float) else "RATE"
    return f"continue it at a lower learning rate with: dvae resume {path} --learning-rate {lower}"


def training_of(method: Trainable, data: Dataset, training: Training | Mapping[str, Any] | None) -> Training:
    """How a method is fitted to data: as is said, or by the method's own options but for those that are said."""
    return training if isinstance(training, Training) else replace(method.training(data.schema), **(training or {}))


def resume(
    path: str | os.PathLike[str],
    data: str | os.PathLike[str] | None = None,
    trackers: Sequence[Tracker] = (),
    callbacks: Sequence[Callback] = (),
    **options: Any,
) -> Fit:
    """Continues a run from its last checkpoint, under the options it was started with.

    What is a share of the run, the falling end of the learning rate and the rise of self-feeding, is laid out anew
    over other steps.

    Args:
        path: the run directory.
        data: where the data lie now, if the path in the run no longer leads there.
        trackers: further receivers of the log's rows.
        callbacks: hooks of the loop.
        **options: options of `Training` to change, such as steps=4000 for a longer run.

    Raises:
        CheckpointError: no run, a damaged one, or one whose data have changed.
    """
    run = _load(path, data)
    training = replace(run.config.training, self_feeding=0.0, **options)
    train, validation = run.data.windows("train"), run.data.windows("validation")
    recipe = run.config.method.train(train, validation, training.steps)
    told: dict[str, Any] = {"out": path, "config": run.config.written(), "trackers": trackers, "callbacks": callbacks}
    return fit(run.model, recipe, resume=True, **told, **vars(training))


def load(path: str | os.PathLike[str], data: str | os.PathLike[str] | None = None) -> Loaded:
    """Reads a run back: method, and model with its best weights; its data when they are asked for.

    Warns of a run that failed or has not made a step.

    Args:
        path: the run directory, as `dvae fit` writes it.
        data: where the data lie now, if the path in the run no longer leads there.

    Raises:
        CheckpointError: no run, or a damaged one.

    Example:
        >>> import tempfile
        >>> clips = dvae.motion.simulate(clips=8, frames=90)
        >>> people = dvae.motion.MotionData("simulated", clips, dvae.motion.PROTOCOLS["simulated"])
        >>> training = {"steps": 1, "batch_size": 2, "progress": False}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = dvae.fit(dvae.method("vae", latent=2), people, out=folder + "/a", **training)
        ...     dvae.load(folder + "/a").method.name
        'vae'
    """
    loaded = _load(path, data)
    if loaded.failed:
        warnings.warn(loaded.unfinished, stacklevel=3)  # `alone` is between
    return loaded


def _load(path: str | os.PathLike[str], data: str | os.PathLike[str] | None) -> Loaded:
    config, size = read_config(path), Run(path).size()
    with reading_config(path), at_most(size, f"{Path(path) / CONFIG}"):
        model = config.method.build(config.schema)
    load_weights(model, path)
    return Loaded(Path(path), config, model.eval(), None if data is None else os.fspath(data))


def read_config(path: str | os.PathLike[str]) -> Config:
    """Reads and checks the config of a run.

    Args:
        path: the run directory.

    Raises:
        CheckpointError: no run, or a damaged one.
    """
    run = Run(path)
    with reading_config(path):
        config = run.config
        if (version := config["format"]) != FORMAT:
            raise CheckpointError(
                f"{run.path} is a run of format {version!r}, and this version of dvae reads format {FORMAT}; fit "
                "again, or install the version that wrote it"
            )
        schema, source, training = dict(config["schema"]), dict(config["data"]), config["training"]
        kind, described = source.pop("kind"), schema.pop("kind")
        if described != DATA[kind].described:
            raise ValueError(f"data of the kind {kind!r} are {DATA[kind].described}, not {described!r}")
        return Config(
            configured(config["method"]),
            SCHEMAS[described].from_config(schema),
            kind,
            DATA[kind].source(**source),
            Training(**{name: option_from_config(value) for name, value in training.items()}),
        )


@contextmanager
def reading_config(path: str | os.PathLike[str]) -> Iterator[None]:
    """What fails within it is the config of a run."""
    try:
        yield
    except (CheckpointError, OSError):
        raise
    except Exception as error:  # a method of somebody else's may fail in any way at options that are not its own
        what = f"it lacks {error}" if isinstance(error, KeyError) else str(error) or type(error).__name__
        raise CheckpointError(
            f"{Path(path) / CONFIG} does not tell method, schema, data and training of a run "
            f"({what[:400]}{'…' * (len(what) > 400)}); it is damaged, or was not written by `dvae fit` with these "
            "methods"
        ) from error
