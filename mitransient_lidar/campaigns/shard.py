"""Rendering of a campaign's shard in its own process.

The process ends with its shard, and with it the memory that Mitsuba does not return. It also ends when its parent
process does, and after a program error, since Dr.Jit's recording is then in an unknown state. A hanging process is
ended. Its standard input contains the store, the shard, the required versions, and the runs that are not to be
rendered, with the reasons; it writes one line of JSON for each event: ``begin`` and ``end`` of a run, ``done``,
``error``, ``bug``, or ``differs`` for other versions. After SIGTERM it writes its completed runs, and ends.

A log beside the store, ``NAME.zarr.log``, holds the messages of processes that ended before their shard.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
import numpy.typing as npt
import psutil

from mitransient_lidar.campaigns.runs import Array, Renderer, difference, other_versions, own_versions
from mitransient_lidar.campaigns.store import DONE, FAILED, PLANNED, Store
from mitransient_lidar.core.errors import LINES, UserError, printable, raise_if_out_of_memory
from mitransient_lidar.core.files import open_log

_LOG = logging.getLogger(__name__)

#: Program of a process. xarray would import Dask for its first dataset, which takes 1.6 s.
_PROGRAM = "import sys; sys.modules['dask'] = None; from mitransient_lidar.campaigns.shard import main; main()"

_INTERVAL_S = 60.0  #: Time between two writes of a shard that is not finished [s].

#: Number of times that the process may end while it renders a run before this run has failed, or before its first run.
_MOST_DEATHS, _MOST_STARTS = 2, 3

_MOST_BUGS = 3  #: Number of runs with a program error, or that hang, after which the rest of a shard is left.
_LONGEST_REASON = 200  #: Longest program error reason; the log contains the traceback.

#: Environment variables with thread numbers for numerical libraries.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_WRITE_S = 10.0  #: Time for a process to write the runs that it has when the campaign ends [s].

#: Time between two checks of a process [s], and number of checks without any processor time after which it hangs;
#: checks while it waits for a disk, which may be a server's, do not count.
_LOOK_S, _MOST_STILL = 10.0, 30

Report = Callable[[int, int], None]


class Outcome(NamedTuple):
    """Numbers of done and failed runs in a shard, and the reason why the others are left, empty if none are."""

    done: int
    failed: int
    left: str = ""


class _End(NamedTuple):
    """Process end before its shard's end: the run in progress, the reason, and whether the run is left.

    Runs that meet a bug or hang are left: they stay planned.
    """

    run: int | None
    reason: str
    is_left: bool = False


class Processes:
    """Processes of a campaign's shards, which `end` ends together.

    `versions`: required versions, as from `runs.own_versions`; by default any. `place`: their machine, for
    messages.
    """

    def __init__(self, versions: Mapping[str, str] | None = None, place: str = "this machine") -> None:
        self.versions, self.place = dict(versions or {}), place
        self.is_ended = False
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[str]] = set()

    @contextlib.contextmanager
    def holding(self, process: subprocess.Popen[str]) -> Iterator[None]:
        """Context in which a process is one of those that `end` ends."""
        with self._lock:
            self._running.add(process)
            if self.is_ended:
                process.kill()
        try:
            yield
        finally:
            process.kill()
            with self._lock:
                self._running.discard(process)

    def end(self) -> None:
        """End the processes, which write the runs that they have if that takes at most 10 s; start no others."""
        with self._lock:
            self.is_ended = True
            running = list(self._running)
        until = time.monotonic() + _WRITE_S
        try:
            for process in running:
                process.terminate()
            for process in running:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(max(until - time.monotonic(), 0))
        finally:
            for process in running:
                process.kill()
                process.wait()


def render_in_process(
    path: str, shard: int, retry: bool = False, report: Report | None = None, processes: Processes | None = None
) -> Outcome:
    """Render a shard's unfinished runs in a new process.

    A run in which the process ends twice has failed. Runs that meet an error of the program or hang stay planned, and
    so do all where the process ends three times before the first run.

    Raises UserError if the store cannot be read or written, or the process has other versions than it must have.

    `path`: store folder. `shard`: shard number. `retry`: whether to render runs that have failed, too. `report`: called
    with the numbers of runs done and failed after each run. `processes`: processes that the new one belongs to.
    """
    processes = processes or Processes()
    reasons: dict[int, str] = {}
    left: dict[int, str] = {}
    deaths: Counter[int | None] = Counter()
    while True:
        order = {"store": path, "shard": shard, "retry": retry, "failed": reasons, "left": list(left)}
        ended = _one_process({**order, "versions": processes.versions}, report, processes)
        if isinstance(ended, Outcome):
            return ended._replace(left=next(iter(left.values()), ""))
        if processes.is_ended:
            return Outcome(0, 0, f"shard {shard}: the campaign was ended")
        deaths[ended.run] += 1
        if ended.run is not None and ended.is_left:
            left[ended.run] = f"run {ended.run}: {ended.reason}"
            if len(left) < _MOST_BUGS:
                continue
        elif ended.run is not None:
            if deaths[ended.run] >= _MOST_DEATHS:
                reasons[ended.run] = ended.reason
            continue
        elif deaths[None] < _MOST_STARTS:
            continue
        status = Store(path).status(Store(path).runs_of(shard))
        done, failed = _counts(status)
        return Outcome(done, failed, next(iter(left.values()), f"shard {shard}: {ended.reason}"))


def log_path(store: str | os.PathLike[str]) -> Path:
    """Return the path of a store's log."""
    path = Path(store)
    return path.with_name(f"{path.name}.log")


