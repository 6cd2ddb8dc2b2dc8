"""Atomic writing of files, one alone or several together."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import platform
import re
import shutil
import uuid
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

from mitransient_lidar.core.errors import UserError

#: Beginning of the names of temporary files; host, process and a unique number follow, which tell leftovers of
#: processes that were killed from files of running ones.
_PREFIX = ".mitransient-lidar."
_TEMPORARY = re.compile(re.escape(_PREFIX) + r"(?P<host>.+)\.(?P<process>\d+)\.[0-9a-f]{32}(?P<suffix>\..*)?")

#: Suffix of the list of files that are being moved together.
_MOVES = ".moves"

#: Temporary files and their destinations, within the context `together`.
_moves: ContextVar[list[tuple[Path, Path]] | None] = ContextVar("moves", default=None)


def check_encodable(path: Path) -> None:
    """Raise `UserError` if the name of a file is not text that can be encoded in UTF-8, or contains NUL."""
    text = str(path)
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise UserError(f"cannot write {text!a}: its name is not valid UTF-8.") from error
    if "\0" in text:
        raise UserError(f"cannot write {text!a}: its name contains the character NUL.")


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield the path of a temporary file in the folder of `path`, which replaces `path` on success.

    Within `together`, it replaces `path` at the end of that context. On any failure, an interruption included, the
    temporary file is removed and `path` is unchanged. Leftovers of killed processes in the folder are removed first.

    Raises
    ------
    UserError
        If the name cannot be encoded, or the operating system reports an error.
    """
    path, moves = Path(path), _moves.get()
    check_encodable(path)
    _sweep(path.parent)
    temporary = _temporary(path)
    try:
        yield temporary
        if moves is None:
            os.replace(temporary, path)
        else:
            moves.append((temporary, path))
    except (OSError, RuntimeError) as error:
        # HDF5 and OpenEXR report a full disk by their own errors, with the operating system's message in them.
        if os.strerror(errno.ENOSPC) in str(error):
            raise UserError(f"cannot write {path}: {os.strerror(errno.ENOSPC)}.") from error
        if isinstance(error, RuntimeError):
            raise
        raise UserError(f"cannot write {path}: {_reason(error, temporary, path)}.") from error
    finally:
        if moves is None or (temporary, path) not in moves:
            _remove(temporary)


@contextlib.contextmanager
def together() -> Iterator[list[Path]]:
    """Move all files that `replacing` writes in this context to their places at its end; on a failure, none of them.

    Yields a list that holds their paths, in order, after the context; a context within another one joins it, and its
    list stays empty. On any failure the former files stay. If the process is killed while the files are moved, the next
    `replacing` in their folder moves the rest.

    Raises
    ------
    UserError
        If the operating system reports an error.
    """
    written: list[Path] = []
    if _moves.get() is not None:
        yield written
        return
    moves: list[tuple[Path, Path]] = []
    outer = _moves.set(moves)
    try:
        yield written
        if moves:
            _move(moves)
        written += [path for _, path in moves]
    finally:
        _moves.reset(outer)
        for temporary, _ in moves:
            _remove(temporary)


def _move(moves: list[tuple[Path, Path]]) -> None:
    """Replace files by their temporary ones; on a failure, restore those that were replaced."""
    journal = _temporary(moves[0][1].with_suffix(_MOVES))
    moved: list[tuple[Path, Path | None]] = []
    path = moves[0][1]
    try:
        names = [[os.path.relpath(part, journal.parent) for part in pair] for pair in moves]
        journal.write_text(json.dumps(names), encoding="utf-8")
        for temporary, path in moves:
            former = _kept(path)
            moved.append((path, former))
            os.replace(temporary, path)
    except BaseException as error:
        # From here on, the next run must not move the rest.
        _remove(journal)
        for changed, former in reversed(moved):
            if former is not None:
                os.replace(former, changed)
            else:
                _remove(changed)
        if isinstance(error, OSError):
            raise UserError(f"cannot write {path}: {_reason(error, path, path)}.") from error
        raise
    finally:
        _remove(journal)
        for _, former in moved:
            if former is not None:
                _remove(former)


def _kept(path: Path) -> Path | None:
    """Return another name of the contents of a file, None if there is no such file."""
    if not path.exists():
        return None
    kept = _temporary(path)
    try:
        os.link(path, kept)
    except OSError:  # file systems without hard links
        shutil.copy2(path, kept)
    return kept


def _sweep(folder: Path) -> None:
    """Finish the moves of killed processes of this machine in a folder, and remove their temporary files."""
    try:
        names = [name for name in os.listdir(folder) if name.startswith(_PREFIX)]
    except OSError:
        return
    # Moves first: they need the temporary files.
    for name in sorted(names, key=lambda name: not name.endswith(_MOVES)):
        match = _TEMPORARY.fullmatch(name)
        if match is None or match["host"] != host_name() or _is_running(int(match["process"])):
            continue
        if match["suffix"] == _MOVES:
            # A list that was not written in full precedes all moves.
            with contextlib.suppress(OSError, ValueError):
                for temporary, path in json.loads((folder / name).read_text(encoding="utf-8")):
                    if (folder / temporary).exists():
                        os.replace(folder / temporary, folder / path)
        _remove(folder / name)


def _temporary(path: Path) -> Path:
    """Return the name of a temporary file beside a file, of the same type."""
    return path.with_name(f"{_PREFIX}{host_name()}.{os.getpid()}.{uuid.uuid4().hex}{path.suffix}")


def host_name() -> str:
    """Return the name of this machine, which names of temporary files hold."""
    return platform.node() or "localhost"


def _is_running(process: int) -> bool:
    """Return whether a process of this machine exists."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def _remove(path: Path) -> None:
    # unlink fails, too, where a parent of the path is a regular file.
    with contextlib.suppress(OSError):
        path.unlink()


def _reason(error: OSError, temporary: Path, path: Path) -> str:
    """Return the reason of an error in one line, with the name of the file instead of the temporary one."""
    # HDF5 gives a number and a long text with the state of its file.
    text = os.strerror(error.errno) if error.errno else str(error).replace(str(temporary), str(path)).rstrip(".")
    return text.partition("\n")[0]
