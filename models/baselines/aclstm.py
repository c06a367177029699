"""The auto-conditioned LSTM: in training it reads blocks of the data and blocks of its own output in turns.

    p(x_t | x_{<t})        x_t = W LSTMs(x_{t-1}) + b

Of every ten frames it reads five of the data and then five that it made itself, from the first step of training on;
gradients flow through these. So it learns to come back from where its own output has gone.

Zhou, Li, Xiao, He, Huang and Li, 2018, arXiv 1707.05363. In the public implementation each LSTM reads the state that
the one below it had a step before; here it reads the present one, and a loss sums squares that are means there. Windows
are not turned at random as there: see `heading`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from typing_extensions import override

from ...inference.training.options import Training
from ...inference.training.schedules import Schedule
from ...networks import NetworkSpec, Recurrent
from ...options import Layers, Share, Size
from ...program.rollout import SelfFeeding
from ..motion.poses import table
from .deterministic import DeterministicMethod


@dataclass(frozen=True)
class ACLSTM(DeterministicMethod):
    """See the file.

    Args:
        shown: frames of the data in a block.
        own: frames of its own output in the block that follows.
        self_feeding: probability with which each frame of such a block is its own output; else it is the data's.
    """

    name = "aclstm"
    source = "Zhou, Li, Xiao, He, Huang and Li, 2018, arXiv 1707.05363"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = table(
        "width heading", {"human36m": (1024, False), "humaneva": (1024, False), "": (256, True)}
    )
    trainings: ClassVar[Mapping[str, Training]] = {
        **DeterministicMethod.trainings,
        "": Training(learning_rate=1e-2, decay=0.5),
    }

    layers: Layers = 3
    shown: Size = 5
    own: Size = 5
    self_feeding: Share = 1.0

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """LSTMs alone; the law has the linear layer behind them."""
        return {"default": Recurrent(self.width or 0, layers=self.layers, hidden=())}

    @override
    def fed(self) -> SelfFeeding:
        return SelfFeeding(0.0, gradient=True, blocks=(self.shown, self.own))

    @override
    def _feeding(self, steps: int) -> Schedule | float:
        return self.self_feeding
