"""Errors of Euler angles at a few times, for the best of K futures.

This is the usual score of deterministic motion forecasts. Let e_t be the angles of all joints at time t, and e^k_t the
angles of future k. The error

    error_t(K) = || e_t - e^best_t ||        best = argmin_{k <= K} mean_t || e_t - e^k_t ||

is in radians, averaged over windows, at 80, 160, 320, 400, 560 and 1000 ms. The protocol is due to Fragkiadaki, Levine,
Felsen and Malik, 2015, arXiv 1508.00271, and Jain et al., 2016, arXiv 1511.05298. The details follow the public code of
Martinez, Black and Romero, 2017, arXiv 1705.02445, which later work uses:

* Joint rotations are relative to the parent. The root rotation (the orientation of the body in the world) is ignored.
* Angles are about the moving axes z, y and x. (The public code uses matrices that act on rows, which are the transposes
  of ours.) They are between -pi and pi. Differences are not wrapped, so a difference across pi is off by 2 pi.
* The norm is over all angles that vary, i.e. whose standard deviation is above 1e-4. The public code computes it over
  the frames of a forecast. We compute it over all true windows, so that all methods are scored on the same angles.
* Each time uses the nearest frame, counted from the last observed one.

Aliakbarian et al., 2020, arXiv 1908.00733, score the best of K futures (K = 50, and 1 to 500): "at least one is close
to the ground truth". They call it the S-MSE of Yan et al., 2018, arXiv 1808.04545. They do not say whether the best
future is the same at all times. Here it is: the best future has the smallest mean error over the times, so the same
future is scored at 80 ms and at 1000 ms. For smaller K, the first K of all drawn futures are used.

Rotations come from the data, and from models that output rotations. Positions do not determine how a bone is rotated
about itself. Models of positions are therefore scored with `inverse`: inverse kinematics estimates the rotations, both
of forecasts and of the truth. Errors with and without `inverse` are not comparable.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, ClassVar

import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor, nn

from ...data.batch import WHOLE, Batch
from ...data.views import Views
from ...inference.evaluation.evaluate import evaluate
from ...inference.evaluation.evaluation import Evaluation
from ...inference.evaluation.scores import Measure
from ...locking import serialized
from ...program.model import DynamicalVAE
from ...program.protocols import Emitting
from ..data.protocols import Windows
from . import kinematics
from .rotations import from_matrix, to_matrix
from .views import ROTATIONS, Rotations

TIMES = (80, 160, 320, 400, 560, 1000)
"""Milliseconds."""
COUNTS = (1, 5, 10, 50, 100, 500)
VARIES = 1e-4
"""Standard deviation of an angle, in radians, above which it is scored."""
FORM = "euler-zyx"
MOTION = "motion"
"""Name in batches of the past that models receive."""


@dataclass(frozen=True)
class AngleProtocol:
    """Settings of `Angles`.

    Args:
        name: name of the protocol of the windows.
        fps: frames per second of the windows.
        times: milliseconds from the last observed frame.
        frames: nearest predicted frames, counted from 1.
        inverse: whether rotations are estimated from positions.
        observed: number of frames in `Angles` before the times: the last observed one.
    """

    name: str
    fps: float
    times: tuple[float, ...]
    frames: tuple[int, ...]
    inverse: bool
    observed: int = 1


class Angles:
    """Euler angles of the joints in test windows: of the last observed frame, and at a few times after it.

    Args:
        windows: windows of motion.
        times: milliseconds from the last observed frame.
        inverse: estimate the rotations from positions.

    Raises:
        ValueError: no predicted frame is nearest to a time, the windows have missing joints or no rotations, or the
            skeleton has no rest pose.
    """

    def __init__(self, windows: Windows, times: Sequence[float] = TIMES, inverse: bool = False) -> None:
        protocol, skeleton = windows.protocol, windows.skeleton
        frames = tuple(round(time * protocol.fps / 1000) for time in times)
        last = windows.length - protocol.observed
        beyond = [f"{time:g}" for time, frame in zip(times, frames, strict=True) if not 1 <= frame <= last]
        if beyond or not times:
            raise ValueError(
                f"no predicted frame is nearest to {', '.join(beyond) or 'no time'} ms: windows of {protocol.name} "
                f"have {last} frames at {protocol.fps:g} a second, {1000 * last / protocol.fps:g} ms; choose others"
            )
        if windows.missing:
            raise ValueError("a missing joint leaves the rotations of others undetermined; fill the gaps first")
        if not inverse and protocol.representation == "positions":
            raise ValueError(
                f"windows of {protocol.name} have positions, which do not determine all rotations; use a protocol "
                "whose representation is a rotation, or inverse=True to compute rotations from positions"
            )
        self.windows = windows
        self.protocol = AngleProtocol(protocol.name, protocol.fps, tuple(times), frames, inverse)
        self.joints = sorted({parent for parent, _ in skeleton.edges} - {skeleton.root})
        self.offsets = skeleton.offsets

    @property
    def keys(self) -> list[tuple[str, str, int]]:
        """Keys of the windows."""
        return self.windows.keys

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the windows and the protocol."""
        return hashlib.sha256(f"{self.windows.fingerprint} {self.protocol}".encode()).hexdigest()

    references: ClassVar = Windows.references

    @property
    def description(self) -> dict[str, Any]:
        """Entries for a record: the joints, and the number of angles that are compared."""
        names = [self.windows.skeleton.names[joint] for joint in self.joints]
        return {"joints": names, "angles": int(self.varying.sum()), "title": ["Euler angles"]}

    def all(self) -> Batch:
        """Return the angles {"x": (N, 1 + times, A)}, and the past of each window that models receive."""
        batch, observed = self._batch, self.windows.protocol.observed
        return Batch({WHOLE: self._angles[..., self.varying], MOTION: batch.past(observed)})

    @cached_property
    def varying(self) -> Tensor:
        """(3 J',) mask of the angles that vary over the true windows; J' joints have children."""
        return self._angles.double().flatten(0, 1).std(0) > VARIES

    @cached_property
    def _batch(self) -> Batch:
        return self.windows.all()

    @cached_property
    def _angles(self) -> Tensor:
        """(N, 1 + times, 3 J') all angles."""
        now = self.windows.protocol.observed - 1
        frames = [now, *(now + frame for frame in self.protocol.frames)]
        if self.protocol.inverse:
            return torch.cat([self.angles_of(x[:, frames]) for x in self._batch[WHOLE].split(512)])
        rotations = self._batch.view_inputs[ROTATIONS][:, frames].unflatten(-1, (-1, 4))[..., self.joints, :]
        return self.of(to_matrix(rotations, "quaternion"))

    def angles_of(self, x: Tensor) -> Tensor:
        """Return angles (..., 3 J') of positions (..., D), by inverse kinematics."""
        positions = self.windows.positions(x)
        rotations = kinematics.inverse(self.windows.skeleton, positions, self.offsets.to(positions))
        return self.of(rotations[..., self.joints, :, :])

    def of(self, rotations: Tensor) -> Tensor:
        """Return angles (..., 3 J') of joint rotations (..., J', 3, 3)."""
        return from_matrix(rotations, FORM).flatten(-2)


