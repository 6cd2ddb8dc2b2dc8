"""First and last arrival times in a lidar: the limits of a time axis that are not given. System attenuation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import ArrayLike, FloatArray, non_negative_array
from mitransient_lidar.physics.lidar.level_sea import LevelSea
from mitransient_lidar.physics.lidar.pose import Pose
from mitransient_lidar.physics.water.layers import WaterColumn

#: Level to which light falls in the column before the time axis ends, and below which a solid counts as invisible.
COLUMN_LEVEL, SOLID_LEVEL = 1e-6, 1e-12

#: Time for multiply scattered light after the last echo: a multiple of this echo's time in the water, for shallow
#: water, or if less a time [ns] plus a share of it. Chosen with renders over longer time axes: less than 1e-4 of the
#: energy arrives later.
_SHALLOW, _LATER_NS, _LATER_SHARE = 4.0, 40.0, 0.25

_FARTHEST = 10.0  #: Largest distance from the beam at which the time of the way from it is added for the view [m].

#: Horizontal distance from the lines of sight, over the depth, within which waves and scattering light a solid.
_REACH_PER_DEPTH = 0.3

_NARROWINGS = 6  #: Largest number of times that the height range of a solid in view is narrowed.
_EDGE, _CIRCLES = 128, 8  #: Directions at a cone's edge, and circles of such directions within it.
_COVERED = 0.98  #: A bottom that ends this share of its lines of sight makes the water below it count no more.
_HIGHEST = 0.9  #: Greatest height of the plane of the earliest light, relative to the lower instrument's altitude.

_NS_PER_M = 1e9 / C0


@dataclass(frozen=True, eq=False)
class Cone:
    """Directions in the air within a laser beam or a field of view."""

    pose: Pose  #: Position above the sea level, and axis.
    half_angles: tuple[float, float]  #: Half angles along the two tangent-plane angles [rad].
    is_round: bool = True  #: Whether the cross-section is an ellipse instead of a rectangle.

    def places(self, z: float, reach: float) -> FloatArray:
        """Return where its directions meet a height [m], x, y [m]; beyond `reach` [m] and above the horizon there."""
        azimuth = np.linspace(0, 2 * np.pi, _EDGE, endpoint=False)
        edge = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
        if not self.is_round:
            edge = edge / np.abs(edge).max(axis=1, keepdims=True)
        angles = (np.linspace(0, 1, _CIRCLES + 1)[:, None, None] * edge).reshape(-1, 2) * self.half_angles
        direction = self.pose.rays(angles)
        sine, down = np.hypot(direction[:, 0], direction[:, 1]), -direction[:, 2]
        with np.errstate(divide="ignore"):
            distance = np.where(down > 0, (self.pose.origin[2] - z) * sine / np.maximum(down, 0), np.inf)
        along = np.minimum(distance, reach) / np.where(sine > 0, sine, 1)
        return np.asarray(self.pose.origin[:2] + direction[:, :2] * along[:, None])

    def holds(self, places: FloatArray, z: float) -> np.ndarray:
        """Return whether places x, y [m] at a height [m] are in the cone."""
        offset = np.column_stack([places, np.full(len(places), z)]) - self.pose.origin
        ahead = offset @ self.pose.axis
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = np.abs(self.pose.angles_of(offset) / self.half_angles).T
        # The edge of an equal cone is inside, whatever the rounding.
        return np.asarray((ahead > 0) & ((np.hypot(x, y) if self.is_round else np.maximum(x, y)) <= 1 + 1e-9))


@dataclass(frozen=True, eq=False)
class Solid:
    """A bottom or target: its name, and triangles with its highest and lowest points [m], shape (n, 3, 3)."""

    name: str
    triangles: FloatArray

    @cached_property
    def _corners(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest coordinates per triangle, shape (3, n)."""
        # Coordinate by coordinate, and corner by corner: NumPy reduces axes of three slowly.
        first, second, third = self.triangles.transpose(1, 2, 0)
        return np.minimum(np.minimum(first, second), third), np.maximum(np.maximum(first, second), third)

    @cached_property
    def box(self) -> tuple[FloatArray, FloatArray]:
        """Bounding box corners [m]."""
        low, high = self._corners
        return low.min(axis=1), high.max(axis=1)

    def heights_in(self, low: FloatArray, high: FloatArray) -> tuple[float, float] | None:
        """Return the height limits [m] between locations (x, y) [m], None where the solid has no part there."""
        lows, highs = self._corners
        here = np.flatnonzero((lows[0] <= high[0]) & (highs[0] >= low[0]) & (lows[1] <= high[1]) & (highs[1] >= low[1]))
        if here.size == 0:
            return None
        lowest, highest, triangles = lows[2, here], highs[2, here], self.triangles[here]
        normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        level = np.abs(normal[:, 2]) > 1e-6 * np.linalg.norm(normal, axis=1)
        # A triangle that is larger than the view: its plane at the corners of the view.
        slope = -normal[level, :2] / normal[level, 2:]
        corners = np.array([(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])])
        first = triangles[level, 0]
        planes = first[:, 2, None] + np.sum(slope[:, None] * (corners - first[:, None, :2]), axis=-1)
        lowest[level] = np.maximum(lowest[level], planes.min(axis=1))
        highest[level] = np.minimum(highest[level], planes.max(axis=1))
        return float(lowest.min()), float(highest.max())


