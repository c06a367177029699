"""Schemas: what a model must know of data to be built for them, without the data themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from torch import Tensor

from ..distributions.base import LawSpec
from ..options import Frames, Size, check
from .sequences import ArrayWindows, Sequences, refuse_table, sequences
from .units import Coordinate
from .views import View


class SchemaError(ValueError):
    """Data of which less is known than a method needs to know."""


@dataclass(frozen=True)
class Schema:
    """Sequences of numbers. What is known of other kinds of data is added by a subclass.

    Args:
        sizes: dimension of every variable of the data, context included, such as {"x": 48}, as models see them.
        length: T, steps of a sequence; None where they differ, or nobody knows.
        observed: O, the steps that forecasts start from; None likewise.

    Raises:
        TypeError, ValueError: sizes or lengths that are none.
    """

    kind: ClassVar[str] = "sequences"
    per: ClassVar[str] = "frame"
    """What bounds are per."""

    sizes: Mapping[str, Size]
    length: Frames | None = None
    observed: Frames | None = None

    def __post_init__(self) -> None:
        check(self)

    @property
    def preset(self) -> str:
        """Name by which methods keep options for such data; "" for none."""
        return ""

    @property
    def view(self) -> View:
        """What models see of the data."""
        return View()

    @property
    def emission(self) -> LawSpec | None:
        """The law of x that suits the data, where they say one."""
        return None

    @property
    def covariates(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of local and of static context that methods have their factors read, where the data have such."""
        return (), ()

    @property
    def indicators(self) -> tuple[str, ...]:
        """Names of data of which training sequences lack entries, and guides read which: see `DynamicalVAE`."""
        return ()

    @property
    def together(self) -> Sequence[int]:
        """For each coordinate of x a number; those of one number are observed together or not at all."""
        return [0] * self.size("x")

    @property
    def units(self) -> Mapping[str, Sequence[Coordinate]]:
        """Variable to how its coordinates are read and made."""
        return {}

    def size(self, name: str) -> int:
        """The size of a variable.

        Raises:
            SchemaError: it is not known.
        """
        if name not in self.sizes:
            raise SchemaError(f"sizes missing for {name}; given are {', '.join(self.sizes) or 'none'}")
        return self.sizes[name]

    @property
    def windows(self) -> Schema:
        """The schema of the same data where models see them as they are; runs that share it can be judged together."""
        return self

    @classmethod
    def of(cls, data: Any, who: str = "this method") -> Self:
        """The schema of data.

        Args:
            data: a schema, windows that have one, x (N, T, D), a batch, or sizes by name.
            who: needs to know this kind of schema.

        Raises:
            TypeError: a table, whose columns need roles.
            SchemaError: nothing of which this kind of schema is known.
        """
        refuse_table(data)
        arrays = Tensor | np.ndarray
        if isinstance(data, arrays | Sequences | ArrayWindows) or (
            isinstance(data, Mapping) and any(isinstance(value, arrays) for value in data.values())
        ):
            batch = sequences(data).batch
            sizes = {name: value.shape[-1] for name, value in batch.items() if name != "mask" and np.ndim(value) > 1}
            observed = data.observed if isinstance(data, ArrayWindows) else None
            data = Schema(sizes, None if "lengths" in batch else batch["x"].shape[1], observed)
        found = Schema(dict(data)) if isinstance(data, Mapping) else getattr(data, "schema", data)
        if not isinstance(found, cls):
            known = found.kind if isinstance(found, Schema) else type(data).__name__
            need = f"{who} needs to know what {cls.kind} are, and was given {known}"
            if isinstance(found, Schema) and type(found) is not Schema:
                raise SchemaError(f"{need}, which has none; take a method for any sequences, such as srnn")
            raise SchemaError(f"{need}; give the windows that it is to be trained on, or their schema")
        return found

    def config(self) -> dict[str, Any]:
        """The schema in JSON's types; `from_config` of its kind reads it."""
        return {"sizes": dict(self.sizes), "length": self.length, "observed": self.observed}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """The schema that `config` wrote."""
        return cls(**config)
