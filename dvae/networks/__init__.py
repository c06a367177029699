"""Networks that map the parents of a factor to features, under the masks of the factorization.

>>> networks = {"p": dvae.networks.Dense((16,)), "q": dvae.networks.Attention(width=16, heads=2)}
>>> model = dvae.DynamicalVAE("p(z_t) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 2, "x": 3}, networks)
"""

from .attention import Attention, SelfAttention
from .base import Input, Network, NetworkSpec
from .cosine import CosineDecoder, CosineEncoder
from .denoising import Denoiser
from .graphconv import GraphConv
from .graphs import FrameGraph, NodeGraph
from .known_noise import WithNoise
from .linear import Linear
from .recurrent import Dense, Recurrent
from .sde import LinearSDE, LinearSDEGuide
from .whole import WholeDecoder, WholeEncoder

__all__ = [
    "Attention",
    "CosineDecoder",
    "CosineEncoder",
    "Denoiser",
    "Dense",
    "FrameGraph",
    "GraphConv",
    "Input",
    "Linear",
    "LinearSDE",
    "LinearSDEGuide",
    "Network",
    "NetworkSpec",
    "NodeGraph",
    "Recurrent",
    "SelfAttention",
    "WholeDecoder",
    "WholeEncoder",
    "WithNoise",
]