@dataclass(frozen=True)
class AxisLimits:
    """First and last arrival of light over all pixels, for an ideal pulse."""

    first_ns: float
    last_ns: float
    surface_ns: tuple[float, float]  #: First and last arrival from the sea surface.
    end: str  #: Source of the last light.


@dataclass(frozen=True, eq=False)
class LidarView:
    """Lidar geometry over a sea."""

    #: Field of view with its blur, and beam.
    view: Cone
    beam: Cone
    #: Index layers of the water below z = 0, and layers of system attenuation by which its signal decays.
    sea: LevelSea
    decay: WaterColumn
    heights: tuple[float, float]  #: Lowest and highest sea height [m].
    reach: float  #: Horizontal distance to the end of the scene [m], where light towards the horizon ends.
    #: Least depth of the last light from water without a bottom [m], such as light from bubbles; None without water.
    column: float | None

    def limits(self, solids: Sequence[Solid], direct: bool = False, dry: bool = False) -> AxisLimits:
        """Find the first and the last arrival of light; with `direct`, the last one by surface and solid echoes only.

        The sea returns no light in a `dry` view or beam, which meets land alone.

        Light follows directions in both view and beam. The first light is reflected at the height of the highest crest,
        or of a solid above it. The last light comes from the deepest part of a solid in these directions, or within 0.3
        of its depth of them, below a level sea at the height of the lowest trough. Multiply scattered light follows it:
        for up to four times its time in the water or 40 ns and a quarter of it, plus the time from the beam to the edge
        of the view, up to 10 m. Where no solids end these directions, the last light comes from the depth at which the
        column signal has fallen to 1e-6. This signal is exp(-2 K s) by Gordon's system attenuation K
        (`system_attenuation`). Solids where it is below 1e-12 are invisible.
        """
        surface = self._earliest(self.heights[1]), sum(self._latest(self.heights[0]))
        seen = self._at_sea[1]
        # Both ways, per vertical metre.
        slant = 2 / np.sqrt(1 - (float(_sine(seen).min()) / self.sea.refractive_index[0]) ** 2)
        covered = np.zeros(len(seen), dtype=bool)
        firsts, lasts = [], []
        for solid in solids:
            limits = self._heights_of(solid)
            if limits is None:
                continue
            lowest, highest = limits
            if self.column is None or highest > self.heights[1]:
                firsts.append(self._earliest(highest))
            if np.exp(-slant * self.decay.cumulative(max(-lowest, 0.0))) >= SOLID_LEVEL:
                air, in_water = self._latest(lowest)
                later = min(_SHALLOW * in_water, _LATER_NS + _LATER_SHARE * in_water) + self._crossing_ns
                later = 0.0 if direct or dry else later
                lasts.append((air + in_water + later, f"after the echo of shape {solid.name!r}"))
                low, high = solid.box
                below = self.sea.at_height(self.view.pose.origin, seen, min(lowest, 0.0))
                covered |= np.all((below >= low[:2]) & (below <= high[:2]), axis=1)
        if (self.column is not None and not dry) or not firsts:
            firsts.append(surface[0])
            lasts.append((surface[1], "after the surface echo"))
        if self.column is not None and not direct and not dry and np.mean(covered) < _COVERED:
            depth = max(self.decay.depth_of(-np.log(COLUMN_LEVEL) / slant), self.column)
            text = f"at a depth of {depth:.3g} m, where the water's signal has fallen to {COLUMN_LEVEL:g}"
            lasts.append((sum(self._latest(-depth)), text))
        last, end = max(lasts)
        return AxisLimits(min(firsts), last, surface, end)

    @cached_property
    def _at_sea(self) -> tuple[FloatArray, FloatArray]:
        """Rays of laser and receiver to the mean sea level [m]."""
        return self._rays(0.0)[:2]

    @cached_property
    def _crossing_ns(self) -> float:
        """Time in the water from the beam to the edge of the view [ns]."""
        view, beam = (cone.places(0.0, self.reach)[-_EDGE:] for cone in (self.view, self.beam))
        outside = view[~self.beam.holds(view, 0.0)]
        if len(outside) == 0:
            return 0.0
        away = np.linalg.norm(outside[:, None] - beam, axis=-1).min(axis=1)
        index = self.sea.group_index or self.sea.refractive_index
        return float(_NS_PER_M * index[0] * min(away.max(), _FARTHEST))

    def _rays(self, z: float) -> tuple[FloatArray, FloatArray, bool]:
        """Return rays of laser and receiver to a height [m], shape (n, 3), and whether they meet, lit and seen."""
        of_view, of_beam = self.view.places(z, self.reach), self.beam.places(z, self.reach)
        common = np.concatenate([of_view[self.beam.holds(of_view, z)], of_beam[self.view.holds(of_beam, z)]])
        meet = len(common) > 0
        laser, receiver = (
            np.insert(places, 2, z, axis=1) - cone.pose.origin
            for cone, places in ((self.beam, common if meet else of_beam), (self.view, common if meet else of_view))
        )
        return laser, receiver, meet

    def _below_instruments(self, z: float) -> float:
        return float(min(z, _HIGHEST * min(self.view.pose.origin[2], self.beam.pose.origin[2])))

    def _earliest(self, z: float) -> float:
        """Return the time of the first light from a height in the air [ns]."""
        *rays, meet = self._rays(self._below_instruments(z))
        laser, receiver = (np.linalg.norm(each, axis=1) for each in rays)
        return float(_NS_PER_M * (np.min(laser + receiver) if meet else laser.min() + receiver.min()))

    def _latest(self, z: float) -> tuple[float, float]:
        """Return the times of the last direct light from a height, through the air and in the water [ns]."""
        total = in_water = 0.0
        for rays in self._rays(self._below_instruments(max(z, self.heights[0])))[:2]:
            optical, _ = self.sea.lengths(-z, _sine(rays))
            total += float((np.linalg.norm(rays, axis=1) + optical).max())
            in_water += float(optical.max())
        return _NS_PER_M * (total - in_water), _NS_PER_M * in_water

    def _heights_of(self, solid: Solid) -> tuple[float, float] | None:
        """Return the height limits [m] of a solid's parts that may be lit and seen, None without such parts."""
        heights = float(solid.box[0][2]), float(solid.box[1][2])
        # Limits of the heights limit the places, and these the heights.
        for _ in range(_NARROWINGS):
            corners = []
            for z in heights:
                top = max(self._below_instruments(z), 0.0)
                rays = self._at_sea if z <= 0 else self._rays(top)[:2]
                lines = zip((self.beam.pose.origin, self.view.pose.origin), rays, strict=True)
                places = np.concatenate([self.sea.at_height(*one, min(z, top)) for one in lines])
                margin = _REACH_PER_DEPTH * max(-z, 0.0)
                corners += [places.min(axis=0) - margin, places.max(axis=0) + margin]
            narrower = solid.heights_in(np.min(corners, axis=0), np.max(corners, axis=0))
            if narrower is None or narrower == heights:
                return narrower
            heights = narrower
        return heights


