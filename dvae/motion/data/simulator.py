"""A simulator of human motion: people who walk, wave and turn, with all underlying variables known.

A person has a static part, drawn once per clip: morphology (bone lengths) and style (cadence, amplitudes, posture, arm
carriage). The dynamic part is a semi-Markov chain of activities and the phase of the gait. The time and type of the
next activity cannot be predicted from the past, so futures are multimodal.

Joint angles are smooth functions of phase and activity. Positions follow by forward kinematics, so bones are rigid. The
pelvis then follows the feet: the lower foot determines its height, and the foot that carries the body stays in place.
"""

from __future__ import annotations

import numpy as np

from ..geometry.skeleton import WALKER
from .clips import Clip, MotionSet

ACTIVITIES = ("stand", "walk", "wave-left", "wave-right", "wave-both", "turn-left", "turn-right")
"""The activities in the order of the codes in a clip's truth."""

SHORTEST, MEAN_EXTRA = 0.7, 1.0
"""Duration of an activity in seconds: `SHORTEST` plus an exponential time with mean `MEAN_EXTRA`."""

BLEND = 0.45
"""Duration in seconds of the transition between activities."""

SETTLE = 0.4
"""Duration in seconds of the smoothing that lets the pelvis follow the feet.

A shorter duration shakes the body at each step; a longer one lets the feet slide.
"""

_J = {name: joint for joint, name in enumerate(WALKER.names)}

# Average body at rest: offset of each joint from its parent in metres. Left is +x, and the body faces +z.
_REST = {
    "RHip": (-0.11, -0.03, 0.0),
    "RKnee": (0.0, -0.43, 0.0),
    "RFoot": (0.0, -0.42, 0.0),
    "LHip": (0.11, -0.03, 0.0),
    "LKnee": (0.0, -0.43, 0.0),
    "LFoot": (0.0, -0.42, 0.0),
    "Spine": (0.0, 0.22, -0.01),
    "Thorax": (0.0, 0.26, 0.0),
    "Neck": (0.0, 0.11, 0.03),
    "Head": (0.0, 0.13, 0.0),
    "LShoulder": (0.17, -0.02, 0.0),
    "LElbow": (0.0, -0.28, 0.0),
    "LWrist": (0.0, -0.25, 0.0),
    "RShoulder": (-0.17, -0.02, 0.0),
    "RElbow": (0.0, -0.28, 0.0),
    "RWrist": (0.0, -0.25, 0.0),
}
_ANKLE_HEIGHT = 0.08


def simulate(clips: int = 64, frames: int = 150, seed: int = 0, test: float = 0.2) -> MotionSet:
    """Simulate clips of walking, waving and turning people on `WALKER`, 30 frames a second.

    Args:
        clips: number of people, one clip each.
        frames: length of a clip.
        seed: random seed.
        test: fraction of the clips that form the split "test", the last ones; the other clips form "train".

    Returns:
        A `MotionSet`. Labels of a clip: `activity` (its first activity), `switches` ("walk@0 wave-left@41": activity
        and first frame of each), `height_m`, `cadence_hz`. Truth of a clip: `activity` (F,) codes into `ACTIVITIES`,
        `weights` (F, 7) of the activities while they blend, `phase` (F,) of the gait and `heading` (F,) in radians,
        `bone_lengths` (16,) in metres, `style` (7,).

    Raises:
        ValueError: fewer than 1 clip or 2 frames, or a test fraction outside 0 to 1.
    """
    if clips < 1 or frames < 2 or not 0 <= test <= 1:
        raise ValueError(
            "expected at least 1 clip, at least 2 frames and a test fraction from 0 to 1, got "
            f"clips={clips}, frames={frames} and test={test}"
        )
    random = np.random.default_rng(seed)
    offsets = _morphology(random, clips)
    style = _style(random, clips)
    activity = _activities(random, clips, frames)
    weights = _smooth(np.eye(len(ACTIVITIES))[activity], BLEND)
    phase = _phase(random, weights, style)
    heading = _heading(random, weights)
    positions = _kinematics(offsets, _angles(random, weights, style, phase, heading))
    positions = _stand_on_feet(random, positions, weights, phase)

    lengths = np.linalg.norm(offsets, axis=-1)[:, 1:]
    trunk = offsets[:, [_J[j] for j in ("Spine", "Thorax", "Neck", "Head")], 1].sum(axis=1)
    height = _ANKLE_HEIGHT + trunk - offsets[:, [_J[j] for j in ("LHip", "LKnee", "LFoot")], 1].sum(axis=1)
    truths = {"activity": activity, "weights": weights, "phase": phase, "heading": heading}
    truths |= {"bone_lengths": lengths, "style": style}
    motions = []
    for i in range(clips):
        switches = [0, *(np.flatnonzero(np.diff(activity[i])) + 1)]
        labels = {
            "activity": ACTIVITIES[activity[i, 0]],
            "switches": " ".join(f"{ACTIVITIES[activity[i, frame]]}@{frame}" for frame in switches),
            "height_m": f"{height[i]:.3f}",
            "cadence_hz": f"{style[i, 0]:.3f}",
        }
        truth = {name: values[i] for name, values in truths.items()}
        split = "test" if i >= round(clips * (1 - test)) else "train"
        motions.append(Clip(split, f"person_{i:04d}", positions[i], labels, truth))
    return MotionSet(motions, WALKER, "simulated")


