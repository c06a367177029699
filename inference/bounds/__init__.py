"""Bounds on the log evidence and their terms."""

from typing import TYPE_CHECKING

from ...lazy import importing

if not TYPE_CHECKING:
    __getattr__ = importing(__name__)
