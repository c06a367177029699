"""What the studies share: names of directories, fits and measurements that are made once, and estimates in print."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import dvae
from dvae.inference.evaluation.estimates import Estimate
from dvae.inference.evaluation.record import plain
from dvae.inference.training.checkpoints import Run


def folder(name: Any) -> str:
    """The directory of a section, a case or a row, by its name."""
    return str(name).replace(", ", "-").replace(",", "").replace(" ", "-")


def kept(file: Path, measure: Callable[[], Mapping[str, Any]]) -> dict[str, Any]:
    """What is in a file; or what `measure` returns, which is written to it with the seconds of processor time."""
    if not file.exists():
        begun = time.process_time()
        found = {**measure(), "seconds": time.process_time() - begun}
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(plain(found)))
        print(f"{file}: {found['seconds']:.0f} s of processor time", flush=True)
    read: dict[str, Any] = json.loads(file.read_text())
    return read


def fitted(model: Any, train: Any, *validation: Any, out: Path, **options: Any) -> float | None:
    """Fit a model, or continue its run; return seconds of processor time, None of a run that was stopped before."""
    begun, resumed = time.process_time(), Run(out).exists
    dvae.fit(model, train, *validation, out=out, resume=resumed, progress=False, **options)
    return None if resumed else time.process_time() - begun


def said(found: Estimate | None, digits: int = 1) -> str:
    """Mean, and its errors over clips and over seeds; a dash for what is unknown."""
    values = () if found is None else (found.mean, found.sequences, found.seeds)
    return " ± ".join("–" if np.isnan(value) else f"{value:.{digits}f}" for value in values) or "–"


def interval(found: Estimate | None, digits: int = 1, *, alone: bool = False) -> str:
    """The interval of 95 % from both errors, or, with `alone`, from that over clips where there is one seed."""
    if found is None or (np.isnan(found.total) and not alone):
        return "–"
    low, high = found.interval(error="sequences" if np.isnan(found.total) else "total")
    return "–" if np.isnan(low) else f"{low:.{digits}f} to {high:.{digits}f}"
