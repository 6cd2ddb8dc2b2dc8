"""Statistics of echoes over shots at random places of a sea, against the slope that the beam meets."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, integer
from mitransient_lidar.rendering.passes import ProgressCallback
from mitransient_lidar.rendering.session import open_scene
from mitransient_lidar.results.geometry import LidarGeometry
from mitransient_lidar.studies.find_shots import SeaMap
from mitransient_lidar.studies.shot_series import random_shots

_PASSES = 8

#: Half widths of the gates about the echoes on a level sea [ns].
_SURFACE_GATE_NS, _BOTTOM_GATE_NS = 10.0, 10.0


def shot_statistics(
    scene: Any,
    params: Mapping[str, Any] | None = None,
    *,
    count: int = 200,
    seed: int = 1,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Render shots at random places of one sea and measure their echoes.

    Parameters
    ----------
    scene, params
        An XML scene with the parameters ``aim_x`` and ``aim_y``.
    count
        Number of shots, 2 to 100 000.
    seed
        Seed of the places, at least 0.
    progress
        Called with a `passes.Progress` after every shot.

    Returns
    -------
    xarray.Dataset
        Over ``shot``: ``aim_x``, ``aim_y`` [m], ``slope_along``, ``slope_across`` (mean over the beam's footprint,
        positive along is a face towards the lidar, [1]). Over ``shot`` and ``pixel``: ``surface_peak``,
        ``bottom_peak`` [W], ``surface_time``, ``bottom_time`` [ns] of the waveform's highest point in a gate of 20 ns
        about the echo of a level sea; ``NaN`` where it lies on the gate's border.

    Raises
    ------
    UserError
        When the scene is wrong, has no waves or no bottom, or the record does not hold the echoes.
    UserError
        When `count` is out of range.
    """
    count, seed = integer("count", count, 2, 100_000), integer("seed", seed, 0, 2**53)
    sea = SeaMap.of_scene(open_scene(scene, params).scene)
    rows: list[dict[str, Any]] = []
    drawn = random_shots(scene, params, sea, count=count, passes=_PASSES, seed=seed, progress=progress)
    for shot, result in drawn:
        row: dict[str, Any] = {"aim_x": shot.x, "aim_y": shot.y, "slope_along": shot.along, "slope_across": shot.across}
        for name, middle, half in _gates(result):
            row[f"{name}_peak"], row[f"{name}_time"] = highest_points(result, middle - half, middle + half)
        rows.append(row)
    pixels = [str(name) for name in result["pixel"].values]
    arrays = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    units = {"aim_x": "m", "aim_y": "m", "slope_along": "1", "slope_across": "1"}
    data = {
        name: (("shot", "pixel")[: values.ndim], values, {"units": units.get(name, "W" if "peak" in name else "ns")})
        for name, values in arrays.items()
    }
    return xr.Dataset(data, coords={"pixel": pixels}, attrs={**result.attrs, "places_seed": seed})


def _gates(shot: xr.Dataset) -> list[tuple[str, float, float]]:
    """Return name, middle [ns] and half width [ns] of the gates about surface and bottom echo of a level sea."""
    depth = shot.attrs.get("scene.bottom_depth")
    if depth is None or "surface_time_ns" not in shot.attrs:
        raise UserError("shot-statistics needs a scene with a sea and the parameter bottom_depth")
    geometry = LidarGeometry.from_attributes(shot.attrs)
    bottom = float(geometry.time_of_depth(float(depth)))
    return [("surface", geometry.surface_time_ns, _SURFACE_GATE_NS), ("bottom", bottom, _BOTTOM_GATE_NS)]


def highest_points(shot: xr.Dataset, start: float, end: float) -> tuple[FloatArray, FloatArray]:
    """Find the highest point of each pixel's waveform in a gate, by a parabola through three bins.

    Parameters
    ----------
    shot
        A result with waveforms.
    start, end
        Gate [ns].

    Returns
    -------
    height, time
        Power [W] and time [ns], shape (pixels,); NaN where the highest bin lies on the gate's border.

    Raises
    ------
    UserError
        When the record does not hold the gate.
    """
    time = shot["time"].values
    inside = np.flatnonzero((time >= start) & (time <= end))
    if len(inside) < 3 or inside[0] == 0 or inside[-1] == len(time) - 1:
        raise UserError(f"the record must hold {start:.1f} to {end:.1f} ns: change time_start_ns or bin_count")
    power = shot["waveform"].values.reshape(-1, len(time))
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
    """Return how much too deep a bottom appears where a ray is refracted by a slope [m].

    Parameters
    ----------
    slope_along
        Slope of the surface along the lidar's azimuth [1].
    depth
        Depth of the bottom [m].
    off_nadir
        Angle of the ray in air from the vertical [rad].
    refractive_index
        Refractive index of the water.

    Notes
    -----
    The published explanation (Tulldahl 2006, figure 12): a face turned away from the lidar bends the ray towards the
    vertical, and the way to the bottom is shorter. The depth read from it is that of a level sea.
    """
    tilt = np.arctan(slope_along)
    level = math.asin(math.sin(off_nadir) / refractive_index)
    in_water = tilt + np.arcsin(np.sin(off_nadir - tilt) / refractive_index)
    return np.asarray(depth * (math.cos(level) / np.cos(in_water) - 1))


def slope_effects(shots: xr.Dataset) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return the effects of the slopes on the echoes of a receiver with 2x2 pixels.

    Parameters
    ----------
    shots
        What `shot_statistics` returned.

    Returns
    -------
    dict
        Slope [1] and effect, each over ``shot``: ``strength`` (log10 of the surface echo [W]), ``separation`` (of the
        far pair's surface echo from the near pair's [ns]) and ``depth`` (error of the bottom's depth [m]) against the
        slope along the azimuth; ``sideways`` (green's surface echo after red's [ns]) against the slope across.

    Raises
    ------
    UserError
        When the pixels are others.
    """
    if [str(name) for name in shots["pixel"].values] != ["red", "green", "blue", "black"]:
        raise UserError(f"pixels = {list(shots['pixel'].values)} must be the 2x2 of red, green, blue and black")
    geometry = LidarGeometry.from_attributes(shots.attrs)
    due = float(geometry.time_of_depth(float(shots.attrs["scene.bottom_depth"])))
    along, across = (shots[f"slope_{name}"].values for name in ("along", "across"))
    surface, bottom = shots["surface_time"], shots["bottom_time"]
    strength = shots["surface_peak"].sum("pixel", skipna=False).values
    separation = (surface[:, :2].mean("pixel", skipna=False) - surface[:, 2:].mean("pixel", skipna=False)).values
    deeper = geometry.depth_per_ns * (bottom.mean("pixel", skipna=False).values - due)
    return {
        "strength": (along, np.log10(strength)),
        "separation": (along, separation),
        "sideways": (across, (surface[:, 1] - surface[:, 0]).values),
        "depth": (along, deeper),
    }


def slope_correlations(shots: xr.Dataset) -> dict[str, float]:
    """Return the correlation of each of the `slope_effects` with its slope, without NaN; raises as `slope_effects`."""
    found = {}
    for name, (slope, value) in slope_effects(shots).items():
        known = np.isfinite(value)
        found[name] = float(np.corrcoef(slope[known], value[known])[0, 1])
    return found
