"""Campaigns on Dask: shards as tasks, on processes of this machine or on a cluster."""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import logging
import os
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from mitransient_lidar.campaigns.design import Campaign
from mitransient_lidar.campaigns.runs import RunRenderer, check_names, record_of
from mitransient_lidar.campaigns.shard import Outcome, log_path, render_in_process
from mitransient_lidar.campaigns.store import DONE, FAILED, PLANNED, Store, open_campaign
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import integer, shown
from mitransient_lidar.rendering.passes import Progress, ProgressCallback

if TYPE_CHECKING:
    from distributed import Client

_LOG = logging.getLogger(__name__)

#: Shards for each worker that are with the scheduler at a time.
_AHEAD = 4

#: Shards with runs that could not be rendered after which the campaign ends.
_MOST_LEFT = 8

#: Runs that are tried until one of them shows the arrays of a store.
_TRIALS = 8

#: Time between two reports of a shard, and time to wait for a scheduler [s].
_REPORT_S, _CONNECT_S = 1.0, 15.0


def sweep(
    campaign: Campaign | Mapping[str, Any] | str | os.PathLike[str],
    store: str | os.PathLike[str],
    *,
    workers: int | None = None,
    scheduler: Client | str | None = None,
    shard_size: int | None = None,
    retry_failed: bool = False,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Render the runs of a campaign into a Zarr store, or those that an interrupted one has left.

    Scripts call it below ``if __name__ == "__main__":``, since new processes import the script.

    Parameters
    ----------
    campaign
        A TOML file, or a dict of its contents; see docs/guide/campaigns.md.
    store
        Folder of the store. One that holds the same campaign is completed.
    workers
        Processes on this machine, 1 to 1024; by default one for each core.
    scheduler
        Address of a Dask scheduler, or a ``distributed.Client``, instead of processes on this machine. Its workers need
        this package, and the store at the same path.
    shard_size
        Runs of a shard, which one process renders and writes, 1 to 1 000 000; by default a sixteenth of the runs, but
        8 to 1024, and fewer where a shard would take more than half a gigabyte.
    retry_failed
        Whether to render runs that have failed, too.
    progress
        Called with a `rendering.passes.Progress` about every second.

    Returns
    -------
    xarray.Dataset
        The store, as of `campaigns.store.open_campaign`.

    Raises
    ------
    UserError
        If the campaign is invalid, the store holds another one or cannot be written, the first runs all fail, the
        scheduler or one of its workers cannot be reached, or runs could not be rendered for another reason than their
        parameters, after the others.
    KeyboardInterrupt
        After Ctrl-C; runs that are written stay.
    """
    return open_campaign(
        complete(
            lambda: _prepare(_campaign(campaign), Path(store), shard_size), workers, scheduler, retry_failed, progress
        ).path
    )


def resume(store: str | os.PathLike[str], **options: Any) -> xr.Dataset:
    """Render the runs that an interrupted campaign has left in its store; `options` as for `sweep`."""
    given = {"workers": None, "scheduler": None, "retry_failed": False, "progress": None, **options}
    return open_campaign(complete(lambda: Store(store), **given).path)


def render_row(campaign: Campaign | Mapping[str, Any] | str | os.PathLike[str], row: int, **options: Any) -> xr.Dataset:
    """Render one run of a campaign: all shots with everything that `render_shots` returns, the bits of the store.

    Parameters
    ----------
    campaign
        Folder of a store, a TOML file, or a dict of its contents.
    row
        Number of the run.
    options
        Options of `render_shots` instead of those of the campaign.

    Raises
    ------
    UserError
        If there is no such run, or it fails.
    """
    if isinstance(campaign, (str, os.PathLike)) and Path(campaign).is_dir():
        store = Store(campaign)
        renderer, row = store.renderer(), integer("row", row, 0, store.count - 1)
        values = {name: column[0].item() for name, column in store.inputs(slice(row, row + 1)).items()}
    else:
        plan = _campaign(campaign)
        check_names(plan)
        table = plan.table()
        row = integer("row", row, 0, len(next(iter(table.values()))) - 1)
        renderer = RunRenderer.of(plan, table)
        values = {name: column[row].item() for name, column in table.items()}
    series: xr.Dataset = renderer.series(row, values, **options)
    return series


def _campaign(given: Campaign | Mapping[str, Any] | str | os.PathLike[str]) -> Campaign:
    """Return a campaign that may be given as a file or a dict."""
    if isinstance(given, Campaign):
        return given
    return Campaign.of(given) if isinstance(given, Mapping) else Campaign.read(given)


def _prepare(campaign: Campaign, path: Path, shard_size: int | None) -> Store:
    """Return the store of a campaign, a new one if there is none."""
    if not path.exists():
        check_names(campaign)
    columns = campaign.table()
    if path.exists():
        store = Store(path)
        if not store.is_of("campaign", campaign.text, columns, lambda: record_of(campaign)):
            raise UserError(
                f"{path} holds another campaign, or its scene has changed: choose another place, or remove it"
            )
        if shard_size not in (None, store.shard_size):
            raise UserError(f"shard_size = {shown(shard_size)} must be that of {path}, {store.shard_size}")
        return store
    renderer = RunRenderer.of(campaign, columns)
    count = len(next(iter(columns.values())))
    first: UserError | None = None
    for row in range(min(_TRIALS, count)):
        values = {name: column[row].item() for name, column in columns.items()}
        try:
            arrays, coordinates = renderer.sample(row, values)
        except UserError as error:
            first = first or error
        else:
            made = Store.create(path, renderer, columns, arrays, coordinates, shard_size)
            # Another process may have made another store in the meantime, which is then refused.
            is_wanted = made.text == campaign.text and shard_size in (None, made.shard_size)
            return made if is_wanted else _prepare(campaign, path, shard_size)
    raise UserError(f"the first {min(_TRIALS, count)} runs all fail, the first of them so: {first}")


def complete(
    prepare: Callable[[], Store],
    workers: int | None,
    scheduler: Client | str | None,
    retry_failed: bool,
    progress: ProgressCallback | None,
) -> Store:
    """Render what is missing in a store, and return it; options as for `sweep`."""
    if workers is not None and scheduler is not None:
        raise UserError(f"workers = {workers} are of this machine, and the scheduler has its own: give one of both")
    number = os.cpu_count() or 1 if workers is None else integer("workers", workers, 1, 1024)
    with contextlib.ExitStack() as stack:
        # A scheduler that is away leaves no store.
        client = None if scheduler is None else stack.enter_context(_connected(scheduler))
        store = prepare()
        store.mend()
        status = store.status()
        wanted = (PLANNED, FAILED) if retry_failed else (PLANNED,)
        shards = [shard for shard in store.shards if np.isin(status[store.runs_of(shard)], wanted).any()]
        if shards:
            store.check_pixel_order()
            # Here for the warning of other versions: the processes of shards tell nothing.
            store.renderer()
            try:
                client = client or stack.enter_context(_local(min(number, len(shards))))
                _render(store, shards, client, retry_failed, progress)
            except KeyboardInterrupt as error:
                done = int(np.count_nonzero(store.status() != PLANNED))
                text = f"interrupted after {done} of {store.count} {store.unit}s, which are kept"
                text += "; the same command goes on."
                raise KeyboardInterrupt(text) from error
    return store


def _render(
    store: Store, shards: list[int], client: Client, retry_failed: bool, progress: ProgressCallback | None
) -> None:
    """Render shards on the workers of a client."""
    from concurrent.futures import CancelledError

    from distributed import KilledWorker, as_completed
    from distributed.comm import CommClosedError

    topic = f"campaign-{uuid.uuid4().hex}"
    tally = _Tally(store, progress)
    client.subscribe_topic(topic, tally.receive)
    path, waiting = str(store.path.resolve()), iter(shards)
    futures = as_completed(loop=client.loop)
    reached: set[str] = set()

    def submit() -> None:
        # Workers may come and go.
        threads = client.nthreads()
        _check_workers(client, set(threads) - reached)
        reached.update(threads)
        wanted = _AHEAD * max(sum(threads.values()), 1) - futures.count()
        for shard in itertools.islice(waiting, max(wanted, 0)):
            key = f"shard-{shard}-{topic}"
            futures.add(client.submit(_task, path, shard, retry_failed, topic, pure=False, key=key))

    left: list[str] = []
    try:
        if not client.nthreads():
            _LOG.warning("the scheduler has no workers: the campaign waits for the first one")
            while not client.nthreads():
                time.sleep(_REPORT_S)
        submit()
        for future in futures:
            found = future.result()
            if isinstance(found, str):
                raise UserError(found)
            shard, outcome = found
            tally.finish(shard, outcome)
            if outcome.left:
                left.append(outcome.left)
                _LOG.warning("runs of shard %d are left: %s", shard, outcome.left)
                if len(left) >= _MOST_LEFT:
                    break
            submit()
    except KilledWorker as error:
        raise UserError(f"{error.task} has lost its worker too often: see the log of the scheduler") from error
    except (CancelledError, OSError) as error:
        # A connection that times out is an OSError, and so may be what a worker tells.
        if client.status == "running" and not isinstance(error, (CancelledError, CommClosedError)):
            raise
        raise UserError("the scheduler was lost: what is written is kept, and the same command goes on") from error
    finally:
        with contextlib.suppress(OSError):
            client.unsubscribe_topic(topic)
    if left:
        raise UserError(
            f"{len(left)} of {len(shards)} shards are not complete, the first for {left[0]}; {log_path(store.path)} "
            "tells more, and the same command goes on"
        )


def _check_workers(client: Client, addresses: set[str]) -> None:
    """Raise `UserError` if the scheduler cannot reach a worker, which would wait for ever."""
    answers = client.run(os.getpid, workers=sorted(addresses), on_error="return") if addresses else {}
    for address, answer in answers.items():
        if isinstance(answer, BaseException) and address in client.nthreads():
            raise UserError(f"the scheduler cannot reach its worker at {address}: check its address and the firewall")


def _task(path: str, shard: int, retry_failed: bool, topic: str) -> tuple[int, Outcome] | str:
    """Render a shard on a worker; return its number and outcome, or the message of a `UserError`.

    Dask would log the error itself with its traceback.
    """
    from distributed import get_worker

    worker = get_worker()
    last = time.monotonic()

    def report(done: int, failed: int) -> None:
        nonlocal last
        if time.monotonic() - last > _REPORT_S:
            last = time.monotonic()
            worker.log_event(topic, {"shard": shard, "done": done, "failed": failed})

    try:
        return shard, render_in_process(path, shard, retry_failed, report)
    except UserError as error:
        return str(error)


class _Tally:
    """Counts of the runs of a campaign, by shard."""

    def __init__(self, store: Store, progress: ProgressCallback | None) -> None:
        self._store, self._progress = store, progress
        status = store.status()
        self._shards = {
            shard: tuple(int(np.count_nonzero(status[store.runs_of(shard)] == one)) for one in (DONE, FAILED))
            for shard in store.shards
        }
        self._began, self._before = time.perf_counter(), sum(map(sum, self._shards.values()))
        self._finished: set[int] = set()
        self._tell()

    def receive(self, event: tuple[float, Mapping[str, int]]) -> None:
        """Count the runs of a shard that a worker renders."""
        news = event[1]
        if news["shard"] not in self._finished:
            self._shards[news["shard"]] = news["done"], news["failed"]
            self._tell()

    def finish(self, shard: int, outcome: Outcome) -> None:
        """Count the runs of a shard that is written."""
        self._finished.add(shard)
        self._shards[shard] = outcome.done, outcome.failed
        state = self._tell()
        _LOG.info(
            "shard %d written: %d of %d %ss, %d failed, %.3g a second, ends in %.0f s",
            shard, state.done, state.planned, state.unit, state.failed, state.rate or 0, state.remaining_s or 0,
        )  # fmt: skip

    def _tell(self) -> Progress:
        done, failed = (sum(counts) for counts in zip(*self._shards.values(), strict=True))
        elapsed, here = time.perf_counter() - self._began, done + failed - self._before
        planned, rate = self._store.count, here / elapsed
        remaining = (planned - done - failed) / rate if here else None
        state = Progress(
            done=done + failed,
            planned=planned,
            unit=self._store.unit,
            elapsed_s=elapsed,
            remaining_s=remaining,
            failed=failed,
            rate=rate if here else None,
        )
        if self._progress is not None:
            self._progress(state)
        return state


@contextlib.contextmanager
def _connected(scheduler: Client | str) -> Iterator[Client]:
    """Yield a client of a running scheduler."""
    from distributed import Client

    if isinstance(scheduler, Client):
        yield scheduler
        return
    _silence()
    try:
        client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise UserError(f"scheduler = {scheduler!r} cannot be reached: give its address, tcp://HOST:PORT") from error
    with client:
        yield client


@contextlib.contextmanager
def _local(workers: int) -> Iterator[Client]:
    """Yield a client of new processes on this machine."""
    from distributed import Client, LocalCluster

    _silence()
    # The processes of the shards hold the memory, not these.
    options = {
        "threads_per_worker": 1,
        "processes": True,
        "memory_limit": 0,
        "dashboard_address": "127.0.0.1:0",
        "silence_logs": logging.CRITICAL,
    }
    try:
        started = LocalCluster(n_workers=workers, **options)
    except (OSError, RuntimeError) as error:
        raise UserError(f"{workers} worker processes could not be started; the same command tries again") from error
    with started as cluster, Client(cluster, set_as_default=False) as client:
        if importlib.util.find_spec("bokeh") is not None:
            _LOG.info("dashboard: %s", cluster.dashboard_link)
        yield client


def _silence() -> None:
    """Keep Dask from telling of workers and connections that come and go."""
    for name in [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
