"""Views of motion: fixed headings, bones of constant length, rotations instead of positions, and the root's travel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from typing_extensions import override

from ...constants import constant, indices
from ...data.batch import WHOLE, Batch
from ...data.views import View
from ...networks.loop import valid_steps
from . import kinematics
from .rotations import continuous, from_matrix, in_time, size, to_matrix
from .skeleton import Skeleton, inverse_lengths, rotate_about_up

HEADING = "heading"
"""Name in batches of the angles (B,) by which windows were rotated, in radians."""
LENGTHS = "bone_lengths"
"""Name in batches of the bone lengths (B, J - 1) of windows, in metres, in the order of `Skeleton.edges`."""
START = "travel_start"
"""Name in batches of the root one frame before x, (B, 4): position with the height of frame 0, and heading."""
ROTATIONS = "rotations"
"""Name in `Batch.view_inputs` of the rotations (B, T, 4 J) of all joints, as concatenated quaternions w x y z."""


@dataclass(frozen=True)
class Heading(View):
    """Windows rotated about the up axis so that one of their poses has heading zero.

    A rotation preserves volumes, lengths and angles. The heading itself is not modelled, so bounds are bounds of the
    rotated windows. Compare them only with models that rotate windows by the heading of the same pose.

    Missing values stay missing. The two horizontal coordinates of a joint must be both observed or both missing,
    because a rotation mixes them. If hips or shoulders are missing in the pose, the heading comes from the nearest
    earlier pose that has some of them (`Skeleton.heading_near`). Without such a pose, the window is not rotated, and
    neither is its past in a forecast.

    Args:
        skeleton: skeleton with left and right joints.
        frames: number of frames O; the pose is frame O of x, or the last frame of a shorter window.
        pose: name of a variable (B, D) that is the pose; None for a frame of x.
        turned: names of the variables to rotate, (..., B, T, D) with D = 3 J, or 3 (J - 1) without the root at the
            origin.
    """

    skeleton: Skeleton
    frames: int = 1
    pose: str | None = None
    turned: tuple[str, ...] = (WHOLE,)
    names = (HEADING,)

    @override
    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        source = self.pose or WHOLE
        heading = None if view_inputs is None else view_inputs.get(HEADING)
        if HEADING in data or (source not in data if view_inputs is None else heading is None):
            return data
        values = Batch(data)
        for name, mask in data.masks().items():
            if name in self.turned and name in data:
                self._check_mask(name, mask)
                values[name] = torch.where(mask, data[name], 0.0)
        if heading is None:
            if self.pose is None and data.lengths is not None:
                shortest, required = data.lengths.min(), min(self.frames, data[WHOLE].shape[-2])
                if shortest < required:
                    raise ValueError(
                        f"this model rotates every window by the heading in frame {required}, but a sequence has only "
                        f"{shortest} frames; remove the sequence, or fit with heading=False"
                    )
            heading = self._observed_heading(values)
        return self._rotate_all(values, -heading) | {HEADING: heading}

    @override
    def inverse(self, model_values: Batch) -> Batch:
        data = Batch(model_values)
        heading = data.pop(HEADING, None)
        return data if heading is None else self._rotate_all(data, heading)

    def of(self, x: Tensor) -> Tensor:
        """Return headings (...) in radians of windows (..., T, D), or of poses (..., D) if `pose` is set.

        Coordinates of unobserved joints are NaN.

        Args:
            x: windows (..., T, D), or poses (..., D), in metres.

        Raises:
            ValueError: D does not match the skeleton.
        """
        frames = x[..., None, :] if self.pose else x
        return self.skeleton.heading_near(self._joints(frames), min(self.frames, frames.shape[-2]) - 1)

    def face(self, x: Tensor) -> Tensor:
        """Return windows (..., T, D), each rotated to heading zero.

        Args:
            x: windows (..., T, D) in metres.
        """
        return self._rotate(x, -self.of(x), 2)

    def _rotate_all(self, values: Batch, angle: Tensor) -> Batch:
        rotated = {n: self._rotate(values[n], angle, 2 - (n == self.pose)) for n in self.turned if n in values}
        return values | rotated

    def _rotate(self, x: Tensor, angle: Tensor, dims: int) -> Tensor:
        return rotate_about_up(x.unflatten(-1, (-1, 3)), angle[(..., *[None] * dims)], self.skeleton.up).flatten(-2)

    def _observed_heading(self, data: Batch) -> Tensor:
        """Return headings (B,) in radians, computed from observed values only."""
        source = self.pose or WHOLE
        x, mask = data[source], data.mask(source)
        return self.of(x if mask is None else torch.where(mask, x, torch.nan))

    def _joints(self, poses: Tensor) -> Tensor:
        """Return joints (..., J, 3) of poses (..., D), adding a dropped root at the origin."""
        sizes = 3 * self.skeleton.joints, 3 * self.skeleton.joints - 3
        if poses.shape[-1] not in sizes:
            raise ValueError(
                f"{self.pose or WHOLE} has shape {tuple(poses.shape)}, but poses of the skeleton "
                f"{self.skeleton.name!r} have {sizes[0]} coordinates, or {sizes[1]} without the root"
            )
        return self.skeleton.with_root(poses.unflatten(-1, (-1, 3)))

    def _check_mask(self, name: str, mask: Tensor) -> None:
        """Raise an error if a joint has only one observed horizontal coordinate."""
        skeleton, joints = self.skeleton, mask.unflatten(-1, (-1, 3))
        across = [axis for axis in range(3) if axis != skeleton.vertical]
        mixed = joints[..., across[0]] != joints[..., across[1]]
        if mixed.any():
            window, *_, joint = mixed.nonzero()[0].tolist()
            names = [
                n for j, n in enumerate(skeleton.names) if j != skeleton.root or mixed.shape[-1] == skeleton.joints
            ]
            raise ValueError(
                f"window {window} is missing only one of the two horizontal coordinates of {names[joint]}, but this "
                "model rotates windows, which mixes both; mark both as missing in 'mask', or fit with heading=False"
            )


@dataclass(frozen=True)
class Bones(View):
    """Unit vectors along the bones instead of positions; the inverse restores the observed bone lengths.

    The direction of the bone that ends at a joint replaces the coordinates of this joint. If x contains the root, its
    coordinates are not changed. The inverse rescales any output of the model to the bone lengths, so that they are
    correct by construction.

    This view is not a bijection. Lengths are given, one per bone and window, so their variation within a window is
    lost. A direction has two degrees of freedom in three numbers, so a density of directions does not define one of
    positions, and `log_det` raises an error. Use this view for models whose x is a function of its parents, as with
    `distributions.Directions`. They are trained by energies instead of bounds.

    Args:
        skeleton: skeleton of the poses.
        frames: number of frames O; lengths are means over the first O frames, or over all frames if there are fewer.
        pieces: {name: indices of coordinates of x}, for parts of x that batches and forecasts contain as variables of
            their own, in positions.
    """

    skeleton: Skeleton
    frames: int = 1
    pieces: Mapping[str, Sequence[int]] = field(default_factory=dict)
    names = (LENGTHS,)

    @override
    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        pieces = {name: places for name, places in self.pieces.items() if name in data}
        if LENGTHS in data or (WHOLE not in data and not pieces):
            return data
        self._check_complete(data)
        x = data[WHOLE] if WHOLE in data else self._assemble(data, pieces)
        limbs = self.skeleton.limbs(x)
        directions = self._with_root(limbs * inverse_lengths(limbs)[..., None], x)
        values = self._replace_x(data, directions)
        if view_inputs is not None:
            return values
        return values | {LENGTHS: self._mean_lengths(limbs[:, : self.frames].norm(dim=-1), data.lengths)}

    @override
    def inverse(self, model_values: Batch) -> Batch:
        data = Batch(model_values)
        lengths = data.pop(LENGTHS, None)
        if lengths is None or WHOLE not in data:
            return data
        directions = data[WHOLE].unflatten(-1, (-1, 3))
        has_root = directions.shape[-2] == self.skeleton.joints
        bones = self.skeleton.without_root(directions) if has_root else directions
        bones = bones * (inverse_lengths(bones) * lengths[:, None])[..., None]
        joints = self.skeleton.ends(bones).unflatten(-1, (-1, 3))
        if has_root:
            joints = joints + directions[..., self.skeleton.root, None, :]
        return self._replace_x(data, self._with_root(joints, data[WHOLE]))

    def with_lengths(self, x: Tensor, like: Tensor) -> Tensor:
        """Return poses x (K, B, T, D) with the mean bone lengths of other poses (B, O, D)."""
        lengths = self.skeleton.limbs(like).norm(dim=-1).mean(1)
        limbs = self.skeleton.limbs(x)
        directions = self._with_root(limbs * inverse_lengths(limbs)[..., None], x)
        return torch.stack([self.inverse(Batch({WHOLE: each, LENGTHS: lengths}))[WHOLE] for each in directions])

    @override
    def log_det(self, data: Batch) -> Tensor:
        raise ValueError(
            "a model that sees the directions of bones has no density of positions: lengths are given, and a direction "
            "has two degrees of freedom in three numbers. Make x a function of its parents with "
            "distributions.Directions() and train by energies, or fit with bones=False"
        )

    def _with_root(self, joints: Tensor, x: Tensor) -> Tensor:
        """Flatten values (..., J - 1, 3) of all joints except the root to (..., D), and insert the root of x if any."""
        if x.shape[-1] == 3 * self.skeleton.joints:
            root = self.skeleton.root
            root_position = x.unflatten(-1, (-1, 3))[..., root : root + 1, :]
            joints = torch.cat([joints[..., :root, :], root_position, joints[..., root:, :]], -2)
        return joints.flatten(-2)

    def _replace_x(self, values: Batch, x: Tensor) -> Batch:
        """Return the values with x and its pieces replaced."""
        pieces = {name: x[..., list(places)] for name, places in self.pieces.items() if name in values}
        return values | pieces | ({WHOLE: x} if WHOLE in values else {})

    def _assemble(self, data: Batch, pieces: Mapping[str, Sequence[int]]) -> Tensor:
        """Return x assembled from pieces, 0 elsewhere.

        Raises:
            ValueError: the parent of a joint is neither the root nor in a piece.
        """
        size = 1 + max(index for places in self.pieces.values() for index in places)
        joints = [j for j in range(self.skeleton.joints) if j != self.skeleton.root or size == 3 * self.skeleton.joints]
        known_joints = {joints[index // 3] for places in pieces.values() for index in places} | {self.skeleton.root}
        if undetermined := [
            joint for joint in known_joints - {self.skeleton.root} if self.skeleton.parents[joint] not in known_joints
        ]:
            names, parent = self.skeleton.names, self.skeleton.parents[undetermined[0]]
            raise ValueError(
                f"this model sees the directions of bones, but {', '.join(pieces)} alone does not determine the "
                f"direction of {names[undetermined[0]]}, whose parent is {names[parent]}; also give the part that "
                f"contains {names[parent]}"
            )
        first_piece: Tensor = data[next(iter(pieces))]
        x = first_piece.new_zeros(*first_piece.shape[:-1], size)
        for name, places in pieces.items():
            x[..., list(places)] = data[name]
        return x

    def _mean_lengths(self, lengths: Tensor, steps: Tensor | None) -> Tensor:
        """Average lengths (B, O, J - 1) to (B, J - 1) over the frames that are not padding."""
        if steps is None:
            return lengths.mean(1)
        valid = valid_steps(steps, lengths.shape[1])[..., None]
        mean: Tensor = (lengths * valid).sum(1) / valid.sum(1)
        return mean

    def _check_complete(self, data: Batch) -> None:
        for name, mask in data.masks().items():
            if name in (WHOLE, *self.pieces) and not mask.all():
                window, frame, *_ = (~mask).nonzero()[0].tolist()
                raise ValueError(
                    f"window {window} has missing entries in frame {frame + 1}, but this model sees the directions of "
                    "bones, which need both ends; impute these entries first, or fit with bones=False"
                )


@dataclass(frozen=True)
class Rotations(View):
    """Joint rotations instead of positions, and bones of constant length.

    Outside the model, x is positions (B, T, D) in metres. The model sees the position of the root, if x has it, and
    then the rotation of every joint with children, in `form` and without jumps (`rotations.in_time`). Rotations come
    from the data if these contain them, and otherwise from `kinematics.inverse`, which also estimates the rotation of a
    bone about itself. Each bone has its mean length in the window, or its length in the rest pose if no data are given.

    Densities are densities of these numbers, not of positions, since the conversion changes volumes and the number of
    degrees of freedom. Compare bounds only with models that use the same view.

    Args:
        skeleton: skeleton with a rest pose.
        form: form of the rotations: "6d", "quaternion" or "vector", in which all values are valid rotations; see
            `dvae.motion.geometry.rotations`.
        root: whether x has the root, D = 3 J; otherwise the root is the origin, and D = 3 (J - 1).

    Raises:
        ValueError: the form is unknown, or the skeleton has no rest pose.
    """

    skeleton: Skeleton
    form: str = "6d"
    root: bool = False
    names = (LENGTHS,)
    _offsets: tuple[tuple[float, ...], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        size(self.form)
        offsets = self.skeleton.offsets  # raises an error that explains how to get a rest pose
        object.__setattr__(self, "_offsets", tuple(map(tuple, offsets.tolist())))

    @property
    def measured(self) -> str:  # type: ignore[override]
        """Name of the values that densities refer to."""
        return f"joint rotations ({self.form})"

    @property
    def turning(self) -> list[int]:
        """Indices of the joints with children; the rotation of any other joint changes no position."""
        return sorted({parent for parent, _ in self.skeleton.edges})

    @property
    def size(self) -> int:
        """Number of values per frame that the model sees."""
        return 3 * self.root + size(self.form) * len(self.turning)

    @override
    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        converted = Batch(data)
        if WHOLE not in data or LENGTHS in data:
            return converted
        x, skeleton = data[WHOLE], self.skeleton
        if x.shape[-1] != 3 * (skeleton.joints - (not self.root)):
            raise ValueError(
                f"x has shape {tuple(x.shape)}, but positions of the skeleton {skeleton.name!r} have "
                f"{3 * (skeleton.joints - (not self.root))} numbers in the last dimension, for root={self.root}"
            )
        if data.mask() is not None:
            raise ValueError(
                "a missing joint leaves the rotations of others undetermined; fit under a protocol whose "
                "representation is positions, which may be masked"
            )
        positions = skeleton.with_root(x.unflatten(-1, (-1, 3)))
        quaternions = data.view_inputs.get(ROTATIONS)
        if quaternions is None:
            matrices = kinematics.inverse(skeleton, positions, constant(self._offsets, x))[..., self.turning, :, :]
            rotations = in_time(matrices, self.form)
        else:
            quaternions = quaternions[:, : x.shape[1]].unflatten(-1, (-1, 4))  # a past uses only its own frames
            rotations = in_time(
                quaternions.index_select(-2, indices(self.turning, quaternions)).to(x), self.form, "quaternion"
            )
        root = [positions[..., skeleton.root, :]] if self.root else []
        converted[WHOLE] = torch.cat([*root, rotations.flatten(-2)], -1)
        converted[LENGTHS] = (view_inputs or Batch()).get(LENGTHS, skeleton.bone_lengths(positions).mean(-2))
        return converted

    @override
    def inverse(self, model_values: Batch) -> Batch:
        data = Batch(model_values)
        bones = data.pop(LENGTHS, None)
        if WHOLE not in model_values:
            return data
        x, skeleton = model_values[WHOLE], self.skeleton
        offsets = constant(self._offsets, x)
        if bones is not None:
            children = [child for _, child in skeleton.edges]
            lengths = bones.new_zeros(*bones.shape[:-1], skeleton.joints)
            lengths = lengths.index_copy(-1, indices(children, bones), bones)
            offsets = lengths[..., None, :, None] * torch.nn.functional.normalize(offsets, dim=-1)  # (B, 1, J, 3)
        root = x[..., :3] if self.root else torch.zeros_like(x[..., :3])
        rotations = torch.eye(3, dtype=x.dtype, device=x.device).repeat(*x.shape[:-1], skeleton.joints, 1, 1)
        known_rotations = to_matrix(x[..., 3 * self.root :].unflatten(-1, (len(self.turning), -1)), self.form)
        rotations = rotations.index_copy(-3, indices(self.turning, rotations), known_rotations)
        positions, _ = kinematics.forward(skeleton.parents, rotations, offsets, root)
        return data | {WHOLE: (positions if self.root else skeleton.without_root(positions)).flatten(-2)}


@dataclass(frozen=True)
class Travel(View):
    """The root's velocities, and poses relative to the root and its heading, instead of positions in the world.

    Outside the model, x is positions (B, T, 3 J) in metres. The model sees the root's horizontal velocity relative to
    the heading of the previous frame (metres per second), its height above the first frame (metres) and the rate of
    the heading (radians per second). Then follow the other joints, relative to the root and rotated to heading zero.
    Values do not depend on the position and heading of the window. The inverse adds up velocities from the last frame
    of the past, or from the origin if no data are given.

    The first frame has no predecessor and repeats the velocities of the second. Densities are densities of these
    numbers, not of positions, because there is one number more than x has.

    Args:
        skeleton: skeleton of the poses; with a rest pose for rotations. Without left and right joints, the heading is
            the direction between the first two siblings with subtrees of the same shape. Without these, it is 0 in
            every frame, and velocities and poses keep the axes of the data.
        form: "positions" of the other joints, or a form of `Rotations`.

    Raises:
        ValueError: the form is unknown, or it is a rotation and the skeleton has no rest pose.
    """

    skeleton: Skeleton
    form: str = "positions"
    names = (START, LENGTHS)
    _pose: View = field(init=False, repr=False, compare=False)
    _sides: Skeleton | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        pose, skeleton = View() if self.form == "positions" else Rotations(self.skeleton, self.form), self.skeleton
        if not (skeleton.left and skeleton.right):
            skeleton = replace(skeleton, left=(pair := _alike_siblings(skeleton))[:1], right=pair[1:])
        object.__setattr__(self, "_pose", pose)
        object.__setattr__(self, "_sides", skeleton if skeleton.left else None)

    @property
    def measured(self) -> str:  # type: ignore[override]
        """Name of the values that densities refer to."""
        return f"velocities of the root and {self._pose.measured or 'positions relative to it'}"

    @property
    def size(self) -> int:
        """Number of values per frame that the model sees."""
        return 4 + (self._pose.size if isinstance(self._pose, Rotations) else 3 * (self.skeleton.joints - 1))

    @override
    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        if WHOLE not in data or START in data:
            return data
        x, skeleton = data[WHOLE], self.skeleton
        if x.shape[-1] != 3 * skeleton.joints:
            raise ValueError(
                f"x has shape {tuple(x.shape)}, but positions of the skeleton {skeleton.name!r} with its root have "
                f"{3 * skeleton.joints} numbers in the last dimension"
            )
        if data.mask() is not None:
            raise ValueError(
                "a missing joint leaves the heading or the velocity of the root undetermined; fit under a protocol "
                "with root='relative' and positions, which may be masked, or impute the joints first"
            )
        joints = x.unflatten(-1, (-1, 3))
        root = joints[..., skeleton.root, :]
        heading = x.new_zeros(x.shape[:-1]) if self._sides is None else self._sides.heading(joints)
        if view_inputs is None:
            rates = self._rates(root, heading)[:, :1] if x.shape[1] > 1 else x.new_zeros(len(x), 1, 4)
            before = heading[:, :1] - rates[..., 3]
            origin = root[:, :1] - rotate_about_up(rates[..., :3], before, skeleton.up)
            start = torch.cat([origin, before[..., None]], -1)
            start[..., skeleton.vertical] = root[:, :1, skeleton.vertical]
        else:
            start = self.following(view_inputs)[START][:, None]
        rates = self._rates(torch.cat([start[..., :3], root], 1), torch.cat([start[..., 3], heading], 1))
        rates = skeleton.fps * rates
        rates[..., skeleton.vertical] = root[..., skeleton.vertical] - start[..., skeleton.vertical]
        local = rotate_about_up(skeleton.without_root(joints - root[..., None, :]), -heading[..., None], skeleton.up)
        pose = Batch({WHOLE: local.flatten(-2)})
        if ROTATIONS in data.view_inputs:
            pose["view_inputs"] = {ROTATIONS: self._facing(data.view_inputs[ROTATIONS][:, : x.shape[1]], heading)}
        converted = Batch(self._pose(pose, view_inputs))
        converted.pop("view_inputs", None)
        converted[WHOLE] = torch.cat([rates, converted[WHOLE]], -1)
        return data | converted | {START: start[:, 0]}

    @override
    def inverse(self, model_values: Batch) -> Batch:
        data = Batch(model_values)
        start, lengths = data.pop(START, None), data.pop(LENGTHS, None)
        if WHOLE not in data:
            return data
        x, skeleton = data[WHOLE], self.skeleton
        root, heading = self._path(x, start)
        pose = Batch({WHOLE: x[..., 4:]} | ({} if lengths is None else {LENGTHS: lengths}))
        local = skeleton.with_root(self._pose.inverse(pose)[WHOLE].unflatten(-1, (-1, 3)))
        joints = rotate_about_up(local, heading[..., None], skeleton.up) + root[..., None, :]
        return data | {WHOLE: joints.flatten(-2)}

    @override
    def following(self, data: Batch) -> Batch:
        if START not in data:
            return data
        if WHOLE not in data:
            raise ValueError("the view of the root's travel must see the frames before a forecast; remove `Past`")
        root, heading = self._path(data[WHOLE], data[START])
        end = torch.cat([root[:, -1], heading[:, -1:]], -1)
        end[:, self.skeleton.vertical] = data[START][:, self.skeleton.vertical]
        return data | {START: end}

    def _rates(self, root: Tensor, heading: Tensor) -> Tensor:
        """Return steps of the root (B, T - 1, 4): relative to the earlier heading, in metres, and turns in radians."""
        turn = heading.diff(dim=1)
        turn = torch.atan2(turn.sin(), turn.cos())
        step = rotate_about_up(root.diff(dim=1), -heading[:, :-1], self.skeleton.up)
        return torch.cat([step, turn[..., None]], -1)

    def _path(self, x: Tensor, start: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return root positions (..., T, 3) and headings (..., T) of values (..., T, D) that follow a start (B, 4)."""
        start = x.new_zeros(4) if start is None else start.to(x)[..., None, :]
        rates, vertical = x[..., :4] / self.skeleton.fps, self.skeleton.vertical
        heading = start[..., 3] + rates[..., 3].cumsum(-1)
        steps = rotate_about_up(rates[..., :3], heading - rates[..., 3], self.skeleton.up)
        root = start[..., :3] + steps.cumsum(-2)
        root[..., vertical] = start[..., vertical] + x[..., vertical]
        return root, heading

    def _facing(self, rotations: Tensor, heading: Tensor) -> Tensor:
        """Return rotations (B, T, 4 J) of joints, with the root rotated to heading zero."""
        quaternions, root = rotations.unflatten(-1, (-1, 4)).clone(), self.skeleton.root
        axes = to_matrix(quaternions[:, :, root], "quaternion").mT
        turned = rotate_about_up(axes, -heading[..., None].to(axes), self.skeleton.up).mT
        quaternions[:, :, root] = continuous(from_matrix(turned, "quaternion"), dim=1)
        facing: Tensor = quaternions.flatten(-2)
        return facing


def _alike_siblings(skeleton: Skeleton) -> tuple[int, ...]:
    """Return the first joints, from the root on, that are the only two siblings with subtrees of one shape; or ()."""
    children = {joint: [c for p, c in skeleton.edges if p == joint] for joint in range(skeleton.joints)}
    shapes: dict[int, str] = {}
    for joint in reversed(skeleton.order):
        shapes[joint] = f"({''.join(sorted(shapes[child] for child in children[joint]))})"
    for joint in skeleton.order:
        for shape in dict.fromkeys(shapes[child] for child in children[joint]):
            if len(pair := [child for child in children[joint] if shapes[child] == shape]) == 2:
                return tuple(pair)
    return ()
