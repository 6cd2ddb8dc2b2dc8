"""Campaigns from their files to data sets: labels, failures, interruption, clusters, and single runs."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import significance
import zarr
from command_line import assert_refused, run
from quick_campaign import QUICK, files_of, planned_copy, write_toml
from rows import must_refuse

from mitransient_lidar.campaigns import shard as shards
from mitransient_lidar.campaigns import workers
from mitransient_lidar.campaigns.runs import FILES, check_versions
from mitransient_lidar.campaigns.store import DONE, FAILED, PLANNED, Store, open_campaign
from mitransient_lidar.campaigns.sweep import campaign as run_campaign
from mitransient_lidar.campaigns.sweep import resume


@pytest.mark.slow
def test_same_bits_whatever_shards_workers_order_and_interruptions(campaign, quick, tmp_path, request, default_ctrl_c):
    """Ctrl-C comes when three runs are done; processes write what they have, and this process renders the others."""
    path, pressed = tmp_path / "other.zarr", []

    def press(state):
        if state.done >= 3 and not pressed:
            pressed.append(state.done)
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match=r"interrupted after \d+ of 12 runs, which are kept; the same command"):
        run_campaign(campaign, path, workers=2, shard_size=5, progress=press)
    assert np.count_nonzero(Store(path).status() == DONE) >= 3
    request.getfixturevalue("in_this_process")
    first, other = open_campaign(quick), resume(path, workers=1)
    for name in first.variables:
        np.testing.assert_array_equal(first[name].values, other[name].values, err_msg=str(name))
    before = files_of(path)
    run_campaign(campaign, path, workers=1, shard_size=5)
    assert files_of(path) == before


@pytest.mark.long
def test_killed_and_resumed_it_has_the_bits_of_an_uninterrupted_one(campaign, quick, tmp_path):
    path = tmp_path / "killed.zarr"
    file = write_toml(tmp_path / "quick.toml", campaign)
    command = [sys.executable, "-m", "mitransient_lidar", "campaign", str(file), "-o", str(path)]
    command += ["--workers", "1", "--shard-size", "6"]
    mark = {"MARK_OF_TEST": str(tmp_path)}
    with subprocess.Popen(
        command, start_new_session=True, stderr=subprocess.PIPE, env={**os.environ, **mark}
    ) as process:
        deadline, seen = time.monotonic() + 120, set()
        while time.monotonic() < deadline and not (path.exists() and (Store(path).status() == DONE).any()):
            time.sleep(0.05)
            seen |= set(shard_processes(mark))
        assert seen
        os.killpg(process.pid, signal.SIGKILL)
    status = Store(path).status()
    assert (status == DONE).any()
    assert (status == PLANNED).any()
    # The processes of shards, in sessions of their own, end with their worker.
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline and shard_processes(mark):
        time.sleep(0.1)
    assert not shard_processes(mark)
    finished = [one for one in Store(path).shards if (status[Store(path).runs_of(one)] == DONE).all()]
    chunks = [path / "waveform" / "c" / str(one) / "0" / "0" for one in finished]
    written = [chunk.stat().st_mtime_ns for chunk in chunks]
    out = run("campaign", path, "--workers", 2, "-q")
    assert out.exit_code == 0, out.stderr
    assert [chunk.stat().st_mtime_ns for chunk in chunks] == written
    if significance.seed_shift == 0:
        assert files_of(path) == files_of(quick)


def shard_processes(mark):
    """Return the processes that render a shard with a variable in their environment."""
    ((name, value),) = mark.items()
    variable, found = f"{name}={value}".encode(), []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            command, environment = ((entry / one).read_bytes().split(b"\0") for one in ("cmdline", "environ"))
            state = (entry / "stat").read_text().rsplit(")", 1)[1].split()[0]
        except OSError:
            continue
        if shards._PROGRAM.encode() in command and variable in environment and state != "Z":
            found.append(int(entry.name))
    return found


@pytest.mark.slow
def test_failed_runs_end_with_exit_code_1(quick, tmp_path):
    path = tmp_path / "failed.zarr"
    shutil.copytree(quick, path)
    store = Store(path)
    store.array("status")[2:4] = np.array([FAILED, FAILED], dtype=np.uint8)
    store.array("error")[2:4] = np.array(["wind_speed = -6 is too small", "another reason"])
    out = run("campaign", path, "-q")
    assert out.exit_code == 1
    assert out.stderr == "2 of 12 runs failed, the first, run 2, so: wind_speed = -6 is too small\n"
    assert out.stdout == f"{path}\n"
    assert run("campaign", quick, "-q").exit_code == 0


@pytest.mark.slow
def test_a_store_of_other_versions_is_not_completed(quick, tmp_path, caplog):
    path = planned_copy(quick, tmp_path / "older.zarr")
    group = zarr.open_group(path, mode="r+")
    now = group.attrs["versions"]
    group.attrs["versions"] = {**now, "mitsuba": "3.9.0"}
    text = r"older\.zarr was begun by other versions, and here is mitsuba 3\.9\.1 instead of 3\.9\.0: install those"
    must_refuse(text, resume, path, workers=1)
    # Stores of version 0.2 have less.
    del group.attrs["versions"]
    group.attrs["drjit_version"] = "1.4.0"
    must_refuse(r"drjit 1\.5\.0 instead of 1\.4\.0", resume, path, workers=1)
    assert (Store(path).status() == PLANNED).all()
    check_versions(path, {"versions": {**now, FILES: "0123456789ab"}})
    assert "files of this package have changed since" in caplog.text


@pytest.mark.slow
def test_invalid_use_leaves_nothing(campaign, quick, tmp_path):
    def changed(**sections):
        return {**campaign, **sections}

    out = tmp_path / "out.zarr"
    cases = [
        (changed(fixed={"bottom_dept": 3}), [], "parameter 'bottom_dept' is not one of scene"),
        (changed(parameters={"altitude": {"low": 3, "high": 3}}), [], "altitude has the empty range 3 to 3"),
        (changed(parameters={"bin_width_ns": [1, 2]}), [], "parameter 'bin_width_ns' must be the same in all runs"),
        (changed(fixed={"bottom_depth": -3, **QUICK["fixed"]}, parameters={"altitude": [100, 200]}), [], "depth = -3"),
        (changed(parameters={"bottom_depth": [-3, -2]}), [], "all fail"),
        (changed(fixed={"aim_x": 3}, design={**QUICK["design"], "shots": 2}), [], "leave out aim_x"),
        (changed(scene="table9"), [], "table9"),
        (changed(), ["--scheduler", "nonsense://a"], "--scheduler = 'nonsense://a' cannot be reached"),
        (changed(), ["--workers", "0"], "--workers = 0 must lie between 1 and 1024"),
        (changed(), ["--workers", "2", "--row", "1"], "--workers and --row are alternatives"),
        (changed(), ["--row", "1", "--light", "maps"], "--row and --light are alternatives"),
        (changed(), ["--row", "12", "-o", str(tmp_path / "a.nc")], "--row = 12 must lie between 0 and 11"),
    ]
    for given_campaign, options, message in cases:
        given = [] if "-o" in options else ["-o", out]
        file = write_toml(tmp_path / "campaign.toml", given_campaign)
        assert_refused(run("campaign", file, *given, *options, "-q"), message)
        assert not out.exists()
    assert_refused(run("campaign", tmp_path / "none.toml", "-o", out), "none.toml")
    (tmp_path / "text.toml").write_text("scene : table1")
    assert_refused(run("campaign", tmp_path / "text.toml", "-o", out), "text.toml is not a TOML file")
    assert_refused(run("campaign", tmp_path, "-q"), "is no store of a campaign")
    before = files_of(quick)
    other = write_toml(tmp_path / "other.toml", {**campaign, "target_error": 0.2})
    assert_refused(run("campaign", other, "-o", quick, "-q"), "holds another campaign, or its scene has changed")
    assert_refused(run("campaign", quick, "-o", out, "-q"), "--output is fixed in the store")
    same = write_toml(tmp_path / "same.toml", campaign)
    assert_refused(run("campaign", same, "-o", quick, "--shard-size", 5, "-q"), "--shard-size = 5 must be that of", "6")
    assert files_of(quick) == before
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def shard_code(monkeypatch, arrays, start="pass"):
    """Replace what processes of shards do: a statement at their start, and an expression for the arrays of a run."""
    code = (
        f"import os, signal; from mitransient_lidar.campaigns import runs, shard\n{start}\n"
        f"arrays = runs.RunRenderer.arrays\nrender = lambda self, number, values: {arrays}\n"
        "runs.RunRenderer.arrays = render; shard.main()"
    )
    original = subprocess.Popen
    monkeypatch.setattr(
        shards.subprocess, "Popen", lambda command, **given: original([sys.executable, "-c", code], **given)
    )


@pytest.mark.slow
def test_an_error_of_the_program_is_told_and_its_run_stays_planned(quick, tmp_path, monkeypatch):
    path = planned_copy(quick, tmp_path / "bug.zarr")
    shard_code(monkeypatch, "{}[3] if number == 8 else arrays(self, number, values)")
    assert shards.render_in_process(str(path), 1) == (5, 0, "run 8: KeyError: 3")
    assert Store(path).status().tolist() == [PLANNED] * 6 + [DONE, DONE, PLANNED, DONE, DONE, DONE]
    log = (tmp_path / "bug.zarr.log").read_text()
    assert log.count("Traceback (most recent call last)") == 1
    assert "shard 1\n" in log


@pytest.mark.long
@pytest.mark.parametrize("deaths", [2, 3])
def test_a_process_that_dies_early_is_started_again(quick, tmp_path, monkeypatch, deaths):
    path = planned_copy(quick, tmp_path / "early.zarr")
    (tmp_path / "deaths").mkdir()
    place = str(tmp_path / "deaths")
    die = f"open({place!r} + f'/{{n}}', 'w').close(); os.kill(os.getpid(), 9)"
    start = f"n = len(os.listdir({place!r}))\nif n < {deaths}: {die}"
    shard_code(monkeypatch, "arrays(self, number, values)", start)
    outcome = shards.render_in_process(str(path), 1)
    assert outcome == ((6, 0, "") if deaths == 2 else (0, 0, "shard 1: the process ended by signal 9"))


@pytest.mark.slow
def test_shards_that_cannot_be_rendered_are_left(quick, tmp_path, monkeypatch):
    path = planned_copy(quick, tmp_path / "left.zarr")
    monkeypatch.setattr(workers, "render_in_process", lambda path, shard, *_: shards.Outcome(0, 0, "shard 0: lost"))
    must_refuse(r"2 of 2 shards are not complete, .* shard 0: lost; .*left\.zarr\.log", resume, path, workers=1)


@pytest.mark.long
def test_a_run_in_which_the_process_dies_fails_alone(quick, tmp_path, monkeypatch):
    path = planned_copy(quick, tmp_path / "dying.zarr")
    shard_code(monkeypatch, "os.abort() if number == 8 else arrays(self, number, values)")
    told = []
    assert shards.render_in_process(str(path), 1, report=lambda *counts: told.append(counts)) == (5, 1, "")
    assert told[-1] == (5, 1)
    store = Store(path)
    assert store.status(store.runs_of(1)).tolist() == [DONE, DONE, FAILED, DONE, DONE, DONE]
    assert store.errors()[8] == "the process ended by signal 6"
    np.testing.assert_array_equal(
        open_campaign(path)["waveform"].values[[6, 7, 9, 10, 11]],
        open_campaign(quick)["waveform"].values[[6, 7, 9, 10, 11]],
    )
    monkeypatch.undo()
    assert shards.render_in_process(str(path), 1) == (5, 1, "")
    assert shards.render_in_process(str(path), 1, retry=True) == (6, 0, "")
    np.testing.assert_array_equal(open_campaign(path)["waveform"].values[8], open_campaign(quick)["waveform"].values[8])


#: No new process imports this script, so that it needs no condition. Ctrl-C comes when three runs are done.
SCRIPT = """
import contextlib
import json, os, signal, sys
import mitransient_lidar
signal.signal(signal.SIGINT, signal.default_int_handler)
pressed = []
def watch(state):
    if state.done >= 3 and not pressed:
        pressed.append(state.done)
        os.kill(os.getpid(), signal.SIGINT)
