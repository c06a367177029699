"""Fit motion to a body: the rotations of its joints, its position, and its shape parameters.

Sources contain positions of joints, but every source places joints differently in the anatomy. Joints are therefore not
pulled to the positions in the source. Instead, rotations are computed from directions that mean the same on any
skeleton, relative to the same directions of the body at rest:

* **pelvis**: the line through the hips, and the direction from their midpoint to the start of the spine.
* **chest**: the line through the clavicles, or else the shoulders, and the direction from the start of the spine to the
  neck. The joints of the spine share the rotation between pelvis and chest evenly. They are then rotated together so
  that the neck has the right direction (in cmu8, this reduces its error from 28 to 12 mm).
* **limbs**: along their bones. The twist of a thigh or an upper arm is minimal relative to the trunk while the limb is
  straight, and follows its hinge when the knee or elbow is bent.
* **neck**: towards the head.
* **ankles**: towards the toes. The slope of a foot that stands flat in the source counts as zero rotation.
* **Joints without children**, and joints that the source does not have, keep their rest rotation relative to the
  parent.

The midpoint of the hips is at its position in the source.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import groupby, pairwise
from operator import itemgetter
from typing import NamedTuple

import numpy as np
import scipy
import torch
from torch import Tensor
from torch.nn.functional import normalize

from ...data.sequences import tensor_of
from ..data.clips import Clip, MotionSet
from ..files.smpl import has_smpl_rest
from ..geometry.kinematics import forward, resting, swing
from ..geometry.rotations import continuous, from_matrix, to_matrix
from ..geometry.skeleton import Skeleton
from ..naming import sides
from ..scoring.matching import parts
from ..segments.frames import AT_ONCE, resting_offsets
from .skinning import Body

WITHIN = 0.01
"""Deviation of a length in metres that costs as much as a parameter value of 1."""

MOST = 3.0
"""Bound on the absolute value of a fitted parameter; one person in four hundred exceeds it."""

ROUNDED = 1e-4
"""Tolerance in metres within which joint offsets agree with shape parameters up to rounding in single precision."""

SAME = 1e-3
"""Tolerance in metres within which lengths belong to the same body, and joints at rest to the same shape."""

STRETCHED = 0.25
"""Sine of the bend of a knee or elbow at which hinge and trunk have equal influence on the twist of the limb."""

STILL = 0.15
"""Speed in metres a second below which ankle and toes belong to a foot that stands flat."""

MIN_DISTANCE = 0.03
"""Minimum distance in metres between clavicles; closer ones begin in the middle of the body and are ignored."""

ALIKE = 0.5
"""Minimum cosine between the directions of a bone in two rest poses whose rotations are comparable.

