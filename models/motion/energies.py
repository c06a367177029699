"""Base of the methods that learn from energies of whole motions: their options, and a model that scores its samples.

Several samples of a window are drawn together. The energies penalise

* the error of the best sample, relative to the truth and to each pseudo ground truth;
* similar samples of a body part;
* limbs that change their lengths, and joint angles outside their limits;
* poses that are unlikely under a pose prior.

Source: GSPS (Mao, Liu and Salzmann, 2021, arXiv 2108.08422).

Our additions: a model may see every window rotated so that the last observed pose faces one way, which helps on small
data sets. It may also read and predict directions of bones, which keeps their lengths constant. The energies always
compare positions.
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
from ...motion.metric_models.pose_prior import PosePriorModel, fit_pose_prior, load_pose_prior
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
        multimodal: weight of the squared error of the best sample to each pseudo ground truth.
        diversity: weight of the similarity of a part's samples, for each part.
        diversity_scale: length scale of this similarity, in metres of L1 distance, for each part.
        limb: weight of the squared error of the limbs' lengths.
        angles: weight of the violation of the joint-angle limits.
        pose_prior: weight of the poses' energy under a pose prior.
        pose_prior_run: run directory of a fitted pose-prior; "" to fit one first.
        angle_quantile: share of the training poses beyond an angle's limit, at each end.
        pseudo_threshold: largest distance between last observed poses of windows that exchange futures, in metres.
        pseudo_minimum: smallest distance of a pseudo ground truth from the true future, in metres, mean over joints.
        pseudo_most: largest number of pseudo ground truths of a window.
        pool_stride: frames between the windows that provide pseudo ground truths.
        bones: whether to read and predict directions of bones: futures keep the bone lengths of the observed frames.
            The model then has no density and no bound, and windows must be complete.
        heading: whether to rotate every window so that its last observed pose faces one way, and rotate the futures
            back. All earlier frames then depend on that pose. Bounds score rotated windows and ignore the heading:
            compare them only with bounds of models that rotate too.
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
        """Estimate the angle limits of a model, and load or fit its pose prior.

        Args:
            model: model of this method, changed in place.
            windows: training windows.

        Raises:
            ValueError: if the pose prior has another skeleton.
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
        """Return windows with pseudo ground truths if their weight is not 0; all options must be resolved."""
        method: Any = self
        if not method.multimodal:
            return windows
        limits = {name: getattr(self, f"pseudo_{name}") for name in ("threshold", "minimum", "most")}
        truths = PseudoTruths(windows, **limits, stride=method.pool_stride, heading=bool(method.heading))
        return WithPseudoTruths(windows, truths)


class EnergyModel(DynamicalVAE):
    """A model of windows whose samples are scored by energies.

    Batches may contain "pseudo" (B, M, T, D) and "valid" (B, M): further futures of the windows.

    Args:
        method: method whose options are all resolved.
        skeleton: skeleton of poses without root, D = 3 (J - 1).
        observed: O, number of observed frames.
        views: views applied to windows after their rotation.
        **options: arguments of `DynamicalVAE`.
    """

    extras: ClassVar[tuple[str, ...]] = ("pseudo", "valid")
    angle_low: Tensor
    angle_high: Tensor

    def __init__(self, method: Any, skeleton: Skeleton, observed: int, views: Sequence[View] = (), **options: Any):
        parts = {name: coordinates for view in views for name, coordinates in (view.parts or {}).items()}
        heading = Heading(skeleton, observed, turned=(WHOLE, *parts)) if method.heading else None
        bones = Bones(skeleton, observed, parts) if method.bones else None
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
        """Return the energies of the best sample whose weight is not 0, (B,) each.

        Args:
            samples: positions (S, B, T, D) of the frames to score, rotated as the networks see them.
            truth: (B, T, D), rotated likewise; NaN where it was not observed.
            batch: batch, with "pseudo" and "valid" if there are further futures, whose last T frames are scored.
        """
        terms: dict[str, Tensor] = {}
        if self.method.reconstruction:
            terms["reconstruction"] = energies.best_of_many(samples, truth)
        if self.method.multimodal:
            terms["multimodal"] = truth.new_zeros(len(truth))
            if "pseudo" in batch:
                others = self._rotate_futures(batch["pseudo"], batch)[:, :, -samples.shape[2] :]
                terms["multimodal"] = energies.multimodal_best_of_many(samples, others, batch["valid"])
        return terms

    def realism(self, samples: Tensor, truth: Tensor, frames: Tensor) -> dict[str, Tensor]:
        """Return the energies of limb lengths, angles and pose prior whose weight is not 0, (B,) each.

        Args:
            samples: (S, B, T, D), whose limb lengths are scored in all frames.
            truth: (B, T, D); the first of the frames with the most joints defines the true lengths.
            frames: (S, B, T, D), frames whose angles and poses are scored.
        """
        terms: dict[str, Tensor] = {}
        if self.method.limb:
            fullest = truth.isfinite().sum(-1).argmax(-1)
            reference = truth.take_along_dim(fullest[:, None, None], 1).squeeze(1)
            terms["limb"] = energies.limb_length(samples, reference, self.skeleton)
        if self.limits is not None:
            if self.angles is None or self.angles.low is not self.angle_low:  # only once, as the checks synchronise
                self.angles = AngleLimits(self.limits, self.angle_low, self.angle_high)
            terms["angles"] = energies.joint_angles(frames, self.angles, self.skeleton)
        if self.pose_prior is not None:
            offset = int(torch.randint(min(3, frames.shape[2]), ()))  # every third frame, randomly shifted at each step
            terms["pose_prior"] = energies.pose_prior_energy(frames[:, :, offset::3], self.pose_prior, self.skeleton)
        return terms

    def turned(self, x: Tensor) -> Tensor:
        """Return windows (..., T, D) rotated as the networks see them."""
        return x if self.heading is None else self.heading.face(x)

    def positions(self, values: Mapping[str, Tensor], data: Batch) -> Batch:
        """Return positions (..., B, T, D), rotated as the networks see them.

        Args:
            values: x, or all parts of x by name, in the representation of the model.
            data: batch as returned by `read`, with the bone lengths if the model reads directions of bones.
        """
        lengths = {LENGTHS: data[LENGTHS]} if self.bones else {}
        return self.view.inverse(Batch(values) | lengths)

    def _rotate_futures(self, others: Tensor, batch: Batch) -> Tensor:
        """Return other futures (B, M, T, D) of the windows of a batch, rotated like the windows."""
        if self.heading is None:
            return others
        return self.heading(Batch({WHOLE: others.transpose(0, 1)}), batch)[WHOLE].transpose(0, 1)

    def seen(self, x: Tensor, batch: Batch) -> Tensor:
        """Return x (B, T, D) as read from a batch, NaN where it was not observed."""
        mask = batch.mask(self.view.history or WHOLE)
        return x if mask is None else torch.where(mask, x, torch.nan)
