"""Sampling of the laser beam within the receiver's field of view."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.rng import interleaved_point, stratified_point, unit_points
from mitransient_lidar.transport.sensor.octaves import Octaves
from mitransient_lidar.transport.sensor.receiver import Receiver

#: The field of view is sampled separately when it contains less than this share of the beam.
_SMALLEST_SHARE = 0.5

#: Core radius of the sampled region relative to the field of view, as light around it scatters into it.
_ROOM = 1.5

#: Width around that core beyond which there is little light, over the beam's standard deviation.
_BEAM_EDGE = 3.0


class BeamSampler:
    """Samples the beam by its energy; half the samples lie about the field of view when that is much narrower.

    Light that enters the water farther from the view the deeper reaches it, so that those samples are distributed in
    `Octaves`. Both halves are weighted by the balance heuristic. Samples are stratified.

    Parameters
    ----------
    spread
        Distance from the view, on the sea, from which light reaches the view in the water [m].
    """

    def __init__(self, transmitter: mi.Emitter, receiver: Receiver, spread: float = 0.0) -> None:
        self.transmitter = transmitter
        spot = receiver.pose.ground_point()
        centre = transmitter.pose.angles_of(spot - transmitter.pose.origin)
        ranges = [float(np.linalg.norm(spot - pose.origin)) for pose in (receiver.pose, transmitter.pose)]
        core = _ROOM * 0.5 * receiver.pixels.field_of_view * ranges[0] / ranges[1]
        edge = core + min(spread / ranges[1], _BEAM_EDGE * transmitter.widest_angular_spread)
        self._view = Octaves(centre, core, edge)
        share = dr.mean(dr.select(self._view.in_core(*transmitter.sample_tangent(unit_points(4096))), mi.Float(1), 0))
        self.use_view = float(share[0]) < _SMALLEST_SHARE

    def sample(self, index: mi.UInt32, count: int, rng: mi.PCG32) -> tuple[mi.Point2f, mi.Float]:
        """Return tangent-plane angles of photons number `index` of `count`, and the energy [J] that each represents."""
        transmitter = self.transmitter
        if not self.use_view:
            angle_x, angle_y = transmitter.sample_tangent(stratified_point(index, count, rng))
            return mi.Point2f(angle_x, angle_y), opaque(transmitter.energy / count)
        point = interleaved_point(index, count, 2, rng)
        of_view, of_beam = self._view.sample(point), transmitter.sample_tangent(point)
        angle_x, angle_y = (dr.select(index % 2 == 1, *pair) for pair in zip(of_view, of_beam, strict=True))
        density = transmitter.tangent_density(angle_x, angle_y)
        mixture = dr.lerp(density, self._view.density(angle_x, angle_y), opaque(count // 2 / count))
        # A sample of the beam's rim may lie outside both by rounding.
        share = dr.select(density > 0, density / mixture, 0)
        return mi.Point2f(angle_x, angle_y), opaque(transmitter.energy / count) * share
