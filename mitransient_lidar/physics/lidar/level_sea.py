"""Lidar over a level sea: refraction, ranges, depths and times, the lidar equation, and definitions of divergence.

Angles are from the vertical, `theta` in air and `phi` in water; n is the index of water relative to air.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field

import numpy as np

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.fields import Read
from mitransient_lidar.core.validation import ArrayLike, Checked, FloatArray, checked, finite_array, in_range, positive
from mitransient_lidar.physics.lidar.pose import Pose

_STEPS, _CHANGE = 60, 4e-16  #: Steps of Newton's method, and the relative change at which it ends.
_SMALLEST_DESCENT = 1e-9  #: Directions nearer to the horizon than this sine are taken as horizontal.


@dataclass(frozen=True)
class LevelSea:
    """Water below the mean sea level z = 0, in layers of one refractive index each."""

    refractive_index: tuple[float, ...]  #: Indices relative to air from the top down, at least 1, shape (layers,).
    #: Depths of the boundaries between the layers [m], increasing, shape (layers - 1,).
    boundaries: tuple[float, ...] = ()
    group_index: tuple[float, ...] | None = None  #: Group indices of the layers; by default the refractive indices.

    def lengths(self, depth: ArrayLike, sine: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the optical length of rays from the sea level to depths, and the horizontal one over the sine [m].

        Depths [m] and sines of the angles from the vertical in the air broadcast. Lengths to points in the air are 0.
        """
        depth, sine = np.asarray(depth, dtype=np.float64), np.asarray(sine, dtype=np.float64)
        optical = horizontal = np.zeros(np.broadcast_shapes(depth.shape, sine.shape))
        groups = self.group_index or self.refractive_index
        for index, group, thickness in zip(self.refractive_index, groups, self._thickness(depth), strict=True):
            length = thickness / np.sqrt(index**2 - sine**2)
            optical, horizontal = optical + group * index * length, horizontal + length
        return optical, horizontal

    def at_height(self, origin: FloatArray, directions: ArrayLike, z: ArrayLike) -> FloatArray:
        """Return where rays from points in the air meet a height, in the air or in the water.

        Returns x, y [m], shape (..., 2); NaN for rays that do not go down.

        `origin`: point in the air, x, y, z [m], or one for each ray, shape (..., 3). `directions`: ray directions in
        the air, of any length, shape (..., 3). `z`: heights [m], below the origin, shape (...).
        """
        rays = finite_array("directions", directions)
        level = np.broadcast_to(finite_array("z", z), rays.shape[:-1])
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        sine = np.hypot(rays[..., 0], rays[..., 1])
        down = np.where(rays[..., 2] < -_SMALLEST_DESCENT, -rays[..., 2], np.nan)
        distance = (origin[..., 2] - np.maximum(level, 0)) / down + self.lengths(-level, sine)[1]
        return np.asarray(origin[..., :2] + rays[..., :2] * distance[..., None])

    def crossing(self, origin: FloatArray, points: ArrayLike) -> FloatArray:
        """Return where lines of sight from a point in the air to points cross the sea level.

        Lines to points in the air are prolonged straight to the sea level.

        Returns x, y [m], shape (..., 2); NaN for points in the air that are not below the origin.

        `origin`: point in the air, x, y, z [m]. `points`: points x, y, z [m], shape (..., 3).
        """
        points = finite_array("points", points)
        offset, height = points[..., :2] - origin[:2], float(origin[2])
        target = np.linalg.norm(offset, axis=-1)
        in_water = height * self._tangents(target, height, -points[..., 2]) / np.where(target > 0, target, 1)
        drop = np.where(points[..., 2] < height, height - points[..., 2], np.nan)
        share = np.where(points[..., 2] > 0, height / drop, np.where(target > 0, in_water, 0))
        return np.asarray(origin[:2] + offset * share[..., None])

    def _tangents(self, distance: FloatArray, height: float, depth: FloatArray) -> FloatArray:
        """Return the tangents of ray angles from the vertical in air, between points in air and in the water.

        The points are a horizontal distance [m] apart; the height is above the sea level, positive [m].
        """
        # The distance is a concave, increasing function of the tangent: Newton's method from 0 cannot overshoot.
        t, layers = np.zeros_like(distance), list(zip(self.refractive_index, self._thickness(depth), strict=True))
        for _ in range(_STEPS):
            missing, rise = distance - height * t, np.full_like(t, height)
            for n, thickness in layers:
                root = np.sqrt(n**2 + (n**2 - 1) * t**2)
                missing, rise = missing - thickness * t / root, rise + thickness * n**2 / root**3
            change = missing / rise
            t = t + change
            if np.all(np.abs(change) <= _CHANGE * t):
                break
        return np.asarray(t)

    def _thickness(self, depth: FloatArray) -> list[FloatArray]:
        """Return each layer's thickness above depths [m]."""
        edges = [0.0, *self.boundaries, np.inf]
        return [np.clip(depth - top, 0, bottom - top) for top, bottom in itertools.pairwise(edges)]