try:
    mitransient_lidar.campaign(json.loads(sys.argv[1]), sys.argv[2], workers=1, shard_size=500, progress=watch)
except KeyboardInterrupt as error:
    print(pressed[0], error)
"""


@pytest.mark.long
def test_nothing_listens_on_a_port(quick, tmp_path):
    psutil = pytest.importorskip("psutil")
    path, seen = planned_copy(quick, tmp_path / "closed.zarr"), []

    def watch(state):
        here = psutil.Process()
        for process in (here, *here.children(recursive=True)):
            with contextlib.suppress(psutil.NoSuchProcess, psutil.ZombieProcess):
                seen.append([one for one in process.net_connections("inet") if one.status == psutil.CONN_LISTEN])

    before = [one for one in psutil.Process().net_connections("inet") if one.status == psutil.CONN_LISTEN]
    resume(path, workers=2, progress=watch)
    assert len(seen) > 2
    assert all(one in ([], before) for one in seen)


@pytest.mark.long
def test_a_script_without_a_main_guard_that_is_interrupted_keeps_runs_of_its_shard(campaign, tmp_path):
    path, script = tmp_path / "out.zarr", tmp_path / "script.py"
    script.write_text(SCRIPT)
    many = {**campaign, "design": {**campaign["design"], "count": 500}}
    done = subprocess.run(
        [sys.executable, str(script), json.dumps(many), str(path)], capture_output=True, text=True, check=True
    )
    told, text = done.stdout.split(maxsplit=1)
    kept = np.count_nonzero(Store(path).status() == DONE)
    assert text == f"interrupted after {kept} of 500 runs, which are kept; the same command goes on.\n"
    assert int(told) <= kept < 500
    assert done.stderr == ""
