"""Bounds, training, evaluation, comparison and diagnostics of models."""

from typing import TYPE_CHECKING

if __name__ != "dvae.inference":
    raise ImportError(f"import this package as dvae.inference, not as {__name__}: a second path loads a second copy")

from ..lazy import importing

if not TYPE_CHECKING:
    __getattr__ = importing(__name__)
