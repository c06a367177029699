"""GSPS: diverse futures of a moving body, part after part, each a function of its own latent and of the parts before.

With the parts lower and upper, and h the motion observed up to frame O,

    p(a) p(b) p(lower_t | h_{1:O}, a) p(upper_t | h_{1:O}, lower_{1:T}, b)        q(a) q(b)

Every part is a point mass: a trajectory that a residual graph convolutional network makes, all steps at once, as its
first cosine coefficients. There is no inference network. The guide is the prior, so that every divergence is exactly
zero and what is minimised is the expected energy of futures that are drawn together for each window: several draws of
a, and for each of them several of b. The energies say that the best of these futures is near the true one and that the
best is near each pseudo ground truth, that the futures of a part differ, that they begin like the past, keep the limbs'
lengths, stay within the joints' angles, and look like poses to a prior.

A fixed latent, or a fixed motion of the first parts, leaves those parts as they are while the others vary.

Mao, Liu and Salzmann, 2021, arXiv 2108.08422, with the layers, weights and normalisations of its public code. Ours: the
generator may see every window turned so that the last observed pose faces one way, which the presets for small sets do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from math import prod
from operator import mul
from string import ascii_lowercase
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from ...data.batch import WHOLE, Batch
from ...data.sequences import bridged
from ...data.views import History, Parts
from ...distributions import Delta, Directions
from ...factorization.notation import Factorization
from ...inference.training.objectives import Evidence, Objective
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe
from ...motion import Skeleton, Windows
from ...motion.geometry.parts import body_parts
from ...motion.scoring import energies
from ...networks import GraphConv
from ...options import Amount, Layers, Size
from ...program.batch import AnyBatch
from ...program.rollout import Rollout
from .energies import EnergyMethod, EnergyModel
from .poses import table, without_gaps

PRESETS = table(
    "coefficients width draws diversity diversity_scale pseudo_minimum pool_stride heading",
    {
        "human36m": (10, 256, (10, 10), (8.0, 25.0), (100.0, 300.0), 0.1, 20, False),
        "humaneva": (8, 256, (10, 10), (5.0, 10.0), (15.0, 50.0), 0.01, 15, False),
        "": (8, 128, (4, 4), (5.0, 10.0), (15.0, 50.0), 0.01, 10, True),
    },
)
"""Skeleton to options: the paper's; and for others, at 30 frames a second, 15 observed and 60 predicted frames."""


