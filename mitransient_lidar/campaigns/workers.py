"""Campaign workers, which render shards: threads in this process, or the workers in a Dask cluster.

Each shard is rendered in its own process on its worker's machine. Threads need no connection, so that nothing listens
on a port on this machine.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import logging
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Protocol

from mitransient_lidar.campaigns.runs import difference, other_versions, own_versions
from mitransient_lidar.campaigns.shard import Outcome, Processes, render_in_process
from mitransient_lidar.core.errors import UserError

if TYPE_CHECKING:
    from distributed import Client

_LOG = logging.getLogger(__name__)

#: Time between two reports of a shard, and time to wait for a scheduler to connect [s].
REPORT_S, _CONNECT_S = 1.0, 15.0

_ANSWER_S = 300.0  #: Time after which a scheduler that does not answer is lost [s].

_LOST = "the scheduler was lost: what is written is kept, and the same command goes on"

#: Function that takes a shard and its numbers of runs done and failed.
Tell = Callable[[int, int, int], None]

_PROCESSES: dict[str, Processes] = {}  #: Campaign processes on this cluster worker.


class Workers(Protocol):
    """Workers that render a store's shards."""

    def count(self) -> int:
        """Return how many shards they render at a time; raise `UserError` for one that cannot be used."""

    def submit(self, shard: int) -> Future[Outcome | str]:
        """Return a shard's outcome when it is rendered, or a `UserError` message."""


class _Threads:
    """Threads in this process."""

    def __init__(self, number: int, path: str, retry_failed: bool, tell: Tell, processes: Processes) -> None:
        self._number, self._path, self._retry = number, path, retry_failed
        self._tell, self._processes = tell, processes
        self._pool = ThreadPoolExecutor(number)

    def count(self) -> int:
        return self._number

    def submit(self, shard: int) -> Future[Outcome | str]:
        return self._pool.submit(_outcome, self._path, shard, self._retry, self._tell, self._processes)

    def end(self) -> None:
        """End the shard processes, and then the threads."""
        try:
            self._processes.end()
        finally:
            self._pool.shutdown(cancel_futures=True)


class _Cluster:
    """Workers of a Dask cluster, which may come and go."""

    def __init__(self, client: Client, path: str, retry_failed: bool, tell: Tell) -> None:
        self._client, self._path, self._retry = client, path, retry_failed
        self._topic = f"campaign-{uuid.uuid4().hex}"
        self._versions = own_versions()
        self._reached: set[str] = set()
        self._executor = client.get_executor(pure=False)
        client.subscribe_topic(self._topic, lambda event: tell(*event[1]))

    def wait(self) -> None:
        """Wait for the first worker."""
        if not self._threads():
            _LOG.warning("the scheduler has no workers: the campaign waits for the first one")
            while not self._threads():
                time.sleep(REPORT_S)

    def count(self) -> int:
        threads = self._threads()
        self._check(set(threads) - self._reached)
        self._reached.update(threads)
        return max(sum(threads.values()), 1)

    def submit(self, shard: int) -> Future[Outcome | str]:
        key = f"shard-{shard}-{self._topic}"
        found: Future[Outcome | str] = self._executor.submit(
            _task, self._path, shard, self._retry, self._topic, self._versions, key=key
        )
        return found

    def end(self) -> None:
        """End the processes of shards on all workers; they stay where the scheduler is lost."""
        if self._client.status != "running":
            return
        with contextlib.suppress(OSError):
            self._executor.shutdown(wait=False)
            if self._client.nthreads(callback_timeout=_CONNECT_S):
                self._client.run(_end, self._topic, on_error="return")
            self._client.unsubscribe_topic(self._topic)

    def _threads(self) -> dict[str, int]:
        """Return the threads of each worker; raise `UserError` where the scheduler does not answer."""
        try:
            threads: dict[str, int] = self._client.nthreads(callback_timeout=_ANSWER_S)
        except TimeoutError as error:
            raise UserError(_LOST) from error
        return threads

    def _check(self, addresses: set[str]) -> None:
        """Raise `UserError` for workers with other versions, and those that the scheduler cannot reach."""
        if not addresses:
            return
        answers = self._client.run(own_versions, workers=sorted(addresses), on_error="return")
        for address, answer in answers.items():
            place = f"the worker at {address}"
            if isinstance(answer, Mapping):
                if differs := difference(self._versions, answer):
                    raise UserError(other_versions(place, differs))
            elif address not in self._threads():
                continue
            elif isinstance(answer, OSError):
                raise UserError(
                    f"the scheduler cannot reach its worker at {address}: check its address and the firewall"
                ) from answer
            else:
                # Releases up to 0.2 do not state their versions.
                name = "mitransient-lidar"
                found = self._client.run(importlib.metadata.version, name, workers=[address], on_error="return")
                version, own = found.get(address), self._versions[name]
                differs = f"other files of {name}" if version == own else f"{name} {version} instead of {own}"
                raise UserError(other_versions(place, differs))


