"""Result attributes that describe lidar, sea and the layout of pixels, beam and targets; lines of sight."""

from __future__ import annotations

import json
import math
from typing import Any

import mitsuba as mi
import numpy as np
import xarray as xr

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.pulse import Pulse
from mitransient_lidar.rendering.accuracy import ErrorWindow
from mitransient_lidar.rendering.lines_of_sight import lines_of_sight
from mitransient_lidar.transport.opaque import aligned_ray
from mitransient_lidar.transport.paths.ripple_focusing import RippleFocusing
from mitransient_lidar.transport.probe import Probe, axis_on_bottom
from mitransient_lidar.transport.scene import LidarScene, WaterScene
from mitransient_lidar.transport.sensor.outlines import pixel_outlines, simplified
from mitransient_lidar.transport.solids import box_rays, scene_of_shapes

#: Largest number of pixels whose outlines are stored.
_MOST_PIXELS = 256

#: Longest attribute text; NetCDF files limit it to 64 KiB.
_LONGEST_TEXT = 60_000

#: Largest distance of simplified outlines from their points, relative to the size.
_TOLERANCE = 5e-4

#: Most samples of a pulse.
_MOST_SAMPLES = 1000

#: Shapes with points that Mitsuba samples; rays find those of others. Numbers of both along each side.
_SAMPLED, SAMPLED_TICKS = ("Sphere", "Disk", "Cylinder", "Rectangle"), 64


def with_lines_of_sight(dataset: xr.Dataset, lidar: LidarScene) -> xr.Dataset:
    """Return a result with the pixels' lines of sight as coordinates, unless the scene has no surface."""
    if not lidar.surfaces:
        return dataset
    pixels = lidar.receiver.pixels
    dims = ("pixel",) if pixels.grid is None else ("row", "column")
    return dataset.assign_coords(lines_of_sight(lidar).coordinates(dims, pixels.grid or (pixels.count,)))


def describe_scene(probe: Probe, window: ErrorWindow, focusing: RippleFocusing | None) -> dict[str, Any]:
    """Return the attributes of a result that describe lidar, sea and expected echoes."""
    heights = probe.scene.sea_heights
    # Depths are relative to the mean arrival of the surface echo over all pixels.
    arrivals = probe.echoes.surface_ns[:, 1]
    surface = {"surface_time_ns": float(np.nanmean(arrivals))} if np.isfinite(arrivals).any() else {}
    return {
        "beam_outside_surface": probe.echoes.missed_beam,
        **({"beam_on_land": probe.echoes.on_land} if probe.echoes.on_land else {}),
        **describe_lidar(probe),
        **surface,
        **({} if heights is None else {"surface_heights_m": list(heights)}),
        **({} if focusing is None else focusing.describe()),
        "window_start_ns": float(window.start_ns.min()),
        "window_end_ns": float(window.end_ns.max()),
    }


def describe_lidar(probe: Probe) -> dict[str, Any]:
    """Return the attributes of a result that describe lidar, refractive indices, and layout."""
    scene = probe.scene
    transmitter, receiver = scene.transmitter, scene.receiver
    pixels, optics, profile = receiver.pixels, receiver.optics, transmitter.profile
    return {
        "layout": pixels.layout,
        "field_of_view_mrad": 1e3 * pixels.field_of_view,
        "field_of_view_sides_mrad": [1e3 * side for side in pixels.sides or ()],
        "field_of_view_shape": pixels.field_of_view_shape,
        "aperture_area": optics.aperture_area,
        "obscuration": optics.obscuration,
        "response_time_ns": optics.response_time_ns,
        "pulse_energy_mj": 1e3 * transmitter.pulse_energy,
        "two_way_efficiency": (
            transmitter.optical_efficiency * optics.optical_efficiency * optics.two_way_atmospheric_transmittance
        ),
        "pulse_fwhm_ns": transmitter.pulse.fwhm_ns,
        **_describe_pulse(transmitter.pulse),
        "beam_profile": transmitter.beam_profile,
        "divergence_mrad": 1e3 * profile.divergence[0],
        "divergence_across_mrad": 1e3 * profile.divergence[1],
        "ellipse_deg": float(np.degrees(profile.rotation)),
        "wavelength_nm": transmitter.wavelength_nm,
        "altitude": float(transmitter.pose.origin[2]),
        "off_nadir_deg": transmitter.pose.off_nadir_deg,
        "refractive_index": scene.refractive_index,
        "group_index": scene.group_index,
        "surface_slope_variance": scene.slope_variance,
        **describe_layout(probe),
    }


def _describe_pulse(pulse: Pulse) -> dict[str, list[float]]:
    """Return times [ns] and power [1/ns] of a pulse that is not Gaussian, as lists with at most 1000 samples."""
    if pulse.shape == "gaussian":
        return {}
    times = pulse.times_ns
    if times.size > _MOST_SAMPLES:
        times = np.linspace(times[0], times[-1], _MOST_SAMPLES)
    power = np.interp(times, pulse.times_ns, pulse.power)
    return {"pulse_times_ns": times.tolist(), "pulse_power": power.tolist()}


