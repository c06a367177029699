"""Protocols of data for training, evaluation, comparison and model criticism, and sequences in memory.

A batch is a `Batch`, or a dictionary that can become one. Local variables have the shape (B, T, D), static ones (B, D).
"lengths" (B,) counts the valid frames of right-padded sequences. "mask" (B, T, D) is True where an entry of the
observed variable was observed; for several variables it maps names to masks. "view_inputs" maps names to additional
inputs of some views, such as the rotations of joints in addition to their positions.

| used by | protocol |
|---|---|
| training | `Source`: draws batches |
| validation | `Batched`: iterates over batches of sequences; or any data for comparison |
| comparison | `Listed`: returns all sequences at once; or arrays, or a batch |
| evaluation and model criticism | `HeldOutWindows`: listed windows with a past, names and a fingerprint |

`ArrayWindows` and `Sequences` implement them for arrays. Arrays may be mapped from disk (`numpy.memmap`) and are then
read on demand.
"""

import hashlib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import Protocol, runtime_checkable  # typing's own, in Python 3.11, evaluates properties

from ..options import Count, require
from .batch import Batch
from .blocks import hash_values, ranges
from .units import exceeds_float32


@runtime_checkable
class Source(Protocol):
    """Training data: an object that draws batches, such as windows of sequences."""

    def sample(self, batch_size: int, generator: torch.Generator) -> Mapping[str, Any]:
        """Return a random batch; the generator is the only source of randomness."""


@runtime_checkable
class Fingerprinted(Protocol):
    """Data with a fingerprint, which resumed runs and results use to identify them."""

    @property
    def fingerprint(self) -> str:
        """Hash of the sequences, in their order."""


@runtime_checkable
class Listed(Protocol):
    """Data that can be loaded completely."""

    def all(self) -> Mapping[str, Any]:
        """Return all sequences, one per row, always in the same order."""


@runtime_checkable
class Batched(Protocol):
    """Data that can be iterated without loading them completely."""

    def __len__(self) -> int:
        """Return the number of sequences."""

    def batches(self, batch_size: int) -> Iterator[Mapping[str, Any]]:
        """Yield all sequences in batches, always in the same order."""


@runtime_checkable
class HeldOutWindows(Fingerprinted, Listed, Protocol):
    """Windows for evaluation: the first frames are observed, the others are to be predicted."""

    @property
    def protocol(self) -> Any:
        """A dataclass with the attribute `observed`, the number of observed frames.

        `observed` is None for whole sequences, which have bounds but no forecasts.
        """

    @property
    def keys(self) -> Sequence[tuple[str, str, int]]:
        """(split, cluster, first step) of every window."""

    @property
    def description(self) -> Mapping[str, Any]:
        """Further information on the data, in JSON types; every entry is optional.

        "title" lists phrases for titles. "columns" is a dictionary from the name of each coordinate of x, in order, to
        the unit that tables print, "" for none. To remove units from a coordinate, its entry of "means" is subtracted
        and the result is divided by its entry of "scales". "season" is the period of the data in steps, for a reference
        row of the results. "axis_names" is a list of the words for a cluster of windows and for a step, by default
        ["sequence", "step"].
        """


def cluster_keys(windows: Any) -> list[tuple[str, str, int]]:
    """Return the cluster of each window: `cluster_keys` if the windows define them, else `keys`.

    Windows of different clusters are independent.
    """
    return list(getattr(windows, "cluster_keys", None) or windows.keys)


def axis_names(metadata: Mapping[str, Any]) -> tuple[str, str]:
    """Return the words for a cluster of windows and for a step, from a description of windows or their defaults."""
    cluster, step = metadata.get("axis_names", ("sequence", "step"))
    return cluster, step


def columns_of(windows: HeldOutWindows) -> Mapping[str, str]:
    """Return a dictionary from column of x to unit of measurement; empty if the columns have no names."""
    columns: Mapping[str, str] = windows.description.get("columns", {})
    return columns


