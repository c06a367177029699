"""Ctrl-C and SIGTERM, kept until the step that they come in is done."""

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any


class Signals:
    """Remembers the first Ctrl-C or SIGTERM in `received`, for a loop to stop after its step; a second acts at once.

    Args:
        then: what else the first one does.
    """

    def __init__(self, then: Callable[[], object] = lambda: None) -> None:
        self.received: int | None = None
        self._then = then
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> "Signals":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) != signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._remember)
        return self

    def __exit__(self, *_: object) -> None:
        while self._previous:
            number, handler = self._previous.popitem()
            signal.signal(number, handler or signal.SIG_DFL)

    def _remember(self, number: int, _: FrameType | None) -> None:
        self.received = number
        self.__exit__()
        self._then()
