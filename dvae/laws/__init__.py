"""Laws: distributions of a variable given features, and what they are made of."""

from .families import Delta, FixedNormal, Head, HeadSpec, Normal, StandardNormal, StudentT
from .flow import FlowDistribution, QRFlow
from .priors import FlowPrior, MixturePrior, Prior, VampPrior

__all__ = [
    "Delta",
    "FixedNormal",
    "FlowDistribution",
    "FlowPrior",
    "Head",
    "HeadSpec",
    "MixturePrior",
    "Normal",
    "Prior",
    "QRFlow",
    "StandardNormal",
    "StudentT",
    "VampPrior",
]
