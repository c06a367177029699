"""Schedules: values that depend on the training step, such as a KL weight, learning rate or probability.

A schedule is a frozen dataclass that is called with the global step. It has no state, so a resumed run continues its
schedules.

>>> warm_up = dvae.schedules.Ramp(0.0, 1.0, steps=100)
>>> warm_up(25), warm_up(500)
(0.25, 1.0)

KL warm-up is due to Bowman et al. (2016, arXiv 1511.06349), cosine annealing to Loshchilov and Hutter (2017, arXiv
1608.03983), cyclical annealing (a `Piecewise`) to Fu et al. (2019, arXiv 1903.10145).
"""

import math
import warnings
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import pairwise
from typing import Annotated, Any

from ...options import Range, check

Level = Annotated[float, Range()]


@dataclass(frozen=True)
class Constant:
    """The same value at every step.

    Args:
        value: value at every step.
    """

    value: Level

    def __post_init__(self) -> None:
        check(self)

    def __call__(self, step: int) -> float:
        """Return the value at a global step."""
        return float(self.value)


@dataclass(frozen=True)
class _Rise:
    """Change from `start` to `end` in `steps` steps, after `delay` steps at `start`; then constant."""

    start: Level
    end: Level
    steps: int
    delay: int = 0

    def __post_init__(self) -> None:
        check(self)
        if self.steps < 1 or self.delay < 0:
            name = type(self).__name__
            raise ValueError(
                f"{name} needs steps of at least 1 and a delay of at least 0, got steps={self.steps} and "
                f"delay={self.delay}; use Constant for a value that does not change"
            )

    def __call__(self, step: int) -> float:
        """Return the value at a global step."""
        elapsed = min(max((step - self.delay) / self.steps, 0.0), 1.0)
        share = self._share(elapsed)
        return (1 - share) * self.start + share * self.end

    def _share(self, elapsed: float) -> float:
        """Return the share of the change after `elapsed` (0 to 1) of the steps."""
        raise NotImplementedError


@dataclass(frozen=True)
class Ramp(_Rise):
    """Linear change from `start` to `end` in `steps` steps, after `delay` steps at `start`; then constant.

    Args:
        start: value until step `delay`.
        end: value from step `delay + steps` on.
        steps: number of steps of the change, at least 1.
        delay: number of steps before the change, at least 0.

    Raises:
        ValueError: `steps` or `delay` is too small, or a value is invalid.
    """

    def _share(self, elapsed: float) -> float:
        return elapsed


@dataclass(frozen=True)
class Cosine(_Rise):
    """Half a cosine wave from `start` to `end` in `steps` steps, after `delay` steps: slow, fast, slow.

    Args:
        start: value until step `delay`.
        end: value from step `delay + steps` on.
        steps: number of steps of the change, at least 1.
        delay: number of steps before the change, at least 0.

    Raises:
        ValueError: `steps` or `delay` is too small, or a value is invalid.
    """

    def _share(self, elapsed: float) -> float:
        return (1 - math.cos(math.pi * elapsed)) / 2


@dataclass(frozen=True)
class Logistic(_Rise):
    """Logistic curve from `start` to `end`, rescaled to reach both ends exactly.

    Args:
        start: value before and at `delay`.
        end: value from `delay + steps` on.
        steps: number of steps of the change.
        delay: number of steps at `start` before the change.
        steepness: slope in the middle; towards 0 the curve becomes linear, for large values a jump.
    """

    steepness: Annotated[float, Range(1e-9, 1e9)] = 10.0

    def _share(self, elapsed: float) -> float:
        half = math.tanh(self.steepness / 4)
        return (math.tanh(self.steepness * (elapsed - 0.5) / 2) + half) / (2 * half)


@dataclass(frozen=True)
class Saturating(_Rise):
    """Exponential saturation from `start` to `end`: 1 - e^{-steepness s} at a share s of the steps, rescaled.

    The first n steps of the endless schedule 1 - q^step are `Saturating(0.0, 1 - q**n, n, steepness=-n * log(q))`.

    Args:
        start: value before and at `delay`.
        end: value from `delay + steps` on.
        steps: number of steps of the change.
        delay: number of steps at `start` before the change.
        steepness: number of time constants in `steps`: the distance to the asymptote falls by a factor of e in each.
            Towards 0 the curve becomes linear.
    """

    steepness: Annotated[float, Range(1e-9, 1e9)] = 3.0

    def _share(self, elapsed: float) -> float:
        return math.expm1(-self.steepness * elapsed) / math.expm1(-self.steepness)


@dataclass(frozen=True)
class Piecewise:
    """Linear interpolation of `(step, value)` points; two points at one step make a jump.

    The value is constant before the first and after the last point.

    Args:
        points: pairs (step, value) in the order of steps, at least one.

    Raises:
        ValueError: there are no points, steps are not in order, or a value is not finite.

    Example:
        Piecewise(((0, 0.0), (500, 1.0), (1000, 1.0), (1000, 0.0), (1500, 1.0)))  # two annealing cycles
    """

    points: tuple[tuple[int, float], ...]

    def __post_init__(self) -> None:
        points = tuple((int(step), float(value)) for step, value in self.points)
        if not all(math.isfinite(value) for _, value in points):
            raise ValueError(f"all values of Piecewise must be finite, got the points {points}")
        if not points or any(later[0] < earlier[0] for earlier, later in pairwise(points)):
            raise ValueError(f"Piecewise needs at least one point, and points in the order of steps, got {points}")
        object.__setattr__(self, "points", points)

    def __call__(self, step: int) -> float:
        """Return the value at a global step; at a jump, the value after it."""
        after = bisect_right(self.points, step, key=lambda point: point[0])
        if after == 0:
            return self.points[0][1]
        if after == len(self.points):
            return self.points[-1][1]
        (left, low), (right, high) = self.points[after - 1 : after + 1]
        share = (step - left) / (right - left)
        return (1 - share) * low + share * high


