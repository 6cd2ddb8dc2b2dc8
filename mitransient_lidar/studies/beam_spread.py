"""Spread of the laser's light at depth, horizontally and in time."""

from __future__ import annotations

import logging
from typing import Any

import mitsuba as mi
import numpy as np
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Numbers
from mitransient_lidar.core.validation import ArrayLike, BoolArray, FloatArray
from mitransient_lidar.loading.scenes import LoadedScene
from mitransient_lidar.physics.lidar.level_sea import LevelSea
from mitransient_lidar.rendering.passes import TOLERATED_LOSS, Goal, ProgressCallback, run_passes
from mitransient_lidar.results.attributes import label
from mitransient_lidar.transport.medium.water_phases import table_of
from mitransient_lidar.transport.plane_crossings import CrossingTracer, PlaneCrossings
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.scene_parts import find_lidar_scene

logger = logging.getLogger(__name__)

_ABOVE_BOTTOM = 1e-3  #: Smallest distance from a plane to the bottom [m], larger than intersection rounding errors.

#: Number of radii and delays in the distributions, smallest over largest, and largest share of the light beyond them.
_STEPS, _SMALLEST, _BEYOND = 160, 1e-3, 2e-3

_MEASURED = (
    *("transmitted", "unscattered", "in_view", "centroid_x", "centroid_y", "radius_rms", "radius_50", "radius_90"),
    *("shift_rms", "delay_mean", "delay_std", "within_radius", "within_shift", "within_delay"),
)
#: Coordinates of the distributions.
_CURVES = {"within_radius": "radius", "within_shift": "radius", "within_delay": "delay"}

#: Columns of the table: heading, variable, and factor to its unit; and their width.
_COLUMNS = (
    ("passes (%)", "transmitted", 100.0),
    ("direct (%)", "unscattered", 100.0),
    ("in view (%)", "in_view", 100.0),
    ("r50 (m)", "radius_50", 1.0),
    ("r90 (m)", "radius_90", 1.0),
    ("shift (m)", "shift_rms", 1.0),
    ("delay (ns)", "delay_mean", 1.0),
    ("its sd (ns)", "delay_std", 1.0),
)
_COLUMN = 17


def beam_spread(
    session: LoadedScene, depths: Numbers, photons: int, goal: Goal, seed: int, progress: ProgressCallback | None
) -> xr.Dataset:
    """Trace light from the laser to horizontal planes under water, and measure its positions and delays.

    Arguments as of `light_classes.scattering`.

    Result: over ``depth`` [m], increasing: ``transmitted`` and ``unscattered`` (shares of the energy that leaves the
    laser), ``in_view`` (share of the light at the depth), ``centroid_x``, ``centroid_y``, ``radius_rms``,
    ``radius_50``, ``radius_90``, ``shift_rms`` [m], ``delay_mean``, ``delay_std`` [ns]. Over ``depth`` and ``radius``
    [m] or ``delay`` [ns], the light shares ``within_radius``, ``within_shift`` and ``within_delay``. Each has its
    standard error over the passes, ``..._stderr``. Without light, all but the first two are NaN. Raises `UserError` if
    the scene is invalid or has no water, or a number is out of range.

    Light that has not met a solid counts each time that it passes the plane downwards: the result is the downward plane
    irradiance integrated over the plane. Light outside the surface mesh is excluded; its share of the energy is the
    attribute ``beam_outside_surface``.

    Shift and delay are relative to the unscattered continuation of the path on which the light entered the water: they
    exclude the spread by beam, waves and ripples. At oblique incidence some delays are negative.

    Light is in the field of view where its line of sight from the receiver through a level sea is in a pixel. Paths end
    at 50 times the slant distance to the deepest plane, or at a weight below a millionth.
    """
    wanted = np.unique(depths)
    lidar = find_lidar_scene(session.scene, session.sensor)
    lidar.transmitter.pose.require_above_sea()
    planes = _planes(lidar, wanted)
    tracer = CrossingTracer(lidar, planes, photons)
    measured: list[list[dict[str, Any]]] = []
    axes: dict[str, FloatArray] = {}
    outside: list[float] = []

    def render_pass(number: int, _: int) -> float:
        crossings, missed = tracer.trace(seed, number)
        outside.append(missed)
        light = [crossings.select(crossings.downward & (crossings.plane == plane)) for plane in range(len(planes))]
        if not axes:
            axes.update(_axes(light))
        measured.append([_measure(lidar, *pair, axes) for pair in zip(light, planes, strict=True)])
        return 0.0

    log = run_passes(render_pass, goal, seed=seed, progress=progress)
    missed = float(np.mean(outside))
    if missed > TOLERATED_LOSS:
        logger.warning(
            "the surface is smaller than the footprint: %.2g %% of the beam passes outside it and is left out; "
            "enlarge the surface's size",
            100 * missed,
        )
    described = {"photons_per_pass": photons, "beam_outside_surface": missed, **_describe(lidar)}
    return _dataset(measured, wanted, axes, session.attributes(lidar, **log.attributes(seed), **described))


