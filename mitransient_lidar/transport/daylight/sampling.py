"""Uniform sampling of the receiver's field of view, and solid angles of its pixels."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.transport.daylight.scene import DaylightScene
from mitransient_lidar.transport.opaque import opaque_point
from mitransient_lidar.transport.rng import pass_streams, stratified_point
from mitransient_lidar.transport.sensor.pixels import PixelArray, parse_layout
from mitransient_lidar.transport.sensor.receiver import Receiver, SensorSample, solid_angle_factor

#: Points along each axis of the field of view, at least, that measure the pixels' solid angles.
_LATTICE = 4096

#: Rays that look for what lies outside the surface mesh.
_RAYS = 2**14


class FovSampler:
    """Samples the receiver's field of view uniformly.

    Samples are stratified. Where the optics blur, the place on the detector is drawn first, then the direction from
    which it receives light.

    Parameters
    ----------
    receiver
        Pose, aperture and pixels.
    """

    def __init__(self, receiver: Receiver) -> None:
        self.receiver = receiver

    def sample(self, index: mi.UInt32, count: int, rng: mi.PCG32) -> SensorSample:
        """Sample one direction for each path; its weight is the solid angle that it represents [sr].

        Parameters
        ----------
        index
            Number of the path, 0 to count - 1.
        count
            Number of paths.
        rng
            Random numbers of the paths.
        """
        pixels = self.receiver.pixels
        px, py = pixels.sample(stratified_point(index, count, rng))
        angle_x, angle_y = px, py
        if self.receiver.blur is not None:
            dx, dy = self.receiver.blur.sample(mi.Point2f(rng.next_float32(), rng.next_float32()))
            angle_x, angle_y = px - dx, py - dy
        pixel, here = pixels.pixel_at(px, py, rng.next_float32())
        weight = pixels.area / count * solid_angle_factor(px, py)
        return SensorSample(self.receiver.pose.direction(angle_x, angle_y), pixel, dr.select(here > 0, weight, 0))


def pixel_solid_angles(pixels: PixelArray) -> NDArray[np.float64]:
    """Return the solid angle of each pixel [sr], shape (pixels,), counted on a fine lattice of the field of view.

    Whole cells of a layout are exact, other pixels within about a thousandth of the width of the lattice's cells over
    their own.
    """
    # A whole number of points in every cell of a layout.
    cells = parse_layout(pixels.layout) if pixels.layout[0].isdigit() else (1, 1)
    rows, columns = (cell * -(-_LATTICE // cell) for cell in cells)
    index = dr.arange(mi.UInt32, rows * columns)
    full = pixels.field_of_view
    angle_x = full * (0.5 - (mi.Float(index // columns) + 0.5) / rows)
    angle_y = full * ((mi.Float(index % columns) + 0.5) / columns - 0.5)
    u = mi.Float(index * mi.UInt32(2654435769) >> 8) * 2**-24
    pixel, here = pixels.pixel_at(angle_x, angle_y, u)
    found = dr.zeros(mi.Float64, pixels.count)
    # Of pixels that overlap one is counted.
    dr.scatter_add(found, mi.Float64(here * solid_angle_factor(angle_x, angle_y)), pixel, here > 0)
    return np.array(found) * full**2 / (rows * columns)


def share_outside_surface(scene: DaylightScene, sampler: FovSampler) -> float:
    """Return the share of the field of view that looks down outside the surface mesh."""
    if not scene.surfaces:
        return 0.0
    seen = sampler.sample(dr.arange(mi.UInt32, _RAYS), _RAYS, pass_streams(0, 0, _RAYS))
    ray = mi.Ray3f(opaque_point(scene.receiver.pose.origin), seen.direction)
    si = scene.ray_intersect(ray, seen.weight > 0)
    outside = ~si.is_valid() & (seen.direction.z < 0)
    outside |= si.is_valid() & scene.outside_surface(si.p.z, mi.Bool(False))
    weight = np.array(seen.weight, dtype=np.float64)
    return float(weight[np.array(outside)].sum() / max(weight.sum(), 1e-300))