def scales_of(windows: HeldOutWindows) -> Sequence[float]:
    """Return the scales that make columns with different units comparable; empty if all units are equal."""
    units = [*columns_of(windows).values()]
    differ = len(units) > 1 and (len({*units}) > 1 or "" in units)
    return windows.description.get("scales", ()) if differ else ()


@dataclass(frozen=True)
class Sequences:
    """N sequences, in memory or mapped from disk.

    Args:
        batch: the variables, each with N rows.

    Raises:
        ValueError: if numbers of rows differ, a shape is neither (N, T, D) nor (N, D), or an entry that is neither
            masked nor padding is NaN or infinite.
    """

    batch: Batch

    def __post_init__(self) -> None:
        object.__setattr__(self, "batch", Batch(self.batch))
        rows = {name: len(value) for name, value in self.batch.leaves().items()}
        if len(set(rows.values())) != 1 or 0 in rows.values():
            raise ValueError(f"every variable needs the same number of sequences, at least one; given {rows}")
        for name, value in self.batch.leaves().items():
            if value.is_floating_point():
                self._check(name, value)

    def _check(self, name: str, value: Tensor) -> None:
        if value.ndim not in (2, 3):
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}; a local variable is (sequences, steps, features), "
                "a static one (sequences, features)"
            )
        lengths, mask = self.batch.lengths, self.batch.mask(name)
        count, first = 0, None
        for rows in ranges(value):
            bad = ~torch.isfinite(value[rows])
            if not bad.any():
                continue
            if mask is not None and mask.shape == value.shape:
                bad &= mask[rows]
            if lengths is not None and value.ndim == 3:
                bad &= (torch.arange(value.shape[1], device=value.device) < lengths[rows, None])[..., None]
            if first is None and bad.any():
                first = rows.start + int(bad.flatten(1).any(1).nonzero()[0])
            count += int(bad.sum())
        if count:
            raise ValueError(
                f"{name} is NaN or infinite in {count} entries, the first in sequence {first}; remove them, or "
                'give a boolean "mask" that is False there'
            )

    def __len__(self) -> int:
        return len(next(iter(self.batch.leaves().values())))

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Return `batch_size` different sequences in random order, or all if there are fewer."""
        rows = torch.randperm(len(self), generator=generator)[:batch_size]
        return self.batch.rows(rows)

    def batches(self, batch_size: int) -> Iterator[Batch]:
        """Yield all sequences in order, `batch_size` at a time."""
        for start in range(0, len(self), batch_size):
            yield self.batch.rows(slice(start, start + batch_size))


@dataclass(frozen=True, eq=False)
class RandomMasking:
    """A source that hides further entries of x at random, anew in each batch.

    The bound remains valid for the visible entries. The guide thus learns to read incomplete sequences even if training
    sequences have few or no missing values.

    Args:
        source: source of the batches.
        share: share of the entries of x to hide, half of them as whole steps and half as single entries.
        together: label of each coordinate of x; coordinates with equal labels are hidden together.
    """

    source: Any
    share: float
    together: Sequence[int]

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Return a batch of the source, with a mask."""
        batch = Batch(self.source.sample(batch_size, generator))
        x, observed, keep = batch["x"], batch.mask(), (1 - self.share) ** 0.5
        steps, entries = (
            torch.rand(*x.shape[:2], count, generator=generator) < keep for count in (1, max(self.together) + 1)
        )
        visible = (steps & entries)[..., list(self.together)].to(x.device)
        visible = visible if observed is None else observed & visible
        return batch | {"mask": {**batch["mask"], "x": visible} if isinstance(batch.get("mask"), Mapping) else visible}

    @property
    def fingerprint(self) -> str | None:
        """Fingerprint of the source, if it has one."""
        return getattr(self.source, "fingerprint", None)


