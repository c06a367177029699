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
from dataclasses import dataclass, fields, replace
from itertools import accumulate
from math import prod
from operator import mul
from string import ascii_lowercase
from typing import Any, ClassVar

import numpy as np
import pyro
import torch
from torch import Tensor, nn

from .. import energies
from ..heads import Delta
from ..inference.batches import Source
from ..inference.objectives import Evidence, Objective
from ..model import WHOLE, Batch, DynamicalVAE
from ..motion import Skeleton, Windows, face_forward, rotate_about_up
from ..motion.angles import AngleLimits, angle_names, estimate_angle_limits
from ..motion.body import body_parts
from ..motion.truths import PseudoTruths, WithPseudoTruths
from ..networks import GraphConv
from ..notation import Factorization
from .method import Method
from .pose_prior import PosePrior, PosePriorModel, fit_pose_prior

PUBLISHED: dict[str, dict[str, Any]] = {
    "human36m": {
        "coefficients": 10,
        "width": 256,
        "draws": (10, 10),
        "diversity": (8.0, 25.0),
        "diversity_scale": (100.0, 300.0),
        "pseudo_minimum": 0.1,
        "pool_stride": 20,
        "heading": False,
    },
    "humaneva": {
        "coefficients": 8,
        "width": 256,
        "draws": (10, 10),
        "diversity": (5.0, 10.0),
        "diversity_scale": (15.0, 50.0),
        "pseudo_minimum": 0.01,
        "pool_stride": 15,
        "heading": False,
    },
}
"""Skeleton to the paper's options."""

SCALED: dict[str, Any] = {
    "coefficients": 8,
    "width": 128,
    "draws": (4, 4),
    "diversity": (2.0, 4.0),
    "diversity_scale": (15.0, 50.0),
    "pseudo_minimum": 0.02,
    "pool_stride": 10,
    "heading": True,
}
"""Options for other skeletons, at 30 frames a second and 15 observed and 60 predicted frames."""


