"""Kinds of data that runs are fitted on, and of their schemas: known by name, and loaded when they are used."""

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
"""Kinds of schemas and of data, by the name that a config gives them."""


class Dataset(Protocol):
    """Data that runs are fitted on, such as `dvae.motion.MotionData`."""

    kind: ClassVar[str]
    described: ClassVar[str]
    """The kind of their schema."""
    source: ClassVar[type[Any]]
    """What `recorded` is: a dataclass of JSON's types with at least a path and a fingerprint, which a run keeps."""

    @classmethod
    def open(cls, path: str, *, skip_bad: bool = False, **options: Any) -> Self:
        """Reads a file, with options of this kind, which the command line gives."""

    @property
    def location(self) -> str:
        """Where they are, as any process finds them."""

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the content."""

    @property
    def schema(self) -> Schema:
        """What a model must know of them."""

    def windows(self, split: str) -> Any:
        """The sequences of "train", "validation" or "test"."""

    def recorded(self) -> Any:
        """Where they are."""

    @classmethod
    def reopened(cls, source: Any, schema: Any, path: str | os.PathLike[str] | None = None) -> Self:
        """The data that were recorded, from there or from another path, whatever they are now."""


def opened(
    run: str | os.PathLike[str], kind: str, source: Any, schema: Any, where: str | os.PathLike[str] | None = None
) -> Any:
    """The data of a run.

    Args:
        run: its directory.
        kind: of the data.
        source: where they were, as they `recorded` it.
        schema: of them.
        where: they lie now.

    Raises:
        CheckpointError: they are not there, or have changed.
    """
    where = os.fspath(where or source.path)
    try:
        found = DATA[kind].reopened(source, schema, where)
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{run} was fitted on {source.path}, but {where} is not here; relative paths count from the working "
            "directory, so change to where it was fitted, or tell where the data lie now, or other data (--data)"
        ) from error
    if found.fingerprint != source.fingerprint:
        raise CheckpointError(
            f"{where} has changed since {run} was fitted on it: its fingerprint is {found.fingerprint[:12]}…, the "
            f"run's {source.fingerprint[:12]}…; restore the file, or fit again"
        )
    return found