def _morphology(random: np.random.Generator, clips: int) -> np.ndarray:
    """Draw offsets of joints from their parents (N, J, 3): size, and proportions of trunk, legs, arms and widths."""
    rest = np.zeros((WALKER.joints, 3))
    for name, offset in _REST.items():
        rest[_J[name]] = offset
    # legs, arms and widths; the trunk is 0
    parts = {"Knee": 1, "Foot": 1, "Elbow": 2, "Wrist": 2, "Hip": 3, "Shoulder": 3}
    part = [parts.get(name.lstrip("LR"), 0) for name in WALKER.names]
    size = np.exp(0.07 * random.standard_normal((clips, 1)))
    proportions = np.exp(0.05 * random.standard_normal((clips, 4)))
    return rest * (size * proportions[:, part])[..., None]


def _style(random: np.random.Generator, clips: int) -> np.ndarray:
    """Draw styles (N, 7): cadence (Hz), stride, knee lift, arm swing, elbow bend, lean (radians), wave rate (Hz)."""
    middle = np.array([0.95, 0.42, 0.95, 0.45, 0.45, 0.06, 1.4])
    spread = np.array([0.14, 0.07, 0.12, 0.16, 0.22, 0.06, 0.3])
    return middle + spread * np.clip(random.standard_normal((clips, 7)), -2, 2)


def _activities(random: np.random.Generator, clips: int, frames: int) -> np.ndarray:
    """Draw activity codes (N, F): a semi-Markov chain that never repeats an activity and prefers walking."""
    segments = 2 + int(frames / WALKER.fps / SHORTEST)
    seconds = SHORTEST + random.exponential(MEAN_EXTRA, (clips, segments))
    seconds[:, 0] *= random.random(clips)  # the clip starts at a random time within its first activity
    starts = np.cumsum(seconds, axis=1) - seconds
    odds = np.array([1.0, 3.0, 1.0, 1.0, 1.0, 1.5, 1.5])
    codes = np.empty((clips, segments), int)
    for s in range(segments):
        allowed = np.tile(odds, (clips, 1))
        if s:
            allowed[np.arange(clips), codes[:, s - 1]] = 0
        cumulative = allowed.cumsum(axis=1)
        codes[:, s] = (random.random((clips, 1)) * cumulative[:, -1:] >= cumulative).sum(axis=1)
    time = np.arange(frames) / WALKER.fps
    segment = (starts[:, None, :] <= time[None, :, None]).sum(axis=2) - 1
    return np.take_along_axis(codes, segment, axis=1)


