"""Checks before a scene is rendered: whether light can return, from which shapes, and when."""

from __future__ import annotations

import logging
import math

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.transport.fitted_axis import NEAREST_RANGE, earliest_ns, total_reflection_ns
from mitransient_lidar.transport.opaque import shape_number
from mitransient_lidar.transport.probe import PROBE_RAYS, Probe, Rays, SolidEcho, gaps
from mitransient_lidar.transport.rng import unit_points
from mitransient_lidar.transport.scene import LidarScene, WaterScene
from mitransient_lidar.transport.solids import box_of, met_numbers

logger = logging.getLogger(__name__)

#: Axis distance that is reported, over the radii of beam and view, whichever is larger.
_APART_PER_BEAM, _APART_PER_VIEW = 0.5, 0.15

_HEIGHTS = 64  #: Heights at which the distance of the axes is compared.
_CLOSED = 1e-3  #: Sum of a mesh's areas over their absolute values, below which it is closed.
_MOST_NAMED = 5  #: Most shapes out of view or outside the beam that are named.
_PULSES = 5.0  #: Longest echo in widths of the pulse and of the receiver's response.


def check_scene(probe: Probe) -> None:
    """Refuse a probe's scene that can return no light within its record, and warn about parts that cannot contribute.

    Warnings name shapes whose echo is outside the record, and shapes out of view, outside the beam, or partly in the
    air. They also report a laser and a receiver whose axes do not meet.

    Raises UserError if no pixel sees the sea or a solid, the beam misses them, or beam and view are too far apart for
    the record. Further, if nothing in view reflects or scatters light, the record contains no echo, or a target lies
    below the bottom.
    """
    scene, view, beam = probe.scene, probe.view, probe.beam
    if scene.submerged:
        _check_under_water(probe)
        return
    _check_rays(view, "no pixel sees the sea or a solid: the receiver")
    _check_rays(beam, "the beam misses the sea and every solid: the laser")
    _check_overlap(scene, view, beam)
    _check_axis_under_water(probe)
    _check_reflection(scene, view)
    _check_solids(probe)
    _warn_of_axes(scene, view, beam)
    solids = scene.solids
    # Of several bottom parts, such as a shore, some may be elsewhere.
    single = scene.targets if len(scene.bottoms) > 1 else solids
    out = [said for solid in single if (said := _out_of_place(solid, view, beam))]
    for said in out[:_MOST_NAMED]:
        logger.warning(said)
    if len(out) > _MOST_NAMED:
        logger.warning("%d more shapes lie out of view or outside the beam", len(out) - _MOST_NAMED)
    for solid in solids:
        _warn_of_inside_out(solid)
    for echo in probe.echoes.solids:
        _warn_of_time(probe, echo)


def _check_under_water(probe: Probe) -> None:
    """Check an underwater lidar's record: without the laser itself and total reflection, and with every echo."""
    scene, axis = probe.scene, probe.scene.axis
    first_ns = earliest_ns(scene, scene.transmitter)
    if first_ns is not None and axis.start_ns < first_ns:
        raise UserError(
            f"time_start_ns = {axis.start_ns:g} must be at least {first_ns:.2g} under water, {NEAREST_RANGE:g} m from "
            "the lidar: at one place, laser and receiver return without limit from less and less range"
        )
    reflected_ns = total_reflection_ns(probe.view, probe.beam)
    if axis.end_ns > reflected_ns:
        raise UserError(
            f"time_start_ns = {axis.start_ns:g} and bin_count = {axis.bin_count} bins of {axis.bin_width_ns:g} ns end "
            f"the record at {axis.end_ns:g} ns: it must end by {reflected_ns:.1f} ns, when the sea reflects beam or "
            "view totally; what lies beyond is not rendered"
        )
    for echo in probe.echoes.solids:
        _warn_of_time(probe, echo)