An arm that hangs in one rest pose and points to the side in the other has cosine 0."""

Z_TO_Y = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
"""Rotation (3, 3) about x of a world with z up to a world with y up."""

_LIMBS = {"hip knee ankle": (1.0, 0.0, 0.0), "shoulder elbow wrist": (0.0, -1.0, 0.0)}
"""Limbs, and the axis about which the left one bends at rest; the axis is mirrored for the right side."""

_NEEDED = ["pelvis", *(f"{side} {part}" for limb in _LIMBS for part in limb.split() for side in "lr")]


def fit_to_body(motion: MotionSet, body: Body, shapes: Tensor | None = None) -> MotionSet:
    """Fit motion to the joints of a body; the documentation of this module describes how.

    Motion on these joints, with rotations from a similar rest pose (e.g. from AMASS), keeps its rotations. Motion of
    AMASS on a body from a file of SMPL, SMPL-H or SMPL-X also keeps its `betas`, so nothing is estimated; the root is
    where SMPL puts it.

    Args:
        motion: motion on any skeleton with pelvis, hips, knees, ankles, shoulders, elbows and wrists.
        body: target body, such as `human()`.
        shapes: shape parameters, (S,) for all clips or (N, S). Default: `betas` of AMASS on a body from a file; for
            other motion, fitted to the bone lengths, equal for all clips with the same lengths.

    Returns:
        The same clips with y up, with positions of the body's joints in metres, and rotations. `shapes_of` returns
        their shape parameters. The rest pose of the skeleton is the mean over clips. The `translation` of
        `Body.forward` is the position of the root minus the root's position at rest.

    Raises:
        ValueError: a required joint is missing in the skeleton or in a frame, the shapes have a wrong size, or a clip
            of AMASS has too few betas.
    """
    if incomplete := [clip for clip in motion if np.isnan(clip.positions).any()]:
        raise ValueError(
            f"clip {'/'.join(incomplete[0].key)} has missing joints and cannot be fitted to a body; remove it, or "
            "fill its gaps first (`dvae impute RUN --filled FILE`)"
        )
    if _has_matching_rotations(motion, body):
        has_betas = shapes is None and _is_of_smpl(motion, body)
        shapes = betas(motion, body.parameters_of_shape) if has_betas else shapes
        shapes_of_clips = _known_shapes(motion, body) if shapes is None else _shapes(shapes, motion, body)
        return _on_bodies(motion, body, shapes_of_clips, _kept_rotations(motion, body, shapes_of_clips))
    motion = _y_up(motion)
    source = _Source.of(motion, body)
    marks_of_clips = [source.marks(tensor_of(clip.positions).double()) for clip in motion]
    shapes_of_clips = torch.zeros(len(motion), body.parameters_of_shape, dtype=torch.float64)
    slopes = torch.zeros(len(motion), dtype=torch.float64)
    person_of_clip = np.zeros(len(motion), int)
    for person, people in enumerate(_bodies(motion)):
        person_of_clip[people] = person
        lengths = torch.cat([source.lengths(marks_of_clips[n]) for n in people])
        shapes_of_clips[people] = source.shape(body, lengths.mean(0))
        slopes[people] = source.steepness([marks_of_clips[n] for n in people], motion.skeleton.fps)
    shapes_of_clips = shapes_of_clips if shapes is None else _shapes(shapes, motion, body)
    joints, frames = _joints(body, shapes_of_clips), [clip.frames for clip in motion]
    batch_keys = zip(np.cumsum(frames) // AT_ONCE, person_of_clip, shapes_of_clips.tolist(), strict=True)

    def rotations() -> Iterator[tuple[Tensor, Tensor]]:
        """Yield rotations and root positions of each clip, computed for several clips of one body at once."""
        for _, batch in groupby(enumerate(batch_keys), key=itemgetter(1)):
            clips = [n for n, _ in batch]
            marks_of_batch = {part: torch.cat([marks_of_clips[n][part] for n in clips]) for part in marks_of_clips[0]}
            motions = source.rotations(body, marks_of_batch, joints[clips[0]], slopes[clips[0]])
            yield from zip(*(values.split([frames[n] for n in clips]) for values in motions), strict=True)

    return _on_bodies(motion, body, shapes_of_clips, rotations())


def shapes_of(motion: MotionSet, body: Body) -> Tensor:
    """Return shape parameters (N, S) of clips from `fit_to_body`, `retarget` or `TimedFrames.back`.

    On a body from a file, these are the label `betas`, if they agree with the offsets of the joints. Otherwise, the
    parameters are computed from the offsets by `Body.shape_of`. For other motion, the result is meaningless.

    Args:
        motion: N clips with rotations of the body's joints.
        body: body that the motion was fitted to.

    Raises:
        ValueError: the clips have other joints, or no rotations.
    """
    _check(motion, body)
    offsets, size = resting_offsets(motion), body.parameters_of_shape
    shapes = body.shape_of(offsets)
    if is_from_file(body):
        labels = [clip.labels.get("betas", "").split()[:size] for clip in motion]
        labelled = torch.tensor([n for n, label in enumerate(labels) if len(label) == size], dtype=torch.long)
        values = torch.tensor([[float(number) for number in labels[n]] for n in labelled], dtype=torch.float64)
        if len(labelled):
            agree = (body.offsets(values) - offsets[labelled]).abs().amax((-2, -1)) < ROUNDED
            shapes[labelled[agree]] = values[agree]
    return shapes


def retarget(motion: MotionSet, body: Body, shapes: Tensor) -> MotionSet:
    """Return the same rotations on other bodies, with positions scaled about the origin.

    The scale is the ratio of the heights of the root above the soles at rest. Speeds in leg lengths are therefore
    preserved, and people who stand on a floor at height 0 still do.

    Args:
        motion: motion on the body's joints, e.g. from `fit_to_body`.
        body: body of the motion.
        shapes: new shape parameters, (S,) for all clips or (N, S).

    Raises:
        ValueError: the clips have other joints or no rotations, or the shapes have a wrong size.
    """
    _check(motion, body)
    parameters = _shapes(shapes, motion, body)
    scales = standing_heights(body, parameters) / standing_heights(body, shapes_of(motion, body))
    motions = (_local_rotations(clip, motion.skeleton) for clip in motion)
    scaled = ((local, scale * root) for scale, (local, root) in zip(scales, motions, strict=True))
    return _on_bodies(motion, body, parameters, scaled)


def is_from_file(body: Body) -> bool:
    """Return whether a body was read from a file of SMPL, SMPL-H or SMPL-X."""
    return body.source is not None and bool(body.source.path)


def betas(motion: MotionSet, parameters: int = 8) -> Tensor:
    """Return the shape parameters in AMASS's files, (N, S): the first values of each clip's label `betas`.

    The parameters are valid only for the body that the files were fitted with, usually SMPL-H (`read_body`).

    Args:
        motion: N clips read from files in AMASS's layout.
        parameters: number of shape parameters S.

    Raises:
        ValueError: a clip has no betas, or too few.
    """
    rows = []
    for clip in motion:
        values = clip.labels.get("betas", "").split()
        if len(values) < parameters:
            raise ValueError(
                f"clip {'/'.join(clip.key)} has {len(values) or 'no'} betas, expected {parameters}; files of "
                "AMASS contain 10 or 16. Give shapes= to fit_to_body, or read_body with fewer shapes"
            )
        rows.append([float(number) for number in values[:parameters]])
    return torch.tensor(rows, dtype=torch.float64)


class _Source(NamedTuple):
    """Corresponding joints of a skeleton and of a body.

    Attributes:
        source_joints: indices of the skeleton's joints by part, for the parts that both have.
        body_joints: indices of the body's joints by part.
        waist, top: parts where the spine begins and ends.
        girdle: pair of joints that gives the left-right direction of the chest, "clavicle" or "shoulder".
    """

    source_joints: Mapping[str, int]
    body_joints: Mapping[str, int]
    waist: str
    top: str
    girdle: str

    @classmethod
    def of(cls, motion: MotionSet, body: Body) -> _Source:
        """Match the joints by the meaning of their names."""
        skeleton, pose = motion.skeleton, motion.clips[0].positions[0]
        source_joints, body_joints = parts(skeleton.names), parts(body.names)
        if {"l clavicle", "r clavicle"} <= source_joints.keys():
            ends = [source_joints.pop(f"{side} clavicle") for side in "lr"]
            if np.linalg.norm(pose[ends[0]] - pose[ends[1]]) > MIN_DISTANCE:
                source_joints |= {"l clavicle": ends[0], "r clavicle": ends[1]}
        # if there are two, the lower one is in the chest
        for part, higher in (("neck", "upperneck"), ("head", "headtop")):
            source_joints |= {part: source_joints[higher]} if higher in source_joints else {}
        for owner, joints, names, required in (
            (f"skeleton {skeleton.name!r}", source_joints, skeleton.names, _NEEDED),
            ("the body", body_joints, body.names, [*_NEEDED, "neck"]),
        ):
            if missing := [part for part in required if part not in joints]:
                raise ValueError(
                    f"{owner} has no {', '.join(missing)}, which fitting to a body requires; its joints are "
                    f'{", ".join(names)[:600]}. read_motion(..., joints={{"name there": "LHip", ...}}) renames joints'
                )
        both = source_joints.keys() & body_joints.keys()
        return cls(
            {part: joint for part, joint in source_joints.items() if part in both},
            body_joints,
            "spine" if "spine" in both else "pelvis",
            "neck" if "neck" in both else "shoulders",
            "clavicle" if both >= {"l clavicle", "r clavicle"} else "shoulder",
        )

    def marks(self, positions: Tensor) -> dict[str, Tensor]:
        """Return positions (..., 3) of parts, and of the midpoints of hips and shoulders, from joints (..., J, 3)."""
        return _marks(positions, self.source_joints)

    def lengths(self, marks: Mapping[str, Tensor]) -> Tensor:
        """Return eight lengths (..., 8) in metres.

        They are the four bones of limbs (means of both sides), the widths of hips and shoulders, and the lengths of
        the trunk from the hips to the shoulders and to `top`.
        """

        def length(start: str, end: str) -> Tensor:
            lengths_of_bone: Tensor = (marks[end] - marks[start]).norm(dim=-1)
            return lengths_of_bone

        bones = [bone for limb in _LIMBS for bone in pairwise(limb.split())]
        limbs = [(length(f"l {a}", f"l {b}") + length(f"r {a}", f"r {b}")) / 2 for a, b in bones]
        widths = [length(f"l {part}", f"r {part}") for part in ("hip", "shoulder")]
        trunk = [length("hips", self.waist) + length(self.waist, top) for top in ("shoulders", self.top)]
        return torch.stack([*limbs, *widths, *trunk], -1)

    def shape(self, body: Body, lengths: Tensor) -> Tensor:
        """Return the shape parameters (S,) of a body with approximately these lengths (8,)."""
        size = body.parameters_of_shape
        average, *units = _joints(body, torch.cat([lengths.new_zeros(1, size), torch.eye(size).to(lengths)]))
        changes = torch.stack(units, -1) - average[..., None]

        def off(shape: np.ndarray) -> np.ndarray:
            deviation = self.lengths(_marks(average + changes @ torch.from_numpy(shape), self.body_joints))
            return np.concatenate([(deviation - lengths).numpy() / WITHIN, shape])

        return torch.from_numpy(scipy.optimize.least_squares(off, np.zeros(size), bounds=(-MOST, MOST)).x)

    def steepness(self, clips: Iterable[Mapping[str, Tensor]], fps: float) -> Tensor:
        """Return the median slope in radians from ankle to toe in flat feet, positive downwards; NaN without flat feet.

        Args:
            clips: positions (F, 3) by part of each clip.
            fps: frames per second.
        """
        slopes = [torch.zeros(0, dtype=torch.float64)]
        if self.source_joints.keys() >= {"l toe", "r toe"}:
            for marks in clips:
                for side in "lr":
                    ends = marks[f"{side} ankle"], marks[f"{side} toe"]
                    speeds = [fps * end.diff(dim=0).norm(dim=-1) for end in ends]
                    slopes.append(_descent(ends[1] - ends[0])[1:][torch.maximum(*speeds) < STILL])
        all_slopes = torch.cat(slopes)
        return all_slopes.median() if len(all_slopes) else all_slopes.new_tensor(torch.nan)

    def rotations(
        self, body: Body, targets: Mapping[str, Tensor], joints: Tensor, slope: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return local rotations (F, J, 3, 3) of a clip, and positions of its root (F, 3).

        Args:
            body: target body.
            targets: positions by part, (F, 3) each.
            joints: (J, 3), joints of the body at rest.
            slope: result of `steepness`.
        """
        rest, parents, root = _marks(joints, self.body_joints), body.parents, body.parents.index(-1)

        def across(girdle: str, low: str, high: str) -> Tensor:
            return _align(
                *((marks[f"l {girdle}"] - marks[f"r {girdle}"], marks[high] - marks[low]) for marks in (rest, targets))
            )

        world = {root: across("hip", "hips", self.waist)}

        def carried(joint: int) -> Tensor:
            """Return the world rotation of a joint, or of its nearest ancestor with one."""
            while joint not in world:
                joint = parents[joint]
            return world[joint]

        def point(start: str, end: str, resting: Tensor | None = None) -> None:
            """Rotate a part by the smallest rotation that aligns it with the direction to another part."""
            turn, bone = carried(self.body_joints[start]), rest[end] - rest[start] if resting is None else resting
            world[self.body_joints[start]] = (
                swing(turn @ normalize(bone, dim=-1), normalize(targets[end] - targets[start], dim=-1)) @ turn
            )

        bent = from_matrix(world[root].mT @ across(self.girdle, self.waist, self.top), "vector")
        spine = [parents[self.body_joints["neck"]]]
        while parents[spine[0]] != root:
            spine.insert(0, parents[spine[0]])
        ends = [*(joints[joint] for joint in spine), rest[self.top]]
        for n, joint in enumerate(spine, 1):
            world[joint] = world[root] @ to_matrix(n / len(spine) * bent, "vector")
        bones = [world[joint] @ (end - start) for joint, (start, end) in zip(spine, pairwise(ends), strict=True)]
        correction = swing(
            normalize(torch.stack(bones).sum(0), dim=-1), normalize(targets[self.top] - targets[self.waist], dim=-1)
        )
        world |= {joint: correction @ world[joint] for joint in spine}
        if {"neck", "head"} <= self.source_joints.keys():
            point("neck", "head")
        for side, mirror in (("l ", 1.0), ("r ", -1.0)):
            if self.girdle == "clavicle":
                point(f"{side}clavicle", f"{side}shoulder")
            for limb, hinge_axis in _LIMBS.items():
                start, middle, end = (side + part for part in limb.split())
                hinge = joints.new_tensor([hinge_axis[0], mirror * hinge_axis[1], mirror * hinge_axis[2]])
                point(start, middle)
                upper, lower = (normalize(targets[b] - targets[a], dim=-1) for a, b in ((start, middle), (middle, end)))
                bend = upper.cross(lower, dim=-1) + STRETCHED * world[self.body_joints[start]] @ hinge
                world[self.body_joints[start]] = _align((rest[middle] - rest[start], hinge), (upper, bend))
                point(middle, end)
            if f"{side}toe" in self.source_joints:
                foot = rest[f"{side}toe"] - rest[f"{side}ankle"]
                point(f"{side}ankle", f"{side}toe", foot if slope.isnan() else _direction(foot, slope))
        world_rotations = torch.stack([carried(joint) for joint in range(body.joints)], -3)
        parent_rotations = world_rotations[:, [max(parent, 0) for parent in parents]]
        local = parent_rotations.mT @ world_rotations
        local[:, root] = world_rotations[:, root]
        hips = (world[root] @ (rest["hips"] - joints[root])[:, None]).squeeze(-1)
        return local, targets["hips"] - hips


