"""Data: what the loop, evaluation, comparison and criticism need of them, as protocols, and sequences in memory.

A batch is a `Batch`, or a dictionary of which one can be made. Local variables are (B, T, D), static ones (B, D);
"lengths" (B,) counts the valid frames of right-padded sequences, and "mask" (B, T, D) is True where an entry of the
observed variable was observed (or maps several such names to masks). "beside" maps names to what some views read, such
as the turns of joints beside their positions.

| who | asks for |
|---|---|
| the loop, to train | `Source`: draws batches |
| the loop, to validate | `InBatches`: some sequences after the others; or what comparison does |
| comparison | `Listed`: all sequences at once; or arrays, or a batch |
| evaluation and criticism | `HeldOutWindows`: listed windows with a past, names and a fingerprint |

`ArrayWindows` and `Sequences` make them of arrays, which may be mapped from a disk (`numpy.memmap`) and are then read
as they are drawn.
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
    """Training data: anything that draws batches, such as windows of sequences."""

    def sample(self, batch_size: int, generator: torch.Generator) -> Mapping[str, Any]:
        """Return a batch, drawn with the generator alone."""


@runtime_checkable
class Fingerprinted(Protocol):
    """Data that can be told from others: a run that resumes, and a record, say on which it rests."""

    @property
    def fingerprint(self) -> str:
        """Hash of the sequences, in their order."""


@runtime_checkable
class Listed(Protocol):
    """Data that can be had whole."""

    def all(self) -> Mapping[str, Any]:
        """All sequences, one in each row, always in the same order."""


@runtime_checkable
class InBatches(Protocol):
    """Data that can be gone through without having them whole."""

    def __len__(self) -> int:
        """How many sequences."""

    def batches(self, batch_size: int) -> Iterator[Mapping[str, Any]]:
        """All sequences, so many in a batch, always in the same order."""


@runtime_checkable
class HeldOutWindows(Fingerprinted, Listed, Protocol):
    """Windows to be judged on: their first frames are observed, the others are to be predicted."""

    @property
    def protocol(self) -> Any:
        """A dataclass with `observed` (frames).

        `observed` is None of whole sequences, of which there are bounds, and no forecasts.
        """

    @property
    def keys(self) -> Sequence[tuple[str, str, int]]:
        """(split, clip, first frame) of every window."""

    @property
    def description(self) -> Mapping[str, Any]:
        """What else a record is to say of the data, in JSON's types, nothing of it being required.

        "title" lists phrases for titles; "columns" {name: unit} names the coordinates of x, in their order, in units
        that tables print, "" for none; "means" are subtracted from their numbers, and "scales" divide them, to have no
        unit, in the same order; "season" is a period of the data, in frames, for a reference row; "called" is what a
        clip and a frame are called in tables, such as ["sequence", "step"].
        """


def clusters(windows: Any) -> list[tuple[str, str, int]]:
    """Keys of windows by what is independent of each other: by clips, unless the windows know of more (`clusters`)."""
    return list(getattr(windows, "clusters", None) or windows.keys)


def called(said: Mapping[str, Any]) -> tuple[str, str]:
    """What a clip and a frame are called, by what windows say of themselves."""
    clip, frame = said.get("called", ("clip", "frame"))
    return clip, frame


def columns_of(windows: HeldOutWindows) -> Mapping[str, str]:
    """The unit of every named column of x; empty where the windows name none."""
    found: Mapping[str, str] = windows.description.get("columns", {})
    return found


def scales_of(windows: HeldOutWindows) -> Sequence[float]:
    """By what columns are divided to be told together: their scales where they share no unit, else nothing."""
    units = [*columns_of(windows).values()]
    mixed = len(units) > 1 and (len({*units}) > 1 or "" in units)
    return windows.description.get("scales", ()) if mixed else ()


@dataclass(frozen=True)
class Sequences:
    """N sequences, in memory or mapped.

    Args:
        batch: the variables, each with N rows.

    Raises:
        ValueError: when rows differ in number, a shape is neither (N, T, D) nor (N, D), or an entry that is
            neither masked nor padding is NaN or infinite.
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
                f"{name} has shape {tuple(value.shape)}; a local variable is (sequences, frames, features), "
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
                f"{name} has {count} entries that are NaN or infinite, the first in sequence {first}; remove them, or "
                'give a boolean "mask" that is False there'
            )

    def __len__(self) -> int:
        return len(next(iter(self.batch.leaves().values())))

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Return `batch_size` different sequences in random order; all of them if there are no more."""
        chosen = torch.randperm(len(self), generator=generator)[:batch_size]
        return self.batch.rows(chosen)

    def batches(self, batch_size: int) -> Iterator[Batch]:
        """Yield all sequences in order, `batch_size` at a time."""
        for start in range(0, len(self), batch_size):
            yield self.batch.rows(slice(start, start + batch_size))


@dataclass(frozen=True, eq=False)
class Hiding:
    """A source whose batches lack more of x than its own, at random and anew each time.

    The bound stays one, of what is left. A guide that is to tell latents from sequences with gaps meets them so, where
    training sequences have few or none.

    Args:
        source: of the batches.
        share: of the entries of x that are hidden; as many whole steps as single entries.
        together: for each coordinate of x a number; those of one number are hidden together.
    """

    source: Any
    share: float
    together: Sequence[int]

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Return a batch of the source, with a mask."""
        batch = Batch(self.source.sample(batch_size, generator))
        x, seen, kept = batch["x"], batch.mask(), (1 - self.share) ** 0.5
        steps, entries = (
            torch.rand(*x.shape[:2], count, generator=generator) < kept for count in (1, max(self.together) + 1)
        )
        left = (steps & entries)[..., list(self.together)].to(x.device)
        left = left if seen is None else seen & left
        return batch | {"mask": {**batch["mask"], "x": left} if isinstance(batch.get("mask"), Mapping) else left}

    @property
    def fingerprint(self) -> str:
        """That of the source, where it has one."""
        found: str = self.source.fingerprint
        return found