def _place(scene: WaterScene, point: FloatArray) -> str:
    """Return a point as x, y in the scene [m]."""
    x, y = scene.receiver.pose.in_scene(point[:2])
    return f"({x:.1f}, {y:.1f})"


def _check_axis_under_water(probe: Probe) -> None:
    """Refuse a record that ends before the surface echo, or begins after a bottom's echo below all pixels."""
    axis, surface = probe.scene.axis, probe.echoes.surface_ns[:, 0]
    first = float(np.nanmin(surface)) if np.isfinite(surface).any() else np.nan
    if axis.end_ns <= first:
        raise UserError(
            f"time_start_ns = {axis.start_ns:g} and bin_count = {axis.bin_count} bins of {axis.bin_width_ns:g} ns "
            f"end the record at {axis.end_ns:g} ns: it must end after the surface echo, which comes at {first:.1f} ns"
        )
    for echo in probe.echoes.solids:
        # Light that was scattered several times comes later.
        column = max(echo.latest_ns - first, 0.0) if np.isfinite(first) else 0.0
        late = axis.start_ns > echo.latest_ns + column + _echo_length(probe.scene)
        if late and probe.view.covered_by(echo.shape):
            raise UserError(
                f"time_start_ns = {axis.start_ns:g} starts the record after every echo: it must be less than "
                f"{echo.latest_ns:.1f} ns, when the echo of shape {echo.shape.id()!r} ends"
            )


def _check_rays(rays: Rays, subject: str) -> None:
    """Refuse rays that meet neither the sea nor a solid."""
    surfaces = rays.scene.surfaces
    for surface in surfaces:
        for z in (0.0, min(float(surface.bbox().max.z), 0.5 * rays.pose.origin[2])):
            if len(places := rays.at_height(z)) and gaps(places, surface).min() == 0:
                return
    if any(rays.meets(solid) for solid in rays.scene.solids):
        return
    places = rays.at_height(0.0)
    if len(places) == 0:
        x, y, z = rays.pose.axis
        raise UserError(f"{subject} looks above the horizon, along ({x:.3g}, {y:.3g}, {z:.3g}); it must look down")
    where = "where no shape is"
    if surfaces:
        lows, highs = zip(*map(box_of, surfaces), strict=True)
        first, last = (_place(rays.scene, corner) for corner in (np.min(lows, axis=0), np.max(highs, axis=0)))
        where = f"outside the sea from {first} to {last} m"
    first, last = (_place(rays.scene, corner) for corner in (places.min(axis=0), places.max(axis=0)))
    extent = f"from {first} to {last} m"
    raise UserError(f"{subject} looks at the sea level {extent}, {where}; change aim_x and aim_y")


def _check_overlap(scene: LidarScene, view: Rays, beam: Rays) -> None:
    """Refuse beam and view so far apart that light could not pass from one to the other before the record ends."""
    seen, lit = view.at_height(0.0), beam.at_height(0.0)
    if not (len(seen) and len(lit)):
        return
    apart = np.maximum(seen.min(axis=0) - lit.max(axis=0), lit.min(axis=0) - seen.max(axis=0))
    gap = float(np.hypot(*np.maximum(apart, 0)))
    air = sum(
        float(np.sqrt(np.sum((places - rays.pose.origin[:2]) ** 2, axis=1).min() + rays.pose.origin[2] ** 2))
        for rays, places in ((view, seen), (beam, lit))
    )
    # Bounds of the path from below: solids in the air may reflect it, which shortens its way through the air.
    highest = max((float(solid.bbox().max.z) for solid in scene.solids), default=0.0)
    if highest <= 0 and gap > 0 and air + gap > scene.axis.path_end:
        raise UserError(
            f"beam and field of view do not overlap: they are {gap:.3g} m apart on the sea level, so that scattered "
            f"light would arrive at {1e9 * (air + gap) / C0:.0f} ns or later, after the end of the record at "
            f"{scene.axis.end_ns:g} ns; aim laser and receiver at one place by aim_x, aim_y and off_nadir_deg"
        )


