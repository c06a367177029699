"""Runs benchmarks, compares them with the last release and keeps them: `python -m benchmarks.bench`, or `make bench`.

A benchmark is a module of this folder with `rows()`, from names to numbers, and `TARGETS`, from some of these names to
a bound. Numbers are ratios within one run, so that they mean the same on other machines, or sizes. The exit status is 1
where a target is missed, or where a row with a target is worse by more than a tenth than at the last release; such a
row is measured once more before, and the better one counts.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import platform
import sys
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Any

import torch
import tyro

import dvae

from .tables.pages import DOCS, refuse_unknown, table, write

HERE = Path(__file__).parent
HISTORY = HERE / "history.json"
NAMES = ("speed", "gsps", "hit_dvae", "mix_and_match", "trajevae", "completion", "startup", "files")
WORSE = 1.1
Targets = Mapping[str, tuple[str, float]]


def measured(name: str) -> tuple[dict[str, float], dict[str, tuple[str, float]]]:
    """Rows of a benchmark and their targets, named after it."""
    module = importlib.import_module(f".{name}", __package__)
    torch.manual_seed(0)
    found, targets = module.rows(), module.TARGETS
    return (*({f"{name}: {row}": value for row, value in each.items()} for each in (found, targets)),)


def met(value: float, target: tuple[str, float]) -> bool:
    """Whether a target is; of one that is no number it is not."""
    side, bound = target
    return value <= bound if side == "at most" else value >= bound


def worse(value: float, before: float, side: str) -> float:
    """How many times worse a row is than before."""
    return value / before if side == "at most" else before / value


def better(one: float, other: float, side: str) -> float:
    """Of two measurements of a row."""
    return min(one, other) if side == "at most" else max(one, other)


def failures(found: Mapping[str, float], targets: Targets, before: Mapping[str, float]) -> dict[str, str]:
    """Rows that miss their target or are worse than before, and what is to be said of them."""
    said = {}
    for name, (side, bound) in targets.items():
        parts = [] if met(found[name], (side, bound)) else [f"is to be {side} {bound:g}"]
        if name in before and worse(found[name], before[name], side) > WORSE:
            parts.append(f"was {before[name]:.2f} at the last release")
        if parts:
            said[name] = f"{name}: {found[name]:.2f} " + ", ".join(parts)
    return said


def machine() -> dict[str, Any]:
    """What numbers were measured on."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": names[0] if names else platform.processor() or platform.machine(),
        "instructions": torch.backends.cpu.get_cpu_capability(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def page(records: list[dict[str, Any]], path: Path | None = DOCS / "results" / "speed.md") -> None:
    """Writes the history, newest first, and the ratio of the last two."""
    newest = records[::-1]
    last, before = newest[0], newest[1]["rows"] if len(newest) > 1 else {}
    lines = []
    for name, value in last["rows"].items():
        target = last["targets"].get(name)
        said = "" if target is None else f"{target[0]} {target[1]:g}"
        number = f"{value:.2f}" if target is None or not met(value, target) else f"**{value:.2f}**"
        change = f"{value / before[name]:.2f}" if name in before else "–"
        lines.append([name, said, number, *(f"{r['rows'].get(name, math.nan):.2f}" for r in newest[1:4]), change])
    heads = [f"{record['version']}, {record['date']}" for record in newest[:4]]
    write(path, table(["", "target", *heads, "last over the one before"], lines), name="history")


def main(
    names: tyro.conf.Positional[tuple[str, ...]] = NAMES,
    threads: int = 1,
    out: Path = Path("bench.json"),
    keep: bool = False,
) -> int:
    """Measure.

    Args:
        names: of benchmarks.
        threads: of torch.
        out: where the numbers are written.
        keep: whether they join the history, as those of this version, and its page.
    """
    refuse_unknown("benchmark", names, NAMES)
    torch.set_num_threads(threads)
    records = json.loads(HISTORY.read_text()) if HISTORY.exists() else []
    releases = [record for record in records if record["machine"]["threads"] == threads]
    before = releases[-1]["rows"] if releases else {}
    found: dict[str, float] = {}
    targets: dict[str, tuple[str, float]] = {}
    for name in names:
        print(f"{name} ...", flush=True)
        rows, bounds = measured(name)
        slower = (row for row in bounds if row in before and worse(rows[row], before[row], bounds[row][0]) > WORSE)
        if any(slower):
            for row, value in measured(name)[0].items():
                rows[row] = better(rows[row], value, bounds.get(row, ("at most", 0))[0])
        for row, value in rows.items():
            was = f"{before[row]:8.2f}" if row in before else " " * 8
            print(f"  {row:50} {value:8.2f} {was}   {' '.join(map(str, bounds.get(row, ())))}", flush=True)
        found |= rows
        targets |= bounds
    record = {
        "version": dvae.__version__,
        "date": date.today().isoformat(),
        "machine": machine(),
        "rows": {row: round(value, 4) for row, value in found.items()},
        "targets": targets,
    }
    out.write_text(json.dumps(record, indent=1) + "\n")
    if keep:
        records = [each for each in records if each["version"] != record["version"]] + [record]
        HISTORY.write_text(json.dumps(records, indent=1) + "\n")
        page(records)
    failed = failures(found, targets, before)
    print(*failed.values(), sep="\n")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(tyro.cli(main, description=__doc__))
