"""The encoder-recurrent-decoder: a perceptron on each pose, LSTMs over time, a perceptron back to the next pose.

    p(x_t | x_{<t})        x_t = decoder(LSTMs(encoder(x_{t-1})))

In training the poses that it reads have noise, by a curriculum: the more of it, the further off from the data it learns
to go on, as it will have to on its own output.

Fragkiadaki, Levine, Felsen and Malik, 2015, arXiv 1508.00271, whose sizes for motion capture these are. Ours: positions
in place of joints' turns, rectified linear units in all layers but the last, and noise that rises as a line, beside one
spread for all coordinates; the reimplementation of Jain et al., 2016, arXiv 1511.05298, goes from .01 to .7 in seven
steps, beside the spread of each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from typing_extensions import override

from ...inference.training.schedules import Schedule
from ...networks import NetworkSpec, Recurrent
from ...options import Amount, Layers, Size
from ...program.rollout import InputNoise, SelfFeeding
from ..method import rising
from ..motion.poses import table
from .deterministic import DeterministicMethod

PAPER = (1000, (500, 500), (500, 100), False)


@dataclass(frozen=True)
class ERD(DeterministicMethod):
    """See the file.

    Args:
        encoder: widths of the perceptron before the LSTMs; None as for `width`.
        decoder: widths of the perceptron behind them; None likewise.
        noise: standard deviation, at the end, of the noise on what is read in training, beside the spread of x. It
            rises from 0 over a third of training, after the first tenth. 0 for none.
    """

    name = "erd"
    source = "Fragkiadaki, Levine, Felsen and Malik, 2015, arXiv 1508.00271"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = table(
        "width encoder decoder heading",
        {"human36m": PAPER, "humaneva": PAPER, "": (256, (128, 128), (128, 64), True)},
    )

    layers: Layers = 2
    encoder: tuple[Size, ...] | None = None
    decoder: tuple[Size, ...] | None = None
    noise: Amount = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.noise and self.self_feeding:
            raise ValueError(
                f"noise is {self.noise} and self_feeding is {self.self_feeding}, but in training a model reads data "
                "with noise or its own means; leave one of them 0"
            )

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """LSTMs between two perceptrons."""
        shape: dict[str, Any] = {"hidden": self.decoder, "activation": "relu"}
        return {"default": Recurrent(self.width or 0, layers=self.layers, extract={"x": self.encoder or ()}, **shape)}

    @override
    def fed(self) -> SelfFeeding | InputNoise:
        return InputNoise(self.noise) if self.noise else SelfFeeding(0.0, gradient=False)

    @override
    def _feeding(self, steps: int) -> Schedule | float:
        return rising(1.0, steps) if self.noise else super()._feeding(steps)
