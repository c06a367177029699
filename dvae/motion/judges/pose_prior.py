"""The pose prior of GSPS: a density of single poses, as the directions of their limbs.

    p(d_t),        d_t = the unit vectors along all limbs, from parent to child

It has no latents and no time: every frame is a pose of its own, and the flow's density is exact, so that the bound is
the log evidence. Others are trained with it: poses that it finds unlikely cost energy (`energies.pose_prior_energy`).

Mao, Liu and Salzmann, 2021, arXiv 2108.08422, with the flow of its public code (see `dvae.distributions.flow`). Ours:

* Training poses get noise of 2 mm. Where a body part is rigid, as the hips are, its limbs' directions hardly vary, and
  the density rises without bound as a flow narrows down on them. In bandai2 eight of sixty dimensions have no more than
  the rounding of the file, 0.1 mm. Fitted without noise, errors of 1 mm raise the energy of a test pose from 117 nats
  to 4300; with it, from 90 to 92, errors of 2 cm to 2300, and lower legs bent the wrong way to 1000.
* The flow reads whitened directions, which changes what it learns first and not what it can learn. In nats a training
  (test) pose of bandai2 it is at 80.7 (67.1) after 1000 steps, and at 73.7 (62.0) from raw directions as in the paper;
  a normal with full covariance has 76.0 (63.8), and the raw flow comes near to it in 8000 steps.
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
from ...data.sequences import bridged
from ...distributions import QRFlow, Shape
from ...inference.training.checkpoints import Run, load_weights
from ...inference.training.fit import fit
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe, Trainable
from ...inference.training.trackers import Bar
from ...options import Layers, Range
from ...turns import seeded
from ..data.protocols import Poses, Windows
from ..geometry.skeleton import HUMAN36M, HUMANEVA, Skeleton, rotate_about_up
from ..geometry.views import Heading


@dataclass(frozen=True)
class PosePrior(Trainable):
    """See the file.

    Args:
        layers: of the flow.
        noise: standard deviation in metres of the noise that training poses get at each coordinate; the paper has none.
        turned: turn every training window about the up axis by a uniform angle, for a prior that does not mind
            which way people face. Where the windows' heading is fixed there is no need.
        heading: turn every window about the up axis so that its last observed frame has heading zero; a prior for
            models that see their windows so.
        whiten: standardise directions with their mean and covariance over training poses before the flow reads them;
            the paper does not, and needs a learning rate of .01.
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
            raise ValueError("heading fixes the direction that turned would draw; choose one")

    def build(self, data: Any) -> PosePriorModel:
        """The model for poses of the data's skeleton."""
        schema = Poses.of(data, "a pose prior")
        return PosePriorModel(schema.skeleton, self.layers, schema.protocol.observed - 1 if self.heading else None)

    def train(self, train: Windows, validation: Windows | None = None, steps: int = 1000) -> Recipe:
        """Minimises minus the log density, in nats per pose, of poses that are turned and have noise."""
        varied = VariedPoses(train, self.noise, self.turned)
        return Recipe(varied, validation, [Stage(steps)], prepare=partial(self._whiten, poses=varied))

    def _whiten(self, model: PosePriorModel, poses: VariedPoses) -> None:
        """Has the flow take mean and covariance of the directions from the poses of 1024 windows."""
        if self.whiten:
            x = poses.sample(1024, torch.default_generator)["x"]
            model.flow.whiten(model.skeleton.directions(model.facing(x).double()))


