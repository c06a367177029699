"""Reading a batch: values by name, in a model's precision, validated before any program runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from ..capture import defer, is_deferring
from ..data.batch import WHOLE, Batch
from ..data.sequences import HeldOutWindows, has_splits, refuse_table, tensor_of
from ..data.units import RESOLVED, ROUNDING, SMALLEST, TOO_SMALL, exceeds_float32, known_values
from ..data.views import View
from ..distributions.product import ProductSupport
from ..factorization.notation import Factorization
from ..networks.loop import memoize, repeat_batch, valid_steps
from .conditional import Conditional
from .groups import Groups
from .rollout import Rollout

CHUNK = 2048
"""Default maximum of sequences times samples that a forecast keeps in memory."""

AnyBatch = Tensor | Mapping[str, Any]


@dataclass(frozen=True)
class Reader:
    """Validation of a model's batches, and conversion to its precision and representation.

    Args:
        sizes: dimension of every variable.
        local: dictionary from variable name to whether the variable has a value for every step.
        observed: names of the data variables.
        context: names of the variables that a batch must give.
        view: transformation of the data that the model sees.
        extras: names of other entries that a batch may have.
        made: names of data variables that are deterministic given their parents; they are not passed to a program.
        distributions: conditionals of the data, which declare the support and the coordinates of each joint event.
        density: whether the data have a density, so that a view that changes volume needs a log-determinant.
        grouped: names of static latents that groups of sequences share.
    """

    sizes: Mapping[str, int]
    local: Mapping[str, bool]
    observed: tuple[str, ...]
    context: tuple[str, ...]
    view: View
    extras: tuple[str, ...]
    made: frozenset[str]
    distributions: Mapping[str, Conditional]
    density: bool
    grouped: tuple[str, ...]

    def read(
        self, batch: AnyBatch | None, parameter: Tensor, means: Mapping[str, Tensor], wide: Collection[str] = ()
    ) -> Batch:
        """Return the batch as tensors, in the model's precision and representation and on its device.

        Reading the result again does not change it.

        Args:
            batch: as in `DynamicalVAE.model`.
            parameter: parameter of the model, with its precision and device.
            means: dictionary from variable name to the values (D,) of missing entries; 0 for other variables.
            wide: names of variables that are read in float64 in any model.

        Raises:
            TypeError: if the batch is a table, or windows.
            ValueError: if the batch has names that the model does not know, a mask without its variable, tensors on the
                meta device, or values that float32 does not resolve.
        """
        if batch is None:
            return Batch()
        names = tuple(dict.fromkeys((*self.view.names, *self.sizes)))
        whole_name = WHOLE if self.view.parts else self.observed[0]
        refuse_table(batch)
        if not isinstance(batch, Mapping):
            if len(self.observed) > 1 and not self.view.parts:
                raise ValueError(
                    f"a batch of {', '.join(self.observed)} must be a mapping of these names, not one tensor"
                )
            if isinstance(batch, HeldOutWindows) or has_splits(batch):
                raise TypeError(f"got {type(batch).__name__}, expected a batch; give `windows.all()` of its windows")
            batch = {whole_name: batch}
        if unknown := [name for name in batch if name not in (*names, *self.extras, *Batch.reserved)]:
            raise ValueError(
                f"the batch has {', '.join(unknown)}; expected only {', '.join(names)}, 'lengths' and 'mask'"
            )
        exact = (
            {*wide, whole_name, *self.view.names} if wide or self.view.exact else set()
        )  # the view computes the variables from these
        dtype = parameter.dtype
        values = _tensors(Batch(batch), parameter, names, exact)
        if "mask" in values:
            values["mask"] = values.masks(whole_name)
            for name, mask in values.masks().items():
                self._check_mask(name, mask, values)
        has_volume = self.density and whole_name in values and values.log_det is None
        viewed, log_det = self.view.with_volume(values) if has_volume else (Batch(self.view(values)), None)
        made_names = {name for name in viewed if name in self.made and name not in values}
        result = Batch(
            {name: value for name, value in viewed.items() if name not in made_names and name != "view_inputs"}
        )
        if log_det is not None:
            result["log_det"] = log_det
        wide = {*wide, *self.view.exact}
        narrow = [n for n, v in result.items() if n not in wide and isinstance(v, Tensor) and v.is_floating_point()]
        result |= {name: _cast(name, result[name], dtype, result) for name in narrow}
        if "mask" in result:  # masks of context fill its values and are then dropped
            masks = {name: mask for name, mask in result.masks().items() if name in result}
            for name in masks.keys() & self.distributions.keys():
                for event in map(list, self.distributions[name].events):
                    if not torch.equal(masks[name][..., event].any(-1), masks[name][..., event].all(-1)):
                        raise ValueError(
                            f"the mask of {name} hides some entries of a step and not others, but its distribution has "
                            f"one joint density for {len(event)} of them; hide all of these or none, or give {name} a "
                            "distribution with a density for each entry, such as Normal()"
                        )
            fill = {name: means[name].to(result[name].dtype) if name in means else 0.0 for name in masks}
            result |= {name: torch.where(mask, result[name], fill[name]) for name, mask in masks.items()}
            kept_names = {*self.observed, self.view.history}
            result["mask"] = {name: mask for name, mask in masks.items() if name in kept_names}
        return result

    def _check_mask(self, name: str, mask: Tensor, values: Batch) -> None:
        if name not in (*self.observed, self.view.history, WHOLE) or name not in values:
            tensors = {n: v for n, v in values.items() if isinstance(v, Tensor)}
            raise ValueError(f"the batch has a mask of {name}, but no data of that name; it has {shapes(tensors)}")
        if mask.shape != values[name].shape or mask.dtype != torch.bool:
            raise ValueError(
                f"the mask of {name} is {mask.dtype} {tuple(mask.shape)}; expected bool {tuple(values[name].shape)}, "
                "True where an entry was observed"
            )

    def rollout(
        self,
        factorization: Factorization,
        conditionals: Any,
        batch: Batch,
        length: int | None,
        size: int,
    ) -> Rollout:
        """Return a run of the factorization over a batch.

        Args:
            factorization: the factorization.
            conditionals: dictionary from the child of each factor to its `Conditional`.
            batch: batch that `read` returned.
            length: T; None for the length of the batch.
            size: B, if the batch does not determine it.

        Raises:
            ValueError: if the batch is invalid.
        """
        lengths, masks, index = batch.lengths, batch.masks(), batch.group if self.grouped else None
        groups = None if index is None else memoize(self, [index], lambda: Groups.of(index))
        values = {name: value for name, value in batch.items() if name in self.sizes}
        for name, value in values.items():
            self.check(name, value)
        size, length = _extent(values, length, size)
        tensors = list(values.values())
        self._extend_history(factorization, values, length)
        local = {name: v for name, v in values.items() if v.dim() == 3}
        prefix = {name: v for name, v in local.items() if v.shape[1] < length}
        if max((v.shape[1] for v in local.values()), default=0) > length or not set(prefix) <= set(self.observed):
            raise ValueError(
                f"expected {length} steps, or fewer for data that the model continues; the batch has {shapes(local)}"
            )
        if lengths is not None:
            if lengths.is_floating_point() or lengths.shape != (size,):
                raise ValueError(_lengths_message(lengths, length))
            valid = valid_steps(lengths, length)[..., None]
            values |= {name: v.masked_fill(~valid, 0) for name, v in values.items() if v.dim() == 3}
        self._check_context(factorization, values)
        checked = [length, lengths, *tensors, *masks.values()]  # memoized for guide and model
        memoize(self, checked, lambda: self._check_values(values, masks, lengths, length))
        return Rollout(
            factorization=factorization,
            conditionals=conditionals,
            batch=size,
            length=length,
            values={name: v for name, v in values.items() if name not in prefix},
            data=frozenset(self.observed),
            lengths=lengths,
            observed={name: masks[name] for name in self.observed if name in masks},
            prefix={name: values[name] for name in prefix},
            groups=groups,
            grouped=self.grouped,
            given=self.view.given,
        )

    def _extend_history(self, factorization: Factorization, values: dict[str, Any], length: int) -> None:
        """Pad the history (`views.History`) with zeros to all T steps, in place.

        Args:
            factorization: factorization whose factors read the history. Their custom masks hide the padding.
            values: values of the batch by name, changed in place.
            length: T.

        Raises:
            ValueError: if a factor reads the history after its last step.
        """
        name = self.view.history
        if name is None or name not in values or (past := values[name].shape[1]) >= length:
            return
        for factor in factorization.factors:
            if factor.parent(name) is not None and factor.mask(name, length)[:, past:].any():
                raise ValueError(f"{factor} reads {name} after step {past}, its last one; narrow the mask of {name}")
        values[name] = functional.pad(values[name], (0, 0, 0, length - past))

    def _check_context(self, factorization: Factorization, values: Mapping[str, Tensor]) -> None:
        for factor in factorization.factors:
            if missing := [p for p in factor.parents if p.name in self.context and p.name not in values]:
                expected = ", ".join(f"{p.name} (B, {'T, ' * p.local}{self.sizes[p.name]})" for p in missing)
                raise ValueError(
                    f"{factor} reads {expected}, context that the batch must contain; it has "
                    f"{shapes(values) or 'nothing'}"
                )

    def _check_values(
        self, values: Mapping[str, Tensor], masks: Mapping[str, Tensor], lengths: Tensor | None, length: int
    ) -> None:
        """Check that values are finite and in the support, and lengths valid, with one synchronisation of the GPU.

        Args:
            values: values by name, with 0 or another finite value at missing entries.
            masks: masks of observed entries by name; missing entries are not compared with the support.
            lengths: (B,) valid steps of a ragged batch.
            length: T, upper limit of the lengths.

        Raises:
            ValueError: if a value or length is invalid.
        """
        not_finite = {name: ~torch.isfinite(value.sum()) for name, value in values.items()}  # a NaN survives the sum
        outside = {
            name: invalid
            for name in values.keys() & self.distributions.keys()
            if (invalid := self._outside(name, values[name], masks.get(name), lengths)) is not None
        }
        verdict = [*not_finite.values(), *(invalid.any() for invalid in outside.values())]
        verdict += [] if lengths is None else [((lengths < 1) | (lengths > length)).any()]
        if not verdict or defer(failed := torch.stack(verdict).any()) or not failed:
            return
        if lengths is not None and (lengths.min() < 1 or lengths.max() > length):
            raise ValueError(_lengths_message(lengths, length))
        for name, bad in not_finite.items():
            if bad:
                raise ValueError(
                    f"{name} has NaN or infinite values; remove them, or give a boolean 'mask' that is False there"
                )
        for name, invalid in outside.items():
            if invalid.any():
                distribution, index = self.distributions[name], invalid.nonzero()[0].tolist()
                raise ValueError(
                    f"{name} has {values[name][tuple(index)].item():g} (sequence {index[0]}, coordinate {index[-1]}),"
                    f" but under {distribution.factor}, {distribution.head.label}, values are "
                    f"{describe_support(distribution.support)}; give {name} another"
                    " distribution, correct such entries, or hide them by the 'mask' of the batch"
                )

    def _outside(self, name: str, value: Tensor, mask: Tensor | None, lengths: Tensor | None) -> Tensor | None:
        """Return a mask of observed entries outside the support; None if the distribution supports all real values.

        Args:
            name: name of the data variable.
            value: (B, T, D) or (B, D).
            mask: True where an entry was observed; None if all were.
            lengths: (B,) valid steps of a ragged batch.
        """
        distribution = self.distributions[name]
        if (support := distribution.support) is None:
            return None
        outside = ~support.check(value)
        outside = outside[..., None].expand_as(value) if distribution.whole else outside
        if mask is not None:
            outside = outside & mask
        if lengths is not None and value.dim() == 3:
            outside = outside & valid_steps(lengths, value.shape[1])[..., None]
        return outside

    def check(self, name: str, value: Tensor) -> None:
        """Check that a value has the shape (B, T, D), or (B, D) if it is static.

        Raises:
            ValueError: if the shape differs.
        """
        local = self.local[name]
        expected = f"(B, {'T, ' if local else ''}{self.sizes[name]})"
        if value.dim() != (3 if local else 2) or value.shape[-1] != self.sizes[name]:
            raise ValueError(f"{name} has shape {tuple(value.shape)}, expected {expected}")
        if value.dim() == 3 and value.shape[1] == 0:
            raise ValueError(f"{name} has no steps: shape {tuple(value.shape)}")


def _lengths_message(lengths: Tensor, length: int) -> str:
    return f"lengths must be (B,) whole numbers between 1 and {length}, got {lengths.tolist()}"


def _tensors(batch: Batch, parameter: Tensor, names: Collection[str], wide: Collection[str]) -> Batch:
    """Return the entries of a batch as tensors in the precision of the model and on its device.

    Floating-point entries and entries in `names` get the precision, or float64 if they are in `wide`. Masks and counts,
    such as lengths, keep their type.

    Args:
        batch: arrays or tensors by name.
        parameter: parameter of the model.
        names: names of the variables.
        wide: names of the variables that are read in float64.
    """
    tensors = Batch()
    for name, value in batch.items():
        if isinstance(value, Mapping):
            tensors[name] = _tensors(Batch(value), parameter, names if name == "view_inputs" else (), ())
            continue
        tensor = tensor_of(value)
        if tensor.is_floating_point() or name in names:
            tensor = tensor.double() if name in wide else _cast(name, tensor, parameter.dtype, batch)
        tensors[name] = tensor.to(parameter.device)
    return tensors


def _cast(name: str, value: Tensor, dtype: torch.dtype, batch: Batch) -> Tensor:
    """Return the value in the precision of the model.

    Raises:
        ValueError: if float32 does not resolve the values.
    """
    if dtype is not torch.float32 or not exceeds_float32(value.dtype) or value.dim() < 2 or not value.numel():
        return value.to(dtype)
    mask, lengths = batch.mask(name), batch.lengths
    no_aminmax = torch.uint32, torch.uint64
    if mask is None and lengths is None and value.dtype not in no_aminmax and not is_deferring():
        least, most = value.flatten(0, -2).aminmax(dim=0)  # quick test: the deviation is at least range / sqrt(2 N)
        bound = RESOLVED * math.sqrt(2 * value.numel() / value.shape[-1])
        if ((most == least) | (most - least > bound * torch.maximum(most.abs(), least.abs()))).all():
            return value.to(dtype)
    mean, spread = _moments(name, value, batch)
    size = mean.abs()
    imprecise = (spread < RESOLVED * size) & (spread > ROUNDING * size)
    if not defer(imprecise.any()) and imprecise.any():
        coordinate = int(imprecise.nonzero()[0])
        raise ValueError(
            f"coordinate {coordinate} of {name} has mean {mean[coordinate].item():.9g} and standard deviation "
            f"{spread[coordinate].item():.3g}, which float32 does not resolve; call "
            f"model.standardise({name!r}).fit(values), which subtracts the mean in float64, or subtract it yourself"
        )
    return value.to(dtype)


def _moments(name: str, value: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation (D,) of the observed entries in float64; NaN without any."""
    rows = known_values(batch | {name: value.double()}, name).flatten(0, -2)
    mean = rows.nanmean(0)
    return mean, (rows - mean).square().nanmean(0).sqrt()


