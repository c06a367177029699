"""The pose prior of GSPS: a density of single poses, represented by the directions of their limbs.

    p(d_t),        d_t = the unit vectors along all limbs, from parent to child

It has no latents and no dynamics: each frame is an independent pose, and the density of the flow is exact, so the bound
equals the log evidence. Other models are trained with it: poses that it finds unlikely cost energy
(`energies.pose_prior_energy`).

Mao, Liu and Salzmann, 2021, arXiv 2108.08422, with the flow of its public code (`dvae.distributions.flow`). Our
changes:

* Training poses get noise of 2 mm. Where a body part is rigid, such as the hips, the directions of its limbs hardly
  vary, and the density grows without bound as the flow concentrates on them. In bandai2, eight of sixty dimensions vary
  only by the rounding of the file, 0.1 mm. Without noise, errors of 1 mm raise the energy of a test pose from 117 to
  4300 nats. With noise, they raise it from 90 to 92 nats; errors of 2 cm raise it to 2300 nats, and lower legs bent the
  wrong way to 1000 nats.
* The flow receives whitened directions, which affects the speed of learning but not the model class. Energies of
  training (test) poses of bandai2, in nats, are 80.7 (67.1) after 1000 steps, and 73.7 (62.0) from raw directions as in
  the paper. A normal distribution with full covariance has 76.0 (63.8), which the raw flow approaches in 8000 steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from math import pi
from pathlib import Path
from typing import Annotated, Any, ClassVar

import pyro
import torch
from torch import Tensor, nn

from ...data.batch import Batch
from ...data.sequences import interpolate_missing
from ...distributions import QRFlow, Shape
from ...inference.training.checkpoints import Run, load_weights
from ...inference.training.fit import fit
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe, Trainable
from ...inference.training.trackers import Bar
from ...locking import seeded
from ...options import Layers, Range
from ..data.protocols import Poses, Windows
from ..geometry.skeleton import HUMAN36M, HUMANEVA, Skeleton, rotate_about_up
from ..geometry.views import Heading


@dataclass(frozen=True)
class PosePrior(Trainable):
    """The pose prior of GSPS: a density of single poses.

    Args:
        layers: number of layers of the flow.
        noise: standard deviation in metres of the noise added to each coordinate of training poses; 0 in the paper.
        turned: rotate every training window about the up axis by a uniform angle, for a prior that ignores headings.
            Not needed if the heading of the windows is fixed.
        heading: rotate every window about the up axis so that its last observed frame has heading zero, for a prior
            that trains models of windows rotated in this way.
        whiten: standardise directions by their mean and covariance over training poses; the paper does not, and needs a
            learning rate of .01.
    """

    name: ClassVar[str] = "pose-prior"
    source: ClassVar[str] = "Mao, Liu and Salzmann, 2021, arXiv 2108.08422"
    trainings: ClassVar[Mapping[str, Training]] = {
        HUMAN36M.name: Training(1225, 33, 0.01, 0.8, weight_decay=1e-3),  # 33 windows of 125 frames are 4,125 poses
        HUMANEVA.name: Training(1225, 55, 0.01, 0.8, weight_decay=1e-3),
        "": Training(1000, 32, 0.01, 0.8),
    }

    layers: Layers = 3
    noise: Annotated[float, Range(0, 1, below=True)] = 0.002
    turned: bool = False
    heading: bool = False
    whiten: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.turned and self.heading:
            raise ValueError("`heading` fixes the direction that `turned` draws at random; set only one")

    def build(self, data: Any) -> PosePriorModel:
        """Return the model for poses of the data's skeleton."""
        schema = Poses.of(data, "a pose prior")
        return PosePriorModel(schema.skeleton, self.layers, schema.protocol.observed - 1 if self.heading else None)

    def train(self, train: Windows, validation: Windows | None = None, steps: int = 1000) -> Recipe:
        """Return the recipe: minimise the negative log density, in nats per pose, of rotated and noisy poses."""
        varied = VariedPoses(train, self.noise, self.turned)
        return Recipe(varied, validation, [Stage(steps)], prepare=partial(self._whiten, poses=varied))

    def _whiten(self, model: PosePriorModel, poses: VariedPoses) -> None:
        """Set the mean and covariance of the flow's whitening from the poses of 1024 windows."""
        if self.whiten:
            x = poses.sample(1024, torch.default_generator)["x"]
            model.flow.whiten(model.skeleton.directions(model.facing(x).double()))


@dataclass(frozen=True)
class VariedPoses:
    """Training windows with augmented poses.

    Args:
        windows: windows to draw from.
        noise: same as in `PosePrior`.
        turned: same as in `PosePrior`.
    """

    windows: Windows
    noise: float
    turned: bool

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the windows."""
        return self.windows.fingerprint

    def sample(self, batch_size: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw windows, rotated and with noise: {"x": (B, T, D)}; missing values are interpolated."""
        batch = self.windows.sample(batch_size, generator)
        x = interpolate_missing(batch["x"], batch.mask())
        if self.turned:
            angle = 2 * pi * torch.rand(len(x), 1, 1, generator=generator)
            x = rotate_about_up(x.unflatten(-1, (-1, 3)), angle, self.windows.skeleton.up).flatten(-2)
        if self.noise:
            x = x + self.noise * torch.randn(x.shape, generator=generator)
        return {"x": x}


