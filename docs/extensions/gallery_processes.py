"""Processes that scripts of the gallery start while joblib runs them."""

from __future__ import annotations

import multiprocessing
from typing import Any


def start_as_usual(gallery_conf: dict[str, Any], script: str) -> None:
    """Set the start method of child processes, which is joblib's own in its workers and unknown to their children."""
    if multiprocessing.get_start_method() == "loky":
        multiprocessing.set_start_method("spawn", force=True)
