"""Forecasts of motion, and a file format with everything needed to draw and score them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import pi
from pathlib import Path

import numpy as np
import torch

from .. import files
from .data.clips import Clip, MotionSet
from .files.archive import holds, write_arrays
from .files.arrays import read_arrays
from .geometry import kinematics
from .geometry.rotations import from_matrix, to_matrix
from .geometry.skeleton import FIELDS, Skeleton


def is_forecasts(path: str | Path) -> bool:
    """Return whether a file is an npz with a member `forecasts`.

    Args:
        path: path of the file.
    """
    return holds(path, "forecasts")


@dataclass(frozen=True, eq=False)
class Forecasts:
    """Sampled futures of windows of motion, with the observed frames and the true futures, in metres.

    Args:
        skeleton: skeleton of the poses.
        keys: (split, clip, first frame) of the N windows.
        forecasts: (S, N, H, J, 3), S futures of each window.
        observed: (N, O, J, 3), NaN where a joint was missing.
        truth: (N, F, J, 3), true frames after the observed ones, NaN where a joint was missing; F is at most H.
        emission: "drawn" if futures include the noise of the emission, "mean" if they are its means given draws of the
            latents, "" if unknown.
        blend: number of first frames that `blended` changed; 0 if these are the model's own forecasts. Scores are for
            the model's own forecasts.

    Raises:
        ValueError: the shapes do not match each other or the skeleton, or an array is empty.
        FloatingPointError: a future is NaN or infinite, or another position is infinite. The message names the window
            and the clip.
    """

    skeleton: Skeleton
    keys: Sequence[tuple[str, str, int]]
    forecasts: np.ndarray
    observed: np.ndarray
    truth: np.ndarray
    emission: str = ""
    blend: int = 0

    def __post_init__(self) -> None:
        windows, joint = len(self.keys), (self.skeleton.joints, 3)
        shapes = [array.shape for array in (self.forecasts, self.observed, self.truth)]
        of_windows = [self.forecasts.shape[1:], *shapes[1:]]
        fit = all(len(s) == 4 and s[0] == windows and s[2:] == joint for s in of_windows) and self.forecasts.size
        if not fit or not self.observed.size or shapes[2][1] > shapes[0][2]:
            raise ValueError(
                f"expected forecasts (S, {windows}, H, {joint[0]}, 3), observed ({windows}, O, {joint[0]}, 3) and "
                f"truth ({windows}, up to H, {joint[0]}, 3), got {shapes[0]}, {shapes[1]} and {shapes[2]}"
            )
        for name, array in (("futures", self.forecasts), ("observed frames", self.observed), ("truth", self.truth)):
            invalid = np.isinf(array) if array.ndim == 4 else ~np.isfinite(array)
            invalid_windows = invalid.any((*range(array.ndim - 4), -3, -2, -1))
            if invalid_windows.any():
                split, clip, start = self.keys[int(invalid_windows.argmax())]
                raise FloatingPointError(
                    f"the {name} of the window of clip {clip!r} ({split}) from frame {start} on are NaN or infinite; "
                    "positions must be finite, except NaN for missing joints of observed and true frames"
                )

    def window(self, n: int, samples: int | None = None) -> Forecasts:
        """Return the forecasts of a single window.

        Args:
            n: index of the window.
            samples: number of futures to keep; None for all.
        """
        row = slice(n, n + 1)
        future, keys = self.forecasts[:samples, row], self.keys[row]
        return replace(self, keys=keys, forecasts=future, observed=self.observed[row], truth=self.truth[row])

    def largest_steps(self, frames: int = 1) -> tuple[float, float]:
        """Return the largest distance in metres that a joint moves between frames, in the futures and in the truth.

        Args:
            frames: number of steps after the last observed frame; the first one is the seam of past and future.

        Returns:
            The distances, NaN if the joints of no step were observed.
        """
        future, true = (
            np.linalg.norm(np.diff(np.insert(each[:, :, :frames], 0, self.observed[:, -1], 2), axis=2), axis=-1)
            for each in (self.forecasts, self.truth[None])
        )
        largest = (float(np.nanmax(distances, initial=-1)) for distances in (future, true))
        first, second = (np.nan if each < 0 else each for each in largest)
        return first, second

    def blended(self, frames: int) -> Forecasts:
        """Return futures whose first frames continue the observed motion, without a jump of any joint.

        The first frame becomes the one that the last two observed frames predict at constant velocity. The difference
        to the future, a displacement of the root and a rotation of each bone, is applied to the following frames too,
        with weights that fall from 1 to 0 along a cosine. Lengths of bones change gradually from the observed ones to
        those of the future. A joint that was missing in the last two observed frames starts as in the future.

        Args:
            frames: number of first frames to change.

        Raises:
            ValueError: the number is not between 1 and the number of frames, or the futures are blended already.
        """
        if self.blend or not 1 <= frames <= self.forecasts.shape[2]:
            raise ValueError(
                f"cannot blend {frames} frames: expected 1 to {self.forecasts.shape[2]} frames, of forecasts that are "
                f"not blended yet (these have {self.blend} blended frames)"
            )
        skeleton, future = self.skeleton, torch.from_numpy(self.forecasts[:, :, :frames]).double()
        last, before = (torch.from_numpy(self.observed[:, n]).double() for n in (-1, max(-2, -self.observed.shape[1])))
        last, expected = (torch.where(x.isfinite(), x, future[:, :, 0])[:, :, None] for x in (last, 2 * last - before))
        weight = (0.5 + 0.5 * torch.cos(pi / frames * torch.arange(frames, dtype=torch.float64)))[:, None, None]
        limbs, past_limbs, expected_limbs = (skeleton.limbs(x.flatten(-2)) for x in (future, last, expected))
        first, towards = (torch.nn.functional.normalize(x, dim=-1) for x in (limbs[:, :, :1], expected_limbs))
        turn = from_matrix(kinematics.swing(first, towards), "vector")
        lengths = torch.lerp(limbs.norm(dim=-1), past_limbs.norm(dim=-1), weight[..., 0])
        limbs = (to_matrix(weight * turn, "vector") @ torch.nn.functional.normalize(limbs, dim=-1)[..., None])[..., 0]
        limbs = lengths[..., None] * limbs
        root = (future + weight * (expected - future[:, :, :1]))[..., skeleton.root, :]
        joints = skeleton.with_root(skeleton.ends(limbs).unflatten(-1, (-1, 3))) + root[..., None, :]
        changed = joints.numpy().astype(self.forecasts.dtype)
        return replace(self, forecasts=np.concatenate([changed, self.forecasts[:, :, frames:]], 2), blend=frames)

    def motion(self) -> MotionSet:
        """Return one clip per future, including its observed frames.

        Clips are named after their window and the index of the sample, and after blending.
        """
        end = "-blended" if self.blend else ""
        return MotionSet(
            [
                Clip(split, f"{clip}-{start}-{sample}{end}".replace("/", "-"), np.concatenate([before, future]))
                for (split, clip, start), before, futures in zip(
                    self.keys, self.observed, self.forecasts.swapaxes(0, 1), strict=True
                )
                for sample, future in enumerate(futures)
            ],
            self.skeleton,
            "forecasts",
            missing=bool(np.isnan(self.observed).any()),
        )

    def save(self, path: str | Path) -> None:
        """Write an npz of plain arrays.

        Its members are `forecasts`, `observed` and `truth`; `emission` if known; `blend`; `largest_steps` after the
        last observed frame; and `split`, `clip` and `start` of each window. The skeleton has the fields of its JSON
        file: `name`, `joint_names`, `parents`, `joints_left`, `joints_right`, `up_axis`, `fps`.

        Args:
            path: path of the file.
        """
        arrays = {"forecasts": self.forecasts, "observed": self.observed, "truth": self.truth}
        arrays |= {"blend": np.array(self.blend), "largest_steps": np.array(self.largest_steps())}
        _write(path, arrays, self.keys, self.skeleton, self.emission)

    @classmethod
    def load(cls, path: str | Path) -> Forecasts:
        """Read a file that `save` wrote.

        Args:
            path: path of the file.

        Returns:
            The forecasts.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file is damaged, a member is missing, or its arrays do not match each other.
        """
        arrays = read_arrays(path)
        try:
            skeleton = Skeleton(**{field: arrays[key].tolist() for field, key in FIELDS.items()})
            if (arrays["split"].dtype.kind, arrays["clip"].dtype.kind, arrays["start"].dtype.kind) != ("U", "U", "i"):
                raise ValueError("expected text in split and clip, and whole numbers in start")
            keys = list(zip(*(arrays[name].tolist() for name in ("split", "clip", "start")), strict=True))
            motions = [arrays[name] for name in ("forecasts", "observed", "truth")]
            if any(array.dtype.kind != "f" for array in motions):
                raise ValueError("expected real numbers in forecasts, observed and truth")
            emission, blend = str(arrays.get("emission", "")), int(arrays.get("blend", 0))
            return cls(skeleton, keys, motions[0], motions[1], motions[2], emission, blend)
        except KeyError as error:
            raise ValueError(f"{path} has no member {error}; write it with `dvae forecast`") from error
        except (FloatingPointError, TypeError, ValueError) as error:
            raise ValueError(f"{path}: {error}") from error


@dataclass(frozen=True, eq=False)
class Imputed:
    """Motion whose missing joints were imputed several times, in metres.

    Args:
        skeleton: skeleton of the poses.
        keys: (split, clip, first frame) of the N windows.
        filled: (S, N, T, J, 3), S samples: observed positions, and imputed positions where joints were missing.
        observed: (N, T, J), True where a joint was observed.
        emission: same as in `Forecasts`.
    """

    skeleton: Skeleton
    keys: Sequence[tuple[str, str, int]]
    filled: np.ndarray
    observed: np.ndarray
    emission: str = ""

    @property
    def spread(self) -> np.ndarray:
        """Root mean square distance (N, T, J) in metres of a joint from its mean over samples; 0 where observed."""
        variance: np.ndarray = self.filled.var(0).sum(-1)
        return np.where(self.observed, 0.0, variance**0.5)

    def save(self, path: str | Path) -> None:
        """Write an npz: `filled`, `observed`, `spread`, and the other members of `Forecasts.save`.

        Args:
            path: path of the file.
        """
        arrays = {"filled": self.filled, "observed": self.observed, "spread": self.spread}
        _write(path, arrays, self.keys, self.skeleton, self.emission)


def _write(
    path: str | Path,
    arrays: dict[str, np.ndarray],
    keys: Sequence[tuple[str, str, int]],
    skeleton: Skeleton,
    emission: str,
) -> None:
    """Write the arrays together with the keys of their windows and the skeleton."""
    arrays |= {"emission": np.array(emission)} if emission else {}
    arrays |= zip(("split", "clip", "start"), map(np.array, zip(*keys, strict=True)), strict=True)
    for field, key in FIELDS.items():
        arrays[key] = np.array(getattr(skeleton, field), int if field in ("left", "right") else None)
    with files.atomic_write(path) as file:
        write_arrays(file, arrays.items())
