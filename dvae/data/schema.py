"""Schemas: descriptions of data, sufficient to build a model without the data themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from torch import Tensor

from ..distributions.base import DistributionSpec
from ..options import Frames, Size, check
from .sequences import ArrayWindows, Sequences, refuse_table, sequences
from .units import Coordinate
from .views import View


class SchemaError(ValueError):
    """Error for a schema without information that a method requires."""


@dataclass(frozen=True)
class Schema:
    """A description of sequences of numbers; subclasses describe other kinds of data.

    Args:
        sizes: dimension of every variable of the data as models see them, context included, such as {"x": 48}.
        length: T, steps of a sequence; None if they differ or are unknown.
        observed: O, observed steps of a forecast; None if they differ or are unknown.

    Raises:
        TypeError, ValueError: if sizes or lengths are invalid.
    """

    kind: ClassVar[str] = "sequences"
    per: ClassVar[str] = "step"
    """Unit of time of bounds, which are reported in nats per step, frame or window."""

    sizes: Mapping[str, Size]
    length: Frames | None = None
    observed: Frames | None = None

    def __post_init__(self) -> None:
        check(self)

    @property
    def preset(self) -> str:
        """Name of a method's preset options for such data; "" for none."""
        return ""

    @property
    def view(self) -> View:
        """Transformation of the data that models see."""
        return View()

    @property
    def emission(self) -> DistributionSpec | None:
        """Suitable distribution of x, if the data determine one."""
        return None

    @property
    def covariates(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of local and of static context that the factors of methods read."""
        return (), ()

    @property
    def indicators(self) -> tuple[str, ...]:
        """Names of data variables with missing training entries; guides read their indicators (`DynamicalVAE`)."""
        return ()

    @property
    def together(self) -> Sequence[int]:
        """Label of each coordinate of x; coordinates with equal labels are always observed or missing together."""
        return range(self.size("x"))

    @property
    def exposure(self) -> tuple[str, Sequence[int]] | None:
        """Context variable whose exponential is a known factor of x, and the coordinates of x that it multiplies."""
        return None

    @property
    def units(self) -> Mapping[str, Sequence[Coordinate]]:
        """Dictionary from variable name to the units of its coordinates."""
        return {}

    def size(self, name: str) -> int:
        """Return the size of a variable.

        Raises:
            SchemaError: if the size is unknown.
        """
        if name not in self.sizes:
            raise SchemaError(
                f"sizes missing for {name}; the schema has sizes of {', '.join(self.sizes) or 'no variable'}"
            )
        return self.sizes[name]

    @property
    def windows(self) -> Schema:
        """Schema of the same data without a view; runs can be evaluated on the same windows if it is equal."""
        return self

    @classmethod
    def of(cls, data: Any, who: str = "this method") -> Self:
        """Return the schema of data.

        Args:
            data: a schema, windows that have one, x (N, T, D), a batch, or sizes by name.
            who: name of the method that requires this kind of schema.

        Raises:
            TypeError: if the data are a table, whose columns need roles.
            SchemaError: if the data do not have this kind of schema.
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
        schema = Schema(dict(data)) if isinstance(data, Mapping) else getattr(data, "schema", data)
        if not isinstance(schema, cls):
            kind = schema.kind if isinstance(schema, Schema) else type(data).__name__
            need = f"{who} needs the description of {cls.kind}, but was given {kind}"
            if isinstance(schema, Schema) and type(schema) is not Schema:
                raise SchemaError(f"{need}, which has none; take a method for any sequences, such as srnn")
            raise SchemaError(f"{need}; give the training windows, or their schema")
        return schema

    def config(self) -> dict[str, Any]:
        """Return the schema as JSON types, for `from_config` of its class."""
        return {"sizes": dict(self.sizes), "length": self.length, "observed": self.observed}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Return the schema that `config` described."""
        return cls(**config)
