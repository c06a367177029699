"""Encoder-recurrent-decoder: a perceptron on each pose, LSTMs over time, and a perceptron to the next pose.

    p(x_t | x_{<t})        x_t = decoder(LSTMs(encoder(x_{t-1})))

In training, its input poses have noise, which increases by a curriculum. The network thereby learns to continue from
poses that deviate from the data, as its own output will.

Fragkiadaki, Levine, Felsen and Malik, 2015, arXiv 1508.00271, with its sizes for motion capture. Our choices are
positions instead of joint rotations, and rectified linear units in all layers except the last. Our noise rises
linearly, relative to one scale for all coordinates. The reimplementation of Jain et al., 2016, arXiv 1511.05298,
increases it from .01 to .7 in seven steps, relative to the scale of each coordinate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from typing_extensions import override

from ...inference.training.schedules import Schedule
from ...networks import NetworkSpec, Recurrent
from ...options import Amount, Layers, Size
from ...program.rollout import InputNoise, ScheduledSampling
from ..method import rising
from ..motion.poses import table
from .deterministic import DeterministicMethod

PAPER = (1000, (500, 500), (500, 100), False)


@dataclass(frozen=True)
class ERD(DeterministicMethod):
    """The encoder-recurrent-decoder.

    Args:
        encoder: widths of the perceptron before the LSTMs; the default depends on the skeleton, as for `width`.
        decoder: widths of the perceptron after the LSTMs; the default depends on the skeleton, as for `width`.
        noise: final standard deviation of the noise on the input in training, relative to the scale of x, or
            in the unit of x without `standardise`. It rises from 0 over a third of training, after the first tenth. 0
            for none.
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
        if self.noise and self.scheduled_sampling:
            raise ValueError(
                f"noise is {self.noise} and scheduled_sampling is {self.scheduled_sampling}, but in training "
                "a model reads either noisy data or its own means; set one of them to 0"
            )

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        """Return LSTMs between two perceptrons."""
        shape: dict[str, Any] = {"hidden": self.decoder, "activation": "relu"}
        return {"default": Recurrent(self.width or 0, layers=self.layers, extract={"x": self.encoder or ()}, **shape)}

    @override
    def fed(self) -> ScheduledSampling | InputNoise:
        return InputNoise(self.noise) if self.noise else ScheduledSampling(0.0, gradient=False)

    @override
    def _feeding(self, steps: int) -> Schedule | float:
        return rising(1.0, steps) if self.noise else super()._feeding(steps)