Schedule = Constant | Ramp | Cosine | Logistic | Saturating | Piecewise
_SCHEDULES = {kind.__name__: kind for kind in (Constant, Ramp, Cosine, Logistic, Saturating, Piecewise)}
_FORMER = {"Linear": "Ramp"}
"""Former names of schedules in configs."""


def schedule(value: float | Schedule) -> Schedule:
    """Return a number as a `Constant` schedule, and a schedule unchanged.

    Args:
        value: number or schedule.

    Raises:
        TypeError: for anything else.
    """
    if isinstance(value, Schedule):
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"expected a number or a schedule ({', '.join(_SCHEDULES)}), got {value!r}")
    return Constant(float(value))


def levels(value: float | Schedule) -> tuple[float, ...]:
    """Return values whose closed range contains all values of a number or schedule.

    Args:
        value: number or schedule.

    Raises:
        TypeError: the value is neither a number nor a schedule.
    """
    match schedule(value):
        case Constant(level):
            return (level,)
        case Piecewise(points):
            return tuple(level for _, level in points)
        case ramp:
            return ramp.start, ramp.end


def clamp(value: Any, steps: int, name: str = "") -> Any:
    """Return `value` with every schedule in it shortened to end by `steps`; warn about each change.

    A schedule that is too long is compressed as a whole, delay and steps in proportion, so that it reaches its end
    value. Mappings and dataclasses are searched for schedules; anything else is returned unchanged.

    Args:
        value: a schedule, a mapping or dataclass with schedules, or anything else.
        steps: number of steps of the training.
        name: name of the value, for warnings.
    """
    if isinstance(value, Schedule):
        end = _end(value)
        if end <= steps:
            return value
        clamped = _compress(value, steps)
        warnings.warn(
            f"the schedule{name and ' of '}{name} needs {end} steps, but training has {steps}: "
            f"it is shortened to {steps}"
        )
        return clamped
    if isinstance(value, Mapping):
        items = value
    elif is_dataclass(value) and not isinstance(value, type):
        items = {field.name: getattr(value, field.name) for field in fields(value) if field.init}
    else:
        return value
    changes = {
        key: new for key, item in items.items() if (new := clamp(item, steps, f"{name}{name and '.'}{key}")) is not item
    }
    if not changes:
        return value
    return {**value, **changes} if isinstance(value, Mapping) else replace(value, **changes)


def _end(value: Schedule) -> int:
    """Return the step where the schedule becomes constant."""
    match value:
        case Constant():
            return 0
        case Piecewise():
            return value.points[-1][0]
        case _:
            return value.delay + value.steps


def _compress(value: Schedule, steps: int) -> Schedule:
    match value:
        case Constant():
            return value
        case Piecewise():
            last = value.points[-1][0]
            return Piecewise(tuple((step * steps // last, level) for step, level in value.points))
        case _:
            delay = min(value.delay * steps // (value.delay + value.steps), steps - 1)
            return replace(value, delay=delay, steps=steps - delay)


def to_config(value: Any) -> Any:
    """Return a schedule as a JSON object whose key "schedule" names its class.

    Numbers, text and None are returned unchanged; mappings and sequences are searched.

    Args:
        value: schedule, number, text or None, or a mapping or sequence of these.

    Raises:
        TypeError: for a value that JSON cannot represent.
    """
    if isinstance(value, Schedule):
        arguments = {field.name: to_config(getattr(value, field.name)) for field in fields(value)}
        return {"schedule": type(value).__name__, **arguments}
    if isinstance(value, Mapping):
        return {key: to_config(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_config(item) for item in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"expected numbers, text and schedules, got {value!r} of type {type(value).__name__}")


def from_config(config: Any) -> Any:
    """Return the value that `to_config` converted.

    Args:
        config: result of `to_config`, as read from JSON.

    Raises:
        ValueError: when "schedule" is not the name of a schedule, or its arguments do not fit.
    """
    if isinstance(config, list | tuple):
        return tuple(from_config(item) for item in config)
    if not isinstance(config, Mapping):
        return config
    arguments = {key: from_config(item) for key, item in config.items() if key != "schedule"}
    if "schedule" not in config:
        return arguments
    name = _FORMER.get(config["schedule"], config["schedule"])
    if name not in _SCHEDULES:
        raise ValueError(f"unknown schedule {name!r}; the schedules are {', '.join(_SCHEDULES)}")
    kind = _SCHEDULES[name]
    names = [field.name for field in fields(kind)]
    try:
        return kind(**arguments)
    except TypeError as error:
        raise ValueError(f"{name} takes {', '.join(names)}; the config gives {', '.join(arguments)}") from error
