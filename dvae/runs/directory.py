"""Runs of methods on motion data: fit, resume and load a run directory that says all it takes to do so.

`config.json` of such a run holds the method with its options, the data file as it was given with the
fingerprint of its content, and every field of the protocol. A relative path stays relative, so that a project
folder can be moved.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from .. import motion
from ..inference.checkpoints import CONFIG, CheckpointError, Run, at_most, load_weights
from ..inference.fit import Callback, Fit, Training
from ..inference.fit import fit as fit_model
from ..inference.schedules import from_config as option_from_config
from ..inference.trackers import Tracker
from ..motion import PROTOCOLS, MotionSet, Protocol, Windows
from ..options import check, nearest
from ..turns import alone
from ..models.method import Method, from_config

SIMULATED = "simulated"

DEFAULT_PROTOCOLS = {
    "bandai21": "bandai2-by-style",
    "cmu21": "cmu8",
    "human36m": "h36m",
    "humaneva": "humaneva",
    "walker": "simulated",
}
"""Protocols by the name of the skeleton, where none is named."""


@dataclass(frozen=True)
class Data:
    """Motion data under a protocol.

    Args:
        path: the file as it was given, or "simulated".
        motion: its clips.
        protocol: how windows are cut from them.
        skip_bad: whether unusable clips were left out.
    """

    path: str
    motion: MotionSet
    protocol: Protocol
    skip_bad: bool = False

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str] = SIMULATED,
        protocol: str | Protocol | None = None,
        skip_bad: bool = False,
    ) -> Data:
        """Reads a motion file, or simulates.

        Args:
            path: of a file that `dvae.motion.load` reads, or "simulated" for `dvae.motion.simulate()`.
            protocol: one of `dvae.motion.PROTOCOLS` or its name; by default the one of the skeleton.
            skip_bad: leave out unusable clips instead of refusing the file.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: a file that cannot be read, an unknown protocol, or none for the skeleton.
        """
        name = os.fspath(path)
        clips = motion.simulate() if name == SIMULATED else motion.load(name, skip_bad=skip_bad)
        if protocol is None:
            if clips.skeleton.name not in DEFAULT_PROTOCOLS:
                raise ValueError(
                    f"{name}: which protocol? The skeleton {clips.skeleton.name!r} has none of its own; "
                    f"choose one of {', '.join(PROTOCOLS)}"
                )
            protocol = DEFAULT_PROTOCOLS[clips.skeleton.name]
        return cls(name, clips, named_protocol(protocol) if isinstance(protocol, str) else protocol, skip_bad)

    def windows(self, split: str) -> Windows:
        """The windows of "train", "validation", "test" or "train+validation"."""
        return motion.windows(self.motion, self.protocol, split)

    def config(self) -> dict[str, Any]:
        """The data and the protocol in JSON's types."""
        source = {"path": self.path, "fingerprint": self.motion.fingerprint(), "skip_bad": self.skip_bad}
        return {"data": source, "protocol": asdict(self.protocol)}


@dataclass(frozen=True)
class Loaded:
    """A run, read back: `loaded.model.forecast(...)`, `loaded.data.windows("test")`.

    Args:
        path: the run directory.
        method: the method with its options.
        model: the model with the run's best weights, in evaluation mode.
        data: the data and protocol that it was fitted on.
    """

    path: Path
    method: Method
    model: Any
    data: Data


