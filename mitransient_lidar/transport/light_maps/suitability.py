"""Which scenes and shots light maps suit."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import BoolArray, FloatArray
from mitransient_lidar.physics.lidar.level_sea import refract_level
from mitransient_lidar.physics.sea.shoaling import ShoalingHeights
from mitransient_lidar.transport.probe import Rays, first_along
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.solids import box_of

#: Largest angle of the receiver from nadir [deg].
_LARGEST_ANGLE = 45.0

#: Largest distance of laser and receiver over their range, and angle between their axes [rad].
_APART = 0.05

#: Largest mean number of scattering events on one way to the bottom, beyond which light arrives too late.
_MOST_EVENTS = 8.0

#: Largest share of a pixel's light that meets a target whose shadow is left out, and deflection by waves over depth.
_SHADOWED, _DEFLECTED = 0.1, 0.05

#: Least depth of the bottom below a beam [m], and rays of the beam that must reach it.
_LEAST_DEPTH, _RAYS_TO_BED = 0.05, 64

#: Reason against the light of shots over land, or over solids near the surface.
REACH_THE_SURFACE = "solids reach the surface"


class UnsuitedError(UserError):
    """A scene that light maps are not for, for a reason."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"light maps do not suit the scene: {reason}; use light = 'merging'")


def unsuited(scene: LidarScene) -> str | None:
    """Return why light maps are not for a scene, or None. Shots must also be `over_water`."""
    if scene.submerged:
        return "the lidar is under water"
    if scene.water is None or len(scene.surfaces) != 1 or len(scene.seas) != 1:
        return "it needs water below one ocean_surface"
    sea, axis = scene.seas[0], scene.receiver.pose.axis
    if np.degrees(np.arccos(np.clip(-float(axis[2]), -1, 1))) > _LARGEST_ANGLE:
        return f"the receiver looks more than {_LARGEST_ANGLE:g} degrees from nadir"
    if not sea.has_ripples or sea.sea.has_foam:
        return "its sea has a BSDF of its own, or foam"
    if len(scene.water.index_layers.boundaries):
        return "its water has several refractive indices"
    if scene.water.plume is not None:
        return "its water has bubbles"
    if scene.perturbations.count:
        return "derivatives need paths"
    if scene.has_veils or scene.has_shared_gaps or scene.has_specular_solids:
        return "solids are transparent or mirror-like"
    events = _events(scene)
    apart = (
        np.linalg.norm(scene.receiver.pose.origin - scene.transmitter.pose.origin) / scene.receiver.pose.ground_range
    )
    if max(apart, np.linalg.norm(axis - scene.transmitter.pose.axis)) > _APART:
        return "laser and receiver look from different places, or along different axes"
    if events > _MOST_EVENTS:
        return f"light scatters {events:.2g} times on its way to the bottom, more than {_MOST_EVENTS:g}"
    return None


