"""Threads take turns: Pyro's stack of handlers and torch's random state are one for the whole process.

Two programs that ran at once would land on each other's stack, and draw from each other's random numbers. So `alone`
is held while a model is built or a program runs: in `DynamicalVAE.running`, in the terms of a bound, in a step of
`SVI`, and in `seeded`, which also sets and restores the random state. Threads wait for each other that
long, not for a whole fit. Processes run side by side (`dvae.runs.sweep`). When a process forks while another thread
holds the lock, the child starts with a free lock and without that thread's handlers.
"""

from __future__ import annotations

import logging  # noqa: F401  its fork hook, registered first, takes its lock after `no_fork`: imports make loggers
import os
import re
import threading
from collections.abc import Iterator
from contextlib import ContextDecorator, contextmanager
from typing import Any

SHAPES = re.compile(r"\n\s*Trace Shapes:.*", re.DOTALL)
"""The table that Pyro appends to an error that passes a program."""


class _Alone(ContextDecorator):
    """A lock that a thread which holds it may take again; around a block or a function."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._lock.release()
        if error is not None and error.args and isinstance(error.args[0], str):
            error.args = (SHAPES.sub("", error.args[0]), *error.args[1:])

    def _leave_to_the_parent(self) -> None:
        """Forget the thread that held the lock, which a forked child does not have."""
        if self._lock.acquire(blocking=False):
            self._lock.release()
            return
        from pyro.poutine.runtime import _PYRO_STACK

        self._lock = threading.RLock()
        _PYRO_STACK.clear()


alone = _Alone()


@contextmanager
def seeded(seed: int | None, device: Any = None) -> Iterator[None]:
    """Draw from a seed, or without one go on from the present state; restore torch's random state at the end.

    Args:
        seed: of torch's random numbers.
        device: a `torch.device` whose random state is restored too, if it is a GPU.
    """
    import torch

    with alone, torch.random.fork_rng([device] if device is not None and device.type == "cuda" else []):
        if seed is not None:
            torch.manual_seed(seed)
        yield


no_fork = threading.RLock()
"""A lock held during imports: a child that is forked during one would wait for the lock of the module for ever."""
if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(before=no_fork.acquire, after_in_parent=no_fork.release, after_in_child=no_fork.release)
    os.register_at_fork(after_in_child=alone._leave_to_the_parent)
