"""Run benchmarks, compare them with the last release and store them: `python -m benchmarks.bench`, or `make bench`.

A benchmark is a module of this folder with two members. `rows(device)` returns by name numbers, or functions that
return a number or numbers by name. If such a function fails, only its rows are missing. `TARGETS` maps some of the
names to a side and a bound, or None. Numbers are ratios within one run, or sizes. Lower is better for "at most",
the default, and higher for "at least". "under" and "over" only have a bound: exponents and seconds differ by more than
a tenth between machines.

The exit status is 1 if a measurement fails, or a row is worse by more than a tenth than at the last release, or misses
a target that it met there. The release is the first record of the last version. Machines of one name differ by as much,
so such a row is measured again, and the better value counts. Then it is compared with the code of that record on this
machine.
"""

from __future__ import annotations

import importlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Mapping
from datetime import date
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

import dvae

from .studies.results import RESULTS, Table, refuse_unknown, require_gpu, write

HERE = Path(__file__).parent
HISTORY = HERE / "history.json"
"""Records of the processor; those of a GPU are in gpu-history.json."""
NAMES = ("speed", "gsps", "hit_dvae", "mix_and_match", "trajevae")
NAMES += ("completion", "startup", "files", "mapped", "scaling", "graphs", "peers")
PROCESSORS = {
    "speed: segments": "says what one core does",
    "gsps: memory": "is the process's, not the device's",
    "startup: all but the first step": "is of programs that use no device",
    "files": "is of files, which use no device",
    "mapped": "is of files and of the process's memory",
    "scaling": "is of processes that share the cores",
}
"""Rows or whole benchmarks that a GPU skips, with the reason."""
GPUS = {"graphs": "is of CUDA graphs"}
"""The same for a processor."""
WORSE = 1.1
Target = tuple[str, float | None]
Targets = Mapping[str, Target]
Rows = dict[str, float]
RELEASE_RUN = "DVAE_BENCH_BESIDE"
"""Environment variable of the process that measures a release, which makes no comparison of its own."""
LESS = ("at most", "under")
COMPARED = ("at most", "at least")


def measured(
    name: str, device: torch.device, store: Callable[[Rows, Targets, dict[str, str]], None] = lambda *_: None
) -> tuple[Rows, dict[str, Target]]:
    """Run a benchmark; return its rows and their targets, with the benchmark's name as prefix.

    Args:
        name: name of the benchmark.
        device: device of models and data.
        store: function that is called after each part, with all rows and targets so far, and with the reason of each
            part that failed.
    """
    rows, targets, failures = Rows(), dict[str, Target](), dict[str, str]()
    torch.manual_seed(0)
    try:
        module = importlib.import_module(f".{name}", __package__)
        parts = module.rows(device)
    except Exception as error:
        parts, failures[name] = {}, reason_of(error)
        store(rows, targets, failures)
    for part, value in parts.items():
        try:
            result = value() if callable(value) else value
        except Exception as error:
            failures[f"{name}: {part}"] = reason_of(error)
            result = {}
        for row, number in (result if isinstance(result, dict) else {part: result}).items():
            rows[f"{name}: {row}"], targets[f"{name}: {row}"] = number, module.TARGETS.get(row, ("at most", None))
        store(rows, targets, failures)
    return rows, targets


def reason_of(error: Exception) -> str:
    """Return the message of an error with its kind."""
    return "".join(traceback.format_exception_only(error)).strip()


def meets(value: float, target: Target) -> bool:
    """Return whether a value meets its target."""
    side, bound = target
    return bound is None or (value <= bound if side in LESS else value >= bound)


def better(one: Rows, other: Mapping[str, float], targets: Targets) -> Rows:
    """Return the better of two measurements of each row."""
    both = {row: (value, other.get(row, value)) for row, value in one.items()}
    return {row: (min if targets[row][0] in LESS else max)(values) for row, values in both.items()}


def slower(rows: Mapping[str, float], targets: Targets, before: Mapping[str, float]) -> list[str]:
    """Return the rows that are worse than before by more than a tenth, or miss a target that they met."""

    def is_slower(row: str) -> bool:
        (side, _), now, then = targets[row], rows[row], before[row]
        costs = side in COMPARED and (now > WORSE * then if side in LESS else then > WORSE * now)
        return costs or (meets(then, targets[row]) and not meets(now, targets[row]))

    return [row for row in rows if row in before and is_slower(row)]


