"""Motion Infilling: one motion from its first pose and what is known of joints' paths, by convolutions of an image.

    p(x_t | y_{1:T}, s)        no guide: nothing is latent, and the likelihood is exact

The first pose s and the given trajectories y are the columns of an image with a row for each coordinate, without unit
and 0 where nothing is known, which is also what the mean is. Convolutions and pooling halve it again and again,
transposed convolutions bring it back, without a short cut around them, and what comes out is the motion. Minimised is
the absolute error of all of it: x has Laplace's law, whose scale is one metre, and minus the log-density is that error
and a constant.

In training a gap in time hides the paths, or some joints lack theirs. A curriculum widens the gaps and takes more
joints.

Kaufmann, Aksan, Song, Pece, Ziegler and Hilliges, 2020, arXiv 2010.11531, with the layers, gaps and curriculum of its
public implementation, whose network for gaps of any width has 4,703,425 parameters. It is a baseline in TrajeVAE's
tables (arXiv 2104.00351). Ours: the frames of the paper are shares of a window, the curriculum rises evenly, each
window draws for itself whether it has a gap or lacks joints, joints are taken over the curriculum and not over all of
training, and all coordinates have one scale and their errors the weight of metres, where that divides each by a
deviation. Bodies move through space, as TrajeVAE's do. Off Human3.6M's skeleton maps are a quarter as many and windows
turned to one heading.
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
from ...data.sequences import bridged
from ...data.units import Units
from ...distributions import Family, LawSpec
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe
from ...inference.training.schedules import Ramp
from ...motion import Windows
from ...networks import Input, NetworkSpec
from ...networks.base import AtOnce
from ...networks.loop import once
from ...options import Share, Size
from ...program.batch import AnyBatch
from ..motion.poses import table
from ..motion.trajectories import FIRST, GIVEN, TrajectoryMethod, TrajectoryModel

PRESETS = table(
    "maps heading",
    {"human36m": ((32, 64, 128, 256, 256), False), "": ((8, 16, 32, 64, 64), True)},
)
"""Skeleton to options: the paper's; and for others what learns in minutes on a processor."""

HIDDEN = "hidden"
"""Name, in training batches, of how far the curriculum has come when an entry of y is hidden (B, T, D)."""
NARROWEST, SPREAD = 1 / 12, 1 / 6
"""Mean width of gaps at first, and its standard deviation, in widths of those at the end."""
IN_TIME, JOINTS = 0.7, 3
"""Share of windows that have a gap in time; how many joints others lack at most."""
NEVER = 2.0
"""Where no curriculum, which goes to 1, arrives."""


@dataclass(frozen=True)
class MotionInfilling(TrajectoryMethod):
    """See the file. Options that are None are chosen by the skeleton.

    Args:
        latent: there is none.
        maps: of the image at each size, from the whole one on.
        keep: probability with which a joint is given, in training, where no gap hides it.
        gap: mean width of the gaps in training, in the end, as a share of the window; 0 for neither gaps nor joints
            that are taken, as other methods are trained (with a `keep` below 1).
        curriculum: share of training over which gaps widen, after its first twentieth; 0 for wide ones all the time.
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
            raise ValueError("maps is empty; the image has at least one size")

    @override
    def sizes(self) -> dict[str, int]:
        """No latents."""
        return {}

    @override
    def networks(self) -> Mapping[str, NetworkSpec]:
        return {"p(x)": Infiller(self.maps or ())}

    @override
    def laws(self) -> Mapping[str, LawSpec]:
        """x has Laplace's law, minus whose log-density is the absolute error."""
        return {"p(x)": Family("Laplace", {"scale": 1.0}, project=False, error_weight=True)}

    @override
    def kind(self) -> type[TrajectoryModel]:
        return InfillingModel

    @override
    def train(self, train: Windows, validation: Windows | None = None, steps: int = 2000) -> Recipe:
        """Minimises the absolute error, with gaps that widen; validation windows have gaps of the last width."""
        recipe = replace(super().train(train, validation, steps), prepare=partial(start, train=train))
        if not self.gap:
            return recipe
        begin = steps // 20
        rise = Ramp(0.0, 1.0, steps=max(min(int(self.curriculum * steps), steps - begin), 1), delay=begin)
        return replace(
            recipe,
            batches=Gaps(recipe.batches, self.gap),
            validation=recipe.validation and Gaps(recipe.validation, self.gap),
            stages=[Stage(steps, curriculum=rise if self.curriculum else None)],
        )


def start(model: InfillingModel, train: Windows) -> None:
    """Gives the network mean and spread of 1024 windows, as the model sees them."""
    seen = model.read(train.sample(1024, torch.default_generator))
    model.generator[WHOLE].network.units.fit(bridged(seen[WHOLE], seen.mask()))


