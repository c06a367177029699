"""What every test starts from: the same seeds, an empty parameter store; and what it must leave as it was."""

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

# A shell has what it starts in the background ignore Ctrl-C, and so would all that is started from there.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Examples are the same in every run, so that a failure is one for everybody.
settings.register_profile("dvae", derandomize=True, deadline=None)
settings.load_profile("dvae")


# A NaN of a variant shows in its first steps; some methods take thirty on real motion.
FactorizationContract.training_steps = 5

ROOT = Path(__file__).parents[1]
REAL = Path(os.environ.get("DVAE_SHARED_DATA", ROOT.parent / "shared" / "data"))
"""Where the real motion capture is, which is not part of the project."""


@pytest.fixture(scope="session")
def shared() -> Callable[[str], Path]:
    """A file of the real motion capture; a test that asks for one is skipped where it is absent."""

    def found(file: str) -> Path:
        if not (REAL / file).is_file():
            pytest.skip(f"{file} of the real motion capture is not beside the project")
        return REAL / file

    return found


@pytest.fixture(scope="session")
def real(shared: Callable[[str], Path]) -> Callable[[str], Any]:
    """Real motion by its file, read once."""

    @cache
    def read(file: str) -> Any:
        return dvae.motion.read_motion(shared(file))

    return read


@pytest.fixture(scope="session")
def people(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of simulated people, enough for windows of every split; nobody writes to it."""
    path = tmp_path_factory.mktemp("data") / "people.npz"
    dvae.motion.save(path, dvae.motion.simulate(clips=14, frames=90, seed=1))
    return path


@pytest.fixture(scope="session")
def walkers() -> Any:
    """The simulated people of the default, as motion data."""
    return dvae.motion.MotionData.open()


@pytest.fixture(scope="session")
def windows(walkers: Any) -> Any:
    """Their training windows."""
    return walkers.windows("train")


@pytest.fixture(scope="session")
def fitted(people: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run directory of a small model of those people, after ten steps; nobody writes to it."""
    out = tmp_path_factory.mktemp("runs") / "fitted"
    training = dvae.Training(steps=10, batch_size=4, validate_every=5, progress=False)
    method = dvae.method("vae", latent=3, warm_up=4)
    dvae.fit(method, dvae.motion.MotionData.open(people), out=out, **vars(training))
    return out


@pytest.fixture
def run(fitted: Path, tmp_path: Path) -> Path:
    """A copy of it, or of what a module calls `fitted`, to be used up."""
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
    changed = [
        f"{name}: {value} -> {now}"
        for (name, value), now in zip(before.items(), global_state().values())
        if value != now
    ]
    if changed:
        torch.set_default_dtype(before["default dtype"])
        torch.set_grad_enabled(before["grad mode"])
        torch.autograd.set_detect_anomaly(before["anomaly detection"])
        torch.use_deterministic_algorithms(before["deterministic algorithms"])
        torch.set_num_threads(before["threads"])
        pyro.settings.set(**before["Pyro settings"])
        pytest.fail(f"the test changed the global state: {'; '.join(changed)}")
