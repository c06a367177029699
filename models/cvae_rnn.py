"""CVAE-RNN: motion from one pose and any number of joint trajectories, by one latent and a recurrent decoder.

    p(w) p(x_t | x_{<t}, y_{1:T}, w, s)        q(w | r_{1:T}, y_{1:T}, s)

The stochastic baseline of TrajeVAE, in the same frame: y are the given trajectories, r what they leave out, s the first
pose. The decoder reads its own means in place of x from the first step on, in training too, and gradients flow through
them. Poses are absolute.

Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351, after the CVAE of Yuan and Kitani, 2020, arXiv 2003.08386. Ours:
LSTMs, whose last states enter the guide where that has a mean over time of GRUs, and a backward state of y at every
frame of the decoder where that has one summary of y beside y_t.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from ..networks import NetworkSpec, Recurrent
from ..rollout import SelfFeeding
from .trajectories import TrajectoryMethod


@dataclass(frozen=True)
class CVAERNN(TrajectoryMethod):
    """See the file.

    Args:
        latent: size of w.
        summary: units of the guide's recurrent states, for each direction.
        width: units of the decoder's.
        hidden: widths of the guide's perceptron.
        decoder: widths of the decoder's.
    """

    name: ClassVar[str] = "cvae-rnn"
    source: ClassVar[str] = "Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351"
    generative: ClassVar[str] = "p(w) p(x_t | x_{<t}, y_{1:T}, w, s)"
    inference: ClassVar[str] = "q(w | r_{1:T}, y_{1:T}, s)"

    latent: int = 256
    beta: float = 0.1
    summary: int = 64
    width: int = 128
    hidden: tuple[int, ...] = (300, 200, 128)
    decoder: tuple[int, ...] = (300, 200)

    def sizes(self) -> dict[str, int]:
        """Size of w."""
        return {"w": self.latent}

    def networks(self) -> Mapping[str, NetworkSpec]:
        """Recurrent states and perceptrons."""
        return {
            "q(w)": Recurrent(self.summary, hidden=self.hidden),
            "p(x)": Recurrent(self.width, hidden=self.decoder),
        }

    def _built(self, kind: Any, size: int, *arguments: Any) -> Any:
        model = super()._built(kind, size, *arguments)
        model.feeding = SelfFeeding(1.0, gradient=True)
        return model

    def feeding(self, steps: int) -> float:
        """1: the model never reads what it has not made."""
        return 1.0
