"""Records that contain all light in a scene: their start and their number of time bins."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.axis_limits import COLUMN_LEVEL, Cone, LidarView, Solid, system_attenuation
from mitransient_lidar.physics.lidar.gate_train import GatePlan
from mitransient_lidar.physics.lidar.pulse import FWHM_PER_SIGMA
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.water_types import InherentProperties
from mitransient_lidar.transport.opaque import opaque, opaque_point
from mitransient_lidar.transport.plugin_types import GatedFilm, OwnPlugin, Transmitter
from mitransient_lidar.transport.probe import Rays
from mitransient_lidar.transport.scene import WaterScene
from mitransient_lidar.transport.sensor.receiver import SensorSampler
from mitransient_lidar.transport.solids import box_of

_REFLECTED = 0.1  #: Share of beam or view rays that the sea must reflect totally for the record to end there.

#: Least time of a fitted record before the first and after the last light [ns], and more after it in response times.
_MARGIN_NS, _RESPONSE_TIMES = 12.0, 12.0

NEAREST_RANGE = 0.05  #: Smallest record range for a lidar under water with laser and receiver at one location [m].

#: Bins before the surface echo in which its detection measures the noise, and the longest extension for them [ns].
_QUIET_BINS, _LONGEST_NS = 10, 100.0


def fitted_axis(
    scene: WaterScene, transmitter: Transmitter, film: GatedFilm, shifts: Iterable[tuple[float, float]] = ((0.0, 0.0),)
) -> tuple[TimeAxis, str]:
    """Return a film's time bins for all light that returns, and the source of the last light.

    `shifts` are horizontal displacements of a lidar above water [m]: the bins contain the light at all its positions.

    Raises UserError if the bins are too many.
    """
    lead, tail = (max(span, _MARGIN_NS) for span in transmitter.pulse.span_ns)
    tail += _RESPONSE_TIMES * scene.receiver.optics.response_time_ns
    latest, given = np.inf, film.time_start_ns
    if transmitter.pose.submerged:
        first, last, end, latest = _light_under_water(scene, transmitter, film.gates)
        start = first - lead
        if given is None and (earliest := earliest_ns(scene, transmitter)) is not None:
            given = np.ceil(earliest / film.bin_width_ns) * film.bin_width_ns
    else:
        first, last, end, higher_ns = _light_above_water(scene, transmitter, film.gates, shifts)
        start = first - lead
        if scene.surfaces:
            quiet = _quiet_until(scene, transmitter) - higher_ns - _QUIET_BINS * film.bin_width_ns
            start = min(start, max(quiet, start - _LONGEST_NS))
    axis = TimeAxis.covering(start, last + tail, film.bin_width_ns, given, film.bin_count)
    if film.bin_count is None and axis.end_ns > latest:
        bins = max(int((latest - axis.start_ns) / axis.bin_width_ns), 1)
        return replace(axis, bin_count=bins), "where the sea reflects beam or view totally"
    return axis, end


def _light_above_water(
    scene: WaterScene, transmitter: Transmitter, gates: GatePlan | None, shifts: Iterable[tuple[float, float]]
) -> tuple[float, float, str, float]:
    """Return the first and the last light's times [ns], the last light's source, and land's lead.

    Land and other solids above the sea return the first light earlier than it by this time [ns].
    """
    solids = [Solid(_name(shape), _triangles(shape)) for shape in scene.solids]
    found = [
        _lidar_view(scene, transmitter, shift).limits(solids, gates is not None, _is_dry(scene, transmitter, shift))
        for shift in dict.fromkeys((float(x), float(y)) for x, y in shifts)
    ]
    first = min(found, key=lambda each: each.first_ns)
    last = max(found, key=lambda each: each.last_ns)
    higher_ns = max(first.surface_ns[0] - first.first_ns, 0.0)
    return *_with_gates(scene, gates, first.first_ns, last.last_ns, last.end), higher_ns


def _is_dry(scene: WaterScene, transmitter: Transmitter, shift: tuple[float, float]) -> bool:
    """Return whether all rays in the view, or in the beam, of a displaced lidar [m] meet solids above the sea."""
    lowest, highest = scene.sea_heights or (0.0, 0.0)
    if not scene.surfaces or all(float(solid.bbox().max.z) <= highest for solid in scene.solids):
        return False
    both = Rays.of_view(scene, SensorSampler(scene.receiver, transmitter)), Rays.of_beam(scene, transmitter)
    for rays in both:
        moved = replace(rays, pose=replace(rays.pose, origin=np.add(rays.pose.origin, [*shift, 0.0])))
        on_land = moved.first.is_valid() & ~moved.on_sea & (moved.first.p.z > opaque(lowest))
        if dr.all(on_land | ~moved.seen)[0]:
            return True
    return False


def _with_gates(
    scene: WaterScene, gates: GatePlan | None, first: float, last: float, end: str
) -> tuple[float, float, str]:
    """Return limits that also hold the gates."""
    if gates is None:
        return first, last, end
    spans = scene.gate_train(gates).spans_ns
    end = "after the last gate" if spans[-1, 1] > last else end
    return min(first, spans[0, 0]), max(last, spans[-1, 1]), end


def earliest_ns(scene: WaterScene, transmitter: Transmitter) -> float | None:
    """Return the earliest start of a record under water [ns]; None for a laser away from the receiver.

    At one place, they return without limit from less and less range.
    """
    apart = float(np.linalg.norm(transmitter.pose.origin - scene.receiver.pose.origin))
    return 2e9 / C0 * scene.group_index * NEAREST_RANGE if apart < NEAREST_RANGE else None


def _light_under_water(
    scene: WaterScene, transmitter: Transmitter, gates: GatePlan | None
) -> tuple[float, float, str, float]:
    """Return the same for a lidar under water, and when the sea first reflects beam or view totally [ns].

    The first light is scattered at the lidar. The last light is the farthest echo in beam and view, plus a quarter of
    its time and 40 ns for multiply scattered light. If nearer, it comes from the range where the water's signal has
    fallen to 1e-6. The signal is exp(-2 K s) with the column's least diffuse attenuation K.
    """
    view = Rays.of_view(scene, SensorSampler(scene.receiver, transmitter))
    beam = Rays.of_beam(scene, transmitter)
    visible = -0.5 * np.log(COLUMN_LEVEL) / max(float(_kd(scene.required_water.column).min()), 1e-9)
    ends = [float(rays.ranges.max()) for rays in (view, beam)]
    to_solid = max(ends) if np.isfinite(ends).all() else min(ends)
    apart = float(np.linalg.norm(transmitter.pose.origin - scene.receiver.pose.origin))
    echo = 2e9 / C0 * scene.group_index * (min(to_solid, visible) + apart)
    end = "after the farthest echo" if to_solid <= visible else f"at a range of {visible:.3g} m"
    return *_with_gates(scene, gates, 0.0, 1.25 * echo + 40.0, end), total_reflection_ns(view, beam)


def total_reflection_ns(view: Rays, beam: Rays) -> float:
    """Return when light of a lidar under water first meets the sea beyond its critical angle, and comes back [ns].

    Infinite where less than a tenth of beam and view does so. Reflection alone shows the scene beyond, by few paths and
    in cells about an axis that light has left: it is not rendered.
    """
    found, scene = [np.inf], view.scene
    lidar = [opaque_point(rays.pose.origin) for rays in (beam, view)]
    for rays in (view, beam):
        si = rays.first
        beyond = rays.on_sea & (opaque(scene.refractive_index**2) * (1 - dr.square(si.wi.z)) > 1)
        time_ns = opaque(1e9 / C0 * scene.group_index) * (dr.norm(si.p - lidar[0]) + dr.norm(si.p - lidar[1]))
        if dr.count(beyond)[0] > _REFLECTED * len(rays.directions):
            found.append(float(dr.min(dr.select(beyond, time_ns, dr.inf))[0]))
    return min(found)


def _quiet_until(scene: WaterScene, transmitter: Transmitter) -> float:
    """Return the end [ns] of the time that echo detection uses as the noise baseline (`analysis.waveforms.records`)."""
    pose, field = transmitter.pose, scene.receiver.pixels.field_of_view
    spot = pose.ground_point()
    arrival = sum(float(np.linalg.norm(spot - origin)) for origin in (pose.origin, scene.receiver.pose.origin))
    angle = np.deg2rad(min(pose.off_nadir_deg, 89.9))
    slope = 2 * float(pose.origin[2]) * np.sin(angle) / np.cos(angle) ** 2
    spread = FWHM_PER_SIGMA * min(transmitter.widest_angular_spread, 0.25 * field) * slope
    pulse_ns = transmitter.pulse.fwhm_ns + 2 * scene.receiver.optics.response_time_ns
    width_ns = float(np.hypot(pulse_ns, 1e9 / C0 * spread))
    return float(1e9 / C0 * (arrival - 0.5 * field * slope) - 2 * width_ns)


def _lidar_view(scene: WaterScene, transmitter: Transmitter, shift: tuple[float, float]) -> LidarView:
    """Return a lidar's geometry, displaced horizontally [m], over the level sea in a scene."""
    pixels, blur, pose = scene.receiver.pixels, scene.receiver.blur, scene.receiver.pose
    sides = pixels.sides or (pixels.field_of_view, pixels.field_of_view)
    blurred = 0.0 if blur is None else blur.reach
    half_angles = 0.5 * sides[0] + blurred, 0.5 * sides[1] + blurred
    edge = transmitter.profile.reach
    poses = [replace(each, origin=np.add(each.origin, [*shift, 0.0])) for each in (pose, transmitter.pose)]
    view = Cone(poses[0], half_angles, pixels.field_of_view_shape == "circle")
    beam = Cone(poses[1], (edge, edge))
    corners = np.reshape([box_of(shape) for shape in scene.mitsuba_scene.shapes()], (-1, 3))[:, :2]
    farthest = [np.abs(corners - each.origin[:2]).max(axis=0) for each in poses if len(corners)]
    reach = max((float(np.hypot(*each)) for each in farthest), default=float(pose.origin[2]))
    none, deepest = np.zeros(1), None
    decay = WaterColumn(none, none, none, none)
    if scene.water is not None:
        column, plume = scene.water.column, scene.water.plume
        spot = pose.ground_range * np.hypot(pixels.field_of_view, 4 * transmitter.widest_angular_spread)
        attenuation = system_attenuation(column.attenuation, np.minimum(_kd(column), column.attenuation), spot)
        none, deepest = np.zeros(column.count), 0.0 if plume is None else plume.depth
        decay = WaterColumn(column.layer_tops, attenuation, none, none)
    return LidarView(view, beam, scene.level_sea, decay, scene.sea_heights or (0.0, 0.0), reach, deepest)


