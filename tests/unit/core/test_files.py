"""Files that replace others alone or together, and the leftovers of killed processes."""

import contextlib
import errno
import os
import signal
import subprocess
import sys

import pytest
from rows import each_case

from mitransient_lidar.core import files
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import replacing, together
from mitransient_lidar.core.interruption import DeferredInterrupt

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
    assert str(caught.value) in ("", f"cannot write {tmp_path / 'c'}: Permission denied")
    assert contents(tmp_path) == {"b": "old"}


@pytest.mark.slow
@each_case(("a.txt", {"b.txt": "old"}), ("b.txt", {"b.txt": "old"}), ("moving", {"a.txt": "new", "b.txt": "old"}))
def test_the_next_run_sweeps_what_a_killed_one_left(event, kept, tmp_path):
    (tmp_path / "b.txt").write_text("old")
    killed = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path), event], check=False, timeout=60)
    assert killed.returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) > len(kept)
    write(tmp_path, "next.txt")
    assert contents(tmp_path) == kept | {"next.txt": "new"}


@pytest.fixture
def dead():
    """Beginning of the names of the temporary files of a process that has ended."""
    process = subprocess.Popen(["true"])
    process.wait()
    return name_of(process.pid)


def name_of(process, space=None):
    """Return the beginning of the names of the temporary files of a process, of this process space by default."""
    host, own, _ = files.temporary_prefix().removesuffix(".").rsplit(".", 2)
    return f"{host}.{space or own}.{process}"


def test_leftovers_of_a_dead_process_are_removed(tmp_path, dead):
    (tmp_path / f"{dead}.{'b' * 32}.nc").write_text("half")
    folder = tmp_path / f"{dead}.{'c' * 32}.zarr"
    (folder / "waveform").mkdir(parents=True)
    (folder / "zarr.json").write_text("{}")
    write(tmp_path, "c")
    assert contents(tmp_path) == {"c": "new"}


def test_no_leftover_moves_or_removes_a_file_of_another_name(tmp_path, dead):
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "a").write_text("old")
    out = tmp_path / "out"
    out.mkdir()
    (out / "evil").write_text("new")
    (out / f"{dead}.{'a' * 32}.moves").write_text(f'[["evil", "../victim/a"], ["evil", "{victim / "a"}"]]')
    (out / f"{dead}.{'b' * 32}.zarr").symlink_to(victim)
    write(out, "c")
    assert contents(victim) == {"a": "old"}
    assert contents(out) == {"evil": "new", "c": "new"}


def test_leftovers_of_another_user_stay(tmp_path, dead, monkeypatch):
    name = f"{dead}.{'a' * 32}.nc"
    (tmp_path / name).write_text("theirs")
    monkeypatch.setattr(files.os, "getuid", lambda: os.stat(tmp_path).st_uid + 1)
    write(tmp_path, "c")
    assert contents(tmp_path) == {name: "theirs", "c": "new"}


@pytest.mark.parametrize("presses", [1, 2])
def test_an_interruption_waits_until_the_files_are_in_place(tmp_path, default_ctrl_c, presses):
    (tmp_path / "a").write_text("old")

    def interrupted():
        with together(), replacing(tmp_path / "a") as temporary:
            for _ in range(presses):
                os.kill(os.getpid(), signal.SIGINT)
            temporary.write_text("new")

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert contents(tmp_path) == {"a": "new" if presses == 1 else "old"}
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize(("presses", "survived"), [(1, 1), (3, 1)])
def test_a_second_ctrl_c_acts_at_once(default_ctrl_c, presses, survived):
    done = []

    def press():
        with DeferredInterrupt():
            for number in range(presses):
                os.kill(os.getpid(), signal.SIGINT)
                done.append(number)

    with pytest.raises(KeyboardInterrupt):
        press()
    assert len(done) == survived
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interruption_between_a_render_and_its_files_waits(tmp_path, default_ctrl_c):
    def render():
        with DeferredInterrupt(at_once=False):
            with DeferredInterrupt() as passes, contextlib.suppress(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGINT)
                passes.check()
            os.kill(os.getpid(), signal.SIGINT)
            write(tmp_path, "a")

    with pytest.raises(KeyboardInterrupt):
        render()
    assert contents(tmp_path) == {"a": "new"}


def test_files_of_running_processes_and_other_machines_stay(tmp_path):
    number = "0" * 32
    names = [f"{name_of(os.getppid())}.{number}.nc", f".mitransient-lidar.elsewhere.{'0' * 12}.1.{number}.nc"]
    names += [".mitransient-lidar.nc", ".hidden.nc"]
    for name in names:
        (tmp_path / name).write_text("theirs")
    write(tmp_path, "a")
    assert contents(tmp_path) == {"a": "new"} | dict.fromkeys(names, "theirs")


def test_leftovers_of_another_container_stay_for_a_week(tmp_path, dead, monkeypatch):
    """Its host may have the same name, and the number of a process that runs there may be of none here."""
    name = f"{name_of(dead.rsplit('.', 1)[1], space='0' * 12)}.{'a' * 32}.nc"
    (tmp_path / name).write_text("theirs")
    write(tmp_path, "c")
    assert contents(tmp_path) == {name: "theirs", "c": "new"}
    now = files.time.time()
    monkeypatch.setattr(files.time, "time", lambda: now + 8 * 24 * 3600)
    write(tmp_path, "c")
    assert contents(tmp_path) == {"c": "new"}


#: Runs a command where it has the process number 1, as in a container.
CONTAINER = ["unshare", "--user", "--map-root-user", "--pid", "--fork", "--mount-proc"]

#: Writes a file beside another one, into a folder, while a line is awaited.
SLOW = """
import sys
from pathlib import Path
from mitransient_lidar.core.files import replacing
with replacing(Path(sys.argv[1]) / "slow") as temporary:
    temporary.write_text("theirs")
    print(temporary.name, flush=True)
    sys.stdin.readline()
"""


@pytest.mark.slow
@pytest.mark.skipif(
    subprocess.run([*CONTAINER, "true"], check=False, capture_output=True).returncode != 0, reason="no containers here"
)
def test_a_file_that_another_container_writes_stays(tmp_path):
    """Here 1 is another process than there; a second container has none of the number of the first one's."""
    command = [sys.executable, "-c", SLOW, str(tmp_path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    # A shell that does not replace itself gives the writer the number 2.
    with subprocess.Popen([*CONTAINER, "sh", "-c", '"$@"; exit $?', "sh", *command], **pipes) as first:
        name = first.stdout.readline().strip()
        assert ".2." in name
        other = "from mitransient_lidar.core.files import sweep; import sys; from pathlib import Path; "
        done = subprocess.run([*CONTAINER, sys.executable, "-c", f"{other}sweep(Path(sys.argv[1]))", str(tmp_path)])
        assert done.returncode == 0
        write(tmp_path, "c")
        assert name in contents(tmp_path)
        first.communicate("\n")
    assert first.returncode == 0
    assert contents(tmp_path) == {"slow": "theirs", "c": "new"}


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
        assert str(caught.value) == f"cannot write {tmp_path / 'a.nc'}: No space left on device"
    with pytest.raises(UserError) as caught:
        fail("cannot write {}")
    assert str(caught.value) == f"cannot write {tmp_path / 'a.nc'}: cannot write {tmp_path / 'a.nc'}"
    assert contents(tmp_path) == {}