def _log(store: str, shard: int, text: str) -> None:
    """Add a process's report to its store's log, which must not be a link; the run has its reason anyway."""
    with contextlib.suppress(OSError, UserError), open_log(log_path(store)) as file:
        file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} shard {shard}\n{printable(text.rstrip(), kept=LINES)}\n\n")


def _one_process(order: dict[str, Any], report: Report | None, processes: Processes) -> Outcome | _End:
    """Return the outcome of a shard, or how its process ended before."""
    environment = {**os.environ, **dict.fromkeys(_THREADS, "1")}
    # Its own session: Ctrl-C is for the process that has started it.
    with subprocess.Popen(
        [sys.executable, "-c", _PROGRAM],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    ) as process:
        told: list[str] = []
        reader = threading.Thread(target=lambda: told.extend(process.stderr or ()), daemon=True)
        reader.start()
        with processes.holding(process), _watching(process) as is_hung:
            found = _events(process, order, report, processes.place)
        code = process.wait()
        reader.join(timeout=5)
        if isinstance(found, (Outcome, _End)):
            return found
        last = " ".join((told or ["without a message"])[-1].split())
        why = f"ended by signal {-code}" if code < 0 else f"ended with exit code {code}: {last}"
        if is_hung.is_set():
            why = f"was ended after {_MOST_STILL * _LOOK_S:.0f} s without processor time"
            told.append(f"the process {why}")
        if told:
            _log(order["store"], order["shard"], "".join(told))
        return _End(found, f"the process {why}", is_hung.is_set())


@contextlib.contextmanager
def _watching(process: subprocess.Popen[str]) -> Iterator[threading.Event]:
    """Context in which a process that uses no processor time for 5 minutes is ended; yield whether it was.

    Looks are counted, not time: this process may be stopped, too.
    """
    is_over, is_hung = threading.Event(), threading.Event()

    def watch() -> None:
        still, before = 0, -1.0
        try:
            watched = psutil.Process(process.pid)
            while still < _MOST_STILL:
                if is_over.wait(_LOOK_S):
                    return
                now = sum(watched.cpu_times()[:2])
                if now != before:
                    still, before = 0, now
                elif watched.status() != psutil.STATUS_DISK_SLEEP:
                    still += 1
        except psutil.NoSuchProcess:
            return
        except psutil.Error as error:
            _LOG.warning("process %d of a shard is not watched: %s", process.pid, error)
            return
        is_hung.set()
        process.kill()

    threading.Thread(target=watch, daemon=True).start()
    try:
        yield is_hung
    finally:
        is_over.set()


