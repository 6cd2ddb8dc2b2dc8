"""Opening of files named by others, and atomic writing of one file or several together."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import platform
import re
import shutil
import stat
import time
import uuid
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from io import BufferedReader
from pathlib import Path
from typing import TextIO

from mitransient_lidar.core.errors import UserError, WriteError, printable
from mitransient_lidar.core.interruption import DeferredInterrupt
from mitransient_lidar.core.validation import shown

#: Beginning of the names of temporary files and folders. Host, process space, process and a unique number follow; they
#: distinguish leftovers of killed processes from the files of running ones.
_PREFIX = ".mitransient-lidar."
_TEMPORARY = re.compile(
    re.escape(_PREFIX) + r"(?P<host>.+)\.(?P<space>[0-9a-f]{12})\.(?P<process>\d{1,9})\.[0-9a-f]{32}(?P<suffix>\..*)?"
)

#: Time after which a temporary file from another process space that nobody has changed is a leftover [s]. None is open
#: as long as that; without it, files from a machine that has lost its power would stay for ever.
_FORGOTTEN_S = 7 * 24 * 3600.0

#: Paths that are not read, besides folders: their end may never come.
_OTHERS = {stat.S_IFIFO: "a named pipe", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device", stat.S_IFSOCK: "a socket"}

_LONGEST_NAME = 200  #: Longest name of a file [bytes], which leaves room for endings.

#: Temporary files and their destinations, within the context `together`.
_moves: ContextVar[list[tuple[Path, Path]] | None] = ContextVar("moves", default=None)

Moves = list[tuple[Path, Path]]

#: Called with complete temporary files and their destinations, before they are moved; returns the destinations to use.
before_moving: ContextVar[Callable[[Moves], Moves] | None] = ContextVar("before_moving", default=None)


def check_encodable(path: Path) -> None:
    """Raise `UserError` if the name of a file is not text that can be encoded in UTF-8, or has control characters."""
    text = str(path)
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise UserError(f"cannot write {text!a}: its name is not valid UTF-8") from error
    if "\0" in text:
        raise UserError(f"cannot write {text!a}: its name contains the character NUL")
    if printable(text) != text:
        raise UserError(f"cannot write {text!a}: its name must have no control characters, such as a line break")


def is_file_name(name: object) -> bool:
    """Return whether a text may be the name of a file: no folder, printable, and 1 to 200 bytes long."""
    plain = isinstance(name, str) and printable(name) == name and not any(one in name for one in "/\\")
    return plain and name not in ("", ".", "..") and len(str(name).encode()) <= _LONGEST_NAME


def open_file(path: str | os.PathLike[str]) -> BufferedReader:
    """Open a regular file for reading; a link to one, too.

    Every reader of a file that a user or another file names opens it here. Libraries that take a path get a path that
    `check_regular` has checked. A named pipe or a device would wait for ever, or never end. Raises `UserError` if there
    is no such file, or it cannot be opened, or is a folder, a named pipe, a device or a socket.
    """
    # Before it is opened, which may act on a device; and again, since another file may have come in its place.
    check_regular(path)
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    try:
        _check_mode(path, os.fstat(descriptor).st_mode)
        os.set_blocking(descriptor, True)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def check_regular(path: str | os.PathLike[str]) -> None:
    """Raise `UserError` if a path is no regular file, and no link to one."""
    try:
        mode = os.stat(path).st_mode
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise UserError(f"cannot read {os.fspath(path)!a}: its name contains the character NUL") from error
    _check_mode(path, mode)


def checked_path(name: str, path: object) -> Path:
    """Return a path; raise `UserError` if it is no text or path, or empty."""
    if not isinstance(path, (str, os.PathLike)) or not str(path):
        raise UserError(f"{name} = {shown(path)} must be the path of a file or folder")
    return Path(path)


def is_there(path: Path) -> bool:
    """Return whether a path is anything but a folder, which may not be a regular file."""
    try:
        return path.exists() and not path.is_dir()
    except (OSError, ValueError):  # the text is too long for a name, or contains NUL
        return False


def check_tree(folder: str | os.PathLike[str]) -> None:
    """Raise `UserError` if a folder holds anything but folders and regular files: a link would lead out of it."""
    folders = [os.fspath(folder)]
    while folders:
        try:
            with os.scandir(folders.pop()) as found:
                entries = list(found)
        except OSError as error:
            raise UserError(f"cannot read {error.filename}: {error.strerror}") from error
        for entry in entries:
            if entry.is_symlink():
                raise UserError(f"cannot read {folder}: {entry.path} is a link, and no link in it is followed")
            if entry.is_dir():
                folders.append(entry.path)
            elif not entry.is_file():
                _check_mode(entry.path, entry.stat().st_mode)


def open_log(path: Path) -> TextIO:
    """Open a file to add lines to it; raise UserError, or OSError for a link, if it is no regular file."""
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
    file = os.fdopen(os.open(path, flags, 0o666), "w", encoding="utf-8")
    try:
        _check_mode(path, os.fstat(file.fileno()).st_mode)
    except UserError:
        file.close()
        raise
    return file


def _check_mode(path: str | os.PathLike[str], mode: int) -> None:
    """Raise `UserError` for the mode of something that is not a regular file."""
    kind = stat.S_IFMT(mode)
    if kind == stat.S_IFDIR:
        raise UserError(f"cannot read {path}: {os.strerror(errno.EISDIR)}")
    if kind in _OTHERS:
        raise UserError(f"cannot read {path}: it is {_OTHERS[kind]}, and only regular files are read")


def read_text(path: str | os.PathLike[str], most_bytes: int = 2**24) -> str:
    """Return the text of a file in UTF-8, without a byte order mark.

    Raises `UserError` if the file cannot be read, is not such a text, or is larger than `most_bytes`.
    """
    try:
        with open_file(path) as file:
            data = file.read(most_bytes + 1)
        if len(data) <= most_bytes:
            return data.decode("utf-8-sig")
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not a text file in UTF-8") from error
    raise UserError(f"{path} is larger than {most_bytes / 2**20:g} MiB, the most for a file of this kind")


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield the path of a temporary file in the folder of `path`, which replaces `path` on success.

    Within `together`, it replaces `path` at the end of that context. On any failure the temporary file is removed and
    `path` is unchanged. An interruption waits until the file is in its place; a second one counts as a failure.
    Leftovers of killed processes in the folder are removed first. Raises `UserError` if the name cannot be encoded.
    Raises `WriteError` if the operating system reports an error.
    """
    path, moves = Path(path), _moves.get()
    check_encodable(path)
    sweep(path.parent)
    temporary = temporary_beside(path)
    with DeferredInterrupt():
        try:
            yield temporary
            if moves is None:
                os.replace(temporary, _destinations([(temporary, path)])[0][1])
            else:
                moves.append((temporary, path))
        except (OSError, RuntimeError) as error:
            # HDF5 and OpenEXR report a full disk by their own errors, with the operating system's message in them.
            if os.strerror(errno.ENOSPC) in str(error):
                raise WriteError(f"cannot write {path}: {os.strerror(errno.ENOSPC)}") from error
            if isinstance(error, RuntimeError):
                raise
            raise WriteError(f"cannot write {path}: {_reason(error, temporary, path)}") from error
        finally:
            if moves is None or (temporary, path) not in moves:
                _remove(temporary)


