"""Outlines of pixels and other tangent-plane regions."""

from __future__ import annotations

from collections.abc import Callable

import contourpy
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.transport.sensor.fov_shapes import FovShape
from mitransient_lidar.transport.sensor.pixels import PixelArray, ShapedPixels

#: Points along each side of the raster on which a region is traced, bisections that find its outline to 1/1000 of a
#: cell, and largest distance from simplified lines to omitted points, in cells.
_RASTER, _BISECTIONS, _CELL_TOLERANCE = 128, 10, 0.05

_PIXEL_RASTER = 400  #: Points along each side of the raster that finds the pixels.

#: Closed line, shape (n, 2).
Outline = NDArray[np.float64]

#: Whether points (angle_x, angle_y) lie in a region.
Region = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.bool_]]


def enclosed_area(loop: Outline) -> float:
    """Return the area that a closed line encloses, shape (n, 2), positive if counter-clockwise."""
    x, y = loop.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def pixel_outlines(pixels: PixelArray) -> list[list[Outline]]:
    """Return the outlines of each pixel, closed lines (angle_x, angle_y) [rad]; none for very small pixels."""
    if isinstance(pixels, ShapedPixels):
        # Each by itself: pixels may overlap.
        return [traced_outlines(_held_by(field), field.bounds()) for field in pixels.fields]

    def pixel_at(angle_x: NDArray[np.float64], angle_y: NDArray[np.float64]) -> NDArray[np.int64]:
        index, held = pixels.pixel_at(mi.Float(angle_x), mi.Float(angle_y), mi.Float(0.5))
        return np.where(np.array(held) > 0, np.array(index).astype(np.int64), -1)

    ticks = 0.5 * pixels.field_of_view * np.linspace(-1, 1, _PIXEL_RASTER)
    angle_x, angle_y = (g.ravel() for g in np.meshgrid(ticks, ticks, indexing="ij"))
    seen, step = pixel_at(angle_x, angle_y), ticks[1] - ticks[0]
    outlines: list[list[Outline]] = []
    for index in range(pixels.count):
        x, y = angle_x[seen == index], angle_y[seen == index]
        bounds = (x.min() - step, x.max() + step, y.min() - step, y.max() + step) if x.size else None
        outlines.append(traced_outlines(_equal_to(pixel_at, index), bounds) if bounds else [])
    return outlines


def _held_by(field: FovShape) -> Region:
    return lambda angle_x, angle_y: np.array(field.contains(mi.Float(angle_x), mi.Float(angle_y)), dtype=bool)


def _equal_to(pixel_at: Callable[..., NDArray[np.int64]], index: int) -> Region:
    return lambda angle_x, angle_y: pixel_at(angle_x, angle_y) == index


def traced_outlines(inside: Region, bounds: tuple[float, float, float, float]) -> list[Outline]:
    """Return a region's outlines within some bounds: raster contours, moved onto the region's edge."""
    for _ in range(2):
        # Rows outside the region close its outlines. The second raster fits the region closely.
        steps = [(bounds[i + 1] - bounds[i]) / (_RASTER - 3) for i in (0, 2)]
        axes = [np.linspace(bounds[2 * i] - steps[i], bounds[2 * i + 1] + steps[i], _RASTER) for i in (0, 1)]
        angle_x, angle_y = np.meshgrid(*axes, indexing="ij")
        mask = inside(angle_x.ravel(), angle_y.ravel()).reshape(angle_x.shape)
        if not mask.any():
            return []
        (x, y), (dx, dy) = (g[mask] for g in (angle_x, angle_y)), steps
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
        traced.append(at(simplified(0.5 * (first + last), _CELL_TOLERANCE)))
    return traced


def simplified(line: Outline, tolerance: float) -> Outline:
    """Leave out points on a closed line that lie within `tolerance` of it without them (Douglas and Peucker 1973)."""
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
        if gap[worst] > tolerance:
            keep[first + 1 + worst] = True
            stretches += [(first, first + 1 + worst), (first + 1 + worst, last)]
    return line[keep]
