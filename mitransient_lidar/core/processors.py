"""Number of processors that this process may use."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path

#: Where the system shows the control groups of this process, and where it mounts them.
_GROUPS, _MOUNT = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")


def usable_processors() -> int:
    """Return the number of processors that this process may use, at least 1.

    It is the smallest of: the machine's processors, the affinity's (``taskset``, batch systems), and the control group
    quotas (containers), rounded up.
    """
    # macOS has no affinity.
    number = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min([number, *(math.ceil(quota) for quota in _quotas(_GROUPS, _MOUNT))]))


def _quotas(groups: Path, mount: Path) -> Iterator[float]:
    """Yield the numbers of processors that a process's control groups and the groups above them allow."""
    for line in _text(groups).splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers and "cpu" not in controllers.split(","):
            continue
        # First-version controllers have folders of their own.
        folders = (mount / name for name in (controllers, "cpu", "cpu,cpuacct") if controllers)
        root = next((folder for folder in folders if folder.is_dir()), mount)
        # A container sees its own group as the mount, whatever the path is.
        folder = root / path.lstrip("/")
        for group in (folder, *folder.parents[: len(folder.parts) - len(root.parts)]):
            names = ("cpu.cfs_quota_us", "cpu.cfs_period_us") if controllers else ("cpu.max",)
            with contextlib.suppress(ValueError):  # "max", or no such file
                quota, period = (float(word) for name in names for word in _text(group / name).split())
                if quota > 0:
                    yield quota / period


def _text(path: Path) -> str:
    """Return a system file's text, empty if it cannot be read."""
    try:
        return path.read_text()
    except OSError:
        return ""
