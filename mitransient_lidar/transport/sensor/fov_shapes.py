"""Field-of-view shapes in tangent-plane angles [rad]: area [rad^2], membership and uniform sampling."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import finite, in_range, positive
from mitransient_lidar.physics.piecewise_linear import inside_polygon
from mitransient_lidar.transport.opaque import opaque

_BISECTION_STEPS = 25  #: Bisection steps that invert a distribution function to float32 accuracy.

_NOT_SIMPLE = "polygon: its edges must not cross each other, nor touch or overlap"


class FovShape(ABC):
    """A region in the tangent plane."""

    area: float

    @abstractmethod
    def contains(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Bool:
        """Return whether points lie inside."""

    @abstractmethod
    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers in the unit square to points that are uniform in the region."""

    @abstractmethod
    def bounds(self) -> tuple[float, float, float, float]:
        """Return (angle_x_min, angle_x_max, angle_y_min, angle_y_max)."""

    def comes_near(self, angle_x: NDArray[np.float64], angle_y: NDArray[np.float64], reach: float) -> NDArray[np.bool_]:
        """Return whether the region may have a point within `reach` [rad] of each point, with no false negatives."""
        angle_x_min, angle_x_max, angle_y_min, angle_y_max = self.bounds()
        return np.asarray(
            (angle_x >= angle_x_min - reach)
            & (angle_x <= angle_x_max + reach)
            & (angle_y >= angle_y_min - reach)
            & (angle_y <= angle_y_max + reach)
        )

    def centroid(self) -> tuple[float, float]:
        """Return the centre of gravity (angle_x, angle_y) in radians, within a hundredth of the extent."""
        angle_x_min, angle_x_max, angle_y_min, angle_y_max = self.bounds()
        fraction = (np.arange(200) + 0.5) / 200
        angle_x, angle_y = np.meshgrid(
            angle_x_min + fraction * (angle_x_max - angle_x_min), angle_y_min + fraction * (angle_y_max - angle_y_min)
        )
        inside = np.array(self.contains(mi.Float(angle_x.ravel()), mi.Float(angle_y.ravel())), dtype=bool)
        return float(angle_x.ravel()[inside].mean()), float(angle_y.ravel()[inside].mean())


