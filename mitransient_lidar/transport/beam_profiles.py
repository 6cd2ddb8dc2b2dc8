"""Shapes of a laser beam in tangent-plane angles: density of its energy, sampling by it, widths; outlines of any shape.

Coordinates (gx, gy) are radians about the optical axis, +gx away from nadir.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import contourpy
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.optics.checks import positive
from mitransient_lidar.transport.images import ImageSampler

if TYPE_CHECKING:
    from mitransient_lidar.transport.fields import Field
    from mitransient_lidar.transport.pixels import PixelArray

#: Shares of the peak irradiance at which a beam's outlines are drawn.
OUTLINE_LEVELS = (float(np.exp(-0.5)), float(np.exp(-2)))

#: Longest side of an image: finer ones would lose their cells in the digits of 32-bit random numbers.
_LONGEST_SIDE = 2048

#: Outlines of an image that enclose less than this share of the largest are noise.
_SMALLEST_ISLAND = 0.02

#: Points along each side of the raster on which a region is traced, steps that then bring its outline to 1/1000 of a
#: cell, and how far lines may pass by the points that they leave out, in cells.
_RASTER = 128
_BISECTIONS = 10
_CELL_SLACK = 0.05

#: Points along each side of the raster that finds the pixels.
_PIXEL_RASTER = 400

Outline = NDArray[np.float64]

#: Whether points (gx, gy) lie in a region.
Region = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.bool_]]


class BeamProfile(ABC):
    """Energy of a beam over the tangent plane, normalised to 1.

    Attributes
    ----------
    spreads
        Root-mean-square angles along the beam's two principal axes, about its centre of gravity [rad].
    turn
        Azimuth of the first of these axes, from +gx towards +gy [rad].
    divergence
        Full angles along these axes as the transmitter's manual defines them [rad].
    """

    spreads: tuple[float, float]
    turn: float
    divergence: tuple[float, float]

    @abstractmethod
    def density(self, gx: mi.Float, gy: mi.Float) -> mi.Float:
        """Return the share of the energy per tangent-plane area [1/rad^2]."""

    @abstractmethod
    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers in the unit square to points distributed as the density."""

    @abstractmethod
    def outlines(self) -> list[tuple[float, list[Outline]]]:
        """Return lines of equal irradiance: its share of the peak, and closed lines (gx, gy) [rad], shape (n, 2)."""


