"""Atomic writing of files."""

from __future__ import annotations

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path

from mitransient_lidar.core.errors import UserError


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield the path of a temporary file in the folder of `path`, which replaces `path` on success.

    On any failure, an interruption included, the temporary file is removed and `path` is unchanged.

    Raises
    ------
    UserError
        If the operating system reports an error.
    """
    path = Path(path)
    temporary = path.with_name(f".{uuid.uuid4().hex}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror or error}.") from error
    finally:
        # unlink fails, too, where a parent of `path` is a regular file.
        with contextlib.suppress(OSError):
            temporary.unlink()
