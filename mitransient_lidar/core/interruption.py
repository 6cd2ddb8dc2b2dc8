"""Handling of the interrupting signals: SIGINT (Ctrl-C), and for commands SIGTERM and SIGHUP."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any, ClassVar

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
    """Context in which an interruption waits for `check` or the context's end; a second one takes effect at once.

    An interruption during a pass would become a ``RuntimeError`` in the loop that Dr.Jit is recording. An interruption
    while files are written would lose a render. The context applies to Ctrl-C, and to the signals of
    `TerminationAsInterrupt`. The outermost of nested contexts defers. Outside the main thread, and with other handlers
    for the signals, nothing changes. Without `at_once` it defers from the first context inside this one on.
    """

    #: Contexts that are entered, from the outermost one on, the handlers that they replace, and the signal that waits.
    _entered: ClassVar[list[DeferredInterrupt]] = []
    _handlers: ClassVar[dict[int, Any]] = {}
    _pending: ClassVar[int] = 0

    def __init__(self, at_once: bool = True) -> None:
        self._at_once = at_once

    def __enter__(self) -> DeferredInterrupt:
        """Install the signal handlers, unless an outer context has done so."""
        if threading.current_thread() is threading.main_thread():
            self._entered.append(self)
            if self._at_once and not self._handlers:
                self._install()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_error: object) -> None:
        """Restore the signal handlers with the outermost context; raise KeyboardInterrupt if an interruption waits."""
        if self not in self._entered:
            return
        self._entered.remove(self)
        if not self._entered:
            self._restore()
            number, DeferredInterrupt._pending = self._pending, 0
            handlers = dict(self._handlers)
            self._handlers.clear()
            if number and kind is None:
                handlers[number](number, None)

    @classmethod
    def check(cls) -> None:
        """Raise KeyboardInterrupt if there was an interruption since the outermost context was entered.

        Outside the main thread, which handles signals, do nothing.
        """
        if cls._pending and threading.current_thread() is threading.main_thread():
            number, cls._pending = cls._pending, 0
            handler = cls._handlers[number]
            # The next one waits, too: the code that this one ends has results to keep.
            cls._install()
            handler(number, None)

    @classmethod
    def _install(cls) -> None:
        for number in (signal.SIGINT, *_TERMINATIONS):
            handler = signal.getsignal(number)
            owner = getattr(handler, "__self__", None)
            if handler is signal.default_int_handler or isinstance(owner, TerminationAsInterrupt):
                cls._handlers[number] = handler
                signal.signal(number, cls._defer)

    @classmethod
    def _restore(cls) -> None:
        for number, handler in cls._handlers.items():
            signal.signal(number, handler)

    @classmethod
    def _defer(cls, number: int, frame: FrameType | None) -> None:
        cls._restore()
        cls._pending = number
