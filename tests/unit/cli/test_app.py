"""The command line: output, sentences and exit codes."""

import errno
import io
import logging
import os
import signal
import time as clock
from types import SimpleNamespace

import numpy as np
import pytest
import rich.console
import xarray as xr
from command_line import assert_refused, run, stub
from rows import each_row
from small_results import made

from mitransient_lidar import results
from mitransient_lidar.cli import messages
from mitransient_lidar.cli.app import COMMANDS
from mitransient_lidar.core.files import replacing
from mitransient_lidar.loading import catalogue
from mitransient_lidar.rendering.passes import Progress


@pytest.fixture
def scene(tmp_path, monkeypatch):
    folder = tmp_path / "scenes"
    folder.mkdir()
    (folder / "fig09.xml").write_text('<!-- Flat bottom. -->\n<scene version="3.0.0"/>\n')
    monkeypatch.setattr(catalogue, "folder_of_scenes", lambda: folder)
    return "fig09"


@pytest.fixture
def calls(monkeypatch):
    seen = []
    extra = {}

    def render(scene, **options):
        seen.append((scene, options))
        if options["progress"] is not None:
            options["progress"](Progress(1, 2, "pass", 0.1, 3.0, 0.02, 0.03, 0.01, error=0.03))
            options["progress"](Progress(2, None, "pass", 0.2))
        if "error" in extra:
            raise extra["error"]
        waveform = np.array([[1e-6, 3e-6, 2e-6], [1e-6, 5e-6, 2e-6]])
        attributes = {"scene": "fig09", "passes": 4, "elapsed_s": 1.5, "error_median": 0.0123, "error_p95": 0.04}
        attributes |= {"altitude": 200.0, "off_nadir_deg": 20.0}
        names, centres = ["[red]", "green"], [(1, 0), (-1, 0)]
        return made(waveform, waveform, start=0, step=1, names=names, centres=centres, **(attributes | extra))

    stub(monkeypatch, "render", render)
    return SimpleNamespace(seen=seen, extra=extra)


@pytest.mark.slow
def test_render_writes_files_and_prints_their_paths(scene, calls, tmp_path):
    out = tmp_path / "new" / "folder"
    result = run("render", scene, "-o", out, "-D", "wind_speed=3", "-D", "file=a=b", "--passes", 4, "--seed", 7)
    assert result.exit_code == 0, result.output
    names = ["fig09.exr", "fig09.nc", "fig09.png", "fig09_layout.png"]
    assert result.stdout.splitlines() == [str(out / name) for name in names]
    assert sorted(path.name for path in out.iterdir()) == names
    assert results.open(out / "fig09.exr").attrs["passes"] == 4
    ((name, options),) = calls.seen
    assert name == "fig09"
    assert options.pop("progress") is not None
    given = {"params": {"wind_speed": "3", "file": "a=b"}, "passes": 4, "seed": 7, "infrared": False}
    assert {name: value for name, value in options.items() if value is not None} == given
    for part in ("1.23", "peak power, [red] (W)", "3e-06", "5e-06", "1.50"):
        assert part in result.stderr
    calls.extra["interrupted"] = 1
    result = run("render", scene, "-o", out, "--quiet", "--overwrite")
    assert (result.exit_code, len(result.stdout.splitlines())) == (130, 4)
    assert "interrupted after 4 passes" in result.stderr
    assert results.open(out / "fig09.nc").attrs["interrupted"] == 1


@each_row(True, False)
def test_messages_of_a_quiet_command_alone_are_silent_to_its_end(quiet, tmp_path, monkeypatch, caplog):
    logger = logging.getLogger("mitransient_lidar")
    before = logger.propagate, logger.level, [*logger.handlers]
    monkeypatch.setattr("mitransient_lidar.results.dataset_of", lambda *_: logger.warning("early") or xr.Dataset())
    stub(monkeypatch, "record", lambda *_, **__: ())
    monkeypatch.setattr("mitransient_lidar.analysis.recorded.describe_recording", lambda *_, **__: ())
    monkeypatch.setattr("mitransient_lidar.cli.analysis.write_netcdf", lambda *_: logger.warning("late"))
    done = run("record", tmp_path / "a.nc", *(["-q"] if quiet else []))
    assert done.exit_code == 0, done.output
    assert ("early" in done.stderr, caplog.messages) == ((False, []) if quiet else (True, ["early", "late"]))
    assert (logger.propagate, logger.level, logger.handlers) == before


