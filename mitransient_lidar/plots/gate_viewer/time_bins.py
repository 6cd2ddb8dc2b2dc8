"""Waveforms and recorded signals as stacks of time bins, for the page that shows gates."""

from __future__ import annotations

import numpy as np
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots.drawing import as_seen
from mitransient_lidar.results.attributes import check_attributes, check_coordinates, described
from mitransient_lidar.results.dataset import record_dims, time_axis
from mitransient_lidar.results.geometry import LinesOfSight, lidar_geometry

#: Variables with a record in time, and their errors; for a signal the standard deviation of one record.
RECORDS = {"signal": "signal_deviation", "waveform": "waveform_stderr"}


def one_record(dataset: xr.Dataset) -> xr.Dataset:
    """Return every pixel's record in time as ``waveform`` and ``waveform_stderr``, in picture order.

    For a shot series it is the mean, with the mean's standard error. The waveform's attribute ``units`` is W, V or 1,
    and its ``long_name`` belongs to the variable shown.

    Raises UserError if it has another shape, no angles of the pixels, or attributes or times that are invalid.

    `dataset`: a result with ``waveform``, or a record with ``signal``, over (pixel, time) or (row, column, time), after
    ``shot`` if it has shots.
    """
    name = next(name for name in RECORDS if name in dataset)
    dims = record_dims(dataset, name, shots=True)
    check_attributes("the result", dataset.attrs)
    check_coordinates("the result", dataset, name)
    values = dataset[name]
    error = dataset.get(RECORDS[name], values * np.nan).broadcast_like(values)
    if dims[0] == "shot":
        error = (error**2).sum("shot", skipna=False) ** 0.5 / values.sizes["shot"]
        values = values.mean("shot")
    pixels = [dim for dim in dims if dim not in ("shot", "time")]
    own = {key: one for key, one in dataset.coords.items() if {*one.dims} <= {*pixels, "time"}}
    for angle in ("angle_x", "angle_y"):
        if angle not in own or set(own[angle].dims) != set(pixels):
            raise UserError(f"the result has no coordinate {angle} over ({', '.join(pixels)}): it has no map to draw")
    about = {**described(name), **{key: str(text) for key, text in dataset[name].attrs.items() if key == "units"}}
    arrays = {"waveform": (values, about), "waveform_stderr": (error, {})}
    order = (*pixels, "time")
    data = {key: (order, one.transpose(*order).values, text) for key, (one, text) in arrays.items()}
    return as_seen(xr.Dataset(data, own, dataset.attrs))


def time_bins(record: xr.Dataset) -> xr.Dataset:
    """Return the time bins of `one_record` with a gate stack's coordinates: its starts, widths and depths.

    Depths are on the axis, NaN where the geometry is unknown; where it is known, ``surface_time`` and ``depth_per_ns``
    are the pixels' lines of sight.
    """
    axis = time_axis(record)
    try:
        depth = lidar_geometry(record.attrs, surface="measured").depth_of_time(axis.centres_ns)
    except UserError:
        depth = np.full(axis.bin_count, np.nan)
    bins = record.drop_vars(["time", "waveform_stderr"]).rename(waveform="gate_energy", time="gate")
    coordinates = {
        "gate_start": axis.centres_ns - 0.5 * axis.bin_width_ns,
        "gate_width": np.full(axis.bin_count, axis.bin_width_ns),
        "gate_depth": depth,
    }
    bins = bins.assign_coords({name: ("gate", values) for name, values in coordinates.items()})
    try:
        lines = LinesOfSight.from_dataset(record)
    except UserError:
        return bins.drop_vars(["surface_time", "depth_per_ns"], errors="ignore")
    dims = record["waveform"].dims[:-1]
    shape = record["waveform"].shape[:-1]
    sights = {"surface_time": lines.surface_time, "depth_per_ns": lines.depth_per_ns}
    return bins.assign_coords({name: (dims, values.reshape(shape)) for name, values in sights.items()})
