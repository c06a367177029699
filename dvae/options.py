"""Validate options: fields of frozen dataclasses whose types define the allowed values.

    width: Size = 64                                       at least 1 and at most 16384
    keep: Share = 0.15                                     between 0 and 1
    noise: Annotated[float, Range(0, 1, below=True)] = 0   at least 0 and below 1
    loss: Literal["evidence", "best-of-many"] = ...        one of these

Options are also read from the files of a run, which may come from an untrusted source. `check` therefore rejects values
such as a width of a million or 40 processes before anything is allocated.
"""

from __future__ import annotations

import difflib
import reprlib
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cache
from math import inf
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

LONGEST = 10_000
"""Maximum number of characters of a string, and of entries of a tuple of strings or of a mapping."""
DEEPEST = 64
"""Maximum number of layers, and thus of entries of a tuple that does not contain strings."""


@dataclass(frozen=True)
class Range:
    """A range of allowed numbers.

    Args:
        least, most: lower and upper end of the range.
        above: whether to exclude the lower end.
        below: whether to exclude the upper end. Infinite ends are always excluded.
    """

    least: float = -inf
    most: float = inf
    above: bool = False
    below: bool = False

    def __contains__(self, value: Any) -> bool:
        low = value > self.least if self.above or self.least == -inf else value >= self.least
        return bool(low and (value < self.most if self.below or self.most == inf else value <= self.most))

    def __str__(self) -> str:
        if (self.least, self.most, self.above, self.below) == (0, 1, False, False):
            return "between 0 and 1"
        low = f"{'above' if self.above else 'at least'} {self.least}"
        if self.least == -inf or self.most == inf:
            return "finite" if self.least == -inf else f"finite and {low}"
        return f"{low} and {'below' if self.below else 'at most'} {self.most}"


Count = Annotated[int, Range(1, 10**9)]
"""A number of steps, draws or frames."""
Delay = Annotated[int, Range(0, 10**9)]
"""A number of steps, possibly zero."""
Frames = Annotated[int, Range(1, 200_000)]
"""The length of a sequence in steps."""
Size = Annotated[int, Range(1, 16384)]
"""The dimension of a variable, a layer or a state."""
Extra = Annotated[int, Range(0, 16384)]
"""The dimension of a variable or layer that can be omitted."""
Layers = Annotated[int, Range(1, DEEPEST)]
Share = Annotated[float, Range(0, 1)]
"""A fraction or probability."""
Amount = Annotated[float, Range(0)]
"""A finite non-negative number, such as a weight."""
Positive = Annotated[float, Range(0, above=True)]


def check(options: Any) -> None:
    """Check that every field of a dataclass has its declared type and range.

    Args:
        options: instance of the dataclass.

    Raises:
        TypeError: a value has another type.
        ValueError: a value is out of range or not an allowed name; the message suggests the nearest name.
    """
    kind: Any = type(options)
    for name, hint in _hints(kind).items():
        if (error := problem(name, getattr(options, name), hint)) is not None:
            raise error


def require(hint: Any, **values: Any) -> None:
    """Check that arguments have a given type and range.

    Args:
        hint: allowed type, such as `Size` or `Literal["a", "b"]`.
        values: arguments by name; errors contain the name.

    Raises:
        TypeError, ValueError: as in `check`.
    """
    for name, value in values.items():
        if (error := problem(name, value, hint)) is not None:
            raise error


