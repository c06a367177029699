"""Data of any kind: batches, windows of arrays, schemas, units and views."""

from typing import TYPE_CHECKING

from ..lazy import importing

if TYPE_CHECKING:
    from .schema import Schema, SchemaError
    from .sequences import ArrayWindows, HeldOutWindows, Sequences, gaps, past_of, since_observed

__all__ = [
    "ArrayWindows",
    "HeldOutWindows",
    "Schema",
    "SchemaError",
    "Sequences",
    "gaps",
    "past_of",
    "since_observed",
]

_PLACES = {name: "schema" if name.startswith("Schema") else "sequences" for name in __all__}

if not TYPE_CHECKING:
    __getattr__ = importing(__name__, _PLACES)
