"""The five papers on human motion, and what several methods of motion share."""

from typing import TYPE_CHECKING

from ...lazy import importing

if not TYPE_CHECKING:
    __getattr__ = importing(__name__)
