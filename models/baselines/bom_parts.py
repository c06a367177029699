"""BoM by parts: GSPS's generator, of whose futures the best alone has to be near what happened.

    p(a) p(b) p(lower_t | h_{1:O}, a) p(upper_t | h_{1:O}, lower_{1:T}, b)        q(a) q(b)

The parts of the body are made one after the other, as in GSPS (Mao, Liu and Salzmann, 2021, arXiv 2108.08422, eq. 14),
and can be controlled as there. What is minimised is the squared error of the best of ten futures after the observed
frames (Bhattacharyya, Schiele and Fritz, 2018, arXiv 1806.07772), and no other energy: BoM says nothing of the observed
frames, of diversity, of further futures, or of bodies. It is the row "BoM with Eq. 14" of GSPS's table of control.

GSPS does not tell how it was made; ours is that there is no guide but the prior, as GSPS has none, and that the ten
futures have a latent of each part of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from typing_extensions import override

from ...motion import Skeleton
from ...options import Amount
from ..motion.gsps import GSPS

SAMPLES = 10
"""Futures of a window in training, as BoM's code has them."""


@dataclass(frozen=True)
class BoMParts(GSPS):
    """See the file; options are those of GSPS, where weights of other energies are 0 and `draws` makes ten futures."""

    name = "bom-parts"
    source = "Bhattacharyya, Schiele and Fritz, 2018, arXiv 1806.07772"

    reconstruction: Amount = 1.0
    multimodal: Amount = 0.0
    diversity: tuple[Amount, ...] | None = (0.0,)
    history: Amount = 0.0
    limb: Amount = 0.0
    angles: Amount = 0.0
    pose_prior: Amount = 0.0

    @override
    def preset(self, skeleton: Skeleton) -> Mapping[str, Any]:
        """Of later parts one draw for each of the first."""
        return {**super().preset(skeleton), "draws": (SAMPLES, *[1] * (len(self.parts) - 1))}