def check_scale(batch: AnyBatch, names: Collection[str]) -> None:
    """Check that variables vary by more than the smallest scale that float32 models resolve, or not at all.

    Args:
        batch: x as a tensor, or a batch.
        names: names of the variables.

    Raises:
        ValueError: if the largest standard deviation is below `units.SMALLEST`, but not 0.
    """
    refuse_table(batch)
    tensors = Batch(batch if isinstance(batch, Mapping) else {WHOLE: batch})
    for name in tensors.keys() & {*names}:
        value = tensor_of(tensors[name])
        if not value.is_floating_point() or value.dim() < 2 or not value.numel():
            continue
        mean, spread = _moments(name, value, tensors)
        largest = torch.where(spread > ROUNDING * mean.abs(), spread, 0.0).max().item()
        if 0 < largest < SMALLEST:
            raise ValueError(f"the standard deviation of {name} is {largest:g}; {TOO_SMALL}")


def describe_support(support: Any) -> str:
    """Return the support in words."""
    if isinstance(support, ProductSupport):
        return "; ".join(
            f"of {', '.join(map(str, places))}: {describe_support(part)}" for places, part in support.parts
        )
    while hasattr(support, "base_constraint"):
        support = support.base_constraint
    return {
        "Boolean()": "0 or 1",
        "OneHot()": "1 at one coordinate and 0 at the others",
        "IntegerGreaterThan(lower_bound=0)": "whole numbers from 0",
        "GreaterThan(lower_bound=0.0)": "above 0",
        "GreaterThanEq(lower_bound=0.0)": "at least 0",
        "Inside(Interval(lower_bound=0.0, upper_bound=1.0))": "above 0 and below 1",
        "Inside(Simplex())": "above 0 and sum to 1",
        "Interval(lower_bound=0.0, upper_bound=1.0)": "from 0 to 1",
    }.get(str(support), str(support))


