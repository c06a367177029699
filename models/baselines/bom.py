"""BoM: the CVAE, of which the best of several draws has to be near what happened.

    p(w) p(x_t | x_{<t}, h, w)        q(w | x_{1:T}, h)

In place of the mean squared error of draws from the guide stands that of the best of them, for each window, so that
the others are free to be elsewhere (Bhattacharyya, Schiele and Fritz, 2018, arXiv 1806.07772). With the networks of the
CVAE of Yuan and Kitani, 2020, arXiv 2003.08386, as in the tables of motion prediction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from typing_extensions import override

from ...inference.training.objectives import Objective
from ...options import Size
from .cvae import CVAE


@dataclass(frozen=True)
class BestOfMany(CVAE):
    """See the file.

    Args:
        samples: draws of w for each window in training.
    """

    name = "bom"
    source = "Bhattacharyya, Schiele and Fritz, 2018, arXiv 1806.07772"

    samples: Size = 10

    @override
    def objective(self) -> Objective:
        evidence: Any = super().objective()
        return replace(evidence, likelihood_weight=0.0, draws={"w": self.samples})
