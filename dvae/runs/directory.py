"""Load and resume runs from their directories.

`config.json` of a run (format 2) contains the method with its options, the schema of the data, the path of the data
with the fingerprint of their content, and the training options. The model is rebuilt from the schema, without the data.
A relative path stays relative, so a project folder can be moved.
"""

from __future__ import annotations

import os
import shlex
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
from .kinds import DATA, SCHEMAS, Dataset, open_data


@dataclass(frozen=True)
class Config:
    """Content of `config.json` of a run.

    Args:
        method: method with its options.
        schema: schema of the data.
        kind: kind of the data.
        data: source of the data, as returned by `Dataset.recorded`.
        training: training options.
    """

    method: Trainable
    schema: Schema
    kind: str
    data: Any
    training: Training

    def written(self) -> dict[str, Any]:
        """Return the config in JSON's types, without the training options, which `fit` adds."""
        return run_config(self.method, self.schema, self.kind, self.data)


@dataclass
class Loaded:
    """A loaded run, as in `loaded.model.forecast(...)` and `loaded.data.windows("test")`.

    Args:
        path: run directory.
        config: content of its `config.json`.
        model: model with the run's best weights, in evaluation mode.
        where: path of the data, if the path in the run is no longer valid.
    """

    path: Path
    config: Config
    model: Any
    where: str | None = None

    @property
    def method(self) -> Any:
        """Method with its options."""
        return self.config.method

    @property
    def schema(self) -> Any:
        """Schema of the data that the run was fitted on."""
        return self.config.schema

    @cached_property
    def data(self) -> Any:
        """Data that the run was fitted on, opened at first use.

        Raises:
            CheckpointError: the data are missing or have changed.
        """
        return open_data(self.path, self.config.kind, self.config.data, self.schema, self.where)

    @property
    def failed(self) -> bool:
        """Whether the fit failed, or has neither ended nor made a step."""
        state = Run(self.path).state
        return state["status"] == "failed" or (state["step"] == 0 and state["status"] not in ENDED)

    @property
    def unfinished(self) -> str:
        """Sentence that describes an unfinished run; "" for a finished one."""
        state = Run(self.path).state
        if state["status"] in ENDED:
            return ""
        reached = f"{state['status']} at step {state['step']} of {self.config.training.steps}"
        initial = "" if state["step"] else "; its weights are the initial ones"
        return f"{self.path} has not ended ({reached}){initial}; {advice(self.path)}"

    def alike(self, other: Loaded) -> bool:
        """Return whether another run was fitted on the same windows of the same data; the views may differ."""
        fingerprint, other_fingerprint = self.config.data.fingerprint, other.config.data.fingerprint
        return bool(fingerprint == other_fingerprint and self.schema.windows == other.schema.windows)

    def with_data(self, path: str | os.PathLike[str], **changes: Any) -> Any:
        """Open other data of the same kind under the run's schema.

        Args:
            path: path of the other data.
            **changes: fields of `config.data` to replace, such as missing=True.

        Raises:
            ValueError: the data have another schema, such as other joints.
        """
        other = DATA[self.config.kind].reopen(replace(self.config.data, **changes), self.schema, path)
        stored, other_config = (dict(flat(schema.config())) for schema in (self.schema, other.schema))
        if differing := [name for name in stored | other_config if stored.get(name) != other_config.get(name)]:
            values = (f"{name} is {brief(other_config.get(name))}, not {brief(stored.get(name))}" for name in differing)
            more = f"; and {len(differing) - 3} more" if len(differing) > 3 else ""
            raise ValueError(
                f"the data in {os.fspath(path)} do not match the run {self.path}: {'; '.join(islice(values, 3))}{more}"
            )
        return other


def in_command(path: str | os.PathLike[str]) -> str:
    """Return a path for a shell command, quoted if necessary."""
    text = os.fspath(path)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)


def advice(path: str | os.PathLike[str]) -> str:
    """Return advice on how to continue a run.

    After a failure the advice is a lower learning rate, because the same steps would fail again.
    """
    run = Run(path)
    if run.state["status"] != "failed":
        return f"continue it with: dvae resume {in_command(path)}"
    rate = run.config.get("training", {}).get("learning_rate")
    lower = f"{rate / 10:g}" if isinstance(rate, int | float) else "RATE"
    return f"continue it at a lower learning rate with: dvae resume {in_command(path)} --learning-rate {lower}"


