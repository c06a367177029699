"""Networks: parents to features under the masks of a factorization."""

from .attention import Attention, SelfAttention
from .base import Input, Network, NetworkSpec
from .cosine import CosineDecoder, CosineEncoder
from .dense import Dense
from .graphconv import GraphConv
from .graphs import FrameGraph, NodeGraph
from .linear import Linear
from .recurrent import Recurrent

__all__ = [
    "Attention",
    "CosineDecoder",
    "CosineEncoder",
    "Dense",
    "FrameGraph",
    "GraphConv",
    "Input",
    "Linear",
    "Network",
    "NetworkSpec",
    "NodeGraph",
    "Recurrent",
    "SelfAttention",
]
