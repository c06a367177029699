"""GSPS: diverse futures of a moving body, part by part, each a function of its own latent and of earlier parts.

With the parts lower and upper, and h the motion observed up to frame O,

    p(a) p(b) p(lower_t | h_{1:O}, a) p(upper_t | h_{1:O}, lower_{1:T}, b)        q(a) q(b)

Every part is a point mass: a residual graph convolutional network predicts the first cosine coefficients of its
trajectory, all steps at once. The guide is the prior instead of an inference network, so that every KL divergence is
exactly zero. Training minimises the expected energy of futures that are drawn together for each window: several draws
of a, and for each of them several draws of b. The energies penalise

* the error of the best future, relative to the true future and to each pseudo ground truth;
* similar futures of a part;
* futures that differ from the past in the observed frames;
* limbs that change their lengths, and joint angles outside their limits;
* poses that are unlikely under a pose prior.

With a fixed latent, or a fixed motion of the first parts, these parts are constant while the others vary.

Mao, Liu and Salzmann, 2021, arXiv 2108.08422, with the layers, weights and normalisations of its public code. Our
addition: the generator may see every window rotated so that the last observed pose faces one way, as in the presets for
small data sets.

Coefficient k = 0, 1, ... of T frames at f frames per second has the frequency k f / (2 T). For Human3.6M, the
supplement states 20 coefficients (3.8 Hz). The public code has 10 (1.8 Hz), and so has the released model: its
generator has 1,298,108 parameters. For HumanEva-I, both have 8 (2.8 Hz). Other data have as many as reach 2.8 Hz.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate
from math import floor, prod
from operator import mul
from string import ascii_lowercase
from typing import Any, ClassVar, Literal, Self

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from ...data.batch import WHOLE, Batch
from ...data.schema import Schema
from ...data.sequences import interpolate_missing
from ...data.views import History, Parts
from ...distributions import Delta, Directions
from ...factorization.notation import Factorization
from ...inference.training.objectives import Evidence, Objective
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe
from ...motion import HUMAN36M, HUMANEVA, PROTOCOLS, Skeleton, Windows
from ...motion.data.protocols import Poses
from ...motion.geometry.parts import body_parts
from ...motion.scoring import energies
from ...networks import GraphConv
from ...options import Amount, Layers, Positive, Size
from ...program.batch import AnyBatch
from ...program.rollout import Rollout
from .energies import EnergyMethod, EnergyModel
from .poses import table, without_gaps

BANDWIDTH = 2.8
"""Frequency in Hz that the coefficients reach by default; the paper's on HumanEva-I."""
PUBLISHED = {"code": {HUMAN36M.name: 10, HUMANEVA.name: 8}, "supplement": {HUMAN36M.name: 20, HUMANEVA.name: 8}}
"""Numbers of coefficients for each skeleton, in the public code and in the paper's supplement."""
PRESETS = table(
    "coefficients width draws diversity diversity_scale pseudo_minimum pool_stride heading",
    {
        "human36m": (10, 256, (10, 10), (8.0, 25.0), (100.0, 300.0), 0.1, 20, False),
        "humaneva": (8, 256, (10, 10), (5.0, 10.0), (15.0, 50.0), 0.01, 15, False),
        "": (None, 128, (4, 4), (5.0, 10.0), (15.0, 50.0), 0.01, 10, True),
    },
)
"""Options by skeleton: the paper's values; for other skeletons, values for 15 observed + 60 predicted frames, 30 Hz."""
CLIP = 100.0
"""Largest norm of the gradient of the published loss, which is T times ours, for windows of T frames."""


