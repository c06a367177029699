"""Untrusted run directories: a run is used, or is an error of one sentence."""

import contextlib
import hashlib
import io
import json
import math
import os
import pickle
import shutil
import warnings
from pathlib import Path
from typing import Any

import lightning_fabric  # noqa: F401  # imported before files are watched
import matplotlib.figure  # noqa: F401
import torch
from hypothesis import strategies as st
from safetensors import SafetensorError
from safetensors.torch import load, save

import dvae
from dvae import motion
from dvae.cli import assessment, futures, segments
from dvae.cli.loading import ON_CPU
from dvae.inference.training.checkpoints import BEST, CONFIG, LAST, OPTIMISER, STATE
from dvae.motion.data.dataset import MotionData
from dvae.motion.segments.dataset import SegmentData
from dvae.runs import directory as runs

from .engine import Isolated, fuzz, limited

SHARE = 15
FILES = (CONFIG, STATE, BEST, LAST, OPTIMISER, "log.jsonl", "evaluation.json", ".lock")
FILES += (f"{STATE}.new", f"{LAST}.new", f"{OPTIMISER}.new", f"{CONFIG}.new")
NOTHING_LEFT = (
    SafetensorError,
    pickle.UnpicklingError,
    OSError,
    ValueError,
    LookupError,
    TypeError,
    ArithmeticError,
    RuntimeError,
    MemoryError,
)
"""Errors of a mutation of a file that an earlier mutation has damaged."""
LAST_OF_ALL = ("longer", "link", "special")
"""Mutations that come last, because they cannot read the file afterwards."""
TARGETS = ("mine.txt", "nowhere", "fifo")
CALLS = ("load", "resume", "forecast", "evaluate")


def values():
    """Return a strategy of values of every type, at and beyond the ends of its range."""
    numbers = [-1, 0, 1, 2, 40, 4096, 20_000, 100_000, 10**9, 2**63, 10**400, 0.5, -0.0, 1e308, math.nan, math.inf]
    texts = ["", "vae", "gsps", "../mine.txt", "/dev/zero", "simulated", "\0", "[/red]", "é" * 20_000]
    return st.recursive(
        st.sampled_from([None, True, False, *numbers, *texts]),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["schedule", "a", "step"]), inner),
        max_leaves=4,
    )


def mutations():
    places, byte = st.integers(0, 2**20), st.integers(0, 255)
    binary = st.sampled_from([BEST, LAST, OPTIMISER])
    return st.one_of(
        st.tuples(st.just("value"), st.sampled_from([CONFIG, STATE]), places, values()),
        st.tuples(st.just("value"), st.just(CONFIG), places, values()),
        st.tuples(st.just("without"), st.sampled_from([CONFIG, STATE]), places),
        st.tuples(st.just("text"), st.sampled_from([CONFIG, STATE, "log.jsonl"]), places, st.binary(max_size=20)),
        st.tuples(st.just("bytes"), binary, st.lists(st.tuples(places, byte), min_size=1, max_size=4), st.booleans()),
        st.tuples(st.just("shorter"), binary, places, st.booleans()),
        st.tuples(st.just("longer"), st.sampled_from(FILES[:6]), st.sampled_from([1, 2**20, 2**36]), st.booleans()),
        st.tuples(st.just("link"), st.sampled_from(FILES), st.sampled_from(TARGETS)),
        st.tuples(st.just("special"), st.sampled_from(FILES), st.sampled_from(["fifo", "directory", "nothing"])),
        st.tuples(st.just("weights"), binary, places, st.sampled_from(sorted(DAMAGES))),
    )


DAMAGES = {
    "NaN": lambda value: value * math.nan,
    "infinite": lambda value: value * math.inf,
    "huge": lambda value: value * 0 + 3e38,
    "negative": lambda value: -value - 1,
    "whole": lambda value: value.long(),
    "complex": lambda value: value.to(torch.complex64),
    "bfloat16": lambda value: value.to(torch.bfloat16),
    "bytes": lambda value: value.to(torch.uint8),
    "empty": lambda value: value.flatten()[:0],
    "flat": lambda value: value.flatten(),
    "missing": None,
}


