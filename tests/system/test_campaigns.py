"""Campaigns from their files to data sets: labels, failures, interruption, clusters, and single runs."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import significance
import xarray as xr
from command_line import assert_refused, run
from descriptions import assert_described
from few_paths import few_paths

from mitransient_lidar import results
from mitransient_lidar.campaigns import shard as shards
from mitransient_lidar.campaigns import workers
from mitransient_lidar.campaigns.store import DONE, FAILED, PLANNED, Store, open_campaign
from mitransient_lidar.campaigns.sweep import render_row, resume, sweep
from mitransient_lidar.core.errors import UserError

#: Runs that take a tenth of a second each.
QUICK = {
    "target_error": 0.3,
    "keep": ["waveform", "truth"],
    "fixed": {"spectrum": "flat", "layout": "1x1", "time_start_ns": 1380, "bin_count": 160},
    "parameters": {"bottom_depth": {"low": 2.0, "high": 9.0}, "bottom_reflectance": "0.02 * bottom_depth"},
    "design": {"kind": "sobol", "count": 12, "seed": 4},
}

FULL = {
    "target_error": 0.6,
    "keep": ["waveform", "stderr", "components", "echoes", "truth"],
    "derivatives": ["attenuation", "target_reflectance"],
    "receiver": "apd",
    "gain": "auto",
    "parameters": {"scattering": "0.6 * attenuation"},
    "design": {"file": "runs.csv", "shots": 2, "seed": 9},
}

#: The second run is impossible.
TABLE = """attenuation,target_depth,wind_speed
0.2,4.5,3
0.3,5,-6
0.35,5.5,6
"""


def write_toml(path, campaign):
    """Write a campaign as TOML, whose values are those of JSON but for tables."""

    def text(value):
        if isinstance(value, dict):
            return "{ " + ", ".join(f"{key} = {text(one)}" for key, one in value.items()) + " }"
        return json.dumps(value)

    sections = {name: value for name, value in campaign.items() if isinstance(value, dict)}
    lines = [f"{name} = {text(value)}" for name, value in campaign.items() if name not in sections]
    for name, section in sections.items():
        lines += [f"[{name}]", *(f"{key} = {text(value)}" for key, value in section.items())]
    path.write_text("\n".join(lines))
    return path


def files_of(store):
    """Return the contents of the files of a store by name."""
    return {path.relative_to(store): path.read_bytes() for path in Path(store).rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """The quick campaign, of a scene with few paths a pass."""
    return {"scene": str(few_paths("table1", tmp_path_factory.mktemp("scene"))), **QUICK}


def planned_copy(store, path):
    """Copy a store, without the status of its runs."""
    shutil.copytree(store, path)
    shutil.rmtree(path / "status" / "c")
    return path


@pytest.fixture(scope="module")
def quick(campaign, tmp_path_factory):
    """Store of the quick campaign, rendered in two shards."""
    path = tmp_path_factory.mktemp("campaign") / "quick.zarr"
    sweep(campaign, path, workers=1, shard_size=6)
    return path


@pytest.mark.long
def test_everything_that_can_be_kept(tmp_path):
    (tmp_path / "runs.csv").write_text(TABLE)
    told = []
    path = tmp_path / "full.zarr"
    campaign = write_toml(tmp_path / "full.toml", {"scene": str(few_paths("fig13_2x2", tmp_path)), **FULL})
    data = sweep(campaign, path, workers=1, progress=told.append).load()
    assert (told[-1].done, told[-1].planned, told[-1].failed, told[-1].unit) == (3, 3, 1, "run")
    assert data["status"].values.tolist() == [DONE, FAILED, DONE]
    assert data["error"].values.tolist()[::2] == ["", ""]
    assert data["error"].values[1].startswith("wind_speed = -6")
    assert np.isnan(data["waveform"].isel(run=1)).all()
    done = data.isel(run=[0, 2])
    for name in ("waveform", "waveform_stderr", "waveform_by_origin", "signal", "echo_depth_m", "true_bottom_depth"):
        assert np.isfinite(done[name].values).any(), name
    assert done["waveform"].dims == ("run", "shot", "pixel", "time")
    assert done["origin"].values.tolist() == ["surface", "water", "target", "bottom"]
    assert done["parameter"].values.tolist() == ["attenuation", "target_reflectance"]
    slopes = done["waveform_derivative"].sum(("pixel", "time"))
    assert np.all(slopes.sel(parameter="attenuation") < 0)
    assert np.all(slopes.sel(parameter="target_reflectance") > 0)
    # Inputs as coordinates; the truth follows from them.
    np.testing.assert_allclose(done["scattering"], 0.6 * np.array([0.2, 0.35]))
    assert set(done["waveform"].coords) >= {
        "attenuation",
        "target_depth",
        "wind_speed",
        "surface_seed",
        "pixel",
        "time",
    }
    assert len(np.unique(done["surface_seed"])) == 2
    np.testing.assert_allclose(done["true_bottom_depth"], 12, atol=1e-3)
    heights = done["true_bottom_depth_below_surface"] - done["true_bottom_depth"]
    np.testing.assert_allclose(heights, done["true_surface_height"], atol=1e-12)
    np.testing.assert_allclose(done["true_attenuation"], done["attenuation"].broadcast_like(done["true_attenuation"]))
    assert_described(data)
    assert len(np.unique(done["aim_x"])) == 4
    # The parts add up to the whole, and come from where they should.
    np.testing.assert_allclose(done["waveform_by_origin"].sum("origin"), done["waveform"], rtol=1e-5, atol=1e-12)
    first = done["waveform_by_origin"].isel(run=0, shot=0).sum("pixel")
    peaks = first["time"].values[first.argmax("time").values]
    assert peaks[0] < peaks[2] < peaks[3]
    # A run alone, in this process, is the same to the bit, unless the seeds of this process are shifted.
    alone = render_row(path, 2)
    if significance.seed_shift == 0:
        stored = data["waveform"].isel(run=2)
        np.testing.assert_array_equal(alone["waveform"].values.astype(np.float32), stored.values)
    assert float(alone.attrs["scene.attenuation"]) == 0.35
    # Analysis commands read it, also from the campaign's file.
    out = run("sweep", campaign, "--row", 2, "-o", tmp_path / "run.nc", "-q")
    assert out.exit_code == 0, out.stderr
    np.testing.assert_array_equal(results.open(tmp_path / "run.nc")["waveform"], alone["waveform"])
    assert run("waveforms", tmp_path / "run.nc", "--table").exit_code == 0
    out = run("sweep", path, "--show", "-o", tmp_path / "run.png")
    assert out.exit_code == 0, out.stderr
    assert "3 runs: 2 done, 1 failed, 0 planned\nfailed 1, the first run 1: wind_speed = -6" in out.stdout
    assert (tmp_path / "run.png").stat().st_size > 20_000


@pytest.mark.slow
def test_opening_needs_no_consolidated_metadata(quick):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = xr.open_zarr(quick, consolidated=False).load()
    assert data["waveform"].dims == ("run", "pixel", "time")
    np.testing.assert_allclose(data["true_bottom_depth"], data["bottom_depth"], atol=2e-4)
    np.testing.assert_allclose(data["bottom_reflectance"], 0.02 * data["bottom_depth"])
    # Passes end when the mean of the two middle bins has reached 0.3; stated is the higher of these.
    assert (data["error_median"] < 0.35).all()
    assert np.isfinite(data["waveform"].values).all()


@pytest.mark.long
def test_same_bits_whatever_shards_workers_and_order(campaign, tmp_path):
    first = sweep(campaign, tmp_path / "first.zarr", workers=2, shard_size=6).load()
    other = sweep(campaign, tmp_path / "other.zarr", workers=1, shard_size=17).load()
    for name in first.variables:
        np.testing.assert_array_equal(first[name].values, other[name].values, err_msg=str(name))


@pytest.mark.slow
def test_a_complete_campaign_is_left_as_it_is(campaign, quick):
    before = files_of(quick)
    resume(quick, workers=1)
    sweep(campaign, quick, workers=1)
    assert files_of(quick) == before


@pytest.mark.long
def test_killed_and_resumed_it_has_the_bits_of_an_uninterrupted_one(campaign, quick, tmp_path):
    path = tmp_path / "killed.zarr"
    file = write_toml(tmp_path / "quick.toml", campaign)
    command = [sys.executable, "-m", "mitransient_lidar", "sweep", str(file), "-o", str(path)]
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
    out = run("sweep", path, "--workers", 2, "-q")
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
        if b"mitransient_lidar.campaigns.shard" in command and variable in environment and state != "Z":
            found.append(int(entry.name))
    return found


SILENT = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}


@pytest.fixture
def scheduler(tmp_path):
    """Dask scheduler in a process of its own: this process, and the file with its address."""
    file = tmp_path / "scheduler.json"
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--host", "127.0.0.1"]
    with subprocess.Popen([*command, "--no-dashboard", "--scheduler-file", str(file)], **SILENT) as process:
        while not (file.exists() and file.read_text().endswith("}")):
            time.sleep(0.1)
        yield process, file
        process.kill()


@pytest.mark.long
def test_cluster_that_loses_a_worker(campaign, tmp_path, scheduler):
    """A scheduler and two workers as on a cluster; one is killed while it renders."""
    _, file = scheduler
    path = tmp_path / "cluster.zarr"
    command = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(file), "--nthreads", "1"]
    command += ["--no-nanny", "--no-dashboard", "--local-directory", str(tmp_path)]
    nodes = [subprocess.Popen(command, **SILENT) for _ in range(2)]
    try:
        seen = []

        def watch(state):
            seen.append(state.done)
            if state.done >= 2 and nodes[0].poll() is None:
                os.killpg(nodes[0].pid, signal.SIGKILL)

        address = json.loads(file.read_text())["address"]
        data = sweep(campaign, path, scheduler=address, shard_size=2, progress=watch)
        assert nodes[0].wait(10) == -signal.SIGKILL
        assert (data["status"] == DONE).all()
        assert seen[-1] == 12
        alone = sweep(campaign, tmp_path / "alone.zarr", workers=1, shard_size=2)
        assert files_of(path) == files_of(tmp_path / "alone.zarr")
        assert np.array_equal(data["waveform"], alone["waveform"])
    finally:
        for worker in nodes:
            if worker.poll() is None:
                os.killpg(worker.pid, signal.SIGKILL)
            worker.wait()


@pytest.mark.slow
def test_scheduler_that_is_lost(quick, tmp_path, scheduler):
    process, file = scheduler
    path = planned_copy(quick, tmp_path / "lost.zarr")
    address = json.loads(file.read_text())["address"]
    command = [sys.executable, "-m", "mitransient_lidar", "sweep", str(path), "--scheduler", address]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as client:
        assert "the scheduler has no workers: the campaign waits" in client.stderr.readline()
        process.kill()
        _, told = client.communicate(timeout=60)
    assert client.returncode == 2
    # Where the loss is noticed late, progress is told before.
    told = [line for line in told.splitlines() if not line.startswith("run 0/")]
    assert told == ["the scheduler was lost: what is written is kept, and the same command goes on"]


@pytest.mark.slow
def test_connections_that_time_out(quick, tmp_path, scheduler, monkeypatch):
    """Any call may notice first that the scheduler is lost; an error with a scheduler that is there is another one."""
    from distributed import Client

    path = planned_copy(quick, tmp_path / "lost.zarr")

    def times_out():
        raise OSError("Timed out trying to connect")

    with Client(json.loads(scheduler[1].read_text())["address"], set_as_default=False) as client:
        monkeypatch.setattr(client, "nthreads", times_out)
        with pytest.raises(OSError, match="Timed out trying to connect"):
            resume(path, scheduler=client)
        monkeypatch.setattr(client, "status", "connecting")
        with pytest.raises(UserError, match="the scheduler was lost: what is written is kept"):
            resume(path, scheduler=client)
        monkeypatch.undo()
    assert (Store(path).status() == PLANNED).all()


@pytest.mark.long
def test_interruption_keeps_what_is_written(campaign, tmp_path):
    path, file = tmp_path / "out.zarr", write_toml(tmp_path / "quick.toml", campaign)
    command = [sys.executable, "-m", "mitransient_lidar", "sweep", str(file), "-o", str(path)]
    with subprocess.Popen(
        [*command, "--workers", "1", "--shard-size", "3"], start_new_session=True, stderr=subprocess.PIPE, text=True
    ) as process:
        while process.poll() is None and not (path.exists() and (Store(path).status() == DONE).any()):
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=60)
    assert process.returncode == 130
    assert told.splitlines()[-1].startswith("interrupted after ")
    assert "Traceback" not in told
    assert 0 < np.count_nonzero(Store(path).status() == DONE) < 12


@pytest.mark.slow
def test_invalid_use_leaves_nothing(campaign, quick, tmp_path):
    def changed(**sections):
        return {**campaign, **sections}

    out = tmp_path / "out.zarr"
    cases = [
        (changed(fixed={"bottom_dept": 3}), [], "parameter 'bottom_dept' is not one of scene"),
        (changed(parameters={"altitude": {"low": 3, "high": 3}}), [], "altitude has the empty range 3 to 3"),
        (changed(parameters={"bin_width_ns": [1, 2]}), [], "parameter 'bin_width_ns' must be the same in all runs"),
        (changed(fixed={"bottom_depth": -3, **QUICK["fixed"]}, parameters={"altitude": [100, 200]}), [], "all fail"),
        (changed(fixed={"aim_x": 3}, design={**QUICK["design"], "shots": 2}), [], "leave out aim_x"),
        (changed(scene="table9"), [], "table9"),
        (changed(), ["--scheduler", "nonsense://a"], "scheduler = 'nonsense://a' cannot be reached"),
        (changed(), ["--workers", "0"], "workers = 0 must lie between 1 and 1024"),
        (changed(), ["--workers", "2", "--row", "1"], "--workers and --row are alternatives"),
        (changed(), ["--row", "12", "-o", str(tmp_path / "a.nc")], "row = 12 must lie between 0 and 11"),
    ]
    for given_campaign, options, message in cases:
        given = [] if "-o" in options else ["-o", out]
        file = write_toml(tmp_path / "campaign.toml", given_campaign)
        assert_refused(run("sweep", file, *given, *options, "-q"), message)
        assert not out.exists()
    assert_refused(run("sweep", tmp_path / "none.toml", "-o", out), "none.toml")
    (tmp_path / "text.toml").write_text("scene : table1")
    assert_refused(run("sweep", tmp_path / "text.toml", "-o", out), "text.toml is not a TOML file")
    assert_refused(run("sweep", tmp_path, "-q"), "is no store of a campaign")
    before = files_of(quick)
    other = write_toml(tmp_path / "other.toml", {**campaign, "target_error": 0.2})
    assert_refused(run("sweep", other, "-o", quick, "-q"), "holds another campaign, or its scene has changed")
    assert_refused(run("sweep", quick, "-o", out, "-q"), "--output is fixed in the store")
    same = write_toml(tmp_path / "same.toml", campaign)
    assert_refused(run("sweep", same, "-o", quick, "--shard-size", 5, "-q"), "shard_size = 5 must be that of", "6")
    assert files_of(quick) == before
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.long
def test_scheduler_that_does_not_answer(campaign, tmp_path):
    """A quarter of a minute passes until it is given up."""
    out, file = tmp_path / "out.zarr", write_toml(tmp_path / "campaign.toml", campaign)
    done = run("sweep", file, "-o", out, "--scheduler", "tcp://127.0.0.1:9", "-q")
    assert_refused(done, "scheduler = 'tcp://127.0.0.1:9' cannot be reached")
    assert not out.exists()


@pytest.mark.long
def test_disk_that_is_full(quick, tmp_path):
    """Files of a limited size stand for a full disk: chunks cannot be written, and no status says that they were."""
    path = planned_copy(quick, tmp_path / "full.zarr")
    done = subprocess.run(
        [sys.executable, "-m", "mitransient_lidar", "sweep", str(path), "--workers", "1", "-q"],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000)),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert done.stderr == f"cannot write {path}: File too large.\n"
    assert (Store(path).status() == PLANNED).all()


def shard_code(monkeypatch, arrays, start="pass"):
    """Replace what processes of shards do: a statement at their start, and an expression for the arrays of a run."""
    code = (
        f"import os, signal; from mitransient_lidar.campaigns import runs, shard\n{start}\n"
        f"arrays = runs.RunRenderer.arrays\nrender = lambda self, number, values: {arrays}\n"
        "runs.RunRenderer.arrays = render; shard._main()"
    )
    original = subprocess.Popen
    monkeypatch.setattr(
        shards.subprocess, "Popen", lambda command, **given: original([sys.executable, "-c", code], **given)
    )


@pytest.mark.slow
def test_an_error_of_the_program_is_told_and_its_run_stays_planned(quick, tmp_path, monkeypatch):
    """It once was tried twice, and stored as a failure of the run without its traceback."""
    path = planned_copy(quick, tmp_path / "bug.zarr")
    shard_code(monkeypatch, "{}[3] if number == 8 else arrays(self, number, values)")
    assert shards.render_in_process(str(path), 1) == (5, 0, "run 8: KeyError: 3")
    assert Store(path).status().tolist() == [PLANNED] * 6 + [DONE, DONE, PLANNED, DONE, DONE, DONE]
    log = (tmp_path / "bug.zarr.log").read_text()
    assert log.count("Traceback (most recent call last)") == 1
    assert "shard 1\n" in log


@pytest.mark.parametrize("deaths", [pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.long)])
def test_a_process_that_dies_early_is_started_again(quick, tmp_path, monkeypatch, deaths):
    """Twice; it once ended the campaign."""
    path = planned_copy(quick, tmp_path / "early.zarr")
    (tmp_path / "deaths").mkdir()
    place = str(tmp_path / "deaths")
    die = f"open({place!r} + f'/{{n}}', 'w').close(); os.kill(os.getpid(), 9)"
    start = f"n = len(os.listdir({place!r}))\nif n < {deaths}: {die}"
    shard_code(monkeypatch, "arrays(self, number, values)", start)
    outcome = shards.render_in_process(str(path), 1)
    assert outcome == ((6, 0, "") if deaths == 2 else (0, 0, "shard 1: the process ended by signal 9"))


@pytest.mark.long
def test_shards_that_cannot_be_rendered_are_left(quick, tmp_path, monkeypatch):
    """The others are rendered, and the command says which ones to look at."""
    path = planned_copy(quick, tmp_path / "left.zarr")
    original = shards.render_in_process

    def render(path, shard, *rest):
        return shards.Outcome(0, 0, "shard 0: lost") if shard == 0 else original(path, shard, *rest)

    monkeypatch.setattr(workers, "render_in_process", render)
    with pytest.raises(
        UserError, match=r"1 of 2 shards are not complete, the first for shard 0: lost; .*left\.zarr\.log"
    ):
        resume(path, workers=1)
    assert Store(path).status().tolist() == [PLANNED] * 6 + [DONE] * 6


@pytest.mark.long
def test_a_worker_that_the_scheduler_cannot_reach(quick, tmp_path, scheduler):
    """The campaign once waited for ever."""
    path = planned_copy(quick, tmp_path / "unreachable.zarr")
    nowhere = "tcp://127.0.0.1:9"
    command = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(scheduler[1])]
    command += ["--no-nanny", "--no-dashboard", "--local-directory", str(tmp_path), "--nthreads", "1"]
    with subprocess.Popen(
        [*command, "--listen-address", "tcp://127.0.0.1:0", "--contact-address", nowhere], **SILENT
    ) as worker:
        address = json.loads(scheduler[1].read_text())["address"]
        with pytest.raises(UserError, match=r"cannot reach its worker at tcp://127\.0\.0\.1:9"):
            resume(path, scheduler=address)
        worker.kill()


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
    assert shards.render_in_process(str(path), 1, retry=True) == (6, 0)
    np.testing.assert_array_equal(open_campaign(path)["waveform"].values[8], open_campaign(quick)["waveform"].values[8])
