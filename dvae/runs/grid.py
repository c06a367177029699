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
"""Maximum number of methods in a grid, counting all combinations of options; also the maximum number of seeds."""
NAME = r"\w[\w.=+-]{0,199}"
"""Pattern of the name of a run directory without its seed."""
SEEDS, TRAINING, METHOD, EACH = "seeds", "training", "method", "each"
EQUATIONS = "equations"


@dataclass(frozen=True)
class Grid:
    """Content of a grid file.

    Attributes:
        methods: dictionary from the name of a run directory, without the seed, to the method with its options.
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
            document = tomllib.loads(text.decode("utf-8"))
        except (ValueError, RecursionError) as error:  # invalid TOML or UTF-8, long numbers, deep nesting
            raise ValueError(f"{path} is not TOML in UTF-8: {error}") from error
        seeds, training = document.pop(SEEDS, None), document.pop(TRAINING, {})
        if seeds is not None and not _are_seeds(seeds):
            raise ValueError(
                f"{path}: seeds is {reprlib.repr(seeds)}; it must list distinct whole numbers, such as [0, 1, 2]"
            )
        try:
            training = tuples(_training(training))
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}, [{TRAINING}]: {error}") from error
        if not document:
            raise ValueError(f"{path} names nothing to fit; give a table for each, such as [srnn] with method = 'srnn'")
        methods: dict[str, Method] = {}
        for name, table in document.items():
            if not isinstance(table, dict):
                raise ValueError(
                    f"{path}: {name} = {table!r} is in no table; move it into [training] or the table of a method"
                )
            try:
                table_methods = _methods(name, table, options or {}, MOST - len(methods))
                if duplicates := table_methods.keys() & methods.keys():
                    raise ValueError(f"two tables give a run the name {min(duplicates)}; rename one of the tables")
            except (TypeError, ValueError) as error:
                raise ValueError(f"{path}, [{name}]: {error}") from error
            methods |= table_methods
        return cls(methods, None if seeds is None else tuple(seeds), training)


def _are_seeds(value: Any) -> bool:
    if not isinstance(value, list) or not 0 < len(value) <= MOST:
        return False
    return all(type(seed) is int and seed >= 0 for seed in value) and len({*value}) == len(value)


def _training(options: Any) -> dict[str, Any]:
    """Return the checked training options of all runs.

    Raises:
        TypeError, ValueError: `options` is not a table, or an option is unknown, wrong, or not available in a sweep.
    """
    if not isinstance(options, dict):
        raise ValueError(f"it must be a table of options such as steps, got {reprlib.repr(options)}")
    option_names = {option.name for option in fields(Training)} - {"seed", "devices", "scheduled_sampling"}
    hints = {"seed": "; give seeds = [...] instead", "scheduled_sampling": "; give it as an option of the methods"}
    for name in options:
        if name not in option_names:
            hint = hints.get(name) or nearest(name, option_names)
            raise ValueError(f"unknown training option {name!r} of a sweep{hint}")
    Training(**options)
    return options


def _methods(name: str, table: Mapping[str, Any], options: Mapping[str, Any], limit: int) -> dict[str, Method]:
    """Return a dictionary from name to method, for the methods of a table; raise an error above `limit` methods."""
    settings = {**options, **table}
    kind, variations = settings.pop(METHOD, EQUATIONS), settings.pop(EACH, {})
    if not isinstance(kind, str) or not isinstance(variations, dict):
        raise ValueError("`method` must be a name, and `each` a table of options with lists of values")
    if both := variations.keys() & table.keys():
        raise ValueError(f"{', '.join(sorted(both))} has one value and several in `each`; remove one of them")
    count = 1
    for option, values in variations.items():
        if not isinstance(values, list) or not values:
            raise ValueError(f"each.{option} is {values!r}; it must be a list of values, such as [8, 16]")
        if any(values.count(value) > 1 for value in values):
            raise ValueError(f"each.{option} has a value twice: {reprlib.repr(values)}")
        count *= len(values)
    if count > limit:
        raise ValueError(f"{count} more methods would exceed the maximum of {MOST} in a grid; leave some values out")
    methods = {}
    for values in product(*variations.values()):
        varied = dict(zip(variations, values, strict=True))
        labels = [f"{option.replace('_', '-')}={value}" for option, value in varied.items()]
        method = registry.method(kind, **tuples({**settings, **varied}))
        method.check()
        label = "-".join([name, *labels])
        if not re.fullmatch(NAME, label):
            raise ValueError(
                f"{reprlib.repr(label)} cannot name run directories; names have at most 200 letters, digits and "
                "-_.=+; give each text value its own table"
            )
        methods[label] = method
    return methods