def missed(values: Mapping[str, float], targets: Targets) -> list[str]:
    """Return one message for each row that misses its target."""
    rows = [row for row in values if not meets(values[row], targets[row])]
    return [f"{row}: {values[row]:.2f} must be {targets[row][0]} {targets[row][1]:g}" for row in rows]


def commit() -> str:
    """Return the short hash of the measured commit; "" if git cannot find it."""
    return _git("rev-parse", "--short", "HEAD")


def _git(*arguments: str) -> str:
    try:
        process = subprocess.run(["git", "-C", HERE, *arguments], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return process.stdout.strip() or "done"


def measure_at_commit(commit: str, name: str, device: str, threads: int) -> Rows:
    """Measure a benchmark with the code of a commit on this machine; empty if checkout or run fail."""
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "code", Path(folder) / "rows.json"
        if not commit or not _git("worktree", "add", "--detach", str(path), commit):
            return {}
        try:
            options = ["--threads", str(threads), "--out", str(out), *(["--device", device] if device != "cpu" else [])]
            command = [sys.executable, "-m", "benchmarks.bench", name, *options]
            environment = os.environ | {"PYTHONPATH": str(path), RELEASE_RUN: "1"}
            subprocess.run(command, cwd=path, env=environment, capture_output=True, check=False)
            rows: Rows = json.loads(out.read_text())["rows"] if out.exists() else {}
            return rows
        finally:
            _git("worktree", "remove", "--force", str(path))


def machine(device: torch.device) -> dict[str, Any]:
    """Return device, processor and versions of this machine."""
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


def add_record(records: list[dict[str, Any]], record: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the history with a record added; a version keeps its first and its last record, with rows merged.

    Rows of parts that failed in the last run are dropped.
    """
    alike = [
        each
        for each in records
        if (each["version"], device_and_threads(each)) == (record["version"], device_and_threads(record))
    ]
    matching = [each for n, each in enumerate(alike) if (n > 0) == (record["commit"] != alike[0]["commit"])]
    merged = {
        key: {
            name: value
            for part in (*matching, record)
            for name, value in part[key].items()
            if not has_failed(name, record)
        }
        for key in ("rows", "targets")
    }
    if not matching:
        return [*records, record]
    return [record | merged if each is matching[0] else each for each in records]


def has_failed(row: str, record: Mapping[str, Any]) -> bool:
    """Return whether the part of a row failed in a run."""
    return not {row, row.partition(",")[0], row.partition(":")[0]}.isdisjoint(record.get("failed", ()))


def release_rows(records: list[dict[str, Any]], record: dict[str, Any]) -> dict[str, tuple[float, str]]:
    """Return the reference of each row, the first number of the last version in other commits, and its commit."""
    others = [
        each
        for each in records
        if device_and_threads(each) == device_and_threads(record) and each["commit"] != record["commit"]
    ]
    reference: dict[str, tuple[float, str]] = {}
    for each in others:
        if each["version"] == others[-1]["version"]:
            reference = {row: (value, each["commit"]) for row, value in each["rows"].items()} | reference
    return reference


def device_and_threads(record: dict[str, Any]) -> tuple[str, int]:
    """Return the device and the number of threads of a record; records without them are from the processor."""
    return record["machine"].get("device", "cpu"), record["machine"]["threads"]


def tabulate(records: list[dict[str, Any]], results: Path = RESULTS) -> None:
    """Write the table of the last number of each row in this version, and of the release; a GPU has its own table."""
    last = records[-1]
    lines: dict[str, tuple[list[str], str, str]] = {}
    for n, each in enumerate(records):
        if (each["version"], device_and_threads(each)) != (last["version"], device_and_threads(last)):
            continue
        before = release_rows(records[: n + 1], each)
        for name, value in each["rows"].items():
            target = side, bound = each["targets"].get(name, ("at most", None))
            cells = ["", ""] if bound is None else [f"{side} {bound:g}", "yes" if meets(value, target) else "no"]
            reference, commit = before.get(name, (None, ""))
            release = "–" if reference is None else f"{reference:.2f}"
            change = f"{value / reference:.2f}" if reference is not None and side in COMPARED else "–"
            line = [name, *cells, f"{value:.2f}", release, change]
            lines[name] = line, f"{each['commit']} ({each['date']})", commit
    shown = [lines[name] for name in sorted(lines, key=_place) if not has_failed(name, last)]
    commits = {kind: sorted({line[n] for line in shown} - {""}) for n, kind in ((1, "Last"), (2, "release"))}
    note = "; ".join(f"{kind}: {', '.join(names) or 'none'}" for kind, names in commits.items()) + "."
    note += f" Failed: {', '.join(last['failed'])}." if last.get("failed") else ""
    header = ["", "target", "met", "last", "release", "last over release"]
    history = Table(header, [line for line, *_ in shown], note)
    write(results, {f"speed/{'history' if device_and_threads(last)[0] == 'cpu' else 'gpu-history'}": history})


def _place(row: str) -> int:
    """Return the position of a row's benchmark in `NAMES`."""
    name = row.partition(":")[0]
    return NAMES.index(name) if name in NAMES else len(NAMES)


def main(
    names: tyro.conf.Positional[tuple[str, ...]] = NAMES,
    threads: int = 1,
    device: Literal["cpu", "cuda"] = "cpu",
    out: Path = Path("bench.json"),
    keep: bool = False,
) -> int:
    """Run benchmarks.

    Args:
        names: benchmarks to run.
        threads: number of torch threads.
        device: device of models and data. A GPU skips some rows; the output names them.
        out: file of the numbers, written after each part of a benchmark.
        keep: whether to add the numbers to the history and its table.
    """
    refuse_unknown("benchmark", names, NAMES)
    if device == "cuda":
        require_gpu("device")
    if threads < 1:
        sys.exit(f"threads must be at least 1, got {threads}")
    if not out.parent.is_dir():
        sys.exit(
            f"{out} is in a folder that does not exist; create {out.parent} first, or name another file with --out"
        )
    torch.set_num_threads(threads)
    place = torch.device(device)
    record = {
        "version": dvae.__version__,
        "commit": commit(),
        "date": date.today().isoformat(),
        "machine": machine(place),
    }
    history = HISTORY if device == "cpu" else HISTORY.with_name(f"gpu-{HISTORY.name}")
    records = json.loads(history.read_text()) if history.exists() else []
    release = {} if RELEASE_RUN in os.environ else release_rows(records, record)
    numbers: Rows = {}
    targets: dict[str, Target] = {}
    failures: dict[str, str] = {}
    failed: list[str] = []

    def store(rows: Rows, bounds: Targets, reasons: Mapping[str, str]) -> None:
        for part in reasons.keys() - failures.keys():
            print(f"  {part} failed: {reasons[part]}", flush=True)
        numbers.update({row: round(value, 4) for row, value in rows.items()})
        targets.update(bounds)
        failures.update(reasons)
        last = record | {"rows": numbers, "targets": targets, "failed": failures}
        out.write_text(json.dumps(last, indent=1) + "\n")
        if keep:
            updated = add_record(records, last)
            history.write_text(json.dumps(updated, indent=1) + "\n")
            tabulate(updated)

    for name in names:
        print(f"{name} ...", flush=True)
        skipped = GPUS if device == "cpu" else PROCESSORS
        left_out = {row: reason for row, reason in skipped.items() if row.partition(":")[0] == name}
        for row, reason in left_out.items():
            print(f"  {row} is left out: it {reason}", flush=True)
        if name in left_out:
            continue
        rows, bounds = measured(name, place, store)
        before = {row: release[row][0] for row in rows if row in release}
        if slower(rows, bounds, before):
            rows = better(rows, measured(name, place)[0], bounds)
        if doubtful := slower(rows, bounds, before):
            for old in {release[row][1] for row in doubtful}:
                old_rows = measure_at_commit(old, name, device, threads)
                before |= {row: value for row, value in old_rows.items() if row in before and release[row][1] == old}
            failed += [
                f"{row}: {rows[row]:.2f} was {before[row]:.2f} at the last release"
                for row in slower(rows, bounds, before)
                if row in doubtful
            ]
        for row, value in rows.items():
            was = f"{before[row]:8.2f}" if row in before else " " * 8
            side, bound = bounds[row]
            print(f"  {row:50} {value:8.2f} {was}   {'' if bound is None else f'{side} {bound:g}'}", flush=True)
        store(rows, bounds, {})
    messages = {
        "targets missed:": missed(numbers, targets),
        "slower than at the last release:": failed,
        "failed:": [f"{part}: {why}" for part, why in failures.items()],
    }
    for title, lines in messages.items():
        if lines:
            print(title, *lines, sep="\n  ")
    return int(bool(failed or failures))


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(main, description=__doc__))
    except KeyboardInterrupt:
        sys.exit("stopped; finished rows are written; to continue, give the names of the other benchmarks")
