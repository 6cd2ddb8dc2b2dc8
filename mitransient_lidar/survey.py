"""Many shots at random places of a sea: how echoes go with the slope that the beam meets."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar import rendering, variants
from mitransient_lidar.errors import UserError
from mitransient_lidar.loading import load_scene
from mitransient_lidar.optics.checks import FloatArray, whole
from mitransient_lidar.optics.water import C0
from mitransient_lidar.shots import SeaMap

_PASSES = 8

#: Half widths of the gates about the echoes on a level sea [ns].
_SURFACE_GATE_NS, _BOTTOM_GATE_NS = 10.0, 10.0


def survey(
    scene: Any,
    params: Mapping[str, Any] | None = None,
    *,
    count: int = 200,
    seed: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Render shots at random places of one sea and measure their echoes.

    Parameters
    ----------
    scene, params
        An XML scene with the parameters ``shot_x`` and ``shot_y``.
    count
        Number of shots, 2 to 100 000.
    seed
        Seed of the places, at least 0.
    progress
        Called with the shots done and planned.

    Returns
    -------
    xarray.Dataset
        Over ``shot``: ``shot_x``, ``shot_y`` [m], ``slope_along``, ``slope_across`` (mean over the beam's footprint,
        positive along is a face towards the lidar, [1]). Over ``shot`` and ``pixel``: ``surface_peak``,
        ``bottom_peak`` [W], ``surface_time``, ``bottom_time`` [ns] of the waveform's highest point in a gate of 20 ns
        about the echo of a level sea; ``NaN`` where it lies on the gate's border.

    Raises
    ------
    UserError
        When the scene is wrong, has no waves or no bottom, or the record does not hold the echoes.
    ValueError
        When `count` is out of range.
    """
    count = whole("count", count, 2, 100_000)
    variants.set_variant()
    loaded, _, _ = load_scene(scene, params)
    sea = SeaMap.of_scene(loaded)
    rng = np.random.default_rng(whole("seed", seed, 0, 2**53))
    places = rng.uniform(sea.x[0], sea.x[-1], (count, 2))
    rows: list[dict[str, Any]] = []
    attributes: dict[str, Any] = {}
    for number, (x, y) in enumerate(places):
        place = {**(params or {}), "shot_x": x, "shot_y": y}
        shot = rendering.render(scene, params=place, passes=_PASSES, seed=number)
        attributes = shot.attrs
        row: dict[str, Any] = {"shot_x": x, "shot_y": y}
        row["slope_along"], row["slope_across"] = sea.slope_at(x, y)
        for name, middle, half in _gates(shot):
            row[f"{name}_peak"], row[f"{name}_time"] = highest_points(shot, middle - half, middle + half)
        rows.append(row)
        if progress is not None:
            progress(number + 1, count)
    pixels = [str(name) for name in shot["pixel"].values]
    arrays = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    units = {"shot_x": "m", "shot_y": "m", "slope_along": "1", "slope_across": "1"}
    data = {
        name: (("shot", "pixel")[: values.ndim], values, {"units": units.get(name, "W" if "peak" in name else "ns")})
        for name, values in arrays.items()
    }
    return xr.Dataset(data, coords={"pixel": pixels}, attrs={**attributes, "survey_seed": seed})


def _gates(shot: xr.Dataset) -> list[tuple[str, float, float]]:
    """Return name, middle [ns] and half width [ns] of the gates about surface and bottom echo of a level sea."""
    attributes = shot.attrs
    depth = attributes.get("scene.bottom_depth")
    if depth is None or "surface_time_ns" not in attributes:
        raise UserError("survey needs a scene with a sea and the parameter bottom_depth")
    surface = float(attributes["surface_time_ns"])
    sine = math.sin(math.radians(float(attributes["off_nadir_deg"]))) / float(attributes["refractive_index"])
    way = 2 * float(depth) / math.sqrt(1 - sine**2) * float(attributes["group_index"])
    bottom = surface + 1e9 / C0 * way
    return [("surface", surface, _SURFACE_GATE_NS), ("bottom", bottom, _BOTTOM_GATE_NS)]


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


def plot_survey(shots: xr.Dataset, path: str | os.PathLike[str]) -> dict[str, float]:
    """Draw echoes against slopes, and return the correlations.

    Parameters
    ----------
    shots
        What `survey` returned, of a receiver of 2x2 pixels.
    path
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.

    Returns
    -------
    dict
        Correlation of ``strength`` (logarithm of the surface echo), ``separation`` (of the far pair's surface echo from
        the near pair's) and ``depth`` (of the bottom) with the slope along the azimuth, and of ``sideways`` (green's
        surface echo after red's) with the slope across.

    Raises
    ------
    UserError
        When the pixels are others, or the file cannot be written.
    """
    from matplotlib.figure import Figure

    from mitransient_lidar.plotting import check_format
    from mitransient_lidar.results import replacing

    check_format(Path(path))
    if [str(name) for name in shots["pixel"].values] != ["red", "green", "blue", "black"]:
        raise UserError(f"pixels = {list(shots['pixel'].values)} must be the 2x2 of red, green, blue and black")
    attributes = shots.attrs
    depth, off_nadir = float(attributes["scene.bottom_depth"]), math.radians(float(attributes["off_nadir_deg"]))
    index, group = float(attributes["refractive_index"]), float(attributes["group_index"])
    metres_per_ns = 1e-9 * C0 / (2 * group) * math.sqrt(1 - (math.sin(off_nadir) / index) ** 2)
    level = 2e9 * depth * group / C0 / math.sqrt(1 - (math.sin(off_nadir) / index) ** 2)
    along, across = (shots[f"slope_{name}"].values for name in ("along", "across"))
    surface, bottom = shots["surface_time"], shots["bottom_time"]
    strength = shots["surface_peak"].sum("pixel", skipna=False).values
    separation = (surface[:, :2].mean("pixel", skipna=False) - surface[:, 2:].mean("pixel", skipna=False)).values
    sideways = (surface[:, 1] - surface[:, 0]).values
    deeper = metres_per_ns * (bottom.mean("pixel", skipna=False).values - float(attributes["surface_time_ns"]) - level)
    panels = {
        "strength": (along, np.log10(strength), "surface echo (log10 W)"),
        "separation": (along, separation, "far pair after near pair (ns)"),
        "sideways": (across, sideways, "green after red (ns)"),
        "depth": (along, deeper, "bottom too deep (m)"),
    }
    figure = Figure(figsize=(9.6, 7.0), layout="constrained")
    correlations = {}
    for ax, (name, (slope, value, label)) in zip(figure.subplots(2, 2).flat, panels.items(), strict=True):
        known = np.isfinite(value)
        correlations[name] = float(np.corrcoef(slope[known], value[known])[0, 1])
        ax.plot(np.degrees(np.arctan(slope)), value, ".", color="#1f5fd6", markersize=4)
        ax.set_xlabel("mean slope across (deg)" if name == "sideways" else "mean slope towards the lidar (deg)")
        ax.set_ylabel(label)
        ax.set_title(f"correlation {correlations[name]:+.2f}, {known.sum()} shots", fontsize="small")
        ax.grid(True, color="0.9", linewidth=0.7)
        if name == "depth":
            slopes = np.linspace(along.min(), along.max(), 100)
            bias = depth_bias(slopes, depth, off_nadir, index)
            ax.plot(np.degrees(np.arctan(slopes)), bias, color="#d81e1e", label="refraction alone")
            ax.legend(frameon=False)
    figure.suptitle(f"{attributes.get('scene', '')}: {shots.sizes['shot']} shots")
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=160)
    return correlations
