"""Campaigns: shards of runs on workers, into a store."""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import os
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import xarray as xr

from mitransient_lidar.campaigns.design import Campaign
from mitransient_lidar.campaigns.runs import RunRenderer, check_names, check_versions, source_of
from mitransient_lidar.campaigns.shard import Outcome, log_path
from mitransient_lidar.campaigns.store import BYTES_PER_BYTE, DONE, FAILED, LARGEST_SHARD, PLANNED, Store, open_campaign
from mitransient_lidar.campaigns.workers import REPORT_S, Workers, connected, on_cluster, on_this_machine
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import checked_path
from mitransient_lidar.core.options import Option, checked
from mitransient_lidar.core.processors import usable_processors
from mitransient_lidar.core.validation import integer, require_memory
from mitransient_lidar.rendering.passes import Progress, ProgressCallback

if TYPE_CHECKING:
    from distributed import Client

_LOG = logging.getLogger(__name__)

_AHEAD = 4  #: Shards for each worker that are with the scheduler at a time.
_MOST_LEFT = 8  #: Shards with runs that could not be rendered after which the campaign ends.
_TRIALS = 8  #: Runs that are tried until one shows a store's arrays.


#: Options for campaigns and flights.
ProcessCount = Annotated[
    int | None, Option("Processes on this machine, by default one for each processor that may be used", 1, 1024)
]
Scheduler = Annotated[Any, Option("A running Dask scheduler instead, as tcp://host:8786", form="ADDRESS")]


