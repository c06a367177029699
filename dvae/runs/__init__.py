"""Runs: directories that contain a fit and everything needed to resume it; sweeps, ablations and reports."""

from typing import TYPE_CHECKING

from ..lazy import importing

if not TYPE_CHECKING:
    __getattr__ = importing(__name__)
