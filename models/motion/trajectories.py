"""What methods share that make motion from one pose and the paths that some joints are to take.

    s the first pose, y_{1:T} the given trajectories, r_{1:T} the other joints', x_{1:T} the motion

Poses are positions in metres relative to the first pelvis, so that the body moves through space; y and r are x with
zeros at the joints that are not theirs. In training, every joint of a window is given with probability `keep`, over all
its frames: so one model takes any number of trajectories.

Source: TrajeVAE (Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351), with what its public implementation does.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf, sqrt
from typing import Any, ClassVar

import numpy as np
import torch
from pyro import poutine
from torch import Tensor
from typing_extensions import override

from ...data.batch import WHOLE, Batch
from ...data.schema import Schema
from ...data.views import Past, View, Views
from ...distributions import FixedNormal, LawSpec
from ...inference.training.objectives import Evidence
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe
from ...inference.training.schedules import Piecewise
from ...motion import HUMAN36M, PROTOCOLS, Clip, Heading, Skeleton, Windows
from ...motion.control import bend
from ...motion.data.clips import defect
from ...motion.data.protocols import Poses
from ...options import Amount, Share, Size
from ...program.batch import CHUNK, AnyBatch, in_chunks, repeat, rows
from ...program.model import DynamicalVAE
from .poses import PoseMethod

FIRST, GIVEN, REST = "s", "y", "r"
NEEDED = "relative", 1
"""Root and number of observed frames of a protocol under which methods complete motion."""


@dataclass(frozen=True)
class TrajectoryMethod(PoseMethod):
    """A method that completes motion.

    Args:
        latent: size of the latent.
        keep: probability with which a joint is given, in training.
        rotate: turn every training window about the up axis by a uniform angle.
        heading: turn every window so that its first pose faces one way, and the motion back. Turned windows then have
            turned motions, exactly, and `rotate` changes nothing. None for not with Human3.6M's poses, as in the
            paper, where that is left to learn, and for so with others whose left and right are known.
    """

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {HUMAN36M.name: {"heading": False}, "": {"heading": True}}

    latent: Size | None = None
    keep: Share = 0.15
    rotate: bool = True
    heading: bool | None = None

    @override
    def preset(self, skeleton: Skeleton) -> Mapping[str, Any]:
        """Where left and right are unknown, so are headings."""
        found = super().preset(skeleton)
        return found if skeleton.left and skeleton.right else {**found, "heading": False}

    def beside(self) -> Paths:
        """What its models see beside the motion."""
        return Paths()

    def kind(self) -> type[TrajectoryModel]:
        """Of its models for poses."""
        return TrajectoryModel

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """The model for windows with a root and one observed frame.

        Of sizes alone it is one with the paper's options whose batches hold y, r and s, of the size of x, beside x.

        Raises:
            ValueError: windows without a root, or with more than one observed frame; no size of x.
        """
        schema = Schema.of(data)
        if not isinstance(schema, Poses):
            return self.filled(self.presets[HUMAN36M.name])._built(DynamicalVAE, schema.size(WHOLE))
        protocol = Poses.of(schema, self.name).protocol
        if (protocol.root, protocol.observed) != NEEDED:
            raise ValueError(
                f"{self.name} moves a body through space from one pose on, but the protocol {protocol.name} has "
                f"root={protocol.root!r} and {protocol.observed} observed frames; use one with root='relative' and "
                f"observed=1, such as {', '.join(n for n, p in PROTOCOLS.items() if (p.root, p.observed) == NEEDED)}"
            )
        return self.build_on(schema.skeleton, schema.frames - 1)

    def build_on(self, skeleton: Skeleton, frames: int | None = None) -> TrajectoryModel:
        """The model for poses of this skeleton, to be fitted to motions of T frames after the first pose."""
        method = self.filled(self.preset(skeleton))
        if method.heading:
            skeleton.heading(torch.zeros(skeleton.joints, 3))  # refuses one without left and right
        return method._built(method.kind(), 3 * skeleton.joints, method, skeleton, frames)

    def _built(self, kind: Any, size: int, *arguments: Any) -> Any:
        generative, inference = self.equations()
        names = {*generative.variables, *generative.context, *inference.context}
        poses = {name: size for name in (WHOLE, FIRST, GIVEN, REST) if name in names}
        return kind(*arguments, **self.described(poses))

    @override
    def train(self, train: Windows, validation: Windows | None = None, steps: int = 2000) -> Recipe:
        """Maximises the bound, on windows that are turned anyhow, with some paths given."""
        turned = train.with_protocol(replace(train.protocol, rotate=self.rotate))
        return Recipe(turned.given(self.keep), validation and validation.given(self.keep), [Stage(steps)])


@dataclass(frozen=True)
class LatentTrajectoryMethod(TrajectoryMethod):
    """A method that completes motion in many ways. The likelihood is the paper's squared error.

    Args:
        beta: weight of the KL, beside squared errors in square metres.
        complement: the guide sees the joints that are not given, and not the others.
    """

    trainings: ClassVar[Mapping[str, Training]] = {
        HUMAN36M.name: Training(
            240_000, 64, Piecewise(((0, 1e-4), (79_999, 1e-4), (80_000, 2.5e-5), (159_999, 2.5e-5), (160_000, 6.25e-6)))
        ),
        "": Training(24_000, 16, 5e-4, 0.8),
    }

    beta: Amount | None = None
    complement: bool = True

    @override
    def laws(self) -> Mapping[str, LawSpec]:
        """x is normal with variance 1/2, minus whose log-density is the squared error."""
        return {"p(x)": FixedNormal(scale=sqrt(0.5), error_weight=True)}

    @override
    def beside(self) -> Paths:
        return Rest(self.complement)

    @override
    def train(self, train: Windows, validation: Windows | None = None, steps: int = 2000) -> Recipe:
        """Minimises squared errors and the weighted KL, on such windows.

        The best weights are those of the lowest loss: beta is part of the model, which the bound does not know.
        """
        method: Any = self.suited(train)
        stages = [Stage(steps, Evidence(kl_weight=method.beta, select="loss"))]
        return replace(super().train(train, validation, steps), stages=stages)


class Paths(View):
    """Beside the motion, given trajectories; without any in a batch none are."""

    @override
    def __call__(self, data: Batch, beside: Batch | None = None) -> Batch:
        return Batch({GIVEN: torch.zeros_like(data[WHOLE]), **data}) if WHOLE in data else data


@dataclass(frozen=True)
class Rest(Paths):
    """Beside the motion, given trajectories and the joints that are not given.

    Args:
        complement: False for r that is all of x.
    """

    complement: bool

    @override
    def __call__(self, data: Batch, beside: Batch | None = None) -> Batch:
        if WHOLE not in data:
            return data
        seen, x = super().__call__(data, beside), data[WHOLE]
        if (mask := data.mask()) is not None:
            x = torch.where(mask, x, 0.0)
        return Batch({REST: torch.where(seen[GIVEN] == 0, x, 0.0) if self.complement else x, **seen})


class TrajectoryModel(DynamicalVAE):
    """A model of motion given its first pose and some trajectories.

    A batch holds either windows x (B, 1 + T, D), whose first frame is s, with y (B, 1 + T, D) if trajectories are
    given, or the variables themselves: s (B, D), y (B, T, D) and, to train, x and r.

    Its programs see windows turned if the method says so (`heading`); what else it returns is as the batch was.

    Args:
        method: with no option left open.
        skeleton: of the poses.
        frames: T of the motions that it is fitted to; None if that is not known.
        **options: of `DynamicalVAE`.
    """

    def __init__(self, method: TrajectoryMethod, skeleton: Skeleton, frames: int | None, **options: Any):
        seen: list[View] = [Past(FIRST, also=(GIVEN,)), method.beside()]
        if method.heading:
            seen.append(Heading(skeleton, pose=FIRST, turned=(FIRST, GIVEN, REST, WHOLE)))
        super().__init__(view=Views(*seen), **options)
        self.method, self.skeleton, self.frames = method, skeleton, frames

    @override
    def model(self, batch: AnyBatch | None = None, *, curriculum: float = 1.0, **options: Any) -> dict[str, Tensor]:
        """Without trajectories in the batch, none are given.

        Raises:
            ValueError: no pose to start from.
        """
        data = self.read(batch, curriculum=curriculum)
        if FIRST not in data:
            raise ValueError("a motion starts from a pose: give a batch with s (B, D), or with windows x (B, 1 + T, D)")
        first, length = data[FIRST], options.get("length")
        if GIVEN not in data and length is not None:
            data = data | {GIVEN: first.new_zeros(len(first), length, first.shape[-1])}
        return super().model(data, curriculum=curriculum, **options)

    @torch.no_grad()
    @override
    def forecast(
        self,
        batch: AnyBatch,
        horizon: int,
        samples: int = 1,
        *,
        draw_emission: bool | None = None,
        fix: Mapping[str, Tensor] | None = None,
        temperature: float = 1.0,
        chunk: int = CHUNK,
    ) -> dict[str, Tensor]:
        """Goes on from a pose, along the given trajectories if there are any.

        (Longer than other functions by what its arguments mean.)

        Of motions that are shorter than those the model was fitted to, it makes the whole, with joints at rest where
        their trajectories end, and gives the beginning: z has the length of the whole.

        Args:
            batch: x (B, 1, D) and, if trajectories are given, y (B, 1 + H, D) or longer; or s (B, D) and y (B, H, D).
            horizon: H.
            samples: S, motions for each pose.
            draw_emission: see `DynamicalVAE.forecast`.
            fix: nothing can be fixed; give trajectories.
            temperature: of the latent's scale: 0 for the motion of the prior's mean, in all samples the same.
            chunk: see `DynamicalVAE.forecast`.

        Returns:
            "x" (S, B, H, D) and the latents.

        Raises:
            ValueError: more than one observed frame, trajectories that end before the horizon or are not of the poses'
                size, or a temperature that is negative or not finite.
        """
        if fix:
            raise ValueError(f"cannot fix {', '.join(fix)}: what is known of a motion are its trajectories, in y")
        if horizon < 1 or samples < 1:
            raise ValueError(f"horizon and samples are at least 1, got {horizon} and {samples}")
        if not 0 <= temperature < inf:
            raise ValueError(f"temperature is {temperature}; it must be finite and at least 0")
        data = self.read(batch)
        if WHOLE in data or FIRST not in data:
            raise ValueError("a motion goes on from one pose: x (B, 1, D) or s (B, D)")
        data = self._whole(data, horizon)
        if self.frames is not None and horizon > self.frames:
            warnings.warn(
                f"this model was fitted to motions of {self.frames} frames, and knows little of {horizon}: ask for "
                "fewer, or fit it under a protocol that predicts so many",
                stacklevel=3,  # torch.no_grad is between
            )
        length = data[GIVEN].shape[1]
        draw_emission = self.is_drawn() if draw_emission is None else draw_emission
        distinct = samples if draw_emission or (temperature and self.latents) else 1

        def futures(part: slice, count: int) -> dict[str, Tensor]:
            some, latents = rows(data, part), {}
            for name in self.latents:  # the prior is evaluated once for all samples
                loc, scale = self.generator[name](some, len(some[FIRST]), length)
                noise = torch.randn(count, *loc.shape, dtype=loc.dtype, device=loc.device)
                latents[name] = torch.addcmul(loc, scale, noise, value=temperature).flatten(0, 1)
            program = poutine.condition(self.model, data=latents)
            out = program(repeat(some, count), length=length, mean_emission=not draw_emission)
            made = {name: out[name].unflatten(0, (count, -1)) for name in (WHOLE, *self.latents)}
            made[WHOLE] = made[WHOLE][:, :, :horizon]
            return self.shown(made, some)

        with self.running():
            out = in_chunks(futures, len(data[FIRST]), distinct, chunk)
        # Samples that are all the same are one: rows of one product may differ in their last bits.
        return out if distinct == samples else {name: value.repeat(samples, 1, 1, 1) for name, value in out.items()}

    def _whole(self, data: Batch, horizon: int) -> Batch:
        """The data, and trajectories over all frames that the networks are to make for a horizon.

        Raises:
            ValueError: trajectories that end before the horizon or are not of the poses' size.
        """
        first = data[FIRST]
        given = data.get(GIVEN, first.new_zeros(len(first), horizon, first.shape[-1]))
        if given.dim() != 3 or (len(given), given.shape[-1]) != first.shape:
            raise ValueError(
                f"beside poses {tuple(first.shape)} trajectories are of shape (B, frames, D); got {tuple(given.shape)}"
            )
        if given.shape[1] < horizon:
            raise ValueError(f"the trajectories have {given.shape[1]} frames, but {horizon} are asked for")
        if not given.isfinite().all():
            raise ValueError(
                "trajectories are finite, 0 at joints that are not given; `complete` takes paths with gaps"
            )
        made = max(horizon, self.frames or horizon)
        rest = given[:, -1:].expand(-1, max(made - given.shape[1], 0), -1)
        return data | {GIVEN: torch.cat([given[:, :made], rest], 1)}

    def complete(
        self,
        initial_pose: Any,
        trajectories: Mapping[str, Any] | None = None,
        frames: int | None = None,
        samples: int = 1,
        *,
        exact: bool = False,
        temperature: float = 1.0,
        steps: int = 400,
        progress: bool = False,
    ) -> Completion:
        """Motions that start at a pose and follow paths of some joints.

        (Longer than other functions by the arguments that it refuses.)

        The networks know of a path frame by frame. Where it has gaps they are told of a straight one across them, from
        the joint's place in the first pose on, and of a resting joint behind the last known frame. See `forecast` for
        motions of other lengths than those that the model was fitted to.

        Args:
            initial_pose: positions (J, 3) of all joints in metres, anywhere in the world.
            trajectories: joint to its path (T, 3) in metres in the same world, one frame after the pose first; a
                frame with a NaN is not known. A joint has its name in the skeleton, or one such as "left_wrist".
            frames: T; needed without trajectories.
            samples: S, motions.
            exact: have the given joints on their paths, by the most likely move of the latents and correction of the
                poses, with bones at their lengths; see `dvae.motion.control`. The completion has the corrections.
            temperature: of the latents' scales; 0 for the motion of the prior's mean.
            steps: of the optimiser, with `exact`.
            progress: whether to show a progress bar, with `exact`.

        Raises:
            ValueError: an unknown joint, a path of another length or without a known frame, positions that are not in
                metres, or an exact motion without a path.
        """
        pose = _numbers(initial_pose, "the initial pose")
        if pose.shape != (self.skeleton.joints, 3):
            raise ValueError(
                f"the initial pose has shape {tuple(pose.shape)}, expected ({self.skeleton.joints}, 3): "
                f"{', '.join(self.skeleton.names)}"
            )
        if lacking := [name for name, place in zip(self.skeleton.names, pose, strict=True) if place.isnan().any()]:
            raise ValueError(
                f"the initial pose lacks {', '.join(lacking)}, but motion starts at a whole one; take another window, "
                "or fill the gaps first (`dvae impute RUN --filled FILE`)"
            )
        if complaint := defect(Clip("initial", "pose", pose[None].numpy()), self.skeleton):
            raise ValueError(complaint.replace("clip initial/pose", "the initial pose"))
        given = trajectories or {}
        paths = {self.skeleton.find(joint): self._path(joint, path, pose) for joint, path in given.items()}
        if len(paths) < len(given):
            raise ValueError(f"the trajectories name a joint twice: {', '.join(given)}")
        lengths = {joint: len(path) for joint, path in zip(given, paths.values(), strict=True)}
        if frames is not None:
            lengths["frames"] = frames
        if len(set(lengths.values())) != 1 or min(lengths.values()) < 1:
            got = ", ".join(f"{name}: {length}" for name, length in lengths.items()) or "neither"
            raise ValueError(f"expected paths of one length, or frames= without any; got {got}")
        if exact and not paths:
            raise ValueError("exact=True has motions follow paths; give some trajectories")
        if exact and not self.latents:
            raise ValueError(
                f"exact=True has motions follow paths by a move of their latents, of which {self.method.name} has "
                "none; take a method with latents, such as trajevae"
            )
        length = next(iter(lengths.values()))
        world = pose[self.skeleton.root]
        told, known = pose.new_zeros(2, length, self.skeleton.joints, 3)
        for joint, path in paths.items():
            seen = path.isfinite().all(-1)
            told[:, joint] = _bridged(path, seen, pose[joint]) - world
            known[:, joint] = seen[:, None].double()
            if not told[:, joint].any():
                warnings.warn(
                    f"{self.skeleton.names[joint]} rests where the first pose has the root, which is how networks are "
                    "told of no path at all; exact=True holds it there",
                    stacklevel=2,
                )
        first = (pose - world).flatten()[None]
        parameter = next(self.parameters())
        data = {FIRST: first.to(parameter), GIVEN: told.flatten(1)[None].to(parameter)}
        out = self.forecast(data, length, samples, temperature=temperature)
        x, corrections = out[WHOLE][:, 0], None
        if exact:
            latents, known = out[self.latents[0]][:, 0], known.flatten(1).to(parameter)
            x, moved = self._followed(data, latents, known, steps=steps, progress=progress)
            corrections = moved[:, :length].cpu().double().unflatten(-1, (-1, 3)).norm(dim=-1).numpy()
        motion = x[:, :length].cpu().double().unflatten(-1, (-1, 3)) + world
        names = self.skeleton.names
        if exact:
            self._warn_of_stretching(motion, pose)
        errors = {names[joint]: (motion[:, :, joint] - path).norm(dim=-1).numpy() for joint, path in paths.items()}
        return Completion(self.skeleton, motion.numpy(), errors, corrections)

    def _path(self, joint: str, given: Any, pose: Tensor) -> Tensor:
        """A path as it was given, if it can be one."""
        path = _numbers(given, f"the path of {joint}")
        path[~path.isfinite()] = torch.nan
        if path.dim() != 2 or path.shape[-1] != 3:
            raise ValueError(f"the path of {joint} has shape {tuple(path.shape)}, expected (frames, 3) in metres")
        seen = path.isfinite().all(-1)
        if not seen.any():
            raise ValueError(f"the path of {joint} has no known frame; leave it out")
        frames = torch.cat([torch.tensor([-1]), seen.nonzero()[:, 0]])
        places = torch.cat([pose[None, self.skeleton.find(joint)], path[seen]])
        leaps = places.diff(dim=0).norm(dim=-1) / frames.diff()
        worst = int(leaps.argmax())
        if leaps[worst] > LEAP:
            what = (
                f"the path of {joint} moves by {leaps[worst]:.4g} m a frame before its frame {frames[worst + 1]} "
                f"(from {'the pose' if worst == 0 else f'frame {frames[worst]}'} on)"
            )
            if leaps[worst] > FAR:
                raise ValueError(f"{what}; paths are in metres, in the same world as the pose")
            warnings.warn(what, stacklevel=3)
        return path

    def _followed(
        self, batch: Mapping[str, Tensor], latents: Tensor, known: Tensor, **options: Any
    ) -> tuple[Tensor, Tensor]:
        """Motions (S, T, D) on the given paths where these are known, and their corrections."""
        data = self._whole(self.read(batch), len(known))
        known = torch.cat([known, known.new_zeros(data[GIVEN].shape[1] - len(known), known.shape[1])])
        bones = self.skeleton.limbs(data[FIRST][0]).norm(dim=-1)

        def means(z: Tensor) -> Tensor:
            rollout = self.rollout(data, data[GIVEN].shape[1])
            rollout.mean_emission = (WHOLE,)
            rollout.values[self.latents[0]] = z
            return rollout.draw(WHOLE)

        with self.running():
            with torch.no_grad():
                scale = self.generator[self.latents[0]](data, 1, len(known))[1]
            x, corrections = bend(means, latents, scale, data[GIVEN][0], known, self.skeleton, bones, **options)
        return self.shown({WHOLE: x}, data)[WHOLE], corrections

    def _warn_of_stretching(self, motion: Tensor, pose: Tensor) -> None:
        """Warns where more than one bone of twenty is more than a tenth too long or too short."""
        lengths, true = (self.skeleton.bone_lengths(positions.numpy()) for positions in (motion, pose))
        share = np.mean(np.abs(lengths - true) < 0.1 * true)
        if share < 0.95:
            warnings.warn(
                f"only {share:.1%} of the bones are within 10 % of their length; the paths may be out of reach for "
                "this body, or the model too little fitted",
                stacklevel=3,
            )


FAR, LEAP = 5.0, 0.5
"""Metres a frame: no joint moves so far, and one that moves so is odd."""


@dataclass(frozen=True, eq=False)
class Completion:
    """Motions along given paths.

    Args:
        skeleton: the tree.
        positions: (S, T, J, 3), metres, in the world of the pose and the paths.
        errors: joint to (S, T), metres between it and its path; NaN where that is not known.
        corrections: (S, T, J), metres by which exact motions are moved beyond what the decoder makes; else None.
    """

    skeleton: Skeleton
    positions: np.ndarray
    errors: Mapping[str, np.ndarray]
    corrections: np.ndarray | None = None

    def __str__(self) -> str:
        samples, frames = self.positions.shape[:2]
        lines = [f"{samples} motions of {frames} frames"]
        for joint, errors in self.errors.items():
            missed = errors[np.isfinite(errors)]
            near = f"within 1 cm in {np.mean(missed < 0.01):.0%} of frames"
            lines.append(f"  {joint}: off its path by {missed.mean():.3f} m (mean), {near}")
        if self.corrections is not None:
            moved = f"{self.corrections.mean():.3f} m (mean), {self.corrections.max():.3f} m at most"
            lines.append(f"  beyond what the model makes: joints corrected by {moved}")
        return "\n".join(lines)


def _numbers(given: Any, what: str) -> Tensor:
    """A copy of an array, in double precision."""
    try:
        return torch.tensor(np.array(given.detach().cpu() if isinstance(given, Tensor) else given, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} is no array of numbers: {error}") from error


def _bridged(path: Tensor, seen: Tensor, start: Tensor) -> Tensor:
    """The path (T, 3) without gaps: straight between known frames, from its start one frame before."""
    times = np.concatenate([[-1], seen.nonzero()[:, 0].numpy()])
    places = torch.cat([start[None], path[seen]]).numpy()
    now = np.arange(len(path))
    return torch.from_numpy(np.stack([np.interp(now, times, places[:, axis]) for axis in range(3)], axis=-1))
