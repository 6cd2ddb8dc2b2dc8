"""Handling of the signals that interrupt a render: SIGINT (Ctrl-C), and for commands SIGTERM and SIGHUP."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any

#: Signals that end a process by default, as when a batch system or a closed terminal does.
_TERMINATIONS = (signal.SIGTERM, signal.SIGHUP)


class TerminationAsInterrupt:
    """Context in which SIGTERM and SIGHUP raise KeyboardInterrupt as Ctrl-C does.

    Outside the main thread, and for signals that are ignored (``nohup``) or handled otherwise, nothing changes.
    """

    def __init__(self) -> None:
        self._number = signal.SIGINT
        self._installed: list[signal.Signals] = []
        self._terminals = [descriptor for descriptor in (1, 2) if os.isatty(descriptor)]

    @property
    def exit_code(self) -> int:
        """Exit code of the last signal, 128 plus its number: 130 for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP."""
        return 128 + self._number

    def __enter__(self) -> TerminationAsInterrupt:
        """Install the signal handlers."""
        if threading.current_thread() is threading.main_thread():
            self._installed = [number for number in _TERMINATIONS if signal.getsignal(number) is signal.SIG_DFL]
            for number in self._installed:
                signal.signal(number, self.interrupt)
        return self

    def __exit__(self, *_error: object) -> None:
        """Restore the signal handlers."""
        for number in self._installed:
            signal.signal(number, signal.SIG_DFL)

    def interrupt(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt; where the terminal is gone, its output is discarded."""
        self._number = signal.Signals(number)
        for descriptor in self._terminals:
            if not os.isatty(descriptor):
                with open(os.devnull, "wb") as nothing:
                    os.dup2(nothing.fileno(), descriptor)
        raise KeyboardInterrupt


class DeferredInterrupt:
    """Context in which the first interruption is deferred until `check` is called; the second one takes effect at once.

    An interruption during a pass would become a ``RuntimeError`` of the loop that Dr.Jit is recording. It applies to
    Ctrl-C, and to the signals of `TerminationAsInterrupt`. Outside the main thread, and with other handlers of the
    signals, nothing changes.
    """

    def __init__(self) -> None:
        self._pending = 0
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> DeferredInterrupt:
        """Install the signal handlers."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, *_TERMINATIONS):
                handler = signal.getsignal(number)
                owner = getattr(handler, "__self__", None)
                if handler is signal.default_int_handler or isinstance(owner, TerminationAsInterrupt):
                    self._handlers[number] = handler
                    signal.signal(number, self._defer)
        return self

    def __exit__(self, *_error: object) -> None:
        """Restore the signal handlers."""
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def _defer(self, number: int, frame: FrameType | None) -> None:
        self._restore()
        self._pending = number

    def check(self) -> None:
        """Raise KeyboardInterrupt if there was an interruption since the context was entered."""
        if self._pending:
            number, self._pending = self._pending, 0
            self._handlers[number](number, None)
