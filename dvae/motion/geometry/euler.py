"""Errors of Euler angles at a few times, the score of deterministic forecasts of motion, for the best of K futures.

With e_t the angles of all joints at time t, and e^k_t those of future k,

    error_t(K) = || e_t - e^best_t ||        best = argmin_{k <= K} mean_t || e_t - e^k_t ||

in radians, the mean over windows, at 80, 160, 320, 400, 560 and 1000 ms. The protocol is that of Fragkiadaki, Levine,
Felsen and Malik, 2015, arXiv 1508.00271, and Jain et al., 2016, arXiv 1511.05298, as the public code of Martinez, Black
and Romero, 2017, arXiv 1705.02445, has it, from which later work takes it:

* Rotations are of joints against their parents. That of the root, which is the body's in the world, is left out.
* Angles are about z, y and x, axes that turn along. (That code has them of matrices that act on rows, which are the
  transposed ones.) They are between -pi and pi, and differences of them are taken as they are: one that passes pi is
  off by 2 pi.
* The norm is over all angles that vary: those whose standard deviation is above 1e-4. There it is over the frames of a
  forecast, here over those of all true windows, so that all methods are scored on the same angles.
* A time is that of the nearest frame, counted from the last observed one.

The best of K futures stands for all of them in Aliakbarian et al., 2020, arXiv 1908.00733, who call it the S-MSE of Yan
et al., 2018, arXiv 1808.04545: "at least one is close to the ground truth" (K = 50, and 1 to 500). They do not say
whether one future is the best at all times. Here it is: the best by its mean error over the times, so that what is
scored at 1000 ms is the future that is scored at 80 ms. Fewer futures are the first of the most.

Turns are those of the data, and of models that make turns. Positions do not tell how a bone is turned about itself:
models that make them are scored with `inverse`, by turns that inverse kinematics finds in positions, of what models
make and of the truth alike. Errors by the one and by the other do not compare.
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
from ...program.model import DynamicalVAE
from ...program.protocols import Emitting
from ...turns import alone
from ..data.protocols import Windows
from . import kinematics
from .rotations import from_matrix, to_matrix
from .views import TURNS, Rotations

TIMES = (80, 160, 320, 400, 560, 1000)
"""Milliseconds."""
COUNTS = (1, 5, 10, 50, 100, 500)
VARIES = 1e-4
"""Standard deviation of an angle, in radians, above which it counts."""
FORM = "euler-zyx"
MOTION = "motion"
"""Name in batches of the past as models are given it."""


@dataclass(frozen=True)
class AngleProtocol:
    """What `Angles` are of.

    Args:
        name: of the protocol of the windows.
        fps: of these.
        times: milliseconds from the last observed frame.
        frames: that are nearest to them, from 1.
        inverse: whether turns are found in positions.
        observed: frames of an `Angles` before the times: the last observed one.
    """

    name: str
    fps: float
    times: tuple[float, ...]
    frames: tuple[int, ...]
    inverse: bool
    observed: int = 1


class Angles:
    """Held-out windows as Euler angles of joints: of the last observed frame, and at a few times after it.

    Args:
        windows: of motion.
        times: milliseconds from the last observed frame.
        inverse: find the turns in positions.

    Raises:
        ValueError: a time that no predicted frame is nearest to, windows that lack joints or the turns of them, or a
            skeleton without rest pose.
    """

    def __init__(self, windows: Windows, times: Sequence[float] = TIMES, inverse: bool = False) -> None:
        protocol, skeleton = windows.protocol, windows.skeleton
        frames = tuple(round(time * protocol.fps / 1000) for time in times)
        last = windows.length - protocol.observed
        beyond = [f"{time:g}" for time, frame in zip(times, frames, strict=True) if not 1 <= frame <= last]
        if beyond or not times:
            raise ValueError(
                f"no predicted frame is nearest to {', '.join(beyond) or 'no time'} ms: windows of {protocol.name} go "
                f"on for {last} frames at {protocol.fps:g} a second, {1000 * last / protocol.fps:g} ms; choose others"
            )
        if windows.missing:
            raise ValueError("a joint that is missing leaves the turns of others open; fill the gaps first")
        if not inverse and protocol.representation == "positions":
            raise ValueError(
                f"windows of {protocol.name} are of positions, which do not tell all turns; take a protocol whose "
                "representation is one of turns, or inverse=True for those that positions tell"
            )
        self.windows = windows
        self.protocol = AngleProtocol(protocol.name, protocol.fps, tuple(times), frames, inverse)
        self.joints = sorted({parent for parent, _ in skeleton.edges} - {skeleton.root})
        self.offsets = skeleton.offsets

    @property
    def keys(self) -> list[tuple[str, str, int]]:
        """Of the windows."""
        return self.windows.keys

    @property
    def fingerprint(self) -> str:
        """Of the windows and the protocol."""
        return hashlib.sha256(f"{self.windows.fingerprint} {self.protocol}".encode()).hexdigest()

    references: ClassVar = Windows.references

    @property
    def description(self) -> dict[str, Any]:
        """How many angles are compared, and of which joints."""
        names = [self.windows.skeleton.names[joint] for joint in self.joints]
        return {"joints": names, "angles": int(self.varying.sum()), "title": ["Euler angles"]}

    def all(self) -> Batch:
        """The angles {"x": (N, 1 + times, A)}, and what models are given of each window."""
        batch, observed = self._batch, self.windows.protocol.observed
        return Batch({WHOLE: self._angles[..., self.varying], MOTION: batch.past(observed)})

    @cached_property
    def varying(self) -> Tensor:
        """(3 J',) which angles of the joints that turn vary over the true windows."""
        return self._angles.double().flatten(0, 1).std(0) > VARIES

    @cached_property
    def _batch(self) -> Batch:
        return self.windows.all()

    @cached_property
    def _angles(self) -> Tensor:
        """(N, 1 + times, 3 J')."""
        now = self.windows.protocol.observed - 1
        frames = [now, *(now + frame for frame in self.protocol.frames)]
        if self.protocol.inverse:
            return torch.cat([self.found(x[:, frames]) for x in self._batch[WHOLE].split(512)])
        turns = self._batch.beside[TURNS][:, frames].unflatten(-1, (-1, 4))[..., self.joints, :]
        return self.of(to_matrix(turns, "quaternion"))

    def found(self, x: Tensor) -> Tensor:
        """Angles (..., 3 J') of positions (..., D), by inverse kinematics."""
        positions = self.windows.positions(x)
        turns = kinematics.inverse(self.windows.skeleton, positions, self.offsets.to(positions))
        return self.of(turns[..., self.joints, :, :])

    def of(self, turns: Tensor) -> Tensor:
        """Angles (..., 3 J') of the turns of joints (..., J', 3, 3)."""
        return from_matrix(turns, FORM).flatten(-2)


class Angled(nn.Module):
    """A model of motion as one of angles, for `evaluate`.

    Args:
        model: that forecasts.
        angles: which ones.

    Raises:
        ValueError: a model that makes no turns, where they are not to be found in positions.
    """

    likelihood = False  # what is scored is not the model's own

    def __init__(self, model: Any, angles: Angles) -> None:
        super().__init__()
        self.model, self.angles = model, angles
        self.generative, self.inference = model.generative, model.inference
        view = model.view if isinstance(model, DynamicalVAE) else None
        views = view.views if isinstance(view, Views) else (view,)
        self.turns = next((each for each in views if isinstance(each, Rotations)), None)
        if self.turns is None and not angles.protocol.inverse:
            raise ValueError(
                "a model of positions makes no turns; score it with inverse=True, by those that positions tell, and "
                "what it is compared with likewise"
            )

    def is_drawn(self, means: bool = False) -> bool:
        """As the model decides."""
        return self.model.is_drawn(means) if isinstance(self.model, Emitting) else not means

    def forecast(self, batch: Batch, horizon: int, samples: int = 1, **options: Any) -> dict[str, Tensor]:
        """{"x": (S, B, times, A)}, angles at all times, of which there are as many as the horizon."""
        frames, inverse = self.angles.protocol.frames, self.angles.protocol.inverse
        places, last, made = [frame - 1 for frame in frames], max(frames), _Made()
        with alone, made:  # at once, where it is seen
            at_once = {} if inverse else {"chunk": 2**62}
            futures = self.model.forecast(batch[MOTION], last, samples, **options, **at_once)[WHOLE]
        if inverse:
            found = self.angles.found(futures[:, :, places])
        else:
            assert self.turns is not None
            turning = self.turns.turning
            wanted = [turning.index(joint) for joint in self.angles.joints]
            seen = made.value[:, -last:][:, places, 3 * self.turns.root :].unflatten(-1, (len(turning), -1))
            turns = to_matrix(seen[..., wanted, :].unflatten(0, futures.shape[:2]), self.turns.form)
            found = self.angles.of(turns)
        return {WHOLE: found[..., self.angles.varying.to(found.device)]}


class _Made(Messenger):
    """Keeps x as a model makes it, (S B, T, D), before it is shown as positions."""

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
    """Errors of Euler angles of the best of K futures, beside zero velocity: see the file.

    Args:
        models: by name.
        windows: held-out ones. With turns, unless `inverse`.
        times: in milliseconds.
        counts: K; the most are drawn, and fewer are the first of them.
        inverse: find the turns in positions, for models that make positions and what they are compared with.
        seed: of the draws of every model.
        batch_size: windows forecast at once, with all of their futures.
        progress: whether to show a progress bar.

    Returns:
        An evaluation with a score "400 ms, best of 50" for each time and number, clustered by clip.

    Raises:
        ValueError: times beyond the windows, or windows or models without turns where they are not to be found.
    """
    if not counts or min(counts) < 1:
        raise ValueError(f"the best is of at least one future, got {list(counts)}")
    angles = Angles(windows, times, inverse)
    return evaluate(
        {name: Angled(model, angles) for name, model in models.items()},
        angles,
        scores=lambda _: _measures(angles, counts),
        samples=max(counts),
        seed=seed,
        batch_size=batch_size,
        progress=progress,
    )


def _measures(angles: Angles, counts: Sequence[int]) -> list[Measure]:
    """A score for each time and number."""

    @lru_cache(maxsize=1)  # times come one after the other
    def best(forecasts: Tensor, truth: Tensor, count: int) -> Tensor:
        """Errors (B, times) of the best of the first futures."""
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

    source = "found in positions" if angles.protocol.inverse else "of data and models"
    note = (
        f"Euler angles z y x of {len(angles.joints)} joints without the root, {int(angles.varying.sum())} that vary, "
        f"turns {source}; the best future is that over all times"
    )
    return [measure(count, *each) for count in counts for each in enumerate(angles.protocol.times)]