@dataclass(frozen=True)
class GSPS(EnergyMethod):
    """See the file. Options that are None are the paper's for Human3.6M and HumanEva-I, and smaller ones for others.

    What is given once for each part may be given as one number for all.

    Args:
        latent: size of each part's latent.
        parts: parts of the body in the order in which they are made: "lower" and "upper", or some of "torso",
            "right_leg", "left_leg", "left_arm", "right_arm"; or new ones, such as "legs=right_leg+left_leg" or
            "head=Neck+Head".
        coefficients: of the cosine transform, of the whole window.
        width: features of a joint in the networks.
        blocks: residual blocks in each.
        draws: of each part's latent, in training, for each draw of the parts before.
        history: weight of the squared error in the observed frames.
    """

    name = "gsps"
    source = "Mao, Liu and Salzmann, 2021, arXiv 2108.08422"
    generative = "p(a) p(lower_t | h_{1:O}, a) p(b) p(upper_t | h_{1:O}, lower_{1:T}, b)"
    inference = "q(a) q(b)"
    presets = PRESETS
    trainings: ClassVar[Mapping[str, Training]] = {
        "human36m": Training(156_000, 16, 1e-3, 0.8, gradient_clip=100.0),
        "humaneva": Training(62_500, 16, 1e-3, 0.8, gradient_clip=100.0),
        "": Training(6500, 16, 1e-3, 0.5),
    }
    latent: Size = 64
    parts: tuple[str, ...] = ("lower", "upper")
    coefficients: Size | None = None
    width: Size | None = None
    blocks: Layers = 4
    draws: tuple[Size, ...] | None = None
    reconstruction: Amount = 2.0
    multimodal: Amount = 1.0
    history: Amount = 100.0
    limb: Amount = 500.0
    angles: Amount = 100.0
    pose_prior: Amount = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.parts:
            raise ValueError(f"{self.name} makes the body part by part; name at least one part")
        for name in ("draws", "diversity", "diversity_scale"):
            values = getattr(self, name)
            if values is not None and len(values) not in (1, len(self.parts)):
                raise ValueError(
                    f"{name} is {values}; expected one number, or one for each of the parts {', '.join(self.parts)}"
                )

    @override
    def equations(self) -> tuple[Factorization, Factorization]:
        """The generative model and the guide; here half of the steps count as observed."""
        generative = part_by_part(self.names, lambda length: max(1, length // 2))
        return generative, generative.prior_guide(self.names)

    @property
    def names(self) -> list[str]:
        """Names of the parts."""
        return [part.partition("=")[0] for part in self.parts]

    @override
    def preset(self, skeleton: Skeleton) -> Mapping[str, Any]:
        """For these parts."""
        return {name: self._spread(name, value) for name, value in super().preset(skeleton).items()}

    def _spread(self, name: str, value: Any) -> Any:
        """A preset for two parts, for the parts that there are: with no more futures, if each has two draws."""
        count = len(self.parts)
        if not isinstance(value, tuple) or count == len(value):
            return value
        if name == "draws":
            return (max(2, int(prod(value) ** (1 / count))),) * count
        return (sum(value) / count,) * count

    @override
    def build(self, data: Any) -> GSPSModel:
        """The model for such windows.

        Raises:
            ValueError: poses with a root, or parts that are not those of the skeleton.
        """
        schema = self.poses(data)
        return GSPSModel(self.suited(schema), schema.skeleton, schema.protocol.observed, schema.frames)

    @override
    def train(self, train: Windows, validation: Windows | None = None, steps: int = 2000) -> Recipe:
        """One stage that minimises the weighted energies."""
        method = self.suited(train)
        stages = [Stage(steps, method.objective())]
        return Recipe(method.scored(train), validation, stages, prepare=partial(method.start, windows=train))

    def objective(self) -> Objective:
        """The weighted energies, summed; in `Evidence`'s unit, per frame. There is no likelihood, and no bound.

        Raises:
            ValueError: weights that are still open, which the skeleton decides.
        """
        if self.diversity is None:
            raise ValueError("the weights depend on the skeleton; take those of method.suited(windows)")
        weights = {name: getattr(self, name) for name in WEIGHTS}
        diversity = _each(self.diversity, self.parts)
        weights |= {f"diversity_{name}": weight for name, weight in zip(self.names, diversity, strict=True)}
        return Evidence(energy_weights={name: weight for name, weight in weights.items() if weight}, select="loss")


HISTORY = "h"
WEIGHTS = ("reconstruction", "multimodal", "history", "limb", "angles", "pose_prior")


class GSPSModel(EnergyModel):
    """The model of GSPS.

    On a batch of whole windows its program draws futures jointly and scores them by energies, with "pseudo"
    (B, M, T, D) and "valid" (B, M) in the batch where there are further futures; on observed frames it goes on from
    them.

    Args:
        method: with no option left open.
        skeleton: of poses whose root was dropped, D = 3 (J - 1).
        observed: O, frames that the networks see.
        length: T, frames that they make.
    """

    def __init__(self, method: Any, skeleton: Skeleton, observed: int, length: int):
        joints = body_parts(skeleton, method.parts)
        count = skeleton.joints - 1
        parts = {name: [3 * joint + axis for joint in held for axis in range(3)] for name, held in joints.items()}
        codes = _codes(list(parts))
        everything, shape = {HISTORY: range(count), **joints}, (method.coefficients, method.width, method.blocks)
        super().__init__(
            method,
            skeleton,
            observed,
            views=(History(HISTORY), Parts(parts)),
            generative=part_by_part(list(parts), lambda _: observed),
            inference=None,
            sizes={HISTORY: 3 * count, **dict.fromkeys(codes, method.latent), **{n: len(p) for n, p in parts.items()}},
            network={f"p({name})": GraphConv(everything, name, length, *shape) for name in parts},
            laws={f"p({name})": Directions(project=False) if method.bones else Delta() for name in parts},
        )
        self.length = length
        self.draws = dict(zip(codes, _each(method.draws, method.parts), strict=True))

    @override
    def model(self, batch: AnyBatch | None = None, **options: Any) -> dict[str, Tensor]:
        """Of whole windows, with energies. Values are as the networks see them, turned."""
        return super().model(batch, **self._drawing(batch, options))

    @override
    def guide(self, batch: AnyBatch, **options: Any) -> dict[str, Tensor]:
        return super().guide(batch, **self._drawing(batch, options))

    def _drawing(self, batch: AnyBatch | None, options: Mapping[str, Any]) -> dict[str, Any]:
        """The options, with several draws where the batch holds whole windows, a truth to score futures by."""
        given = batch.get(WHOLE) if isinstance(batch, Mapping) else None
        whole = given is not None and given.shape[1] == self.length and options.get("length") is None
        return {**({"draws": self.draws} if whole else {}), **options}

    @override
    def penalties(self, rollout: Rollout, data: Batch, draws: Mapping[str, int]) -> dict[str, Tensor]:
        """Those of whole windows."""
        if not draws:
            return {}
        truth = self.positions({WHOLE: self.seen(data[HISTORY], data)}, data)[WHOLE]
        parts = {name: rollout.values[name].unflatten(0, (-1, len(truth))) for name in self.observed}
        values = {name: value.flatten(0, 1) for name, value in self.positions(parts, data).items()}
        return self.energies(values, truth, data)

    def energies(self, values: Mapping[str, Tensor], truth: Tensor, batch: Batch) -> dict[str, Tensor]:
        """The energies of futures that were drawn together, (B,) each; those of weight 0 are left out.

        Args:
            values: name to rows, draw by draw, of a run with `draws`.
            truth: (B, T, D), NaN where it was not observed.
            batch: as it was read, with "pseudo" and "valid" where there are further futures.
        """
        method, past, size = self.method, self.frames, len(truth)
        samples = values[WHOLE].unflatten(0, (-1, size))  # (S, B, T, D)
        ahead = samples[:, :, past:]  # once: each cut of its own has a gradient of the whole samples' size
        found = self.best(ahead, truth[:, past:], batch)
        if method.history:
            found["history"] = energies.history_error(samples[:, :, :past], truth[:, :past])
        found |= self.realism(samples, truth, ahead)
        draws = list(self.draws.values())
        names = self.observed
        weights, scales = (_each(given, method.parts) for given in (method.diversity, method.diversity_scale))
        for i, rows in enumerate(accumulate(draws, mul)):
            if not weights[i]:
                continue
            motions = values[names[i]][: rows * size, past:].unflatten(0, (draws[i], -1))  # those that share the rest
            likeness = energies.pairwise_diversity(motions, scales[i])
            found[f"diversity_{names[i]}"] = likeness.unflatten(0, (-1, size)).mean(0)
        return found

    @override
    def read(self, batch: AnyBatch | None, **options: Any) -> Batch:
        """The batch, whose observed frames have no gaps (see `without_gaps`)."""
        data = super().read(batch, **options)
        mask = data.mask(HISTORY)
        if mask is None or mask.all():
            return data
        past = without_gaps(self.skeleton, data[HISTORY][:, : self.frames], mask[:, : self.frames])
        return data | {HISTORY: torch.cat([past, data[HISTORY][:, self.frames :]], 1)}

    @torch.no_grad()
    @override
    def forecast(self, batch: AnyBatch, horizon: int, samples: int = 1, **options: Any) -> dict[str, Tensor]:
        """At most as far as the networks' T frames, all of which a fixed part has.

        Raises:
            ValueError: other observed frames than the networks see, or a horizon beyond what they make.
        """
        data, most = self.read(batch), self.length - self.frames
        past = data[HISTORY].shape[1]
        if past != self.frames or not 1 <= horizon <= most:
            raise ValueError(
                f"this model sees {self.frames} frames and makes up to {most} more, but was given {past} frames and "
                f"asked for {horizon}"
            )
        out = super().forecast(data, most, samples, **options)
        return {
            name: value[:, :, :horizon] if name in (WHOLE, *self.observed) else value for name, value in out.items()
        }

    @torch.no_grad()
    @override
    def impute(
        self, batch: AnyBatch, samples: int = 1, *, draw: bool | None = None, **options: Any
    ) -> dict[str, Tensor]:
        """Fill missing entries of whole windows, S times, by the drawn motion nearest to all observed entries.

        The paper has no such method, and the model has no guide that reads observations after a gap. Each sample is the
        best of as many draws as in training. Inside a gap, a linear correction in time removes the errors at both ends.
        `draw` has no effect, because the emission has no noise.

        Args:
            batch: whole windows x (B, T, D) with a mask.
            samples: S.
            draw: ignored.
            options: options of `DynamicalVAE.impute`.

        Returns:
            {"x": (S, B, T, D)}.

        Raises:
            ValueError: if the batch has no mask, or the windows have another length than the model.
        """
        if not isinstance(batch, Mapping) or (mask := Batch(batch).mask()) is None:
            return super().impute(batch, samples, **options)  # which says so
        if (length := batch[WHOLE].shape[1]) != self.length:
            raise ValueError(
                f"{self.method.name} fills gaps in windows of {self.length} frames, not {length}; cut the motion so, "
                "as `dvae impute` does without --clip"
            )
        filled, count = [], prod(self.draws.values())
        for _ in range(samples):
            made = self.reconstruct(batch, count, **options)[WHOLE]
            given, seen = torch.as_tensor(batch[WHOLE]).to(made), torch.as_tensor(mask).to(made.device)
            nearest = (made - given).square().masked_fill(~seen, 0.0).sum((2, 3)).argmin(0)
            best = made.take_along_dim(nearest[None, :, None, None], 0)[0]
            filled.append(torch.where(seen, given, best + bridged(given - best, seen)))
        return {WHOLE: torch.stack(filled)}

    @torch.no_grad()
    @override
    def sample(self, n: int = 1, length: int | None = None, batch: AnyBatch | None = None) -> dict[str, Tensor]:
        """The batch holds what was observed."""
        return super().sample(n, self.length if length is None else length, batch)


def part_by_part(parts: Sequence[str], observed: Callable[[int], int]) -> Factorization:
    """The generative model of parts that are made in this order; `observed`: O of T steps."""
    text = " ".join(
        f"p({code}) p({name}_t | h_{{1:O}}, {''.join(f'{before}_{{1:T}}, ' for before in parts[:i])}{code})"
        for i, (code, name) in enumerate(zip(_codes(parts), parts, strict=True))
    )
    return Factorization.parse(text, {"1:O": lambda length: np.arange(length)[None] < observed(length)})


def _codes(parts: Sequence[str]) -> list[str]:
    """The names of the parts' latents: a, b, ..., but for names that are taken."""
    free = (letter for letter in ascii_lowercase if letter not in {HISTORY, WHOLE, *parts})
    return [code for code, _ in zip(free, parts, strict=False)]


def _each(values: Sequence[Any], parts: Sequence[str]) -> Sequence[Any]:
    """One value for each part, from one for all of them."""
    return tuple(values) * len(parts) if len(values) == 1 else values