def _extent(values: Mapping[str, Tensor], length: int | None, size: int) -> tuple[int, int]:
    """Return B and T of a batch.

    Args:
        values: values of variables by name, which determine B.
        length: T; None if the values determine it.
        size: B; used only if there are no values.

    Raises:
        ValueError: if values differ in B or T, B or T is 0, or T cannot be inferred.
    """
    sizes = {value.shape[0] for value in values.values()} or {size}
    if len(sizes) > 1:
        raise ValueError(f"all variables of a batch must have the same number of sequences, got {shapes(values)}")
    if sizes == {0}:
        raise ValueError(f"the batch holds no sequences: {shapes(values)}")
    local = {name: value for name, value in values.items() if value.dim() == 3}
    steps = {value.shape[1] for value in local.values()}
    if length is None:
        if not steps:
            raise ValueError("cannot infer the number of steps without a batch; pass length=")
        if len(steps) > 1:
            raise ValueError(f"all local variables of a batch must have the same number of steps, got {shapes(local)}")
        length = max(steps)
    if length < 1:
        raise ValueError(f"length must be at least 1, got {length}")
    return sizes.pop(), length


def shapes(values: Mapping[str, Tensor]) -> str:
    """Return the names and shapes of the values as text."""
    return ", ".join(f"{name} {tuple(value.shape)}" for name, value in values.items())


