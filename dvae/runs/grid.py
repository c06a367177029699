"""Grids: what a sweep fits, as a file says it; named pairs of equations and methods, with options and their values.

    seeds = [0, 1, 2]

    [training]                       # of all runs, where it is not each method's own
    steps = 2000

    [filter]                         # where no method is named, a pair of equations
    generative = "p(z_t | z_{t-1}) p(x_t | z_t)"
    inference = "q(z_t | z_{t-1}, x_{<=t})"

    [smoother]
    generative = "p(z_t | z_{t-1}) p(x_t | z_t)"
    inference = "faithful"
    each.latent = [8, 16]            # a run for each value, and for each combination where there are several

    [srnn]
    method = "srnn"

The file is TOML, at most a mebibyte long. Run directories have the names of the file, with the options that vary:
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
"""Bytes of a grid."""
MOST = 1000
"""Methods of a grid, with all their options, and seeds."""
NAME = r"\w[\w.=+-]{0,199}"
"""Of a run directory, before its seed."""
SEEDS, TRAINING, METHOD, EACH = "seeds", "training", "method", "each"
EQUATIONS = "equations"


@dataclass(frozen=True)
class Grid:
    """What a file says.

    Attributes:
        methods: name to method with its options.
        seeds: of the runs of each; None where the file has none.
        training: options that are not each method's own.
    """

    methods: dict[str, Method]
    seeds: tuple[int, ...] | None
    training: dict[str, Any]

    @classmethod
    def read(cls, path: str | os.PathLike[str], options: Mapping[str, Any] | None = None) -> Self:
        """From a file.

        Args:
            path: of the TOML file.
            options: of all methods, where the file says nothing else.

        Raises:
            ValueError: no TOML, or what is no grid, naming the table; methods, options or values that there are not.
            FileRefused, OSError: the file cannot be read, or is too large.
        """
        text = files.read(path, LARGEST, links=True)
        try:
            told = tomllib.loads(text.decode("utf-8"))
        except (ValueError, RecursionError) as error:  # of TOML, of UTF-8, of numbers and nesting without end
            raise ValueError(f"{path} is not TOML in UTF-8: {error}") from error
        seeds, training = told.pop(SEEDS, None), told.pop(TRAINING, {})
        if seeds is not None and not _are_seeds(seeds):
            raise ValueError(
                f"{path}: seeds are some whole numbers, each once, such as [0, 1, 2], not {reprlib.repr(seeds)}"
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
                raise ValueError(f"{path}: {name} = {table!r} is in no table; of all runs are seeds and [training]")
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
    """Options of the training of all runs.

    Raises:
        TypeError, ValueError: something else, or what is no option, or none of a sweep.
    """
    if not isinstance(told, dict):
        raise ValueError(f"it is a table, of options such as steps, not {reprlib.repr(told)}")
    known = {option.name for option in fields(Training)} - {"seed", "devices"}
    for name in told:
        if name not in known:
            said = "; seeds = [...] says it" if name == "seed" else nearest(name, known)
            raise ValueError(f"there is no option {name!r} of all runs{said}")
    Training(**told)
    return told


def _methods(name: str, table: Mapping[str, Any], options: Mapping[str, Any], room: int) -> dict[str, Method]:
    """The methods of a table, by what they are called."""
    own = {**options, **table}
    kind, each = own.pop(METHOD, EQUATIONS), own.pop(EACH, {})
    if not isinstance(kind, str) or not isinstance(each, dict):
        raise ValueError("method is a name, and each a table of options with lists of values")
    count = 1
    for option, values in each.items():
        if not isinstance(values, list) or not values:
            raise ValueError(f"each.{option} is {values!r}; it must be a list of values, such as [8, 16]")
        if any(values.count(value) > 1 for value in values):
            raise ValueError(f"each.{option} has a value twice: {reprlib.repr(values)}")
        count *= len(values)
    if count > room:
        raise ValueError(f"with {count} methods more the grid has over {MOST}; leave some values out")
    found = {}
    for values in product(*each.values()):
        varied = dict(zip(each, values, strict=True))
        labels = [f"{option.replace('_', '-')}={value}" for option, value in varied.items()]
        method = registry.method(kind, **tuples({**own, **varied}))
        method.check()
        label = "-".join([name, *labels])
        if not re.fullmatch(NAME, label):
            raise ValueError(
                f"{reprlib.repr(label)} is to be the name of run directories, at most 200 letters, digits and -_.=+; "
                "give values that are texts a table each"
            )
        found[label] = method
    return found
