"""Networks: parents to features under the masks of a factorization."""

from .attention import Attention, SelfAttention
from .base import Input, Network, NetworkSpec
from .cosine import CosineEncoder, MotionDecoder
from .dense import Dense
from .graphconv import GraphConv
from .linear import Linear
from .posegraph import FrameGraph, PoseGraph
from .recurrent import Recurrent

__all__ = [
    "Attention",
    "CosineEncoder",
    "Dense",
    "FrameGraph",
    "GraphConv",
    "Input",
    "Linear",
    "MotionDecoder",
    "Network",
    "NetworkSpec",
    "PoseGraph",
    "Recurrent",
    "SelfAttention",
]