def mean_of_known(values: Tensor, dims: int | tuple[int, ...]) -> Tensor:
    """Means over some dimensions of what is not NaN."""
    found: Tensor = values.mean(dims)
    return values.nanmean(dims) if found.isnan().any() else found


def bridged(x: Tensor, mask: Tensor | None) -> Tensor:
    """Sequences whose missing entries lie on the straight line between the observed ones around them, in time.

    Before the first and after the last observed entry of a coordinate that one stays; of one that is never observed
    there is 0.

    Args:
        x: (..., T, D), anything where entries are missing.
        mask: (..., T, D), True where an entry was observed; None for all.

    Example:
        >>> x = torch.tensor([[0.0, 9.0, 9.0, 3.0, 9.0]]).mT
        >>> bridged(x, x < 9).flatten().tolist()
        [0.0, 1.0, 2.0, 3.0, 3.0]
    """
    if mask is None:
        return x
    length, (mask, x) = x.shape[-2], torch.broadcast_tensors(mask, x)
    step = torch.arange(length, device=x.device)[:, None]
    before = torch.where(mask, step, -1).cummax(-2).values
    after = torch.where(mask, step, length).flip(-2).cummin(-2).values.flip(-2)
    first, last = torch.where(before < 0, after, before), torch.where(after == length, before, after)
    start, end = (x.gather(-2, place.clamp(0, length - 1)) for place in (first, last))
    line = start + (end - start) * ((step - first) / (last - first).clamp(min=1)).to(x)
    return torch.where(mask, x, torch.where(mask.any(-2, keepdim=True), line, 0.0))


def gaps(times: Tensor | np.ndarray, lengths: Tensor | None = None) -> Tensor:
    """The time (B, T, 1) since the step before: a covariate of irregular steps that any network reads.

    That of the first step, before which there is nothing, is 0; so are those of padding.

    Args:
        times: (B, T), rising, in any unit. Days since 1970 in single precision have no minutes: give double, or take
            the start of each sequence from it.
        lengths: (B,) valid steps, where some are padding.

    Raises:
        ValueError: times that are not finite, or do not rise.

    Example:
        >>> gaps(torch.tensor([[3.0, 4.0, 6.5, 0.0]]), torch.tensor([3])).flatten().tolist()
        [0.0, 1.0, 2.5, 0.0]
    """
    times = torch.as_tensor(times)
    if times.ndim != 2:
        raise ValueError(f"times are (sequences, steps), but these have shape {tuple(times.shape)}")
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
            f"at steps {max(step - 1, 0)} to {step}, counted from 0; times are finite and rise: sort them, make one "
            "step of values at one time, and leave out steps without a time"
        )
    return rise[..., None] if rise.is_floating_point() else rise[..., None].to(torch.get_default_dtype())


