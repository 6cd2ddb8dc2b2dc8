"""Fast estimate of the waveforms of a scene over a level sea."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import xarray as xr

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Instrument, Option, Scene, Seed, checked
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.loading.exclusive import alone
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.physics.lidar.echo_estimate import Arrivals, EchoEstimate
from mitransient_lidar.physics.lidar.lidar_geometry import LidarGeometry, LidarSystem
from mitransient_lidar.physics.sea.double_passage import (
    LEAST_DEPTH,
    EnhancementTable,
    slope_spread,
    slope_structures,
)
from mitransient_lidar.rendering.accumulators import PassAccumulator
from mitransient_lidar.rendering.accuracy import ErrorWindow

if TYPE_CHECKING:
    from mitransient_lidar.transport.scene import LidarScene

logger = logging.getLogger(__name__)

#: Independent parts of the paths, for standard errors.
_PARTS = 8

#: Largest number of pixels, of paths, and of their points at once.
_MOST_PIXELS, _MOST_PATHS, _MOST_POINTS = 1024, 2**22, 2**21

#: Steps of depth: a bin or this share of the pulse, within these limits.
_STEPS_OF_PULSE, _FEWEST_STEPS, _MOST_STEPS = 0.3, 64, 1024

#: Optical depth of absorption and backscattering, one way, from which the water is dark.
_DARK = 8.0

#: Number of depths of the table of the enhancement.
_DEPTHS = 20

#: Largest distance of transmitter and receiver over the altitude, and angle between their axes over the view.
_APART = 0.01

#: Largest height of a level bottom over its depth.
_LEVEL = 0.01

#: Largest number of 32 bits below 1.
_BELOW_ONE = np.float32(1 - 2**-24)

_ORIGINS = ("surface", "water", "bottom")


@checked
@alone
def estimate(
    scene: Scene,
    params: Mapping[str, Any] | None = None,
    *,
    instrument: Instrument = None,
    paths: Annotated[int, Option("Number of paths of the light", 64, _MOST_PATHS)] = 2**13,
    seed: Seed = 0,
) -> xr.Dataset:
    """Estimate the waveforms of a scene in about a second, as a first look and a second opinion.

    Parameters
    ----------
    scene, params
        As for `rendering.render.render`.

    Returns
    -------
    xarray.Dataset
        As of `rendering.render.render` with ``components``, for the origins surface, water and bottom.

    Raises
    ------
    UserError
        If the scene is invalid, or not one that the model is for; if a number is out of range.

    Notes
    -----
    The model is `physics.lidar.echo_estimate.EchoEstimate`: the sea is level, with all of its slopes as ripples, so
    that the result is a mean over seas, enhanced by the focusing of all waves (`physics.sea.double_passage`); the water
    has layers of one refractive index; the bottom is level and Lambertian. Targets, bubbles and slopes of the bottom
    are left out. Light that large angles turn more than once is missing.

    Compared with renders of ``table1`` over a level sea, in Jerlov's types 1C and 3C and with bottoms at 4 to 12 m, the
    surface agrees within 0.1 % and the water has 2 to 3 % too little energy, in 5C 4 to 6 %, and 8 % in views of 60 and
    200 mrad. The bottom agrees within 3 % of its energy up to 8 attenuation lengths; beyond, where its light is late,
    it has too little: 10 % at 12 and 27 % at 18 attenuation lengths (5C at 8 and 12 m). Over waves of 3 and 6 m/s the
    result is the mean over seas. In the turbid layers of ``fig15_2x2``, c of 0.9 and 0.5, the bottom had 3 to 13 % too
    little.
    """
    session = open_scene(scene, params, instrument=instrument)
    from mitransient_lidar.rendering.describe import describe_scene, with_lines_of_sight
    from mitransient_lidar.transport.paths.ripple_focusing import RippleFocusing
    from mitransient_lidar.transport.probe import Probe
    from mitransient_lidar.transport.scene_parts import find_lidar_scene

    lidar = find_lidar_scene(session.scene, session.sensor)
    model = _model(lidar)
    session.tell_axis(lidar.axis, lidar.record_end)
    probe = Probe(lidar)
    window = ErrorWindow.of_probe(probe)
    accumulator = PassAccumulator(lidar, window, origins=_ORIGINS)
    for generator in np.random.SeedSequence(seed).spawn(_PARTS):
        accumulator.add(_record(lidar, model, paths // _PARTS, np.random.default_rng(generator)))
    accumulator.require_light(_PARTS)
    described = describe_scene(probe, window, RippleFocusing.of_scene(lidar))
    attributes = session.attributes(lidar, model="estimate", paths=paths, seed=seed, **described)
    return with_lines_of_sight(accumulator.dataset(attributes), lidar)


def describe_estimate(found: xr.Dataset) -> list[str]:
    """Return the lines of a table of a result of `estimate`: energy, and peak power with its time, by origin."""
    energy, power = found["impulse_response_by_origin"], found["waveform_by_origin"]
    over = [dim for dim in power.dims if dim not in ("origin", "time")]
    lines = [f"{'all pixels':<12}{'energy (J)':>12}{'peak (W)':>12}{'at (ns)':>10}"]
    for name in found["origin"].values:
        received = float(energy.sel(origin=name).sum())
        curve = power.sel(origin=name).sum(over)
        peak = (
            f"{float(curve.max()):>12.3e}{float(curve['time'][int(np.argmax(curve.values))]):>10.1f}"
            if received > 0
            else ""
        )
        lines.append(f"{name!s:<12}{received:>12.3e}{peak}")
    return lines


def _model(lidar: LidarScene) -> EchoEstimate:
    """Return the model of a scene; refuse scenes that it is not for."""
    from mitransient_lidar.transport.medium.water_phases import table_of

    lidar.transmitter.pose.require_above_sea()
    water, pose, pixels = lidar.required_water, lidar.receiver.pose, lidar.receiver.pixels
    if water.plume is not None:
        raise UserError(
            "the scene has bubbles, which an estimate lacks: plume_scattering and bubble_wind_speed must be 0"
        )
    if len(water.index_layers.boundaries):
        raise UserError("the layers of the water have different indices: an estimate needs one refractive index")
    if pixels.count > _MOST_PIXELS:
        raise UserError(f"the receiver has {pixels.count} pixels: an estimate takes at most {_MOST_PIXELS}")
    apart = np.linalg.norm(pose.origin - lidar.transmitter.pose.origin) / pose.origin[2]
    across = np.linalg.norm(pose.axis - lidar.transmitter.pose.axis) / pixels.field_of_view
    if max(apart, across) > _APART:
        raise UserError("transmitter and receiver must be at one place and have one axis for an estimate")
    if lidar.targets:
        logger.warning("the estimate leaves out %s", ", ".join(repr(target.id()) for target in lidar.targets))
    energy = lidar.transmitter.energy * lidar.receiver.optics.collection
    geometry = LidarGeometry.of_pose(pose, lidar.refractive_index, lidar.group_index)
    system = LidarSystem(**vars(geometry), energy=energy, aperture_area=1.0)
    depth, reflectance = _bottom(lidar)
    phases = [table_of(phase) for phase in water.phases.phases[: water.column.count]]
    covariance, ratio = _slopes(lidar)
    enhancement = _enhancement(lidar, depth)
    return EchoEstimate(system, water.column, phases, covariance, depth, reflectance, enhancement, ratio)


def _bottom(lidar: LidarScene) -> tuple[float, float]:
    """Return the depth of the bottom, or of the last light [m], and its reflectance."""
    import mitsuba as mi

    from mitransient_lidar.transport.plugin_types import OwnPlugin
    from mitransient_lidar.transport.solids import scene_of_shapes

    column = lidar.required_water.column
    if not lidar.bottoms:
        darkest = _DARK / max(float((column.absorption + column.backscattering).min()), 1e-3)
        return min(darkest, 1e-9 * C0 / 2 * (lidar.axis.end_ns - lidar.axis.start_ns)), 0.0
    bsdf = lidar.bottoms[0].bsdf()
    if isinstance(bsdf, OwnPlugin) and bsdf.parameters.get("model") == "hapke":
        raise UserError("model = 'hapke' gives the bottom an opposition effect, which an estimate lacks")
    place = lidar.receiver.pose.ground_point()
    start = mi.Point3f(float(place[0]), float(place[1]), float(lidar.empty_heights[1]))
    si = scene_of_shapes(lidar.bottoms, lidar.groups).ray_intersect(mi.Ray3f(start, mi.Vector3f(0, 0, -1)))
    box = lidar.bottoms[0].bbox()
    depth, height = -float(si.p.z[0]), float(box.max.z - box.min.z)
    if not (si.is_valid()[0] and depth > 0):
        raise UserError("the axis of the receiver must meet water above the bottom for an estimate")
    if height > _LEVEL * depth:
        logger.warning("the estimate takes the bottom as level, at its depth of %.3g m on the axis", depth)
    return depth, float(np.array(si.bsdf().eval_diffuse_reflectance(si))[0, 0])


def _slopes(lidar: LidarScene) -> tuple[FloatArray, Callable[[FloatArray], FloatArray] | None]:
    """Return the covariance of the sea's slopes away from nadir and to the left, shape (2, 2), and their series."""
    sea = next((found.sea for found in lidar.seas), None)
    if sea is None:
        return np.diag([0.5 * lidar.slope_variance] * 2), None
    variances = np.add(sea.resolved_variance, sea.ripple_variance)
    far = lidar.receiver.pose.far
    turn = sea.wind_direction - math.atan2(far[1], far[0])
    axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    covariance = np.asarray(axes @ np.diag(variances) @ axes.T)
    if sea.slope_series is None:
        return covariance, None
    series = sea.slope_series.of_part(sea.ripple_variance, tuple(variances))

    def ratio(slopes: FloatArray) -> FloatArray:
        downwind, crosswind = (slopes @ axes / np.sqrt(variances)).T
        return np.asarray(series.ratio(crosswind, -downwind))

    return covariance, ratio


