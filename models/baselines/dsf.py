"""DSF, the diversity sampling function: K futures of a moving body, by latents that are far from each other.

    p(x_t | x_{<t}, h, k)        w = b_k(h)        nothing is latent

A network of the observed poses h returns K latents, and the decoder of a fitted CVAE predicts the future of each. There
is no noise, so that a window has exactly K futures. The loss is minus the expected number of futures that a
determinantal point process selects,

    -tr(I - (L + I)^-1),    L_ij = r_i r_j exp(-||x^i - x^j||^2 / s),    log r_i = log omega - max(||w_i||^2 - R^2, 0)

Distances are over all frames and coordinates. R is the radius of the ball that contains a share rho of N(0, I). Only r
keeps the futures near the data.

Yuan and Kitani, 2020, arXiv 1907.04967; we know of no public code. Our choices are omega and rho. The network, its
number of modes and the distances s are from DLow (arXiv 2003.08386), as in published comparisons of the two.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import scipy
from torch import Tensor
from typing_extensions import override

from ...data.batch import WHOLE, Batch
from ...inference.training.objectives import Evidence, Objective
from ...motion.scoring import energies
from ...options import Amount, Positive, Range
from ...program.rollout import Rollout
from ..motion.futures import HISTORY
from ..motion.modes import MODE, SHAPE, WHOLE_SETS, ModesMethod, ModesModel
from ..motion.poses import table

PRESETS = table(
    "latent width hidden modes diversity_scale heading",
    {"human36m": (*SHAPE, 50, 100.0, False), "humaneva": (*SHAPE, 50, 20.0, False), "": (*SHAPE, 10, 20.0, True)},
)
"""Options by skeleton, as in DLow."""


@dataclass(frozen=True)
class DSF(ModesMethod):
    """The diversity sampling function.

    Args:
        beta: weight of half the squared norm of the latents, mean over modes; the paper has no such term.
        diversity_scale: s, scale of squared distances between futures, in square metres; two futures at this distance
            have similarity 1 / e. The default is the value of DLow.
        quality: omega, quality of a latent within the radius R.
        radius: rho, probability under N(0, I) of a latent within the radius R, which determines R.
    """

    name = "dsf"
    source = "Yuan and Kitani, 2020, arXiv 1907.04967"
    generative = "p(x_t | x_{<t}, h, k)"
    presets = PRESETS

    beta: Amount = 0.0
    diversity_scale: Positive | None = None
    quality: Positive = 1.0
    radius: Annotated[float, Range(0, 1, above=True, below=True)] = 0.9

    @override
    def kind(self) -> type[DSFModel]:
        return DSFModel

    @override
    def objective(self) -> Objective:
        """Return minus the expected number of selected futures, per frame as in `Evidence`."""
        weights = {"cardinality": 1.0}
        weights |= {"norm": self.beta} if self.beta else {}
        weights |= {"join": self.join} if self.join else {}
        draws = {MODE: self.modes or 0}
        return Evidence(energy_weights=weights, likelihood_weight=0.0, draws=draws, select="loss")


class DSFModel(ModesModel):
    """The model of DSF. Forecasts of more than K futures contain repeated futures."""

    method: DSF

    @override
    def penalties(self, rollout: Rollout, data: Batch, draws: Mapping[str, int]) -> dict[str, Tensor]:
        """Return the energies of the futures of each window in all modes."""
        penalties = super().penalties(rollout, data, {})
        if WHOLE_SETS not in data:
            return penalties
        method, codes = self.method, self.sampler(rollout.values[HISTORY])
        squares = codes.square().sum(2).T
        excess = (squares - float(scipy.special.chdtri(codes.shape[2], 1 - method.radius))).clamp_min(0)
        futures = rollout.parameters(WHOLE, rollout.values[WHOLE])[0].unflatten(0, (self.modes, -1))
        quality, scale = method.quality * (-excess).exp(), method.diversity_scale or 1.0
        penalties["cardinality"] = energies.determinantal_diversity(futures, quality, scale)
        if method.beta:
            penalties["norm"] = squares.mean(0) / 2
        return penalties
