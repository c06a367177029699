"""Base of the methods that complete a motion from one pose and given paths of some joints.

    s the first pose, y_{1:T} the given trajectories, r_{1:T} all other trajectories, x_{1:T} the motion

Poses are positions in metres relative to the first pelvis, so that the body moves through space. y and r are copies of
x with zeros at all other joints. In training, every joint of a window is given with probability `keep`, over all its
frames. One model therefore accepts any number of trajectories.

Source: TrajeVAE (Kania, Kowalski and Trzcinski, 2021, arXiv 2104.00351) and its public implementation.
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

from ...capture import defer
from ...data.batch import WHOLE, Batch
from ...data.schema import Schema
from ...data.views import Past, View, Views
from ...distributions import DistributionSpec, FixedNormal
from ...inference.training.objectives import Evidence
from ...inference.training.options import Stage, Training
from ...inference.training.recipe import Recipe
from ...inference.training.schedules import Piecewise
from ...motion import HUMAN36M, PROTOCOLS, Clip, Heading, Skeleton, Windows
from ...motion.control import follow_paths
from ...motion.data.clips import defect
from ...motion.data.protocols import Poses
from ...options import Amount, Share, Size
from ...program.batch import CHUNK, AnyBatch, in_chunks, repeat, rows
from ...program.model import DynamicalVAE
from .poses import PoseMethod

FIRST, GIVEN, REST = "s", "y", "r"
REQUIRED_PROTOCOL = "relative", 1
"""Root and number of observed frames that the protocol must have."""


@dataclass(frozen=True)
class TrajectoryMethod(PoseMethod):
    """A method that completes motion.

    Args:
        latent: size of the latent.
        keep: probability that a joint is given, in training.
        rotate: whether to rotate every training window about the up axis by a uniform angle; it has no effect if the
            protocol has `heading`, which fixes the direction.
        heading: whether to rotate every window so that its first pose faces one way, and rotate the motion back. The
            model is then exactly equivariant to rotations, and `rotate` has no effect. By default off for Human3.6M, as
            in the paper, where the network learns this from rotated windows, and on for other skeletons with known left
            and right.
    """

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {HUMAN36M.name: {"heading": False}, "": {"heading": True}}

    latent: Size | None = None
    keep: Share = 0.15
    rotate: bool = True
    heading: bool | None = None

    def extra_inputs(self) -> View:
        """Return the view (see `dvae.data.views`) that adds joint trajectories and the first pose to each window."""
        return Paths()

    def kind(self) -> type[TrajectoryModel]:
        """Return the class of the models for poses."""
        return TrajectoryModel

    @override
    def build(self, data: Any) -> DynamicalVAE:
        """Return the model for windows with a root and one observed frame.

        If `data` only gives sizes, the model has the paper's options, and its batches contain x, y, r and s, which all
        have the size of x.

        Raises:
            ValueError: if windows have no root or more than one observed frame, or the size of x is missing.
        """
        schema = Schema.of(data)
        if not isinstance(schema, Poses):
            return self.with_presets(self.presets[HUMAN36M.name])._build_model(DynamicalVAE, schema.size(WHOLE))
        protocol = Poses.of(schema, self.name).protocol
        if (protocol.root, protocol.observed) != REQUIRED_PROTOCOL:
            suitable = (name for name, other in PROTOCOLS.items() if (other.root, other.observed) == REQUIRED_PROTOCOL)
            raise ValueError(
                f"{self.name} moves a body through space from one pose, but the protocol {protocol.name} has "
                f"root={protocol.root!r} and {protocol.observed} observed frames; use a protocol with root='relative' "
                f"and observed=1, such as {', '.join(suitable)}"
            )
        return self.build_on(schema.skeleton, schema.frames - 1)

    def build_on(self, skeleton: Skeleton, frames: int | None = None) -> TrajectoryModel:
        """Return the model for poses of this skeleton, to fit to motions of T frames after the first pose."""
        method = self.with_presets(self.preset(skeleton))
        if method.heading:
            skeleton.heading(torch.zeros(skeleton.joints, 3))  # raises without left and right
        return method._build_model(method.kind(), 3 * skeleton.joints, method, skeleton, frames)

    def _build_model(self, kind: Any, size: int, *arguments: Any) -> Any:
        generative, inference = self.equations()
        names = {*generative.variables, *generative.context, *inference.context}
        poses = {name: size for name in (WHOLE, FIRST, GIVEN, REST) if name in names}
        return kind(*arguments, **self.model_arguments(poses))

    @override
    def train(self, train: Windows, validation: Windows | None = None, steps: int = 2000) -> Recipe:
        """Return one stage that maximises the bound, on windows with random rotations and given paths."""
        rotate = self.rotate and not train.protocol.heading
        windows = train.with_protocol(replace(train.protocol, rotate=rotate))
        return Recipe(windows.given(self.keep), validation and validation.given(self.keep), [Stage(steps)])


@dataclass(frozen=True)
class LatentTrajectoryMethod(TrajectoryMethod):
    """A method that completes motion in many ways. The likelihood is the paper's squared error.

    Args:
        beta: weight of the KL, relative to squared errors in square metres.
        complement: whether the guide reads only the joints that are not given; otherwise it reads all joints.
    """

    trainings: ClassVar[Mapping[str, Training]] = {
        HUMAN36M.name: Training(
            240_000,
            64,
            Piecewise(((0, 1e-4), (79_999, 1e-4), (80_000, 2.5e-5), (159_999, 2.5e-5), (160_000, 6.25e-6))),
            gradient_clip=None,
        ),
        "": Training(24_000, 16, 5e-4, 0.8),
    }

    beta: Amount | None = None
    complement: bool = True

    @override
    def distributions(self) -> Mapping[str, DistributionSpec]:
        """Return a normal distribution of x with variance 1/2, whose negative log-density is the squared error."""
        return {"p(x)": FixedNormal(scale=sqrt(0.5), error_weight=True)}

    @override
    def extra_inputs(self) -> View:
        return OtherJoints(self.complement)

    @override
    def train(self, train: Windows, validation: Windows | None = None, steps: int = 2000) -> Recipe:
        """Return one stage that minimises squared errors and the weighted KL, with windows as in `TrajectoryMethod`.

        The best weights are chosen by the loss, not by the bound, because the bound does not include beta.
        """
        method: Any = self.resolve_defaults(train)
        stages = [Stage(steps, Evidence(kl_weight=method.beta, select="loss"))]
        return replace(super().train(train, validation, steps), stages=stages)


class Paths(View):
    """A view that adds given trajectories to the motion; if a batch has none, no joint is given."""

    @override
    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        return Batch({GIVEN: torch.zeros_like(data[WHOLE]), **data}) if WHOLE in data else data


@dataclass(frozen=True)
class OtherJoints(Paths):
    """A view that adds given trajectories and the joints that are not given to the motion.

    Args:
        complement: whether r has zeros at the given joints; otherwise r is all of x.
    """

    complement: bool

    @override
    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        if WHOLE not in data:
            return data
        inputs, x = super().__call__(data, view_inputs), data[WHOLE]
        if (mask := data.mask()) is not None:
            x = torch.where(mask, x, 0.0)
        return Batch({REST: torch.where(inputs[GIVEN] == 0, x, 0.0) if self.complement else x, **inputs})


class TrajectoryModel(DynamicalVAE):
    """A model of motion given its first pose and some trajectories.

    A batch contains either windows x (B, 1 + T, D), whose first frame is s, with y (B, 1 + T, D) if trajectories are
    given, or the variables themselves: s (B, D), y (B, T, D) and, for training, x and r.

    With the option `heading`, the programs see rotated windows; all other results have the orientation of the batch.

    Args:
        method: method whose options are all resolved.
        skeleton: skeleton of the poses.
        frames: T, length of the motions that the model is fitted to; None if unknown.
        **options: arguments of `DynamicalVAE`.
    """

    def __init__(self, method: TrajectoryMethod, skeleton: Skeleton, frames: int | None, **options: Any):
        views: list[View] = [Past(FIRST, also=(GIVEN,)), method.extra_inputs()]
        if method.heading:
            views.append(Heading(skeleton, pose=FIRST, turned=(FIRST, GIVEN, REST, WHOLE)))
        super().__init__(view=Views(*views), **options)
        self.method, self.skeleton, self.frames = method, skeleton, frames

    @override
    def model(self, batch: AnyBatch | None = None, *, curriculum: float = 1.0, **options: Any) -> dict[str, Tensor]:
        """Run the generative program; if a batch has no trajectories, no joint is given.

        Raises:
            ValueError: if the batch has no initial pose.
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
        """Continue from a pose, along the given trajectories if there are any.

        If the horizon is shorter than the motions that the model was fitted to, it predicts a motion of their length
        and returns its beginning, because z has this length. Joints rest where their trajectories end.

        Args:
            batch: x (B, 1, D) and, if trajectories are given, y (B, 1 + H, D) or longer; or s (B, D) and y (B, H, D).
            horizon: H, number of frames to return.
            samples: S, number of motions for each pose.
            draw_emission: as in `DynamicalVAE.forecast`.
            fix: not supported; give trajectories instead.
            temperature: factor on the latents' scales; with 0 all samples are the motion of the prior's mean.
            chunk: as in `DynamicalVAE.forecast`.

        Returns:
            {"x": (S, B, H, D)} and the latents.

        Raises:
            ValueError: if there is more than one observed frame, trajectories end before the horizon or do not have the
                size of the poses, or the temperature is negative or not finite.
        """
        if fix:
            raise ValueError(f"cannot fix {', '.join(fix)}; give known parts of a motion as trajectories, in y")
        if horizon < 1 or samples < 1:
            raise ValueError(f"`horizon` and `samples` must be at least 1, got {horizon} and {samples}")
        if not 0 <= temperature < inf:
            raise ValueError(f"temperature is {temperature}; it must be finite and at least 0")
        data = self.read(batch)
        if WHOLE in data or FIRST not in data:
            raise ValueError("a motion starts from one pose; give a batch with x (B, 1, D) or s (B, D)")
        data = self._extend_paths(data, horizon)
        if self.frames is not None and horizon > self.frames:
            warnings.warn(
                f"this model was fitted to motions of {self.frames} frames, and may predict {horizon} frames badly; "
                f"reduce the horizon, or fit the model under a protocol with a horizon of {horizon} frames",
                stacklevel=3,  # torch.no_grad is between
            )
        length = data[GIVEN].shape[1]
        draw_emission = self.is_drawn() if draw_emission is None else draw_emission
        distinct = samples if draw_emission or (temperature and self.latents) else 1

        def futures(part: slice, count: int) -> dict[str, Tensor]:
            inputs, latents = rows(data, part), {}
            for name in self.latents:  # evaluated once for all samples
                loc, scale = self._test_time(name)(inputs, len(inputs[FIRST]), length)
                noise = torch.randn(count, *loc.shape, dtype=loc.dtype, device=loc.device)
                latents[name] = torch.addcmul(loc, scale, noise, value=temperature).flatten(0, 1)
            program = poutine.condition(self.model, data=latents)
            out = program(repeat(inputs, count), length=length, mean_emission=not draw_emission)
            values = {name: out[name].unflatten(0, (count, -1)) for name in (WHOLE, *self.latents)}
            values[WHOLE] = values[WHOLE][:, :, :horizon]
            return self.to_data_space(values, inputs)

        with self.running():
            out = in_chunks(futures, len(data[FIRST]), distinct, chunk)
        # Equal samples are copies of one, because rows of one matrix product may differ in their last bits.
        return out if distinct == samples else {name: value.repeat(samples, 1, 1, 1) for name, value in out.items()}

    def _test_time(self, name: str) -> Any:
        """Return the distribution of a latent in forecasts: the guide if it reads only s and y, otherwise the prior."""
        is_given = {parent.name for parent in self.inference.factor(name).parents} <= {FIRST, GIVEN}
        return (self.encoder if is_given else self.generator)[name]

    def _extend_paths(self, data: Batch, horizon: int) -> Batch:
        """Return the data with trajectories over all frames that the networks predict for a horizon.

        Args:
            data: batch as returned by `read`, with the first pose (B, D).
            horizon: H, number of frames that are requested.

        Raises:
            ValueError: if trajectories end before the horizon or do not have the size of the poses.
        """
        first = data[FIRST]
        trajectories = data.get(GIVEN, first.new_zeros(len(first), horizon, first.shape[-1]))
        if trajectories.dim() != 3 or (len(trajectories), trajectories.shape[-1]) != first.shape:
            raise ValueError(
                f"trajectories have shape {tuple(trajectories.shape)}; expected (B, frames, D) with B and D of "
                f"the first poses, {tuple(first.shape)}"
            )
        if trajectories.shape[1] < horizon:
            raise ValueError(f"the trajectories have {trajectories.shape[1]} frames, but the horizon is {horizon}")
        if not defer(failed := ~trajectories.isfinite().all()) and failed:
            raise ValueError(
                "trajectories must be finite, and 0 at joints that are not given; `complete` accepts paths "
                "with missing frames"
            )
        length = max(horizon, self.frames or horizon)
        tail = trajectories[:, -1:].expand(-1, max(length - trajectories.shape[1], 0), -1)
        return data | {GIVEN: torch.cat([trajectories[:, :length], tail], 1)}

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
        """Return motions that start at a pose and follow paths of some joints.

        Missing frames of a path are interpolated linearly, starting from the joint's position in the first pose. After
        the last known frame the joint rests. `forecast` describes motions of other lengths than the model was fitted
        to.

        Args:
            initial_pose: positions (J, 3) of all joints, in metres, in world coordinates.
            trajectories: mapping from joint to path (T, 3), in metres, in the same coordinates. The first frame follows
                the pose; a frame with a NaN is missing. Joints are named as in the skeleton, or by a common name such
                as "left_wrist".
            frames: T, number of frames; required without trajectories.
            samples: S, number of motions.
            exact: whether to put the given joints exactly on their paths, with the most likely change of the latents
                and a correction of the poses that keeps bone lengths; see `dvae.motion.control`. The completion
                contains the corrections.
            temperature: factor on the latents' scales; 0 for the motion of the prior's mean.
            steps: steps of the optimiser, with `exact`.
            progress: whether to show a progress bar, with `exact`.

        Raises:
            ValueError: if a joint is unknown, a path has another length or no known frame, positions are not in metres,
                or `exact` is given without a path.
        """
        pose = _to_numbers(initial_pose, "the initial pose")
        if pose.shape != (self.skeleton.joints, 3):
            raise ValueError(
                f"the initial pose has shape {tuple(pose.shape)}, expected ({self.skeleton.joints}, 3): "
                f"{', '.join(self.skeleton.names)}"
            )
        if missing := [
            name for name, position in zip(self.skeleton.names, pose, strict=True) if position.isnan().any()
        ]:
            raise ValueError(
                f"the initial pose has no positions of {', '.join(missing)}, but must be complete; choose another "
                "window, or fill them in first (`dvae impute RUN --filled FILE`)"
            )
        if problem := defect(Clip("initial", "pose", pose[None].numpy()), self.skeleton):
            raise ValueError(problem.replace("clip initial/pose", "the initial pose"))
        named_paths = trajectories or {}
        paths = {self.skeleton.find(joint): self._check_path(joint, path, pose) for joint, path in named_paths.items()}
        if len(paths) < len(named_paths):
            raise ValueError(f"the trajectories name a joint twice: {', '.join(named_paths)}")
        lengths = {joint: len(path) for joint, path in zip(named_paths, paths.values(), strict=True)}
        if frames is not None:
            lengths["frames"] = frames
        if len(set(lengths.values())) != 1 or min(lengths.values()) < 1:
            lengths_text = ", ".join(f"{name}: {length}" for name, length in lengths.items()) or "neither"
            raise ValueError(f"expected paths of equal length, or `frames` without paths; got {lengths_text}")
        if exact and not paths:
            raise ValueError("exact=True makes motions follow paths, but got no path; give trajectories")
        if exact and not self.latents:
            raise ValueError(
                f"exact=True makes motions follow paths by a change of their latents, but {self.method.name} has no "
                "latents; use a method with latents, such as trajevae"
            )
        length = next(iter(lengths.values()))
        world = pose[self.skeleton.root]
        targets, known_mask = pose.new_zeros(2, length, self.skeleton.joints, 3)
        for joint, path in paths.items():
            is_known = path.isfinite().all(-1)
            targets[:, joint] = _interpolate(path, is_known, pose[joint]) - world
            known_mask[:, joint] = is_known[:, None].double()
            if not targets[:, joint].any():
                warnings.warn(
                    f"the path of {self.skeleton.names[joint]} stays at the root of the first pose, where its input "
                    "is 0, so networks treat it as a joint without a path; exact=True keeps the joint there",
                    stacklevel=2,
                )
        first = (pose - world).flatten()[None]
        parameter = next(self.parameters())
        data = {FIRST: first.to(parameter), GIVEN: targets.flatten(1)[None].to(parameter)}
        out = self.forecast(data, length, samples, temperature=temperature)
        x, corrections = out[WHOLE][:, 0], None
        if exact:
            latents, known_mask = out[self.latents[0]][:, 0], known_mask.flatten(1).to(parameter)
            x, shifts = self._follow(data, latents, known_mask, steps=steps, progress=progress)
            corrections = shifts[:, :length].cpu().double().unflatten(-1, (-1, 3)).norm(dim=-1).numpy()
        motion = x[:, :length].cpu().double().unflatten(-1, (-1, 3)) + world
        names = self.skeleton.names
        if exact:
            self._warn_about_bones(motion, pose)
        errors = {names[joint]: (motion[:, :, joint] - path).norm(dim=-1).numpy() for joint, path in paths.items()}
        return Completion(self.skeleton, motion.numpy(), errors, corrections)

    def _check_path(self, joint: str, values: Any, pose: Tensor) -> Tensor:
        """Return a path as float64, with NaN at all coordinates that are not finite.

        Raises:
            ValueError: if the path has another shape, no known frame, or moves implausibly fast.
        """
        path = _to_numbers(values, f"the path of {joint}")
        path[~path.isfinite()] = torch.nan
        if path.dim() != 2 or path.shape[-1] != 3:
            raise ValueError(f"the path of {joint} has shape {tuple(path.shape)}, expected (frames, 3) in metres")
        is_known = path.isfinite().all(-1)
        if not is_known.any():
            raise ValueError(f"the path of {joint} has no known frame; leave it out")
        frames = torch.cat([torch.tensor([-1]), is_known.nonzero()[:, 0]])
        positions = torch.cat([pose[None, self.skeleton.find(joint)], path[is_known]])
        leaps = positions.diff(dim=0).norm(dim=-1) / frames.diff()
        worst = int(leaps.argmax())
        if leaps[worst] > LEAP:
            message = (
                f"the path of {joint} moves by {leaps[worst]:.4g} m per frame from "
                f"{'the pose' if worst == 0 else f'its frame {frames[worst]}'} to its frame {frames[worst + 1]}"
            )
            if leaps[worst] > FAR:
                raise ValueError(f"{message}; paths must be in metres, in the same coordinates as the pose")
            warnings.warn(message, stacklevel=3)
        return path

    def _follow(
        self, batch: Mapping[str, Tensor], latents: Tensor, known_mask: Tensor, **options: Any
    ) -> tuple[Tensor, Tensor]:
        """Return motions (S, T, D) that are on the given paths at known frames, and their corrections (S, T, D).

        Args:
            batch: first pose and trajectories, with one row.
            latents: initial values of the latents of S motions.
            known_mask: (T, D), 1 where a coordinate is given, otherwise 0.
            **options: options of `dvae.motion.control.follow_paths`.
        """
        data = self._extend_paths(self.read(batch), len(known_mask))
        known_mask = torch.cat(
            [known_mask, known_mask.new_zeros(data[GIVEN].shape[1] - len(known_mask), known_mask.shape[1])]
        )
        bones = self.skeleton.limbs(data[FIRST][0]).norm(dim=-1)

        def means(z: Tensor) -> Tensor:
            rollout = self.rollout(data, data[GIVEN].shape[1])
            rollout.mean_emission = (WHOLE,)
            rollout.values[self.latents[0]] = z
            return rollout.draw(WHOLE)

        with self.running():
            with torch.no_grad():
                scale = self._test_time(self.latents[0])(data, 1, len(known_mask))[1]
            x, corrections = follow_paths(
                means, latents, scale, data[GIVEN][0], known_mask, self.skeleton, bones, **options
            )
        return self.to_data_space({WHOLE: x}, data)[WHOLE], corrections

    def _warn_about_bones(self, motion: Tensor, pose: Tensor) -> None:
        """Warn if more than 5 % of the bones are more than 10 % too long or too short."""
        lengths, true = (self.skeleton.bone_lengths(positions.numpy()) for positions in (motion, pose))
        share = np.mean(np.abs(lengths - true) < 0.1 * true)
        if share < 0.95:
            warnings.warn(
                f"only {share:.1%} of the bones are within 10 % of their length; the body may not reach the paths, or "
                "the model needs more training",
                stacklevel=3,
            )