@contextlib.contextmanager
def on_this_machine(number: int, path: str, retry_failed: bool, tell: Tell) -> Iterator[Workers]:
    """Yield workers on this machine; processes that still render at the end of the context end with it."""
    workers = _Threads(number, path, retry_failed, tell, Processes(own_versions()))
    try:
        yield workers
    finally:
        workers.end()


@contextlib.contextmanager
def on_cluster(client: Client, path: str, retry_failed: bool, tell: Tell) -> Iterator[Workers]:
    """Yield the workers in a Dask cluster; processes that still render at the end of the context end with it.

    Raises UserError if the scheduler is lost or has other versions, or a shard has lost its worker too often.
    """
    from distributed import KilledWorker
    from distributed.comm import CommClosedError

    try:
        workers = _Cluster(client, path, retry_failed, tell)
        try:
            workers.wait()
            yield workers
        finally:
            workers.end()
    except KilledWorker as error:
        raise UserError(f"{error.task} has lost its worker too often: see the log of the scheduler") from error
    except RuntimeError as error:
        if "deserialization of the task graph" not in str(error):
            raise
        raise UserError(
            "the scheduler has no mitransient-lidar, or another version: it must have the same as its workers"
        ) from error
    except (CancelledError, OSError) as error:
        # A connection that times out is an OSError, and so may be a worker's own error.
        if client.status == "running" and not isinstance(error, (CancelledError, CommClosedError)):
            raise
        raise UserError(_LOST) from error


@contextlib.contextmanager
def connected(scheduler: Client | str) -> Iterator[Client]:
    """Yield a client of a running scheduler; raise `UserError` if there is none at its address."""
    from distributed import Client

    if isinstance(scheduler, Client):
        yield scheduler
        return
    for name in [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]:
        # Dask reports workers and connections that come and go.
        logging.getLogger(name).setLevel(logging.CRITICAL)

    class Connection(Client):  # type: ignore[misc]
        """Client that is closed by this context alone: one without a connection would wait half a minute at its end."""

        def __del__(self) -> None:
            pass

    # Dask asserts a scheduler's answers, and that it closes: one that stops, and other servers, may answer anything.
    try:
        client = Connection(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except Exception as error:
        raise UserError(f"scheduler = {scheduler!r} cannot be reached: give its address, tcp://HOST:PORT") from error
    try:
        yield client
    finally:
        with contextlib.suppress(Exception):
            client.close(timeout=_CONNECT_S)


def _task(path: str, shard: int, retry_failed: bool, topic: str, versions: Mapping[str, str]) -> Outcome | str:
    """Render a shard on a cluster worker; return its outcome, or a `UserError` message.

    Dask would log the error itself with its traceback.
    """
    from distributed import get_worker

    worker = get_worker()
    place = f"the worker at {worker.address}"
    processes = _PROCESSES.setdefault(topic, Processes(versions, place))

    def tell(shard: int, done: int, failed: int) -> None:
        worker.log_event(topic, (shard, done, failed))

    return _outcome(path, shard, retry_failed, tell, processes)


def _end(topic: str) -> None:
    """End a campaign's processes on this worker."""
    _PROCESSES.setdefault(topic, Processes()).end()


def _outcome(path: str, shard: int, retry_failed: bool, tell: Tell, processes: Processes) -> Outcome | str:
    """Render a shard, report its progress about every second, and return its outcome or a `UserError` message."""
    last = time.monotonic()

    def report(done: int, failed: int) -> None:
        nonlocal last
        if time.monotonic() - last > REPORT_S:
            last = time.monotonic()
            tell(shard, done, failed)

    try:
        return render_in_process(path, shard, retry_failed, report, processes)
    except UserError as error:
        return str(error)