def training_of(method: Trainable, data: Dataset, training: Training | Mapping[str, Any] | None) -> Training:
    """Return the training options of a method for data: its defaults, with those in `training` replaced."""
    return training if isinstance(training, Training) else replace(method.training(data.schema), **(training or {}))


def resume(
    path: str | os.PathLike[str],
    data: str | os.PathLike[str] | None = None,
    trackers: Sequence[Tracker] = (),
    callbacks: Sequence[Callback] = (),
    **options: Any,
) -> Fit:
    """Continue a run from its last checkpoint with its original options.

    If the number of steps changes, schedules that cover a share of the run are stretched accordingly: the decay of the
    learning rate and the rise of scheduled sampling.

    Args:
        path: run directory.
        data: current path of the data, if the path in the run is no longer valid.
        trackers: further trackers, which receive each row of the training log.
        callbacks: hooks of the training loop.
        **options: options of `Training` to change, such as steps=4000 for a longer run.

    Raises:
        CheckpointError: the run is missing or damaged, or its data have changed.
    """
    run = _load(path, data)
    training = replace(run.config.training, scheduled_sampling=0.0, **options)
    train, validation = run.data.windows("train"), run.data.windows("validation")
    recipe = run.config.method.train(train, validation, training.steps)
    hooks: dict[str, Any] = {"trackers": trackers, "callbacks": callbacks}
    return fit(run.model, recipe, resume=True, out=path, config=run.config.written(), **hooks, **vars(training))


def load(path: str | os.PathLike[str], data: str | os.PathLike[str] | None = None) -> Loaded:
    """Load a run: its method, and its model with the best weights. Its data are opened at first use.

    Warns if the run failed or has made no step.

    Args:
        path: run directory, as `dvae fit` writes it.
        data: current path of the data, if the path in the run is no longer valid.

    Returns:
        The run: `model` in evaluation mode, `method`, `schema` and `data`.

    Raises:
        CheckpointError: the run is missing or damaged.

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
    run = _load(path, data)
    if run.failed:
        warnings.warn(run.unfinished, stacklevel=3)  # `serialized` is between
    return run


def _load(path: str | os.PathLike[str], data: str | os.PathLike[str] | None) -> Loaded:
    config, size = read_config(path), Run(path).size()
    with reading_config(path), at_most(size, f"{Path(path) / CONFIG}"):
        model = config.method.build(config.schema)
    load_weights(model, path)
    return Loaded(Path(path), config, model.eval(), None if data is None else os.fspath(data))


def read_config(path: str | os.PathLike[str]) -> Config:
    """Read and check the config of a run.

    Args:
        path: run directory.

    Raises:
        CheckpointError: the run is missing or damaged.
    """
    run = Run(path)
    with reading_config(path):
        config = run.config
        if "method" not in config and "stages" in config:
            raise CheckpointError(
                f"{run.path} was fitted in Python on arrays, or with a model of your own, which a run does not store; "
                "build the model as before, then load its weights by dvae.load_weights(model, path), or continue by "
                "dvae.fit(model, data, out=path, resume=True)"
            )
        if (version := config["format"]) != FORMAT:
            raise CheckpointError(
                f"{run.path} is a run of format {version!r}, and this version of dvae reads format {FORMAT}; fit "
                "again, or install the version that wrote it"
            )
        schema, source, training = dict(config["schema"]), dict(config["data"]), config["training"]
        kind, schema_kind = source.pop("kind"), schema.pop("kind")
        if schema_kind != DATA[kind].schema_kind:
            raise ValueError(
                f"data of kind {kind!r} require a schema of kind {DATA[kind].schema_kind!r}, got {schema_kind!r}"
            )
        return Config(
            configured(config["method"]),
            SCHEMAS[schema_kind].from_config(schema),
            kind,
            DATA[kind].source(**source),
            Training(**{name: option_from_config(value) for name, value in training.items()}),
        )


@contextmanager
def reading_config(path: str | os.PathLike[str]) -> Iterator[None]:
    """Raise errors in the block as a `CheckpointError` about the config of a run."""
    try:
        yield
    except (CheckpointError, OSError):
        raise
    except Exception as error:  # a third-party method may raise any error for unknown options
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error) or type(error).__name__
        raise CheckpointError(
            f"{Path(path) / CONFIG} does not describe method, schema, data and training of a run "
            f"({reason[:400]}{'…' * (len(reason) > 400)}); it is damaged, or was not written by `dvae fit` with these "
            "methods; fit again"
        ) from error
