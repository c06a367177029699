"""Run directories: weights, the state that training resumes from, and what was run.

    config.json        what was run: method, equations, data, protocol, training options
    best.safetensors   weights at the best unweighted validation bound (absent without validation data)
    last.safetensors   weights at the last checkpoint
    last.state.pt      optimiser and random number generators, read with torch's restricted unpickler
    state.json         step, best step and bound, status, and the SHA-256 of the three files above

`state.json` is the commit record. New files are first written whole under a temporary name, then `state.json`
is replaced, then they take their names; whenever a run is killed, the files that match `state.json` are on
the disk.
"""

import hashlib
import io
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

try:
    import fcntl
except ImportError:  # no locks on Windows
    fcntl = None  # type: ignore[assignment]

BEST, LAST, OPTIMISER = "best.safetensors", "last.safetensors", "last.state.pt"
STATE, CONFIG, LOCK = "state.json", "config.json", ".lock"


class CheckpointError(RuntimeError):
    """A checkpoint is missing, damaged, or belongs to another model."""


class Run:
    """A run directory.

    Args:
        path: the directory; it need not exist before the first `write_config` or `commit`.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})"

    @property
    def exists(self) -> bool:
        """Whether the directory holds a checkpoint."""
        return (self.path / STATE).exists()

    @property
    def config(self) -> dict[str, Any]:
        """What was run."""
        return self._json(CONFIG)

    @property
    def state(self) -> dict[str, Any]:
        """Step, best step and bound, status, and the fingerprints of the checkpoint's files.

        Raises:
            CheckpointError: when the file is missing, damaged, or leaves a file of the checkpoint unverified.
        """
        state = self._json(STATE)
        fingerprints = state.get("fingerprints")
        if not isinstance(fingerprints, dict) or not all(isinstance(value, str) for value in fingerprints.values()):
            problem = "its fingerprints are no object of texts"
        elif lacking := {LAST, *([BEST] if state.get("best_step") is not None else [])} - fingerprints.keys():
            problem = f"it has no fingerprint of {' and '.join(sorted(lacking))}"
        else:
            return state
        raise CheckpointError(f"{self.path / STATE} is damaged: {problem}; copy the run directory whole, or fit again")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the directory for one process, which writes to it; the lock goes with the process, however it ends.

        Raises:
            CheckpointError: when another process holds it.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        with (self.path / LOCK).open("w") as file:
            if fcntl is not None:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError as error:
                    raise CheckpointError(
                        f"{self.path} is being fitted by another process; wait for it or stop it, or choose another "
                        "directory"
                    ) from error
            yield

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Write `config.json`.

        Raises:
            TypeError: when the config is not made of JSON's types.
        """
        content = json.dumps(config, indent=2).encode()
        self.path.mkdir(parents=True, exist_ok=True)
        _write(self.path / f"{CONFIG}.new", content)
        os.replace(self.path / f"{CONFIG}.new", self.path / CONFIG)

    def commit(self, state: Mapping[str, Any], files: Mapping[str, bytes]) -> None:
        """Replace `files` and `state.json` together; files of earlier commits that are not given stay."""
        self.path.mkdir(parents=True, exist_ok=True)
        fingerprints = self.state["fingerprints"] if self.exists else {}
        for name in fingerprints:
            self._settle(name, fingerprints[name])
        for name, content in files.items():
            _write(self.path / f"{name}.new", content)
        fingerprints |= {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
        _write(self.path / f"{STATE}.new", json.dumps({**state, "fingerprints": fingerprints}, indent=2).encode())
        os.replace(self.path / f"{STATE}.new", self.path / STATE)
        for name in files:
            os.replace(self.path / f"{name}.new", self.path / name)

    def read(self, name: str) -> bytes:
        """Return a file of the checkpoint after checking its fingerprint.

        Raises:
            CheckpointError: when the file is missing or is not the one that was written.
        """
        expected = self.state["fingerprints"].get(name)
        if expected is None:
            raise CheckpointError(f"{self.path / STATE} lists no {name}; the run has not written it")
        self._settle(name, expected)
        path = self.path / name
        if not path.exists():
            raise CheckpointError(f"{path} is missing; copy the run directory whole, or fit again")
        content = path.read_bytes()
        found = hashlib.sha256(content).hexdigest()
        if found != expected:
            raise CheckpointError(
                f"{path} is damaged or from another run: {STATE} expects SHA-256 {expected[:12]}…, the file "
                f"of {len(content)} bytes has {found[:12]}…; copy the run directory whole, or fit again"
            )
        return content

    def optimiser_state(self) -> dict[str, Any]:
        """Return the optimiser and random number states of the last checkpoint, on the CPU."""
        content = self.read(OPTIMISER)
        try:
            return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        except Exception as error:  # torch raises many types for a file that it did not write
            raise CheckpointError(f"{self.path / OPTIMISER} is no optimiser state of torch: {error}") from error

    def _settle(self, name: str, expected: str) -> None:
        """Give a committed file its name, if the process was killed between the commit and the renaming."""
        new = self.path / f"{name}.new"
        if new.exists() and hashlib.sha256(new.read_bytes()).hexdigest() == expected:
            os.replace(new, self.path / name)

    def _json(self, name: str) -> dict[str, Any]:
        path = self.path / name
        try:
            content = json.loads(path.read_text())
        except FileNotFoundError:
            raise CheckpointError(
                f"{self.path} is no run directory: it has no {name}; give the folder that fit wrote (out=… in "
                "Python, --out on the command line)"
            ) from None
        except NotADirectoryError:
            raise CheckpointError(
                f"{self.path} is a file and no run directory; leave it out, or give the folder that fit wrote"
            ) from None
        except ValueError as error:
            raise CheckpointError(f"{path} is damaged, it is not JSON ({error}); fit again") from error
        if not isinstance(content, dict):
            raise CheckpointError(f"{path} is damaged, it holds no JSON object but {type(content).__name__}; fit again")
        return content


def weights(model: nn.Module) -> dict[str, Tensor]:
    """Return a copy of a model's parameters and buffers on the CPU, which later training does not change."""
    return {name: value.detach().cpu().clone().contiguous() for name, value in model.state_dict().items()}


def save_weights(model: nn.Module, path: str | os.PathLike[str]) -> None:
    """Write a model's weights to a safetensors file, which replaces an older one only when it is complete."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(f"{path.name}.new")
    _write(new, save_tensors(weights(model)))
    os.replace(new, path)


def load_weights(model: nn.Module, path: str | os.PathLike[str]) -> None:
    """Load weights into a model, in place; the names and shapes must agree exactly.

    Args:
        model: the module to fill.
        path: a run directory (its best weights, or the last without validation data) or a safetensors file;
            in a run directory, fingerprints are checked.

    Raises:
        CheckpointError: when the file is missing, damaged, or of another model.
    """
    path = Path(path)
    if path.is_dir():
        path = path / (BEST if BEST in Run(path).state["fingerprints"] else LAST)
    run = Run(path.parent)
    if run.exists and (path.name in (BEST, LAST) or path.name in run.state["fingerprints"]):
        content = run.read(path.name)
    elif path.exists():
        content = path.read_bytes()
    else:
        raise CheckpointError(f"{path} does not exist; give a run directory or a safetensors file")
    try:
        tensors = load_tensors(content)
    except SafetensorError as error:
        raise CheckpointError(
            f"{path} is damaged or no safetensors file ({error}); copy it again, or fit again"
        ) from error
    _check_names_and_shapes(model, tensors, path)
    model.load_state_dict(tensors)


def _check_names_and_shapes(model: nn.Module, tensors: Mapping[str, Tensor], path: Path) -> None:
    expected = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in tensors.items()}
    if expected == found:
        return
    problems = [f"it lacks {name} {expected[name]}" for name in expected.keys() - found.keys()]
    problems += [f"it has {name} {found[name]}, which the model lacks" for name in found.keys() - expected.keys()]
    problems += [
        f"{name} is {found[name]}, the model's is {expected[name]}"
        for name in expected.keys() & found.keys()
        if expected[name] != found[name]
    ]
    more = f" (and {len(problems) - 3} more)" if len(problems) > 3 else ""
    raise CheckpointError(
        f"{path} holds the weights of another model: {'; '.join(sorted(problems)[:3])}{more}; "
        "build the model with the equations, sizes and network of the run's config.json"
    )


def _write(path: Path, content: bytes) -> None:
    """Write and force to the disk, so that a later rename never reveals a half-written file."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
