"""Attributes of a result that describe its lidar, and the layout of pixels, beam and targets."""

from __future__ import annotations

import json
import math
from typing import Any

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.sensor.outlines import pixel_outlines, simplified

#: Largest number of pixels whose outlines are stored.
_MOST_PIXELS = 256

#: Longest text of an attribute; the limit of NetCDF files is 64 KiB.
_LONGEST_TEXT = 60_000

#: Largest distance of simplified outlines from their points, relative to the size.
_TOLERANCE = 5e-4


def describe_lidar(scene: LidarScene) -> dict[str, Any]:
    """Return the attributes of a result that describe lidar, refractive indices, and layout."""
    transmitter, receiver = scene.transmitter, scene.receiver
    pixels, optics, profile = receiver.pixels, receiver.optics, transmitter.profile
    return {
        "layout": pixels.layout,
        "field_of_view_mrad": 1e3 * pixels.field_of_view,
        "field_of_view_sides_mrad": [1e3 * side for side in getattr(pixels, "sides", [])],
        "field_of_view_shape": pixels.field_of_view_shape,
        "aperture_area": optics.aperture_area,
        "obscuration": optics.obscuration,
        "response_time_ns": optics.response_time_ns,
        "pulse_energy_mj": 1e3 * transmitter.pulse_energy,
        "pulse_fwhm_ns": transmitter.pulse.fwhm_ns,
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
        **describe_layout(scene),
    }


def describe_layout(scene: LidarScene) -> dict[str, Any]:
    """Return the attributes of a result that `plot_layout` draws.

    ``receiver_pose`` and ``transmitter_pose`` are origin [m], axis, far and left, 12 numbers each. JSON texts are
    ``beam_outlines`` (share of the peak, and lines), ``pixel_outlines`` (lines of each pixel; not of imagers) and
    ``target_outlines`` (lowest and highest point [m], and line of each). A line is closed, with the coordinates
    angle_x, angle_y [mrad] of its points, or x, y [m] for targets. Texts above the limit are omitted.
    """
    transmitter, receiver = scene.transmitter, scene.receiver
    texts: dict[str, list[Any]] = {"target_outlines": _target_outlines(scene), "beam_outlines": []}
    for share, lines in transmitter.profile.outlines():
        short = [_flat(simplified(1e3 * line, 1e3 * _TOLERANCE * float(np.ptp(line)))) for line in lines]
        texts["beam_outlines"].append({"share": round(share, 4), "lines": short})
    if receiver.pixels.grid is None and receiver.pixels.count <= _MOST_PIXELS:
        texts["pixel_outlines"] = [[_flat(1e3 * line) for line in lines] for lines in pixel_outlines(receiver.pixels)]
    described: dict[str, Any] = {
        f"{name}_pose": np.concatenate([pose.origin, pose.axis, pose.far, pose.left]).tolist()
        for name, pose in (("transmitter", transmitter.pose), ("receiver", receiver.pose))
    }
    for name, value in texts.items():
        text = json.dumps(value, separators=(",", ":"))
        if value and len(text) <= _LONGEST_TEXT:
            described[name] = text
    return described


def _target_outlines(scene: LidarScene) -> list[dict[str, Any]]:
    """Return heights and outlines of the solids smaller than the field of view."""
    pose = scene.receiver.pose
    spot = pose.ground_point()
    reach = 0.5 * scene.receiver.pixels.field_of_view * float(np.linalg.norm(spot - pose.origin))
    reach /= max(-float(pose.axis[2]), 1e-3)
    found = []
    for solid in scene.solids:
        box = solid.bbox()
        low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
        covers = np.all(low[:2] < spot[:2] - reach) and np.all(high[:2] > spot[:2] + reach)
        outside = np.any(low[:2] > spot[:2] + 2 * reach) or np.any(high[:2] < spot[:2] - 2 * reach)
        if not (covers or outside):
            found.append({"z": [round(float(z), 4) for z in (low[2], high[2])], "line": _flat(_projection(solid))})
    return found


def _projection(solid: mi.Shape) -> FloatArray:
    """Return the convex outline (x, y) of the vertical projection of a solid."""
    from scipy.spatial import ConvexHull, QhullError

    known = mi.traverse(solid)
    if "vertex_positions" in known:
        points = np.array(known["vertex_positions"]).reshape(-1, 3)
    else:
        ticks = np.linspace(0, 1, 65)
        u, v = (mi.Float(g.ravel()) for g in np.meshgrid(ticks, ticks))
        points = np.array(solid.sample_position(0.0, mi.Point2f(u, v)).p).T
    flat = np.unique(points[:, :2].astype(np.float64), axis=0)
    try:
        hull = flat[ConvexHull(flat).vertices]
    except QhullError:
        hull = flat[[0, -1]]  # the projection is a line
    closed = np.concatenate([hull, hull[:1]])
    return simplified(closed, _TOLERANCE * float(np.ptp(closed)))


def _flat(line: FloatArray) -> list[float]:
    """Return the rounded coordinates of a line, with errors of about 1/5000 of the largest."""
    digits = max(0, 3 - math.floor(math.log10(max(float(np.abs(line).max()), 1e-6))))
    return np.round(line, digits).ravel().tolist()
