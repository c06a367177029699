"""Panels as runs keep and reopen them: a file with its columns, or one of `dvae.tables.domains` by its name."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

from ..options import check, require
from .ahead import ahead
from .columns import Columns
from .encoding import PanelSchema
from .panel import SPLITS, Panel
from .proposing import Told
from .protocol import Cut
from .reading import is_domain, read_panel, schema_beside
from .windows import PanelWindows


@dataclass(frozen=True)
class Tabled:
    """Where a panel was, as a run keeps it.

    Args:
        path: the file as it was given.
        fingerprint: SHA-256 of the sequences.
    """

    path: str
    fingerprint: str

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class PanelData:
    """A panel under a schema.

    Args:
        path: the file as it was given.
        panel: its sequences.
        schema: what models see of them.
    """

    kind: ClassVar[str] = "panel"
    described: ClassVar[str] = PanelSchema.kind
    source: ClassVar[type[Tabled]] = Tabled
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
        **told: Any,
    ) -> Self:
        """Reads a file, by the schema that stands beside it, if there is one.

        Args:
            path: of a CSV, Parquet, npz or npy file, of a folder of npy files, or the name of a data set of
                `dvae.tables.domains`.
            columns: what its columns are, in place of that schema: one, or the targets in words, see `Told`.
            cut: how sequences are divided and cut; by default what the schema says, or what suits them.
            **told: further fields of `Told` and of `Cut`.

        Raises:
            FileNotFoundError: there is no such file.
            TypeError: `cut` that is no `Cut`.
            ValueError: a file or a schema that cannot be read.
        """
        require(Cut | None, cut=cut)
        name = os.fspath(path)
        how = {field.name: told.pop(field.name) for field in fields(Cut) if field.name in told}
        beside, beside_cut = schema_beside(name)
        if not isinstance(columns, Columns):
            words = Told(tuple(columns), **told)
            columns = beside if words == Told() and beside is not None else words  # type: ignore[assignment]
        panel = read_panel(name, columns)  # type: ignore[arg-type]
        cut = replace(cut or beside_cut or suited(panel), **how)
        return cls(name, panel, PanelSchema.under(panel, cut))

    @classmethod
    def of(cls, data: Any, columns: Any = None, cut: Cut | None = None, name: str = "panel") -> Self:
        """A panel in memory, see `Panel.of`; a run that is fitted to it cannot find it again by a path."""
        require(Cut | None, cut=cut)
        panel = Panel.of(data, columns, name)
        return cls(name, panel, PanelSchema.under(panel, cut or suited(panel)))

    def on(self, data: Any) -> Self:
        """Other data, of what `Panel.of` takes, under this schema: the columns, cut and units that models know."""
        return replace(self, panel=Panel.of(data, self.panel.columns, self.panel.name))

    def only(self, sequences: Iterable[str]) -> Self:
        """Some of the sequences, by their names.

        Raises:
            ValueError: one that is not there.
        """
        return replace(self, panel=self.panel.only(sequences))

    def recut(self, **cut: Any) -> Self:
        """The same, cut otherwise, such as with another horizon; units stay those that models know.

        Args:
            **cut: fields of `Cut`.
        """
        return replace(self, schema=replace(self.schema, cut=replace(self.schema.cut, **cut)))

    def windows(self, split: str) -> PanelWindows:
        """The windows of "train", "validation", "test" or "train+validation"; of "all", wherever they are."""
        return PanelWindows(self.panel, self.schema, split)

    def parts(self) -> dict[str, str]:
        """For training, validation and test: what windows there are and which are left out, or why there are none."""
        found = {}
        for split in SPLITS:
            try:
                windows = self.windows(split)
            except ValueError as error:
                found[split] = str(error)
            else:
                less = f"; left out are {windows.left_out}" if windows.left_out else ""
                found[split] = f"{len(windows)} {split} windows of {self.protocol.name}{less}"
        return found

    def ahead(self, horizon: int | None = None) -> PanelWindows:
        """The end of each sequence, and what comes after it, see `dvae.tables.ahead`.

        Args:
            horizon: steps of the future; by default those of the schema.

        Raises:
            ValueError: whole sequences, sequences that are too short, or covariates that the future lacks.
        """
        return ahead(self.panel, self.schema, horizon)

    def whole(self) -> PanelWindows:
        """All sequences, uncut."""
        return self.recut(observed=None, horizon=None, split="sequence").windows("all")

    @property
    def location(self) -> str:
        """Where the file is, as any process finds it, or the name of a domain."""
        return self.path if is_domain(self.path) else os.path.abspath(self.path)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the sequences."""
        return self.panel.fingerprint()

    @property
    def protocol(self) -> Cut:
        """How sequences are divided and cut."""
        return self.schema.cut

    def recorded(self) -> Tabled:
        """Where it is; `reopened` reads it."""
        return Tabled(self.path, self.fingerprint)

    @classmethod
    def reopened(cls, source: Tabled, schema: PanelSchema, path: str | os.PathLike[str] | None = None) -> Self:
        """The panel that was recorded, from there or from another path, whatever it is now, under the run's schema.

        Raises:
            FileNotFoundError, ValueError: see `open`.
        """
        name = os.fspath(path or source.path)
        return cls(name, read_panel(name, schema.columns), schema)


def suited(panel: Panel) -> Cut:
    """How a panel is divided where nobody says: few sequences by time, and by sequence where they are many.

    A tenth of the median sequence, and 24 steps at most, is to be forecast, from three times as many.
    """
    lengths = sorted(len(one) for one in panel.series)
    few = len(panel) < 10 and not any(one.split for one in panel.series)
    horizon = max(min(lengths[len(lengths) // 2] // 10, 24), 1)
    return Cut(3 * horizon, horizon, split="time" if few else "sequence")