@contextlib.contextmanager
def together() -> Iterator[list[Path]]:
    """Move all files that `replacing` writes in this context to their places at its end; on a failure, none of them.

    Yields a list that contains their paths, in order, after the context. A context within another one joins it, and its
    list stays empty. On any failure the former files stay. Only a process that is killed during the moves, which take
    less than a millisecond, leaves some of them. An interruption waits until all files are in their places. Raises
    `WriteError` if the operating system reports an error.
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
            settled = _destinations(moves)
            _move(settled)
            written += [path for _, path in settled]
        finally:
            _moves.reset(outer)
            for temporary, _ in moves:
                _remove(temporary)


def _destinations(moves: Moves) -> Moves:
    """Return temporary files and their destinations as `before_moving` changes them."""
    settle = before_moving.get()
    return moves if settle is None else settle(moves)


def _move(moves: Moves) -> None:
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
            raise WriteError(f"cannot write {path}: {_reason(error, path, path)}") from error
        raise
    finally:
        for _, former in moved:
            if former is not None:
                _remove(former)


def _kept(path: Path) -> Path | None:
    """Return another name for a file's contents, None if there is no such file."""
    if not path.exists():
        return None
    kept = temporary_beside(path)
    try:
        os.link(path, kept)
    except OSError:  # file systems without hard links
        shutil.copy2(path, kept)
    return kept


def sweep(folder: Path) -> None:
    """Remove the leftovers of this user's killed processes in a folder: temporary files and folders.

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
                    import psutil

                    is_left = not psutil.pid_exists(int(match["process"]))
                else:
                    is_left = time.time() - found.st_ctime > _FORGOTTEN_S
                if is_left and found.st_uid == os.getuid():
                    _remove(Path(entry.path))


def temporary_beside(path: Path) -> Path:
    """Return the name of a temporary file or folder beside a path, with the same type."""
    return path.with_name(f"{temporary_prefix()}{uuid.uuid4().hex}{path.suffix}")


def temporary_prefix() -> str:
    """Return the beginning of this process's temporary file names."""
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


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
        return
    # unlink fails, too, where a parent of the path is a regular file.
    with contextlib.suppress(OSError):
        path.unlink()


def _reason(error: OSError, temporary: Path, path: Path) -> str:
    """Return an error's reason in one line, with the file's name instead of the temporary one."""
    # HDF5 gives a number and a long text with the state of its file.
    text = os.strerror(error.errno) if error.errno else str(error).replace(str(temporary), str(path)).rstrip(".")
    return text.partition("\n")[0]