def snell(theta: ArrayLike, n: float) -> FloatArray:
    """Refraction angle [rad] in water with relative index `n` >= 1 for angles `theta` [rad] in air."""
    return np.asarray(np.arcsin(np.sin(finite_array("theta", theta)) / in_range("n", n, 1, np.inf)))


def cos_in_water(cosine: ArrayLike, n: float) -> FloatArray:
    """Return the cosines of refraction angles in water from the cosines in air, by Snell's law."""
    return np.asarray(np.sqrt(1 - (1 - np.asarray(cosine, dtype=np.float64) ** 2) / n**2))


def turn_by_slope(theta: ArrayLike, n: float) -> FloatArray:
    """Return the angle by which a slope turns the refracted ray over the slope, 1 - cos(theta)/(n cos(phi))."""
    angle = np.asarray(theta, dtype=np.float64)
    return np.asarray(1 - np.cos(angle) / (n * np.sqrt(1 - (np.sin(angle) / n) ** 2)))


def refract(direction: FloatArray, normal: FloatArray, n: float) -> FloatArray:
    """Return unit directions refracted from air into water by a facet, shape (..., 2 or 3).

    `direction`: unit directions of propagation in the air, shape (..., 2 or 3). `normal`: facet normals into the air,
    of any length, with the same shape. `n`: refractive index of the water relative to air, at least 1.
    """
    unit = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    cosine = -np.sum(direction * unit, axis=-1, keepdims=True)
    return np.asarray(direction / n + (cosine / n - cos_in_water(cosine, n)) * unit)


def refract_level(direction: FloatArray, n: float) -> FloatArray:
    """Return unit directions refracted downwards by the level surface, as `refract` does by a facet, shape (..., 3)."""
    horizontal = direction[..., :2] / n
    down = -np.sqrt(1 - np.sum(horizontal**2, axis=-1, keepdims=True))
    return np.concatenate([horizontal, down], axis=-1)


def fresnel(theta: ArrayLike, n: float) -> tuple[FloatArray, FloatArray]:
    """Power reflectance and transmittance of a smooth interface for unpolarised light.

    `theta`: incidence angle [rad], 0 to pi/2. `n`: index behind the interface relative to that before it; below 1 from
    water to air.

    Returns `reflectance`, `transmittance`: they add up to 1; the reflectance is 1 beyond the critical angle.
    """
    angle = finite_array("theta", theta)
    cos_i = np.cos(angle)
    sin_t = np.sin(angle) / positive("n", n)
    cos_t = np.sqrt(np.maximum(1 - sin_t**2, 0))
    with np.errstate(invalid="ignore"):
        s = (cos_i - n * cos_t) / (cos_i + n * cos_t)
        p = (n * cos_i - cos_t) / (n * cos_i + cos_t)
    reflectance = np.where(sin_t < 1, 0.5 * (s**2 + p**2), 1.0)
    return reflectance, 1 - reflectance