@dataclass(frozen=True)
class _Ellipse(BeamProfile):
    """Beam that is circular once its second axis is stretched.

    Parameters
    ----------
    along, across
        Half angles [rad] along the first and the second axis, positive.
    turn
        Azimuth of the first axis, from +gx towards +gy [rad].
    """

    along: float
    across: float
    turn: float = 0.0

    @property
    def divergence(self) -> tuple[float, float]:  # type: ignore[override]
        """Full angles along and across [rad]."""
        return 2 * self.along, 2 * self.across

    @property
    def _ratio(self) -> float:
        return self.across / self.along

    def _to_circle(self, gx: mi.Float, gy: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Return the point of the circular beam of half angle `along` that stands for (gx, gy)."""
        if self.turn != 0:
            sin, cos = float(np.sin(self.turn)), float(np.cos(self.turn))
            gx, gy = cos * gx + sin * gy, cos * gy - sin * gx
        return gx, gy / self._ratio

    def _from_circle(self, x: mi.Float, y: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Invert `_to_circle`."""
        y = y * self._ratio
        if self.turn == 0:
            return x, y
        sin, cos = float(np.sin(self.turn)), float(np.cos(self.turn))
        return cos * x - sin * y, sin * x + cos * y

    def _rim(self, scale: float) -> Outline:
        azimuth = np.linspace(0, 2 * np.pi, 97)
        gx, gy = self._from_circle(scale * self.along * np.cos(azimuth), scale * self.along * np.sin(azimuth))
        return np.stack([gx, gy], axis=-1)


class GaussianBeam(_Ellipse):
    """Gaussian beam: the half angles are standard deviations."""

    @property
    def spreads(self) -> tuple[float, float]:  # type: ignore[override]
        """Root-mean-square angles [rad]: the standard deviations."""
        return self.along, self.across

    def density(self, gx: mi.Float, gy: mi.Float) -> mi.Float:
        """Return the share of the energy per tangent-plane area [1/rad^2]."""
        x, y = self._to_circle(gx, gy)
        return dr.exp(-(x * x + y * y) / (2 * self.along**2)) / (2 * np.pi * self.along**2 * self._ratio)

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to points by Box and Muller's transform."""
        # 1 - u lies in (0, 1], so that the logarithm is finite.
        radius = self.along * dr.sqrt(-2 * dr.log(1 - u.x))
        sin, cos = dr.sincos(dr.two_pi * u.y)
        return self._from_circle(radius * cos, radius * sin)

    def outlines(self) -> list[tuple[float, list[Outline]]]:
        """Return the ellipses at one and two standard deviations."""
        return [(level, [self._rim(float(np.sqrt(-2 * np.log(level))))]) for level in OUTLINE_LEVELS]


class TopHatBeam(_Ellipse):
    """Beam of even irradiance within an ellipse: the half angles are its semi-axes."""

    @property
    def spreads(self) -> tuple[float, float]:  # type: ignore[override]
        """Root-mean-square angles [rad]: half the semi-axes."""
        return self.along / 2, self.across / 2

    def density(self, gx: mi.Float, gy: mi.Float) -> mi.Float:
        """Return the share of the energy per tangent-plane area [1/rad^2]."""
        x, y = self._to_circle(gx, gy)
        inside = x * x + y * y <= self.along**2
        return dr.select(inside, mi.Float(1 / (np.pi * self.along**2 * self._ratio)), 0)

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to uniform points of the ellipse."""
        radius = dr.sqrt(self.along**2 * u.x)
        sin, cos = dr.sincos(dr.two_pi * u.y)
        return self._from_circle(radius * cos, radius * sin)

    def outlines(self) -> list[tuple[float, list[Outline]]]:
        """Return the rim."""
        return [(1.0, [self._rim(1.0)])]


class ImageBeam(BeamProfile):
    """Measured beam: even irradiance within each cell of an image that is centred on the optical axis.

    A point is sampled row first, then column, each by its cumulative distribution: exactly by the density.

    Parameters
    ----------
    irradiance
        Image in any unit, shape (rows, columns): row 0 is the far edge (+gx), column 0 the -gy edge. Sides of 1 to 2048
        cells; not negative, not all 0.
    side
        Full angle [rad] from the first column's outer edge to the last one's, positive. Cells are squares.

    Raises
    ------
    ValueError
        When the image is of another kind, or the side out of range.
    """

    def __init__(self, irradiance: NDArray[np.float64], side: float) -> None:
        image = np.asarray(irradiance, dtype=np.float64)
        if image.ndim != 2 or 0 in image.shape or max(image.shape) > _LONGEST_SIDE:
            raise ValueError(
                f"beam image of shape {image.shape} must have two dimensions of 1 to {_LONGEST_SIDE} cells each"
            )
        if not np.isfinite(image).all():
            raise ValueError(f"beam image holds {image[~np.isfinite(image)][0]} but every irradiance must be finite")
        if image.min() < 0:
            raise ValueError(f"beam image holds {image.min():g} but no irradiance may be negative")
        if image.max() == 0:
            raise ValueError("beam image holds zeros only but must have light in at least one cell")
        # Scaled first: the sum of irradiances in units of their own may overflow.
        self._share = image / image.max()
        self._share /= self._share.sum()
        self._rows, self._columns = image.shape
        self._cell = positive("side of the beam image", side) / self._columns
        self._sampler = ImageSampler(self._share)
        self._density = mi.Float((self._share / self._cell**2).ravel())
        self._measure()

    def _measure(self) -> None:
        """Set widths and azimuth from the second moments about the centre of gravity."""
        far = self._cell * (0.5 * self._rows - np.arange(self._rows) - 0.5)
        left = self._cell * (np.arange(self._columns) + 0.5 - 0.5 * self._columns)
        rows, columns = self._share.sum(axis=1), self._share.sum(axis=0)
        dx, dy = far - rows @ far, left - columns @ left
        # Light is spread evenly within a cell.
        within = self._cell**2 / 12
        mixed = float(dx @ self._share @ dy)
        moments = np.array([[rows @ dx**2 + within, mixed], [mixed, columns @ dy**2 + within]])
        variances, axes = np.linalg.eigh(moments)
        self.spreads = float(np.sqrt(variances[1])), float(np.sqrt(variances[0]))
        self.turn = float(np.arctan2(axes[1, 1], axes[0, 1]))
        self.divergence = 2 * self.spreads[0], 2 * self.spreads[1]

    def density(self, gx: mi.Float, gy: mi.Float) -> mi.Float:
        """Return the share of the energy per tangent-plane area [1/rad^2]."""
        row = 0.5 * self._rows - gx / self._cell
        column = gy / self._cell + 0.5 * self._columns
        inside = (row >= 0) & (row < self._rows) & (column >= 0) & (column < self._columns)
        index = mi.UInt32(dr.select(inside, row, 0)) * self._columns + mi.UInt32(dr.select(inside, column, 0))
        return dr.gather(mi.Float, self._density, index, inside)

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to points distributed as the density."""
        row, column = self._sampler.sample(u)
        return self._cell * (0.5 * self._rows - row), self._cell * (column - 0.5 * self._columns)

    def outlines(self) -> list[tuple[float, list[Outline]]]:
        """Return the lines of equal irradiance, without islands of noise."""
        # A dark frame closes every line.
        padded = np.pad(self._share / self._share.max(), 1)
        far = self._cell * (0.5 * self._rows + 0.5 - np.arange(self._rows + 2))
        left = self._cell * (np.arange(self._columns + 2) - 0.5 - 0.5 * self._columns)
        lines = contourpy.contour_generator(left, far, padded)
        found = []
        for level in OUTLINE_LEVELS:
            loops = [np.asarray(line)[:, ::-1] for line in lines.lines(level)]
            areas = [abs(enclosed_area(loop)) for loop in loops]
            large = _SMALLEST_ISLAND * max(areas)
            found.append((level, [loop for loop, area in zip(loops, areas, strict=True) if area >= large]))
        return found


def enclosed_area(loop: Outline) -> float:
    """Return the area that a closed line encloses, shape (n, 2), positive when it turns left."""
    x, y = loop.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def pixel_outlines(pixels: PixelArray) -> list[list[Outline]]:
    """Return the closed lines (gx, gy) [rad] about each pixel, none for pixels too small to be found."""
    fields = getattr(pixels, "fields", None)
    if fields is not None:
        # Each by itself: pixels may overlap.
        return [traced_outlines(_held_by(field), field.bounds()) for field in fields]

    def pixel_at(gx: NDArray[np.float64], gy: NDArray[np.float64]) -> NDArray[np.int64]:
        index, held = pixels.pixel_at(mi.Float(gx), mi.Float(gy), mi.Float(0.5))
        return np.where(np.array(held) > 0, np.array(index).astype(np.int64), -1)

    ticks = 0.5 * pixels.field_of_view * np.linspace(-1, 1, _PIXEL_RASTER)
    gx, gy = (g.ravel() for g in np.meshgrid(ticks, ticks, indexing="ij"))
    seen, step = pixel_at(gx, gy), ticks[1] - ticks[0]
    outlines: list[list[Outline]] = []
    for index in range(pixels.count):
        x, y = gx[seen == index], gy[seen == index]
        bounds = (x.min() - step, x.max() + step, y.min() - step, y.max() + step) if x.size else None
        outlines.append(traced_outlines(_equal_to(pixel_at, index), bounds) if bounds else [])
    return outlines


def _held_by(field: Field) -> Region:
    return lambda gx, gy: np.array(field.contains(mi.Float(gx), mi.Float(gy)), dtype=bool)


def _equal_to(pixel_at: Callable[..., NDArray[np.int64]], index: int) -> Region:
    return lambda gx, gy: pixel_at(gx, gy) == index


def traced_outlines(inside: Region, bounds: tuple[float, float, float, float]) -> list[Outline]:
    """Return the closed lines about a region within some bounds: contours of a raster, moved onto the region's edge."""
    for _ in range(2):
        # Rows outside the region close its lines. The second raster fits the region closely.
        steps = [(bounds[i + 1] - bounds[i]) / (_RASTER - 3) for i in (0, 2)]
        axes = [np.linspace(bounds[2 * i] - steps[i], bounds[2 * i + 1] + steps[i], _RASTER) for i in (0, 1)]
        gx, gy = np.meshgrid(*axes, indexing="ij")
        mask = inside(gx.ravel(), gy.ravel()).reshape(gx.shape)
        if not mask.any():
            return []
        (x, y), (dx, dy) = (g[mask] for g in (gx, gy)), steps
        bounds = float(x.min() - dx), float(x.max() + dx), float(y.min() - dy), float(y.max() + dy)

    def at(nodes: Outline) -> Outline:
        return np.stack([np.interp(nodes[:, i], np.arange(_RASTER), axes[i]) for i in (0, 1)], axis=-1)

    traced = []
    for line in map(np.asarray, contourpy.contour_generator(z=mask.T.astype(np.float64)).lines(0.5)):
        # Every point lies half-way between two neighbouring nodes, of which one is inside.
        first, last = np.floor(line), np.ceil(line)
        swap = ~mask[tuple(first.astype(int).T)]
        first[swap], last[swap] = last[swap], first[swap].copy()
        for _ in range(_BISECTIONS):
            middle = 0.5 * (first + last)
            held = inside(*at(middle).T)
            first[held], last[~held] = middle[held], middle[~held]
        traced.append(at(simplified(0.5 * (first + last), _CELL_SLACK)))
    return traced


def simplified(line: Outline, slack: float) -> Outline:
    """Leave out points of a closed line that lie within `slack` of it without them (Douglas and Peucker 1973)."""
    keep = np.zeros(len(line), dtype=bool)
    # A closed line is cut at its first point and at the one farthest from it.
    far = int(np.argmax(np.hypot(*(line - line[0]).T)))
    keep[[0, far, -1]] = True
    stretches = [(0, far), (far, len(line) - 1)]
    while stretches:
        first, last = stretches.pop()
        if last - first < 2:
            continue
        chord, offset = line[last] - line[first], line[first + 1 : last] - line[first]
        length = float(np.hypot(*chord))
        gap = np.abs(chord[0] * offset[:, 1] - chord[1] * offset[:, 0]) / length if length else np.hypot(*offset.T)
        worst = int(np.argmax(gap))
        if gap[worst] > slack:
            keep[first + 1 + worst] = True
            stretches += [(first, first + 1 + worst), (first + 1 + worst, last)]
    return line[keep]
