"""Run directories: weights, the state for resuming training, and a description of the run.

    config.json        description of the run: method, schema, data, training options
    best.safetensors   weights at the best validation score, `Training.select` (absent without validation data)
    last.safetensors   weights at the last checkpoint
    last.state.safetensors  optimiser, random number generators and the state of an objective
    state.json         step, best step and bound, status, and the SHA-256 of the three files above

`state.json` is the commit record. New files are first written completely under temporary names, then `state.json` is
replaced, then the files are renamed. If a run is killed at any time, files that match `state.json` are on the disk.

The directory may come from an untrusted source. Its files are opened as in `files`, never through a link, and are read
only up to the size that the model implies.
"""

import hashlib
import json
import math
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor, nn
from torch.nn.modules.module import (
    register_module_buffer_registration_hook,
    register_module_parameter_registration_hook,
)

from ... import files

try:
    import fcntl
except ImportError:  # no file locks on Windows
    fcntl = None  # type: ignore[assignment]

BEST, LAST, OPTIMISER = "best.safetensors", "last.safetensors", "last.state.safetensors"
STATE, CONFIG, LOCK = "state.json", "config.json", ".lock"
LARGEST_TEXT = 2**24
"""Largest size of `config.json` and `state.json`, in bytes."""
LARGEST_WEIGHTS = 2**32
"""Largest size of a model's weights, in bytes."""

OPTIMISERS = ("adam", "adamw", "sgd")
ENDED: tuple[str, ...] = ("finished", "stopped early")
STATUSES: tuple[str, ...] = ("running", *ENDED, "interrupted", "failed")

# fields of state.json, each with a test of its value and a description of valid values
_NUMBER = "a whole number of at least 0"
_STORED: dict[str, tuple[Callable[[Any], bool], str]] = {
    "step": (lambda value: _count(value), _NUMBER),
    "best_step": (lambda value: value is None or _count(value), f"{_NUMBER} or null"),
    "best_bound": (lambda v: v is None or (isinstance(v, float) and math.isfinite(v)), "a finite number or null"),
    "last_value": (
        lambda v: v is None or (isinstance(v, float) and math.isfinite(v)),
        "a finite number or null",
    ),
    "waited": (lambda value: _count(value), _NUMBER),
    "status": (lambda value: value in STATUSES, f"one of {', '.join(STATUSES)}"),
    "optimizer": (lambda value: value in OPTIMISERS, f"one of {', '.join(OPTIMISERS)}"),
    "select": (lambda value: value in (..., "bound", "forecast"), "bound or forecast"),
    "per": (lambda value: value is ... or (isinstance(value, str) and value.isidentifier()), "a word"),
    "processor_seconds": (lambda v: isinstance(v, float) and 0 <= v < math.inf, "a number of at least 0"),
}


class CheckpointError(RuntimeError):
    """A checkpoint is missing, damaged, or belongs to another model."""