def _smooth(signals: np.ndarray, seconds: float) -> np.ndarray:
    """Average signals (N, F, A) over time under a raised cosine."""
    half = max(1, round(seconds * WALKER.fps / 2))
    kernel = 1 + np.cos(np.pi * np.arange(-half, half + 1) / (half + 1))
    kernel /= kernel.sum()
    padded = np.pad(signals, ((0, 0), (half, half), (0, 0)), mode="edge")
    frames = signals.shape[1]
    return sum(w * padded[:, k : k + frames] for k, w in enumerate(kernel))


def _drift(random: np.random.Generator, clips: int, frames: int) -> np.ndarray:
    """Draw a slow random signal (N, F) of unit variance: four sinusoids below 0.4 Hz."""
    time = np.arange(frames) / WALKER.fps
    hertz, phase = random.uniform(0.05, 0.4, (clips, 4, 1)), random.uniform(0, 2 * np.pi, (clips, 4, 1))
    return np.sin(2 * np.pi * hertz * time + phase).sum(axis=1) / np.sqrt(2)


def _of(weights: np.ndarray, prefix: str) -> np.ndarray:
    return weights[..., [k for k, name in enumerate(ACTIVITIES) if name.startswith(prefix)]].sum(axis=-1)


def _phase(random: np.random.Generator, weights: np.ndarray, style: np.ndarray) -> np.ndarray:
    """Return the phase of the gait (N, F): it advances while walking or turning, and rests otherwise."""
    clips, frames = weights.shape[:2]
    running = _of(weights, "walk") + 0.85 * _of(weights, "turn")
    hertz = style[:, :1] * (1 + 0.06 * _drift(random, clips, frames)) * running
    return random.uniform(0, 2 * np.pi, (clips, 1)) + 2 * np.pi * np.cumsum(hertz, axis=1) / WALKER.fps


def _heading(random: np.random.Generator, weights: np.ndarray) -> np.ndarray:
    """Return the heading (N, F) in radians: a turning rate for each person, and slow drift while walking."""
    clips, frames = weights.shape[:2]
    rate = random.uniform(1.0, 2.2, (clips, 1)) * (_of(weights, "turn-left") - _of(weights, "turn-right"))
    rate = rate + 0.15 * _drift(random, clips, frames) * _of(weights, "walk")
    return random.uniform(-np.pi, np.pi, (clips, 1)) + np.cumsum(rate, axis=1) / WALKER.fps


def _angles(
    random: np.random.Generator, weights: np.ndarray, style: np.ndarray, phase: np.ndarray, heading: np.ndarray
) -> dict[str, list[tuple[str, np.ndarray]]]:
    """Return the rotations of the bones that start at each joint: (axis, angle (N, F)), the outermost first.

    A positive angle about x moves a hanging limb backwards; a positive angle about z moves it to the left.
    """
    clips, frames = phase.shape
    _, stride, lift, swing, bend, lean, wave_hertz = (style[:, k : k + 1] for k in range(style.shape[1]))
    walk, turn = _of(weights, "walk"), _of(weights, "turn")
    drift = [_drift(random, clips, frames) for _ in range(4)]
    wave = np.sin(2 * np.pi * wave_hertz * np.arange(frames) / WALKER.fps + random.uniform(0, 2 * np.pi, (clips, 1)))
    raised = random.uniform(2.0, 2.7, (clips, 1))

    sway = 0.05 * walk * np.sin(phase)
    rotations: dict[str, list[tuple[str, np.ndarray]]] = {
        "Pelvis": [("y", heading + 0.1 * walk * np.sin(phase)), ("x", 0.4 * lean + 0.01 * drift[0]), ("z", sway)],
        "Spine": [("x", 0.6 * lean + 0.02 * drift[1]), ("y", 0.03 * drift[2])],
        "Thorax": [("y", -0.22 * walk * np.sin(phase) + 0.05 * drift[2]), ("z", -sway)],
        "Neck": [("x", -0.7 * lean + 0.04 * drift[3]), ("y", 0.12 * drift[2] + 0.05 * drift[1])],
    }
    for side, sign in (("L", 1.0), ("R", -1.0)):
        leg_phase = phase if side == "L" else phase + np.pi
        step = np.clip(np.sin(leg_phase), 0, None) ** 2  # marching on the spot while turning
        gait = np.cos(leg_phase) + 0.09 * np.cos(3 * leg_phase)  # nearly a triangle wave: nearly constant speed
        flex = stride * walk * (gait + 0.1) + 0.45 * turn * step + 0.03
        knee = 0.06 + walk * (0.08 + lift * ((1 + np.cos(leg_phase - 1.45 * np.pi)) / 2) ** 2) + 0.9 * turn * step
        rotations[f"{side}Hip"] = [("x", -flex), ("z", sign * 0.03 - sway)]
        rotations[f"{side}Knee"] = [("x", knee)]

        waving = _of(weights, "wave-left" if side == "L" else "wave-right") + _of(weights, "wave-both")
        resting = 1 - waving
        rotations[f"{side}Shoulder"] = [
            ("z", sign * (0.12 * resting + (raised + 0.12 * wave) * waving)),
            ("x", resting * (swing * (walk + 0.25 * turn) * np.cos(leg_phase) + 0.05 * drift[1]) - 0.25 * waving),
        ]
        rotations[f"{side}Elbow"] = [
            ("z", sign * waving * (0.35 + 0.5 * wave)),
            ("x", -resting * (bend - 0.3 * swing * walk * np.cos(leg_phase))),
        ]
    return rotations


