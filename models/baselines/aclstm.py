"""Auto-conditioned LSTM: in training it alternately reads blocks of the data and blocks of its own output.

    p(x_t | x_{<t})        x_t = W LSTMs(x_{t-1}) + b

Of every ten frames it reads five of the data and then five of its own output, from the first step of training on.
Gradients flow through its output. The network therefore learns to recover from its own errors.

Zhou, Li, Xiao, He, Huang and Li, 2018, arXiv 1707.05363. There are three differences from the public implementation.
There, each LSTM reads the previous state of the one below it; here it reads the current state. There, the loss averages
squares; here it sums them. There, windows are rotated at random; here `heading` replaces this.
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
from ...program.rollout import ScheduledSampling
from ..motion.poses import table
from .deterministic import DeterministicMethod


@dataclass(frozen=True)
class ACLSTM(DeterministicMethod):
    """The auto-conditioned LSTM.

    Args:
        data_frames: number of frames of the data in a block.
        output_frames: number of frames of the network's own output in the following block.
        scheduled_sampling: probability that a frame of the second block is the network's own output instead of the
            data.
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
    data_frames: Size = 5
    output_frames: Size = 5
    scheduled_sampling: Share = 1.0

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return LSTMs alone; the linear layer after them belongs to the distribution."""
        return {"default": Recurrent(self.width or 0, layers=self.layers, hidden=())}

    @override
    def fed(self) -> ScheduledSampling:
        return ScheduledSampling(0.0, gradient=True, blocks=(self.data_frames, self.output_frames))

    @override
    def _feeding(self, steps: int) -> Schedule | float:
        return self.scheduled_sampling
