"""Lazy imports: modules that are imported at first use (PEP 562), and modules of optional packages."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from .locking import no_fork


def importing(package: str, places: Mapping[str, str] | None = None) -> Callable[[str], Any]:
    """Return a `__getattr__` for a package that imports its modules and public names at first use.

    Args:
        package: full name of the package, its `__name__`.
        places: {public name: module that defines it, relative to the package}.

    Returns:
        Function from a name to the imported module or object; it raises an AttributeError for an unknown name.
    """

    def find(name: str) -> Any:
        with no_fork:
            if places and name in places:
                value = getattr(import_module(f"{package}.{places[name]}"), name)
            elif name.startswith("_") or find_spec(f"{package}.{name}") is None:
                raise AttributeError(f"module {package!r} has no attribute {name!r}")
            else:
                value = import_module(f"{package}.{name}")
        setattr(sys.modules[package], name, value)
        return value

    return find


def optional(module: str, extra: str) -> Any:
    """Import a module of an optional package.

    Args:
        module: full name of the module.
        extra: extra of pyro-dvae that installs the package, such as "motion".

    Raises:
        ImportError: the package is not installed; the message contains the install command.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        package = module.partition(".")[0]
        if error.name is None or error.name.partition(".")[0] != package:
            raise
        raise ImportError(f"{package} is not installed: pip install 'pyro-dvae[{extra}]'", name=package) from error