def problem(name: str, value: Any, hint: Any) -> Exception | None:
    """Return the error for a value that does not match its type, or None if it does.

    Args:
        name: name of the option, for the message.
        value: value of the option.
        hint: allowed type, as in `require`.
    """
    origin, arguments = get_origin(hint), get_args(hint)
    message = f"{name} is {reprlib.repr(value)}"
    if origin is Annotated:
        ranges = [each for each in arguments[1:] if isinstance(each, Range)]
        error = problem(name, value, arguments[0])
        if error is None and ranges and value not in ranges[0]:
            error = ValueError(f"{message}; it must be {ranges[0]}")
        return error
    if origin in (Union, UnionType):
        problems = [problem(name, value, each) for each in arguments]
        errors = [each for each, hint in zip(problems, arguments, strict=True) if hint is not NoneType]
        return None if None in problems else next((each for each in errors if isinstance(each, ValueError)), errors[0])
    if origin is Literal:
        if any(type(value) is type(each) and value == each for each in arguments):
            return None
        suggestion = (
            nearest(value, filter(lambda each: isinstance(each, str), arguments)) if isinstance(value, str) else ""
        )
        return ValueError(f"unknown {name} {reprlib.repr(value)}{suggestion}; known: {', '.join(map(str, arguments))}")
    if origin is tuple:
        return _problem_of_entries(name, value, arguments)
    if hint is int:
        if not isinstance(value, Integral) or isinstance(value, bool):
            return TypeError(f"{message}; it must be a whole number")
        return (
            None
            if -(2**63) <= int(value) < 2**63
            else ValueError(f"{message}; it must be at least -2^63 and below 2^63")
        )
    if hint is float:
        if not isinstance(value, Real):
            return TypeError(f"{message}; it must be a number")
        too_large = isinstance(value, Integral) and abs(int(value)) > sys.float_info.max
        return (
            ValueError(f"{message}; it must be a finite number in the range of a float")
            if too_large or value != value
            else None
        )
    kind = origin or hint
    if getattr(kind, "_is_protocol", False):  # not checked: unrelated objects may match its structure
        return None
    if isinstance(kind, type) and kind is not Any and not isinstance(value, kind):
        return TypeError(f"{message}; it must be {'true or false' if kind is bool else 'of type ' + kind.__name__}")
    if isinstance(value, str | Mapping) and len(value) > LONGEST:
        return ValueError(f"{message}, with {len(value)} characters or entries; it must have {LONGEST} at most")
    if isinstance(value, Mapping) and len(arguments) == 2:
        parts = [(f"{name}'s key", key, arguments[0]) for key in value]
        parts += [(f"{name}[{key!r}]", item, arguments[1]) for key, item in value.items()]
        return next((error for part in parts if (error := problem(*part)) is not None), None)
    return None


def tuples(options: Mapping[str, Any]) -> dict[str, Any]:
    """Convert lists to tuples in options read from JSON."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in options.items()}


def flat(options: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (dotted name, value) of every option of a nested configuration, such as ("training.steps", 100)."""
    for name, value in options.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def nearest(name: str, candidates: Iterable[str]) -> str:
    """Return " (did you mean ...?)" with the most similar known name, or "" if no name is similar."""
    close = difflib.get_close_matches(name[:LONGEST], list(candidates), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def kind_of(value: Any) -> str:
    """Return "the class Recurrent" or "a Recurrent", for messages.

    >>> kind_of(int), kind_of(3)
    ('the class int', 'a int')
    """
    return f"the class {value.__name__}" if isinstance(value, type) else f"a {type(value).__name__}"


def _problem_of_entries(name: str, value: Any, hints: tuple[Any, ...]) -> Exception | None:
    if not isinstance(value, tuple | list):
        is_entry = hints[1:] == (Ellipsis,) and problem(name, value, hints[0]) is None
        return TypeError(
            f"{name} is {reprlib.repr(value)}; it must be a tuple{f', such as {(value,)}' if is_entry else ''}"
        )
    if hints[1:] == (Ellipsis,):
        longest = LONGEST if hints[0] is str else DEEPEST
        if len(value) > longest:
            return ValueError(f"{name} has {len(value)} entries; it must have {longest} at most")
        hints = hints[:1] * len(value)
    if len(value) != len(hints):
        return ValueError(f"{name} is {reprlib.repr(value)}; it must have {len(hints)} entries")
    problems = (problem(f"{name}[{index}]", *entry) for index, entry in enumerate(zip(value, hints, strict=True)))
    return next((error for error in problems if error is not None), None)


@cache
def _hints(kind: type) -> dict[str, Any]:
    """Return {name of a field: its type}; {} if a type name of the dataclass cannot be resolved here."""
    try:
        hints = get_type_hints(kind, include_extras=True)
    except NameError:
        return {}
    return {field.name: hints[field.name] for field in fields(kind)}