@checked
def campaign(
    campaign: Annotated[
        Campaign | Mapping[str, Any] | str | os.PathLike[str],
        Option("TOML file of a campaign, or its store to complete it", form="CAMPAIGN", is_argument=True),
    ],
    store: str | os.PathLike[str],
    *,
    light: Annotated[str | None, Option("Computation of the light instead of the campaign's: merging or maps")] = None,
    workers: ProcessCount = None,
    scheduler: Scheduler = None,
    shard_size: Annotated[
        int | None,
        Option(
            "Runs that one process renders and writes, by default a sixteenth of them, but 8 to 1024 in number",
            *(1, LARGEST_SHARD),
        ),
    ] = None,
    retry_failed: Annotated[bool, Option("Render runs that have failed again")] = False,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Render a campaign's runs into a Zarr store, or the runs that an interrupted one has left.

    Parameters
    ----------
    campaign
        A TOML file, or a dict with its contents; see docs/guide/campaigns.md.
    store
        Store folder. A store with the same campaign is completed.
    light
        As of `rendering.shots.series.render_shots`; rows that maps do not suit are merged.
    scheduler
        Address of a Dask scheduler, or a ``distributed.Client``, instead of processes on this machine. Its workers need
        the same versions of this package, Mitsuba, Dr.Jit, NumPy and Python, and the store at the same path.
    shard_size
        Runs per shard, which one process renders and writes, 1 to 1 000 000; by default a sixteenth of the runs, but 8
        to 1024, and fewer where a shard would need more than half a gigabyte.

    Returns
    -------
    xarray.Dataset
        The store, as from `campaigns.store.open_campaign`.

    Raises
    ------
    UserError
        If the campaign is invalid; the store contains another one, was begun by other versions or cannot be written;
        the first runs all fail; the shards of all workers exceed this machine's memory; the scheduler or one of its
        workers cannot be reached; a worker has other versions; or, after the others, runs could not be rendered for
        another reason than their parameters.
    KeyboardInterrupt
        After Ctrl-C; processes write the runs that they have, which stay.
    """
    path, given = checked_path("store", store), (workers, scheduler, retry_failed, progress)
    return open_campaign(complete(lambda: _prepare(_campaign(campaign).lit_by(light), path, shard_size), *given).path)


def resume(store: str | os.PathLike[str], **options: Any) -> xr.Dataset:
    """Render the runs that an interrupted campaign has left in its store; `options` as for `sweep`."""
    given = {"workers": None, "scheduler": None, "retry_failed": False, "progress": None, **options}
    return open_campaign(complete(lambda: Store(store), **given).path)


def render_row(campaign: Campaign | Mapping[str, Any] | str | os.PathLike[str], row: int, **options: Any) -> xr.Dataset:
    """Render one campaign run: all shots with everything that `render_shots` returns, with the bits in the store.

    Raises UserError if there is no such run, or it fails.

    `campaign`: store folder, a TOML file, or a dict with its contents. `row`: run number. `options`: options of
    `render_shots` instead of the campaign's.
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


def describe_campaign(path: str | os.PathLike[str]) -> list[str]:
    """Return lines on a campaign: the numbers of its runs by status, and the most frequent failure reasons."""
    store = Store(path)
    status = store.status()
    done, failures, planned = (int(np.count_nonzero(status == value)) for value in (DONE, FAILED, PLANNED))
    lines = [f"{store.count} runs: {done} done, {failures} failed, {planned} planned"]
    if failures:
        failed = np.flatnonzero(status == FAILED)
        reasons, first, number = np.unique(
            store.errors()[failed].astype(np.str_), return_index=True, return_counts=True
        )
        for reason, place, times in sorted(zip(reasons, first, number, strict=True), key=lambda row: -row[2])[:5]:
            lines.append(f"failed {times}, the first run {failed[place]}: {reason}")
    return lines


def _campaign(given: Campaign | Mapping[str, Any] | str | os.PathLike[str]) -> Campaign:
    """Return a campaign that may be given as a file or a dict."""
    if isinstance(given, Campaign):
        return given
    if isinstance(given, Mapping):
        return Campaign.of_file(given)
    return Campaign.read(checked_path("campaign", given))


def _prepare(campaign: Campaign, path: Path, shard_size: int | None) -> Store:
    """Return the store of a campaign, a new one if there is none."""
    if not path.exists():
        check_names(campaign)
    columns = campaign.table()
    if path.exists():
        return Store(path).require(campaign, columns, lambda: source_of(campaign), shard_size)
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
    """Render the missing runs of a store, and return it; options as for `campaign`."""
    if workers is not None and scheduler is not None:
        raise UserError(f"workers = {workers} are of this machine, and the scheduler has its own: give one of both")
    number = usable_processors() if workers is None else integer("workers", workers, 1, 1024)
    with contextlib.ExitStack() as stack:
        # A scheduler that is away leaves no store.
        client = None if scheduler is None else stack.enter_context(connected(scheduler))
        store = prepare()
        store.mend()
        status = store.status()
        wanted = (PLANNED, FAILED) if retry_failed else (PLANNED,)
        shards = [shard for shard in store.shards if np.isin(status[store.runs_of(shard)], wanted).any()]
        if shards:
            check_versions(store.path, store.attributes)
            few = min(number, len(shards))
            if client is None:
                _require_memory(store, few)
            tally = _Tally(store, progress)
            given = str(store.path.resolve()), retry_failed, tally.count
            try:
                with on_cluster(client, *given) if client else on_this_machine(few, *given) as pool:
                    _render(store, shards, pool, tally)
            except KeyboardInterrupt as error:
                # Processes have written their runs, and ended.
                done = int(np.count_nonzero(store.status() != PLANNED))
                text = f"interrupted after {done} of {store.count} {store.unit}s, which are kept"
                text += "; the same command goes on."
                raise KeyboardInterrupt(text) from error
    return store


def _require_memory(store: Store, workers: int) -> None:
    """Raise `UserError` if the shards of workers on this machine exceed its memory."""
    bytes_of_shard = sum(one.dtype.itemsize * math.prod(one.chunks) for one in map(store.array, store.variables))
    what = f"shards of {store.shard_size} {store.unit}s, {workers} at a time,"
    require_memory(what, BYTES_PER_BYTE * workers * bytes_of_shard, "take fewer workers")


def _render(store: Store, shards: list[int], workers: Workers, tally: _Tally) -> None:
    """Render shards on workers."""
    waiting = iter(shards)
    pending: dict[Future[Outcome | str], int] = {}
    left: list[str] = []
    while len(left) < _MOST_LEFT:
        wanted = _AHEAD * workers.count() - len(pending)
        for shard in itertools.islice(waiting, max(wanted, 0)):
            pending[workers.submit(shard)] = shard
        if not pending:
            break
        # Not for ever: workers of a cluster come and go.
        for future in wait(pending, timeout=REPORT_S, return_when=FIRST_COMPLETED).done:
            shard, outcome = pending.pop(future), future.result()
            if isinstance(outcome, str):
                raise UserError(outcome)
            tally.finish(shard, outcome)
            if outcome.left:
                left.append(outcome.left)
                _LOG.warning("runs of shard %d are left: %s", shard, outcome.left)
    if left:
        raise UserError(
            f"{len(left)} of {len(shards)} shards are not complete, the first for {left[0]}; {log_path(store.path)} "
            "tells more, and the same command goes on"
        )


class _Tally:
    """Run counts in a campaign, by shard; threads may call it."""

    def __init__(self, store: Store, progress: ProgressCallback | None) -> None:
        self._store, self._progress = store, progress
        self._lock = threading.Lock()
        status = store.status()
        self._shards = {
            shard: tuple(int(np.count_nonzero(status[store.runs_of(shard)] == one)) for one in (DONE, FAILED))
            for shard in store.shards
        }
        self._began, self._before = time.perf_counter(), sum(map(sum, self._shards.values()))
        self._finished: set[int] = set()
        self._tell()

    def count(self, shard: int, done: int, failed: int) -> None:
        """Count the runs of a shard that a worker renders."""
        with self._lock:
            if shard not in self._finished:
                self._shards[shard] = done, failed
                self._tell()

    def finish(self, shard: int, outcome: Outcome) -> None:
        """Count the runs in a written shard."""
        with self._lock:
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
