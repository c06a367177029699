"""Batches: values of variables by name, with lengths, masks and groups of the sequences."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

WHOLE = "x"
"""Name of the data as a whole, if a view splits them into several variables."""


class Batch(dict[str, Any]):
    """A dictionary from variable name to values, with one sequence per row.

    Local variables have the shape (B, T, D), static ones (B, D). Users and data loaders can also pass a plain
    dictionary. The five names in `reserved` are not variables; each has a property or method of the same name below.
    `batch | {...}`, `rows` and `map` return a `Batch`.

    >>> batch = Batch(x=torch.zeros(2, 3, 1), lengths=torch.tensor([3, 2]))
    >>> batch.lengths.tolist(), batch.mask(), batch.rows(slice(1))["x"].shape
    ([3, 2], None, torch.Size([1, 3, 1]))
    """

    reserved: ClassVar[tuple[str, ...]] = ("lengths", "mask", "group", "log_det", "view_inputs")
    reader: Any = None
    """Identifier of the model that already prepared this batch (`DynamicalVAE.read`); setting an entry resets it."""

    @property
    def lengths(self) -> Any:
        """Number of valid steps (B,) of right-padded sequences; None if all steps are valid."""
        return self.get("lengths")

    @property
    def group(self) -> Any:
        """Index (B,) of the group of each sequence; None without groups."""
        return self.get("group")

    @property
    def log_det(self) -> Any:
        """Log-determinant of the view's Jacobian, (B,) or (B, T) by step; None if the view keeps volume."""
        return self.get("log_det")

    @property
    def volume(self) -> Any:
        """`log_det` of each sequence, summed over steps, (B,); None if the view keeps volume."""
        return self.log_det.sum(-1) if self.log_det is not None and self.log_det.dim() == 2 else self.log_det

    @property
    def view_inputs(self) -> Mapping[str, Any]:
        """Additional inputs of some views, by name; models do not read them."""
        inputs: Mapping[str, Any] = self.get("view_inputs", {})
        return inputs

    @property
    def partial(self) -> bool:
        """Whether some entries may be missing or padding."""
        return "lengths" in self or "mask" in self

    def masks(self, name: str = WHOLE) -> dict[str, Any]:
        """Return the masks as a dictionary from variable name to mask.

        Args:
            name: name of the variable to which the mask applies if the batch has a single mask instead of a mapping.
        """
        mask = self.get("mask", {})
        return dict(mask) if isinstance(mask, Mapping) else {name: mask}

    def mask(self, name: str = WHOLE) -> Any:
        """Return a variable's mask, in the shape of its values: True where an entry was observed; None if all were."""
        mask = self.get("mask")
        return mask.get(name) if isinstance(mask, Mapping) else mask

    def mask_to_nan(self) -> Tensor:
        """Return x (B, T, D), with NaN at entries that were not observed."""
        x: Tensor = self[WHOLE]
        mask = self.mask()
        return x if mask is None else torch.where(mask, x, torch.nan)

    def map(self, change: Callable[[Any], Any]) -> Batch:
        """Return the batch with `change` applied to every tensor."""
        return Batch({n: Batch(v).map(change) if isinstance(v, Mapping) else change(v) for n, v in self.items()})

    def rows(self, index: Any) -> Batch:
        """Return some of the sequences, by a slice or an index."""
        selected = self.map(lambda value: value[index])
        selected.reader = self.reader
        return selected

    def past(self, observed: int) -> Batch:
        """Return the input of a forecast: x, its mask and `view_inputs` are cut to the first `observed` frames.

        Context keeps all its steps.
        """
        observable = Batch({name: self[name] for name in (WHOLE, "mask", "view_inputs") if name in self})
        return self | observable.map(lambda value: value[:, :observed])

    def leaves(self) -> dict[str, Any]:
        """Return all tensors by path, such as "mask/x"."""
        tensors: dict[str, Any] = {}
        for name, value in self.items():
            inner = Batch(value).leaves() if isinstance(value, Mapping) else None
            tensors |= {name: value} if inner is None else {f"{name}/{key}": each for key, each in inner.items()}
        return tensors

    @classmethod
    def from_leaves(cls, leaves: Mapping[str, Any]) -> Batch:
        """Return the batch with these tensors by path, the inverse of `leaves`."""
        batch = cls()
        for path, value in leaves.items():
            *names, last = path.split("/")
            part: dict[str, Any] = batch
            for name in names:
                part = part.setdefault(name, {})
            part[last] = value
        return batch

    def __setitem__(self, name: str, value: Any) -> None:
        self.reader = None
        super().__setitem__(name, value)

    def update(self, *others: Any, **values: Any) -> None:
        """Set entries, as `dict.update` does."""
        self.reader = None
        super().update(*others, **values)

    def __ior__(self, other: Any) -> Batch:  # type: ignore[override]
        self.update(other)
        return self

    def __or__(self, other: Any) -> Batch:  # type: ignore[override]
        return Batch({**self, **other})
