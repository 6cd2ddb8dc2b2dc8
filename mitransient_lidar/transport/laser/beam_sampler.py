"""Sampling of the laser's beam within the receiver's field of view."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.rng import interleaved_point, stratified_point, unit_points
from mitransient_lidar.transport.sensor.fov_shapes import Sector
from mitransient_lidar.transport.sensor.receiver import Receiver

#: The field of view is sampled separately when it contains less than this share of the beam.
_SMALLEST_SHARE = 0.5

#: Diameter of the sampled region over the field of view, as light around it scatters into it.
_ROOM = 1.5


class BeamSampler:
    """Samples the beam by its energy; half of the samples over the field of view when that is much narrower.

    Both halves are weighted by the balance heuristic. Samples are stratified.
    """

    def __init__(self, transmitter: mi.Emitter, receiver: Receiver) -> None:
        self.transmitter = transmitter
        spot = receiver.pose.ground_point()
        self.centre = [opaque(angle) for angle in transmitter.pose.angles_of(spot - transmitter.pose.origin)]
        ranges = [float(np.linalg.norm(spot - pose.origin)) for pose in (receiver.pose, transmitter.pose)]
        self.view = Sector(_ROOM * 0.5 * receiver.pixels.field_of_view * ranges[0] / ranges[1])
        angle_x, angle_y = transmitter.sample_tangent(unit_points(4096))
        share = dr.mean(dr.select(self._inside(angle_x, angle_y), mi.Float(1), 0))[0]
        self.use_view = float(share) < _SMALLEST_SHARE

    def _inside(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Bool:
        return self.view.contains(angle_x - self.centre[0], angle_y - self.centre[1])

    def sample(self, index: mi.UInt32, count: int, rng: mi.PCG32) -> tuple[mi.Point2f, mi.Float]:
        """Return tangent-plane angles of photons number `index` of `count`, and the energy [J] that each represents."""
        transmitter = self.transmitter
        if not self.use_view:
            angle_x, angle_y = transmitter.sample_tangent(stratified_point(index, count, rng))
            return mi.Point2f(angle_x, angle_y), opaque(transmitter.energy / count)
        point = interleaved_point(index, count, 2, rng)
        angle_x, angle_y = transmitter.sample_tangent(point)
        vx, vy = self.view.sample(point)
        of_view = index % 2 == 1
        angle_x = dr.select(of_view, vx + self.centre[0], angle_x)
        angle_y = dr.select(of_view, vy + self.centre[1], angle_y)
        density = transmitter.tangent_density(angle_x, angle_y)
        in_view = dr.select(self._inside(angle_x, angle_y), opaque(1 / self.view.area), 0)
        mixture = dr.lerp(density, in_view, opaque(count // 2 / count))
        # A sample of the beam's rim may lie outside both by rounding.
        share = dr.select(density > 0, density / mixture, 0)
        return mi.Point2f(angle_x, angle_y), opaque(transmitter.energy / count) * share
