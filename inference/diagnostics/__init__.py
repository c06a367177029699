"""Diagnostics of a fitted model and its guide."""

from typing import TYPE_CHECKING

from ...lazy import importing

if not TYPE_CHECKING:
    __getattr__ = importing(__name__)
