"""Conditional distributions of a variable given features, and the parts they are built from.

>>> distributions = {"p(x)": dvae.distributions.StudentT(df=4), "p(w)": dvae.distributions.Mixture(components=3)}
>>> model = dvae.DynamicalVAE("p(w) p(x_t | w)", "q(w | x_{1:T})", {"w": 2, "x": 3}, distributions=distributions)
"""

from .base import ConditionalDistribution, DistributionSpec, Shape
from .conditional_flow import ConditionalFlow
from .diffusion import Diffusion, FlowMatching
from .families import Delta, Directions, FixedNormal, KnownNoise, Normal, StandardNormal, StudentT
from .family import FAMILIES, Family, LowRankNormal, NormalMixture
from .flow import FlowDistribution, QRFlow
from .priors import Flow, Mixture, Vamp
from .product import Product
from .subset import Subset
from .triangular import Triangular

__all__ = [
    "FAMILIES",
    "ConditionalDistribution",
    "ConditionalFlow",
    "Delta",
    "Diffusion",
    "Directions",
    "DistributionSpec",
    "Family",
    "FixedNormal",
    "Flow",
    "FlowDistribution",
    "FlowMatching",
    "KnownNoise",
    "LowRankNormal",
    "Mixture",
    "Normal",
    "NormalMixture",
    "Product",
    "QRFlow",
    "Shape",
    "StandardNormal",
    "StudentT",
    "Subset",
    "Triangular",
    "Vamp",
]