@dataclass(frozen=True)
class GSPS(EnergyMethod):
    """Diverse futures, part by part.

    The defaults are the paper's sizes for Human3.6M and HumanEva-I, and smaller sizes for other skeletons.

    Options with one number for each part also accept one number for all parts.

    Args:
        latent: size of each part's latent.
        parts: parts of the body, in the order of their prediction: "lower" and "upper", or some of "torso",
            "right_leg", "left_leg", "left_arm", "right_arm"; or new ones, such as "legs=right_leg+left_leg" or
            "head=Neck+Head".
        coefficients: number of cosine coefficients of the whole window; or "code" or "supplement" for the number in the
            public code or in the paper's supplement. By default the number in the code, and for skeletons other than
            Human3.6M's and HumanEva-I's as many as reach 2.8 Hz.
        bandwidth: highest frequency of the coefficients in Hz, in place of their number.
        width: features of a joint in the networks.
        blocks: residual blocks of each network.
        draws: number of draws of each part's latent, in training, for each draw of the earlier parts.
        history: weight of the squared error in the observed frames.
    """

    name = "gsps"
    source = "Mao, Liu and Salzmann, 2021, arXiv 2108.08422"
    generative = "p(a) p(lower_t | h_{1:O}, a) p(b) p(upper_t | h_{1:O}, lower_{1:T}, b)"
    inference = "q(a) q(b)"
    presets = PRESETS
    trainings: ClassVar[Mapping[str, Training]] = {
        "human36m": Training(156_000, 16, 1e-3, 0.8, gradient_clip=CLIP / PROTOCOLS["h36m"].length),
        "humaneva": Training(62_500, 16, 1e-3, 0.8, gradient_clip=CLIP / PROTOCOLS["humaneva"].length),
        "": Training(6500, 16, 1e-3, 0.5),
    }
    latent: Size = 64
    parts: tuple[str, ...] = ("lower", "upper")
    coefficients: Size | Literal["code", "supplement"] | None = None
    bandwidth: Positive | None = None
    width: Size | None = None
    blocks: Layers = 4
    draws: tuple[Size, ...] | None = None
    reconstruction: Amount = 2.0
    multimodal: Amount = 1.0
    history: Amount = 100.0
    limb: Amount = 500.0
    angles: Amount = 100.0
    pose_prior: Amount = 0.01

    @override
    def training(self, data: Any) -> Training:
        """Return the default training options for these data, with the published clip for their number of frames."""
        training, schema = super().training(data), Schema.of(data)
        if isinstance(schema, Poses) and schema.preset in PUBLISHED["code"]:
            return replace(training, gradient_clip=CLIP / schema.frames)
        return training

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.parts:
            raise ValueError("parts is empty; name at least one part of the body")
        if self.coefficients is not None and self.bandwidth is not None:
            raise ValueError(
                f"coefficients is {self.coefficients} and bandwidth is {self.bandwidth:g}; give only one of them"
            )
        for name in ("draws", "diversity", "diversity_scale"):
            values = getattr(self, name)
            if values is not None and len(values) not in (1, len(self.parts)):
                raise ValueError(
                    f"{name} is {values}; expected one number, or one for each of the parts {', '.join(self.parts)}"
                )

    @override
    def equations(self) -> tuple[Factorization, Factorization]:
        """Return the generative model and the guide of sequences whose first half is observed."""
        generative = part_by_part(self.names, lambda length: max(1, length // 2))
        return generative, generative.prior_guide(self.names)

    @property
    def names(self) -> list[str]:
        """Names of the parts."""
        return [part.partition("=")[0] for part in self.parts]

    @override
    def preset(self, skeleton: Skeleton) -> Mapping[str, Any]:
        """Return the preset, adapted to these parts."""
        return {name: self._spread(name, value) for name, value in super().preset(skeleton).items()}

    def _spread(self, name: str, value: Any) -> Any:
        """Return the preset value of an option for these parts, computed from the preset for two parts.

        The result has the mean of the preset for every part. For "draws", the number of futures does not exceed the
        preset's, unless each part would have fewer than two draws.

        Args:
            name: name of the option.
            value: preset for two parts, or a single value, which is returned unchanged.
        """
        count = len(self.parts)
        if not isinstance(value, tuple) or count == len(value):
            return value
        if name == "draws":
            return (max(2, int(prod(value) ** (1 / count))),) * count
        return (sum(value) / count,) * count

    @override
    def resolve_defaults(self, data: Any) -> Self:
        """Return the method with unset options chosen for the skeleton, and the number of coefficients.

        Raises:
            ValueError: if `coefficients` names a publication that has no number for the skeleton.
        """
        schema = Poses.of(data, self.name, self.representation)
        method = replace(self, coefficients=self._count(schema), bandwidth=None)
        return super(GSPS, method).resolve_defaults(schema)

    def _count(self, schema: Poses) -> int:
        """Return the number of coefficients for windows of poses."""
        count, bandwidth, skeleton = self.coefficients, self.bandwidth, schema.skeleton.name
        if isinstance(count, str):
            if skeleton not in PUBLISHED[count]:
                raise ValueError(
                    f"coefficients is {count!r}, which has numbers for {' and '.join(PUBLISHED[count])}, not for the "
                    f"skeleton {skeleton!r}; give a number, or a bandwidth in Hz"
                )
            return PUBLISHED[count][skeleton]
        if bandwidth is not None and bandwidth > schema.protocol.fps / 2:
            raise ValueError(
                f"bandwidth is {bandwidth:g} Hz, but {schema.protocol.fps:g} frames per second contain frequencies "
                f"up to {schema.protocol.fps / 2:g} Hz; give a lower one"
            )
        if count is None and bandwidth is None:
            count = self.preset(schema.skeleton)["coefficients"]
        return count or coefficients_up_to(bandwidth or BANDWIDTH, schema.frames, schema.protocol.fps)

    @override
    def build(self, data: Any) -> GSPSModel:
        """Return the model for windows of poses.

        Raises:
            ValueError: if the poses have a root, or the skeleton does not have these parts.
        """
        schema = self.poses(data)
        return GSPSModel(self.resolve_defaults(schema), schema.skeleton, schema.protocol.observed, schema.frames)

    @override
    def train(self, train: Windows, validation: Windows | None = None, steps: int = 2000) -> Recipe:
        """Return one stage that minimises the weighted energies."""
        method = self.resolve_defaults(train)
        stages = [Stage(steps, method.objective())]
        return Recipe(method.scored(train), validation, stages, prepare=partial(method.start, windows=train))

    def objective(self) -> Objective:
        """Return the sum of the weighted energies, per frame as in `Evidence`, without a likelihood or bound.

        Raises:
            ValueError: if weights that depend on the skeleton are unset.
        """
        if self.diversity is None:
            raise ValueError("the weights depend on the skeleton; call method.resolve_defaults(windows) first")
        weights = {name: getattr(self, name) for name in WEIGHTS}
        diversity = _per_part(self.diversity, self.parts)
        weights |= {f"diversity_{name}": weight for name, weight in zip(self.names, diversity, strict=True)}
        return Evidence(energy_weights={name: weight for name, weight in weights.items() if weight}, select="loss")


HISTORY = "h"
WEIGHTS = ("reconstruction", "multimodal", "history", "limb", "angles", "pose_prior")


class GSPSModel(EnergyModel):
    """The model of GSPS.

    On a batch of whole windows, the program draws futures jointly and scores them by energies. The batch contains
    "pseudo" (B, M, T, D) and "valid" (B, M) if there are further futures. On observed frames alone, the program
    continues from them.

    Args:
        method: method whose options are all resolved.
        skeleton: skeleton of poses without root, D = 3 (J - 1).
        observed: O, number of frames that the networks read.
        length: T, number of frames that the networks predict.
    """

    def __init__(self, method: Any, skeleton: Skeleton, observed: int, length: int):
        joints = body_parts(skeleton, method.parts)
        count = skeleton.joints - 1
        parts = {name: [3 * joint + axis for joint in members for axis in range(3)] for name, members in joints.items()}
        codes = _codes(list(parts))
        groups, shape = {HISTORY: range(count), **joints}, (method.coefficients, method.width, method.blocks)
        super().__init__(
            method,
            skeleton,
            observed,
            views=(History(HISTORY), Parts(parts)),
            generative=part_by_part(list(parts), lambda _: observed),
            inference=None,
            sizes={HISTORY: 3 * count, **dict.fromkeys(codes, method.latent), **{n: len(p) for n, p in parts.items()}},
            network={f"p({name})": GraphConv(groups, name, length, *shape) for name in parts},
            distributions={f"p({name})": Directions(project=False) if method.bones else Delta() for name in parts},
        )
        self.length = length
        self.draws = dict(zip(codes, _per_part(method.draws, method.parts), strict=True))

    @override
    def model(self, batch: AnyBatch | None = None, **options: Any) -> dict[str, Tensor]:
        """Run the generative program, with energies for whole windows. Values are rotated as the networks see them."""
        return super().model(batch, **self._with_draws(batch, options))

    @override
    def guide(self, batch: AnyBatch, **options: Any) -> dict[str, Tensor]:
        return super().guide(batch, **self._with_draws(batch, options))

    def _with_draws(self, batch: AnyBatch | None, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the options, with several draws if the batch has whole windows.

        The energies compare these draws with the true future, which only whole windows contain.
        """
        x = batch.get(WHOLE) if isinstance(batch, Mapping) else None
        is_complete = x is not None and x.shape[1] == self.length and options.get("length") is None
        return {**({"draws": self.draws} if is_complete else {}), **options}

    @override
    def penalties(self, rollout: Rollout, data: Batch, draws: Mapping[str, int]) -> dict[str, Tensor]:
        """Return the energies of whole windows."""
        if not draws:
            return {}
        truth = self.positions({WHOLE: self.seen(data[HISTORY], data)}, data)[WHOLE]
        parts = {name: rollout.values[name].unflatten(0, (-1, len(truth))) for name in self.observed}
        values = {name: value.flatten(0, 1) for name, value in self.positions(parts, data).items()}
        return self.energies(values, truth, data)

    def energies(self, values: Mapping[str, Tensor], truth: Tensor, batch: Batch) -> dict[str, Tensor]:
        """Return the energies of futures that were drawn together, (B,) each, except energies with weight 0.

        Args:
            values: mapping from variable to its values in a rollout with `draws`; rows are ordered draw by draw.
            truth: (B, T, D), NaN where it was not observed.
            batch: batch after `read`, with "pseudo" and "valid" if there are further futures.
        """
        method, past, size = self.method, self.frames, len(truth)
        samples = values[WHOLE].unflatten(0, (-1, size))  # (S, B, T, D)
        ahead = samples[:, :, past:]  # sliced only once, as the gradient of each slice has the full size
        terms = self.best(ahead, truth[:, past:], batch)
        if method.history:
            terms["history"] = energies.history_error(samples[:, :, :past], truth[:, :past])
        terms |= self.realism(samples, truth, ahead)
        draws = list(self.draws.values())
        names = self.observed
        weights, scales = (_per_part(option, method.parts) for option in (method.diversity, method.diversity_scale))
        for i, rows in enumerate(accumulate(draws, mul)):
            if not weights[i]:
                continue
            motions = values[names[i]][: rows * size, past:].unflatten(
                0, (draws[i], -1)
            )  # futures that share earlier parts
            similarity = energies.pairwise_diversity(motions, scales[i])
            terms[f"diversity_{names[i]}"] = similarity.unflatten(0, (-1, size)).mean(0)
        return terms

    @override
    def read(self, batch: AnyBatch | None, **options: Any) -> Batch:
        """Return the batch, with missing entries of observed frames filled in by `without_gaps`."""
        data = super().read(batch, **options)
        mask = data.mask(HISTORY)
        if mask is None or mask.all():
            return data
        past = without_gaps(self.skeleton, data[HISTORY][:, : self.frames], mask[:, : self.frames])
        return data | {HISTORY: torch.cat([past, data[HISTORY][:, self.frames :]], 1)}

    @torch.no_grad()
    @override
    def forecast(self, batch: AnyBatch, horizon: int, samples: int = 1, **options: Any) -> dict[str, Tensor]:
        """Forecast up to the T frames of the networks; a fixed part must have all of these frames.

        Raises:
            ValueError: if the batch has another number of observed frames, or the horizon is too long.
        """
        data, most = self.read(batch), self.length - self.frames
        past = data[HISTORY].shape[1]
        if past != self.frames or not 1 <= horizon <= most:
            raise ValueError(
                f"this model reads {self.frames} frames and predicts up to {most} more; got {past} frames and a "
                f"horizon of {horizon}"
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
            samples: S, number of samples.
            draw: ignored.
            options: options of `DynamicalVAE.impute`.

        Returns:
            {"x": (S, B, T, D)}.

        Raises:
            ValueError: if the batch has no mask, or the windows have another length than the model.
        """
        if not isinstance(batch, Mapping) or (mask := Batch(batch).mask()) is None:
            return super().impute(batch, samples, **options)  # which raises
        if (length := batch[WHOLE].shape[1]) != self.length:
            raise ValueError(
                f"{self.method.name} imputes windows of {self.length} frames, got {length}; cut the motion into "
                "such windows, as `dvae impute` does without --clip"
            )
        motions, count = [], prod(self.draws.values())
        for _ in range(samples):
            draws = self.reconstruct(batch, count, **options)[WHOLE]
            x, observed = torch.as_tensor(batch[WHOLE]).to(draws), torch.as_tensor(mask).to(draws.device)
            nearest = (draws - x).square().masked_fill(~observed, 0.0).sum((2, 3)).argmin(0)
            best = draws.take_along_dim(nearest[None, :, None, None], 0)[0]
            motions.append(torch.where(observed, x, best + interpolate_missing(x - best, observed)))
        return {WHOLE: torch.stack(motions)}

    @torch.no_grad()
    @override
    def sample(self, n: int = 1, length: int | None = None, batch: AnyBatch | None = None) -> dict[str, Tensor]:
        """Draw futures of the observed motion in the batch."""
        return super().sample(n, self.length if length is None else length, batch)


def coefficients_up_to(frequency: float, frames: int, fps: float) -> int:
    """Return the number of cosine coefficients whose frequencies do not exceed a given one; at most all.

    Args:
        frequency: highest frequency in Hz.
        frames: T, number of frames that the coefficients describe.
        fps: frames per second.
    """
    return min(1 + floor(2 * frames * frequency / fps + 1e-9), frames)  # 1e-9: exact multiples, despite rounding


def part_by_part(parts: Sequence[str], observed: Callable[[int], int]) -> Factorization:
    """Return the generative factorization of parts; each part reads all earlier parts.

    Args:
        parts: names of the parts, in the order of their prediction.
        observed: function from the number of steps T to the number of observed steps O.
    """
    text = " ".join(
        f"p({code}) p({name}_t | h_{{1:O}}, {''.join(f'{before}_{{1:T}}, ' for before in parts[:i])}{code})"
        for i, (code, name) in enumerate(zip(_codes(parts), parts, strict=True))
    )
    return Factorization.parse(text, {"1:O": lambda length: np.arange(length)[None] < observed(length)})


def _codes(parts: Sequence[str]) -> list[str]:
    """Return the names of the parts' latents: a, b, ..., except names that are in use."""
    letters = (letter for letter in ascii_lowercase if letter not in {HISTORY, WHOLE, *parts})
    return [code for code, _ in zip(letters, parts, strict=False)]


def _per_part(values: Sequence[Any], parts: Sequence[str]) -> Sequence[Any]:
    """Return one value for each part; a single value applies to all."""
    return tuple(values) * len(parts) if len(values) == 1 else values