def _events(
    process: subprocess.Popen[str], order: dict[str, Any], report: Report | None, place: str
) -> Outcome | _End | int | None:
    """Return a process's report on its end; for one that ends before, the run in progress."""
    assert process.stdin is not None
    assert process.stdout is not None
    run: int | None = None
    with contextlib.suppress(BrokenPipeError):
        process.stdin.write(json.dumps(order) + "\n")
        process.stdin.flush()
        for line in process.stdout:
            if not line.startswith("{"):
                continue
            event = json.loads(line)
            if "done" in event:
                return Outcome(event["done"], event["failed"])
            if "error" in event:
                raise UserError(event["error"])
            if "differs" in event:
                raise UserError(other_versions(place, event["differs"]))
            if "bug" in event:
                _log(order["store"], order["shard"], event["traceback"])
                return _End(run, event["bug"], is_left=True)
            run = event.get("begin", run)
            if "end" in event and report is not None:
                report(*event["end"])
    return run


def render_shard(
    path: str,
    shard: int,
    retry: bool,
    failed: dict[int, str],
    left: set[int],
    tell: Callable[..., None],
    is_ended: Callable[[], bool],
) -> None:
    """Render the runs of a shard that are not done nor to be left, and write them; none more once it is ended."""
    store = Store(path)
    renderer, runs = store.renderer(), store.runs_of(shard)
    inputs = store.inputs(runs)
    status, errors, arrays = store.read(shard)
    if retry:
        status[status == FAILED] = PLANNED
    written = time.monotonic()
    for rows in renderer.batches(inputs):
        if is_ended():
            store.write(shard, status, errors, arrays)
            return
        first = runs.start + rows[0]
        if first in left or not np.any(status[rows] == PLANNED):
            continue
        tell(begin=first)
        numbers, columns = runs.start + np.array(rows), {name: column[rows] for name, column in inputs.items()}
        for name, value in renderer.own_inputs(numbers, columns).items():
            if name in arrays:
                arrays[name][rows] = value
        try:
            if first in failed:
                raise UserError(failed[first])
            found = _arrays(renderer, numbers, columns)
            for name, array in found.items():
                if name not in arrays or array.values.shape[1:] != arrays[name].shape[1:]:
                    raise UserError(
                        f"{name} of the {renderer.unit} has the shape {array.values.shape[1:]}, and that of the first "
                        f"{renderer.unit} another one: all must have the same pixels and origins of light"
                    )
            for name, array in found.items():
                arrays[name][rows] = array.values
            status[rows], errors[rows] = DONE, ""
        except UserError as error:
            status[rows], errors[rows] = FAILED, " ".join(str(error).split())
        except Exception:
            store.write(shard, status, errors, arrays)
            raise
        tell(end=_counts(status))
        if time.monotonic() - written > _INTERVAL_S:
            store.write(shard, status, errors, arrays)
            written = time.monotonic()
    store.write(shard, status, errors, arrays)
    done, without = _counts(status)
    tell(done=done, failed=without)


def _counts(status: npt.NDArray[np.uint8]) -> list[int]:
    """Return the numbers of runs that are done and that have failed."""
    return [int(np.count_nonzero(status == value)) for value in (DONE, FAILED)]


def _arrays(
    renderer: Renderer, numbers: npt.NDArray[np.int64], inputs: Mapping[str, npt.NDArray[Any]]
) -> dict[str, Array]:
    """Return the arrays of runs that are rendered together; raise `UserError` where memory runs out."""
    try:
        return renderer.stacked(numbers, inputs)
    except (MemoryError, RuntimeError) as error:
        raise_if_out_of_memory(error)
        raise


def main() -> None:
    """Render the shard that standard input names."""
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    order = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # A run's messages belong to its result; a campaign has thousands.
    logging.getLogger("mitransient_lidar").setLevel(logging.ERROR)
    dr.set_thread_count(1)
    # Mitsuba may write to standard output, too.
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def tell(**event: Any) -> None:
        out.write(json.dumps(event) + "\n")
        out.flush()

    try:
        if differs := difference(order["versions"], own_versions()):
            tell(differs=differs)
            return
        failed = {int(run): reason for run, reason in order["failed"].items()}
        left = set(order["left"])
        render_shard(order["store"], order["shard"], order["retry"], failed, left, tell, ended.is_set)
    except UserError as error:
        tell(error=str(error))
    except Exception as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        tell(bug=reason[:_LONGEST_REASON], traceback=traceback.format_exc())


def _end_with_parent() -> None:
    """End this process when its standard input does."""
    sys.stdin.read()
    os._exit(1)