def named_protocol(name: str) -> Protocol:
    """A preset protocol.

    Raises:
        ValueError: an unknown name, with the nearest known one.
    """
    if name not in PROTOCOLS:
        raise ValueError(f"unknown protocol {name!r}{nearest(name, PROTOCOLS)}; known: {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]


@alone
def fit(
    method: Method,
    data: Data,
    out: str | os.PathLike[str],
    training: Training | None = None,
    callbacks: Sequence[Callback] = (),
    trackers: Sequence[Tracker] = (),
) -> Fit:
    """Fits a method to motion data, in a run directory that `load` and `resume` read.

    Args:
        method: such as `dvae.method("hit-dvae", latent=8)`; it tells objective and self-feeding.
        data: training and validation windows are taken from it.
        out: the run directory.
        training: the other options; its seed is also that of the initial weights.
        callbacks: hooks of the loop.
        trackers: further receivers of the log's rows.

    Raises:
        ValueError: `training` sets the self-feeding, which is the method's to tell; or the pseudo-sequences of a
            prior are longer than the windows.
    """
    training = training or Training()
    if training.self_feeding != 0:
        raise ValueError(
            f"self-feeding is an option of the method here; instead of Training(self_feeding={training.self_feeding}) "
            f"write dvae.method({method.name!r}, self_feeding=…)"
        )
    train, validation = data.windows("train"), data.windows("validation")
    method = method.suited(train)
    with torch.random.fork_rng():
        torch.manual_seed(training.seed)
        model = method.build_for(train)
        method.prepare(model, train)
    return fit_model(
        model,
        method.batches(train),
        method.validation(validation),
        stages=method.stages(training.steps),
        out=out,
        config={"method": method.config(), **data.config()},
        callbacks=callbacks,
        trackers=trackers,
        **vars(replace(training, self_feeding=method.feeding(training.steps))),
    )


@alone
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
    run, training = load(path, data), read_config(path).training
    steps = options.get("steps", training.steps)
    return fit_model(
        run.model,
        run.method.batches(run.data.windows("train")),
        run.method.validation(run.data.windows("validation")),
        stages=run.method.stages(steps),
        out=path,
        resume=True,
        trackers=trackers,
        callbacks=callbacks,
        **{**vars(training), "self_feeding": run.method.feeding(steps), **options},
    )


@alone
def load(path: str | os.PathLike[str], data: str | os.PathLike[str] | None = None) -> Loaded:
    """Reads a run back: method, model with its best weights, data and protocol.

    Args:
        path: the run directory, as `dvae fit` writes it.
        data: where the data lie now, if the path in the run no longer leads there.

    Raises:
        CheckpointError: no run, a damaged one, or one whose data have changed.
    """
    config, size = read_config(path), Run(path).size()
    recorded, expected = config.source, config.fingerprint
    where = os.fspath(data or recorded)
    try:
        opened = Data.open(where, config.protocol, config.skip_bad)
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{path} was fitted on {recorded}, but {where} is not here; relative paths count from the "
            "working directory, so change to where it was fitted, or tell where the data lie now (--data)"
        ) from error
    if (found := opened.motion.fingerprint()) != expected:
        raise CheckpointError(
            f"{where} has changed since {path} was fitted on it: its fingerprint is {found[:12]}…, the run's "
            f"{expected[:12]}…; restore the file, or fit again"
        )
    # the data are those of the run: if they do not fit, the config is not
    with reading_config(path), at_most(size, f"{Path(path) / CONFIG}"):
        model = config.method.build_for(opened.windows("train"))
    load_weights(model, path)
    return Loaded(Path(path), config.method, model.eval(), opened)


@dataclass(frozen=True)
class Config:
    """What `config.json` of a run says.

    Args:
        method: with its options.
        source, fingerprint, skip_bad: of the data, see `Data`.
        protocol: how windows are cut from them.
        training: how it was fitted.
    """

    method: Method
    source: str
    fingerprint: str
    skip_bad: bool
    protocol: Protocol
    training: Training

    def __post_init__(self) -> None:
        check(self)


def read_config(path: str | os.PathLike[str]) -> Config:
    """Reads and checks the config of a run.

    Raises:
        CheckpointError: no run, or a damaged one.
    """
    with reading_config(path):
        config = Run(path).config
        data, training = config["data"], config["training"]
        return Config(
            from_config(config["method"]),
            data["path"],
            data["fingerprint"],
            data["skip_bad"],
            Protocol(**tuples(config["protocol"])),
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
            f"{Path(path) / CONFIG} does not tell method, data, protocol and training of a run on its data "
            f"({_shortened(what)}); it is damaged, or was not written by `dvae fit` with these methods"
        ) from error


def _shortened(text: str) -> str:
    return text if len(text) <= 400 else f"{text[:400]}…"


def tuples(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options as JSON gives them back, with tuples in place of its lists."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in options.items()}
