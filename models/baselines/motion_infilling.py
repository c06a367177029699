"""Motion Infilling: complete a motion from its first pose and parts of its joints' paths, by 2D convolutions.

    p(x_t | y_{1:T}, s)        no guide: there are no latents, and the likelihood is exact

The first pose s and the given trajectories y are the columns of an image with a row for each coordinate. Values are
standardised, and unknown values are 0, which is also the mean. Convolutions and pooling halve the image repeatedly, and
transposed convolutions restore its size, without skip connections. The output is the motion. Training minimises its
absolute error: x has a Laplace distribution with a scale of one metre, whose negative log-density is this error plus a
constant.

In training, either a gap in time hides the paths, or some joints have no path. A curriculum widens the gaps and removes
more joints.

Kaufmann, Aksan, Song, Pece, Ziegler and Hilliges, 2020, arXiv 2010.11531, with the layers, gaps and curriculum of its
public implementation, whose network for gaps of any width has 4,703,425 parameters. It is a baseline in TrajeVAE's
tables (arXiv 2104.00351). Our differences:

* Widths of gaps are shares of a window; the paper gives them in frames.
* The curriculum rises linearly.
* Each window draws independently whether it has a gap or removed joints.
* Joints are removed over the curriculum, not over all of training.
* All coordinates have one scale, and errors are in metres; the paper divides each by its deviation.
* Bodies move through space, as in TrajeVAE.
* For other skeletons than Human3.6M's, there are a quarter as many maps, and windows are rotated to one heading.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional
from typing_extensions import override

from ...data.batch import WHOLE, Batch
from ...data.sequences import interpolate_missing
from ...data.units import Units
from ...distributions import DistributionSpec, Family
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe
from ...inference.training.schedules import Ramp
from ...motion import Windows
from ...networks import Input, NetworkSpec
from ...networks.base import FixedLengthNetwork
from ...networks.loop import memoize
from ...options import Share, Size
from ...program.batch import AnyBatch
from ..motion.poses import table
from ..motion.trajectories import FIRST, GIVEN, TrajectoryMethod, TrajectoryModel

PRESETS = table(
    "maps heading",
    {"human36m": ((32, 64, 128, 256, 256), False), "": ((8, 16, 32, 64, 64), True)},
)
"""Options by skeleton: the paper's values; for other skeletons, values that train in minutes on a CPU."""

HIDDEN = "hidden"
"""Key in training batches: the value of the curriculum from which an entry of y is hidden, (B, T, D)."""
NARROWEST, SPREAD = 1 / 12, 1 / 6
"""Initial mean width of gaps and its standard deviation, relative to the final mean width."""
IN_TIME, JOINTS = 0.7, 3
"""Share of windows with a gap in time, and the largest number of joints removed from each other window."""
NEVER = 2.0
"""Value that no curriculum reaches, because curricula end at 1."""


@dataclass(frozen=True)
class MotionInfilling(TrajectoryMethod):
    """Motion infilling by convolutions. Options that are None are chosen for the skeleton.

    Args:
        latent: always None; the method has no latents.
        maps: numbers of feature maps at each image size, starting with the full size.
        keep: probability in training that a joint of a window is given, before gaps and removed joints.
        gap: final mean width of the gaps in training, as a share of the window. With 0 there are neither gaps nor
            removed joints; set `keep` below 1 to hide joints as in other methods.
        curriculum: share of training over which gaps widen, after its first twentieth; 0 for wide gaps from the start.
    """

    name = "motion-infilling"
    source = "Kaufmann, Aksan, Song, Pece, Ziegler and Hilliges, 2020, arXiv 2010.11531"
    generative = "p(x_t | y_{1:T}, s)"
    inference = ""

    presets = PRESETS
    trainings: ClassVar[Mapping[str, Training]] = {"": Training(batch_size=80, decay=0.5)}

    latent: None = None
    maps: tuple[Size, ...] | None = None
    keep: Share = 1.0
    gap: Share = 0.5
    curriculum: Share = 0.275

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.maps == ():
            raise ValueError("maps is empty; give the number of maps for at least one image size")

    @override
    def sizes(self) -> dict[str, int]:
        """Return no sizes: the method has no latents."""
        return {}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        return {"p(x)": Infiller(self.maps or ())}

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        """Return a Laplace distribution of x, whose negative log-density is the absolute error."""
        return {"p(x)": Family("Laplace", {"scale": 1.0}, project=False, error_weight=True)}

    @override
    def kind(self) -> type[TrajectoryModel]:
        return InfillingModel

    @override
    def train(self, train: Windows, validation: Windows | None = None, steps: int = 2000) -> Recipe:
        """Return one stage on the absolute error with widening gaps; validation windows have the final width."""
        recipe = replace(super().train(train, validation, steps), prepare=partial(start, train=train))
        if not self.gap:
            return recipe
        begin = steps // 20
        rise = Ramp(0.0, 1.0, steps=max(min(int(self.curriculum * steps), steps - begin), 1), delay=begin)
        return replace(
            recipe,
            batches=RandomGaps(recipe.batches, self.gap),
            validation=recipe.validation and RandomGaps(recipe.validation, self.gap),
            stages=[Stage(steps, curriculum=rise if self.curriculum else None)],
        )


def start(model: InfillingModel, train: Windows) -> None:
    """Set the mean and scale of a model's network from 1024 training windows, in the model's view."""
    data = model.read(train.sample(1024, torch.default_generator))
    model.generator[WHOLE].network.units.fit(interpolate_missing(data[WHOLE], data.mask()))


