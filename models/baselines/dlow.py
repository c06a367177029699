"""DLow: futures of a moving body in K modes, by one noise that each mode's affine map turns into a CVAE's latent.

    p(e) p(x_t | x_{<t}, h, e, k)        w = a_k(h) e + b_k(h)        q(e)

A network of the observed poses h returns the maps of all modes, and the decoder of a fitted CVAE predicts the future
from w. The K futures of a window share one noise e ~ N(0, I). The loss is the KL divergence of each mode's latents from
N(0, I), plus the similarity of the futures, plus the squared error of the best future:

    beta mean_k KL(N(b_k, diag a_k^2) || N(0, I)) + lambda mean_{i<j} exp(-||x^i - x^j||^2 / s) + 2 min_k ||x^k - x||^2

Distances are over all frames and coordinates. If parts of the body are fixed, only the other joints should differ. The
loss then includes the squared distance of the fixed joints from their positions in the first mode.

Yuan and Kitani, 2020, arXiv 2003.08386, with the normalisation of its public code. For Human3.6M, the network has
2,038,528 parameters with 10 modes and 7,291,648 with 50 modes, without the decoder. Our choices are the weight of fixed
joints, the heading, and lambda and s for other data. For lambda and s we use the values of HumanEva, whose windows have
as many frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor
from typing_extensions import override

from ...constants import indices
from ...data.batch import WHOLE, Batch
from ...data.schema import SchemaError
from ...inference.training.objectives import Evidence, Objective
from ...motion import Skeleton
from ...motion.geometry.parts import places_of
from ...motion.scoring import energies
from ...options import Amount, Positive
from ...program.conditional import like
from ...program.rollout import Rollout
from ..motion.futures import HISTORY
from ..motion.modes import MODE, NOISE, SHAPE, WHOLE_SETS, ModesMethod, ModesModel
from ..motion.poses import table

PRESETS = table(
    "latent width hidden modes diversity diversity_scale heading",
    {
        "human36m": (*SHAPE, 50, 25.0, 100.0, False),
        "humaneva": (*SHAPE, 50, 50.0, 20.0, False),
        "": (*SHAPE, 10, 50.0, 20.0, True),
    },
)
"""Options by skeleton: the paper's values, and our values for other skeletons."""


@dataclass(frozen=True)
class DLow(ModesMethod):
    """The DLow sampler of a fitted CVAE.

    Args:
        beta: weight of the KL divergence of each mode's latents from N(0, I).
        diversity: lambda, weight of the similarity of the futures; None, here and below, for the preset.
        diversity_scale: s, scale of squared distances between futures, in square metres; two futures at this distance
            have similarity 1 / e.
        reconstruction: weight of the squared error of the best future.
        fixed: parts of the body, or joints, with the same motion in all modes, such as "lower".
        fixed_weight: weight of the squared distance of fixed joints from their positions in the first mode, averaged
            over the other modes.
    """

    name = "dlow"
    source = "Yuan and Kitani, 2020, arXiv 2003.08386"
    generative = "p(e) p(x_t | x_{<t}, h, e, k)"
    inference = "q(e)"
    presets = PRESETS

    beta: Amount = 1.0
    diversity: Amount | None = None
    diversity_scale: Positive | None = None
    reconstruction: Amount = 2.0
    fixed: tuple[str, ...] = ()
    fixed_weight: Amount = 10.0

    @override
    def sizes(self) -> dict[str, int]:
        return {NOISE: self.latent or 0, **super().sizes()}

    @override
    def model_arguments(self, sizes: Mapping[str, int]) -> dict[str, Any]:
        """Return the arguments, with one noise for the modes of a window."""
        return {**super().model_arguments(sizes), "grouped": (NOISE,)}

    @override
    def kind(self) -> type[DLowModel]:
        return DLowModel

    @override
    def objective(self) -> Objective:
        """Return the weighted energies, per frame as in `Evidence`.

        Raises:
            ValueError: if weights that depend on the skeleton are unset.
        """
        if self.diversity is None:
            raise ValueError("the weights depend on the skeleton; call method.resolve_defaults(windows) first")
        weights = {"reconstruction": self.reconstruction, "kl": self.beta, "diversity": self.diversity}
        weights |= {"join": self.join} if self.join else {}
        weights |= {"fixed": self.fixed_weight} if self.fixed else {}
        draws = {MODE: self.modes or 0}
        return Evidence(energy_weights=weights, likelihood_weight=0.0, draws=draws, select="loss")


class DLowModel(ModesModel):
    """The model of DLow."""

    method: DLow

    def __init__(self, method: DLow, frames: int, skeleton: Skeleton | None, **options: Any) -> None:
        super().__init__(method, frames, skeleton, **options)
        if method.fixed and skeleton is None:
            raise SchemaError(
                f"fixed names {', '.join(method.fixed)}, but the data have no skeleton; fit dlow to windows of poses"
            )
        fixed_joints = set(places_of(skeleton, method.fixed)) if skeleton else set()
        parts = [
            [c for c in range(self.sizes[WHOLE]) if (c // 3 in fixed_joints) == is_fixed] for is_fixed in (True, False)
        ]
        self.fixed, self.free = parts
        if not self.free:
            raise ValueError(f"fixed names {', '.join(method.fixed)}, which are all joints; leave some joints free")

    @override
    def penalties(self, rollout: Rollout, data: Batch, draws: Mapping[str, int]) -> dict[str, Tensor]:
        """Return the energies of the futures of each window in all modes."""
        if WHOLE_SETS not in data:
            return super().penalties(rollout, data, draws)
        penalties = super().penalties(rollout, data, {MODE: self.modes})
        shapes = self.sampler(rollout.values[HISTORY]).to(like(self).dtype)  # half precision under autocast
        scale, location = shapes.chunk(2, -1)
        variance = scale.square()
        penalties["kl"] = (variance + location.square() - 1 - variance.log()).sum(2).mean(1) / 2
        futures = rollout.parameters(WHOLE, rollout.values[WHOLE])[0].unflatten(0, (self.modes, -1))
        free_motion = futures.index_select(-1, indices(self.free, futures))
        penalties["diversity"] = energies.gaussian_diversity(free_motion, self.method.diversity_scale or 1.0)
        if self.fixed:
            fixed_motion = futures.index_select(-1, indices(self.fixed, futures))
            distances = (fixed_motion - fixed_motion[:1]).square().sum((2, 3))
            penalties["fixed"] = distances.sum(0) / max(self.modes - 1, 1)
        return penalties