def solid_angle_per_area(height: ArrayLike, depth: ArrayLike, theta: ArrayLike, n: float) -> FloatArray:
    """Solid angle in water per receiver area, at a point on the refracted ray.

    Returns d(omega)/dA [sr/m^2] for an aperture normal to the ray: 1/(S_s S_t) with the sagittal distance S_s = n
    H/cos(theta) + D/cos(phi). The tangential distance is S_t = n H cos(phi)/cos^2(theta) + D cos(theta)/cos^2(phi).

    `height`, `depth`: receiver height and point depth [m]. `theta`, `n`: ray angle in air [rad], and water refractive
    index.
    """
    h, d = np.asarray(height, dtype=np.float64), np.asarray(depth, dtype=np.float64)
    air, water = np.cos(finite_array("theta", theta)), np.cos(snell(theta, n))
    sagittal = n * h / air + d / water
    tangential = n * h * water / air**2 + d * air / water**2
    return np.asarray(1 / (sagittal * tangential))


def surface_time_ns(height: ArrayLike, theta: ArrayLike) -> FloatArray:
    """Two-way time [ns] to the level surface from `height` [m] at the angle `theta` [rad]."""
    return np.asarray(2e9 * np.asarray(height, dtype=np.float64) / (C0 * np.cos(finite_array("theta", theta))))


def _below_horizon(name: str, value: float) -> float:
    """Return an angle from the vertical; reject one outside [0, pi/2) rad."""
    if not 0 <= value < np.pi / 2:
        raise UserError(f"{name} = {value:g} must be at least 0 and below pi/2")
    return value


