"""Sea elevation and slopes over the beam's footprint, and the truth at shot locations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import BoolArray, FloatArray
from mitransient_lidar.physics.sea.height_maps import HeightMap
from mitransient_lidar.physics.sea.sea_surface import SeaSurface
from mitransient_lidar.physics.water.water_types import InherentProperties
from mitransient_lidar.rendering.shots.batches import ShotPoses
from mitransient_lidar.results.attributes import described
from mitransient_lidar.transport.medium.water import Water
from mitransient_lidar.transport.medium.water_phases import table_of
from mitransient_lidar.transport.plugin_types import Transmitter
from mitransient_lidar.transport.probe import axis_on_bottom, first_along
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.scene_parts import seas_of

#: Reach of the mean over the beam's footprint, in its standard deviations, and smallest number of cells in one of them.
_REACH, _FEWEST_CELLS = 4.5, 4

#: Most cells whose means are computed together.
_MOST_CELLS = 2**20

#: Slopes along and across the lidar's azimuth for each kind of shot, in units of `slope_sigmas` standard deviations.
SLOPE_KINDS = {"towards": (1.0, 0.0), "level": (0.0, 0.0), "away": (-1.0, 0.0), "sideways": (0.0, 1.0)}

_LARGEST_SEARCH = 512.0  #: Longest side of the sea that is searched [m].

#: Largest difference between the nearest location and the wanted slopes, in slope standard deviations.
_NEAREST = 1.0


@dataclass(frozen=True)
class Shot:
    """Intersection of the beam's axis with the mean sea level.

    `x` and `y` are the values of ``aim_x`` and ``aim_y`` [m]. `along` and `across` are mean slopes over the beam's
    footprint [1]: along the lidar's azimuth, positive for a face towards the lidar, and to its left.
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
        """Return a scene's map; reject one without waves."""
        from scipy.ndimage import gaussian_filter

        sea = sea_of(scene)
        if sea is None or (sea.waves is None and sea.wake is None):
            raise UserError("the scene has no ocean_surface with waves: every shot on a flat sea is the same")
        transmitter = transmitter_of(scene)
        transmitter.pose.require_above_sea()
        # For a sea with several grids the coarsest.
        grid = None if isinstance(sea.waves, HeightMap) else sea.waves
        cell, cells = (sea.cell_size, int(sea.size / sea.cell_size)) if grid is None else (grid.cell_size, grid.cells)
        count = min(cells, int(_LARGEST_SEARCH / cell)) // 2
        # About the scene's origin, or about the frame of a lidar that is far from it.
        middle = [round(float(place) / cell) for place in transmitter.pose.frame_origin[:2]]
        x, y = (np.asarray((np.arange(-count, count) + place) * cell, dtype=np.float64) for place in middle)
        heights = sea.heights(x, y)
        azimuth, spread_along, spread_across = footprint(transmitter)
        # A circle of the same area replaces the elliptical footprint.
        sigma = math.sqrt(spread_along * spread_across) / cell
        # The sea of a spectrum is periodic; a height map ends at its edges.
        smooth = gaussian_filter(heights, sigma, mode="wrap" if sea.spectrum != "height_map" else "nearest")
        up, right = np.gradient(smooth, cell)
        cos, sin = math.cos(azimuth), math.sin(azimuth)
        return cls(x, y, heights, cos * right + sin * up, cos * up - sin * right)

    def slope_at(self, x: float, y: float) -> tuple[float, float]:
        """Return the mean slopes (along, across) [1] over a footprint at a place [m] of the periodic sea."""
        spacing = self.x[1] - self.x[0]
        pairs = ((x, self.x), (y, self.y))
        i, j = (round((value - lines[0]) / spacing) % len(lines) for value, lines in pairs)
        return float(self.along[j, i]), float(self.across[j, i])

    def find(self, kind: str, slope_sigmas: float, count: int, apart: float) -> list[Shot]:
        """Return the locations whose slopes are nearest to a kind's, at least `apart` metres from each other."""
        spread = np.sqrt([np.mean(self.along**2), np.mean(self.across**2)])
        wanted = slope_sigmas * np.array(SLOPE_KINDS[kind]) * spread
        distance = np.hypot((self.along - wanted[0]) / spread[0], (self.across - wanted[1]) / spread[1])
        if not (nearest := float(np.min(distance, initial=np.inf))) <= _NEAREST:
            raise UserError(
                f"slope_sigmas = {slope_sigmas:g}: the sea has no place of the kind {kind} with such a slope; the "
                f"nearest one differs by {nearest:.1f} standard deviations, and at most {_NEAREST:g} are allowed"
            )
        return self._nearest(kind, distance, count, apart)

    def near(self, slopes: tuple[float, float], count: int, apart: float) -> list[Shot]:
        """Return the places whose slopes (along, across) [1] are nearest to given ones, `apart` metres or more apart.

        A small sea may have fewer than `count` places.
        """
        distance = np.hypot(self.along - slopes[0], self.across - slopes[1])
        return self._nearest("near", distance, count, apart)

    def _nearest(self, kind: str, distance: FloatArray, count: int, apart: float) -> list[Shot]:
        """Return locations in a slope distance's order, in the map's shape."""
        shots: list[Shot] = []
        for index in np.argsort(distance, axis=None):
            j, i = np.unravel_index(index, distance.shape)
            x, y = float(self.x[i]), float(self.y[j])
            if all(math.hypot(x - shot.x, y - shot.y) >= apart for shot in shots):
                shots.append(Shot(kind, x, y, float(self.along[j, i]), float(self.across[j, i])))
            if len(shots) == count:
                break
        return shots