class AngleModel(nn.Module):
    """Adapter that turns a model of motion into a model of angles, for `evaluate`.

    Args:
        model: model that forecasts motion.
        angles: angles to forecast.

    Raises:
        ValueError: the model does not output rotations, and `inverse` is not set.
    """

    likelihood = False  # the angles have no likelihood under the model

    def __init__(self, model: Any, angles: Angles) -> None:
        super().__init__()
        self.model, self.angles = model, angles
        self.generative, self.inference = model.generative, model.inference
        view = model.view if isinstance(model, DynamicalVAE) else None
        views = view.views if isinstance(view, Views) else (view,)
        self.rotations = next((view_of_part for view_of_part in views if isinstance(view_of_part, Rotations)), None)
        if self.rotations is None and not angles.protocol.inverse:
            raise ValueError(
                "a model of positions predicts no rotations; score it with inverse=True, which computes them from "
                "positions, and score compared models likewise"
            )

    def is_drawn(self, means: bool = False) -> bool:
        """Return whether forecasts are draws; the model decides."""
        return self.model.is_drawn(means) if isinstance(self.model, Emitting) else not means

    def forecast(self, batch: Batch, horizon: int, samples: int = 1, **options: Any) -> dict[str, Tensor]:
        """Return {"x": (S, B, times, A)}, the angles at all times; the horizon equals their number."""
        frames, inverse = self.angles.protocol.frames, self.angles.protocol.inverse
        indices, last, recorder = [frame - 1 for frame in frames], max(frames), _Recorder()
        with serialized, recorder:  # in one chunk, so that `_Recorder` sees all draws
            at_once = {} if inverse else {"chunk": 2**62}
            futures = self.model.forecast(batch[MOTION], last, samples, **options, **at_once)[WHOLE]
        if inverse:
            angles = self.angles.angles_of(futures[:, :, indices])
        else:
            assert self.rotations is not None
            turning = self.rotations.turning
            columns = [turning.index(joint) for joint in self.angles.joints]
            rotations = recorder.value[:, -last:][:, indices, 3 * self.rotations.root :].unflatten(
                -1, (len(turning), -1)
            )
            matrices = to_matrix(rotations[..., columns, :].unflatten(0, futures.shape[:2]), self.rotations.form)
            angles = self.angles.of(matrices)
        return {WHOLE: angles[..., self.angles.varying.to(angles.device)]}


