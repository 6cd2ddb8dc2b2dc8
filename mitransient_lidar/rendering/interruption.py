"""Deferred handling of SIGINT."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[Callable[[], None]]:
    """Defer the first Ctrl-C until the yielded function is called, which raises it; the second takes effect at once.

    An interruption during a pass would become a ``RuntimeError`` of the loop that Dr.Jit is recording. Outside the main
    thread, and with another handler of the signal, nothing changes.
    """
    pending = False

    def defer(_number: int, _frame: FrameType | None) -> None:
        nonlocal pending
        signal.signal(signal.SIGINT, signal.default_int_handler)
        pending = True

    def check() -> None:
        nonlocal pending
        if pending:
            pending = False
            raise KeyboardInterrupt

    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield check
        return
    signal.signal(signal.SIGINT, defer)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