def transmitter_of(scene: mi.Scene) -> Transmitter:
    """Return a scene's transmitter; raise UserError without one."""
    transmitter = next((emitter for emitter in scene.emitters() if isinstance(emitter, Transmitter)), None)
    if transmitter is None:
        raise UserError("the scene needs a lidar_transmitter and a multipixel_receiver to find shots for")
    return transmitter


def footprint(transmitter: Transmitter) -> tuple[float, float, float]:
    """Return the beam's azimuth [rad], and its spread on the mean sea level along and across it [m]."""
    pose = transmitter.pose
    across = transmitter.widest_angular_spread * pose.ground_range
    return float(pose.azimuth), across / max(-float(pose.axis[2]), 1e-3), across


def truth_coordinates(sea: SeaSurface | None, lidar: LidarScene, shots: ShotPoses) -> dict[str, Any]:
    """Return the coordinates over ``shot`` for shots over an ``ocean_surface`` sea, with units and descriptions.

    Locations, slopes and depths as for `shots.series.render_shots`, and in scenes with water its coefficients
    (`water_means`). Where the axis meets land or another solid above the sea, the sea and the water are unknown (NaN).
    The bottom below another solid is also unknown; land is a bottom above the sea, at a negative depth.
    """
    places = shots.places
    turns = np.zeros(len(places))
    if shots.in_scene is not None:
        # The rotation of the shot's frame also turns with the pixels.
        turns = shots.in_scene.azimuth - lidar.receiver.pose.azimuth
    seas = [sea] * len(places) if sea is None or shots.times_s is None else map(sea.at, shots.times_s.tolist())
    along, across, height = footprint_means(list(seas), lidar.transmitter, places, turns).T
    own = lidar.receiver.pose
    origins, axes = own.origin + np.pad(places - own.in_scene(own.ground_point())[:2], ((0, 0), (0, 1))), own.axis
    if shots.in_scene is not None:
        origins, axes = shots.in_scene.origin - lidar.frame_origin, shots.in_scene.axis
    found = -axis_on_bottom(lidar, origins, axes)[:, 2]
    # Rays in single precision are known to a tenth of a millimetre.
    depth = np.round(found, 4)
    on_land = depth + height < 0
    if lidar.empty_heights[0] > 0 and np.all(axes[..., 2] < 0) and not lidar.submerged:
        at_sea = origins - axes * (origins[:, 2:] / axes[..., 2:])
        on_solid = first_along(lidar, [origins, at_sea])[:, 2] > height
        depth = np.where(on_solid & ~on_land, np.nan, depth)
        on_land |= on_solid
    of_sea = {"true_slope_along": along, "true_slope_across": across, "true_surface_height": height}
    of_water = {} if lidar.water is None else water_means(lidar.water, depth)
    of_sea = {name: np.where(on_land, np.nan, column) for name, column in {**of_sea, **of_water}.items()}
    values = {
        "aim_x": places[:, 0],
        "aim_y": places[:, 1],
        **{name: of_sea.pop(name) for name in ("true_slope_along", "true_slope_across", "true_surface_height")},
        "true_bottom_depth": depth,
        "true_bottom_depth_below_surface": np.where(on_land, np.nan, depth + height),
        **of_sea,
    }
    return {name: ("shot", column, described(name)) for name, column in values.items()}