def _kd(column: WaterColumn) -> FloatArray:
    """Return each layer's diffuse attenuation coefficient [1/m]."""
    rows = zip(column.absorption, column.scattering, column.backscattering, strict=True)
    return np.array([InherentProperties(*map(float, row)).kd for row in rows])


def _name(shape: mi.Shape) -> str:
    """Return a shape's id, else its type."""
    return str(shape.id() or (shape.parameters["type"] if isinstance(shape, OwnPlugin) else shape.class_name()))


def _triangles(shape: mi.Shape) -> FloatArray:
    """Return a mesh's or rectangle's triangles, or the top and bottom of another shape's bounding box [m]."""
    known = mi.traverse(shape)
    if "vertex_positions" in known:
        vertices = np.array(known["vertex_positions"], dtype=np.float64).reshape(-1, 3)
        return np.asarray(vertices[np.array(known["faces"]).reshape(-1, 3)])
    square = np.array([[-1.0, -1, 0, 1], [1, -1, 0, 1], [1, 1, 0, 1], [-1, 1, 0, 1]])
    if "Rectangle" in shape.class_name():
        matrix = np.array(known["to_world"].matrix, dtype=np.float64).reshape(4, 4)
        corners = (square @ matrix.T)[None, :, :3]
    else:
        low, high = box_of(shape)
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        corners = np.array([middle + (square[:, :3] + [0, 0, side]) * half for side in (-1.0, 1.0)])
    return np.asarray(corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3))