def paths(value: Any, before: tuple = ()) -> list[tuple]:
    """Return the keys of every value in nested dicts and lists."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path for key, each in inner for path in [(*before, key), *paths(each, (*before, key))]]


def value_at(value: Any, path: tuple) -> Any:
    for key in path:
        value = value[key]
    return value


def commit(run: Path, name: str, content: bytes, signed: bool) -> None:
    """Replace a file, and its fingerprint if `signed`."""
    (run / name).write_bytes(content)
    if signed:
        state = json.loads((run / STATE).read_text())
        state["fingerprints"][name] = hashlib.sha256(content).hexdigest()
        (run / STATE).write_text(json.dumps(state))


def mutate(run: Path, kind: str, *arguments: Any) -> None:
    if kind in ("value", "without"):
        name, place, *new = arguments
        content = json.loads((run / name).read_text())
        *parents, last = (all_paths := paths(content))[place % len(all_paths)]
        if new:
            value_at(content, tuple(parents))[last] = new[0]
        else:
            del value_at(content, tuple(parents))[last]
        (run / name).write_text(json.dumps(content))
    elif kind == "text":
        name, place, text = arguments
        content = (run / name).read_bytes()
        place %= len(content)
        (run / name).write_bytes(content[:place] + text + content[place + len(text) // 2 :])
    elif kind == "bytes":
        name, changes, signed = arguments
        content = bytearray((run / name).read_bytes())
        for place, byte in changes:
            content[place % min(len(content), 4096 if place % 2 else len(content))] = (
                byte  # half of the changes are in the headers
            )
        commit(run, name, bytes(content), signed)
    elif kind == "shorter":
        name, place, signed = arguments
        content = (run / name).read_bytes()
        commit(run, name, content[: place % len(content)], signed)
    elif kind == "longer":
        name, size, _ = arguments
        with (run / name).open("r+b") as file:
            file.truncate(file.seek(0, 2) + size)
    elif kind in ("link", "special"):
        name, target = arguments
        (run / name).unlink(missing_ok=True)
        if kind == "link":
            (run / name).symlink_to(run.parent / target)
        elif target == "fifo":
            os.mkfifo(run / name)
        elif target == "directory":
            (run / name).mkdir()
    elif kind == "weights":
        name, place, damage = arguments
        tensors = load((run / name).read_bytes())
        key = sorted(tensors)[place % len(tensors)]
        value = tensors.pop(key)
        if DAMAGES[damage] is not None:
            tensors[key] = DAMAGES[damage](value)
        commit(run, name, save(tensors), True)


def clear(folder: Path) -> None:
    """Remove a folder file by file, since the engine checks paths and `shutil.rmtree` gives it none."""
    for parent, inner, names in os.walk(folder, topdown=False):
        for name in names:
            os.unlink(os.path.join(parent, name))
        for name in inner:
            os.rmdir(os.path.join(parent, name))
    if folder.exists():
        folder.rmdir()


def check(example: tuple, directory: Path) -> None:
    """Damage a copy of a run and use it; check that files outside of it are unchanged."""
    call, fitted, changes = example
    folder = directory / "inside"
    clear(folder)
    run = folder / "run"
    shutil.copytree(directory / fitted, run)
    canary = folder / "mine.txt"
    canary.write_text("of value")
    os.mkfifo(folder / "fifo")
    before = sorted(each.name for each in folder.iterdir())
    for change in sorted(changes, key=lambda change: LAST_OF_ALL.index(change[0]) if change[0] in LAST_OF_ALL else -1):
        with contextlib.suppress(*NOTHING_LEFT):
            mutate(run, *change)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            use(call, fitted, run, directory / "people.npz")
    finally:
        assert canary.read_text() == "of value"
        assert sorted(each.name for each in folder.iterdir()) == before


def use(call: str, fitted: str, run: Path, data: Path) -> None:
    if call == "load":
        assert dvae.load(run, data).data
    elif call == "resume":
        runs.resume(run, data, steps=6, progress=False)
    elif call == "forecast" and fitted == "latent":
        quick = dvae.Descent(steps=1, starts=1, candidates=1, newton=0)
        glimpse = segments.Glimpse(seen="markers", seconds=0.2)
        recovery = segments.Recovery(glimpse, descent=quick, source=("person_0001",))
        recovery.run(run, run / "found.npz", 0, 0, str(data), ON_CPU)
    elif call == "forecast":
        futures.forecast(run, run / "futures.npz", futures.Paths(), samples=1, horizon=2, data=str(data))
    else:
        few = {} if fitted == "latent" else {"samples": 1}
        assessment.evaluate((run,), assessment.Control(), data=str(data), **few)


@limited(SHARE)
def test_damaged_runs_are_used_or_an_error(tmp_path):
    motion.save(tmp_path / "people.npz", motion.simulate(clips=12, frames=76, seed=1))
    method = dvae.method("vrnn", latent=2, width=4, embed=(4,), embed_latent=(4,), warm_up=1)
    training = dvae.Training(steps=4, batch_size=2, validate_every=2, log_every=1, progress=False)
    dvae.fit(method, MotionData.open(tmp_path / "people.npz"), out=tmp_path / "fitted", **vars(training))
    latent = dvae.method("motion-latent", latent=2, widths=(4,))
    cut = SegmentData.open(tmp_path / "people.npz", cut="clips", scaling="deviation", warped=True)
    dvae.fit(latent, cut, out=tmp_path / "latent", **vars(training))
    changes = st.lists(mutations(), min_size=1, max_size=2)
    examples = st.tuples(st.sampled_from(CALLS), st.sampled_from(["fitted", "latent"]), changes)
    with Isolated(check, tmp_path) as isolated:
        fuzz(isolated, examples, seconds=SHARE)