class Run:
    """Run directory.

    Args:
        path: the directory; it need not exist before the first `write_config` or `commit`.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        if not isinstance(path, str | os.PathLike):
            raise TypeError(f"a run must be the path of a folder that fit wrote, got {path!r}")
        self.path = Path(path)

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})"

    @property
    def exists(self) -> bool:
        """Whether the directory contains a checkpoint."""
        return os.path.lexists(self.path / STATE)

    @property
    def config(self) -> dict[str, Any]:
        """Description of the run."""
        return self._json(CONFIG)

    @property
    def state(self) -> dict[str, Any]:
        """Step, best step and bound, status, and the fingerprints of the checkpoint's files.

        Raises:
            CheckpointError: when the file is missing or damaged, or a fingerprint is missing.
        """
        state = self._json(STATE)
        fingerprints = state.get("fingerprints")
        invalid = [
            f"{name} missing or not {valid}"
            for name, (test, valid) in _STORED.items()
            if not test(state.get(name, ...))
        ]
        if not isinstance(fingerprints, dict) or not all(isinstance(value, str) for value in fingerprints.values()):
            problem = "its fingerprints are not an object of texts"
        elif unknown := fingerprints.keys() - {BEST, LAST, OPTIMISER}:
            problem = f"it has a fingerprint of {min(unknown)[:50]!r}, which is not a file of a checkpoint"
        elif missing := {LAST, *([BEST] if state.get("best_step") is not None else [])} - fingerprints.keys():
            problem = f"it has no fingerprint of {' and '.join(sorted(missing))}"
        elif invalid:
            problem = ", ".join(invalid)
        else:
            return state
        raise CheckpointError(f"{self.path / STATE} is damaged: {problem}; copy the run directory whole, or fit again")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the directory for one process that writes to it; the lock is released when the process ends.

        Raises:
            CheckpointError: when another process has locked it.
        """
        with files.create_folder(self.path), self._open_lock() as file:
            if fcntl is not None:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError as error:
                    raise CheckpointError(
                        f"another process is fitting {self.path}; wait for it, stop it, or choose another directory"
                    ) from error
            try:
                yield
            except BaseException:
                if not self.exists:
                    (self.path / LOCK).unlink(missing_ok=True)
                raise

    def _open_lock(self) -> BinaryIO:
        with _checkpoint_errors():
            return files.open_plain(self.path / LOCK, os.O_RDWR | os.O_CREAT)

    def _write_new(self, name: str, content: bytes) -> None:
        """Write a file under its temporary name."""
        with files.with_path(self.path / name, self.path / f"{name}.new"):
            files.write(self.path / f"{name}.new", content)

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Write `config.json`.

        Raises:
            TypeError: when the config contains values that JSON cannot represent.
        """
        content = json.dumps(config, indent=2).encode()
        self.path.mkdir(parents=True, exist_ok=True)
        self._write_new(CONFIG, content)
        os.replace(self.path / f"{CONFIG}.new", self.path / CONFIG)

    def commit(self, state: Mapping[str, Any], contents: Mapping[str, bytes]) -> None:
        """Replace `state.json` and the files in `contents`; other files of earlier commits stay."""
        self.path.mkdir(parents=True, exist_ok=True)
        fingerprints = self.state["fingerprints"] if self.exists else {}
        for name in fingerprints:
            self._finish_commit(name, fingerprints[name])
        for name, content in contents.items():
            self._write_new(name, content)
        fingerprints |= {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
        self._write_new(STATE, json.dumps({**state, "fingerprints": fingerprints}, indent=2).encode())
        os.replace(self.path / f"{STATE}.new", self.path / STATE)
        for name in contents:
            os.replace(self.path / f"{name}.new", self.path / name)
        for name in {BEST, LAST, OPTIMISER} - contents.keys():  # left by a process that was killed while writing
            (self.path / f"{name}.new").unlink(missing_ok=True)

    def read(self, name: str, most: int = LARGEST_WEIGHTS) -> bytes:
        """Return a file of the checkpoint, of at most `most` bytes, after checking its fingerprint.

        Raises:
            CheckpointError: when the file is missing, not a plain file or too large, or its fingerprint differs.
        """
        expected = self.state["fingerprints"].get(name)
        if expected is None:
            raise CheckpointError(f"{self.path / STATE} does not list {name}: the run has not written it yet")
        self._finish_commit(name, expected, most)
        path = self.path / name
        if (content := _content(path, most)) is None:
            raise CheckpointError(f"{path} is missing; copy the run directory whole, or fit again")
        actual = hashlib.sha256(content).hexdigest()
        if actual != expected:
            raise CheckpointError(
                f"{path} is damaged or from another run: {STATE} expects SHA-256 {expected[:12]}…, the file "
                f"of {len(content)} bytes has {actual[:12]}…; copy the run directory whole, or fit again"
            )
        return content

    def size(self) -> int:
        """Return the size in bytes of the weights that `load_weights` reads.

        Raises:
            CheckpointError: when the file is missing.
        """
        name = BEST if BEST in self.state["fingerprints"] else LAST
        self._finish_commit(name, self.state["fingerprints"][name])
        path = self.path / name
        try:
            with _checkpoint_errors(), files.open_plain(path) as file:
                return os.fstat(file.fileno()).st_size
        except FileNotFoundError:
            raise CheckpointError(f"{path} is missing; copy the run directory whole, or fit again") from None

    def optimiser_state(self, most: int = 2 * LARGEST_WEIGHTS) -> dict[str, Tensor]:
        """Return the optimiser and random number states of the last checkpoint, on the CPU, by their paths.

        Raises:
            CheckpointError: when the file has more bytes than `most`, or is not a safetensors file.
        """
        return _tensors(self.read(OPTIMISER, most), self.path / OPTIMISER)

    def _finish_commit(self, name: str, expected: str, most: int = LARGEST_WEIGHTS) -> None:
        """Rename a committed file if the process was killed between commit and renaming."""
        new = self.path / f"{name}.new"
        content = _content(new, most)
        if content is not None and hashlib.sha256(content).hexdigest() == expected:
            os.replace(new, self.path / name)

    def _json(self, name: str) -> dict[str, Any]:
        path = self.path / name
        try:
            with _checkpoint_errors():
                content = json.loads(files.read(path, LARGEST_TEXT))
        except FileNotFoundError:
            raise CheckpointError(
                f"{self.path} is not a run directory: it has no {name}; give the folder that fit wrote (out=… in "
                "Python, --out on the command line)"
            ) from None
        except NotADirectoryError:
            raise CheckpointError(
                f"{self.path} is a file, not a run directory; pass the folder that fit wrote"
            ) from None
        except (ValueError, RecursionError) as error:
            raise CheckpointError(f"{path} is damaged, it is not JSON ({error}); fit again") from error
        if _depth(content) > 32:
            raise CheckpointError(f"{path} is damaged, it is nested deeper than any file that fit writes; fit again")
        if not isinstance(content, dict):
            raise CheckpointError(f"{path} is damaged: expected a JSON object, got {type(content).__name__}; fit again")
        return content


def weights(model: nn.Module) -> dict[str, Tensor]:
    """Return a copy of a model's parameters and buffers on the CPU, which later training does not change."""
    return {name: value.detach().cpu().clone().contiguous() for name, value in model.state_dict().items()}


