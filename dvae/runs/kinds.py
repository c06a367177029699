"""Registries of the kinds of data that runs are fitted on, and of their schemas; classes are imported on first use."""

from __future__ import annotations

import os
from typing import Any, ClassVar, Protocol, Self

from ..data.schema import Schema
from ..inference.training.checkpoints import CheckpointError
from ..models.registry import Registry

SCHEMAS = Registry(
    {
        "sequences": "dvae.data.schema:Schema",
        "poses": "dvae.motion.data.protocols:Poses",
        "segments": "dvae.motion.segments.embodied:SegmentSchema",
        "panel": "dvae.tables.encoding:PanelSchema",
    },
    "dvae.schemas",
)
DATA = Registry(
    {
        "motion": "dvae.motion.data.dataset:MotionData",
        "segments": "dvae.motion.segments.dataset:SegmentData",
        "panel": "dvae.tables.dataset:PanelData",
    },
    "dvae.data",
)
"""Kinds of schemas and of data, by their name in a config."""


class Dataset(Protocol):
    """Data that runs are fitted on, such as `dvae.motion.MotionData`."""

    kind: ClassVar[str]
    schema_kind: ClassVar[str]
    """Kind of the schema."""
    source: ClassVar[type[Any]]
    """Type that `recorded` returns: a dataclass with JSON's types and at least the fields `path` and `fingerprint`."""

    @classmethod
    def open(cls, path: str, *, skip_bad: bool = False, **options: Any) -> Self:
        """Read a file; `options` are those that the command line has for this kind of data."""

    @property
    def location(self) -> str:
        """Path of the data that other processes can open, whatever their working directory."""

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the content."""

    @property
    def schema(self) -> Schema:
        """Schema of the data; models are built with it."""

    def windows(self, split: str) -> Any:
        """Return the windows of "train", "validation" or "test"."""

    def recorded(self) -> Any:
        """Return the source of the data, such as path and fingerprint, which `config.json` of a run stores."""

    @classmethod
    def reopen(cls, source: Any, schema: Any, path: str | os.PathLike[str] | None = None) -> Self:
        """Open recorded data from their own or another path, without checking their content."""


def open_data(
    run: str | os.PathLike[str], kind: str, source: Any, schema: Any, path: str | os.PathLike[str] | None = None
) -> Any:
    """Open the data of a run.

    Args:
        run: run directory.
        kind: kind of the data.
        source: source of the data, as returned by `Dataset.recorded`.
        schema: schema of the data.
        path: current path of the data; by default the path in `source`.

    Raises:
        CheckpointError: the data are missing or have changed.
    """
    path = os.fspath(path or source.path)
    try:
        data = DATA[kind].reopen(source, schema, path)
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{run} was fitted on {source.path}, but {path} does not exist; relative paths start from the working "
            "directory, so change to the directory of the fit, or give the path of these or other data (--data)"
        ) from error
    if data.fingerprint != source.fingerprint:
        raise CheckpointError(
            f"{path} has changed since {run} was fitted on it: its fingerprint is {data.fingerprint[:12]}…, the "
            f"run's {source.fingerprint[:12]}…; restore the file, or fit again"
        )
    return data
