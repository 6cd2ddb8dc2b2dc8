"""Places on a sea with given slopes of the surface over the footprint of the beam."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, integer, positive
from mitransient_lidar.rendering.render import render
from mitransient_lidar.rendering.session import open_scene

if TYPE_CHECKING:
    import mitsuba as mi
    import xarray as xr

    from mitransient_lidar.transport.pose import Pose

#: Slopes along and across the lidar's azimuth of each kind of shot, in units of `slope_sigmas` standard deviations.
KINDS = {"towards": (1.0, 0.0), "level": (0.0, 0.0), "away": (-1.0, 0.0), "sideways": (0.0, 1.0)}

#: Longest side of the sea that is searched [m].
_LARGEST_SEARCH = 512.0

#: Largest number of pixels whose footprints are mapped.
_MOST_MAPPED_PIXELS = 64

#: Largest difference of the nearest place from the slopes wanted, in standard deviations of the slopes.
_NEAREST = 1.0

_PASSES = 12


@dataclass(frozen=True)
class Shot:
    """Intersection of the beam's axis with the mean sea level.

    `x` and `y` are the values of ``aim_x`` and ``aim_y`` [m], `along` and `across` the mean slopes over the beam's
    footprint along the lidar's azimuth, positive for a face towards the lidar, and to its left [1].
    """

    kind: str
    x: float
    y: float
    along: float
    across: float


@dataclass(frozen=True)
class SeaMap:
    """Elevation of a sea [m] on grid lines [m], shape (len(y), len(x)), and its slopes averaged over the footprint.

    Slopes are along the lidar's azimuth and to its left [1], as in `Shot`.
    """

    x: FloatArray
    y: FloatArray
    heights: FloatArray
    along: FloatArray
    across: FloatArray

    @classmethod
    def of_scene(cls, scene: mi.Scene) -> SeaMap:
        """Return the map of a scene; reject one without waves."""
        from scipy.ndimage import gaussian_filter

        sea = next((shape.sea for shape in scene.shapes() if hasattr(shape, "sea")), None)
        if sea is None or not math.isfinite(sea.cell_size):
            raise UserError("the scene has no ocean_surface with waves: every shot on a flat sea is the same")
        transmitter = _transmitter(scene)
        transmitter.pose.require_above_sea()
        # Of a sea of several grids the coarsest.
        cell = getattr(sea.waves, "cell_size", sea.cell_size)
        count = min(getattr(sea.waves, "cells", int(sea.size / cell)), int(_LARGEST_SEARCH / cell)) // 2
        lines = np.arange(-count, count) * cell
        heights = sea.heights(lines, lines)
        azimuth, spread_along, spread_across = _footprint(transmitter)
        # A circle of the same area replaces the elliptical footprint.
        sigma = math.sqrt(spread_along * spread_across) / cell
        # The sea of a spectrum is periodic; a height map ends at its edges.
        smooth = gaussian_filter(heights, sigma, mode="wrap" if sea.spectrum != "height_map" else "nearest")
        up, right = np.gradient(smooth, cell)
        cos, sin = math.cos(azimuth), math.sin(azimuth)
        return cls(lines, lines, heights, cos * right + sin * up, cos * up - sin * right)

    def slope_at(self, x: float, y: float) -> tuple[float, float]:
        """Return the mean slopes (along, across) [1] over a footprint at a place [m] of the periodic sea."""
        spacing = self.x[1] - self.x[0]
        i, j = (round((value - self.x[0]) / spacing) % len(self.x) for value in (x, y))
        return float(self.along[j, i]), float(self.across[j, i])

    def find(self, kind: str, slope_sigmas: float, count: int, apart: float) -> list[Shot]:
        """Return the places with the slopes nearest to those of a kind, at least `apart` metres from each other."""
        spread = np.sqrt([np.mean(self.along**2), np.mean(self.across**2)])
        wanted = slope_sigmas * np.array(KINDS[kind]) * spread
        distance = np.hypot((self.along - wanted[0]) / spread[0], (self.across - wanted[1]) / spread[1])
        if not (nearest := float(np.min(distance, initial=np.inf))) <= _NEAREST:
            raise UserError(
                f"slope_sigmas = {slope_sigmas:g}: the sea has no place of the kind {kind} with such a slope; the "
                f"nearest one differs by {nearest:.1f} standard deviations, and at most {_NEAREST:g} are allowed"
            )
        shots: list[Shot] = []
        for index in np.argsort(distance, axis=None):
            j, i = np.unravel_index(index, distance.shape)
            x, y = float(self.x[i]), float(self.y[j])
            if all(math.hypot(x - shot.x, y - shot.y) >= apart for shot in shots):
                shots.append(Shot(kind, x, y, float(self.along[j, i]), float(self.across[j, i])))
            if len(shots) == count:
                break
        return shots


@dataclass(frozen=True)
class RenderedShots:
    """Shots of a scene, their results, the sea, and the footprints of beam and pixels on the mean sea level.

    Attributes
    ----------
    azimuth, beam_spread
        Azimuth of the beam [rad], and standard deviations of its footprint along and across it [m].
    pixel_lines, pixel_map, pixel_count
        Grid lines of a map about a shot [m], shape (n,), the index of the pixel at each node, shape (n, n), rows along
        y, and the number of pixels. The index is -1 outside all pixels, and everywhere with more than 64 pixels.
    """

    scene: str
    shots: tuple[Shot, ...]
    results: list[xr.Dataset]
    sea: SeaMap
    azimuth: float
    beam_spread: tuple[float, float]
    pixel_lines: FloatArray
    pixel_map: npt.NDArray[np.int64]
    pixel_count: int


def find_shots(
    scene: Any, params: Mapping[str, Any] | None = None, *, slope_sigmas: float = 2.0, count: int = 1
) -> list[Shot]:
    """Find places of each kind of slope on the sea of a scene.

    Parameters
    ----------
    scene, params
        As for `rendering.render.render`.
    slope_sigmas
        Required slopes in standard deviations of the mean slope over a footprint, greater than 0.
    count
        Places of each kind, 1 to 100.

    Returns
    -------
    list of Shot
        Shots by kind, those with the nearest slopes first.

    Raises
    ------
    UserError
        If the scene is invalid or has no waves, a number is out of range, or the sea has no such slopes.
    """
    slope_sigmas, count = positive("slope_sigmas", slope_sigmas), integer("count", count, 1, 100)
    loaded = open_scene(scene, params).scene
    sea = SeaMap.of_scene(loaded)
    apart = 4 * _footprint(_transmitter(loaded))[1]
    return [shot for kind in KINDS for shot in sea.find(kind, slope_sigmas, count, apart)]


def shots_at(scene: Any, places: Sequence[tuple[float, float]], params: Mapping[str, Any] | None = None) -> list[Shot]:
    """Return shots at given places (x, y) [m] of the sea of a scene; raises as `find_shots`."""
    loaded = open_scene(scene, params).scene
    sea = SeaMap.of_scene(loaded)
    return [Shot(f"shot {number}", x, y, *sea.slope_at(x, y)) for number, (x, y) in enumerate(places, start=1)]


def render_found_shots(
    scene: Any, shots: Sequence[Shot], params: Mapping[str, Any] | None = None, *, waveforms: bool = True
) -> RenderedShots:
    """Render shots, and map the sea and the footprints of beam and pixels.

    Parameters
    ----------
    scene, params
        An XML scene with the parameters ``aim_x`` and ``aim_y``.
    shots
        Places.
    waveforms
        Whether to render the shots.

    Raises
    ------
    UserError
        If the scene is invalid, has no waves or no parameters ``aim_x`` and ``aim_y``.
    """
    session = open_scene(scene, params)
    loaded = session.scene
    sea = SeaMap.of_scene(loaded)
    results = [
        render(scene, params={**(params or {}), "aim_x": shot.x, "aim_y": shot.y}, passes=_PASSES)
        for shot in (shots if waveforms else ())
    ]
    azimuth, along, across = _footprint(_transmitter(loaded))
    lines, pixel_map = _pixel_map(loaded)
    count = loaded.sensors()[0].receiver.pixels.count
    return RenderedShots(session.name, tuple(shots), results, sea, azimuth, (along, across), lines, pixel_map, count)


def _pixel_map(scene: mi.Scene) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Return `pixel_lines` and `pixel_map` of `RenderedShots`."""
    import mitsuba as mi

    receiver = scene.sensors()[0].receiver
    pose: Pose = receiver.pose
    centre = pose.ground_point()
    reach = 0.6 * receiver.pixels.field_of_view * float(np.linalg.norm(centre - pose.origin)) / -float(pose.axis[2])
    lines = np.linspace(-reach, reach, 301)
    x, y = np.meshgrid(lines, lines)
    if receiver.pixels.count > _MOST_MAPPED_PIXELS:
        return lines, np.full(x.shape, -1)
    points = np.stack([x + centre[0], y + centre[1], np.zeros_like(x)], axis=-1).reshape(-1, 3) - pose.origin
    depth = points @ pose.axis
    angle_x, angle_y = ((points @ side / depth).astype(np.float32) for side in (pose.far, pose.left))
    index, held = receiver.pixels.pixel_at(mi.Float(angle_x), mi.Float(angle_y), mi.Float(0.5))
    return lines, np.where(np.array(held) > 0, np.array(index).astype(int), -1).reshape(x.shape)


def _transmitter(scene: mi.Scene) -> mi.Emitter:
    transmitter = next((emitter for emitter in scene.emitters() if hasattr(emitter, "pulse_energy")), None)
    if transmitter is None or not scene.sensors():
        raise UserError("the scene needs a lidar_transmitter and a multipixel_receiver to find shots for")
    return transmitter


def _footprint(transmitter: mi.Emitter) -> tuple[float, float, float]:
    """Return the beam's azimuth [rad], and its spread on the mean sea level along and across it [m]."""
    pose: Pose = transmitter.pose
    across = transmitter.widest_angular_spread * float(np.linalg.norm(pose.ground_point() - pose.origin))
    cosine = max(-float(pose.axis[2]), 1e-3)
    azimuth = math.atan2(pose.axis[1], pose.axis[0]) if math.hypot(*pose.axis[:2]) > 1e-9 else 0.0
    return azimuth, across / cosine, across