@dataclass(frozen=True, eq=False)
class RandomGiven:
    """A source that chooses the given entries of x at random, anew in each batch (`views.Given`).

    In half of the windows with a horizon, the observed steps are given, as in a forecast. In each of the others, a
    random share of the entries is given: single entries or whole steps (the random strategy of Tashiro et al., 2021,
    which has single entries only). Without a horizon, no entry is given in a tenth of the windows.

    Args:
        source: source of the batches.
        observed: number of observed steps of a forecast; None without a horizon.
    """

    source: Any
    observed: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "source", as_source(self.source))

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Return a batch of the source with the entry "given" (B, T, D)."""
        batch = Batch(self.source.sample(batch_size, generator))
        count, length, size = batch["x"].shape

        def uniform(*shape: int) -> torch.Tensor:
            return torch.rand(count, *shape, generator=generator)

        steps, entries = uniform(length, 1).expand(-1, -1, size), uniform(length, size)
        given = torch.where(uniform(1, 1) < 0.5, steps, entries) < uniform(1, 1)
        rest = torch.arange(length)[:, None] < (self.observed or 0)
        given = torch.where(uniform(1, 1) < (0.1 if self.observed is None else 0.5), rest, given)
        return batch | {"given": given.to(batch["x"].device)}

    @property
    def fingerprint(self) -> str | None:
        """Fingerprint of the source, if it has one."""
        return getattr(self.source, "fingerprint", None)


def mean_of_known(values: Tensor, dims: int | tuple[int, ...]) -> Tensor:
    """Return means of values over the dimensions `dims`, ignoring NaN."""
    means: Tensor = values.mean(dims)
    return values.nanmean(dims) if means.isnan().any() else means


def interpolate_missing(x: Tensor, mask: Tensor | None) -> Tensor:
    """Return sequences with missing entries interpolated linearly in time between observed ones.

    Before the first and after the last observed entry of a coordinate, its value is repeated. A coordinate that is
    never observed is 0.

    Args:
        x: (..., T, D), with any values at missing entries.
        mask: (..., T, D), True where an entry was observed; None if all were.

    Example:
        >>> x = torch.tensor([[0.0, 9.0, 9.0, 3.0, 9.0]]).mT
        >>> interpolate_missing(x, x < 9).flatten().tolist()
        [0.0, 1.0, 2.0, 3.0, 3.0]
    """
    if mask is None:
        return x
    length, (mask, x) = x.shape[-2], torch.broadcast_tensors(mask, x)
    step = torch.arange(length, device=x.device)[:, None]
    before = torch.where(mask, step, -1).cummax(-2).values
    after = torch.where(mask, step, length).flip(-2).cummin(-2).values.flip(-2)
    first, last = torch.where(before < 0, after, before), torch.where(after == length, before, after)
    start, end = (x.gather(-2, index.clamp(0, length - 1)) for index in (first, last))
    line = start + (end - start) * ((step - first) / (last - first).clamp(min=1)).to(x)
    return torch.where(mask, x, torch.where(mask.any(-2, keepdim=True), line, 0.0))


def time_since_previous(times: Tensor | np.ndarray, lengths: Tensor | None = None) -> Tensor:
    """Return the time (B, T, 1) since the previous step, a covariate for irregular steps.

    It is 0 at the first step and at padding.

    Args:
        times: (B, T), increasing, in any unit. Days since 1970 in single precision do not resolve minutes: pass double
            precision, or subtract the start of each sequence.
        lengths: (B,) valid steps, if some are padding.

    Raises:
        ValueError: if times are not finite or not increasing.

    Example:
        >>> time_since_previous(torch.tensor([[3.0, 4.0, 6.5, 0.0]]), torch.tensor([3])).flatten().tolist()
        [0.0, 1.0, 2.5, 0.0]
    """
    times = torch.as_tensor(times)
    if times.ndim != 2:
        raise ValueError(f"times must be (sequences, steps), but have shape {tuple(times.shape)}")
    rise = times.diff(dim=1, prepend=times[:, :1])
    bad = ~((rise > 0) & torch.isfinite(rise))
    bad[:, :1] = ~torch.isfinite(times[:, :1])
    if lengths is not None:
        padding = torch.arange(times.shape[1], device=times.device) >= lengths[:, None]
        bad, rise = bad & ~padding, rise.masked_fill(padding, 0)
    if bad.any():
        row, step = bad.nonzero()[0].tolist()
        raise ValueError(
            f"the times of sequence {row} are {', '.join(f'{t:g}' for t in times[row, max(step - 1, 0) : step + 1])} "
            f"at steps {max(step - 1, 0)} to {step}, counted from 0; times must be finite and increase: sort them, "
            "merge values at one time into one step, and remove steps without a time"
        )
    return rise[..., None] if rise.is_floating_point() else rise[..., None].to(torch.get_default_dtype())


def time_since_observed(mask: Tensor, gaps: Tensor | None = None) -> Tensor:
    """Return the time (B, T, D) since each entry was last observed before this step, a covariate for missing values.

    For an entry that was never observed, it is the time since the first step; at the first step it is 0. Source: Che et
    al., 2018, "Recurrent neural networks for multivariate time series with missing values", where it is called delta.

    Args:
        mask: (B, T, D), True where an entry was observed.
        gaps: (B, T, 1), as returned by `time_since_previous`; by default 1 at every step.

    Example:
        >>> mask = torch.tensor([[[True], [False], [False], [True], [True]]])
        >>> time_since_observed(mask).flatten().tolist()
        [0.0, 1.0, 2.0, 3.0, 1.0]
    """
    steps = torch.ones_like(mask[..., :1], dtype=torch.get_default_dtype()) if gaps is None else gaps
    clock = steps.double().cumsum(1)  # in double precision, to resolve a short gap late in a sequence
    clock = (clock - clock[:, :1]).expand(mask.shape)
    last = torch.where(mask, clock, 0.0).cummax(1).values
    return (clock - torch.cat([clock[:, :1], last[:, :-1]], 1)).to(steps.dtype)


def refuse_table(data: Any) -> None:
    """Raise a TypeError for a table, such as a pandas `DataFrame`: the roles of its columns are unknown."""
    for kind in type(data).__mro__:
        if (library := kind.__module__.partition(".")[0]) in ("pandas", "polars", "xarray"):
            raise TypeError(
                f"got {library}.{kind.__name__}, expected numbers (N, T, D) or windows; give "
                "`dvae.tables.PanelData.of(frame, dvae.tables.ColumnHints(id=('unit',), time='date'))`, where `id` "
                "names the columns that identify a sequence, and `time` the column that orders its steps"
            )


def has_splits(data: Any) -> bool:
    """Return whether data have splits for training, validation and test, such as `dvae.tables.PanelData`."""
    return callable(getattr(type(data), "windows", None))  # of the type, since some windows have such an attribute


def take_split(data: Any, split: str) -> Any:
    """Return the windows of one split if the data have splits, otherwise the data unchanged.

    Raises:
        TypeError: if the data are a table.
    """
    refuse_table(data)
    return data.windows(split) if has_splits(data) else data


def held_out_windows(data: Any) -> HeldOutWindows:
    """Return windows to evaluate on, from the test split if the data have splits.

    Raises:
        TypeError: if the data do not define observed steps.
    """
    windows = take_split(data, "test")
    if not isinstance(windows, HeldOutWindows):
        raise TypeError(
            f"expected windows with observed steps and a future, got {type(windows).__name__}; pass an array x "
            "(N, T, D) as `dvae.ArrayWindows(x, observed=...)`"
        )
    return windows


def sequences(data: Any) -> Sequences:
    """Return data as `Sequences`.

    Args:
        data: x as a tensor or array (N, T, D), which may be mapped, a batch, or `Listed` data.

    Raises:
        TypeError, ValueError: if the data are none of these.
    """
    refuse_table(data)
    if isinstance(data, Sequences):
        return data
    if isinstance(data, Mapping):
        x, mask = unmasked(data.get("x"))
        batch = Batch(data) if mask is None or "mask" in data else Batch(data) | {"x": x, "mask": mask}
        return Sequences(batch.map(tensor_of))
    if isinstance(data, Tensor | np.ndarray):
        check_real(data, "x")
        x, mask = unmasked(data)
        if x.ndim != 3:
            raise ValueError(
                f"x has shape {tuple(x.shape)}, expected (sequences, steps, features); a single sequence is "
                "x[None], and windows of a long one are dvae.tables.PanelData.of(x, cut=...).windows('train')"
            )
        return Sequences(Batch({"x": x} if mask is None else {"x": x, "mask": mask}).map(tensor_of))
    if isinstance(data, Listed):
        return Sequences(Batch(data.all()))
    raise TypeError(
        "expected x as a tensor (N, T, D), a dict of tensors, or an object with sample() or all(), "
        f"got {type(data).__name__}"
    )


def as_source(data: Any) -> Source:
    """Return training data unchanged if they draw batches, otherwise as `Sequences`."""
    refuse_table(data)
    return data if isinstance(data, Source) else sequences(data)


def as_batches(data: Any) -> Batched:
    """Return validation data unchanged if they can be iterated, otherwise as `Sequences`."""
    data = take_split(data, "validation")
    return data if isinstance(data, Batched) else sequences(data)


def unmasked(values: Any) -> tuple[Any, np.ndarray | None]:
    """Return an array without its NumPy mask, 0 where it was masked, and its observed entries (None if all)."""
    if not isinstance(values, np.ma.MaskedArray):
        return values, None
    mask = np.ma.getmaskarray(values)
    return (values.filled(0), ~mask) if mask.any() else (values.data, None)


def check_real(values: Any, name: str = "an array") -> None:
    """Check that values are not complex numbers, records or sparse tensors, which no model reads.

    Raises:
        TypeError: if an array or tensor is complex, has fields, or is sparse.
    """
    dtype = getattr(values, "dtype", None)
    if isinstance(values, Tensor) and values.layout is not torch.strided:
        raise TypeError(f"{name} is a tensor of layout {values.layout}; expected a dense one: give x.to_dense()")
    if getattr(dtype, "is_complex", False) or getattr(dtype, "kind", "") == "c":
        raise TypeError(f"{name} is {dtype}; expected real numbers: stack the real and the imaginary part as columns")
    if fields := getattr(dtype, "names", None):
        raise TypeError(
            f"{name} has the fields {', '.join(fields[:10])}; expected plain numbers: give pandas.DataFrame(x), or "
            "numpy.lib.recfunctions.structured_to_unstructured(x)"
        )


def tensor_of(values: Any) -> Tensor:
    """Return a tensor that shares the memory of an array, or its mapped file, which must then stay read-only.

    Raises:
        TypeError: if values are complex, records, sparse, or partly masked.
        ValueError: if a tensor is on the meta device.
    """
    check_real(values)
    if isinstance(values, Tensor):
        if values.is_meta:
            raise ValueError(
                f"got a tensor {tuple(values.shape)} on the meta device, which has no values; give one on a CPU or GPU"
            )
        # autograd refuses inference tensors
        return values.clone() if values.is_inference() and not torch.is_inference_mode_enabled() else values
    values, mask = unmasked(values)
    if mask is not None:
        raise TypeError(
            'got a masked array (numpy.ma); give values.filled(0), and ~values.mask as the "mask" of the batch'
        )
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The given NumPy array is not writable")
        return torch.as_tensor(values)


@dataclass(frozen=True)
class ArrayProtocol:
    """The split of plain arrays into observed and predicted steps."""

    observed: int


@dataclass(frozen=True, eq=False)
class ArrayWindows:
    """Plain arrays as windows for evaluation.

    Args:
        x: `(N, T, D)`, tensor or numpy array, which may be mapped, or masked (`numpy.ma`).
        observed: number of steps that the model sees; it predicts the other T - observed.
        groups: name of the group of each window, such as the recording that it was cut from; errors are clustered by
            group. Without names, windows count as independent sequences.
        mask: `(N, T, D)`, True where an entry was observed; None if all were.
        columns: {name: unit} of the D coordinates, "" for no unit; tables print them.
        season: period of the data, in steps.

    Raises:
        TypeError: if `observed` is not an integer.
        ValueError: if x is not `(N, T, D)`, no steps remain to predict, the shape of the mask or the number of group
            names or columns is wrong, or the season is below 1.

    Example:
        >>> windows = dvae.ArrayWindows(torch.randn(6, 8, 2), observed=5, groups=["a", "a", "a", "b", "b", "b"])
        >>> windows.all()["x"].shape, windows.keys[0]
        (torch.Size([6, 8, 2]), ('array', 'a', 0))
    """

    x: Tensor | np.ndarray
    observed: int
    groups: Sequence[str] | None = None
    mask: Tensor | np.ndarray | None = None
    columns: Mapping[str, str] | None = None
    season: int | None = None

    def __post_init__(self) -> None:
        if isinstance(self.x, Mapping):
            has_x, bounds = "x" in self.x, "pass it as it is to dvae.fit and dvae.compare, which compares bounds"
            advice = 'pass batch["x"], and its mask as mask=…' if has_x else bounds
            raise TypeError(
                f"windows have one array x (N, T, D), but this is a batch of {', '.join(map(str, self.x))}; {advice}"
            )
        check_real(self.x, "x")
        require(Count, observed=self.observed)
        x, mask = unmasked(self.x)
        if mask is not None:
            object.__setattr__(self, "x", x)
            object.__setattr__(self, "mask", mask if self.mask is None else mask & np.asarray(self.mask, bool))
        if self.x.ndim != 3:
            raise ValueError(f"windows must be (N, T, D), but x has shape {tuple(self.x.shape)}")
        if self.observed >= self.x.shape[1]:
            raise ValueError(
                f"observed is {self.observed}, but x has {self.x.shape[1]} steps; give fewer observed steps, so that "
                "at least one is left to predict"
            )
        if self.mask is not None and self.mask.shape != self.x.shape:
            raise ValueError(
                f"the mask has shape {tuple(self.mask.shape)}, expected the shape of x, {tuple(self.x.shape)}"
            )
        if self.groups is not None and len(self.groups) != len(self.x):
            raise ValueError(f"{len(self.x)} windows need one group name each, got {len(self.groups)}")
        if self.columns is not None and len(self.columns) != self.x.shape[2]:
            raise ValueError(f"{self.x.shape[2]} coordinates need one column name each, got {', '.join(self.columns)}")
        if self.season is not None and self.season < 1:
            raise ValueError(f"season must be at least 1 step, got {self.season}")

    @property
    def protocol(self) -> ArrayProtocol:
        """Number of observed steps."""
        return ArrayProtocol(self.observed)

    @property
    def keys(self) -> list[tuple[str, str, int]]:
        """("array", group name, 0) of every window; without group names, the group is the index of the window.

        The last element would be the window's first step within its recording, which an array does not contain.
        """
        groups = self.groups if self.groups is not None else range(len(self.x))
        return [("array", str(group), 0) for group in groups]

    @property
    def description(self) -> dict[str, Any]:
        """Entries "columns", "season" and "axis_names", each only if the windows have columns, a season or groups."""
        description: dict[str, Any] = {
            "columns": None if self.columns is None else dict(self.columns),
            "season": self.season,
            "axis_names": None if self.groups is None else ["group", "step"],
        }
        return {name: value for name, value in description.items() if value is not None}

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the values, their shape and type."""
        values = np.asarray(self.x)
        digest = hashlib.sha256(f"{values.shape} {values.dtype}".encode())
        hash_values(digest, values, values.dtype)
        digest.update(b"" if self.mask is None else np.packbits(np.asarray(self.mask)).tobytes())
        return digest.hexdigest()

    def all(self) -> Batch:
        """Return all windows, x `(N, T, D)` with integers converted to floating point, and the mask if there is one."""
        x = tensor_of(self.x)
        wide = torch.float64 if exceeds_float32(x.dtype) else torch.get_default_dtype()
        batch = Batch(x=x if x.is_floating_point() else x.to(wide))
        return batch if self.mask is None else batch | {"mask": tensor_of(self.mask)}
