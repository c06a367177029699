"""Methods of the literature, one file each: equations, networks, sizes and schedules."""

from typing import TYPE_CHECKING

if __name__ != "dvae.models":
    raise ImportError(f"import this package as dvae.models, not as {__name__}: a second path loads a second copy")

from ..lazy import importing

if not TYPE_CHECKING:
    __getattr__ = importing(__name__)
