"""The command line: list and show methods, describe data, fit and resume runs, evaluate, compare and check them.

Only commands that compute import torch; `dvae --help` and errors about unknown commands do not.
"""

from .app import command, main

__all__ = ["command", "main"]