def _marks(places: Tensor, joints: Mapping[str, int]) -> dict[str, Tensor]:
    """Return positions (..., 3) by part, and the midpoints of hips and shoulders, from joints (..., J, 3)."""
    marks = {part: places[..., joint, :] for part, joint in joints.items()}
    return marks | {f"{part}s": (marks[f"l {part}"] + marks[f"r {part}"]) / 2 for part in ("hip", "shoulder")}


def _align(start: tuple[Tensor, Tensor], end: tuple[Tensor, Tensor]) -> Tensor:
    """Return the rotation (..., 3, 3) that maps one vector onto another, and a second pair as closely as possible."""
    frames = []
    for first, second in (start, end):
        first = normalize(first, dim=-1)
        third = normalize(first.cross(second.expand_as(first), dim=-1), dim=-1)
        frames.append(torch.stack([first, third.cross(first, dim=-1), third], -1))
    return frames[1] @ frames[0].mT


def _descent(bones: Tensor) -> Tensor:
    """Return the angles (...,) in radians of bones (..., 3) below the horizontal."""
    return torch.atan2(-bones[..., 1], bones[..., [0, 2]].norm(dim=-1))


def _direction(bone: Tensor, angle: Tensor) -> Tensor:
    """Return a bone (3,) as a unit vector with the same heading, at this angle in radians below the horizontal."""
    ahead = normalize(bone * bone.new_tensor([1.0, 0, 1]), dim=-1)
    return ahead * angle.cos() - bone.new_tensor([0.0, 1, 0]) * angle.sin()