def _planes(lidar: LidarScene, depths: FloatArray) -> FloatArray:
    """Return the depths of the planes [m]; reject those below the bottom."""
    deepest = max((-float(bottom.bbox().min.z) for bottom in lidar.bottoms), default=np.inf)
    if depths[-1] > deepest:
        raise UserError(f"depths = {depths[-1]:g} m must not lie below the bottom, at {deepest:g} m")
    return np.minimum(depths, deepest - _ABOVE_BOTTOM)


def _spreads(light: PlaneCrossings) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return distances from the centroid [m], shifts [m] and delays [ns]."""
    x, y = (np.average(values, weights=light.weight) for values in (light.x, light.y))
    return np.hypot(light.x - x, light.y - y), np.hypot(light.shift_x, light.shift_y), 1e9 * light.delay


def _axes(light: list[PlaneCrossings]) -> dict[str, FloatArray]:
    """Return radii [m] and delays [ns], in equal ratios, up to the largest of all depths."""
    spreads = [(values, part.weight) for part in light if len(part.weight) > 0 for values in _spreads(part)]
    largest = np.array([_quantile(values, weight, 1 - _BEYOND) for values, weight in spreads]).reshape(-1, 3)
    top = {"radius": largest[:, :2].max(initial=0.0), "delay": largest[:, 2].max(initial=0.0)}
    return {name: np.geomspace(_SMALLEST, 1, _STEPS) * (last if last > 0 else 1.0) for name, last in top.items()}


def _quantile(values: FloatArray, weight: FloatArray, share: float) -> float:
    order = np.argsort(values)
    cumulative = np.cumsum(weight[order])
    place = np.searchsorted(cumulative, share * cumulative[-1])
    return float(values[order[min(place, len(values) - 1)]])


def _measure(lidar: LidarScene, light: PlaneCrossings, depth: float, axes: dict[str, FloatArray]) -> dict[str, Any]:
    """Return one plane's variables in one pass."""
    weight, energy = light.weight, lidar.transmitter.energy
    shares = {"transmitted": weight.sum() / energy, "unscattered": weight[light.scatterings == 0].sum() / energy}
    if len(weight) == 0:
        unknown = {name: np.full(len(axes[_CURVES[name]]), np.nan) if name in _CURVES else np.nan for name in _MEASURED}
        return {**unknown, **shares}

    def mean(values: ArrayLike) -> float:
        return float(np.average(np.asarray(values), weights=weight))

    def within(values: FloatArray, limits: FloatArray) -> FloatArray:
        order = np.argsort(values)
        held = np.concatenate(([0.0], np.cumsum(weight[order])))
        return np.asarray(held[np.searchsorted(values[order], limits, side="right")] / held[-1])

    radius, shift, delay = _spreads(light)
    return {
        **shares,
        "in_view": mean(_in_view(lidar, light, depth)),
        "centroid_x": mean(light.x),
        "centroid_y": mean(light.y),
        "radius_rms": np.sqrt(mean(radius**2)),
        "radius_50": _quantile(radius, weight, 0.5),
        "radius_90": _quantile(radius, weight, 0.9),
        "shift_rms": np.sqrt(mean(shift**2)),
        "delay_mean": mean(delay),
        "delay_std": np.sqrt(mean((delay - mean(delay)) ** 2)),
        "within_radius": within(radius, axes["radius"]),
        "within_shift": within(shift, axes["radius"]),
        "within_delay": within(delay, axes["delay"]),
    }


