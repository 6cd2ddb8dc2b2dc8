"""Flights on Dask: pulses into a Zarr store, and points and waveforms from it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import xarray as xr

from mitransient_lidar.campaigns.store import LARGEST_BYTES, LARGEST_SHARD, Store
from mitransient_lidar.campaigns.sweep import ProcessCount, Scheduler, complete
from mitransient_lidar.core.files import checked_path
from mitransient_lidar.core.options import Option, checked
from mitransient_lidar.flights.las_header import coordinate_system_wkt
from mitransient_lidar.flights.plan import FlightPlan
from mitransient_lidar.flights.preparation import telling_errors_alone
from mitransient_lidar.flights.products import INFRARED_STORE, Flown, points_of, write_files
from mitransient_lidar.flights.renderer import FlightRenderer, scene_of
from mitransient_lidar.rendering.passes import ProgressCallback

#: Name of the store in the folder of a flight.
STORE = "flight.zarr"

#: Fewest and most pulses of a shard, whose process takes as long to start as 1000 of them by maps, and shards of a
#: flight.
_FEWEST, _MOST, _SHARDS = 1024, 8192, 8

#: Pulses whose arrays show those of the store.
_SAMPLE = 2


@checked
def fly(
    flight: Annotated[
        FlightPlan | Mapping[str, Any] | str | os.PathLike[str],
        Option("TOML file of a flight, or the name of a shipped one", form="FLIGHT", is_argument=True),
    ],
    folder: str | os.PathLike[str],
    *,
    light: Annotated[str | None, Option("Computation of the light instead of the flight's: merging or maps")] = None,
    workers: ProcessCount = None,
    scheduler: Scheduler = None,
    shard_size: Annotated[
        int | None,
        Option(
            "Pulses that one process renders and writes, by default an eighth of them, but 1024 to 8192 in number",
            *(1, LARGEST_SHARD),
        ),
    ] = None,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Render the pulses of a flight, or those that an interrupted one has left, and write its points and waveforms.

    Parameters
    ----------
    flight
        A TOML file, a shipped flight's name, or a dict with its contents; see docs/guide/flights.md.
    folder
        Folder for the files: the store ``flight.zarr``, ``points.laz``, ``waveforms.las`` and ``waveforms.wdp``. An
        infrared channel with its own lines has the store ``infrared.zarr``.
    light
        As of `rendering.shots.series.render_shots`; pulses near targets are merged.
    workers, scheduler
        As for `campaigns.sweep.campaign`.
    shard_size
        Pulses per shard, which one process renders and writes, 1 to 10^6. Defaults to an eighth of all, but 1024
        to 8192, and fewer where a shard would need more than half a gigabyte. The bits depend on it.
    progress
        Called with a `rendering.passes.Progress` about every second.

    Returns
    -------
    xarray.Dataset
        The points, as of `products.points_of`.

    Raises
    ------
    UserError
        If the flight is invalid, its coordinate system or corrections are unknown, its bottom does not cover it, or
        the folder holds another one or cannot be written.
    KeyboardInterrupt
        After Ctrl-C; pulses that are written stay, and the same call goes on.
    """
    if isinstance(flight, Mapping):
        plan = FlightPlan.of_file(flight)
    else:
        plan = flight if isinstance(flight, FlightPlan) else FlightPlan.read(checked_path("flight", flight))
    plan = plan.lit_by(light)
    folder = checked_path("folder", folder)
    coordinate_system_wkt(plan.crs, plan.origin[:2])
    store = complete(lambda: _prepare(plan, folder / STORE, shard_size, progress), workers, scheduler, False, progress)
    if plan.infrared_lines is not None:
        other = plan.of_infrared()
        beside = folder / INFRARED_STORE
        complete(lambda: _prepare(other, beside, shard_size, progress), workers, scheduler, False, progress)
    flown = Flown.of(store)
    with telling_errors_alone():
        points = points_of(flown, plan)
    write_files(flown, plan, points, folder)
    return points


def _prepare(plan: FlightPlan, path: Path, shard_size: int | None, progress: ProgressCallback | None = None) -> Store:
    """Return the store of a flight, a new one if there is none."""
    if path.exists():
        return Store(path).require(plan, None, lambda: scene_of(plan), shard_size)
    renderer, columns = FlightRenderer.of(plan, progress)
    with telling_errors_alone():
        arrays, coordinates, attributes = renderer.sample({name: column[:_SAMPLE] for name, column in columns.items()})
    count = len(columns["pulse"])
    if shard_size is None:
        in_memory = LARGEST_BYTES // sum(array.values.nbytes for array in arrays.values())
        shard_size = min(max(-(-count // _SHARDS), _FEWEST), _MOST, max(in_memory, 1), count)
    return Store.create(path, renderer, columns, arrays, coordinates, shard_size, attributes)
