"""Laws: distributions of a variable given features, and what they are made of."""

from .base import Law, LawSpec, Shape, renamed
from .families import Delta, FixedNormal, Normal, StandardNormal, StudentT
from .flow import FlowDistribution, QRFlow
from .priors import Flow, Mixture, Vamp

__all__ = [
    "Delta",
    "FixedNormal",
    "Flow",
    "FlowDistribution",
    "Law",
    "LawSpec",
    "Mixture",
    "Normal",
    "QRFlow",
    "Shape",
    "StandardNormal",
    "StudentT",
    "Vamp",
    "renamed",
]