def since_observed(mask: Tensor, gaps: Tensor | None = None) -> Tensor:
    """The time (B, T, D) since each entry was last observed, before this step: a covariate of missing values.

    Of one that never was, the time since the first step; 0 there. (Che et al., 2018, "Recurrent neural networks for
    multivariate time series with missing values", where it is delta.)

    Args:
        mask: (B, T, D), True where an entry was observed.
        gaps: (B, T, 1), see `gaps`; where nothing is said, every step takes 1.

    Example:
        >>> mask = torch.tensor([[[True], [False], [False], [True], [True]]])
        >>> since_observed(mask).flatten().tolist()
        [0.0, 1.0, 2.0, 3.0, 1.0]
    """
    steps = torch.ones_like(mask[..., :1], dtype=torch.get_default_dtype()) if gaps is None else gaps
    clock = steps.double().cumsum(1)  # in double: a short gap late in a sequence is not lost
    clock = (clock - clock[:, :1]).expand(mask.shape)
    last = torch.where(mask, clock, 0.0).cummax(1).values
    return (clock - torch.cat([clock[:, :1], last[:, :-1]], 1)).to(steps.dtype)


def refuse_table(data: Any) -> None:
    """Raise a TypeError for a table, such as a pandas `DataFrame`: the roles of its columns are unknown."""
    for kind in type(data).__mro__:
        if (library := kind.__module__.partition(".")[0]) in ("pandas", "polars", "xarray"):
            raise TypeError(
                f"got {library}.{kind.__name__}, expected numbers (N, T, D) or windows; give "
                "`dvae.tables.PanelData.of(frame, dvae.tables.Told(id=('unit',), time='date'))`, where `id` names the "
                "columns that identify a sequence, and `time` the column that orders its steps"
            )


def is_divided(data: Any) -> bool:
    """Whether data have parts for training, validation and test, such as `dvae.tables.PanelData`."""
    return callable(getattr(type(data), "windows", None))  # not of an instance: some windows keep others by that name


def take_split(data: Any, split: str) -> Any:
    """Return the windows of one split where data are divided, and any other data unchanged.

    Raises:
        TypeError: data are a table.
    """
    refuse_table(data)
    return data.windows(split) if is_divided(data) else data


def held_out_windows(data: Any) -> HeldOutWindows:
    """Return windows to evaluate on; of divided data those of the test split.

    Raises:
        TypeError: data do not say which steps are observed.
    """
    windows = take_split(data, "test")
    if not isinstance(windows, HeldOutWindows):
        raise TypeError(
            f"expected windows with observed steps and a future, got {type(windows).__name__}; of an array x (N, T, D) "
            "they are `dvae.ArrayWindows(x, observed=...)`"
        )
    return windows


