"""Runs: directories that hold a fit and all it takes to go on with it, one run or many."""

from typing import TYPE_CHECKING

from ..lazy import importing

if not TYPE_CHECKING:
    __getattr__ = importing(__name__)
