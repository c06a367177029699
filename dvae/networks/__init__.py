"""Networks: parents to features under the masks of a factorization."""

from .attention import Attention, SelfAttention
from .base import Input, Network, NetworkSpec
from .dense import Dense
from .graphconv import GraphConv
from .linear import Linear
from .posegraph import FrameGraph, PoseGraph
from .recurrent import Recurrent

__all__ = [
    "Attention",
    "Dense",
    "FrameGraph",
    "GraphConv",
    "Input",
    "Linear",
    "Network",
    "NetworkSpec",
    "PoseGraph",
    "Recurrent",
    "SelfAttention",
]
