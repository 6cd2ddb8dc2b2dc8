"""Find and check the parts of a loaded scene that the integrators need."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.fields import is_green
from mitransient_lidar.core.validation import shown
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.sea.sea_mesh import Footprint
from mitransient_lidar.transport import plugin_types
from mitransient_lidar.transport.contacts import separate_contacts
from mitransient_lidar.transport.fitted_axis import fitted_axis
from mitransient_lidar.transport.medium.water import Water
from mitransient_lidar.transport.opaque import opaque_point
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.scene import LidarScene, WaterScene, solids_of
from mitransient_lidar.transport.sensor.receiver import Receiver
from mitransient_lidar.transport.solids import bottom_depths, children, shape_groups, without_unseen

logger = logging.getLogger(__name__)

_MANY_INSTANCES = 20  #: Largest number of instances without a warning about the time that they need.

#: Total slope variance assumed for a surface without a known one: a broad distribution covers any sea.
_UNKNOWN_SLOPE_VARIANCE = 0.04

_SAME_NM = 1.0  #: Wavelength difference that changes no water [nm].
_SAME_INDEX = 1e-3  #: Relative refractive index difference that does not matter, more than the index of air.
_SMALLEST_RISE = 0.1  #: Vertical component of an axis under water above which it looks up.


def find_lidar_scene(
    scene: mi.Scene,
    sensor: mi.Sensor,
    receiver: Receiver | None = None,
    shifts: Iterable[tuple[float, float]] = ((0.0, 0.0),),
    axis: TimeAxis | None = None,
) -> LidarScene:
    """Find the parts in a loaded scene; sun and sky are ignored. `receiver` replaces the sensor's own.

    `axis` states the time bins that the film does not. Without it they contain the light at all lidar positions, above
    water displaced by `shifts` (x, y) [m].

    Raises UserError when a part is missing, not supported, or there are several where one is allowed.
    """
    fit_seas(scene)
    receiver = receiver or find_receiver(sensor)
    film = sensor.film()
    if not isinstance(film, plugin_types.GatedFilm):
        raise UserError("film: the lidar integrators need a time_gated_film inside the sensor")
    emitters = [emitter for emitter in scene.emitters() if not isinstance(emitter, plugin_types.Daylight)]
    transmitters = [emitter for emitter in emitters if isinstance(emitter, plugin_types.Transmitter)]
    if len(transmitters) != 1 or len(emitters) != 1:
        raise UserError(
            f"emitters: the scene has {len(emitters)} of which {len(transmitters)} are lidar_transmitter; "
            "allowed is exactly one lidar_transmitter, besides sun and sky"
        )
    parts = find_solids(scene, receiver)
    _check_wavelength(parts.water, transmitters[0])
    if not _check_place(parts, transmitters[0]):
        _check_cells(parts.surfaces, transmitters[0])
    axis, end = film.axis or axis, ""
    if axis is None:
        # The bins are the sensor's, even if another receiver replaces its own.
        axis, end = fitted_axis(replace(parts, receiver=find_receiver(sensor)), transmitters[0], film, shifts)
    end = end if film.bin_count is None else ""
    return LidarScene(**vars(parts), transmitter=transmitters[0], axis=axis, gates=film.gates, record_end=end)


def lidar_sensor(scene: mi.Scene, wanted: str = "") -> mi.Sensor:
    """Return the receiver among a scene's sensors, wherever cameras stand beside it; of several, the first.

    `wanted` is another receiver's id.

    Raises UserError if the scene has none, or none with that id.
    """
    sensors = scene.sensors()
    receivers = [sensor for sensor in sensors if isinstance(sensor, plugin_types.LidarSensor)]
    if not receivers:
        found = f"has only {', '.join(sensor.class_name() for sensor in sensors)}" if sensors else "has none"
        raise UserError(f"sensor: the scene {found}; add a multipixel_receiver or pixel_fov")
    ids = [sensor.id() for sensor in sensors if sensor in receivers]
    names = ", ".join(map(repr, ids))
    if wanted and wanted not in ids:
        raise UserError(f"sensor = {shown(wanted)} is no receiver of the scene: it has {names}")
    if len(receivers) > 1 and not wanted:
        text = "the scene has %d receivers, %s: the first one is used, unless sensor names one"
        logger.warning(text, len(receivers), names)
    return receivers[ids.index(wanted) if wanted else 0]


def find_receiver(sensor: mi.Sensor) -> Receiver:
    """Return the receiver of a sensor plugin; raise UserError when the sensor has none."""
    if not isinstance(sensor, plugin_types.LidarSensor):
        raise UserError("sensor: the lidar integrators need a multipixel_receiver or pixel_fov")
    return sensor.receiver


def fit_seas(scene: mi.Scene, model: mi.Scene | None = None) -> None:
    """Set the missing automatic values of each ``ocean_surface`` from the scene's lasers and receivers.

    Plugins load without their siblings: this is done for loaded scenes, before they are used. With the lasers and
    receivers of a `model` instead, the meshes in both scenes have the same cells and waves. Shallow seas follow the
    bottom, also of the model.
    """
    if not (waiting := [sea for sea in seas_of(scene) if sea.footprints is None]):
        return
    footprints = []
    for emitter in (model or scene).emitters():
        if not isinstance(emitter, plugin_types.Transmitter):
            continue
        if place := _seen_sea(emitter.pose):
            spreads = emitter.angular_spread, emitter.widest_angular_spread
            footprints.append(Footprint.laser(*place, spreads))
        else:
            footprints.append(_without_sea(emitter.pose))
    for sensor in (model or scene).sensors():
        if isinstance(sensor, plugin_types.LidarSensor) and (place := _seen_sea(sensor.receiver.pose)):
            pixels = sensor.receiver.pixels
            side = float(np.sqrt(pixels.area / pixels.count))
            footprints.append(Footprint.receiver(*place, pixels.field_of_view, side))
    depths = bottom_depths(model or scene)
    if any([sea.fit(footprints, depths) for sea in waiting]):
        scene.parameters_changed([])


def _seen_sea(pose: KernelPose) -> tuple[tuple[float, float], float, float] | None:
    """Return where the axis meets the mean sea level [m], the height above or below it [m], and its slope [rad].

    The slope is the angle from the vertical. None for a pose under water that does not look up.
    """
    height, off_vertical = abs(float(pose.origin[2])), pose.off_nadir_deg
    if not pose.submerged:
        spot = pose.ground_point()
    elif pose.axis[2] > _SMALLEST_RISE:
        spot, off_vertical = pose.origin + pose.axis * (height / float(pose.axis[2])), 180.0 - off_vertical
    else:
        return None
    spot = pose.in_scene(spot)
    return (float(spot[0]), float(spot[1])), height, float(np.deg2rad(min(off_vertical, 89.9)))


def _without_sea(pose: KernelPose) -> Footprint:
    """Return a footprint that needs no waves: those above it when it looks down under water."""
    x, y, _ = pose.in_scene(pose.origin)
    place = float(x), float(y)
    return Footprint(place, abs(float(pose.origin[2])), 0.0, True, 0.0, np.inf)


def seas_of(scene: mi.Scene) -> list[plugin_types.SeaShape]:
    """Return a scene's ``ocean_surface`` shapes."""
    return [shape for shape in scene.shapes() if isinstance(shape, plugin_types.SeaShape)]


