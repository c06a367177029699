"""Networks: parents to features under the masks of a factorization."""

from .attention import Attention
from .base import Input, Network, NetworkSpec
from .dense import Dense
from .graphconv import GraphConv
from .linear import Linear
from .recurrent import Recurrent

__all__ = ["Attention", "Dense", "GraphConv", "Input", "Linear", "Network", "NetworkSpec", "Recurrent"]
