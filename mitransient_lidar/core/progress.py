"""Progress of public functions, which a notebook shows by itself below the cell that calls one."""

from __future__ import annotations

import contextlib
import html
import importlib
import sys
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any

#: Shortest time between two states that are shown [s].
_INTERVAL_S = 0.2

#: Whether a public function runs: of one that calls others, the notebook shows the whole alone.
_running: ContextVar[bool] = ContextVar("running", default=False)


@contextlib.contextmanager
def progress_of(given: Callable[[Any], None] | None) -> Iterator[Callable[[Any], None] | None]:
    """Yield the function that takes the progress of a call: the given one, or one that shows it in a notebook.

    It is None outside notebooks. The states have ``done``, ``planned`` (None if unknown), and a text. IPython's display
    needs no widgets, unlike the bars of rich and tqdm; it is removed when the call ends.
    """
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    shown = given is None and hasattr(shell, "kernel") and not _running.get()
    token = _running.set(True)
    try:
        with _bar() if shown else contextlib.nullcontext(given) as show:
            yield show
    finally:
        _running.reset(token)


@contextlib.contextmanager
def _bar() -> Iterator[Callable[[Any], None]]:
    """Show the latest state as a bar with its text."""
    display: Any = importlib.import_module("IPython.display")
    handle, latest = display.display(display.HTML("preparing"), display_id=True), [0.0]

    def show(state: Any) -> None:
        if (now := time.monotonic()) - latest[0] >= _INTERVAL_S:
            latest[0] = now
            share = "" if state.planned is None else f' value="{state.done}" max="{state.planned}"'
            handle.update(display.HTML(f"<progress{share}></progress> {html.escape(str(state))}"))

    try:
        yield show
    finally:
        handle.update(display.HTML(""))
