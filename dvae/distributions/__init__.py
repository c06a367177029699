"""Distributions of sequences."""

from .sequence import Sequence

__all__ = ["Sequence"]
