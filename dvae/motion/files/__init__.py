"""Motion files: a reader for each format, all to one `Recording`, and writers of those that other programs open."""

from .plain import read_paths, save
from .reading import read_motion
from .writing import write_motion

__all__ = ["read_motion", "read_paths", "save", "write_motion"]
