"""Echo statistics over shots at random sea locations, against the surface slope."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.analysis.retrieval.slope_corrections import SlopeRefraction
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.results.geometry import lidar_geometry
from mitransient_lidar.results.variables import label

#: Half width of the gates about the echoes from a level sea [ns].
_HALF_GATE_NS = 10.0


def shot_statistics(series: xr.Dataset) -> xr.Dataset:
    """Measure the echoes of shots at locations on one sea, for their dependence on its slopes.

    Raises `UserError` if the scene has no bottom, or the record lacks an echo.

    Parameters
    ----------
    series
        A result of `rendering.shots.series.render_shots` for a scene with the parameter ``bottom_depth``.

    Returns
    -------
    xarray.Dataset
        Over ``shot``: ``aim_x``, ``aim_y`` [m], ``slope_along``, ``slope_across`` (mean over the beam's footprint,
        positive along for a face towards the lidar, [1]). Over ``shot`` and ``pixel``: ``surface_peak``,
        ``bottom_peak`` [W], ``surface_time``, ``bottom_time`` [ns] at the waveform's highest point in a 20 ns gate
        about the echo from a level sea; NaN where it lies at a gate limit.
    """
    columns: dict[str, FloatArray] = {name: series[name].values for name in ("aim_x", "aim_y")}
    columns |= {f"slope_{name}": series[f"true_slope_{name}"].values for name in ("along", "across")}
    shape = series.sizes["shot"], -1
    depth = series.attrs.get("scene.bottom_depth")
    if depth is None or "surface_time_ns" not in series.attrs:
        raise UserError("statistics of shots need a scene with a sea and the parameter bottom_depth")
    geometry = lidar_geometry(series.attrs)
    echoes = {"surface": geometry.surface_time_ns, "bottom": float(geometry.time_of_depth(float(depth)))}
    for name, time in echoes.items():
        heights, times = highest_points(series, time - _HALF_GATE_NS, time + _HALF_GATE_NS)
        columns |= {f"{name}_peak": heights.reshape(shape), f"{name}_time": times.reshape(shape)}
    data = {name: (("shot", "pixel")[: values.ndim], values) for name, values in columns.items()}
    pixels = [str(name) for name in series["pixel"].values]
    return label(xr.Dataset(data, coords={"pixel": pixels}, attrs=series.attrs), "highest")


def highest_points(shot: xr.Dataset, start: float, end: float) -> tuple[FloatArray, FloatArray]:
    """Return the highest point of each pixel's waveform in a gate [ns], by a parabola through three bins.

    Power [W] and time [ns] have the shape (waveforms,), for the pixels of one shot, or of several shots in a row; NaN
    where the highest bin lies at a gate limit. Raises `UserError` if the gate is not within the record.
    """
    time = shot["time"].values
    inside = np.flatnonzero((time >= start) & (time <= end))
    if len(inside) < 3 or inside[0] == 0 or inside[-1] == len(time) - 1:
        raise UserError(f"the record must hold {start:.1f} to {end:.1f} ns: change time_start_ns or bin_count")
    return highest_of(time, shot["waveform"].values.reshape(-1, len(time)), inside)


def highest_of(time: FloatArray, power: FloatArray, inside: npt.NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
    """Return height and time as `highest_points` for power [W], shape (pixels, time), in bins with given indices."""
    heights, times = np.full(len(power), np.nan), np.full(len(power), np.nan)
    for pixel, values in enumerate(power):
        top = inside[np.argmax(values[inside])]
        if top in (inside[0], inside[-1]):
            continue
        left, middle, right = values[top - 1 : top + 2]
        shift = 0.5 * (left - right) / (left - 2 * middle + right)
        heights[pixel] = middle - 0.25 * (left - right) * shift
        times[pixel] = time[top] + shift * (time[1] - time[0])
    return heights, times


def depth_bias(slope_along: FloatArray, depth: float, off_nadir: float, refractive_index: float) -> FloatArray:
    """Return the depth error [m] of a bottom by refraction at a slope, positive for too deep a bottom.

    Slopes are along the lidar's azimuth [1], and the ray in air has an angle from the vertical [rad].

    Notes
    -----
    Explanation by Tulldahl (2006, figure 12): a face away from the lidar refracts the ray towards the vertical, which
    shortens the path to the bottom. The depth is computed from the time as for a level sea.
    """
    level, ray = (SlopeRefraction.of(slope, 0.0, off_nadir, refractive_index) for slope in (0.0, slope_along))
    return np.asarray(depth * (level.cos_vertical / ray.cos_vertical - 1))


def slope_effects(shots: xr.Dataset) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return slopes [1] and their effects on the echoes in a receiver with 2x2 pixels, from `shot_statistics`.

    The effects, each over ``shot``, are ``strength`` (log10 of the surface echo [W]), ``separation`` (surface echo
    delay of the far pair after the near pair [ns]) and ``depth`` (bottom depth error [m]) for the slope along the
    azimuth, and ``sideways`` (delay of green, on the right, after red [ns]) for the rise to the left. Raises
    `UserError` if the pixels are different ones.
    """
    if [str(name) for name in shots["pixel"].values] != ["red", "green", "blue", "black"]:
        raise UserError(f"pixels = {list(shots['pixel'].values)} must be the 2x2 of red, green, blue and black")
    geometry = lidar_geometry(shots.attrs)
    level = float(geometry.time_of_depth(float(shots.attrs["scene.bottom_depth"])))
    along, across = (shots[f"slope_{name}"].values for name in ("along", "across"))
    surface, bottom = shots["surface_time"], shots["bottom_time"]
    strength = shots["surface_peak"].sum("pixel", skipna=False).values
    separation = (surface[:, :2].mean("pixel", skipna=False) - surface[:, 2:].mean("pixel", skipna=False)).values
    deeper = geometry.depth_per_ns * (bottom.mean("pixel", skipna=False).values - level)
    return {
        "strength": (along, np.log10(strength)),
        "separation": (along, separation),
        "sideways": (across, (surface[:, 1] - surface[:, 0]).values),
        "depth": (along, deeper),
    }


def describe_statistics(shots: xr.Dataset) -> list[str]:
    """Return a line for each of the `slope_correlations`; raises as `slope_effects`."""
    found = slope_correlations(shots).items()
    return [f"correlation of {name} with the slope: {value:+.3f}" for name, value in found]


def slope_correlations(shots: xr.Dataset) -> dict[str, float]:
    """Return the correlation of each of the `slope_effects` with its slope; raises as `slope_effects`.

    Shots without the effect, with the value NaN, are left out; the correlation of fewer than two is NaN.
    """
    found = {}
    for name, (slope, value) in slope_effects(shots).items():
        known = np.isfinite(value)
        found[name] = float(np.corrcoef(slope[known], value[known])[0, 1]) if known.sum() > 1 else np.nan
    return found