def over_water(scene: LidarScene, places: FloatArray, turns: FloatArray | None) -> BoolArray:
    """Return which shots have solids below the sea alone in their beam, shape (shots,); arguments as `light_faintly`.

    Beam rays, the outermost among them, pass the sea without meeting a solid. This holds down to 0.05 m or, where waves
    do not follow the bottom, to the lowest trough.
    """
    wet = np.ones(len(places), dtype=bool)
    if not scene.has_dry_solids:
        return wet
    follows = isinstance(scene.seas[0].sea.waves, ShoalingHeights)
    lowest = 0.0 if follows or scene.sea_heights is None else scene.sea_heights[0]
    rays, pose = Rays.of_beam(scene, scene.transmitter), scene.transmitter.pose
    start, end = (
        (pose.origin + rays.directions * ((z - pose.origin[2]) / rays.directions[:, 2:]) - pose.ground_point())
        for z in (pose.origin[2], min(lowest, -_LEAST_DEPTH))
    )
    outermost = np.argsort(-np.linalg.norm(end - end.mean(axis=0), axis=1))[: _RAYS_TO_BED // 2]
    some = np.concatenate([outermost, np.linspace(0, len(end) - 1, _RAYS_TO_BED // 2).astype(np.intp)])
    turned = np.ones(len(places), dtype=complex) if turns is None else turns @ [1, 1j]

    def among_solids(points: FloatArray) -> FloatArray:
        away = np.multiply.outer(turned, points[some, :2] @ [1, 1j])
        level = np.stack([away.real, away.imag], axis=-1) + places[:, np.newaxis]
        return np.insert(level.reshape(-1, 2), 2, np.tile(points[some, 2], len(places)), axis=1)

    met = first_along(scene, [among_solids(start), among_solids(end)])[:, 2]
    return np.asarray(np.isnan(met).reshape(len(places), -1).all(axis=1))


def light_faintly(scene: LidarScene, target: mi.Shape, places: FloatArray, turns: FloatArray | None) -> BoolArray:
    """Return which shots light a target so faintly that its shadow needs no merging, shape (shots,).

    In each pixel at most the share `_SHADOWED` of the beam over a level sea meets the target's box. The box is widened
    as waves deflect the light.

    `scene`, `target`: the lidar's scene, and a target of it. `places`: points (x, y) of the shots among the shapes [m],
    shape (shots, 2). `turns`: cosine and sine of their rotations about the vertical, shape (shots, 2); None without
    any.
    """
    low, high = box_of(target)
    rays = Rays.of_beam(scene, scene.transmitter)
    pixel, seen = scene.receiver.pixels.pixel_at(rays.angles.x, rays.angles.y, mi.Float(0.5))
    pixel, counted = np.array(pixel), np.array(seen) > 0
    pose, height = scene.transmitter.pose, 0.5 * (low[2] + high[2])
    lit = scene.level_sea.at_height(pose.origin, rays.directions, height) - pose.ground_point()[:2]
    counted &= np.isfinite(lit).all(axis=1)
    lit, pixel = lit[counted] @ [1, 1j], pixel[counted]
    whole = np.maximum(np.bincount(pixel, minlength=scene.receiver.pixels.count), 1)
    # A ray that meets the box below or above its middle height does so beside it.
    axis = np.abs(refract_level(pose.axis, scene.refractive_index))
    wider = _DEFLECTED * max(-float(low[2]), 0.0) + 0.5 * (high[2] - low[2]) * np.hypot(*axis[:2]) / axis[2]
    centre, half = (0.5 * (low + high)[:2]), 0.5 * (high - low)[:2] + wider
    faint = np.ones(len(places), dtype=bool)
    farthest = float(np.abs(lit).max(initial=0.0))
    for shot in np.flatnonzero(np.all(np.abs(places - centre) <= half + farthest, axis=1)):
        turned = lit if turns is None else lit * complex(*turns[shot])
        beside = np.abs(np.stack([turned.real, turned.imag], axis=-1) + places[shot] - centre)
        met = np.bincount(pixel[np.all(beside <= half, axis=1)], minlength=whole.size)
        faint[shot] = np.all(met <= _SHADOWED * whole)
    return faint


def reach_of_scattering(scene: LidarScene) -> float:
    """Return the depth to which light of a scene scatters rarely enough for light maps [m], at most 1 km."""
    down = -float(refract_level(scene.receiver.pose.axis, scene.refractive_index)[2])
    depths = np.linspace(0, 1e3, 10_001)
    events = scene.required_water.column.optical_depth_of_scattering(depths) / down
    return float(depths[np.searchsorted(events, _MOST_EVENTS) - 1])


def _events(scene: LidarScene) -> float:
    """Return the mean number of scattering events on the way to the lowest bottom."""
    lowest = min((float(solid.bbox().min.z) for solid in scene.bottoms), default=0.0)
    down = -float(refract_level(scene.receiver.pose.axis, scene.refractive_index)[2])
    return float(scene.required_water.column.optical_depth_of_scattering(max(-lowest, 0.0))) / down
