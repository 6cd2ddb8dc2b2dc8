"""Sea locations with given surface slopes, and the effects of slopes on the echoes of a series of shots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.analysis.retrieval.surface_slope import SlopeRefraction
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, Scene, checked, positive_option
from mitransient_lidar.core.tables.written import table_lines
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.loading import variants
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.physics.lidar.pose import Pose
from mitransient_lidar.rendering.passes import ProgressCallback
from mitransient_lidar.rendering.shots.series import render_shots
from mitransient_lidar.rendering.shots.truth import SLOPE_KINDS, SeaMap, Shot, footprint, transmitter_of
from mitransient_lidar.results.attributes import label
from mitransient_lidar.results.geometry import lidar_geometry
from mitransient_lidar.transport.sensor.receiver import Receiver

_MOST_MAPPED_PIXELS = 64  #: Largest number of pixels whose footprints are mapped.

_PASSES = 12


@dataclass(frozen=True)
class RenderedShots:
    """Shots in a scene, their results, the sea, and the footprints of beam and pixels on the mean sea level."""

    scene: str
    shots: tuple[Shot, ...]
    results: list[xr.Dataset]
    sea: SeaMap
    #: Beam azimuth [rad], and standard deviations of its footprint along and across it [m].
    azimuth: float
    beam_spread: tuple[float, float]
    #: Grid lines of a map about a shot [m], shape (n,), the pixel index at each node, shape (n, n), rows along y, and
    #: the number of pixels. The index is -1 outside all pixels, and everywhere with more than 64 pixels.
    pixel_lines: FloatArray
    pixel_map: npt.NDArray[np.int64]
    pixel_count: int


@checked
@alone
def find_shots(
    scene: Scene,
    params: Mapping[str, Any] | None = None,
    *,
    at: Annotated[Sequence[tuple[float, float]], Option("A location, instead of a search", unit="m", form="X,Y")] = (),
    slope_sigmas: Annotated[float, positive_option("Slopes to find, in standard deviations")] = 2.0,
    count: Annotated[int, Option("Locations of each kind", 1, 100)] = 1,
    waveforms: Annotated[bool, Option("Also render the shots")] = True,
    max_time: Annotated[
        float | None, positive_option("Stop before this many seconds, with fewer passes or waveforms")
    ] = None,
    progress: ProgressCallback | None = None,
) -> RenderedShots:
    """Find locations for each kind of slope on a scene's sea, within 256 m of its origin, and render them.

    Where the lidar's aim is more than 250 m from the origin, they are about the aim.

    Parameters
    ----------
    scene, params, progress
        As for `rendering.shots.series.render_shots`: an XML scene with the parameters ``aim_x`` and ``aim_y``.

    Returns
    -------
    RenderedShots
        Shots by kind, the nearest slopes first.

    Raises
    ------
    UserError
        If the scene is invalid or has no waves, a number is out of range, or the sea has no such slopes.
    """
    loaded = open_scene(scene, params).scene
    sea = SeaMap.of_scene(loaded)
    if len(at):
        shots = [Shot(f"shot {number}", x, y, *sea.slope_at(x, y)) for number, (x, y) in enumerate(at, start=1)]
    else:
        apart = 4 * footprint(transmitter_of(loaded))[1]
        shots = [shot for kind in SLOPE_KINDS for shot in sea.find(kind, slope_sigmas, count, apart)]
    return render_found_shots(scene, shots, params, waveforms=waveforms, max_time=max_time, progress=progress)


def describe_found_shots(rendered: RenderedShots) -> list[str]:
    """Return table lines for locations and slopes."""
    columns = (("kind", "<10"), ("aim_x", ">10.2f"), ("aim_y", ">10.2f"), ("along (deg)", ">13.2f"))
    angles = [np.degrees(np.arctan([shot.along, shot.across])) for shot in rendered.shots]
    rows = [(shot.kind, shot.x, shot.y, *pair) for shot, pair in zip(rendered.shots, angles, strict=True)]
    return table_lines((*columns, ("across (deg)", ">14.2f")), rows)


@alone
def render_found_shots(
    scene: Any,
    shots: Sequence[Shot],
    params: Mapping[str, Any] | None = None,
    *,
    waveforms: bool = True,
    max_time: float | None = None,
    progress: ProgressCallback | None = None,
) -> RenderedShots:
    """Render shots of a scene with the parameters ``aim_x`` and ``aim_y``, and map sea and footprints.

    `results` may hold the first shots alone. Raises `UserError` if the scene is invalid or has no waves.
    """
    if waveforms:
        variants.leave_the_gpu("shots are rendered")
    session = open_scene(scene, params)
    loaded = session.scene
    sea = SeaMap.of_scene(loaded)
    results: list[xr.Dataset] = []
    if waveforms:
        places = [(shot.x, shot.y) for shot in shots]
        series = render_shots(scene, params, positions=places, passes=_PASSES, max_time=max_time, progress=progress)
        results = [series.isel(shot=number) for number in range(series.sizes["shot"])]
    azimuth, along, across = footprint(transmitter_of(loaded))
    lines, pixel_map = _pixel_map(session.sensor.receiver)
    count = session.sensor.receiver.pixels.count
    return RenderedShots(session.name, tuple(shots), results, sea, azimuth, (along, across), lines, pixel_map, count)


def _pixel_map(receiver: Receiver) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Return `pixel_lines` and `pixel_map` of `RenderedShots`."""
    pose: Pose = receiver.pose
    centre = pose.ground_point()
    reach = 0.6 * receiver.pixels.field_of_view * pose.ground_range / -float(pose.axis[2])
    lines = np.linspace(-reach, reach, 301)
    x, y = np.meshgrid(lines, lines)
    if receiver.pixels.count > _MOST_MAPPED_PIXELS:
        return lines, np.full(x.shape, -1)
    points = np.stack([x + centre[0], y + centre[1], np.zeros_like(x)], axis=-1).reshape(-1, 3)
    angle_x, angle_y = pose.angles_of(points - pose.origin).astype(np.float32).T
    index, held = receiver.pixels.pixel_at(mi.Float(angle_x), mi.Float(angle_y), mi.Float(0.5))
    return lines, np.where(np.array(held) > 0, np.array(index).astype(int), -1).reshape(x.shape)


_HALF_GATE_NS = 10.0  #: Half width of the gates about the echoes from a level sea [ns].


def shot_statistics(series: xr.Dataset) -> xr.Dataset:
    """Measure the echoes of shots at locations on one sea, for their dependence on its slopes.

    Raises `UserError` if the scene has no bottom, or the record lacks an echo.

    `series`: a result of `rendering.shots.series.render_shots` for a scene with the parameter ``bottom_depth``.

    Result: over ``shot``: ``aim_x``, ``aim_y`` [m], ``slope_along``, ``slope_across`` (mean over the beam's footprint,
    positive along for a face towards the lidar, [1]). Over ``shot`` and ``pixel``: ``surface_peak``, ``bottom_peak``
    [W], ``surface_time``, ``bottom_time`` [ns] at the waveform's highest point in a 20 ns gate about the echo from a
    level sea; NaN where it lies at a gate limit.
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