def save_weights(model: nn.Module, path: str | os.PathLike[str]) -> None:
    """Write a model's weights to a safetensors file; an existing file is replaced only when the new one is complete."""
    with files.atomic_write(path) as file:
        file.write(save_tensors(weights(model)))


def load_weights(model: nn.Module, path: str | os.PathLike[str]) -> None:
    """Load weights into a model, in place; the names and shapes must match exactly.

    Args:
        model: module to load into.
        path: a run directory (its best weights, or the last without validation data) or a safetensors file; in a run
            directory, fingerprints are checked.

    Raises:
        CheckpointError: when the file is missing, damaged or of another model, or a weight is not finite.

    Example:
        >>> import tempfile
        >>> def build():
        ...     return dvae.DynamicalVAE("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2})
        >>> model, again = build(), build()
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = dvae.fit(model, torch.randn(6, 4, 2), steps=3, out=folder + "/run", progress=False)
        ...     dvae.load_weights(again, folder + "/run")
        >>> all(torch.equal(*pair) for pair in zip(model.parameters(), again.parameters()))
        True
    """
    path = Path(path)
    most = state_bytes(model)
    if path.is_dir():
        path = path / (BEST if BEST in Run(path).state["fingerprints"] else LAST)
    run = Run(path.parent)
    if run.exists and (path.name in (BEST, LAST) or path.name in run.state["fingerprints"]):
        content = run.read(path.name, most)
    elif (weights_file := _content(path, most, links=True)) is not None:
        content = weights_file
    else:
        raise CheckpointError(f"{path} does not exist; give a run directory or a safetensors file")
    model.load_state_dict(read_weights(model, content, path))


def read_weights(model: nn.Module, content: bytes, path: Path) -> dict[str, Tensor]:
    """Return the weights in the content of a safetensors file, after a check of names, shapes and types.

    Raises:
        CheckpointError: when they do not match the model, or a weight is not finite.
    """
    tensors = _tensors(content, path)
    _check_names_and_shapes(model, tensors, path)
    for name, value in model.state_dict().items():
        tensor = tensors[name]
        if tensor.dtype not in (_FLOATING if value.is_floating_point() else (value.dtype,)):
            raise CheckpointError(f"{path} is damaged: {name} is {tensor.dtype}, the model's is {value.dtype}")
        if value.is_floating_point() and not torch.isfinite(tensor).all():
            raise CheckpointError(
                f"the weights in {path} are unusable: {name} has entries that are NaN or infinite, because the run had "
                "failed; fit again, with a lower learning rate"
            )
    return tensors