class PosePriorModel(nn.Module):
    """The density of poses.

    Args:
        skeleton: skeleton with J joints.
        layers: number of layers of the flow.
        forward_at: frame whose heading is rotated to zero in each window; None leaves windows unchanged.
    """

    likelihood, per = True, "frame"  # required by `dvae.program.protocols.Program`

    def __init__(self, skeleton: Skeleton, layers: int = 3, forward_at: int | None = None):
        super().__init__()
        self.skeleton, self.forward_at = skeleton, forward_at
        self.flow = QRFlow(layers).build(Shape(3 * (skeleton.joints - 1), local=False))

    def model(self, batch: Batch, **_: Any) -> dict[str, Tensor]:
        """Pyro program: one site d, batch (B, T), event (3 (J - 1),), observed at the directions of the poses.

        Args:
            batch: batch with x (B, T, D), D as in `Skeleton.limbs`.

        Raises:
            ValueError: the batch has padded sequences or missing values.
        """
        if extra := {"lengths", "mask"} & batch.keys():
            raise ValueError(f"a pose prior reads whole poses in every frame; remove {' and '.join(sorted(extra))}")
        d = self.skeleton.directions(self.facing(batch["x"]))
        with pyro.plate("sequences", d.shape[0], dim=-2), pyro.plate("frames", d.shape[1], dim=-1):
            return {"d": pyro.sample("d", self.flow.prior(), obs=d)}

    def guide(self, batch: Batch, **_: Any) -> dict[str, Tensor]:
        """Return no latents: the model has none."""
        return {}

    def forward(self, inputs: Batch | Tensor, **options: Any) -> Any:
        """Run the program on a batch; or map directions (..., 3 (J - 1)) to noise, as `QRFlowModule.to_noise`."""
        return self.model(inputs, **options) if isinstance(inputs, Mapping) else self.flow.to_noise(inputs)

    def facing(self, x: Tensor) -> Tensor:
        """Return windows (..., T, D), rotated so that frame `forward_at` has heading zero if it is set."""
        return x if self.forward_at is None else Heading(self.skeleton, self.forward_at + 1).face(x)

    def log_prob(self, poses: Tensor) -> Tensor:
        """Return the log density (...) of the limb directions of poses (..., D), in nats.

        Raises:
            ValueError: the poses have another skeleton.
        """
        return self.flow.prior().log_prob(self.skeleton.directions(poses))

    @torch.no_grad()
    def sample(self, count: int) -> Tensor:
        """Draw limb directions (count, 3 (J - 1)); lengths vary around 1, because the density is over all vectors."""
        return self.flow.prior().sample((count,))


def fit_pose_prior(
    windows: Windows, steps: int = 1000, seed: int = 0, progress: bool = True, **options: Any
) -> PosePriorModel:
    """Fit a pose prior on the CPU, without log output, in about fifteen seconds.

    Args:
        windows: training windows.
        steps: optimiser steps.
        seed: seed of the fit; the global random state is restored.
        progress: show a progress bar.
        **options: options of `PosePrior`.

    Returns:
        The model in evaluation mode, with its last weights.
    """
    method = PosePrior(**options)
    with seeded(seed):
        model = method.build(windows)
        fit(
            model,
            method.train(windows, steps=steps),
            seed=seed,
            learning_rate=1e-2,
            decay=0.8,
            weight_decay=1e-3,
            accelerator="cpu",
            progress=False,
            trackers=[Bar("pose prior", steps, progress)],
        )
    return model


def load_pose_prior(path: str | Path, skeleton: Skeleton, heading: bool) -> PosePriorModel:
    """Load the pose prior of a run, for a model of poses.

    Args:
        path: run directory of a pose prior.
        skeleton: skeleton of the poses.
        heading: whether the model sees windows rotated to heading zero.

    Raises:
        ValueError: the run is not a pose prior, or has another skeleton or other options.
        CheckpointError: the weights are damaged, or have another number of joints.
    """
    config = Run(path).config
    try:
        options = config["method"]
        parents = config["schema"]["skeleton"]["parents"]
        fits = options["method"] == PosePrior.name and tuple(parents) == skeleton.parents
        recorded_options = options["heading"], options["layers"]
    except (KeyError, TypeError):
        fits = False
    if not fits:
        raise ValueError(f"{path} does not contain a pose prior of the skeleton {skeleton.name!r}")
    if recorded_options != (heading, PosePrior.layers):
        raise ValueError(
            f"{path} was fitted with heading={options['heading']} and layers={options['layers']}, but this model needs "
            f"a prior with heading={heading} and layers={PosePrior.layers}; fit one with these options"
        )
    model = PosePriorModel(skeleton)
    load_weights(model, path)
    return model
