"""Runs: directories that contain a fit and everything needed to resume it, single runs and sweeps."""

from typing import TYPE_CHECKING

from ..lazy import importing

if not TYPE_CHECKING:
    __getattr__ = importing(__name__)
