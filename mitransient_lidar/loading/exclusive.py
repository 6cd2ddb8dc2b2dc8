"""One thread at a time uses Mitsuba and Dr.Jit; others wait. It leaves Mitsuba's variant as it finds it.

Where a kernel adds to an array, each thread in Dr.Jit's pool has its own copy. All other threads in the process share
one copy, and they help with kernels while they wait: two that wait at once overwrite each other's sums and lose light.
The virtual function calls that one thread records also see the objects in a scene that another thread is still loading.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
import threading
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from mitransient_lidar.core.interruption import DeferredInterrupt
from mitransient_lidar.loading.variants import kept

_P = ParamSpec("_P")
_R = TypeVar("_R")

#: Time after which a thread that waits looks for an interruption [s].
_LOOK_S = 0.1


class _Turn:
    """The turn to use Mitsuba: a lock that counts how often its thread has it."""

    def __init__(self) -> None:
        self._lock, self._depth = threading.RLock(), 0

    def __enter__(self) -> bool:
        """Return whether the thread has just got the turn."""
        while not self._lock.acquire(timeout=_LOOK_S):
            DeferredInterrupt.check()
        self._depth += 1
        return self._depth == 1

    def __exit__(self, kind: type[BaseException] | None, *_error: object) -> None:
        try:
            if self._depth == 1 and kind is None and (drjit := sys.modules.get("drjit")):
                # Arrays that another thread uses later must not wait for this thread's queue.
                drjit.eval()
                drjit.sync_thread()
        finally:
            self._depth -= 1
            self._lock.release()

    def renew(self) -> None:
        """Forget other threads, which a forked process does not have."""
        self.__init__()  # type: ignore[misc]


_turn = _Turn()
os.register_at_fork(after_in_child=_turn.renew)


def alone(
    function: Callable[_P, _R], within: Callable[[], contextlib.AbstractContextManager[None]] = kept
) -> Callable[_P, _R]:
    """Return a function that runs in one thread at a time, alone among all of these functions.

    It may call others of them. The first one leaves Mitsuba's active variant as it found it (`within`). A Ctrl-C in the
    main thread ends its waiting.
    """

    @functools.wraps(function)
    def waiting(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with _turn as is_first, within() if is_first else contextlib.nullcontext():
            return function(*args, **kwargs)

    return waiting


def alone_with_scene(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function as `alone` does, that leaves the variant of the scene which it returns."""
    return alone(function, contextlib.nullcontext)
