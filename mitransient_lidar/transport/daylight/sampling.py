"""Uniform sampling of the receiver's field of view, and solid angles of its pixels."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.transport.daylight.scene import DaylightScene
from mitransient_lidar.transport.rng import pass_streams, stratified_point
from mitransient_lidar.transport.sensor.pixels import PixelArray, parse_layout
from mitransient_lidar.transport.sensor.receiver import Receiver, SensorSample, solid_angle_factor

#: Least number of points along each field-of-view axis for the pixels' solid angles.
_LATTICE = 4096

#: Number of rays for the share of the field of view outside the surface mesh.
_RAYS = 2**14


class FovSampler:
    """Samples the receiver's field of view uniformly.

    Samples are stratified. Where the optics blur, the place on the detector is drawn first, then the direction from
    which it receives light.
    """

    def __init__(self, receiver: Receiver) -> None:
        self.receiver = receiver

    def sample(self, index: mi.UInt32, count: int, rng: mi.PCG32) -> SensorSample:
        """Sample directions for paths number `index` of `count`; weights are the solid angles they represent [sr]."""
        pixels = self.receiver.pixels
        px, py = pixels.sample(stratified_point(index, count, rng))
        dx, dy = self.receiver.displacement(rng)
        angle_x, angle_y = px - dx, py - dy
        pixel, here = pixels.pixel_at(px, py, rng.next_float32())
        weight = pixels.area / count * solid_angle_factor(px, py)
        return SensorSample.at(self.receiver.pose, angle_x, angle_y, pixel, dr.select(here > 0, weight, 0))


def pixel_solid_angles(pixels: PixelArray) -> NDArray[np.float64]:
    """Return each pixel's solid angle [sr], shape (pixels,), counted on a fine lattice over the field of view.

    Layout cells that the field of view does not cut are exact.
    """
    # An integer number of points in every layout cell.
    cells = parse_layout(pixels.layout) if pixels.layout[0].isdigit() else (1, 1)
    rows, columns = (cell * -(-_LATTICE // cell) for cell in cells)
    index = dr.arange(mi.UInt32, rows * columns)
    full = pixels.field_of_view
    angle_x = full * (0.5 - (mi.Float(index // columns) + 0.5) / rows)
    angle_y = full * ((mi.Float(index % columns) + 0.5) / columns - 0.5)
    u = mi.Float(index * mi.UInt32(2654435769) >> 8) * 2**-24
    pixel, here = pixels.pixel_at(angle_x, angle_y, u)
    found = dr.zeros(mi.Float64, pixels.count)
    # Where pixels overlap, a random one counts.
    dr.scatter_add(found, mi.Float64(here * solid_angle_factor(angle_x, angle_y)), pixel, here > 0)
    return np.array(found) * full**2 / (rows * columns)


def share_outside_surface(scene: DaylightScene, sampler: FovSampler) -> float:
    """Return the share of the field of view that points down outside the surface mesh."""
    if not scene.surfaces:
        return 0.0
    seen = sampler.sample(dr.arange(mi.UInt32, _RAYS), _RAYS, pass_streams(0, 0, _RAYS))
    points, _ = scene.first_points(scene.receiver.pose, seen.angles, seen.direction)
    ray = mi.Ray3f(points, seen.direction)
    si = scene.ray_intersect(ray, seen.weight > 0)
    outside = ~si.is_valid() & (seen.direction.z < 0)
    outside |= si.is_valid() & scene.outside_surface(si.p.z, mi.Bool(False))
    weight = np.array(seen.weight, dtype=np.float64)
    return float(weight[np.array(outside)].sum() / max(weight.sum(), 1e-300))