def describe_layout(probe: Probe) -> dict[str, Any]:
    """Return the result attributes that `plot_layout` draws.

    ``receiver_pose`` and ``transmitter_pose`` are origin [m], axis, far and left, 12 numbers each. ``bottom_point`` is
    the point x, y, z [m] where the receiver's axis, refracted by a level sea, meets the bottom (`WaterScene.bottoms`);
    missing without one. Water of several index layers has ``index_layers``, their refractive indices, and
    ``index_boundaries``, the depths between them [m].

    JSON texts are ``beam_outlines`` (share of the peak, and lines), ``pixel_outlines`` (lines of each pixel; not for
    imagers) and ``target_outlines``, for each target that the view may see (`Rays.meets`). A target has an ``id``,
    ``z`` (lowest and highest point [m]), ``line`` (its vertical projection), and ``seen`` (its outline on the sea level
    along the receiver's refracted lines of sight). With a ``bottom_point`` it also has a ``shadow`` (the outline of its
    shadow in the laser light at this point's height). A line is closed, with the coordinates angle_x, angle_y [mrad] of
    its points, or x, y [m] for targets. Texts above the limit are omitted.
    """
    scene = probe.scene
    transmitter, receiver = scene.transmitter, scene.receiver
    targets = [solid for solid in scene.targets if probe.view.meets(solid)]
    found = axis_on_bottom(scene, receiver.pose.origin[None], receiver.pose.axis)[0]
    bottom = found if np.isfinite(found).all() else None
    texts: dict[str, list[Any]] = {
        "target_outlines": [_describe_target(scene, target, bottom) for target in targets],
        "beam_outlines": [],
    }
    for share, lines in transmitter.profile.outlines():
        short = [_flat(simplified(1e3 * line, 1e3 * _TOLERANCE * float(np.ptp(line)))) for line in lines]
        texts["beam_outlines"].append({"share": round(share, 4), "lines": short})
    if receiver.pixels.grid is None and receiver.pixels.count <= _MOST_PIXELS:
        texts["pixel_outlines"] = [[_flat(1e3 * line) for line in lines] for lines in pixel_outlines(receiver.pixels)]
    described: dict[str, Any] = {
        f"{name}_pose": [*pose.in_scene(pose.origin).tolist(), *pose.frame.ravel().tolist()]
        for name, pose in (("transmitter", transmitter.pose), ("receiver", receiver.pose))
    }
    if bottom is not None:
        described["bottom_point"] = bottom.tolist()
    if scene.level_sea.boundaries:
        described["index_layers"] = list(scene.level_sea.refractive_index)
        described["index_boundaries"] = list(scene.level_sea.boundaries)
    for name, value in texts.items():
        text = json.dumps(value, separators=(",", ":"))
        if value and len(text) <= _LONGEST_TEXT:
            described[name] = text
    return described


def _describe_target(scene: LidarScene, target: mi.Shape, bottom: FloatArray | None) -> dict[str, Any]:
    """Return name, heights and outlines of a target."""
    sea, points, at = scene.level_sea, surface_points(scene, target), scene.frame_origin[:2]
    seen = sea.crossing(scene.receiver.pose.origin, points)
    found = {
        "id": target.id(),
        "z": [round(float(z), 4) for z in (target.bbox().min.z, target.bbox().max.z)],
        "line": _outline(points[:, :2] + at),
        "seen": _outline(seen + at),
    }
    if bottom is not None and (points[:, 2] > bottom[2]).any():
        laser = scene.transmitter.pose.origin
        above = points[points[:, 2] > bottom[2]]
        entries = np.pad(sea.crossing(laser, above), ((0, 0), (0, 1)))
        found["shadow"] = _outline(sea.at_height(laser, entries - laser, bottom[2]) + at)
    return found


def surface_points(scene: WaterScene, solid: mi.Shape) -> FloatArray:
    """Return the corners of a mesh, or points all over another shape [m], shape (n, 3)."""
    known = mi.traverse(solid)
    if "vertex_positions" in known:
        return np.array(known["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    if solid.class_name() not in _SAMPLED:
        box = solid.bbox()
        origins, directions = box_rays(np.array(box.min), np.array(box.max), SAMPLED_TICKS)
        rays = aligned_ray(origins, directions, np.full(len(origins), np.inf))
        hit = scene_of_shapes([solid], scene.groups).ray_intersect(rays)
        points: FloatArray = np.array(hit.p, dtype=np.float64).T[np.array(hit.is_valid())]
        return points
    ticks = np.linspace(0, 1, SAMPLED_TICKS + 1)
    u, v = (mi.Float(g.ravel()) for g in np.meshgrid(ticks, ticks))
    return np.array(solid.sample_position(0.0, mi.Point2f(u, v)).p, dtype=np.float64).T


def _outline(points: FloatArray) -> list[float]:
    """Return the convex outline of points (x, y), a closed line, as rounded coordinates."""
    from scipy.spatial import ConvexHull, QhullError

    flat = np.unique(points[np.isfinite(points).all(axis=1)], axis=0)
    if len(flat) == 0:
        return []
    try:
        hull = flat[ConvexHull(flat).vertices]
    except QhullError:
        hull = flat[[0, -1]]  # the points lie on a line
    closed = np.concatenate([hull, hull[:1]])
    size = float(np.ptp(closed, axis=0).max())
    return _flat(simplified(closed, _TOLERANCE * size), size)


def _flat(line: FloatArray, size: float | None = None) -> list[float]:
    """Return a line's rounded coordinates, with errors of about 1/5000 of a size, by default of the largest."""
    size = float(np.abs(line).max()) if size is None else size
    digits = max(0, 3 - math.floor(math.log10(max(size, 1e-6))))
    return np.round(line, digits).ravel().tolist()