def _check_reflection(scene: LidarScene, view: Rays) -> None:
    """Refuse black solids in water that does not scatter, below a smooth surface."""
    rough = mi.BSDFFlags.Glossy.value | mi.BSDFFlags.Diffuse.value
    if any(int(surface.bsdf().flags()) & rough for surface in scene.surfaces):
        return
    water = scene.water
    if water is not None and (water.plume is not None or water.column.scattering.max() > 0):
        return
    found: list[mi.Shape] = []
    random = unit_points(PROBE_RAYS)
    for hit, active in ((view.first, view.first.is_valid() & ~view.on_sea), (view.below, view.below.is_valid())):
        _, weight = hit.bsdf().sample(mi.BSDFContext(), hit, random.x, random, active)
        if dr.any(active & (weight[0] > 0)):
            return
        met = {*met_numbers(hit)[np.array(active)].tolist()}
        found += [solid for solid in scene.solids if shape_number(solid) in met]
    if any(view.meets(solid) and not any(solid is other for other in found) for solid in scene.solids):
        return
    names = ", ".join(repr(solid.id()) for solid in dict.fromkeys(found)) or "no shape"
    raise UserError(
        f"nothing in view returns light: scattering = 0 in the water, a smooth surface, and {names} in view with a "
        "reflectance of 0; raise scattering, reflectance or the surface's roughness"
    )


def _check_solids(probe: Probe) -> None:
    """Refuse a target below the bottom, and warn of solids that hang in the air where there is no land."""
    scene, bottoms = probe.scene, probe.scene.bottoms
    lowest = min(bottoms, key=lambda bottom: float(bottom.bbox().min.z), default=None)
    _, highest = scene.sea_heights or (np.inf, np.inf)
    has_land = any(bottom.bbox().min.z <= highest < bottom.bbox().max.z for bottom in bottoms)
    for solid in scene.solids:
        low, high = float(solid.bbox().min.z), float(solid.bbox().max.z)
        if lowest is not None and high < float(lowest.bbox().min.z):
            raise UserError(
                f"shape {solid.id()!r} lies below the bottom {lowest.id()!r}, up to z = {high:.3g} m: "
                f"it must lie above {float(lowest.bbox().min.z):.3g} m"
            )
        if low > highest and not has_land:
            logger.warning("shape %r lies above the sea, from z = %.3g m", solid.id(), low)
    for solid in probe.echoes.pierced:
        logger.info("shape %r rises through the sea surface: part of it is seen in the air", solid.id())


def _warn_of_axes(scene: LidarScene, view: Rays, beam: Rays) -> None:
    """Warn about laser and receiver axes that do not meet in the water or on the surface."""
    boxes = [box_of(solid) for solid in scene.solids]
    highest = max([0.0, *(min(high[2], 0.5 * view.pose.origin[2]) for _, high in boxes)])
    # Without a solid, to the depth from which light returns within the record.
    reach = 0.5 * (scene.axis.path_end - 2 * view.pose.origin[2]) / scene.group_index
    lowest = min([low[2] for low, _ in boxes] or [-max(reach, 0.0)])
    heights = np.append(0.0, np.linspace(highest, min(lowest, highest), _HEIGHTS))
    apart = np.linalg.norm(view.axis_at_height(heights) - beam.axis_at_height(heights), axis=-1)
    if not np.isfinite(apart).all():
        return
    beam_radius = 0.5 * min(scene.transmitter.profile.divergence) * beam.pose.ground_range
    view_radius = 0.5 * scene.receiver.pixels.field_of_view * view.pose.ground_range
    if apart.min() > max(_APART_PER_BEAM * beam_radius, _APART_PER_VIEW * view_radius):
        logger.warning(
            "the axes of laser and receiver do not meet: on the sea level they are %.3g m apart, %.2g times the beam's "
            "radius of %.3g m there, and nowhere in the water less than %.3g m; aim both at one place",
            apart[0],
            apart[0] / beam_radius,
            beam_radius,
            apart.min(),
        )


