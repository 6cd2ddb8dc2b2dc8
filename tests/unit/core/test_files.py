"""Files that replace others alone or together, and the leftovers of killed processes."""

import errno
import os
import signal
import subprocess
import sys

import pytest

from mitransient_lidar.core import files
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import replacing, together

#: Writes a.txt and b.txt together; the process is killed at an event.
KILLED = """
import os, signal, sys
from pathlib import Path
from mitransient_lidar.core import files
folder, event = Path(sys.argv[1]), sys.argv[2]
replace, moved = os.replace, []
def replace_and_die(source, target):
    replace(source, target)
    moved.append(target)
    if event == "moving":
        os.kill(os.getpid(), signal.SIGKILL)
files.os.replace = replace_and_die
with files.together():
    for name in ("a.txt", "b.txt"):
        with files.replacing(folder / name) as temporary:
            temporary.write_text("new")
            if event == name:
                os.kill(os.getpid(), signal.SIGKILL)
"""


def write(folder, *names, text="new"):
    for name in names:
        with replacing(folder / name) as temporary:
            temporary.write_text(text)


def contents(folder):
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_files_appear_at_the_end_of_the_context(tmp_path):
    (tmp_path / "b").write_text("old")
    with together() as written:
        write(tmp_path, "a")
        with together() as inner:
            write(tmp_path, "b")
        assert not (tmp_path / "a").exists()
        assert (tmp_path / "b").read_text() == "old"
    assert inner == []
    assert written == [tmp_path / "a", tmp_path / "b"]
    assert contents(tmp_path) == {"a": "new", "b": "new"}


@pytest.mark.parametrize("failure", [KeyboardInterrupt, UserError, RuntimeError])
def test_a_failure_in_the_context_leaves_everything_as_it_was(tmp_path, failure):
    (tmp_path / "b").write_text("old")

    def fail():
        with together():
            write(tmp_path, "a", "b")
            raise failure

    with pytest.raises(failure):
        fail()
    assert contents(tmp_path) == {"b": "old"}


@pytest.mark.parametrize("links", [True, False])
@pytest.mark.parametrize("failure", [KeyboardInterrupt(), OSError(errno.EACCES, "Permission denied")])
def test_a_failure_while_files_are_moved_restores_the_former_ones(tmp_path, monkeypatch, links, failure):
    """The third of three moves fails: the first file was new, the second one replaced another."""
    (tmp_path / "b").write_text("old")
    replace, moved = os.replace, []

    def replace_or_fail(source, target):
        if target == tmp_path / "c":
            raise failure
        moved.append(target)
        replace(source, target)

    def no_links(source, target):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(files.os, "replace", replace_or_fail)
    if not links:
        monkeypatch.setattr(files.os, "link", no_links)

    def fail():
        with together():
            write(tmp_path, "a", "b", "c")

    with pytest.raises(KeyboardInterrupt if isinstance(failure, KeyboardInterrupt) else UserError) as caught:
        fail()
    assert moved[:2] == [tmp_path / "a", tmp_path / "b"]
    assert str(caught.value) in ("", f"cannot write {tmp_path / 'c'}: Permission denied.")
    assert contents(tmp_path) == {"b": "old"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("event", "kept"),
    [("a.txt", {"b.txt": "old"}), ("b.txt", {"b.txt": "old"}), ("moving", {"a.txt": "new", "b.txt": "new"})],
)
def test_the_next_run_sweeps_or_completes_what_a_killed_one_left(tmp_path, event, kept):
    (tmp_path / "b.txt").write_text("old")
    killed = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path), event], check=False, timeout=60)
    assert killed.returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) > len(kept)
    write(tmp_path, "next.txt")
    assert contents(tmp_path) == kept | {"next.txt": "new"}


@pytest.mark.parametrize("journal", ['[[".t", "b"], [".gone", "a"]]', '[[".t", "b"', ""])
def test_leftovers_of_a_dead_process_are_swept(tmp_path, journal):
    """Its list of moves is completed, unless it was not written in full, so that no file had been moved."""
    dead = subprocess.Popen(["true"])
    dead.wait()
    start = f".mitransient-lidar.{files.host_name()}.{dead.pid}"
    (tmp_path / f"{start}.{'a' * 32}.moves").write_text(journal.replace(".t", f"{start}.{'b' * 32}.nc"))
    (tmp_path / f"{start}.{'b' * 32}.nc").write_text("complete")
    (tmp_path / f"{start}.{'c' * 32}").write_text("half")
    (tmp_path / "b").write_text("old")
    write(tmp_path, "c")
    assert contents(tmp_path) == {"b": "complete" if journal.endswith("]]") else "old", "c": "new"}


def test_files_of_running_processes_and_other_machines_stay(tmp_path):
    here, number = files.host_name(), "0" * 32
    names = [f".mitransient-lidar.{here}.{os.getppid()}.{number}.nc", f".mitransient-lidar.elsewhere.1.{number}.nc"]
    names += [".mitransient-lidar.nc", ".hidden.nc"]
    for name in names:
        (tmp_path / name).write_text("theirs")
    write(tmp_path, "a")
    assert contents(tmp_path) == {"a": "new"} | dict.fromkeys(names, "theirs")


def test_a_full_disk_names_the_file_and_not_the_temporary_one(tmp_path):
    def fail(error):
        with replacing(tmp_path / "a.nc") as temporary:
            temporary.write_text("half")
            raise error if isinstance(error, Exception) else OSError(error.format(temporary))

    hdf5 = "Unable to extend file properly (file write failed: time = today\n, filename = '.mitransient', errno = 28)"
    openexr = RuntimeError("errno = 28, 'No space left on device'")
    for error in (OSError(errno.ENOSPC, "full"), OSError(errno.ENOSPC, hdf5), openexr):
        with pytest.raises(UserError) as caught:
            fail(error)
        assert str(caught.value) == f"cannot write {tmp_path / 'a.nc'}: No space left on device."
    with pytest.raises(UserError) as caught:
        fail("cannot write {}")
    assert str(caught.value) == f"cannot write {tmp_path / 'a.nc'}: cannot write {tmp_path / 'a.nc'}."
    assert contents(tmp_path) == {}
