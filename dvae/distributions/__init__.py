"""Distributions of sequences."""

from .flow import FlowDistribution, QRFlow
from .sequence import Sequence

__all__ = ["FlowDistribution", "QRFlow", "Sequence"]
