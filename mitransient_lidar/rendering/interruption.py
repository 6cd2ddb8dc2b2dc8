"""Deferred handling of SIGINT."""

from __future__ import annotations

import signal
import threading
from types import FrameType


class DeferredInterrupt:
    """Context in which the first Ctrl-C is deferred until `check` is called; the second one takes effect at once.

    An interruption during a pass would become a ``RuntimeError`` of the loop that Dr.Jit is recording. Outside the main
    thread, and with another handler of the signal, nothing changes.
    """

    def __init__(self) -> None:
        self._pending = self._installed = False

    def __enter__(self) -> DeferredInterrupt:
        """Install the signal handler."""
        main = threading.current_thread() is threading.main_thread()
        if main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._defer)
            self._installed = True
        return self

    def __exit__(self, *_error: object) -> None:
        """Restore the signal handler."""
        if self._installed:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            self._installed = False

    def _defer(self, number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self._pending = True

    def check(self) -> None:
        """Raise KeyboardInterrupt if there was a Ctrl-C since the context was entered."""
        if self._pending:
            self._pending = False
            raise KeyboardInterrupt