def find_solids(scene: mi.Scene, receiver: Receiver) -> WaterScene:
    """Return the water, and the solids that have an effect on light, none of which coincide in a face.

    Raises UserError as `find_water`, `shape_groups` and `separate_contacts`, for mirrored spheres, and for BSDFs that
    Mitsuba cannot evaluate.
    """
    # Mitsuba's own loader joins meshes of equal BSDFs, without a bounding box.
    joined = [shape for shape in scene.shapes() if not shape.bbox().valid()]
    for shape in joined:
        shape.parameters_changed(["vertex_positions"])
    if joined:
        scene.parameters_changed([])
    groups = shape_groups(scene)
    members = [member for group in groups for member in children(group)]
    interpolates = any([_check_bsdf(shape) for shape in (*scene.shapes(), *members) if shape.bsdf() is not None])
    seen = without_unseen(scene, groups)
    found = WaterScene(seen, receiver, *find_water(seen), groups=groups, interpolates=interpolates)
    solids = found.solids
    for solid in solids:
        _check_mirrored(solid)
    instances = sum(solid.class_name() == "Instance" for solid in solids)
    if instances > _MANY_INSTANCES:
        logger.warning(
            "the scene has %d instances: Mitsuba compiles code of its own for each, in about 1 s; shapes of their own "
            "share their code",
            instances,
        )
    moved = separate_contacts(found)
    if not moved:
        return found
    # Other scenes with these shapes have noticed their changes.
    for shape in moved:
        shape.parameters_changed([])
    scene.parameters_changed([])
    return replace(found, mitsuba_scene=without_unseen(scene, groups))