def _bodies(motion: MotionSet) -> list[list[int]]:
    """Group the indices of clips with the same bone lengths."""
    groups: list[tuple[Tensor, list[int]]] = []
    for n, clip in enumerate(motion):
        lengths = motion.skeleton.bone_lengths(tensor_of(clip.positions).double()).mean(0)
        people = next((people for known, people in groups if (known - lengths).abs().max() < SAME), None)
        if people is None:
            groups.append((lengths, [n]))
        else:
            people.append(n)
    return [people for _, people in groups]


def _joints(body: Body, shapes: Tensor) -> Tensor:
    """Return joint positions (N, J, 3) of bodies (N, S) at rest with the root at 0."""
    return resting(body.parents, body.offsets(shapes))


def standing_heights(body: Body, shapes: Tensor) -> Tensor:
    """Return heights (N,) of the root above the soles of bodies (N, S) at rest, in metres, float64."""
    heights = []
    for batch in shapes.to(body.template).split(256):
        vertices, joints = body.at_rest(batch)
        heights.append(joints[:, body.parents.index(-1), 1] - vertices[..., 1].amin(-1))
    return torch.cat(heights).double()


def _shapes(shapes: Tensor, motion: MotionSet, body: Body) -> Tensor:
    """Return shapes (N, S), float64, expanded to all clips."""
    size = body.parameters_of_shape
    if shapes.shape not in ((size,), (len(motion), size)):
        raise ValueError(
            f"`shapes` has shape {tuple(shapes.shape)}, expected ({size},) for all clips or ({len(motion)}, {size}) "
            "with a row for each clip"
        )
    return shapes.detach().cpu().double().expand(len(motion), size)