@dataclass(frozen=True)
class LidarGeometry(Checked):
    """Co-located transmitter and receiver over a level sea, along their axis.

    Values out of range raise UserError.
    """

    height: float = checked(positive)  #: Height above the mean sea level [m], positive.
    off_nadir: float = checked(_below_horizon)  #: Angle of the axis from the vertical [rad], 0 to below pi/2.
    #: Refractive index of the water, at least 1, which refracts rays.
    refractive_index: float = checked(in_range, 1, np.inf)
    #: Group index of the water, at least 1, which determines travel times.
    group_index: float = checked(in_range, 1, np.inf)
    #: Surface echo arrival [ns], the zero of depths; by default (NaN) from the mean sea level along the axis.
    surface_time_ns: float = field(default=math.nan, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if math.isnan(self.surface_time_ns):
            level = float(surface_time_ns(self.height, self.off_nadir))
            object.__setattr__(self, "surface_time_ns", level)

    @classmethod
    def of_pose(cls, pose: Pose, refractive_index: float, group_index: float) -> LidarGeometry:
        """Return a lidar's geometry from its pose above water with these indices."""
        pose.require_above_sea()
        return LidarGeometry(float(pose.origin[2]), math.radians(pose.off_nadir_deg), refractive_index, group_index)

    @property
    def angle_in_water(self) -> float:
        """Angle of the axis from the vertical in the water [rad]."""
        return float(snell(self.off_nadir, self.refractive_index))

    @property
    def cos_water(self) -> float:
        """Cosine of the axis's angle from the vertical in the water."""
        return float(np.cos(self.angle_in_water))

    @property
    def slant_range(self) -> float:
        """Distance to the mean sea level along the axis [m]."""
        return self.height / math.cos(self.off_nadir)

    @property
    def surface_ns_per_rad(self) -> float:
        """Change of the arrival from the mean sea level with the angle from the vertical [ns/rad]."""
        return 2e9 / C0 * self.slant_range * math.tan(self.off_nadir)

    @property
    def metres_per_ns(self) -> float:
        """One-way path in the water per nanosecond of delay [m/ns]."""
        return 0.5e-9 * C0 / self.group_index

    @property
    def depth_per_ns(self) -> float:
        """Depth per nanosecond of delay [m/ns]: c0 cos(theta_water)/(2 n_g)."""
        return self.metres_per_ns * self.cos_water

    def path_of_time(self, time_ns: ArrayLike) -> FloatArray:
        """Return the one-way path in the water [m] of echoes at times [ns]."""
        return np.asarray(self.metres_per_ns * (finite_array("time_ns", time_ns) - self.surface_time_ns))

    def depth_of_time(self, time_ns: ArrayLike) -> FloatArray:
        """Return the echo depth [m] for times [ns]."""
        return np.asarray((finite_array("time_ns", time_ns) - self.surface_time_ns) * self.depth_per_ns)

    def time_of_depth(self, depth: ArrayLike) -> FloatArray:
        """Return the arrival times [ns] of echoes from depths [m]."""
        return np.asarray(self.surface_time_ns + finite_array("depth", depth) / self.depth_per_ns)

    def solid_angle_per_area(self, path: ArrayLike) -> FloatArray:
        """Return the solid angle of the aperture per area [sr/m^2] at one-way paths in the water [m]."""
        depth = np.asarray(path, dtype=np.float64) * self.cos_water
        return solid_angle_per_area(self.height, depth, self.off_nadir, self.refractive_index)

    def spreading(self, path: ArrayLike) -> FloatArray:
        """Return the solid angle of the aperture at paths in the water [m] over that at the surface; 1 above it."""
        return np.asarray(self.solid_angle_per_area(np.maximum(path, 0)) / self.solid_angle_per_area(0.0))

    def surface_depth(self, edge: float) -> float:
        """Return the depth [m] on the axis that is simultaneous with the far surface echo of a half angle [rad]."""
        farthest = self.height / math.cos(min(self.off_nadir + edge, 0.5 * math.pi - 1e-3))
        return (farthest - self.slant_range) / self.group_index * self.cos_water


@dataclass(frozen=True, kw_only=True)
class LidarSystem(LidarGeometry):
    """Co-located transmitter and receiver of a given energy and aperture."""

    #: Pulse energy [J], positive, times efficiencies of both optics and two-way transmission of the air.
    energy: float = checked(positive)
    aperture_area: float = checked(positive)  #: Area of the receiver normal to the ray [m^2], positive.

    def water_gain(self, depth: ArrayLike, theta: ArrayLike) -> FloatArray:
        """Received energy per unit of backscatter [J sr], without attenuation in the water.

        `depth`, `theta`: depth [m], at least 0, and angle of the ray in air [rad], which broadcast.
        """
        _, transmittance = fresnel(theta, self.refractive_index)
        solid_angle = solid_angle_per_area(self.height, depth, theta, self.refractive_index)
        return np.asarray(self.energy * self.aperture_area * transmittance**2 * solid_angle)

    @property
    def column_gain(self) -> float:
        """Power of the column's signal at the surface over the backscatter at 180 degrees, b p(pi) [W m sr]."""
        return float(self.water_gain(0.0, self.off_nadir)) * 1e9 * self.metres_per_ns


#: Ratio of each definition's full width to a Gaussian beam's e^-1/2 full width (2 sigma).
WIDTHS = {"divergence_mrad": 1.0, "divergence_fwhm_mrad": math.sqrt(2 * math.log(2)), "divergence_1e2_mrad": 2.0}


def read_divergence(read: Read, is_top_hat: bool = False) -> float | None:
    """Read a beam's divergence from one of its three parameters.

    Returns the full angle [rad] between the points where the irradiance has fallen to e^-1/2 of its peak; None if no
    parameter is given.

    Raises UserError if the value is out of range.

    `read`: reader of the plugin parameters. `is_top_hat`: whether the irradiance is even up to the beam's edge instead
    of Gaussian.

    A Gaussian exp(-r^2/(2 sigma^2)) has fallen to e^-1/2, to a half and to e^-2 at diameters of 2 sigma, 2 sqrt(2 ln 2)
    sigma = 2.355 sigma and 4 sigma. A top-hat beam has its full irradiance up to its edge and none beyond: all three
    are its full angle.
    """
    given = read.given(*WIDTHS)
    return 1e-3 * read(given[0]) / (1.0 if is_top_hat else WIDTHS[given[0]]) if given else None
