"""Motion files: one reader per format that returns a `Recording`, and writers for formats of other programs."""

from .arrays import read_paths, save
from .reading import read_motion
from .writing import write_motion

__all__ = ["read_motion", "read_paths", "save", "write_motion"]
