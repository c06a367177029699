"""BoM by parts: GSPS's generator, trained only on the error of the best future.

    p(a) p(b) p(lower_t | h_{1:O}, a) p(upper_t | h_{1:O}, lower_{1:T}, b)        q(a) q(b)

The parts of the body are predicted one after the other, as in GSPS (Mao, Liu and Salzmann, 2021, arXiv 2108.08422, eq.
14), and can be controlled in the same way. Training minimises the squared error of the best of ten futures after the
observed frames (Bhattacharyya, Schiele and Fritz, 2018, arXiv 1806.07772). The other energies of GSPS are omitted. It
is the row "BoM with Eq. 14" of GSPS's table on controlled prediction.

The paper on GSPS does not describe its implementation. Our choices: the guide is the prior, since GSPS has no other
guide, and each of the ten futures has its own latent of each part.
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
"""Number of futures per window in training, as in the code of BoM."""


@dataclass(frozen=True)
class BoMParts(GSPS):
    """BoM by parts: GSPS with only the error of the best future, from ten futures of each window by default."""

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
        """Return the preset, with one draw of later parts for each draw of the first."""
        return {**super().preset(skeleton), "draws": (SAMPLES, *[1] * (len(self.parts) - 1))}