@dataclass(frozen=True)
class GSPS(Method):
    """See the file. Without a likelihood, emission, residual, prior, warm-up, free bits and self-feeding do not apply.

    Options that are None are chosen by the skeleton: the paper's for Human3.6M and HumanEva-I, smaller ones for others.
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
        reconstruction: weight of the squared error of the best future.
        multimodal: weight of that to the pseudo ground truths.
        diversity: weight of the likeness of a part's futures, for each part.
        diversity_scale: metres, L1, over which futures of a part are alike, for each part.
        history: weight of the squared error in the observed frames.
        limb: weight of the squared error of the limbs' lengths.
        angles: weight of the violation of the angles' limits.
        pose_prior: weight of the poses' energy under a pose prior.
        pose_prior_run: run directory of a fitted pose-prior; "" to fit one first.
        angle_quantile: share of the training poses that an angle's limit leaves out at each end.
        pseudo_threshold: metres between last observed poses, within which futures are exchanged.
        pseudo_minimum: metres, mean over joints, that such a future keeps from the true one.
        pseudo_most: largest number of them for a window.
        pool_stride: frames between the windows that they are taken from.
        heading: turn every window so that its last observed pose faces one way, and the futures back.
    """

    name: ClassVar[str] = "gsps"
    source: ClassVar[str] = "Mao, Liu and Salzmann, 2021, arXiv 2108.08422"
    generative: ClassVar[str] = "p(a) p(lower_t | h_{1:O}, a) p(b) p(upper_t | h_{1:O}, lower_{1:T}, b)"
    inference: ClassVar[str] = "q(a) q(b)"
    unused: ClassVar[frozenset[str]] = frozenset(option.name for option in fields(Method)) - {"latent"}
    likelihood: ClassVar[bool] = False

    latent: int = 64
    parts: tuple[str, ...] = ("lower", "upper")
    coefficients: int | None = None
    width: int | None = None
    blocks: int = 4
    draws: tuple[int, ...] | None = None
    reconstruction: float = 2.0
    multimodal: float = 1.0
    diversity: tuple[float, ...] | None = None
    diversity_scale: tuple[float, ...] | None = None
    history: float = 100.0
    limb: float = 500.0
    angles: float = 100.0
    pose_prior: float = 0.01
    pose_prior_run: str = ""
    angle_quantile: float = 0.0
    pseudo_threshold: float = 0.5
    pseudo_minimum: float | None = None
    pseudo_most: int = 10
    pool_stride: int | None = None
    heading: bool | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for option in fields(self):
            if option.name in self.unused and getattr(self, option.name) != option.default:
                raise ValueError(
                    f"gsps has no {option.name}, as it has no likelihood and no inference network; leave it at "
                    f"{option.default!r}"
                )
        if not self.parts:
            raise ValueError("gsps makes the body part by part; name at least one part")
        for name in ("draws", "diversity", "diversity_scale"):
            values = getattr(self, name)
            if values is not None and len(values) not in (1, len(self.parts)):
                raise ValueError(
                    f"{name} is {values}; expected one number, or one for each of the parts {', '.join(self.parts)}"
                )
        positive = ("coefficients", "width", "blocks", "draws", "diversity_scale", "pseudo_most", "pool_stride")
        weights = ("reconstruction", "multimodal", "diversity", "history", "limb", "angles", "pose_prior")
        for name in (*positive, *weights):
            value = getattr(self, name)
            for number in value if isinstance(value, tuple) else () if value is None else (value,):
                if not number > 0 if name in positive else not 0 <= number < float("inf"):
                    raise ValueError(
                        f"{name} is {value}; it must be {'positive' if name in positive else 'at least 0'}"
                    )
        if not 0 <= self.angle_quantile < 0.5:
            raise ValueError(f"angle_quantile is {self.angle_quantile}; it must be at least 0 and below 0.5")

    def equations(self) -> tuple[Factorization, Factorization]:
        """The generative model and the guide; here half of the steps count as observed."""
        generative = part_by_part(self.names, lambda length: max(1, length // 2))
        return generative, generative.prior_guide(self.names)

    @property
    def names(self) -> list[str]:
        """Names of the parts."""
        return [part.partition("=")[0] for part in self.parts]

    def check(self) -> None:
        """See `Method.check`; the rest needs the skeleton."""

    def suited(self, windows: Windows) -> GSPS:
        """See `Method.suited`: the options that are None, chosen by the skeleton."""
        chosen = PUBLISHED.get(windows.skeleton.name, SCALED)
        return replace(self, **{n: self._spread(n, v) for n, v in chosen.items() if getattr(self, n) is None})

    def _spread(self, name: str, value: Any) -> Any:
        """A preset for two parts, for the parts that there are: with no more futures, if each has two draws."""
        count = len(self.parts)
        if not isinstance(value, tuple) or count == len(value):
            return value
        if name == "draws":
            return (max(2, int(prod(value) ** (1 / count))),) * count
        return (sum(value) / count,) * count

    def build_for(self, windows: Windows) -> GSPSModel:
        """See `Method.build_for`.

        Raises:
            ValueError: windows with a root, or parts that are not those of the skeleton.
        """
        method = self.suited(windows)
        if windows.protocol.root != "drop":
            raise ValueError(
                f"gsps makes poses relative to the pelvis, but the protocol {windows.protocol.name} has the root "
                f"{windows.protocol.root!r}; use one with root='drop'"
            )
        return GSPSModel(method, windows.skeleton, windows.protocol.observed, windows.length)

    def prepare(self, model: nn.Module, windows: Windows) -> None:
        """See `Method.prepare`: the limits of the angles, and the pose prior.

        Raises:
            ValueError: a pose prior of another skeleton.
        """
        assert isinstance(model, GSPSModel)
        method = model.method
        if model.limits is not None:
            limits = estimate_angle_limits(windows.poses(), windows.skeleton, method.angle_quantile)
            model.angle_low.copy_(limits.low)
            model.angle_high.copy_(limits.high)
        if model.pose_prior is not None:
            model.pose_prior.load_state_dict(method._fitted_prior(windows).state_dict())

    def _fitted_prior(self, windows: Windows) -> nn.Module:
        if not self.pose_prior_run:
            return fit_pose_prior(windows, heading=bool(self.heading))
        from .runs import load

        loaded = load(self.pose_prior_run)
        method = loaded.method
        if not isinstance(method, PosePrior) or loaded.data.motion.skeleton.parents != windows.skeleton.parents:
            raise ValueError(f"{self.pose_prior_run} holds no pose prior of the skeleton {windows.skeleton.name!r}")
        if (method.heading, method.layers) != (self.heading, PosePrior.layers):
            raise ValueError(
                f"{self.pose_prior_run} was fitted with heading={method.heading} and layers={method.layers}, but this "
                f"model sees poses with heading={self.heading}, and takes a prior of {PosePrior.layers} layers"
            )
        return loaded.model

    def batches(self, windows: Windows) -> Source:
        """See `Method.batches`: windows and their pseudo ground truths."""
        method = self.suited(windows)
        if not method.multimodal:
            return windows
        assert method.pseudo_minimum is not None
        assert method.pool_stride is not None
        truths = PseudoTruths(
            windows,
            threshold=method.pseudo_threshold,
            minimum=method.pseudo_minimum,
            most=method.pseudo_most,
            stride=method.pool_stride,
            heading=bool(method.heading),
        )
        return WithPseudoTruths(windows, truths)

    def objective(self) -> Objective:
        """The weighted energies, summed; in `Evidence`'s unit, per frame.

        Raises:
            ValueError: weights that are still open, which the skeleton decides.
        """
        if self.diversity is None:
            raise ValueError("the weights depend on the skeleton; take those of method.suited(windows)")
        weights = {name: getattr(self, name) for name in WEIGHTS}
        diversity = _each(self.diversity, self.parts)
        weights |= {f"diversity_{name}": weight for name, weight in zip(self.names, diversity, strict=True)}
        return Evidence(energy_weights={name: weight for name, weight in weights.items() if weight})


HISTORY = "h"
WEIGHTS = ("reconstruction", "multimodal", "history", "limb", "angles", "pose_prior")


class GSPSModel(DynamicalVAE):
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

    angle_low: Tensor
    angle_high: Tensor

    def __init__(self, method: GSPS, skeleton: Skeleton, observed: int, length: int):
        joints = body_parts(skeleton, method.parts)
        count = skeleton.joints - 1
        parts = {name: [3 * joint + axis for joint in held for axis in range(3)] for name, held in joints.items()}
        codes = _codes(list(parts))
        everything = {HISTORY: range(count), **joints}
        assert method.coefficients is not None
        assert method.width is not None
        super().__init__(
            part_by_part(list(parts), lambda _: observed),
            None,
            {HISTORY: 3 * count, **dict.fromkeys(codes, method.latent), **{name: len(p) for name, p in parts.items()}},
            network={
                f"p({name})": GraphConv(everything, name, length, method.coefficients, method.width, method.blocks)
                for name in parts
            },
            heads={f"p({name})": Delta() for name in parts},
            parts=parts,
            history=HISTORY,
        )
        self.method, self.skeleton, self.frames, self.length = method, skeleton, observed, length
        self.draws = dict(zip(codes, _each(method.draws, method.parts), strict=True))
        self.limits: tuple[str, ...] | None = None
        if method.angles:
            names = angle_names(skeleton)
            self.limits = names
            self.register_buffer("angle_low", torch.full((len(names),), -1.0))
            self.register_buffer("angle_high", torch.full((len(names),), 1.0))
        self.pose_prior = PosePriorModel(skeleton).requires_grad_(False) if method.pose_prior else None

    def model(self, batch: Batch | None = None, **options: Any) -> dict[str, Tensor]:
        """See `DynamicalVAE.model`; of whole windows, with energies. Values are as the networks see them, turned."""
        if not self._whole(batch, options):
            return super().model(_without_futures(batch), **options)
        assert isinstance(batch, Mapping)
        values = self._with_whole(super().model(_without_futures(batch), **{"draws": self.draws, **options}))
        truth = self.turned(batch[WHOLE])[0]
        with pyro.plate("windows", len(truth), dim=-1):
            for name, energy in self.energies(values, truth, batch).items():
                pyro.factor(name, -energy)
        return values

    def guide(self, batch: Batch, **options: Any) -> dict[str, Tensor]:
        """See `DynamicalVAE.guide`."""
        draws = {"draws": self.draws} if self._whole(batch, options) else {}
        return super().guide(_without_futures(batch), **{**draws, **options})

    def _whole(self, batch: Batch | None, options: Mapping[str, Any]) -> bool:
        """Whether there is a truth to score futures by: the program is asked for no more than what the batch holds."""
        given = batch[WHOLE] if isinstance(batch, Mapping) and WHOLE in batch else None
        return given is not None and given.shape[1] == self.length and options.get("length") is None

    def _mapping(self, batch: Batch | None) -> dict[str, Any]:
        """The history turned, wherever a batch comes from."""
        values = super()._mapping(batch)
        given = batch if not isinstance(batch, Mapping) else batch.get(WHOLE)
        if given is not None:
            values[HISTORY] = self.turned(values[HISTORY])[0]
        return values

    def energies(self, values: Mapping[str, Tensor], truth: Tensor, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The energies of futures that were drawn together, (B,) each; those of weight 0 are left out.

        Args:
            values: name to rows, draw by draw, of a run with `draws`.
            truth: (B, T, D).
            batch: with "pseudo" and "valid", where there are further futures.
        """
        method, past, size = self.method, self.frames, len(truth)
        samples = values[WHOLE].unflatten(0, (-1, size))  # (S, B, T, D)
        future = samples[:, :, past:]
        found: dict[str, Tensor] = {}
        if method.reconstruction:
            found["reconstruction"] = energies.best_of_many(future, truth[:, past:])
        if method.multimodal:
            found["multimodal"] = truth.new_zeros(size)
            if "pseudo" in batch:
                others = self.turned(batch["pseudo"])[0][:, :, past:]
                found["multimodal"] = energies.multimodal_best_of_many(future, others, batch["valid"])
        if method.history:
            found["history"] = energies.history_error(samples[:, :, :past], truth[:, :past])
        if method.limb:
            found["limb"] = energies.limb_length(samples, truth[:, 0], self.skeleton)
        if self.limits is not None:
            limits = AngleLimits(self.limits, self.angle_low, self.angle_high)
            found["angles"] = energies.joint_angles(future, limits, self.skeleton)
        if self.pose_prior is not None:
            offset = int(torch.randint(min(3, future.shape[2]), ()))  # every third frame, another third at every step
            found["pose_prior"] = energies.pose_prior_energy(future[:, :, offset::3], self.pose_prior, self.skeleton)
        draws = list(self.draws.values())
        names = list(self.parts)
        weights, scales = (_each(given, method.parts) for given in (method.diversity, method.diversity_scale))
        for i, rows in enumerate(accumulate(draws, mul)):
            if not weights[i]:
                continue
            motions = values[names[i]][: rows * size, past:].unflatten(0, (draws[i], -1))  # those that share the rest
            likeness = energies.pairwise_diversity(motions, scales[i])
            found[f"diversity_{names[i]}"] = likeness.unflatten(0, (-1, size)).mean(0)
        return found

    @torch.no_grad()
    def forecast(
        self,
        batch: Batch,
        horizon: int,
        samples: int = 1,
        *,
        draw_emission: bool = False,
        fix: Mapping[str, Tensor] | None = None,
    ) -> dict[str, Tensor]:
        """See `DynamicalVAE.forecast`; at most as far as the networks' T frames.

        Raises:
            ValueError: other observed frames than the networks see, or a horizon beyond what they make.
        """
        x = super()._mapping(batch)[HISTORY]
        most = self.length - self.frames
        if x.shape[1] != self.frames or not 1 <= horizon <= most:
            raise ValueError(
                f"this model sees {self.frames} frames and makes up to {most} more, but was given {x.shape[1]} frames "
                f"and asked for {horizon}"
            )
        given = {name: torch.as_tensor(value).to(x) for name, value in (fix or {}).items()}
        for name in given.keys() & self.parts.keys():
            if given[name].shape != (len(x), most, self.sizes[name]):
                raise ValueError(
                    f"the fixed {name} has shape {tuple(given[name].shape)}; it must have all {most} frames, "
                    f"{(len(x), most, self.sizes[name])}"
                )
        heading = self.turned(x)[1]
        back = None if heading is None else -heading
        held = {name: self._rotated(v, back) if name in self.parts else v for name, v in given.items()}
        out = self._back(super().forecast(batch, most, samples, fix=held), heading)
        for name, value in given.items():  # turning there and back rounds
            out[name] = value.expand_as(out[name])
        out = self._with_whole(out)
        return {name: value[:, :, :horizon] if name in (WHOLE, *self.parts) else value for name, value in out.items()}

    @torch.no_grad()
    def sample(self, n: int = 1, length: int | None = None, batch: Batch | None = None) -> dict[str, Tensor]:
        """See `DynamicalVAE.sample`; the batch holds what was observed."""
        if batch is None:
            raise ValueError("this model goes on from a history; give it as batch")
        return self._back(super().sample(n, self.length if length is None else length, batch), self._heading(batch))

    @torch.no_grad()
    def reconstruct(self, batch: Batch, samples: int = 1) -> dict[str, Tensor]:
        """See `DynamicalVAE.reconstruct`."""
        return self._back(super().reconstruct(batch, samples), self._heading(batch))

    def _heading(self, batch: Batch) -> Tensor | None:
        return self.turned(super()._mapping(batch)[HISTORY])[1]

    def _back(self, values: dict[str, Tensor], heading: Tensor | None) -> dict[str, Tensor]:
        """Motion as the networks make it, turned back."""
        return {n: self._rotated(v, heading) if n in (WHOLE, *self.parts) else v for n, v in values.items()}

    def turned(self, x: Tensor) -> tuple[Tensor, Tensor | None]:
        """Windows (..., T, D) as the networks see them, and the headings (...) that they had; None if they stay."""
        return face_forward(x, self.skeleton, self.frames - 1) if self.method.heading else (x, None)

    def _rotated(self, x: Tensor, angle: Tensor | None) -> Tensor:
        """(..., B, T, D) turned about the up axis by (B,)."""
        if angle is None:
            return x
        joints = rotate_about_up(x.unflatten(-1, (-1, 3)), angle[:, None, None], self.skeleton.up)
        return joints.flatten(-2)


def _without_futures(batch: Any) -> Any:
    """The batch without the pseudo ground truths, which are no variables of the model."""
    return {n: v for n, v in batch.items() if n not in ("pseudo", "valid")} if isinstance(batch, Mapping) else batch


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


def _each(values: Sequence[Any] | None, parts: Sequence[str]) -> Sequence[Any]:
    """One value for each part, from one for all of them."""
    assert values is not None
    return tuple(values) * len(parts) if len(values) == 1 else values