def repeat(value: Any, samples: int) -> Any:
    """Return a batch, or a tensor (B, ...), repeated as (samples * B, ...), sample by sample.

    Each copy has its own groups.
    """
    if not isinstance(value, Mapping):
        return repeat_batch(value, samples)
    batch = value if isinstance(value, Batch) else Batch(value)
    repeated = batch.map(partial(repeat_batch, n=samples))
    if batch.group is not None:
        repeated["group"] = Groups.of(batch.group).repeat(samples).place
    repeated.reader = batch.reader
    return repeated


def rows(value: Any, part: slice) -> Any:
    """Return some sequences of a batch, or of a tensor (B, ...)."""
    if isinstance(value, Mapping):
        return (value if isinstance(value, Batch) else Batch(value)).rows(part)
    return value[part]


def in_chunks(
    make: Callable[[slice, int], Mapping[str, Tensor]], size: int, samples: int, chunk: int
) -> dict[str, Tensor]:
    """Compute values (S, B, ...) for all sequences and samples in chunks, to limit the memory of the computation.

    Args:
        make: function of a slice of b sequences and a number of samples n; returns values (n, b, ...) by name.
        size: B.
        samples: S.
        chunk: maximum of sequences times samples in one call of `make`.

    Raises:
        ValueError: if samples or chunk is below 1.
    """
    if samples < 1 or chunk < 1:
        raise ValueError(f"samples and chunk must be at least 1, got {samples} and {chunk}")
    results: dict[str, Tensor] = {}
    for first in range(0, max(size, 1), chunk):  # runs once for an empty batch too, so that `make` raises
        part = slice(first, min(first + chunk, size))
        at_once = chunk // max(part.stop - first, 1)
        for start in range(0, samples, at_once):
            for name, value in make(part, min(at_once, samples - start)).items():
                if name not in results:
                    results[name] = value.new_empty(samples, size, *value.shape[2:])
                results[name][start : start + at_once, part] = value
    return results
