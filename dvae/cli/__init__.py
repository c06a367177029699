"""The command line: list and show methods, fit and resume runs, evaluate, compare and criticise them, look into data.

Torch is imported by the commands that compute: not for `dvae --help`, nor to refuse what is no command.
"""

from .app import command, main

__all__ = ["command", "main"]
