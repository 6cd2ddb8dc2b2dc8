"""Atomic writing of files, one alone or several together."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import platform
import re
import shutil
import time
import uuid
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

from mitransient_lidar.core.errors import UserError, WriteError
from mitransient_lidar.core.interruption import DeferredInterrupt

#: Beginning of the names of temporary files and folders; host, process space, process and a unique number follow, which
#: tell leftovers of processes that were killed from files of running ones.
_PREFIX = ".mitransient-lidar."
_TEMPORARY = re.compile(
    re.escape(_PREFIX) + r"(?P<host>.+)\.(?P<space>[0-9a-f]{12})\.(?P<process>\d+)\.[0-9a-f]{32}(?P<suffix>\..*)?"
)

#: Time after which a temporary file of another process space that nobody has changed is a leftover [s]. None is open as
#: long as that; without it, those of a machine that has lost its power would stay for ever.
_FORGOTTEN_S = 7 * 24 * 3600.0

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


def read_text(path: str | os.PathLike[str], most_bytes: int = 2**24) -> str:
    """Return the text of a file in UTF-8, without a byte order mark.

    Raises
    ------
    UserError
        If the file cannot be read, is not such a text, or is larger than `most_bytes`.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(most_bytes + 1)
        if len(data) <= most_bytes:
            return data.decode("utf-8-sig")
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not a text file in UTF-8.") from error
    raise UserError(f"{path} is larger than {most_bytes / 2**20:g} MiB, the most for a file of this kind.")


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield the path of a temporary file in the folder of `path`, which replaces `path` on success.

    Within `together`, it replaces `path` at the end of that context. On any failure the temporary file is removed and
    `path` is unchanged. An interruption waits until the file is in its place; a second one counts as a failure.
    Leftovers of killed processes in the folder are removed first.

    Raises
    ------
    UserError
        If the name cannot be encoded.
    WriteError
        If the operating system reports an error.
    """
    path, moves = Path(path), _moves.get()
    check_encodable(path)
    sweep(path.parent)
    temporary = temporary_beside(path)
    with DeferredInterrupt():
        try:
            yield temporary
            if moves is None:
                os.replace(temporary, path)
            else:
                moves.append((temporary, path))
        except (OSError, RuntimeError) as error:
            # HDF5 and OpenEXR report a full disk by their own errors, with the operating system's message in them.
            if os.strerror(errno.ENOSPC) in str(error):
                raise WriteError(f"cannot write {path}: {os.strerror(errno.ENOSPC)}.") from error
            if isinstance(error, RuntimeError):
                raise
            raise WriteError(f"cannot write {path}: {_reason(error, temporary, path)}.") from error
        finally:
            if moves is None or (temporary, path) not in moves:
                _remove(temporary)


@contextlib.contextmanager
def together() -> Iterator[list[Path]]:
    """Move all files that `replacing` writes in this context to their places at its end; on a failure, none of them.

    Yields a list that holds their paths, in order, after the context; a context within another one joins it, and its
    list stays empty. On any failure the former files stay; only a process that is killed during the moves, which take
    less than a millisecond, leaves some of them. An interruption waits until all files are in their places.

    Raises
    ------
    WriteError
        If the operating system reports an error.
    """
    written: list[Path] = []
    if _moves.get() is not None:
        yield written
        return
    moves: list[tuple[Path, Path]] = []
    outer = _moves.set(moves)
    with DeferredInterrupt():
        try:
            yield written
            _move(moves)
            written += [path for _, path in moves]
        finally:
            _moves.reset(outer)
            for temporary, _ in moves:
                _remove(temporary)


def _move(moves: list[tuple[Path, Path]]) -> None:
    """Replace files by their temporary ones; on a failure, restore those that were replaced."""
    moved: list[tuple[Path, Path | None]] = []
    path = Path()
    try:
        for temporary, path in moves:
            former = _kept(path)
            moved.append((path, former))
            os.replace(temporary, path)
    except BaseException as error:
        for changed, former in reversed(moved):
            if former is not None:
                os.replace(former, changed)
            else:
                _remove(changed)
        if isinstance(error, OSError):
            raise WriteError(f"cannot write {path}: {_reason(error, path, path)}.") from error
        raise
    finally:
        for _, former in moved:
            if former is not None:
                _remove(former)


def _kept(path: Path) -> Path | None:
    """Return another name of the contents of a file, None if there is no such file."""
    if not path.exists():
        return None
    kept = temporary_beside(path)
    try:
        os.link(path, kept)
    except OSError:  # file systems without hard links
        shutil.copy2(path, kept)
    return kept


def sweep(folder: Path) -> None:
    """Remove what killed processes of this user and machine have left in a folder: temporary files and folders.

    Process numbers have a meaning only in their process space: files of others stay until nobody has changed them for a
    week.
    """
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            match = _TEMPORARY.fullmatch(entry.name)
            if match is None or match["host"] != _host_name():
                continue
            with contextlib.suppress(OSError):
                found = entry.stat(follow_symlinks=False)
                if match["space"] == _process_space():
                    is_left = not _is_running(int(match["process"]))
                else:
                    is_left = time.time() - found.st_ctime > _FORGOTTEN_S
                if is_left and found.st_uid == os.getuid():
                    _remove(Path(entry.path))


def temporary_beside(path: Path) -> Path:
    """Return the name of a temporary file or folder beside a path, of the same type."""
    return path.with_name(f"{temporary_prefix()}{uuid.uuid4().hex}{path.suffix}")


def temporary_prefix() -> str:
    """Return the beginning of the names of the temporary files of this process."""
    return f"{_PREFIX}{_host_name()}.{_process_space()}.{os.getpid()}."


def _host_name() -> str:
    return platform.node() or "localhost"


def _process_space() -> str:
    """Return 12 hexadecimal digits of where process numbers have a meaning: a container, since its machine was booted.

    Containers may have the same host name. Where the system has neither, as macOS, the digits are always the same.
    """
    found = []
    with contextlib.suppress(OSError):
        found.append(Path("/proc/sys/kernel/random/boot_id").read_text())
    with contextlib.suppress(OSError):
        found.append(str(os.stat("/proc/self/ns/pid").st_ino))
    return hashlib.sha256(" ".join(found).encode()).hexdigest()[:12]


def _is_running(process: int) -> bool:
    """Return whether a process of this process space exists."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
        return
    # unlink fails, too, where a parent of the path is a regular file.
    with contextlib.suppress(OSError):
        path.unlink()


def _reason(error: OSError, temporary: Path, path: Path) -> str:
    """Return the reason of an error in one line, with the name of the file instead of the temporary one."""
    # HDF5 gives a number and a long text with the state of its file.
    text = os.strerror(error.errno) if error.errno else str(error).replace(str(temporary), str(path)).rstrip(".")
    return text.partition("\n")[0]
