"""Serialise threads, because Pyro's handler stack and torch's random state are global to the process.

Two programs running at the same time would share one handler stack and one stream of random numbers. Building a model
and running a program therefore hold the lock `serialized`: in `DynamicalVAE.running`, in the terms of a bound, and in a
step of `SVI`. `seeded` holds it for a whole block, with another random state. Threads wait for one such step, not for a
whole fit. Processes are independent (`dvae.runs.sweep`). A fork waits for the lock too, because a child would wait
forever for locks that another thread holds, such as those of oneDNN and of `torch.manual_seed`. If it waits for more
than five seconds, the child starts with a free lock, an empty handler stack and no plates.
"""

from __future__ import annotations

import logging  # noqa: F401  register its fork hook first: it must lock after `no_fork`, since imports create loggers
import os
import re
import threading
from collections.abc import Iterator
from contextlib import ContextDecorator, contextmanager
from typing import Any

LONGEST_WAIT = 5.0
"""Seconds that a fork waits for the lock; a thread that holds it may wait for the thread that forks."""
SHAPES = re.compile(r"\n\s*Trace Shapes:.*", re.DOTALL)
"""The table that Pyro appends to an error raised inside a program."""


class _ProgramLock(ContextDecorator):
    """A reentrant lock, usable as a context manager or a decorator.

    It removes Pyro's table of shapes from the messages of errors that are raised while it is held.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._lock.release()
        if error is not None and error.args and isinstance(error.args[0], str):
            error.args = (SHAPES.sub("", error.args[0]), *error.args[1:])

    def _before_fork(self) -> None:
        self._is_held_by_fork = self._lock.acquire(timeout=LONGEST_WAIT)

    def _after_fork(self) -> None:
        if self._is_held_by_fork:
            self._lock.release()

    def _after_fork_in_child(self) -> None:
        """Release the lock, or replace one held by a thread of the parent process, which does not exist here."""
        if self._is_held_by_fork:
            self._lock.release()
            return
        from pyro.poutine.runtime import _DIM_ALLOCATOR, _PYRO_STACK

        self._lock = threading.RLock()
        _PYRO_STACK.clear()
        _DIM_ALLOCATOR._stack.clear()  # dimensions of the plates of that thread


serialized = _ProgramLock()


@contextmanager
def seeded(seed: int | None, device: Any = None) -> Iterator[None]:
    """Set torch's random seed for a block, or keep the current state if it is None; restore the state at the end.

    Args:
        seed: seed of torch's random numbers.
        device: a `torch.device` whose random state is also restored if it is a GPU.
    """
    import torch

    with serialized, torch.random.fork_rng([device] if device is not None and device.type == "cuda" else []):
        if seed is not None:
            torch.manual_seed(seed)
        yield


no_fork = threading.RLock()
"""A lock held during imports: a child forked during an import would wait forever for the lock of the module."""
if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(before=no_fork.acquire, after_in_parent=no_fork.release, after_in_child=no_fork.release)
    os.register_at_fork(
        before=serialized._before_fork,  # runs before the one registered above, in the order of `SVI.init`
        after_in_parent=serialized._after_fork,
        after_in_child=serialized._after_fork_in_child,
    )