def _known_shapes(motion: MotionSet, body: Body) -> Tensor:
    """Return shape parameters (N, S) of motion with rotations of the body's joints.

    They are computed from joint offsets, or from bone lengths if no body has these offsets.
    """
    source, shapes = _Source.of(motion, body), []
    for offsets in resting_offsets(motion):
        shape = body.shape_of(offsets)
        if (body.offsets(shape) - offsets).abs().max() > SAME:
            shape = source.shape(body, source.lengths(source.marks(resting(body.parents, offsets))))
        shapes.append(shape)
    return torch.stack(shapes)


def _local_rotations(clip: Clip, skeleton: Skeleton) -> tuple[Tensor, Tensor]:
    """Return local rotations (F, J, 3, 3) of a clip, and positions of its root (F, 3), both with y up."""
    assert clip.rotations is not None
    local = to_matrix(tensor_of(clip.rotations).double(), "quaternion")
    root = tensor_of(clip.positions[:, skeleton.root]).double()
    if skeleton.up == "z":
        local[:, skeleton.root] = Z_TO_Y @ local[:, skeleton.root]
        root = root @ Z_TO_Y.T
    return local, root


def _kept_rotations(motion: MotionSet, body: Body, shapes: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield local rotations and root positions of each clip, both with y up, of motion with matching rotations.

    SMPL adds `trans` to the root at rest, in the axes of the file.
    """
    pelvis = torch.zeros(len(motion), 3, dtype=torch.float64)
    if _is_of_smpl(motion, body):
        pelvis = body.joints_at_rest(shapes.to(body.template))[:, body.parents.index(-1)].double()
        pelvis = pelvis @ Z_TO_Y.T if motion.skeleton.up == "z" else pelvis
    for clip, place in zip(motion, pelvis, strict=True):
        local, root = _local_rotations(clip, motion.skeleton)
        yield local, root + place


def _has_matching_rotations(motion: MotionSet, body: Body) -> bool:
    """Return whether the rotations belong to the body's joints and refer to a similar rest pose."""
    skeleton = motion.skeleton
    if not skeleton.rest or any(clip.rotations is None for clip in motion):
        return False
    if (skeleton.names, skeleton.parents) != (body.names, body.parents):
        return False
    if _is_of_smpl(motion, body):
        return True
    bones = body.offsets(torch.zeros(body.parameters_of_shape, dtype=torch.float64))
    cosines = torch.cosine_similarity(bones, skeleton.offsets, dim=-1)
    return bool((cosines > ALIKE)[[joint for _, joint in skeleton.edges]].all())


def _is_of_smpl(motion: MotionSet, body: Body) -> bool:
    """Return whether rotations refer to the rest pose of SMPL's own files, and the body is in such a file."""
    return is_from_file(body) and has_smpl_rest(motion.skeleton)


def _check(motion: MotionSet, body: Body) -> None:
    if not _has_matching_rotations(motion, body):
        raise ValueError(
            f"{motion.name or 'this motion'} has other joints than the body, or rotations relative to another rest "
            "pose; convert it with dvae.motion.bodies.fit_to_body"
        )


def _y_up(motion: MotionSet) -> MotionSet:
    """Return motion with y up, rotated about x, without rotations of joints."""
    if motion.skeleton.up == "y":
        return motion
    turn = Z_TO_Y.float().numpy().T
    clips = [replace(clip, positions=clip.positions @ turn, rotations=None) for clip in motion]
    return replace(motion, clips=clips, skeleton=replace(motion.skeleton, up="y"))


def _on_bodies(motion: MotionSet, body: Body, shapes: Tensor, rotations: Iterable[tuple[Tensor, Tensor]]) -> MotionSet:
    """Return clips on bodies (N, S) with local rotations (F, J, 3, 3) and root positions (F, 3)."""
    offsets, clips = body.offsets(shapes), []
    for clip, shape, bones, (local, root) in zip(motion, shapes, offsets, rotations, strict=True):
        quaternions = continuous(from_matrix(local, "quaternion"))
        positions, _ = forward(body.parents, local, bones, root)
        # the precision of `MotionSet`; all clips in double precision would need twice the memory
        labels = {**clip.labels, "betas": " ".join(map(str, shape.tolist()))} if is_from_file(body) else clip.labels
        clips.append(
            replace(clip, positions=positions.float().numpy(), rotations=quaternions.float().numpy(), labels=labels)
        )
    source = motion.skeleton
    rest = tuple(offsets.mean(0).flatten().tolist())
    skeleton = Skeleton(body.names, body.parents, *sides(body.names), "y", source.fps, source.name, rest=rest)
    return MotionSet(
        clips, skeleton, motion.name, copy=False, skipped=motion.skipped, interpretation=motion.interpretation
    )
