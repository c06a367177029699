"""Panel data as runs store and reopen them: a file with its schema, or a data set of `dvae.tables.domains` by name."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

from ..options import check, require
from .advice import is_aligned
from .ahead import ahead
from .column_inference import ColumnHints
from .columns import Columns
from .domains import DOMAINS
from .encoding import PanelSchema
from .panel import SPLITS, Panel
from .protocol import Cut, begin_of
from .reading import is_domain, read_panel, schema_beside
from .windows import PanelWindows


@dataclass(frozen=True)
class PanelSource:
    """The source of a panel, as stored in a run.

    Args:
        path: path of the file, as given.
        fingerprint: SHA-256 of the sequences.
    """

    path: str
    fingerprint: str

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class PanelData:
    """A panel with its schema.

    Args:
        path: path of the file, as given.
        panel: the sequences.
        schema: columns, cut and units that models use.
    """

    kind: ClassVar[str] = "panel"
    schema_kind: ClassVar[str] = PanelSchema.kind
    source: ClassVar[type[PanelSource]] = PanelSource
    onto: ClassVar[bool] = False

    path: str
    panel: Panel
    schema: PanelSchema

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        columns: Columns | Sequence[str] = (),
        cut: Cut | None = None,
        **options: Any,
    ) -> Self:
        """Read a file, with the schema file next to it if there is one.

        Args:
            path: path of a CSV, Parquet, npz or npy file, or of a folder of npy files; or the name of a data set of
                `dvae.tables.domains`.
            columns: a schema, or the targets as in `ColumnHints`; replaces the schema file.
            cut: how to split and cut sequences; by default from the schema file, the cut of the data set in
                `dvae.tables.domains`, or else `default_cut`.
            **options: further fields of `ColumnHints` and of `Cut`.

        Returns:
            The panel, with its schema and splits.

        Raises:
            FileNotFoundError: if the file does not exist.
            TypeError: if `cut` is not a `Cut`.
            ValueError: if the file or the schema is invalid.
        """
        require(Cut | None, cut=cut)
        name = os.fspath(path)
        cut_options = {field.name: options.pop(field.name) for field in fields(Cut) if field.name in options}
        file_columns, file_cut = schema_beside(name)
        if not isinstance(columns, Columns):
            hints = ColumnHints(tuple(columns), **options)
            columns = file_columns if hints == ColumnHints() and file_columns is not None else hints  # type: ignore[assignment]
        panel = read_panel(name, columns)  # type: ignore[arg-type]
        domain_cut = DOMAINS[name].cut if is_domain(name) else None
        cut = replace(cut or file_cut or domain_cut or default_cut(panel), **cut_options)
        return cls(name, panel, PanelSchema.from_data(panel, cut))

    @classmethod
    def of(cls, data: Any, columns: Any = None, cut: Cut | None = None, name: str = "panel") -> Self:
        """Wrap data in memory, as in `Panel.of`; a run fitted to them cannot reopen them by a path.

        Args:
            data: a pandas frame, arrays, an xarray `Dataset` or a `Panel`.
            columns: a schema, or targets as in `ColumnHints`.
            cut: how to split and cut sequences; `default_cut` of the panel if None.
            name: name for titles.

        Returns:
            The panel, with its schema and splits.

        Raises:
            TypeError: the data have another type, or `cut` is not a `Cut`.
            ValueError: the data have no such columns, or values are invalid.
        """
        require(Cut | None, cut=cut)
        panel = Panel.of(data, columns, name)
        return cls(name, panel, PanelSchema.from_data(panel, cut or default_cut(panel)))

    def with_data(self, data: Any) -> Self:
        """Return other data, of any type that `Panel.of` accepts, with the columns, cut and units of this schema.

        Args:
            data: data with these columns.

        Raises:
            TypeError: the data have another type.
            ValueError: the data have no such columns, or values are invalid.
        """
        return replace(self, panel=Panel.of(data, self.panel.columns, self.panel.name))

    def only(self, sequences: Iterable[str]) -> Self:
        """Return some of the sequences, by name.

        Args:
            sequences: names of the sequences to keep.

        Raises:
            ValueError: if a sequence does not exist.
        """
        return replace(self, panel=self.panel.only(sequences))

    def recut(self, **cut: Any) -> Self:
        """Return the data with another cut, such as another horizon; units do not change.

        Args:
            **cut: fields of `Cut`.
        """
        return replace(self, schema=replace(self.schema, cut=replace(self.schema.cut, **cut)))

    def windows(self, split: str) -> PanelWindows:
        """Return the windows of "train", "validation", "test" or "train+validation"; "all" ignores the split.

        Args:
            split: "train", "validation", "test", "train+validation" or "all".

        Raises:
            ValueError: the split has no window.
        """
        return PanelWindows(self.panel, self.schema, split)

    def before(self, steps: int) -> Self:
        """Return the data divided by time before the last steps, with units from the new training part.

        Args:
            steps: number of steps for test, as in `Cut.test`.

        Raises:
            ValueError: the steps before have no training window.
        """
        cut = replace(self.schema.cut, split="time", test=steps)
        return replace(self, schema=PanelSchema.from_data(self.panel, cut))

    @property
    def cutoff(self) -> str:
        """Time of the first test step, or its distance from the ends.

        Raises:
            ValueError: the cut has a share for test, and no number of steps.
        """
        steps = self.schema.cut.test_steps
        if not steps:
            raise ValueError(f"test is the share {self.schema.cut.test:g}, which has no cutoff; give a number of steps")
        begin = begin_of(self.panel, steps)
        if begin is None:
            return f"{steps} steps to the end"
        return self.panel.calendar.text(begin).removesuffix(" 00:00:00")

    def following(self, steps: int) -> PanelWindows:
        """Return the test windows whose futures begin before the next cutoff, `steps` steps later.

        Args:
            steps: number of steps.

        Raises:
            ValueError: there is no such window, or the cut has no number of test steps.
        """
        cutoff, windows, cut = self.cutoff, self.windows("test"), self.schema.cut
        if cut.test_steps <= steps:
            return windows
        later = replace(cut, test=cut.test_steps - steps).spans(self.panel, "train+validation")
        ends = {self.panel.series[index].name: end - (cut.observed or 0) for index, _, end in later}
        places = [place for place, (_, name, start) in enumerate(windows.keys) if start < ends[name]]
        if not places:
            raise ValueError(f"{self.panel.name} has no test window that begins within {steps} steps of {cutoff}")
        return windows.subset(places)

    def parts(self) -> dict[str, str]:
        """Describe the windows of each split and the omitted ones, or state why a split is empty.

        Returns:
            Text by name of the split.
        """
        descriptions = {}
        for split in SPLITS:
            try:
                windows = self.windows(split)
            except ValueError as error:
                descriptions[split] = str(error)
            else:
                omitted = f"; left out are {windows.left_out}" if windows.left_out else ""
                descriptions[split] = f"{len(windows)} {split} windows of {self.protocol.name}{omitted}"
        return descriptions

    def ahead(self, horizon: int | None = None) -> PanelWindows:
        """Return one window for each sequence; its future follows the last target, as in `dvae.tables.ahead`.

        Args:
            horizon: steps of the future; the horizon of the schema by default.

        Raises:
            ValueError: if sequences are not cut into windows, are too short, or have no covariates of the future.
        """
        return ahead(self.panel, self.schema, horizon)

    def whole(self) -> PanelWindows:
        """Return all sequences, uncut."""
        return self.recut(observed=None, horizon=None, season=None, split="sequence").windows("all")

    @property
    def location(self) -> str:
        """Absolute path of the file, or the name of a domain."""
        return self.path if is_domain(self.path) else os.path.abspath(self.path)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the sequences."""
        return self.panel.fingerprint()

    @property
    def protocol(self) -> Cut:
        """How sequences are split and cut."""
        return self.schema.cut

    def recorded(self) -> PanelSource:
        """Return the source of the data, for `reopen`."""
        return PanelSource(self.path, self.fingerprint)

    @classmethod
    def reopen(cls, source: PanelSource, schema: PanelSchema, path: str | os.PathLike[str] | None = None) -> Self:
        """Read a recorded panel with the schema of the run, from its path or another one.

        The content may have changed.

        Args:
            source: result of `recorded`.
            schema: schema of the run.
            path: current path, if the data have moved.

        Returns:
            The panel, with the schema of the run.

        Raises:
            FileNotFoundError, ValueError: as in `open`.
        """
        name = os.fspath(path or source.path)
        return cls(name, read_panel(name, schema.columns), schema)


def default_cut(panel: Panel) -> Cut:
    """Return a default cut; sequences without a given split are split by time if they are few or share their dates.

    Fewer than 10 sequences are few. Sequences with the same dates share events, which a split by sequence reveals. The
    horizon is a tenth of the median length, at most 24 steps, and three times as many steps are observed.
    """
    lengths = sorted(len(sequence) for sequence in panel.series)
    horizon = max(min(lengths[len(lengths) // 2] // 10, 24), 1)
    by_time = Cut(3 * horizon, horizon, split="time")
    if any(sequence.split for sequence in panel.series):
        return replace(by_time, split="sequence")
    if len(panel) < 10 or (is_aligned(panel) and all(by_time.starts(panel, split) for split in SPLITS)):
        return by_time
    return replace(by_time, split="sequence")