def _kinematics(offsets: np.ndarray, rotations: dict[str, list[tuple[str, np.ndarray]]]) -> np.ndarray:
    """Return positions (N, F, J, 3) relative to the pelvis, by forward kinematics."""
    clips, frames = next(iter(rotations.values()))[0][1].shape
    positions = np.zeros((clips, frames, WALKER.joints, 3))
    globally: dict[int, np.ndarray] = {}
    for joint in WALKER.order:
        parent = WALKER.parents[joint]
        frame = np.broadcast_to(np.eye(3), (clips, frames, 3, 3))
        if parent != -1:
            frame = globally[parent]
            positions[:, :, joint] = positions[:, :, parent] + np.einsum("nfij,nj->nfi", frame, offsets[:, joint])
        for axis, angle in rotations.get(WALKER.names[joint], []):
            frame = frame @ _rotation(axis, angle)
        globally[joint] = frame
    return positions


def _rotation(axis: str, angle: np.ndarray) -> np.ndarray:
    vertical = "xyz".index(axis)
    first, second = (vertical + 1) % 3, (vertical + 2) % 3
    matrix = np.zeros((*angle.shape, 3, 3))
    matrix[..., vertical, vertical] = 1
    matrix[..., first, first] = matrix[..., second, second] = np.cos(angle)
    matrix[..., second, first] = np.sin(angle)
    matrix[..., first, second] = -matrix[..., second, first]
    return matrix


def _stand_on_feet(
    random: np.random.Generator, positions: np.ndarray, weights: np.ndarray, phase: np.ndarray
) -> np.ndarray:
    """Return global positions: the lower foot is on the floor, and the foot that carries the body stays in place."""
    feet = positions[:, :, [_J["LFoot"], _J["RFoot"]]]
    depth = np.exp(-(feet[..., 1] - feet[..., 1].min(axis=2, keepdims=True)) / 0.02)
    height = _ANKLE_HEIGHT - (depth * feet[..., 1]).sum(axis=2) / depth.sum(axis=2)

    # In walking, a leg carries the body while it moves backwards; in turning on the spot, while it is not lifted.
    left = 0.5 + 0.5 * (_of(weights, "walk") - _of(weights, "turn")) * np.tanh(3 * np.sin(phase))
    carrying = np.stack([left, 1 - left], axis=2)
    steps = np.diff(feet[..., [0, 2]], axis=1, prepend=feet[:, :1, :, [0, 2]])
    travel = -(carrying[..., None] * steps).sum(axis=2)
    moves = _smooth(np.concatenate([travel, height[..., None]], axis=2), SETTLE)
    path = random.uniform(-1, 1, (len(positions), 1, 2)) + np.cumsum(moves[..., :2], axis=1)
    pelvis = np.stack([path[..., 0], moves[..., 2], path[..., 1]], axis=2)
    return positions + pelvis[:, :, None]