@each_row(
    ("detect", "describe_detection", "targets:plot_detection"),
    ("scattering", "describe_scattering", "light:plot_scattering"),
)
def test_interrupted_studies_end_with_the_exit_code_of_the_signal(command, describe, plot, monkeypatch, tmp_path):
    study = COMMANDS[command].function.partition(":")[0]
    stub(monkeypatch, command, lambda **_: xr.Dataset(attrs={"interrupted": 1, "passes": 3}))
    monkeypatch.setattr(f"mitransient_lidar.{study}.{describe}", lambda _: ["lines"])
    monkeypatch.setattr(f"mitransient_lidar.plots.studies.{plot.replace(':', '.')}", lambda *_: None)
    done = run(command, "table1", "-o", tmp_path / "out.png", "-q")
    assert done.stdout.splitlines() == [str(tmp_path / "out.nc"), "lines"]
    assert (done.exit_code, done.stderr) == (130, "interrupted after 3 passes; their result is kept\n")


def test_interruption_elsewhere_leaves_nothing_and_a_bug_is_not_taken_for_a_mistake(scene, calls, tmp_path):
    wrapped = RuntimeError("while_loop(): encountered an exception")
    wrapped.__cause__ = KeyboardInterrupt()
    for error in (KeyboardInterrupt(), wrapped):
        calls.extra["error"] = error
        result = run("render", scene, "-o", tmp_path / "out", "--quiet")
        assert (result.exit_code, result.stderr) == (130, "interrupted.\n")
        assert not (tmp_path / "out").exists()
    calls.extra["error"] = ValueError("bug")
    assert type(run("render", scene, "-o", tmp_path).exception) is ValueError


def test_a_disk_without_space_for_the_last_picture_leaves_the_former_files(scene, calls, tmp_path, monkeypatch):
    def full(dataset, path):
        with replacing(path):
            raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr("mitransient_lidar.plots.layout.plot_layout", full)
    (tmp_path / "fig09_layout.png").write_text("old")
    full_disk = run("render", scene, "-o", tmp_path, "--quiet", "--overwrite")
    assert_refused(full_disk, "fig09_layout.png: No space left on device")
    assert [(path.name, path.read_text()) for path in tmp_path.glob("fig09*")] == [("fig09_layout.png", "old")]


def test_an_interruption_while_the_files_are_written_keeps_them(scene, calls, tmp_path, monkeypatch, default_ctrl_c):
    save = results.save

    def interrupted(dataset, path):
        if path.suffix == ".nc":
            os.kill(os.getpid(), signal.SIGINT)
        save(dataset, path)

    monkeypatch.setattr(results, "save", interrupted)
    result = run("render", scene, "-o", tmp_path / "out", "--quiet", "--no-plot")
    assert result.exit_code == 130
    assert results.open(tmp_path / "out" / "fig09.nc").attrs["passes"] == 4
    assert (tmp_path / "out" / "fig09.exr").exists()


def test_unwritable_output_is_noticed_before_rendering(scene, calls, tmp_path):
    (tmp_path / "file").write_text("regular")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        assert_refused(run("render", scene, "-o", folder), f"cannot write to folder {folder}: Not a directory")
    (tmp_path / "fig09.nc").mkdir()
    assert_refused(run("render", scene, "-o", tmp_path), f"cannot write {tmp_path / 'fig09.nc'}: it is a folder")
    for name in ("a\nb", "a\x1b[2J"):
        assert_refused(run("render", scene, "-o", tmp_path / name), "its name must have no control characters")
        assert not (tmp_path / name).exists()
    assert not calls.seen


#: Sets colour and title of a terminal, rings, and turns the order of letters.
STEERING = "\x1b[31mred\x1b]0;title\x07\u202e"
SHOWN = r"\x1b[31mred\x1b]0;title\x07\u202e"
LONG = " and long" * 20


def test_control_characters_do_not_reach_the_terminal(scene, calls, tmp_path, monkeypatch):
    """Of a parameter, a pixel in the summary, a message in the log, and of what a command prints."""
    assert_refused(run("render", scene, "-o", tmp_path, "-D", f"{STEERING}=1", "-D", "x"), r"-D")
    assert_refused(run("render", STEERING), SHOWN)
    built = results.build

    def build(*arrays, **options):
        logging.getLogger("mitransient_lidar.test").warning("%s is odd%s", STEERING, LONG)
        return built(*arrays, **{**options, "pixel_names": [STEERING, "green"]})

    monkeypatch.setattr(results, "build", build)
    done = run("render", scene, "-o", tmp_path, "--no-plot")
    assert done.exit_code == 0, done.output
    assert not set(done.stdout + done.stderr) & set(STEERING) - set("[31mred]0;title")
    text = "".join(done.stderr.split())
    assert f"WARNING  {SHOWN} is odd{LONG}\n" in done.stderr  # in one line where there is no terminal
    assert f"peakpower,{SHOWN}(W)" in text


def test_progress_on_a_terminal_holds_only_its_own_control_characters(monkeypatch):
    out = io.StringIO()
    console = rich.console.Console(file=out, force_terminal=True, width=200)
    monkeypatch.setattr(messages, "_console", lambda: console)
    with messages.reporting(quiet=False) as show:
        show(Progress(3, 20, STEERING, 0.1))
        clock.sleep(0.3)
    assert SHOWN in out.getvalue()
    assert "\x07" not in out.getvalue()