FAR, LEAP = 5.0, 0.5
"""Metres per frame: no joint moves farther than `FAR`, and a joint that moves farther than `LEAP` is suspicious."""


@dataclass(frozen=True, eq=False)
class Completion:
    """Motions along given paths.

    Args:
        skeleton: skeleton of the positions.
        positions: (S, T, J, 3), in metres, in the coordinates of the pose and the paths.
        errors: mapping from joint to its distance from its path, (S, T), in metres; NaN at missing frames.
        corrections: (S, T, J), distances between exact motions and the decoder's output, in metres; otherwise None.
    """

    skeleton: Skeleton
    positions: np.ndarray
    errors: Mapping[str, np.ndarray]
    corrections: np.ndarray | None = None

    def __str__(self) -> str:
        samples, frames = self.positions.shape[:2]
        lines = [f"{samples} motions of {frames} frames"]
        for joint, errors in self.errors.items():
            known_errors = errors[np.isfinite(errors)]
            share = f"within 1 cm in {np.mean(known_errors < 0.01):.0%} of frames"
            lines.append(f"  {joint}: off its path by {known_errors.mean():.3f} m (mean), {share}")
        if self.corrections is not None:
            distances = f"{self.corrections.mean():.3f} m (mean), {self.corrections.max():.3f} m at most"
            lines.append(f"  beyond what the model makes: joints corrected by {distances}")
        return "\n".join(lines)


def _to_numbers(values: Any, name: str) -> Tensor:
    """Return a copy of an array, in double precision."""
    try:
        return torch.tensor(np.array(values.detach().cpu() if isinstance(values, Tensor) else values, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is not an array of numbers: {error}") from error


def _interpolate(path: Tensor, is_known: Tensor, start: Tensor) -> Tensor:
    """Return the path (T, 3), interpolated linearly between known frames, from `start` one frame before it."""
    times = np.concatenate([[-1], is_known.nonzero()[:, 0].numpy()])
    positions = torch.cat([start[None], path[is_known]]).numpy()
    frames = np.arange(len(path))
    return torch.from_numpy(np.stack([np.interp(frames, times, positions[:, axis]) for axis in range(3)], axis=-1))
