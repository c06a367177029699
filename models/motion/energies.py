"""What methods share that learn from energies of whole motions: their options, and the model that scores its samples.

Several samples of a window are drawn together. The energies say that the best of them is near the truth and that the
best is near each pseudo ground truth, that the samples of a body part differ, that they keep the limbs' lengths, stay
within the joints' angles, and look like poses to a prior. Source: GSPS (Mao, Liu and Salzmann, 2021, arXiv 2108.08422).

Ours: a model may see every window turned so that the last observed pose faces one way, which helps on small sets; and
it may see and make directions of bones, whose lengths then stay. The energies are of positions in either case.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor

from ...data.batch import WHOLE, Batch
from ...data.sequences import Source
from ...data.views import View, Views
from ...motion import Bones, Heading, Skeleton, Windows
from ...motion.geometry.angles import AngleLimits, angle_names, estimate_angle_limits
from ...motion.geometry.views import LENGTHS
from ...motion.judges.pose_prior import PosePriorModel, fit_pose_prior, load_pose_prior
from ...motion.scoring import energies
from ...motion.scoring.truths import PseudoTruths, WithPseudoTruths
from ...options import Amount, Count, Positive, Range, Size
from ...program.model import DynamicalVAE
from .poses import PoseMethod


@dataclass(frozen=True)
class EnergyMethod(PoseMethod):
    """A method that learns from energies.

    Args:
        reconstruction: weight of the squared error of the best sample.
        multimodal: weight of that to the pseudo ground truths.
        diversity: weight of the likeness of a part's samples, for each part.
        diversity_scale: metres, L1, over which samples of a part are alike, for each part.
        limb: weight of the squared error of the limbs' lengths.
        angles: weight of the violation of the angles' limits.
        pose_prior: weight of the poses' energy under a pose prior.
        pose_prior_run: run directory of a fitted pose-prior; "" to fit one first.
        angle_quantile: share of the training poses that an angle's limit leaves out at each end.
        pseudo_threshold: metres between last observed poses, within which futures are exchanged.
        pseudo_minimum: metres, mean over joints, that such a future keeps from the true one.
        pseudo_most: largest number of them for a window.
        pool_stride: frames between the windows that they are taken from.
        bones: see and make the directions of bones, whose lengths are those that the observed frames have: no future of
            this method stretches a bone. There is no density then and no bound, and windows have to be complete.
        heading: turn every window so that its last observed pose faces one way, and the futures back. Whatever reads
            the frames before then knows of that one, and bounds are those of turned windows, whose heading nothing
            scores: they compare with those of models that turn them too, and with no others.
    """

    weights: ClassVar[tuple[str, ...]] = ("reconstruction", "multimodal", "diversity", "limb", "angles", "pose_prior")

    reconstruction: Amount | None = None
    multimodal: Amount | None = None
    diversity: tuple[Amount, ...] | None = None
    diversity_scale: tuple[Positive, ...] | None = None
    limb: Amount | None = None
    angles: Amount | None = None
    pose_prior: Amount | None = None
    pose_prior_run: str = ""
    angle_quantile: Annotated[float, Range(0, 0.5, below=True)] = 0.0
    pseudo_threshold: Amount = 0.5
    pseudo_minimum: Amount | None = None
    pseudo_most: Size = 10
    pool_stride: Count | None = None
    bones: bool = False
    heading: bool | None = None

    def start(self, model: EnergyModel, windows: Windows) -> None:
        """Has a model take the limits of the angles and the pose prior.

        Raises:
            ValueError: a pose prior of another skeleton.
        """
        if model.limits is not None:
            limits = estimate_angle_limits(windows.poses(), windows.skeleton, self.angle_quantile)
            model.angle_low.copy_(limits.low)
            model.angle_high.copy_(limits.high)
        if model.pose_prior is not None:
            heading = bool(model.method.heading)
            run = self.pose_prior_run
            prior = load_pose_prior(run, windows.skeleton, heading) if run else fit_pose_prior(windows, heading=heading)
            model.pose_prior.load_state_dict(prior.state_dict())

    def scored(self, windows: Windows) -> Source:
        """Windows with their pseudo ground truths, if these count; of a method with no option left open."""
        method: Any = self
        if not method.multimodal:
            return windows
        limits = {name: getattr(self, f"pseudo_{name}") for name in ("threshold", "minimum", "most")}
        truths = PseudoTruths(windows, **limits, stride=method.pool_stride, heading=bool(method.heading))
        return WithPseudoTruths(windows, truths)


class EnergyModel(DynamicalVAE):
    """A model of windows whose samples are scored by energies.

    Batches may hold "pseudo" (B, M, T, D) and "valid" (B, M): further futures of the windows.

    Args:
        method: with no option left open.
        skeleton: of poses whose root was dropped, D = 3 (J - 1).
        observed: O, frames before the present.
        views: of the windows, once these are turned.
        **options: of `DynamicalVAE`.
    """

    extras: ClassVar[tuple[str, ...]] = ("pseudo", "valid")
    angle_low: Tensor
    angle_high: Tensor

    def __init__(self, method: Any, skeleton: Skeleton, observed: int, views: Sequence[View] = (), **options: Any):
        pieces = {name: places for view in views for name, places in (view.parts or {}).items()}
        heading = Heading(skeleton, observed, turned=(WHOLE, *pieces)) if method.heading else None
        bones = Bones(skeleton, observed, pieces) if method.bones else None
        super().__init__(view=Views(*(view for view in (heading, bones) if view), *views), **options)
        self.method, self.skeleton, self.frames, self.heading, self.bones = method, skeleton, observed, heading, bones
        self.limits: tuple[str, ...] | None = None
        self.angles: AngleLimits | None = None
        if method.angles:
            self.limits = angle_names(skeleton)
            self.register_buffer("angle_low", torch.full((len(self.limits),), -1.0))
            self.register_buffer("angle_high", torch.full((len(self.limits),), 1.0))
        self.pose_prior = PosePriorModel(skeleton).requires_grad_(False) if method.pose_prior else None

    def best(self, samples: Tensor, truth: Tensor, batch: Batch) -> dict[str, Tensor]:
        """The energies of the best sample, (B,) each; those of weight 0 are left out.

        Args:
            samples: (S, B, T, D), the frames that count, of positions that are turned as the networks see motion.
            truth: (B, T, D), likewise; NaN where it was not observed.
            batch: with "pseudo" and "valid", where there are further futures, whose last T frames count.
        """
        found: dict[str, Tensor] = {}
        if self.method.reconstruction:
            found["reconstruction"] = energies.best_of_many(samples, truth)
        if self.method.multimodal:
            found["multimodal"] = truth.new_zeros(len(truth))
            if "pseudo" in batch:
                others = self._turned(batch["pseudo"], batch)[:, :, -samples.shape[2] :]
                found["multimodal"] = energies.multimodal_best_of_many(samples, others, batch["valid"])
        return found

    def realism(self, samples: Tensor, truth: Tensor, judged: Tensor) -> dict[str, Tensor]:
        """The energies of the limbs' lengths, the angles and the pose prior, (B,) each; as in `best`.

        Args:
            samples: (S, B, T, D), whose limbs count in all frames.
            truth: (B, T, D), whose first frame, of those that have the most joints, has the right lengths.
            judged: (S, B, T, D), those whose poses count.
        """
        found: dict[str, Tensor] = {}
        if self.method.limb:
            fullest = truth.isfinite().sum(-1).argmax(-1)
            reference = truth.take_along_dim(fullest[:, None, None], 1).squeeze(1)
            found["limb"] = energies.limb_length(samples, reference, self.skeleton)
        if self.limits is not None:
            if self.angles is None or self.angles.low is not self.angle_low:  # checked once, which is waited for
                self.angles = AngleLimits(self.limits, self.angle_low, self.angle_high)
            found["angles"] = energies.joint_angles(judged, self.angles, self.skeleton)
        if self.pose_prior is not None:
            offset = int(torch.randint(min(3, judged.shape[2]), ()))  # every third frame, another third at every step
            found["pose_prior"] = energies.pose_prior_energy(judged[:, :, offset::3], self.pose_prior, self.skeleton)
        return found

    def turned(self, x: Tensor) -> Tensor:
        """Windows (..., T, D) turned as the networks see them."""
        return x if self.heading is None else self.heading.face(x)

    def positions(self, values: Mapping[str, Tensor], data: Batch) -> Batch:
        """Positions (..., B, T, D), turned, from x or all its parts as the networks see them."""
        lengths = {LENGTHS: data[LENGTHS]} if self.bones else {}
        return self.view.inverse(Batch(values) | lengths)

    def _turned(self, others: Tensor, batch: Batch) -> Tensor:
        """Other futures (B, M, T, D) of the windows of a batch, turned as these were."""
        if self.heading is None:
            return others
        return self.heading(Batch({WHOLE: others.transpose(0, 1)}), batch)[WHOLE].transpose(0, 1)

    def seen(self, x: Tensor, batch: Batch) -> Tensor:
        """x (B, T, D) of a batch as it was read, NaN where it was not observed."""
        mask = batch.mask(self.view.history or WHOLE)
        return x if mask is None else torch.where(mask, x, torch.nan)