def _out_of_place(solid: mi.Shape, view: Rays, beam: Rays) -> str:
    """Return the message for a solid that lies out of view or outside the beam; none for others."""
    z = float(solid.bbox().center().z)
    for rays, problem, name in ((view, "out of view", "receiver"), (beam, "outside the beam", "laser")):
        if rays.meets(solid) or not np.isfinite(axis := rays.axis_at_height(rays.middle_height(solid))).all():
            continue
        x, y = rays.scene.receiver.pose.in_scene(axis)
        return (
            f"shape {solid.id()!r} lies {problem}: it is {gaps(axis[None], solid)[0]:.1f} m from the {name}'s axis, "
            f"which passes x = {x:.1f} m, y = {y:.1f} m at its height of z = {z:.1f} m; move the shape there, or the "
            "lidar by aim_x and aim_y"
        )
    return ""


def _warn_of_inside_out(solid: mi.Shape) -> None:
    """Warn about a sphere or a closed mesh that reflects on one side only, the inside."""
    if int(solid.bsdf().flags()) & mi.BSDFFlags.BackSide.value or not _is_inside_out(solid):
        return
    logger.warning(
        "the faces of shape %r point inwards and its BSDF reflects on their front alone: it returns no light; turn the "
        "faces, set flip_normals the other way, or nest the BSDF in a twosided",
        solid.id(),
    )


def _is_inside_out(solid: mi.Shape) -> bool:
    """Return whether a sphere's or a closed mesh's normals point inwards."""
    if solid.class_name() == "Sphere":
        return bool(solid.has_flipped_normals())
    if not isinstance(solid, mi.Mesh):
        return False
    buffers = mi.traverse(solid)
    if "vertex_positions" not in buffers:
        return False
    vertices, faces = (np.array(buffers[name]).reshape(-1, 3) for name in ("vertex_positions", "faces"))
    corners = (vertices[faces] - vertices.mean(axis=0)).astype(np.float64)
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # The areas of a closed surface cancel.
    if np.linalg.norm(areas.sum(axis=0)) > _CLOSED * np.linalg.norm(areas, axis=1).sum():
        return False
    volume = float(np.einsum("ij,ij->", corners[:, 0], areas))
    if solid.has_vertex_normals() and not solid.has_face_normals():
        # BSDFs use the frame of these normals.
        normals = np.array(buffers["vertex_normals"]).reshape(-1, 3)[faces[:, 0]]
        volume *= float(np.einsum("ij,ij->", normals, areas))
    return bool((volume < 0) != solid.has_flipped_normals())


def _warn_of_time(probe: Probe, echo: SolidEcho) -> None:
    """Warn about a solid's echo that comes before the record, or after one that contains more than the surface echo."""
    axis, fwhm_ns = probe.scene.axis, probe.scene.transmitter.pulse.fwhm_ns
    name, mean = echo.shape.id(), echo.mean_ns
    if mean < axis.start_ns:
        logger.warning(
            "the echo of shape %r comes at %.1f ns, before the record starts at %g ns: lower time_start_ns",
            name,
            mean,
            axis.start_ns,
        )
        return
    surface = probe.echoes.surface_ns[:, 1]
    of_surface = np.isfinite(surface).any() and axis.end_ns < np.nanmax(surface) + _echo_length(probe.scene)
    if mean > axis.end_ns and not of_surface:
        logger.warning(
            "the echo of shape %r comes at %.1f ns, after the record ends at %g ns: a bin_count of %d would hold it",
            name,
            mean,
            axis.end_ns,
            math.ceil((echo.latest_ns + fwhm_ns - axis.start_ns) / axis.bin_width_ns),
        )


def _echo_length(scene: LidarScene) -> float:
    """Return an upper limit of the time that an echo lasts [ns]."""
    return _PULSES * float(scene.transmitter.pulse.fwhm_ns + scene.receiver.optics.response_time_ns)