@dataclass(frozen=True, eq=False)
class RandomGaps:
    """Windows with given trajectories, where a curriculum hides a gap in time or the paths of some joints.

    Batches contain a threshold for each entry. The entry is hidden if the curriculum is at least at this threshold, so
    hidden entries remain hidden as the curriculum rises.

    A gap of width w and position u, in a window of length 1, extends from u (1 - w) to u + (1 - u) w. Gaps at different
    u together cover the whole window. With increasing w, a gap grows to both sides.

    Args:
        source: source of the windows.
        width: final mean width of gaps, as a share of the window.
    """

    source: Any
    width: float

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Return random windows with their hidden entries."""
        return self._hide_entries(self.source.sample(batch_size, generator), generator)

    def all(self) -> Batch:
        """Return all windows, with the same gaps every time."""
        return self._hide_entries(self.source.all(), torch.Generator().manual_seed(0))

    @property
    def fingerprint(self) -> str:
        """The fingerprint of the source."""
        fingerprint: str = self.source.fingerprint
        return fingerprint

    def _hide_entries(self, batch: Mapping[str, Any], generator: torch.Generator) -> Batch:
        count, length, _ = batch[GIVEN].shape
        kind, position = torch.rand(2, count, 1, generator=generator).clamp(min=1e-6)
        noise = torch.randn(count, 1, generator=generator)
        frames = (torch.arange(length) + 0.5) / length
        widths = torch.maximum(
            1 - frames / position, (frames - position) / (1 - position)
        )  # gap width that hides the frame
        initial_width = self.width * (NARROWEST + SPREAD * noise)
        gap_values = (widths - initial_width) / (self.width * (1 - NARROWEST))
        order = torch.rand(count, len(self.source.joints), generator=generator)
        order[:, self.source.skeleton.root] = 1.0  # the last one
        rank = order.argsort(1).argsort(1)
        joint_values = torch.where(rank < JOINTS, rank / JOINTS, NEVER).repeat_interleave(3, 1)
        return Batch(batch) | {
            HIDDEN: torch.where((kind < IN_TIME)[..., None], gap_values[..., None], joint_values[:, None])
        }


class InfillingModel(TrajectoryModel):
    """A model that completes a motion from its first pose and some trajectories; batches may hide parts of them."""

    @property
    @override
    def has_curriculum(self) -> bool:
        """True: a curriculum hides entries."""
        return True

    @override
    def read(self, batch: AnyBatch | None, *, size: int = 1, curriculum: float = 1.0, precise: bool = False) -> Batch:
        """Return the batch without the trajectories that are hidden at this value of the curriculum."""
        if isinstance(batch, Mapping) and HIDDEN in batch:
            full_batch = batch

            def hide() -> Batch:
                trajectories = torch.where(full_batch[HIDDEN] <= curriculum, 0.0, full_batch[GIVEN])
                return Batch({name: value for name, value in full_batch.items() if name != HIDDEN}) | {
                    GIVEN: trajectories
                }

            batch = memoize(self, [full_batch, curriculum], hide)  # guide and model both call it
        return super().read(batch, size=size, curriculum=curriculum, precise=precise)


@dataclass(frozen=True)
class Infiller:
    """Network that completes a sequence (B, T, D) by convolutions over time and coordinates.

    It reads the first step s and the given trajectories y, which are 0 where unknown.

    At each size, the image of all frames passes through two 3 x 3 convolutions with leaky ReLU. Pooling then halves it,
    rounding up, with at least two rows left. Any length is therefore possible.

    Args:
        maps: numbers of feature maps at each image size, starting with the full size.
    """

    maps: tuple[int, ...]

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> InfillerNetwork:
        """Return the network for a child of dimension `size`, local or static, with the parents `inputs`."""
        return InfillerNetwork(self, inputs, size)


class InfillerNetwork(FixedLengthNetwork):
    """Network of `Infiller`."""

    def __init__(self, spec: Infiller, inputs: Sequence[Input], size: int):
        super().__init__(inputs, True, size)
        self.units = Units(size)
        self.down: Any = nn.ModuleList()
        self.up: Any = nn.ModuleList()
        self.pools: list[tuple[int, int]] = []
        rows = size
        for in_maps, maps in pairwise((1, *spec.maps)):
            pool = (2 if rows > 2 else 1, 2)
            self.pools.append(pool)
            self.down.append(nn.Sequential(*_convolution(in_maps, maps), *_convolution(maps, maps)))
            upsample = nn.ConvTranspose2d(maps, maps, 3, pool, padding=1)
            self.up.append(nn.ModuleList([upsample, nn.Conv2d(maps, in_maps, 3, padding=1)]))
            rows = -(-rows // pool[0])
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.xavier_uniform_(layer.weight)
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        """Return the features; sequences must not be padded."""
        self.refuse_ragged(lengths)
        poses = torch.cat([parents[FIRST][:, None], parents[GIVEN]], 1)
        image = torch.where(poses == 0, 0.0, self.units(poses)).mT[:, None]
        shapes = []
        for layers, pool in zip(self.down, self.pools, strict=True):
            image = layers(image)
            shapes.append(image.shape[-2:])
            image = functional.max_pool2d(image, pool, ceil_mode=True)
        for level, (upsample, convolution) in reversed(list(enumerate(self.up))):
            image = convolution(functional.leaky_relu(upsample(image, output_size=shapes[level])))
            image = functional.leaky_relu(image) if level else image
        return torch.addcmul(self.units.mean, image[:, 0, :, 1:].mT, self.units.scale)


def _convolution(in_maps: int, maps: int) -> list[nn.Module]:
    return [nn.Conv2d(in_maps, maps, 3, padding=1), nn.LeakyReLU()]
