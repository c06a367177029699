"""Handler of Ctrl-C and SIGTERM that lets the current step finish."""

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any


class Signals:
    """Context manager that stores the first Ctrl-C or SIGTERM in `received`; a second one has its usual effect.

    A loop reads `received` after each step, and stops if it is not None.

    Args:
        then: function called when the first signal arrives.
    """

    def __init__(self, then: Callable[[], object] = lambda: None) -> None:
        self.received: int | None = None
        self._then = then
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> "Signals":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) != signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        while self._previous:
            number, handler = self._previous.popitem()
            signal.signal(number, handler or signal.SIG_DFL)

    def _receive(self, number: int, _: FrameType | None) -> None:
        self.received = number
        self.__exit__()
        self._then()