@dataclass(frozen=True)
class VariedPoses:
    """Training windows whose poses are varied.

    Args:
        windows: to draw from.
        noise: see `PosePrior`.
        turned: see `PosePrior`.
    """

    windows: Windows
    noise: float
    turned: bool

    @property
    def fingerprint(self) -> str:
        """That of the windows."""
        return self.windows.fingerprint

    def sample(self, batch_size: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draws windows as `Windows.sample` does, turned and with noise: {"x": (B, T, D)}, gaps bridged."""
        drawn = self.windows.sample(batch_size, generator)
        x = bridged(drawn["x"], drawn.mask())
        if self.turned:
            angle = 2 * pi * torch.rand(len(x), 1, 1, generator=generator)
            x = rotate_about_up(x.unflatten(-1, (-1, 3)), angle, self.windows.skeleton.up).flatten(-2)
        if self.noise:
            x = x + self.noise * torch.randn(x.shape, generator=generator)
        return {"x": x}


class PosePriorModel(nn.Module):
    """The density of poses.

    Args:
        skeleton: of J joints.
        layers: of the flow.
        forward_at: frame of heading zero in windows, which are turned so; None to take them as they are.
    """

    likelihood, per = True, "frame"  # see `dvae.program.protocols.Program`

    def __init__(self, skeleton: Skeleton, layers: int = 3, forward_at: int | None = None):
        super().__init__()
        self.skeleton, self.forward_at = skeleton, forward_at
        self.flow = QRFlow(layers).build(Shape(3 * (skeleton.joints - 1), local=False))

    def model(self, batch: Batch, **_: Any) -> dict[str, Tensor]:
        """The Pyro program: one site d, batch (B, T), event (3 (J - 1),), observed at the poses' directions.

        Args:
            batch: holds x (B, T, D), D as in `Skeleton.limbs`.

        Raises:
            ValueError: padded sequences or missing entries, of which there are none in windows of motion.
        """
        if extra := {"lengths", "mask"} & batch.keys():
            raise ValueError(f"a pose prior reads whole poses in every frame; leave {' and '.join(sorted(extra))} out")
        d = self.skeleton.directions(self.facing(batch["x"]))
        with pyro.plate("sequences", d.shape[0], dim=-2), pyro.plate("frames", d.shape[1], dim=-1):
            return {"d": pyro.sample("d", self.flow.prior(), obs=d)}

    def guide(self, batch: Batch, **_: Any) -> dict[str, Tensor]:
        """Nothing is latent."""
        return {}

    def forward(self, given: Batch | Tensor, **options: Any) -> Any:
        """On a batch, the program, which bounds take; on directions (..., 3 (J - 1)), see `QRFlowLaw.to_noise`."""
        return self.model(given, **options) if isinstance(given, Mapping) else self.flow.to_noise(given)

    def facing(self, x: Tensor) -> Tensor:
        """Windows (..., T, D) as the density reads them."""
        return x if self.forward_at is None else Heading(self.skeleton, self.forward_at + 1).face(x)

    def log_prob(self, poses: Tensor) -> Tensor:
        """Log density (...) of the limb directions of poses (..., D), in nats.

        Raises:
            ValueError: poses of another skeleton.
        """
        return self.flow.prior().log_prob(self.skeleton.directions(poses))

    @torch.no_grad()
    def sample(self, count: int) -> Tensor:
        """Draws limb directions (count, 3 (J - 1)). The density is over all vectors, so their lengths vary about 1."""
        return self.flow.prior().sample((count,))


def fit_pose_prior(
    windows: Windows, steps: int = 1000, seed: int = 0, progress: bool = True, **options: Any
) -> PosePriorModel:
    """Fits a pose prior quietly, on the CPU, in about fifteen seconds.

    Args:
        windows: training windows.
        steps: optimiser steps.
        seed: of the fit; the caller's random state is left as it was.
        progress: show a bar.
        **options: of `PosePrior`.

    Returns:
        The model, in evaluation mode, with its last weights.
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
    """The pose prior of a run, for a model of such poses.

    Args:
        path: the run directory of a pose prior.
        skeleton: of the poses.
        heading: whether the model sees windows turned to one heading.

    Raises:
        ValueError: a run of something else, of another skeleton, or of other options.
        CheckpointError: damaged weights, or of another number of joints.
    """
    config = Run(path).config
    try:
        options = config["method"]
        parents = config["schema"]["skeleton"]["parents"]
        fits = options["method"] == PosePrior.name and tuple(parents) == skeleton.parents
        given = options["heading"], options["layers"]
    except (KeyError, TypeError):
        fits = False
    if not fits:
        raise ValueError(f"{path} holds no pose prior of the skeleton {skeleton.name!r}")
    if given != (heading, PosePrior.layers):
        raise ValueError(
            f"{path} was fitted with heading={options['heading']} and layers={options['layers']}, but this model sees "
            f"poses with heading={heading}, and takes a prior of {PosePrior.layers} layers"
        )
    model = PosePriorModel(skeleton)
    load_weights(model, path)
    return model