def _check_mirrored(solid: mi.Shape) -> None:
    """Refuse spheres that a mirror turns inside out, so that they reflect inside alone."""
    if solid.class_name() != "Sphere" or int(solid.bsdf().flags()) & mi.BSDFFlags.BackSide.value:
        return
    matrix = np.array(mi.traverse(solid)["to_world"].matrix, np.float64).reshape(4, 4)
    if solid.has_flipped_normals() and np.linalg.det(matrix[:3, :3]) < 0:
        raise UserError(
            f"to_world of sphere {solid.id()!r} mirrors it, which turns it inside out: it returns no light; leave the "
            "negative scale out, or set flip_normals"
        )


def _check_bsdf(shape: mi.Shape) -> bool:
    """Refuse a BSDF that raises an error, or with a ``mesh_attribute`` that its shape lacks, which would be 0.

    Return whether it has an attribute of vertices whose values may differ.
    """
    interpolates, is_even = False, isinstance(shape, plugin_types.SeabedShape) and shape.uniform_reflectance is not None
    bsdf, point = shape.bsdf(), dr.zeros(mi.SurfaceInteraction3f)
    up = point.wi = mi.Vector3f(0, 0, 1)
    try:
        bsdf.sample(mi.BSDFContext(), point, mi.Float(0.5), mi.Point2f(0.5))
        bsdf.eval(mi.BSDFContext(), point, up)
    except RuntimeError as error:
        reason = re.sub(r"\[[\w.:]+\] ", "", str(error)).splitlines()[0]
        raise UserError(f"shape {shape.id()!r}: its bsdf {bsdf.class_name()} cannot be used: {reason}") from error
    pending = [bsdf]
    while pending:
        for part in children(pending.pop()):
            pending.append(part)
            named = re.search(r'name = "(.*)"', str(part)) if part.class_name() == "MeshAttribute" else None
            if named and not shape.has_attribute(named[1]):
                raise UserError(
                    f"mesh_attribute: shape {shape.id()!r} has no attribute {named[1]!r}, which its bsdf names; "
                    "allowed are those of its PLY file"
                )
            interpolates |= named is not None and named[1].startswith("vertex_") and not is_even
    return interpolates


def find_water(scene: mi.Scene) -> tuple[Water | None, list[mi.Shape], float]:
    """Return water, surfaces and slope variance in a scene, see `WaterScene`.

    The slope variance belongs to the roughest surface, or is a typical one without ``ocean_surface``.

    Raises UserError when a medium is not supported or in the wrong place, or there are several.
    """
    surfaces: list[mi.Shape] = []
    waters: list[Water] = []
    for shape in scene.shapes():
        if not shape.is_medium_transition():
            continue
        if shape.exterior_medium() is not None:
            raise UserError(f"shape {shape.id()!r}: the water must be its interior medium and its exterior empty")
        medium = shape.interior_medium()
        if not isinstance(medium, plugin_types.WaterMedium):
            raise UserError(f"shape {shape.id()!r}: its interior medium must be layered_water")
        surfaces.append(shape)
        if not any(medium.water is other for other in waters):
            waters.append(medium.water)
    for shape in solids_of(scene, surfaces):
        name = shape.id()
        if isinstance(shape, plugin_types.SeaShape):
            raise UserError(f"ocean_surface {name!r}: needs a layered_water as its interior medium")
    if len(waters) > 1:
        raise UserError(f"media: the scene has {len(waters)} layered_water; allowed is one that shapes share")
    for water in waters:
        _check_index(surfaces, water)
        _check_layers(scene, surfaces, water)
    variances = [
        sea.sea.slope_variance for sea in surfaces if isinstance(sea, plugin_types.SeaShape) and sea.has_ripples
    ]
    return (waters[0] if waters else None), surfaces, float(max(variances, default=_UNKNOWN_SLOPE_VARIANCE))