@dataclass(frozen=True, eq=False)
class Gaps:
    """Windows with given trajectories, of which a curriculum hides some: a gap in time, or those of some joints.

    Batches say how far it must have come for an entry to be hidden, so that what is hidden stays so. A gap of width w
    in a window of length 1, drawn with its place u, is from u (1 - w) to u + (1 - u) w, which moves over all the window
    as u does, and grows to both sides as w does.

    Args:
        source: of the windows.
        width: mean width of gaps at the end, as a share of the window.
    """

    source: Any
    width: float

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Windows with what is hidden of them."""
        return self._hiding(self.source.sample(batch_size, generator), generator)

    def all(self) -> Batch:
        """All windows, with the same gaps every time."""
        return self._hiding(self.source.all(), torch.Generator().manual_seed(0))

    @property
    def fingerprint(self) -> str:
        """That of the source."""
        found: str = self.source.fingerprint
        return found

    def _hiding(self, batch: Mapping[str, Any], generator: torch.Generator) -> Batch:
        count, length, _ = batch[GIVEN].shape
        kind, place = torch.rand(2, count, 1, generator=generator).clamp(min=1e-6)
        noise = torch.randn(count, 1, generator=generator)
        frames = (torch.arange(length) + 0.5) / length
        needed = torch.maximum(1 - frames / place, (frames - place) / (1 - place))  # width of the gap that has a frame
        first = self.width * (NARROWEST + SPREAD * noise)
        in_time = (needed - first) / (self.width * (1 - NARROWEST))
        order = torch.rand(count, len(self.source.joints), generator=generator)
        order[:, self.source.skeleton.root] = 1.0  # the last one
        rank = order.argsort(1).argsort(1)
        of_joints = torch.where(rank < JOINTS, rank / JOINTS, NEVER).repeat_interleave(3, 1)
        return Batch(batch) | {HIDDEN: torch.where((kind < IN_TIME)[..., None], in_time[..., None], of_joints[:, None])}


class InfillingModel(TrajectoryModel):
    """A model of one motion given its first pose and some trajectories, of which batches may say what is hidden."""

    @property
    @override
    def gradual(self) -> bool:
        """What is hidden comes by a curriculum."""
        return True

    @override
    def read(self, batch: AnyBatch | None, *, size: int = 1, curriculum: float = 1.0, precise: bool = False) -> Batch:
        """Without the trajectories that are hidden when the curriculum has come so far."""
        if isinstance(batch, Mapping) and HIDDEN in batch:
            whole = batch

            def shown() -> Batch:
                given = torch.where(whole[HIDDEN] <= curriculum, 0.0, whole[GIVEN])
                return Batch({name: value for name, value in whole.items() if name != HIDDEN}) | {GIVEN: given}

            batch = once(self, [whole, curriculum], shown)  # by guide and model both
        return super().read(batch, size=size, curriculum=curriculum, precise=precise)


@dataclass(frozen=True)
class Infiller:
    """A sequence (B, T, D) of its first step s and of y, 0 where it is not known, by convolutions over both axes.

    The image of all frames, at each of its sizes, goes through two convolutions of 3 x 3 with leaky ReLU; pooling then
    halves it, rounded up, in rows no further than to two. So there are no lengths that it could not take.

    Args:
        maps: at each size, from the whole one on.
    """

    maps: tuple[int, ...]

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> InfillerNetwork:
        """The network of a factor with these parents."""
        return InfillerNetwork(self, inputs, size)


class InfillerNetwork(AtOnce):
    """What `Infiller` describes."""

    def __init__(self, spec: Infiller, inputs: Sequence[Input], size: int):
        super().__init__(inputs, True, size)
        self.units = Units(size)
        self.down: Any = nn.ModuleList()
        self.up: Any = nn.ModuleList()
        self.pools: list[tuple[int, int]] = []
        rows = size
        for before, maps in pairwise((1, *spec.maps)):
            pool = (2 if rows > 2 else 1, 2)
            self.pools.append(pool)
            self.down.append(nn.Sequential(*_convolved(before, maps), *_convolved(maps, maps)))
            wider = nn.ConvTranspose2d(maps, maps, 3, pool, padding=1)
            self.up.append(nn.ModuleList([wider, nn.Conv2d(maps, before, 3, padding=1)]))
            rows = -(-rows // pool[0])
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.xavier_uniform_(layer.weight)
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        """No sequence is padded."""
        self.refuse_ragged(lengths)
        poses = torch.cat([parents[FIRST][:, None], parents[GIVEN]], 1)
        image = torch.where(poses == 0, 0.0, self.units(poses)).mT[:, None]
        shapes = []
        for layers, pool in zip(self.down, self.pools, strict=True):
            image = layers(image)
            shapes.append(image.shape[-2:])
            image = functional.max_pool2d(image, pool, ceil_mode=True)
        for place, (wider, last) in reversed(list(enumerate(self.up))):
            image = last(functional.leaky_relu(wider(image, output_size=shapes[place])))
            image = functional.leaky_relu(image) if place else image
        return torch.addcmul(self.units.mean, image[:, 0, :, 1:].mT, self.units.scale)


def _convolved(before: int, maps: int) -> list[nn.Module]:
    return [nn.Conv2d(before, maps, 3, padding=1), nn.LeakyReLU()]
