"""Deferred handling of SIGINT."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType


class DeferredInterrupt:
    """Context in which the first Ctrl-C is deferred until `check` is called; the second one takes effect at once.

    An interruption during a pass would come out of Dr.Jit as a ``RuntimeError`` of the loop being recorded. Outside the
    main thread, and where the signal is handled by someone else, nothing changes.
    """

    def __init__(self) -> None:
        self._pending = False
        self._installed = False

    def __enter__(self) -> DeferredInterrupt:
        """Install the signal handler."""
        if (
            threading.current_thread() is threading.main_thread()
            and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        ):
            signal.signal(signal.SIGINT, self._defer)
            self._installed = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
