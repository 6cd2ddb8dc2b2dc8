"""Campaigns on a Dask cluster: workers and schedulers that go, do not answer, or are of other versions."""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
from command_line import assert_refused, run
from quick_campaign import files_of, planned_copy
from rows import each_case, must_refuse

from mitransient_lidar._version import __version__
from mitransient_lidar.campaigns import shard as shards
from mitransient_lidar.campaigns import workers
from mitransient_lidar.campaigns.runs import own_versions
from mitransient_lidar.campaigns.store import DONE, PLANNED, Store
from mitransient_lidar.campaigns.sweep import campaign as run_campaign
from mitransient_lidar.campaigns.sweep import resume
from mitransient_lidar.core.errors import UserError

SILENT = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}


@pytest.fixture
def scheduler(tmp_path, request):
    """Dask scheduler in a process of its own: this process, and the file with its address."""
    file = tmp_path / "scheduler.json"
    code = f"{getattr(request, 'param', 'import sys')}; from distributed.cli.dask_scheduler import main; main()"
    command = [sys.executable, "-c", code, "--port", "0", "--host", "127.0.0.1"]
    with subprocess.Popen([*command, "--no-dashboard", "--scheduler-file", str(file)], **SILENT) as process:
        while not (file.exists() and file.read_text().endswith("}")):
            time.sleep(0.1)
        yield process, file
        process.kill()


def worker_command(file, folder, code="pass"):
    """Return the command of a worker that runs some code first."""
    code = f"{code}; from distributed.cli.dask_worker import main; main()"
    options = ["--scheduler-file", str(file), "--nthreads", "1", "--no-nanny", "--no-dashboard"]
    return [sys.executable, "-c", code, *options, "--local-directory", str(folder)]


#: A scheduler that soon takes a worker that does not answer for lost.
IMPATIENT = "import sys, dask; dask.config.set({'distributed.scheduler.worker-ttl': '5s'})"


@pytest.mark.long
@pytest.mark.parametrize("scheduler", [IMPATIENT], indirect=True)
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP])
def test_cluster_that_loses_a_worker(campaign, tmp_path, scheduler, end):
    """A scheduler and two workers as on a cluster; one is killed, or hangs, while it renders."""
    _, file = scheduler
    path = tmp_path / "cluster.zarr"
    nodes = [subprocess.Popen(worker_command(file, tmp_path), **SILENT) for _ in range(2)]
    try:
        seen = []

        def watch(state):
            seen.append(state.done)
            if state.done >= 2 and nodes[0].poll() is None:
                os.killpg(nodes[0].pid, end)

        address = json.loads(file.read_text())["address"]
        data = run_campaign(campaign, path, scheduler=address, shard_size=2, progress=watch)
        if end == signal.SIGKILL:
            assert nodes[0].wait(10) == -signal.SIGKILL
        assert (data["status"] == DONE).all()
        assert seen[-1] == 12
        alone = run_campaign(campaign, tmp_path / "alone.zarr", workers=1, shard_size=2)
        assert files_of(path) == files_of(tmp_path / "alone.zarr")
        assert np.array_equal(data["waveform"], alone["waveform"])
    finally:
        for worker in nodes:
            if worker.poll() is None:
                os.killpg(worker.pid, signal.SIGKILL)
            worker.wait()


@pytest.mark.long
def test_scheduler_that_is_lost(quick, tmp_path, scheduler):
    process, file = scheduler
    path = planned_copy(quick, tmp_path / "lost.zarr")
    address = json.loads(file.read_text())["address"]
    command = [sys.executable, "-m", "mitransient_lidar", "campaign", str(path), "--scheduler", address]
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

    def times_out(**_):
        raise OSError("Timed out trying to connect")

    with Client(json.loads(scheduler[1].read_text())["address"], set_as_default=False) as client:
        monkeypatch.setattr(client, "nthreads", times_out)
        with pytest.raises(OSError, match="Timed out trying to connect"):
            resume(path, scheduler=client)
        monkeypatch.setattr(client, "status", "connecting")
        must_refuse("the scheduler was lost: what is written is kept", resume, path, scheduler=client)
        monkeypatch.undo()
        # One that is stopped never answers.
        monkeypatch.setattr(workers, "_ANSWER_S", 1)
        monkeypatch.setattr(workers, "_CONNECT_S", 1)
        process = scheduler[0]
        process.send_signal(signal.SIGSTOP)
        goes_on = threading.Timer(30, process.send_signal, (signal.SIGCONT,))
        goes_on.start()
        must_refuse("the scheduler was lost: what is written is kept", resume, path, scheduler=client)
        assert not goes_on.finished.is_set()
        goes_on.cancel()
        process.send_signal(signal.SIGCONT)
    assert (Store(path).status() == PLANNED).all()


@pytest.mark.long
def test_a_worker_that_the_scheduler_cannot_reach(quick, tmp_path, scheduler):
    path = planned_copy(quick, tmp_path / "unreachable.zarr")
    nowhere = "tcp://127.0.0.1:9"
    command = worker_command(scheduler[1], tmp_path)
    with subprocess.Popen(
        [*command, "--listen-address", "tcp://127.0.0.1:0", "--contact-address", nowhere], **SILENT
    ) as worker:
        address = json.loads(scheduler[1].read_text())["address"]
        must_refuse(r"cannot reach its worker at tcp://127\.0\.0\.1:9", resume, path, scheduler=address)
        worker.kill()