def _check_index(surfaces: list[mi.Shape], water: Water) -> None:
    """Refuse surfaces that bend light by another index than the water's, in which paths are timed."""
    index = float(water.refractive_index)
    for surface in surfaces:
        bsdf = surface.bsdf()
        own = getattr(bsdf, "parameters", {})
        values = [own["int_ior"] / own["ext_ior"]] if "int_ior" in own else []
        values += [np.array(value).item() for name, value in mi.traverse(bsdf) if name.split(".")[-1] == "eta"]
        for value in values:
            if abs(value - index) > _SAME_INDEX * index:
                raise UserError(
                    f"shape {surface.id()!r}: its bsdf has the index eta = {value:.6g}, and the water below it "
                    f"refractive_index = {index:.6g}: give both the same (int_ior of the bsdf over ext_ior)"
                )


def _check_wavelength(water: Water | None, transmitter: plugin_types.Transmitter) -> None:
    """Refuse a water at another wavelength than the laser's."""
    laser = transmitter.wavelength_nm
    if water is None or water.wavelength_nm is None or abs(water.wavelength_nm - laser) <= _SAME_NM:
        return
    if water.by_name or not (is_green(water.wavelength_nm) and is_green(laser)):
        raise UserError(
            f"wavelength_nm = {water.wavelength_nm:g} of the water must be that of the lidar_transmitter, {laser:g}: "
            "give both the same, or the water's coefficients and indices as numbers"
        )


def _check_place(scene: WaterScene, transmitter: plugin_types.Transmitter) -> bool:
    """Return whether laser and receiver are under water.

    Refuse both on the sea level, on different sides of the sea, or in layers with different indices.
    """
    heights = [float(each.pose.origin[2]) for each in (transmitter, scene.receiver)]
    if min(heights) > 0:
        return False
    if max(heights) >= 0 or scene.water is None:
        raise UserError(
            f"altitude: transmitter and receiver at z = {heights[0]:g} m and {heights[1]:g} m must both be above the "
            "mean sea level z = 0, or both under water"
        )
    if scene.index_layers is not None and scene.index_layers.count > 1:
        raise UserError("refractive_index changes with depth: a lidar under water needs one index")
    trough = min(float(surface.bbox().min.z) for surface in scene.surfaces)
    for each in (transmitter, scene.receiver):
        origin = opaque_point(each.pose.origin)
        above = scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(0, 0, 1)))
        if each.pose.origin[2] > trough and not (above.is_valid() & scene.is_surface(above.shape))[0]:
            raise UserError(
                f"altitude = {each.pose.origin[2]:g} must be below the surface of the waves, whose lowest trough is at "
                f"{trough:.3g} m"
            )
    return True


def _check_cells(surfaces: list[mi.Shape], transmitter: plugin_types.Transmitter) -> None:
    """Refuse waves in cells longer than the beam is wide: a shot would meet a single slope."""
    footprint = 2 * transmitter.angular_spread * transmitter.pose.ground_range
    for surface in surfaces:
        if isinstance(surface, plugin_types.SeaShape) and footprint < surface.sea.cell_size < np.inf:
            raise UserError(
                f"cell_size = {surface.sea.cell_size:.3g} m is coarser than the beam's footprint on the sea, "
                f"{footprint:.3g} m: it must be finer, or 'auto'"
            )


def _check_layers(scene: mi.Scene, surfaces: list[mi.Shape], water: Water) -> None:
    """Refuse water layers below all solids, and index layers that begin within the waves."""
    lowest = min((float(solid.bbox().min.z) for solid in solids_of(scene, surfaces)), default=-np.inf)
    deepest = float(water.column.layer_tops[-1])
    if not water.from_profile and -deepest <= lowest < 0:
        raise UserError(f"layer_tops = {deepest:g} m is a layer below the bottom: it must be less than {-lowest:g} m")
    trough = min(float(surface.bbox().min.z) for surface in surfaces)
    for boundary in water.index_layers.boundaries[:1]:
        if -boundary >= trough:
            raise UserError(
                f"refractive_index changes at {boundary:g} m, within the waves: "
                f"it must do so below their troughs, {-trough:.3g} m"
            )