def _sine(rays: FloatArray) -> FloatArray:
    """Return the sines of ray angles from the vertical, shape (n,)."""
    return np.asarray(np.hypot(rays[:, 0], rays[:, 1]) / np.linalg.norm(rays, axis=1))


SPOT_COEFFICIENT = 0.85
"""Rate at which the system attenuation falls from c to Kd with the spot diameter in attenuation lengths."""


def system_attenuation(attenuation: ArrayLike, kd: ArrayLike, spot_diameter: ArrayLike) -> FloatArray:
    """One-way attenuation coefficient of a lidar's column signal.

    Returns K = Kd + (c - Kd) exp(-0.85 c D) [1/m], in the broadcast shape of the parameters. Without its geometric
    factors the signal is proportional to exp(-2 K s) with the distance s in the water.

    `attenuation`: beam attenuation coefficient c [1/m], at least `kd`. `kd`: diffuse attenuation coefficient Kd of
    downwelling irradiance [1/m], at least 0. `spot_diameter`: diameter D of the spot on the sea surface that the lidar
    illuminates and views [m], at least 0.

    Gordon (1982), Appl. Opt. 21, 2996, doi:10.1364/AO.21.002996, solved the transfer by Monte Carlo for a level sea.
    The signal decays exponentially over four attenuation lengths. It decays with c where the radius R of the spot in
    view is far below 1/c, and with Kd where c R is above 5 to 6. Between them K depends on c and the whole volume
    scattering function. The formula is a fit by which later authors represent such results, such as Churnside (2013),
    Opt. Eng. 53, 051405, doi:10.1117/1.OE.53.5.051405, eq. 5. It uses the spot's diameter and therefore reaches Kd to
    within 1 % of c - Kd at c R = 2.7 already.

    The result is an order of magnitude. The formula does not distinguish the field of view from the beam. Nor is Kd a
    strict limit: by Phillips and Koerber (1984), Aust. J. Phys. 37, 75, the signal in a large field of view decays with
    the absorption coefficient, which is below Kd.
    """
    c, diffuse, diameter = np.broadcast_arrays(
        non_negative_array("attenuation", attenuation),
        non_negative_array("kd", kd),
        non_negative_array("spot_diameter", spot_diameter),
    )
    if np.any(diffuse > c):
        worst = np.argmax(diffuse - c)
        raise UserError(f"kd = {diffuse.flat[worst]:g} must not exceed attenuation = {c.flat[worst]:g}")
    return np.asarray(diffuse + (c - diffuse) * np.exp(-SPOT_COEFFICIENT * c * diameter))
