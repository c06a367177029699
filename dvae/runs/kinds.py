"""Kinds of data that runs are fitted on, and of their schemas: known by name, and loaded when they are used."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, Self

from ..inference.checkpoints import CheckpointError
from ..models.registry import Registry
from ..schema import Schema

SCHEMAS = Registry({"sequences": "dvae.schema:Schema", "poses": "dvae.motion.protocols:Poses"}, "dvae.schemas")
DATA = Registry({"motion": "dvae.motion.dataset:MotionData"}, "dvae.data")
"""Kinds of schemas and of data, by the name that a config gives them."""


class Data(Protocol):
    """Data that runs are fitted on, such as `dvae.motion.MotionData`."""

    kind: ClassVar[str]

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

    def config(self) -> dict[str, Any]:
        """Where they are, in JSON's types, with path and fingerprint."""

    @classmethod
    def reopened(cls, config: Mapping[str, Any], schema: Any, path: str | os.PathLike[str] | None = None) -> Self:
        """The data that `config` describes, from there or from another path, whatever they are now."""


def opened(
    run: str | os.PathLike[str],
    data: Mapping[str, Any],
    schema: Schema | None,
    where: str | os.PathLike[str] | None = None,
) -> Any:
    """The data of a run.

    Args:
        run: its directory.
        data: where they were, as its config says.
        schema: of them; None where the config has none.
        where: they lie now.

    Raises:
        CheckpointError: they are not there, or have changed.
    """
    where = os.fspath(where or data["path"])
    try:
        found = DATA[data["kind"]].reopened(data, schema, where)
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{run} was fitted on {data['path']}, but {where} is not here; relative paths count from the "
            "working directory, so change to where it was fitted, or tell where the data lie now (--data)"
        ) from error
    if found.fingerprint != data["fingerprint"]:
        raise CheckpointError(
            f"{where} has changed since {run} was fitted on it: its fingerprint is {found.fingerprint[:12]}…, the "
            f"run's {data['fingerprint'][:12]}…; restore the file, or fit again"
        )
    return found
