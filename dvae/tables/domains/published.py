"""Published: what installed packages hold, and where a sequence goes that they put in no part."""

from __future__ import annotations

import hashlib
from importlib.util import find_spec
from pathlib import Path


def folder(package: str, extra: str) -> Path:
    """Where a package is installed; it is not imported, which can take seconds.

    Args:
        package: its name.
        extra: ours that installs it.

    Raises:
        ImportError: it is not installed.
    """
    found = find_spec(package)
    if found is None or not found.submodule_search_locations:
        raise ImportError(f"these data are in the package {package}: pip install 'pyro-dvae[{extra}]'", name=package)
    return Path(found.submodule_search_locations[0])


def lot(name: str) -> int:
    """A number that a name draws, below 2^256: the same everywhere, and without regard to what the name says."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest())
