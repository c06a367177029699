"""Motion files: a reader for each format, all to one `Recording`, and writers of those that other programs open."""

from .plain import read_motion, read_paths, save

__all__ = ["read_motion", "read_paths", "save"]
