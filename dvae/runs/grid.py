"""Grids: files that list what a sweep fits, as named pairs of equations and methods with values of their options.

    seeds = [0, 1, 2]

    [training]                       # for all runs, in place of each method's defaults
    steps = 2000

    [filter]                         # without a method: a pair of equations
    generative = "p(z_t | z_{t-1}) p(x_t | z_t)"
    inference = "q(z_t | z_{t-1}, x_{<=t})"

    [smoother]
    generative = "p(z_t | z_{t-1}) p(x_t | z_t)"
    inference = "faithful"
    each.latent = [8, 16]            # one run for each value, or for each combination of several options

    [srnn]
    method = "srnn"

The file is TOML of at most one mebibyte. Run directories have the names in the file and the options that vary, such as
smoother-latent=8-seed0.
"""

from __future__ import annotations

import os
import re
import reprlib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import product
from typing import Any, Self

from .. import files
from ..inference.training.options import Training
from ..models import registry
from ..models.method import Method
from ..options import nearest, tuples

LARGEST = 2**20
"""Maximum size of a grid in bytes."""
MOST = 1000
"""Maximum number of methods in a grid, counted with all combinations of their options, and of seeds."""
NAME = r"\w[\w.=+-]{0,199}"
"""Pattern of the name of a run directory without its seed."""
SEEDS, TRAINING, METHOD, EACH = "seeds", "training", "method", "each"
EQUATIONS = "equations"


@dataclass(frozen=True)
class Grid:
    """Content of a grid file.

    Attributes:
        methods: {name: method with its options}.
        seeds: seeds of the runs of each method; None if the file has none.
        training: training options that replace each method's defaults.
    """

    methods: dict[str, Method]
    seeds: tuple[int, ...] | None
    training: dict[str, Any]

    @classmethod
    def read(cls, path: str | os.PathLike[str], options: Mapping[str, Any] | None = None) -> Self:
        """Read a grid from a file.

        Args:
            path: path of the TOML file.
            options: options of all methods, unless the file gives others.

        Raises:
            ValueError: the file is not TOML or not a grid, or a method, option or value is unknown; the message names
                the table.
            FileRefused, OSError: the file cannot be read, or is too large.
        """
        text = files.read(path, LARGEST, links=True)
        try:
            told = tomllib.loads(text.decode("utf-8"))
        except (ValueError, RecursionError) as error:  # bad TOML or UTF-8, too long numbers, too deep nesting
            raise ValueError(f"{path} is not TOML in UTF-8: {error}") from error
        seeds, training = told.pop(SEEDS, None), told.pop(TRAINING, {})
        if seeds is not None and not _are_seeds(seeds):
            raise ValueError(
                f"{path}: seeds is {reprlib.repr(seeds)}; it must list distinct whole numbers, such as [0, 1, 2]"
            )
        try:
            training = tuples(_training(training))
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}, [{TRAINING}]: {error}") from error
        if not told:
            raise ValueError(f"{path} names nothing to fit; give a table for each, such as [srnn] with method = 'srnn'")
        methods: dict[str, Method] = {}
        for name, table in told.items():
            if not isinstance(table, dict):
                raise ValueError(
                    f"{path}: {name} = {table!r} is in no table; only seeds and [training] apply to all runs"
                )
            try:
                found = _methods(name, table, options or {}, MOST - len(methods))
                if twice := found.keys() & methods.keys():
                    raise ValueError(f"{min(twice)} is the name of another table's run; give one of them another name")
            except (TypeError, ValueError) as error:
                raise ValueError(f"{path}, [{name}]: {error}") from error
            methods |= found
        return cls(methods, None if seeds is None else tuple(seeds), training)


def _are_seeds(told: Any) -> bool:
    whole = isinstance(told, list) and 0 < len(told) <= MOST and all(type(each) is int and each >= 0 for each in told)
    return whole and len({*told}) == len(told)


def _training(told: Any) -> dict[str, Any]:
    """Return the checked training options of all runs.

    Raises:
        TypeError, ValueError: `told` is not a table, or an option is unknown, wrong, or not available in a sweep.
    """
    if not isinstance(told, dict):
        raise ValueError(f"it must be a table of options such as steps, got {reprlib.repr(told)}")
    known = {option.name for option in fields(Training)} - {"seed", "devices"}
    for name in told:
        if name not in known:
            said = "; give seeds = [...] instead" if name == "seed" else nearest(name, known)
            raise ValueError(f"unknown training option {name!r} of a sweep{said}")
    Training(**told)
    return told


def _methods(name: str, table: Mapping[str, Any], options: Mapping[str, Any], room: int) -> dict[str, Method]:
    """Return the methods of a table by name."""
    own = {**options, **table}
    kind, each = own.pop(METHOD, EQUATIONS), own.pop(EACH, {})
    if not isinstance(kind, str) or not isinstance(each, dict):
        raise ValueError("`method` must be a name, and `each` a table of options with lists of values")
    count = 1
    for option, values in each.items():
        if not isinstance(values, list) or not values:
            raise ValueError(f"each.{option} is {values!r}; it must be a list of values, such as [8, 16]")
        if any(values.count(value) > 1 for value in values):
            raise ValueError(f"each.{option} has a value twice: {reprlib.repr(values)}")
        count *= len(values)
    if count > room:
        raise ValueError(f"{count} more methods exceed the maximum of {MOST} in a grid; leave some values out")
    found = {}
    for values in product(*each.values()):
        varied = dict(zip(each, values, strict=True))
        labels = [f"{option.replace('_', '-')}={value}" for option, value in varied.items()]
        method = registry.method(kind, **tuples({**own, **varied}))
        method.check()
        label = "-".join([name, *labels])
        if not re.fullmatch(NAME, label):
            raise ValueError(
                f"{reprlib.repr(label)} cannot name run directories; names have at most 200 letters, digits and "
                "-_.=+; give each text value its own table"
            )
        found[label] = method
    return found
