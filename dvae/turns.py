"""Threads take turns: Pyro's stack of handlers and torch's random state are one for the whole process.

Two programs that ran at once would land on each other's stack, and draw from each other's random numbers. So whatever
runs one for a user is decorated with `alone`: of several threads one goes on, and the others wait until it is done, a
whole fit if need be. Processes run side by side (`dvae.runs.sweep`).
"""

from __future__ import annotations

import threading
from contextlib import ContextDecorator


class _Alone(ContextDecorator):
    """A lock that a thread which holds it may take again; around a block or a function."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


alone = _Alone()