def _in_view(lidar: LidarScene, light: PlaneCrossings, depth: float) -> BoolArray:
    """Return whether the line of sight from the receiver to the light through a level sea is in a pixel."""
    pose, pixels = lidar.receiver.pose, lidar.receiver.pixels
    points = np.stack([light.x, light.y, np.full_like(light.x, -depth)], axis=1)
    seen = np.pad(LevelSea((lidar.refractive_index,)).crossing(pose.origin, points), ((0, 0), (0, 1))) - pose.origin
    angle_x, angle_y = pose.angles_of(seen).T
    _, count = pixels.pixel_at(mi.Float(angle_x), mi.Float(angle_y), mi.Float(0.5))
    return (seen @ pose.axis > 0) & (np.array(count) > 0)


def _describe(lidar: LidarScene) -> dict[str, Any]:
    """Return the attributes of lidar and water."""
    water: Any = lidar.water
    column, boundaries = water.column, water.index_layers.boundaries
    first = 0.0 if water.plume is not None else np.inf
    for layer in range(1, column.count):
        same = all(values[layer] == values[0] for values in (column.attenuation, column.scattering))
        if not (same and water.phases.phases[layer] is water.phases.phases[0]):
            first = min(first, float(column.layer_tops[layer]))
    if len(boundaries):
        first = min(first, float(boundaries[0]))
    return {
        "pulse_energy_mj": 1e3 * lidar.transmitter.pulse_energy,
        "field_of_view_mrad": 1e3 * lidar.receiver.pixels.field_of_view,
        "off_nadir_deg": lidar.transmitter.pose.off_nadir_deg,
        "refractive_index": lidar.refractive_index,
        "group_index": lidar.group_index,
        "absorption": float(column.absorption[0]),
        "scattering": float(column.scattering[0]),
        "mean_cosine": table_of(water.phases.phases[0]).mean_cosine,
        "uniform_down_to": first,
    }


def _dataset(
    measured: list[list[dict[str, Any]]], depths: FloatArray, axes: dict[str, FloatArray], attributes: dict[str, Any]
) -> xr.Dataset:
    """Return means and standard errors over the passes."""
    data: dict[str, Any] = {}
    for name in _MEASURED:
        values = np.array([[row[name] for row in rows] for rows in measured])
        error = values.std(axis=0, ddof=1) / np.sqrt(len(values))
        dims = ("depth", _CURVES[name]) if name in _CURVES else ("depth",)
        data |= {name: (dims, values.mean(axis=0)), f"{name}_stderr": (dims, error)}
    coordinates = {"depth": depths, "radius": axes["radius"], "delay": axes["delay"]}
    return label(xr.Dataset(data, coords=coordinates, attrs=attributes), "spread")


def describe_spread(spread: xr.Dataset) -> list[str]:
    """Return table lines for a result of `beam_spread`, with standard errors."""
    lines = ["".join(f"{heading:>{_COLUMN}}" for heading in ("depth (m)", *(column[0] for column in _COLUMNS)))]
    for row in (spread.isel(depth=depth) for depth in range(spread.sizes["depth"])):
        cells = [f"{float(row['depth']):.4g}"]
        for _, name, factor in _COLUMNS:
            value, error = (factor * float(row[key]) for key in (name, f"{name}_stderr"))
            digits = min(max(-int(np.floor(np.log10(error))), 0), 4) if error > 0 else 4
            cells.append(f"{value:.{digits}f} ± {error:.{digits}f}" if np.isfinite(value) else "-")
        lines.append("".join(f"{cell:>{_COLUMN}}" for cell in cells))
    return lines