class _Recorder(Messenger):
    """Record x as the model outputs it, (S B, T, D), before its conversion to positions."""

    value: Tensor

    def _pyro_post_sample(self, msg: Any) -> None:
        if msg["name"] == WHOLE:
            self.value = msg["value"]


def euler_errors(
    models: Mapping[str, Any],
    windows: Windows,
    *,
    times: Sequence[float] = TIMES,
    counts: Sequence[int] = COUNTS,
    inverse: bool = False,
    seed: int = 0,
    batch_size: int = 8,
    progress: bool = True,
) -> Evaluation:
    """Evaluate the Euler angle errors of the best of K futures, together with the zero-velocity reference.

    Args:
        models: models by name.
        windows: test windows; they need rotations unless `inverse` is set.
        times: milliseconds from the last observed frame.
        counts: values of K; the largest number is drawn, and a smaller K uses the first of them.
        inverse: estimate rotations from positions, for models of positions and those they are compared with.
        seed: seed of the draws of every model.
        batch_size: windows forecast at once, with all of their futures.
        progress: whether to show a progress bar.

    Returns:
        An evaluation with a score "400 ms, best of 50" for each time and K, clustered by clip.

    Raises:
        ValueError: a time is beyond the windows, or windows or models have no rotations and `inverse` is not set.
    """
    if not counts or min(counts) < 1:
        raise ValueError(f"the best future is chosen among at least one, got {list(counts)}")
    angles = Angles(windows, times, inverse)
    return evaluate(
        {name: AngleModel(model, angles) for name, model in models.items()},
        angles,
        scores=lambda _: _measures(angles, counts),
        samples=max(counts),
        seed=seed,
        batch_size=batch_size,
        progress=progress,
    )


def _measures(angles: Angles, counts: Sequence[int]) -> list[Measure]:
    """Return one score for each time and K."""

    @lru_cache(maxsize=1)  # scores ask for one time after the other
    def best(forecasts: Tensor, truth: Tensor, count: int) -> Tensor:
        """Return the errors (B, times) of the best of the first `count` futures."""
        errors: Tensor = (forecasts[:, :count] - truth[:, None]).norm(dim=-1)
        return errors[torch.arange(len(errors)), errors.mean(-1).argmin(1)]

    def measure(count: int, place: int, time: float) -> Measure:
        return Measure(
            f"{time:g} ms, best of {count}",
            lambda forecasts, truth, past, index: best(forecasts, truth, count)[:, place],
            "rad",
            note=note,
            of_means=True,
        )

    source = "estimated from positions" if angles.protocol.inverse else "of data and models"
    note = (
        f"Euler angles z y x of {len(angles.joints)} joints without the root, {int(angles.varying.sum())} that vary, "
        f"rotations {source}; the best future has the smallest mean error over all times"
    )
    return [measure(count, *numbered_time) for count in counts for numbered_time in enumerate(angles.protocol.times)]
