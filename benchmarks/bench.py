"""Runs benchmarks, compares them with the last release and keeps them: `python -m benchmarks.bench`, or `make bench`.

A benchmark is a module of this folder with `rows(device)`, from names to numbers, and `TARGETS`, from some of these
names to a bound. Numbers are ratios within one run, so that they mean the same on other machines, or sizes. The exit
status is 1 where a target is missed, or where a row with a target is worse by more than a tenth than at the last
release on such a device; such a row is measured once more before, and the better one counts.
"""

from __future__ import annotations

import importlib
import json
import os
import platform
import sys
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

import dvae

from .tables.pages import DOCS, refuse_unknown, table, write

HERE = Path(__file__).parent
HISTORY = HERE / "history.json"
NAMES = (
    "speed",
    "gsps",
    "hit_dvae",
    "mix_and_match",
    "trajevae",
    "completion",
    "compiled",
    "startup",
    "files",
    "mapped",
    "scaling",
)
PROCESSORS = {
    "speed: segments": "says what one core does",
    "gsps: memory": "is the process's, not the device's",
    "startup": "is of programs that start, which use no device",
    "files": "is of files, which use no device",
    "mapped": "is of files and of the process's memory",
    "scaling": "is of processes that share the cores",
}
"""Rows that are left out on a GPU, or all of a benchmark, and why."""
WORSE = 1.1
Targets = Mapping[str, tuple[str, float]]


def measured(name: str, device: torch.device) -> tuple[dict[str, float], dict[str, tuple[str, float]]]:
    """Rows of a benchmark and their targets, named after it."""
    module = importlib.import_module(f".{name}", __package__)
    torch.manual_seed(0)
    found = module.rows(device)
    targets = {row: target for row, target in module.TARGETS.items() if row in found}
    own = [{f"{name}: {row}": value for row, value in each.items()} for each in (found, targets)]
    return own[0], own[1]


def met(value: float, target: tuple[str, float]) -> bool:
    """Whether a row is where its target has it."""
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


def machine(device: torch.device) -> dict[str, Any]:
    """What numbers were measured on."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return {
        "device": "cpu" if device.type == "cpu" else torch.cuda.get_device_name(device),
        "processor": names[0] if names else platform.processor() or platform.machine(),
        "instructions": torch.backends.cpu.get_cpu_capability(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def kept(records: list[dict[str, Any]], record: dict[str, Any]) -> list[dict[str, Any]]:
    """The history with a record; one of that version, measured alike, keeps the rows that were not measured anew."""

    def same(each: dict[str, Any]) -> bool:
        return (each["version"], how(each)) == (record["version"], how(record))

    parts = [*filter(same, records), record]
    joined = {key: {name: value for part in parts for name, value in part[key].items()} for key in ("rows", "targets")}
    return [*(each for each in records if not same(each)), record | joined]


def how(record: dict[str, Any]) -> tuple[str, int]:
    """On which device and how many threads a record was measured; the first ones were, untold, on the processor."""
    return record["machine"].get("device", "cpu"), record["machine"]["threads"]


def page(records: list[dict[str, Any]], path: Path | None = DOCS / "results" / "speed.md") -> None:
    """Writes the history, newest first, of what was measured as the last was, and the ratio of the last two.

    Of the processor and of a GPU there is one each.
    """
    newest = [record for record in records[::-1] if how(record) == how(records[-1])]
    last, before = newest[0], newest[1]["rows"] if len(newest) > 1 else {}
    lines = []
    for name, value in last["rows"].items():
        target = last["targets"].get(name)
        said = "" if target is None else f"{target[0]} {target[1]:g}"
        number = f"{value:.2f}" if target is None or not met(value, target) else f"**{value:.2f}**"
        change = f"{value / before[name]:.2f}" if name in before else "–"
        lines.append([name, said, number, *(_number(r["rows"].get(name)) for r in newest[1:4]), change])
    heads = [f"{record['version']}, {record['date']}" for record in newest[:4]]
    history = table(["", "target", *heads, "last over the one before"], lines)
    write(path, history, name="history" if how(last)[0] == "cpu" else "GPU history")


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def main(
    names: tyro.conf.Positional[tuple[str, ...]] = NAMES,
    threads: int = 1,
    device: Literal["cpu", "cuda"] = "cpu",
    out: Path = Path("bench.json"),
    keep: bool = False,
) -> int:
    """Measure.

    Args:
        names: of benchmarks.
        threads: of torch.
        device: where models and their data are. On a GPU some rows are left out, which is told.
        out: where the numbers are written, after each benchmark.
        keep: whether they join the history, as those of this version, and its page.
    """
    refuse_unknown("benchmark", names, NAMES)
    if device == "cuda" and not torch.cuda.is_available():
        built = "" if torch.version.cuda else ", as it is built without CUDA"
        sys.exit(f"torch {torch.__version__} finds no GPU{built}; leave the device out, or take a machine with one")
    torch.set_num_threads(threads)
    there = torch.device(device)
    on = machine(there)
    records = json.loads(HISTORY.read_text()) if HISTORY.exists() else []
    releases = [record for record in records if how(record) == how({"machine": on})]
    before = releases[-1]["rows"] if releases else {}
    found: dict[str, float] = {}
    targets: dict[str, tuple[str, float]] = {}
    for name in names:
        print(f"{name} ...", flush=True)
        left_out = {row: why for row, why in PROCESSORS.items() if device != "cpu" and row.partition(":")[0] == name}
        for row, why in left_out.items():
            print(f"  {row} is left out: it {why}", flush=True)
        if name in left_out:
            continue
        rows, bounds = measured(name, there)
        slower = (row for row in bounds if row in before and worse(rows[row], before[row], bounds[row][0]) > WORSE)
        if any(slower):
            for row, value in measured(name, there)[0].items():
                rows[row] = better(rows[row], value, bounds.get(row, ("at most", 0))[0])
        for row, value in rows.items():
            was = f"{before[row]:8.2f}" if row in before else " " * 8
            print(f"  {row:50} {value:8.2f} {was}   {' '.join(map(str, bounds.get(row, ())))}", flush=True)
        found |= {row: round(value, 4) for row, value in rows.items()}
        targets |= bounds
        record = {
            "version": dvae.__version__,
            "date": date.today().isoformat(),
            "machine": on,
            "rows": found,
            "targets": targets,
        }
        out.write_text(json.dumps(record, indent=1) + "\n")
        if keep:
            records = kept(records, record)
            HISTORY.write_text(json.dumps(records, indent=1) + "\n")
            page(records)
    failed = failures(found, targets, before)
    print(*failed.values(), sep="\n")
    return int(bool(failed))


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(main, description=__doc__))
    except KeyboardInterrupt:
        sys.exit("stopped; benchmarks that had ended are written, give the names of the others to go on")