def _enhancement(lidar: LidarScene, deepest: float) -> Callable[[FloatArray, FloatArray], FloatArray] | None:
    """Return the enhancement of echoes by all slopes of the sea; None where they are independent on both ways."""
    sea = next((found.sea for found in lidar.seas), None)
    if sea is None or sea.focusing_spectrum is None:
        return None
    structure, _ = slope_structures(sea.focusing_spectrum, sum(sea.resolved_variance), sum(sea.ripple_variance))
    depths = np.geomspace(LEAST_DEPTH, max(deepest, 2 * LEAST_DEPTH), _DEPTHS)
    spread = slope_spread(math.radians(lidar.receiver.pose.off_nadir_deg), lidar.refractive_index)
    table = EnhancementTable.of(structure, depths, spread)
    return table.at


class _Histogram(NamedTuple):
    """Energy of a part of the paths."""

    values: FloatArray  # [J], shape (pixels, origins, bins)

    def energy(self) -> FloatArray:
        return self.values


def _record(lidar: LidarScene, model: EchoEstimate, paths: int, rng: np.random.Generator) -> Any:
    """Return the histogram of paths."""
    span_ns = 2e9 / C0 * model.system.group_index * model.bottom_depth
    step_ns = max(lidar.axis.bin_width_ns, _STEPS_OF_PULSE * lidar.transmitter.pulse.fwhm_ns)
    steps = int(np.clip(math.ceil(span_ns / step_ns), _FEWEST_STEPS, _MOST_STEPS))
    total = np.zeros((lidar.receiver.pixels.count, len(_ORIGINS), lidar.axis.bin_count))
    size = _MOST_POINTS // steps
    for first in range(0, paths, size):
        count = min(size, paths - first)
        beam = _beam(lidar, count, rng)
        found = model.surface(beam), *model.water_and_bottom(beam, steps, rng)
        total += count / paths * np.stack([_binned(lidar, each, rng) for each in found], axis=1)
    return _Histogram(total)