def water_means(water: Water, depth: FloatArray) -> dict[str, FloatArray]:
    """Return the mean coefficients of a ``layered_water`` from the mean sea level to depths [m], bubbles left out.

    They are ``true_absorption``, ``true_scattering``, ``true_backscattering``, ``true_attenuation`` and ``true_kd``
    [1/m], each in the shape of `depth`. Backscattering belongs to the rendered phase functions, and Kd follows by the
    formula in `water_types.InherentProperties.kd`. At an unknown depth (NaN) the values are given for a water that is
    the same at all depths, and NaN for others.
    """
    column = water.column
    phases = water.phases.phases[: column.count]
    ratios = {id(phase): table_of(phase).backscatter_ratio for phase in phases}
    backscattering = column.scattering * [ratios[id(phase)] for phase in phases]
    # Phase function rounding may give slightly less than half the scattering by molecules.
    molecules = np.minimum(water.water_scattering, 2 * backscattering)
    rows = zip(column.absorption, column.scattering, backscattering, molecules, strict=True)
    layers = {
        "true_absorption": column.absorption,
        "true_scattering": column.scattering,
        "true_backscattering": backscattering,
        "true_attenuation": column.attenuation,
        "true_kd": np.array([InherentProperties(*map(float, row)).kd for row in rows]),
    }
    shares = column.layer_shares(depth)
    return {name: np.asarray(shares @ values) for name, values in layers.items()}


def solids_below(lidar: LidarScene, x: FloatArray, y: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the highest solid's height at places [m], NaN without one, and whether it is a target.

    Places in the scene have the shape (n,); targets are `WaterScene.targets`.
    """
    heights = [float(z) for solid in lidar.solids for z in (solid.bbox().min.z, solid.bbox().max.z)]
    places = np.stack([x, y], axis=1) - lidar.frame_origin[:2]
    line = [np.insert(places, 2, z, axis=1) for z in (max(heights, default=0.0) + 1, min(heights, default=0.0) - 1)]
    highest, target = (first_along(lidar, line, shapes)[:, 2] for shapes in (None, lidar.targets))
    return highest, highest == target


def sea_of(scene: mi.Scene) -> SeaSurface | None:
    """Return an ``ocean_surface``'s sea, None without one."""
    return next((found.sea for found in seas_of(scene)), None)


def footprint_means(
    seas: Sequence[SeaSurface | None], transmitter: Transmitter, places: FloatArray, turns: FloatArray
) -> FloatArray:
    """Return the slopes along the lidar's azimuth and to its left [1] and the height [m] at places, shape (n, 3).

    They are means over the beam's footprint on the mean sea level, an elliptic Gaussian, and 0 without waves. Each of
    the places (x, y) [m], shape (n, 2), has its sea, all of them one at several times, and a lidar turned about the
    vertical [rad].
    """
    sea, count = seas[0], len(places)
    if sea is None or not math.isfinite(sea.cell_size):
        return np.zeros((count, 3))
    azimuth, along, across = footprint(transmitter)
    reach = max(math.ceil(_REACH * along / sea.cell_size), _FEWEST_CELLS)
    together = max(_MOST_CELLS // (2 * reach + 1) ** 2, 1)
    if count > together:
        starts = range(0, count, together)
        some = [slice(first, first + together) for first in starts]
        return np.concatenate([footprint_means(seas[one], transmitter, places[one], turns[one]) for one in some])
    heights, corners = sea.height_patches(places, (2 * reach - 1) * sea.cell_size, [one for one in seas if one])
    up, right = np.gradient(heights, sea.cell_size, axis=(1, 2))
    cos, sin = (turned[:, None, None] for turned in (np.cos(azimuth + turns), np.sin(azimuth + turns)))
    away = (corners - places)[..., None] + sea.cell_size * np.arange(2 * reach + 1)
    dx, dy = away[:, 0, None, :], away[:, 1, :, None]
    weight = np.exp(-0.5 * (((cos * dx + sin * dy) / along) ** 2 + ((cos * dy - sin * dx) / across) ** 2))
    weight /= weight.sum(axis=(1, 2), keepdims=True)
    values = (cos * right + sin * up, cos * up - sin * right, heights)
    return np.stack([np.sum(weight * value, axis=(1, 2)) for value in values], axis=1)
