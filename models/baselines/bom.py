"""BoM: the CVAE, trained so that the best of several draws is near the true future.

    p(w) p(x_t | x_{<t}, h, w)        q(w | x_{1:T}, h)

The loss has the squared error of the best draw from the guide for each window, instead of the mean over all draws. The
other draws are therefore free to differ (Bhattacharyya, Schiele and Fritz, 2018, arXiv 1806.07772). It has the networks
of the CVAE of Yuan and Kitani, 2020, arXiv 2003.08386, as in published comparisons of motion prediction.
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
    """The best-of-many CVAE.

    Args:
        samples: number of draws of w for each window in training.
    """

    name = "bom"
    source = "Bhattacharyya, Schiele and Fritz, 2018, arXiv 1806.07772"

    samples: Size = 10

    @override
    def objective(self) -> Objective:
        evidence: Any = super().objective()
        return replace(evidence, likelihood_weight=0.0, draws={"w": self.samples})
