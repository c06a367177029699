"""Common fixtures: fixed seeds, an empty parameter store, and a check that tests keep the global state."""

import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pyro
import pytest
import torch
from hypothesis import settings

import dvae.program
import dvae.runs.directory
from dvae.testing import FactorizationContract

# A background process of a shell ignores Ctrl-C, and so do its children.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Examples are the same in every run, so that failures are reproducible.
settings.register_profile("dvae", derandomize=True, deadline=None)
settings.load_profile("dvae")


# A NaN of a variant shows in its first steps; some methods take thirty on real motion.
FactorizationContract.training_steps = 5

ROOT = Path(__file__).parents[1]
REAL = Path(os.environ.get("DVAE_SHARED_DATA", ROOT.parent / "shared" / "data"))
"""Folder of the real motion capture, which is not part of the project."""


@pytest.fixture(scope="session")
def shared() -> Callable[[str], Path]:
    """Return a file of the real motion capture; skip the test if it is missing."""

    def path_of(file: str) -> Path:
        if not (REAL / file).is_file():
            pytest.skip(f"{file} of the real motion capture is not beside the project")
        return REAL / file

    return path_of


@pytest.fixture(scope="session")
def real(shared: Callable[[str], Path]) -> Callable[[str], Any]:
    """Return real motion by its file, read once."""

    @cache
    def read(file: str) -> Any:
        return dvae.motion.read_motion(shared(file))

    return read


@pytest.fixture(scope="session")
def people(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a file of simulated people with windows of every split; tests do not write to it."""
    path = tmp_path_factory.mktemp("data") / "people.npz"
    dvae.motion.save(path, dvae.motion.simulate(clips=14, frames=90, seed=1))
    return path


@pytest.fixture(scope="session")
def walkers() -> Any:
    """Return the default simulated people as motion data."""
    return dvae.motion.MotionData.open()


@pytest.fixture(scope="session")
def windows(walkers: Any) -> Any:
    """Return their training windows."""
    return walkers.windows("train")


@pytest.fixture(scope="session")
def fitted(people: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the run directory of a small model of those people after ten steps; tests do not write to it."""
    out = tmp_path_factory.mktemp("runs") / "fitted"
    training = dvae.Training(steps=10, batch_size=4, validate_every=5, progress=False)
    method = dvae.method("vae", latent=3, warm_up=4)
    dvae.fit(method, dvae.motion.MotionData.open(people), out=out, **vars(training))
    return out


@pytest.fixture
def run(fitted: Path, tmp_path: Path) -> Path:
    """Return a copy of `fitted` that a test may change; modules may define their own `fitted`."""
    return Path(shutil.copytree(fitted, tmp_path / "run"))


def global_state() -> dict[str, Any]:
    return {
        "default dtype": torch.get_default_dtype(),
        "grad mode": torch.is_grad_enabled(),
        "inference mode": torch.is_inference_mode_enabled(),
        "anomaly detection": torch.is_anomaly_enabled(),
        "deterministic algorithms": torch.are_deterministic_algorithms_enabled(),
        "threads": torch.get_num_threads(),
        "Pyro settings": pyro.settings.get(),
    }


@pytest.fixture(autouse=True)
def _seeded_and_guarded() -> Iterator[None]:
    pyro.set_rng_seed(0)  # of torch, numpy and random
    pyro.clear_param_store()
    before = global_state()
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
    changes = [
        f"{name}: {value} -> {after}"
        for (name, value), after in zip(before.items(), global_state().values())
        if value != after
    ]
    if changes:
        torch.set_default_dtype(before["default dtype"])
        torch.set_grad_enabled(before["grad mode"])
        torch.autograd.set_detect_anomaly(before["anomaly detection"])
        torch.use_deterministic_algorithms(before["deterministic algorithms"])
        torch.set_num_threads(before["threads"])
        pyro.settings.set(**before["Pyro settings"])
        pytest.fail(f"the test changed the global state: {'; '.join(changes)}")
