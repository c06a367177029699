"""Data in installed packages, and a reproducible split for sequences without one."""

from __future__ import annotations

import hashlib
from importlib.util import find_spec
from pathlib import Path


def package_folder(package: str, extra: str) -> Path:
    """Return the folder of an installed package, without importing it, which can take seconds.

    Args:
        package: name of the package.
        extra: extra of this library that installs it.

    Raises:
        ImportError: if the package is not installed.
    """
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ImportError(f"these data are in the package {package}: pip install 'pyro-dvae[{extra}]'", name=package)
    return Path(spec.submodule_search_locations[0])


def name_hash(name: str) -> int:
    """Return a pseudo-random number below 2^256 from a name, identical on every machine."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest())
