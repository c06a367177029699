"""Data of any kind: batches, windows of arrays, schemas, units and views."""

from typing import TYPE_CHECKING

from ..lazy import importing

if TYPE_CHECKING:
    from .batch import Batch
    from .schema import Schema, SchemaError
    from .sequences import ArrayWindows, HeldOutWindows, Sequences, time_since_observed, time_since_previous

__all__ = [
    "ArrayWindows",
    "Batch",
    "HeldOutWindows",
    "Schema",
    "SchemaError",
    "Sequences",
    "time_since_observed",
    "time_since_previous",
]

_MODULES = dict.fromkeys(__all__, "sequences") | {"Batch": "batch", "Schema": "schema", "SchemaError": "schema"}

if not TYPE_CHECKING:
    __getattr__ = importing(__name__, _MODULES)
