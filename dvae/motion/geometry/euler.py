"""Errors of forecast Euler angles at fixed times, for the best of K futures.

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
* The error at a time is the error at the frame nearest to it; time 0 is the last observed frame.

Aliakbarian et al., 2020, arXiv 1908.00733, score the best of K futures (K = 50, and 1 to 500): "at least one is close
to the ground truth". They call it the S-MSE of Yan et al., 2018, arXiv 1808.04545. They do not say whether the best
future is the same at all times. Here it is the same: the best future has the smallest mean error over the times, so one
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
        times: times of the forecasts, in milliseconds from the last observed frame.
        frames: the predicted frame nearest to each time; the first predicted frame is 1.
        inverse: whether rotations are estimated from positions.
        observed: number of observed frames in each sequence of `Angles`: 1, the last observed frame of the window.
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
        windows: test windows of motion.
        times: times of the forecasts, in milliseconds from the last observed frame.
        inverse: whether to estimate the rotations from positions.

    Raises:
        ValueError: no time is given, no predicted frame is nearest to a time, the windows have missing joints or no
            rotations, or the skeleton has no rest pose.
    """

    def __init__(self, windows: Windows, times: Sequence[float] = TIMES, inverse: bool = False) -> None:
        protocol, skeleton = windows.protocol, windows.skeleton
        frames = tuple(round(time * protocol.fps / 1000) for time in times)
        last = windows.length - protocol.observed
        beyond = [f"{time:g}" for time, frame in zip(times, frames, strict=True) if not 1 <= frame <= last]
        if beyond or not times:
            raise ValueError(
                f"no predicted frame is nearest to {', '.join(beyond) or 'no time'} ms: windows of {protocol.name} "
                f"predict {last} frames at {protocol.fps:g} frames per second, {1000 * last / protocol.fps:g} ms; "
                "choose at least one time, and only times in this range"
            )
        if windows.missing:
            raise ValueError(
                "a missing joint leaves the rotations of others undetermined; impute the missing joints first"
            )
        if not inverse and protocol.representation == "positions":
            raise ValueError(
                f"windows of {protocol.name} have positions, which do not determine all rotations; use a protocol "
                "whose representation is a rotation, or inverse=True (`--inverse`) to compute rotations from positions"
            )
        self.windows = windows
        self.protocol = AngleProtocol(protocol.name, protocol.fps, tuple(times), frames, inverse)
        self.joints = sorted({parent for parent, _ in skeleton.edges} - {skeleton.root})
        self.offsets = skeleton.offsets

    @property
    def keys(self) -> list[tuple[str, str, int]]:
        """Key (split, clip, first frame) of each window."""
        return self.windows.keys

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the windows and the protocol."""
        return hashlib.sha256(f"{self.windows.fingerprint} {self.protocol}".encode()).hexdigest()

    references: ClassVar = Windows.references

    @property
    def description(self) -> dict[str, Any]:
        """Entries for the record of an evaluation: names of the joints, and number of the angles that are compared."""
        names = [self.windows.skeleton.names[joint] for joint in self.joints]
        return {"joints": names, "angles": int(self.varying.sum()), "title": ["Euler angles"]}

    def all(self) -> Batch:
        """Return a batch with the angles of the N windows, and the observed frames that models read.

        The angles are "x", (N, 1 + times, A), in radians, for the A angles that vary. The observed frames are `MOTION`.
        """
        batch, observed = self._batch, self.windows.protocol.observed
        return Batch({WHOLE: self._angles[..., self.varying], MOTION: batch.past(observed)})

    @cached_property
    def varying(self) -> Tensor:
        """Mask (3 J',) of the angles that vary over the true windows; J' is the number of scored joints."""
        return self._angles.double().flatten(0, 1).std(0) > VARIES

    @cached_property
    def _batch(self) -> Batch:
        return self.windows.all()

    @cached_property
    def _angles(self) -> Tensor:
        """All angles, (N, 1 + times, 3 J'), in radians."""
        now = self.windows.protocol.observed - 1
        frames = [now, *(now + frame for frame in self.protocol.frames)]
        if self.protocol.inverse:
            return torch.cat([self.angles_of(x[:, frames]) for x in self._batch[WHOLE].split(512)])
        rotations = self._batch.view_inputs[ROTATIONS][:, frames].unflatten(-1, (-1, 4))[..., self.joints, :]
        return self.of(to_matrix(rotations, "quaternion"))

    def angles_of(self, x: Tensor) -> Tensor:
        """Return angles (..., 3 J') in radians from positions (..., D) in metres, by inverse kinematics."""
        positions = self.windows.positions(x)
        rotations = kinematics.inverse(self.windows.skeleton, positions, self.offsets.to(positions))
        return self.of(rotations[..., self.joints, :, :])

    def of(self, rotations: Tensor) -> Tensor:
        """Return angles (..., 3 J') in radians from joint rotations (..., J', 3, 3)."""
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
                "a model of positions predicts no rotations; score it with inverse=True (`--inverse`), which estimates "
                "them from positions, for all models that are compared"
            )

    def is_drawn(self, means: bool = False) -> bool:
        """Return whether forecasts are draws rather than means, as the model decides.

        Args:
            means: prefer means, as in `DynamicalVAE.is_drawn`.
        """
        return self.model.is_drawn(means) if isinstance(self.model, Emitting) else not means

    def forecast(self, batch: Batch, horizon: int, samples: int = 1, **options: Any) -> dict[str, Tensor]:
        """Return forecasts {"x": (S, B, times, A)} of the angles at all times, in radians.

        Args:
            batch: batch of `Angles`, with the observed frames of B windows.
            horizon: ignored; the `Angles` of this object determine the times.
            samples: S, number of futures of each window.
            options: further arguments of the model's `forecast`.
        """
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
        times: times of the forecasts, in milliseconds from the last observed frame.
        counts: values of K. The largest K futures are drawn; a smaller K uses the first K of them.
        inverse: whether to estimate rotations from positions; necessary if any of the models predicts positions.
        seed: seed of the draws of every model.
        batch_size: number of windows that are forecast at once, with all of their futures.
        progress: whether to show a progress bar.

    Returns:
        An evaluation with one score for each time and K, such as "400 ms, best of 50", in radians. Its standard errors
        treat windows of one clip as dependent.

    Raises:
        ValueError: `counts` is empty or below 1, a time is beyond the windows, or windows or models have no rotations
            and `inverse` is not set.
    """
    if not counts or min(counts) < 1:
        raise ValueError(
            f"`counts` needs numbers of at least 1 (futures from which the best is chosen), got {list(counts)}"
        )
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
