"""The one place that holds the version, and the commit beside it."""

import functools
import os
import subprocess
from pathlib import Path

__version__ = "0.3.0"


@functools.cache
def commit() -> str:
    """Return the first digits of the commit of this package, empty where it is unknown.

    A built package has them in a file. In a checkout git states them, with "-dirty" if tracked files differ.
    """
    folder = Path(__file__).parent
    if (file := folder / "commit.txt").is_file():
        return file.read_text("ascii").strip()
    if not (folder.parent / ".git").exists():
        return ""
    command = ["git", "-C", str(folder), "describe", "--always", "--abbrev=12", "--exclude=*", "--dirty"]
    # Without this, git may write to the checkout.
    environment = os.environ | {"GIT_OPTIONAL_LOCKS": "0"}
    try:
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def release() -> str:
    """Return the name of this package with its version and, where it is known, its commit."""
    return f"mitransient-lidar {__version__}" + (f" (commit {commit()})" if commit() else "")
