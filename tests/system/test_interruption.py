"""Commands that are interrupted, killed, or run out of disk space: exit codes, and the files that remain."""

import os
import pty
import resource
import signal
import subprocess
import sys

import pytest
from few_paths import few_paths

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

#: The command line, killed when it has drawn the waveforms but not the layout.
KILLED = """
import os, signal
from mitransient_lidar.plots import layout
from mitransient_lidar.cli import app
layout.plot_layout = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
app.main()
"""

#: The command line, with files of limited size after the render.
DISK_FULL = """
import functools, resource, sys
limit = int(sys.argv.pop(1))
from mitransient_lidar.rendering import render
from mitransient_lidar.cli import app
original = render.render
@functools.wraps(original)  # whose options the command has
def and_fill_the_disk(*arguments, **options):
    dataset = original(*arguments, **options)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    return dataset
render.render = and_fill_the_disk
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


@pytest.mark.long
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_on_the_command_line_keeps_the_passes(tmp_path, number, code):
    process, stdout, stderr = render(INTERRUPTED, tmp_path, passes=100_000, before=[int(number)])
    assert process.returncode == code, stderr
    assert "interrupted after 3 passes; their result is kept." in stderr
    assert names(tmp_path) == FILES
    assert stdout.splitlines() == [str(tmp_path / name) for name in FILES]
    attributes = mitransient_lidar.open(tmp_path / "table1.nc").attrs
    assert (attributes["interrupted"], attributes["passes"]) == (1, 3)


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


@pytest.mark.long
def test_files_of_a_killed_command_do_not_appear_and_the_next_one_sweeps_them(tmp_path):
    (tmp_path / "table1.exr").write_text("old")
    process, stdout, _ = render(KILLED, tmp_path, overwrite=True)
    assert (process.returncode, stdout) == (-signal.SIGKILL, "")
    assert (tmp_path / "table1.exr").read_text() == "old"
    assert [name for name in names(tmp_path) if not name.startswith(".")] == ["table1.exr"]
    assert len(names(tmp_path)) == 4  # three files were written
    process, _, stderr = render("from mitransient_lidar.cli import app; app.main()", tmp_path, overwrite=True)
    assert process.returncode == 0, stderr
    assert names(tmp_path) == FILES


@pytest.mark.skipif(resource.getrlimit(resource.RLIMIT_FSIZE)[1] != resource.RLIM_INFINITY, reason="files are limited")
@pytest.mark.long
@pytest.mark.parametrize(("limit", "file"), [(1000, "table1.exr"), (83_000, "table1.nc"), (120_000, "table1.png")])
def test_a_full_disk_leaves_the_former_files(tmp_path, limit, file):
    """Limits in bytes, between the sizes of the files: EXR 80 000, NetCDF 86 000, drawing more than 150 000."""
    (tmp_path / "table1.exr").write_text("old")
    process, stdout, stderr = render(DISK_FULL, tmp_path, before=[limit], overwrite=True)
    assert (process.returncode, stdout) == (2, ""), stderr
    sentence = stderr.splitlines()[-1]
    assert sentence.startswith(f"cannot write {tmp_path / file}: ")
    assert sentence.endswith("File too large.")
    assert ".mitransient-lidar" not in stderr
    assert "Traceback" not in stderr
    assert names(tmp_path) == ["table1.exr"]
    assert (tmp_path / "table1.exr").read_text() == "old"


#: The command line, with Ctrl-C during the third pass or shot of its renders.
IN_A_RENDER = """
import os, signal
from mitransient_lidar.core.interruption import DeferredInterrupt
from mitransient_lidar.cli import app
check, calls = DeferredInterrupt.check, []
def check_and_interrupt():
    calls.append(1)
    if len(calls) == 3:
        os.kill(os.getpid(), signal.SIGINT)
    check()
signal.signal(signal.SIGINT, signal.default_int_handler)
DeferredInterrupt.check = staticmethod(check_and_interrupt)
app.main()
"""

COARSE = ["-D", "surface_size=60", "-D", "surface_cell_size=0.5"]
STUDIES = {
    "detect": (["small.xml", *COARSE, "--passes", 16, "-o", "d.png"], "of 4 renders, and none is kept."),
    "target-signal": (
        ["small.xml", *COARSE, "--grid", 2, "--passes", 16, "-o", "t.png"],
        "of 4 places, and none is kept.",
    ),
    "depth-bias": (
        ["published_airborne", "--winds", 0, "--waters", "IB", "--angles", "5,10,15", "--depths", 4, "-o", "d.nc"],
        "of 6 renders, and none is kept.",
    ),
}


@pytest.mark.parametrize(
    "study", [pytest.param(name, marks=pytest.mark.slow if name == "detect" else pytest.mark.long) for name in STUDIES]
)
def test_a_study_that_needs_all_of_its_renders_ends_with_the_first_interruption(tmp_path, study):
    """It once went on with the next render, and counted the interrupted one as complete."""
    arguments, text = STUDIES[study]
    few_paths("fig13_2x2", tmp_path)
    process = start(IN_A_RENDER, study, *arguments, "-q", stderr=subprocess.PIPE, cwd=tmp_path)
    _, stderr = process.communicate(timeout=600)
    assert process.returncode == 130, stderr
    (line,) = stderr.splitlines()
    assert line.startswith("interrupted")
    assert text in line
    assert names(tmp_path) == ["small.xml"]


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


@pytest.mark.parametrize(
    ("number", "code"),
    [
        pytest.param(signal.SIGINT, 130, marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, 143, marks=pytest.mark.long),
        pytest.param(signal.SIGHUP, 129, marks=pytest.mark.long),
    ],
)
def test_a_signal_after_the_last_file_ends_as_any_other(number, code):
    """Ctrl-C once gave a traceback and exit code 0."""
    process = start(LATE, int(number), "scenes", "list", stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    stdout, stderr = process.communicate(timeout=240)
    assert (process.returncode, stderr) == (code, "")
    assert "table1" in stdout


@pytest.mark.slow
@pytest.mark.parametrize("closed", [pytest.param("2>&-", marks=pytest.mark.long), "<&- >&- 2>&-"])
def test_a_render_with_closed_streams_writes_its_files_and_nothing_into_them(tmp_path, closed):
    """It once wrote nothing, with exit code 2; files took the number of stderr, which libraries write to."""
    arguments = [*RENDER, "--passes", "2", "-D", "surface_size=60", "-D", "surface_cell_size=0.5", "-o", str(tmp_path)]
    command = f'"$@" {closed}'
    done = subprocess.run(
        ["sh", "-c", command, "sh", sys.executable, "-m", "mitransient_lidar", *arguments],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert names(tmp_path) == FILES
    assert mitransient_lidar.open(tmp_path / "table1.nc").attrs["passes"] == 2
    assert mitransient_lidar.open(tmp_path / "table1.exr").attrs["passes"] == 2