@pytest.mark.long
def test_a_process_that_hangs(quick, tmp_path, monkeypatch):
    path = planned_copy(quick, tmp_path / "hung.zarr")
    monkeypatch.setattr(shards, "_LOOK_S", 0.2)
    processes, alarms = shards.Processes(), []

    def stop(done, failed):
        if not alarms:
            (process,) = processes._running
            process.send_signal(signal.SIGSTOP)
            # Without a watch, it ends as if nothing had been.
            alarms.append(threading.Timer(60, process.send_signal, (signal.SIGCONT,)))
            alarms[0].start()

    outcome = shards.render_in_process(str(path), 0, report=stop, processes=processes)
    alarms[0].cancel()
    assert outcome[:2] == (5, 0)
    assert re.fullmatch(r"run [01]: the process was ended after 6 s without processor time", outcome.left)
    assert "was ended after 6 s without processor time" in shards.log_path(path).read_text()
    assert resume(path, workers=1)["status"].values.tolist() == [DONE] * 12
    assert files_of(path) == files_of(quick)


@each_case(
    (psutil.STATUS_STOPPED, None, True),
    (psutil.STATUS_DISK_SLEEP, None, False),
    (None, psutil.NoSuchProcess(1), False),
    (None, psutil.AccessDenied(1), False),
)
def test_a_process_hangs_that_neither_computes_nor_waits_for_a_disk(state, error, hangs, monkeypatch, caplog):
    looks, enough = [], threading.Event()

    def cpu_times():
        looks.append(0)
        if error or len(looks) > 20:
            enough.set()
        if error:
            raise error
        return 1.0, 1.0

    monkeypatch.setattr(shards, "_LOOK_S", 0.001)
    monkeypatch.setattr(psutil, "Process", lambda pid: SimpleNamespace(cpu_times=cpu_times, status=lambda: state))
    monkeypatch.setattr(shards, "_MOST_STILL", 10)
    process = SimpleNamespace(pid=1, kill=enough.set)
    with shards._watching(process) as is_hung:
        assert enough.wait(60)
        while isinstance(error, psutil.AccessDenied) and not caplog.messages:
            time.sleep(0.01)
    assert is_hung.is_set() == hangs
    expected = ["process 1 of a shard is not watched: (pid=1)"] if isinstance(error, psutil.AccessDenied) else []
    assert caplog.messages == expected


#: A worker with another version, and one of a release whose workers do not know their versions.
OTHERS = {
    "0.1.9": (
        "from mitransient_lidar import _version; _version.__version__ = '0.1.9'",
        f"mitransient-lidar 0.1.9 instead of {__version__}",
    ),
    "unknown": (
        "from mitransient_lidar.campaigns import runs, workers; del runs.own_versions",
        "other files of mitransient-lidar",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["0.1.9"])
def test_workers_of_other_versions_are_refused(quick, tmp_path, scheduler, kind):
    path = planned_copy(quick, tmp_path / "other.zarr")
    with subprocess.Popen(worker_command(scheduler[1], tmp_path, OTHERS[kind][0]), **SILENT) as worker:
        text = rf"the worker at tcp://127\.0\.0\.1:\d+ has {re.escape(OTHERS[kind][1])}: all that"
        try:
            must_refuse(text, lambda: resume(path, scheduler=json.loads(scheduler[1].read_text())["address"]))
        finally:
            worker.kill()
    assert (Store(path).status() == PLANNED).all()


@pytest.mark.slow
def test_the_process_of_a_shard_compares_versions_too(quick, tmp_path):
    """Workers may join later, and files may change while a worker runs."""
    path = planned_copy(quick, tmp_path / "other.zarr")
    processes = shards.Processes({**own_versions(), "drjit": "1.4.9"}, "the worker at tcp://a:1")
    with pytest.raises(UserError, match=r"the worker at tcp://a:1 has drjit 1\.5\.0 instead of 1\.4\.9: all that"):
        shards.render_in_process(str(path), 0, processes=processes)
    assert (Store(path).status() == PLANNED).all()


@pytest.mark.slow
def test_other_servers_than_schedulers(quick):
    def serve():
        with contextlib.suppress(OSError):  # of the server's end
            while True:
                connection, _ = server.accept()
                with connection:
                    connection.recv(1000)
                    connection.sendall(b"HTTP/1.0 200 OK\r\n\r\nok")

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=serve, daemon=True).start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        text = f"--scheduler = '{address}' cannot be reached: give its address, tcp://HOST:PORT"
        assert_refused(run("campaign", quick, "-q", "--scheduler", address), text)


def test_a_scheduler_that_stops_while_it_starts(monkeypatch, tmp_path):
    """Dask asserts what a scheduler answers."""
    import distributed

    def stops(self, address, **options):
        raise AssertionError

    monkeypatch.setattr(distributed.Client, "__init__", stops)
    with pytest.raises(UserError, match="cannot be reached: give its address"):
        run_campaign({"scene": "table1"}, tmp_path / "out.zarr", scheduler="tcp://127.0.0.1:1")
