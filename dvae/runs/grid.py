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
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, Self

from .. import files
from ..models import registry
from ..models.method import Method
from ..options import tuples

LARGEST = 2**20
"""Bytes of a grid."""
MOST = 10_000
"""Methods of a grid, with all their options."""
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
        try:
            told = tomllib.loads(files.read(path, LARGEST, links=True).decode("utf-8"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"{path} is not TOML in UTF-8: {error}") from error
        seeds, training = told.pop(SEEDS, None), told.pop(TRAINING, {})
        if seeds is not None and not (isinstance(seeds, list) and seeds and all(type(each) is int for each in seeds)):
            raise ValueError(f"{path}: seeds are some whole numbers, such as [0, 1, 2], not {seeds!r}")
        if not isinstance(training, dict):
            raise ValueError(f"{path}: [training] is a table, of options such as steps, not {training!r}")
        if not told:
            raise ValueError(f"{path} names nothing to fit; give a table for each, such as [srnn] with method = 'srnn'")
        methods: dict[str, Method] = {}
        for name, table in told.items():
            if not isinstance(table, dict):
                raise ValueError(f"{path}: {name} = {table!r} is in no table; of all runs are seeds and [training]")
            try:
                methods |= _methods(name, table, options or {}, MOST - len(methods))
            except (TypeError, ValueError) as error:
                raise ValueError(f"{path}, [{name}]: {error}") from error
        return cls(methods, None if seeds is None else tuple(seeds), tuples(training))


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
        count *= len(values)
    if count > room:
        raise ValueError(f"with {count} methods more the grid has over {MOST}; leave some values out")
    found = {}
    for values in product(*each.values()):
        varied = dict(zip(each, values, strict=True))
        labels = [f"{option.replace('_', '-')}={value}" for option, value in varied.items()]
        method = registry.method(kind, **tuples({**own, **varied}))
        method.check()
        found["-".join([name, *labels])] = method
    if len(found) < count:
        raise ValueError(f"each has a value twice: {each}")
    return found
