"""Print the size of the project and its targets: `python -m benchmarks.size`; takes a minute.

lines      lines of code, without docstrings, comments and blank lines
calls      calls between files of the project: in a training step; in a forecast of 50 futures of 60 frames; from a
           DataFrame to a CSV of forecasts by an unfitted model
"""

import ast
import io
import os
import subprocess
import sys
import tokenize
import tomllib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import torch
from rich.console import Console
from rich.table import Table

import dvae

ROOT = Path(__file__).parents[1]
SOURCE = ("dvae", "models", "inference")
TARGETS = {
    "lines of source": 25_000,
    "lines of tests": 17_000,
    "tests": 3_500,
    "lines of benchmarks": 3_500,
    "files of stored scores": 30,
    "files in the largest folder": 15,
    "dependencies": 15,
    "calls, step of srnn": 57,
    "calls, forecast of srnn": 621,
    "calls, forecast of hit-dvae": 1_435,
    "calls, table to forecasts": 456,
}
"""Upper bounds. Those of calls are half of the counts before the layout of November 2026."""
LAYOUT = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)


def lines(file: Path) -> int:
    """Count the lines of code of a Python file."""
    text, numbers = file.read_text(encoding="utf-8"), set[int]()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in LAYOUT:
            numbers |= {*range(token.start[0], token.end[0] + 1)}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            numbers -= {*range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1)}
    return len(numbers)


def calls(run: Callable[[], object]) -> int:
    """Count calls from a file of the project to another one."""
    parts, places, count = tuple(str(ROOT / part) + os.sep for part in SOURCE), dict[str, str](), 0

    def trace(frame, event, _) -> None:
        nonlocal count
        if event == "call" and frame.f_back is not None:
            file, caller = (
                places.setdefault(code.co_filename, os.path.realpath(code.co_filename))
                for code in (frame.f_code, frame.f_back.f_code)
            )
            count += file != caller and file.startswith(parts) and caller.startswith(parts)

    sys.setprofile(trace)
    try:
        run()
    finally:
        sys.setprofile(None)
    return count


def traced() -> dict[str, int]:
    """Count the calls of two methods on simulated motion, and of a table."""
    counts, protocol = {}, dvae.motion.PROTOCOLS["simulated"]
    windows = dvae.motion.windows(dvae.motion.simulate(clips=8), protocol, "train")
    batch = windows.sample(4, torch.Generator().manual_seed(0))
    for name in ("srnn", "hit-dvae"):
        model = dvae.method(name).build(windows)

        def step(model=model) -> None:
            dvae.SequenceELBO().terms(model, batch).bound.sum().backward()

        def forecast(model=model) -> None:
            model.forecast({"x": batch["x"][:, : protocol.observed]}, protocol.predicted, 50)

        for name_of_run, run in (("step", step), ("forecast", forecast)):
            run()
            counts[f"calls, {name_of_run} of {name}"] = calls(run)

    def table() -> None:
        days = np.tile(range(20), 10)
        frame = pd.DataFrame({"unit": np.repeat([*"abcdefghij"], 20), "day": days, "x": days % 7})
        data = dvae.tables.PanelData.of(frame, cut=dvae.tables.Cut(observed=6, horizon=3))
        with TemporaryDirectory() as folder:
            data.windows("test").forecast(dvae.method("srnn").build(data), 50).save(Path(folder) / "futures.csv")

    return counts | {"calls, table to forecasts": calls(table)}


def measured() -> dict[str, int]:
    """Return the number of each row."""
    paths = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    files = [path for path in map(Path, paths) if not (ROOT / path).is_symlink()]
    lines_by_folder = Counter[str]()
    for path in files:
        lines_by_folder[path.parts[0]] += lines(ROOT / path) if path.suffix == ".py" else 0
    folders = Counter(path.parent for path in files if path.suffix == ".py" and path.parts[0] in SOURCE)
    collected = subprocess.run(
        [sys.executable, "-m", "pytest", "--collect-only", "-q"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return {
        "lines of source": sum(lines_by_folder[part] for part in SOURCE),
        "lines of tests": lines_by_folder["tests"],
        "tests": sum("::" in line for line in collected.stdout.splitlines()),
        "lines of benchmarks": lines_by_folder["benchmarks"],
        "files of stored scores": sum(path.is_relative_to("benchmarks/scores") for path in files),
        "files in the largest folder": max(folders.values()),
        "dependencies": len(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]),
        **traced(),
    }


if __name__ == "__main__":
    shown = Table("", "now", "target", box=None)
    for name, value in measured().items():
        shown.add_row(name, f"{value:,}", f"{TARGETS[name]:,}" if name in TARGETS else "")
    Console().print(shown)
