"""Commands that are interrupted, killed, or run out of disk space: exit codes, and the files that remain."""

import os
import pty
import signal
import subprocess
import sys

import pytest
from rows import each_case

import mitransient_lidar

RENDER = ["render", "table1", "--integrator", "lidar_volpath"]
FILES = ["table1.exr", "table1.nc", "table1.png", "table1_layout.png"]

#: The command line, with a signal when the third pass is added to the first of its statistics.
INTERRUPTED = """
import os, signal, sys
from mitransient_lidar.rendering import accuracy
from mitransient_lidar.cli import app
number = int(sys.argv.pop(1))
add = accuracy.PassStatistics.add
def add_and_interrupt(statistics, values):
    add(statistics, values)
    if statistics.count == 3:
        accuracy.PassStatistics.add = add
        if number == signal.SIGHUP:
            sys.stdin.readline()  # until the terminal is closed
        else:
            os.kill(os.getpid(), number)
# Where the tests run in the background or under nohup, these are ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
accuracy.PassStatistics.add = add_and_interrupt
app.main()
"""


def start(script, *arguments, **options):
    return subprocess.Popen([sys.executable, "-c", script, *map(str, arguments)], text=True, **options)


def render(script, folder, *, passes=2, before=(), overwrite=False, **options):
    arguments = [*before, *RENDER, "--passes", passes, "-o", folder, *["--overwrite"] * overwrite]
    process = start(script, *arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)
    return process, *process.communicate(timeout=240)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.slow
def test_a_closed_terminal_keeps_the_passes(tmp_path):
    """The terminal is closed, which sends SIGHUP, and every later output to it fails."""
    leader, follower = pty.openpty()

    def take_terminal():
        os.setsid()
        os.close(os.open(os.ttyname(follower), os.O_RDWR))

    coarse = ["-D", "surface_size=60", "-D", "surface_cell_size=0.5"]
    arguments = [int(signal.SIGHUP), *RENDER, *coarse, "--passes", 100_000, "-o", tmp_path]
    process = start(INTERRUPTED, *arguments, stdin=follower, stdout=follower, stderr=follower, preexec_fn=take_terminal)
    os.close(follower)
    shown = b""
    while b"pass 2" not in shown:
        shown += os.read(leader, 4096)
    os.close(leader)
    assert process.wait(timeout=240) == 129
    assert names(tmp_path) == FILES
    attributes = mitransient_lidar.open(tmp_path / "table1.nc").attrs
    assert attributes["interrupted"] == 1
    assert attributes["passes"] >= 2


#: The command line, with a signal when the command has ended and the process has not.
LATE = """
import atexit, os, signal, sys
number = int(sys.argv.pop(1))
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
atexit.register(lambda: os.kill(os.getpid(), number))
from mitransient_lidar.cli import app
app.main()
"""


@each_case(
    pytest.param(signal.SIGINT, 130, marks=pytest.mark.slow),
    pytest.param(signal.SIGTERM, 143, marks=pytest.mark.long),
    pytest.param(signal.SIGHUP, 129, marks=pytest.mark.long),
)
def test_a_signal_after_the_last_file_ends_as_any_other(number, code):
    process = start(LATE, int(number), "scenes", "list", stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    stdout, stderr = process.communicate(timeout=240)
    assert (process.returncode, stderr) == (code, "")
    assert "table1" in stdout


@pytest.mark.slow
def test_a_render_with_closed_streams_writes_its_files_and_nothing_into_them(tmp_path):
    coarse = ["-D", "surface_size=60", "-D", "surface_cell_size=0.5"]
    command = ["sh", "-c", '"$@" <&- >&- 2>&-', "sh", sys.executable, "-m", "mitransient_lidar", *RENDER, *coarse]
    done = subprocess.run([*command, "--passes", "2", "-o", str(tmp_path)], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert names(tmp_path) == FILES
    for suffix in ("nc", "exr"):
        assert mitransient_lidar.open(tmp_path / f"table1.{suffix}").attrs["passes"] == 2
