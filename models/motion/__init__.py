"""The methods of five papers on human motion, and code that several of them share."""

from typing import TYPE_CHECKING

from ...lazy import importing

if not TYPE_CHECKING:
    __getattr__ = importing(__name__)