def _beam(lidar: LidarScene, count: int, rng: np.random.Generator) -> FloatArray:
    """Return points of the beam in the tangent plane [rad], shape (count, 2): a lattice, shifted at random."""
    import mitsuba as mi

    number = np.arange(count)
    lattice = np.stack([(number + 0.5) / count, number * 0.6180339887498949 % 1], axis=1)
    points = ((lattice + rng.random(2)) % 1).T.astype(np.float32)
    # Numbers next to 1 are rounded to it in 32 bits.
    x, y = lidar.transmitter.sample_tangent(mi.Point2f(np.minimum(points, _BELOW_ONE)))
    return np.stack([np.array(x, dtype=np.float64), np.array(y, dtype=np.float64)], axis=1)


def _binned(lidar: LidarScene, light: Arrivals, rng: np.random.Generator) -> FloatArray:
    """Return energies in pixels and time bins, shape (pixels, bins)."""
    import drjit as dr
    import mitsuba as mi

    axis, pixels = lidar.axis, lidar.receiver.pixels
    light = Arrivals(*(np.ascontiguousarray(each).ravel() for each in np.broadcast_arrays(*light)))
    angle_x, angle_y = mi.Float(light.angle_x), mi.Float(light.angle_y)
    if lidar.receiver.blur is not None:
        dx, dy = lidar.receiver.blur.sample(mi.Point2f(rng.random((2, light.energy.size), dtype=np.float32)))
        angle_x, angle_y = angle_x + dx, angle_y + dy
    pixel, number = pixels.pixel_at(angle_x, angle_y, mi.Float(rng.random(light.energy.size, dtype=np.float32)))
    dr.eval(pixel, number)
    time = np.floor((light.time_ns - axis.start_ns) / axis.bin_width_ns)
    seen = (np.array(number) > 0) & (time >= 0) & (time < axis.bin_count)
    cell = np.array(pixel, dtype=np.int64)[seen] * axis.bin_count + time[seen].astype(np.int64)
    energy = light.energy[seen] * np.array(number, dtype=np.float64)[seen]
    found = np.bincount(cell, energy, pixels.count * axis.bin_count)
    return np.asarray(found.reshape(pixels.count, axis.bin_count), dtype=np.float64)