def _tensors(content: bytes, path: Path) -> dict[str, Tensor]:
    try:
        return load_tensors(content)
    except (
        SafetensorError,
        ValueError,
        KeyError,
        TypeError,
        RuntimeError,
    ) as error:  # includes errors for unknown types
        raise CheckpointError(f"{path} is damaged or no safetensors file ({error}); copy or fit it again") from error


def state_bytes(model: nn.Module, copies: int = 1) -> int:
    """Return an upper limit on the size of a file with copies of a model's named weights, in any floating type."""
    state = model.state_dict()
    return copies * sum(8 * value.numel() + 1024 + 4 * len(name) for name, value in state.items()) + 2**16


@contextmanager
def at_most(size: int, subject: str) -> Iterator[None]:
    """Prevent this thread from building modules with more parameters and buffers than `size` allows.

    A number usually takes two or four bytes in a file of weights. The limit is one number per byte plus a margin,
    because tensors that are shared or rebuilt count several times.

    Args:
        size: size of the file of weights in bytes.
        subject: subject of errors, such as the path of the run.

    Raises:
        CheckpointError: when the limit is exceeded.
    """
    if size > LARGEST_WEIGHTS:
        raise CheckpointError(f"{subject} has {size} bytes of weights, but at most {LARGEST_WEIGHTS} are supported")
    remaining, thread = size + 2**24, threading.get_ident()

    def count(module: nn.Module, name: str, value: Tensor | None) -> None:
        nonlocal remaining
        if threading.get_ident() == thread and value is not None:
            remaining -= value.numel()
            if remaining < 0:
                raise CheckpointError(
                    f"{subject} describes a model that is larger than its weights of {size} bytes; either it is "
                    "damaged, or the weights are from another run"
                )

    hooks = [
        register(count)
        for register in (register_module_parameter_registration_hook, register_module_buffer_registration_hook)
    ]
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()


def _check_names_and_shapes(model: nn.Module, tensors: Mapping[str, Tensor], path: Path) -> None:
    expected = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    actual = {name: tuple(value.shape) for name, value in tensors.items()}
    if expected == actual:
        return
    problems = [f"it has no {name} of shape {expected[name]}" for name in expected.keys() - actual.keys()]
    problems += [f"it has {name} of shape {actual[name]}, unlike the model" for name in actual.keys() - expected.keys()]
    problems += [
        f"{name} has the shape {actual[name]}, but the model's has {expected[name]}"
        for name in expected.keys() & actual.keys()
        if expected[name] != actual[name]
    ]
    more = f" (and {len(problems) - 3} more)" if len(problems) > 3 else ""
    raise CheckpointError(
        f"{path} holds the weights of another model: {'; '.join(sorted(problems)[:3])}{more}; "
        "build the model with the equations, sizes and network of the run's config.json"
    )


_FLOATING = (torch.float64, torch.float32, torch.bfloat16, torch.float16)


def _count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= 10**9


def _depth(value: Any) -> int:
    """Return the nesting depth of lists and objects."""
    depth, level = 0, [value]
    while level := [each for each in level if isinstance(each, dict | list)]:
        depth += 1
        level = [inner for each in level for inner in (each.values() if isinstance(each, dict) else each)]
    return depth


def _content(path: Path, most: int, links: bool = False) -> bytes | None:
    """Return the content of a file; None if it does not exist."""
    try:
        with _checkpoint_errors():
            return files.read(path, most, links)
    except FileNotFoundError:
        return None


@contextmanager
def _checkpoint_errors() -> Iterator[None]:
    """Raise `CheckpointError` for a file that is not plain or is too large."""
    try:
        yield
    except files.FileRefused as error:
        raise CheckpointError(f"{error}; a run directory must contain plain files, as fit writes them") from error
