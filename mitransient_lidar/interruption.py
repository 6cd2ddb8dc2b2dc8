"""Ctrl-C that waits for the pass under way to end."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType


class InterruptAfterPass:
    """Context in which the first Ctrl-C is kept until `check` is called, and the second one acts at once.

    An interruption in the midst of a pass would come out of Dr.Jit as a ``RuntimeError`` of the loop being recorded,
    and would leave half a pass in the film. Outside the main thread, or where someone else handles the signal, nothing
    changes.

    .. code-block:: python

        with InterruptAfterPass() as interruption:
            while True:
                render_a_pass()
                interruption.check()
    """

    def __init__(self) -> None:
        self._pending = False
        self._installed = False

    def __enter__(self) -> InterruptAfterPass:
        """Take over the signal."""
        if (
            threading.current_thread() is threading.main_thread()
            and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        ):
            signal.signal(signal.SIGINT, self._keep)
            self._installed = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give the signal back."""
        if self._installed:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            self._installed = False

    def _keep(self, number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self._pending = True

    def check(self) -> None:
        """Act on a Ctrl-C that came since the context was entered.

        Raises
        ------
        KeyboardInterrupt
            When there was one.
        """
        if self._pending:
            self._pending = False
            raise KeyboardInterrupt