@dataclass(frozen=True)
class Sector(FovShape):
    """Circle, ring or sector of a ring about a centre."""

    #: Radii [rad], 0 <= inner < outer.
    outer: float
    inner: float = 0.0
    #: Azimuth at which the sector begins, from +angle_x towards +angle_y, and its size [rad], up to 2 pi.
    start: float = 0.0
    extent: float = 2 * np.pi
    centre: tuple[float, float] = (0.0, 0.0)  #: (angle_x, angle_y) of the centre [rad].

    def __post_init__(self) -> None:
        _convert_to_float(self, "outer", "inner", "start", "extent")
        positive("outer radius of the field of view", self.outer)
        in_range("inner radius of the field of view", self.inner, 0.0, self.outer * (1 - 1e-9))
        positive("extent of the field-of-view sector", self.extent)
        in_range("extent of the field-of-view sector", self.extent, 0.0, 2 * np.pi + 1e-9)

    @property
    def area(self) -> float:  # type: ignore[override]
        """Area [rad^2]."""
        return 0.5 * self.extent * (self.outer**2 - self.inner**2)

    def contains(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Bool:
        """Return whether points lie inside."""
        x, y = angle_x - self.centre[0], angle_y - self.centre[1]
        r2 = x * x + y * y
        inside = (r2 <= opaque(self.outer**2)) & (r2 >= opaque(self.inner**2))
        if self.extent < 2 * np.pi:
            azimuth = dr.atan2(y, x) - self.start
            azimuth -= 2 * np.pi * dr.floor(azimuth * dr.inv_two_pi)
            inside &= azimuth < self.extent
        return inside

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to uniform points."""
        r = dr.sqrt(dr.lerp(opaque(self.inner**2), opaque(self.outer**2), u.x))
        sin, cos = dr.sincos(self.start + self.extent * u.y)
        return dr.fma(r, cos, self.centre[0]), dr.fma(r, sin, self.centre[1])

    def bounds(self) -> tuple[float, float, float, float]:
        """Return the circle's bounds."""
        (x, y), r = self.centre, self.outer
        return x - r, x + r, y - r, y + r

    def comes_near(self, angle_x: NDArray[np.float64], angle_y: NDArray[np.float64], reach: float) -> NDArray[np.bool_]:
        """Return whether the region may have a point within `reach` [rad] of each point, with no false negatives."""
        x, y = angle_x - self.centre[0], angle_y - self.centre[1]
        r = np.hypot(x, y)
        near = (r <= self.outer + reach) & (r >= self.inner - reach)
        # Half angle of a point's surroundings about the centre, pi where they include it.
        width = np.where(r > reach, np.arcsin(np.minimum(1, reach / np.maximum(r, reach))), np.pi)
        off_middle = np.arctan2(y, x) - self.start - 0.5 * self.extent
        off_middle = np.abs(off_middle - 2 * np.pi * np.round(off_middle / (2 * np.pi)))
        return np.asarray(near & (off_middle <= 0.5 * self.extent + width))


@dataclass(frozen=True)
class Rectangle(FovShape):
    """Rectangle with sides along angle_x and angle_y [rad]."""

    angle_x_min: float
    angle_x_max: float
    angle_y_min: float
    angle_y_max: float

    def __post_init__(self) -> None:
        _convert_to_float(self, "angle_x_min", "angle_x_max", "angle_y_min", "angle_y_max")
        positive("extent of the field of view along angle_x", self.angle_x_max - self.angle_x_min)
        positive("extent of the field of view along angle_y", self.angle_y_max - self.angle_y_min)

    @property
    def area(self) -> float:  # type: ignore[override]
        """Area [rad^2]."""
        return (self.angle_x_max - self.angle_x_min) * (self.angle_y_max - self.angle_y_min)

    def contains(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Bool:
        """Return whether points lie inside; the lower edges belong to the rectangle, the upper ones do not."""
        x_min, x_max, y_min, y_max = map(opaque, self.bounds())
        return (angle_x >= x_min) & (angle_x < x_max) & (angle_y >= y_min) & (angle_y < y_max)

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to uniform points."""
        x_min, x_max, y_min, y_max = map(opaque, self.bounds())
        return dr.lerp(x_min, x_max, u.x), dr.lerp(y_min, y_max, u.y)

    def bounds(self) -> tuple[float, float, float, float]:
        """Return (angle_x_min, angle_x_max, angle_y_min, angle_y_max)."""
        return self.angle_x_min, self.angle_x_max, self.angle_y_min, self.angle_y_max


@dataclass(frozen=True)
class Strip(FovShape):
    """Part of a circle about the axis between two constant angle_x lines [rad], as in the published 1x4 receiver."""

    radius: float
    angle_x_min: float
    angle_x_max: float

    def __post_init__(self) -> None:
        _convert_to_float(self, "radius", "angle_x_min", "angle_x_max")
        positive("radius of the field of view", self.radius)
        low, high = self._limits()
        if not high > low:
            raise UserError(
                f"strip from angle_x = {self.angle_x_min} to {self.angle_x_max} rad must cut the circle of "
                f"radius {self.radius} rad"
            )

    def _limits(self) -> tuple[float, float]:
        return max(self.angle_x_min, -self.radius), min(self.angle_x_max, self.radius)

    @staticmethod
    def _half_disc(x: float) -> float:
        """Area of the unit disc's part with abscissa below x, minus half the disc."""
        return float(x * np.sqrt(max(0.0, 1 - x * x)) + np.arcsin(x))

    @property
    def area(self) -> float:  # type: ignore[override]
        """Area [rad^2]."""
        low, high = self._limits()
        return self.radius**2 * (self._half_disc(high / self.radius) - self._half_disc(low / self.radius))

    def contains(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Bool:
        """Return whether points lie inside."""
        return (
            (angle_x * angle_x + angle_y * angle_y <= self.radius**2)
            & (angle_x >= self.angle_x_min)
            & (angle_x < self.angle_x_max)
        )

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to uniform points: angle_x by bisection of the area, then angle_y on its chord."""
        low, high = (limit / self.radius for limit in self._limits())
        target = dr.lerp(self._half_disc(low), self._half_disc(high), u.x)
        left, right = mi.Float(low), mi.Float(high)
        for _ in range(_BISECTION_STEPS):
            middle = 0.5 * (left + right)
            above = middle * dr.safe_sqrt(1 - middle * middle) + dr.safe_asin(middle) > target
            left, right = dr.select(above, left, middle), dr.select(above, middle, right)
        x = 0.5 * (left + right)
        return x * self.radius, (2 * u.y - 1) * dr.safe_sqrt(1 - x * x) * self.radius

    def bounds(self) -> tuple[float, float, float, float]:
        """Return (angle_x_min, angle_x_max, angle_y_min, angle_y_max)."""
        low, high = self._limits()
        return low, high, -self.radius, self.radius

    def comes_near(self, angle_x: NDArray[np.float64], angle_y: NDArray[np.float64], reach: float) -> NDArray[np.bool_]:
        """Return whether the region may have a point within `reach` [rad] of each point, with no false negatives."""
        return super().comes_near(angle_x, angle_y, reach) & (np.hypot(angle_x, angle_y) <= self.radius + reach)


class Polygon(FovShape):
    """Simple polygon, convex or not.

    `vertices`: corners (angle_x, angle_y) [rad] in order, shape (n, 2), at least three, not all on one line. The first
    may be repeated at the end.
    """

    def __init__(self, vertices: Sequence[tuple[float, float]] | NDArray[np.float64]) -> None:
        points = np.asarray(vertices, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3:
            raise UserError(
                f"polygon: needs at least three corners (angle_x, angle_y), got an array of shape {points.shape}"
            )
        for value in points.ravel():
            finite("polygon corner", float(value))
        if len(points) > 3 and np.array_equal(points[0], points[-1]):
            points = points[:-1]
        x, y = points.T
        signed = 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
        if np.linalg.matrix_rank(points - points[0], tol=1e-9) < 2:
            raise UserError("polygon: its corners lie on one line, the field of view must have an area")
        if _meets_itself(points):
            raise UserError(_NOT_SIMPLE)
        self.vertices = points if signed > 0 else points[::-1].copy()
        self.area = abs(signed)
        triangles = _triangulate(self.vertices)
        self._corners = self.vertices[np.array(triangles)]
        areas = 0.5 * np.abs(_cross(*self._corners.swapaxes(0, 1)))
        self._cdf = np.cumsum(areas) / areas.sum()

    def contains(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Bool:
        """Return whether points lie inside."""
        return mi.Bool(inside_polygon(self.vertices, angle_x, angle_y))

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to uniform points: pick a triangle by its area, then a point in it."""
        cdf = mi.Float(self._cdf)
        index = dr.minimum(
            dr.binary_search(0, len(self._cdf), lambda i: dr.gather(mi.Float, cdf, i) <= u.x), len(self._cdf) - 1
        )
        low = dr.select(index > 0, dr.gather(mi.Float, cdf, index - 1, index > 0), 0)
        fraction = (u.x - low) / (dr.gather(mi.Float, cdf, index) - low)
        root = dr.sqrt(dr.clip(fraction, 0, 1))
        weights = (1 - root, root * (1 - u.y), root * u.y)
        table = mi.Float(self._corners.ravel())
        return tuple(
            sum(w * dr.gather(mi.Float, table, index * 6 + 2 * corner + axis) for corner, w in enumerate(weights))
            for axis in (0, 1)
        )

    def bounds(self) -> tuple[float, float, float, float]:
        """Return (angle_x_min, angle_x_max, angle_y_min, angle_y_max)."""
        (x0, y0), (x1, y1) = self.vertices.min(axis=0), self.vertices.max(axis=0)
        return float(x0), float(x1), float(y0), float(y1)

    def comes_near(self, angle_x: NDArray[np.float64], angle_y: NDArray[np.float64], reach: float) -> NDArray[np.bool_]:
        """Return whether the region may have a point within `reach` [rad] of each point, with no false negatives."""
        near, inside = np.zeros(angle_x.shape, dtype=bool), np.zeros(angle_x.shape, dtype=bool)
        for (x0, y0), (x1, y1) in zip(self.vertices, np.roll(self.vertices, -1, axis=0), strict=True):
            x, y, along_x, along_y = angle_x - x0, angle_y - y0, x1 - x0, y1 - y0
            share = np.clip((x * along_x + y * along_y) / (along_x**2 + along_y**2), 0, 1)
            near |= np.hypot(x - share * along_x, y - share * along_y) <= reach
            if y0 != y1:
                inside ^= ((angle_y < y0) != (angle_y < y1)) & (angle_x < x0 + y * (along_x / along_y))
        return near | inside


def _convert_to_float(shape: FovShape, *names: str) -> None:
    """Convert attributes to Python numbers: NumPy scalars would turn Dr.Jit arrays into NumPy ones."""
    for name in names:
        object.__setattr__(shape, name, float(getattr(shape, name)))


def _cross(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return twice the area of triangles, negative if clockwise, 0 where their corners lie on a line to rounding."""
    ab, ac = b - a, c - a
    area = ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
    sides = np.linalg.norm(ab, axis=-1) * np.linalg.norm(ac, axis=-1)
    return np.asarray(np.where(np.abs(area) > 1e-12 * sides, area, 0))


def _meets_itself(points: np.ndarray) -> bool:
    """Return whether a polygon's edges cross, touch or overlap, apart from the corners that neighbours share."""
    start, end, after = points, np.roll(points, -1, axis=0), np.roll(points, -2, axis=0)
    runs_back = (_cross(start, end, after) == 0) & (np.sum((end - start) * (after - end), axis=1) <= 0)
    if runs_back.any():
        return True
    for i, (a, b) in enumerate(zip(start, end, strict=True)):
        c, d = (corners[i + 2 : len(points) - (i == 0)] for corners in (start, end))
        # The second test is true of all edges on one line; the first one excludes those that do not touch.
        apart = (np.maximum(a, b) < np.minimum(c, d)) | (np.maximum(c, d) < np.minimum(a, b))
        meets = (_cross(a, b, c) * _cross(a, b, d) <= 0) & (_cross(c, d, a) * _cross(c, d, b) <= 0)
        if (meets & ~apart.any(axis=1)).any():
            return True
    return False


def _triangulate(points: np.ndarray) -> list[tuple[int, int, int]]:
    """Triangulate a simple polygon of counter-clockwise corners by ear clipping."""
    rest, triangles = list(range(len(points))), []
    while len(rest) > 3:
        for k in range(len(rest)):
            i, j, m = rest[k - 1], rest[k], rest[(k + 1) % len(rest)]
            a, b, c = points[[i, j, m]]
            others = (points[o] for o in rest if o not in (i, j, m))
            if _cross(a, b, c) >= 0 and not any(
                _cross(a, b, p) > 0 and _cross(b, c, p) > 0 and _cross(c, a, p) > 0 for p in others
            ):
                triangles.append((i, j, m))
                del rest[k]
                break
        else:
            raise UserError(_NOT_SIMPLE)
    return [*triangles, (rest[0], rest[1], rest[2])]