def sequences(data: Any) -> Sequences:
    """Return data as `Sequences`.

    Args:
        data: x as a tensor or array (N, T, D), which may be mapped, a batch, or `Listed` data.

    Raises:
        TypeError, ValueError: when it is none of these.
    """
    refuse_table(data)
    if isinstance(data, Sequences):
        return data
    if isinstance(data, Mapping):
        x, mask = unmasked(data.get("x"))
        own = Batch(data) if mask is None or "mask" in data else Batch(data) | {"x": x, "mask": mask}
        return Sequences(own.map(tensor_of))
    if isinstance(data, Tensor | np.ndarray):
        check_real(data, "x")
        x, mask = unmasked(data)
        if x.ndim != 3:
            raise ValueError(
                f"x has shape {tuple(x.shape)}, expected (sequences, frames, features); a single sequence is "
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
    """Return training data that draw batches: as they are, or those of `sequences`."""
    refuse_table(data)
    return data if isinstance(data, Source) else sequences(data)


def in_batches(data: Any) -> InBatches:
    """Return validation data that can be gone through: as they are, or those of `sequences`."""
    data = take_split(data, "validation")
    return data if isinstance(data, InBatches) else sequences(data)


def unmasked(values: Any) -> tuple[Any, np.ndarray | None]:
    """Return an array without its NumPy mask, 0 where it was masked, and where it was observed, None for everywhere."""
    if not isinstance(values, np.ma.MaskedArray):
        return values, None
    mask = np.ma.getmaskarray(values)
    return (values.filled(0), ~mask) if mask.any() else (values.data, None)


def check_real(values: Any, name: str = "an array") -> None:
    """Refuse complex numbers, records and sparse tensors, which no model reads.

    Raises:
        TypeError: an array or tensor of complex numbers or with fields, or a sparse tensor.
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
    """Return a tensor on an array's own memory, or on the mapped file, to which nobody may write then.

    Raises:
        TypeError: complex numbers, records, a sparse tensor, or an array of which some entries are masked.
        ValueError: a tensor on the meta device.
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
        raise TypeError('an array is masked; give values.filled(0), and ~values.mask as the "mask" of the batch')
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The given NumPy array is not writable")
        return torch.as_tensor(values)


@dataclass(frozen=True)
class ArrayProtocol:
    """How plain arrays are split into observed and predicted frames."""

    observed: int


@dataclass(frozen=True, eq=False)
class ArrayWindows:
    """Plain arrays as windows to evaluate on.

    Args:
        x: `(N, T, D)`, tensor or numpy array, which may be mapped, or masked (`numpy.ma`).
        observed: frames the model sees; the other T - observed are predicted.
        clips: name of the clip each window was cut from; without it the windows count as independent.
        mask: `(N, T, D)`, True where an entry was observed, where some are missing.
        columns: {name: unit} of the D coordinates, "" for no unit; tables print them.
        season: a period of the data, in frames.

    Raises:
        TypeError: observed steps that are no whole number.
        ValueError: x that is not `(N, T, D)`, observed steps that leave none to predict, a mask of another shape, as
            many clip names as windows or columns as coordinates are not given, or a season below 1.

    Example:
        >>> windows = dvae.ArrayWindows(torch.randn(6, 8, 2), observed=5, clips=["a", "a", "a", "b", "b", "b"])
        >>> windows.all()["x"].shape, windows.keys[0]
        (torch.Size([6, 8, 2]), ('array', 'a', 0))
    """

    x: Tensor | np.ndarray
    observed: int
    clips: Sequence[str] | None = None
    mask: Tensor | np.ndarray | None = None
    columns: Mapping[str, str] | None = None
    season: int | None = None

    def __post_init__(self) -> None:
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
                f"observed is {self.observed} of {self.x.shape[1]} steps of x, which leaves none to predict; give fewer"
            )
        if self.mask is not None and self.mask.shape != self.x.shape:
            raise ValueError(f"the mask has shape {tuple(self.mask.shape)}, expected that of x, {tuple(self.x.shape)}")
        if self.clips is not None and len(self.clips) != len(self.x):
            raise ValueError(f"{len(self.x)} windows need as many clip names, not {len(self.clips)}")
        if self.columns is not None and len(self.columns) != self.x.shape[2]:
            raise ValueError(f"{self.x.shape[2]} coordinates need as many columns, not {', '.join(self.columns)}")
        if self.season is not None and self.season < 1:
            raise ValueError(f"a season is at least 1 frame, not {self.season}")

    @property
    def protocol(self) -> ArrayProtocol:
        """Number of observed frames."""
        return ArrayProtocol(self.observed)

    @property
    def keys(self) -> list[tuple[str, str, int]]:
        """(split, clip, first frame) of every window; the first frame is unknown here and 0."""
        clips = self.clips if self.clips is not None else range(len(self.x))
        return [("array", str(clip), 0) for clip in clips]

    @property
    def description(self) -> dict[str, Any]:
        """Columns and season, if they were given."""
        said = {"columns": None if self.columns is None else dict(self.columns), "season": self.season}
        return {name: value for name, value in said.items() if value is not None}

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the values, their shape and type."""
        values = np.asarray(self.x)
        digest = hashlib.sha256(f"{values.shape} {values.dtype}".encode())
        hash_values(digest, values, values.dtype)
        digest.update(b"" if self.mask is None else np.packbits(np.asarray(self.mask)).tobytes())
        return digest.hexdigest()

    def all(self) -> Batch:
        """All windows, x `(N, T, D)`, whole numbers as floating-point ones, and the mask if there is one."""
        x = tensor_of(self.x)
        wide = torch.float64 if exceeds_float32(x.dtype) else torch.get_default_dtype()
        batch = Batch(x=x if x.is_floating_point() else x.to(wide))
        return batch if self.mask is None else batch | {"mask": tensor_of(self.mask)}
