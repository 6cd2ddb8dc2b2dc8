"""What every receiver has, whatever its pixels: pose, aperture, losses, and the sampling of its view."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.optics.checks import in_range, non_negative, positive
from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.pixels import PixelArray
from mitransient_lidar.transport.pose import Pose
from mitransient_lidar.transport.streams import stratified_point, unit_points

#: The laser's footprint is worth sampling when the field of view holds at least this share of it.
_SMALLEST_FOOTPRINT_SHARE = 0.05


@dataclass(frozen=True)
class ReceiverOptics:
    """Aperture and losses of a receiver.

    Parameters
    ----------
    aperture_area
        Area [m^2] normal to every ray of the (small) field of view, positive.
    optical_efficiency
        Share of the collected light that reaches the detector, above 0 to 1.
    two_way_atmospheric_transmittance
        Share of the light that survives the way through the air and back, above 0 to 1.
    response_time_ns
        Time constant of the receiver's exponential (single-pole) impulse response [ns]; 0 is ideal.
    """

    aperture_area: float
    optical_efficiency: float
    two_way_atmospheric_transmittance: float
    response_time_ns: float

    @classmethod
    def from_properties(cls, props: mi.Properties) -> ReceiverOptics:
        """Read the four parameters of a sensor plugin; raise ValueError when one is out of range."""
        name = "two_way_atmospheric_transmittance"
        return cls(
            positive("aperture_area", props.get("aperture_area", 0.025)),
            in_range("optical_efficiency", props.get("optical_efficiency", 0.9), 1e-12, 1.0),
            in_range(name, props.get(name, 0.9), 1e-12, 1.0),
            non_negative("response_time_ns", props.get("response_time_ns", 0.0)),
        )

    @property
    def collection(self) -> float:
        """Detected energy per radiance and solid angle [m^2]: area times efficiency times transmittance."""
        return self.aperture_area * self.optical_efficiency * self.two_way_atmospheric_transmittance


@dataclass(frozen=True)
class Receiver:
    """What the integrators need of a sensor plugin, which holds it as ``receiver``."""

    pose: Pose
    optics: ReceiverOptics
    pixels: PixelArray

    def sensor_ray(self, time: mi.Float, position: mi.Point2f, active: mi.Bool) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Serve Mitsuba's own integrators: a ray of the view whose weight turns radiance into energy."""
        gx, gy = self.pixels.sample(position)
        ray = mi.Ray3f(mi.Point3f(self.pose.origin.tolist()), self.pose.direction(gx, gy))
        ray.time = time
        weight = self.optics.collection * self.pixels.area * solid_angle_factor(gx, gy)
        return ray, mi.Spectrum(weight) & active


def solid_angle_factor(gx: mi.Float, gy: mi.Float) -> mi.Float:
    """Return the solid angle per tangent-plane area, (1 + g^2)^(-3/2)."""
    return dr.rsqrt(dr.square(1 + gx * gx + gy * gy) * (1 + gx * gx + gy * gy))


@dataclass(frozen=True)
class View:
    """One sample of the receiver's view for every path.

    Attributes
    ----------
    direction
        Unit direction of the ray.
    pixel
        Index of the pixel that sees it.
    weight
        Energy per radiance [J / (J m^-2 sr^-1)] divided by the number of paths; 0 outside all pixels.
    """

    direction: mi.Vector3f
    pixel: mi.UInt32
    weight: mi.Float


class ViewSampler:
    """Samples the receiver's view, half of the paths over the field of view and half over the laser's footprint.

    Both halves are weighted by the balance heuristic, so any beam and any field of view are served without bias.
    Samples are stratified, and neighbouring ones look into neighbouring directions.

    Parameters
    ----------
    receiver
        Pose, aperture and pixels.
    transmitter
        The ``lidar_transmitter`` plugin.
    """

    def __init__(self, receiver: Receiver, transmitter: mi.Emitter) -> None:
        self.receiver = receiver
        spot = transmitter.pose.ground_point()
        self.centre = [opaque(angle) for angle in receiver.pose.tangent_of_point(spot)]
        ranges = (np.linalg.norm(spot - pose.origin) for pose in (transmitter.pose, receiver.pose))
        self.sigma = opaque(transmitter.angular_spread * float(next(ranges)) / float(next(ranges)))
        self.use_footprint = self._footprint_share() > _SMALLEST_FOOTPRINT_SHARE

    def _footprint_share(self) -> float:
        """Return the share of the footprint's samples that fall inside a pixel."""
        gx, gy = self._sample_footprint(unit_points(4096))
        _, count = self.receiver.pixels.pixel_at(gx, gy, mi.Float(0.5))
        return float(dr.mean(dr.select(count > 0, mi.Float(1), 0))[0])

    def _sample_footprint(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        radius = self.sigma * dr.sqrt(-2 * dr.log(1 - u.x))
        sin, cos = dr.sincos(dr.two_pi * u.y)
        return dr.fma(radius, cos, self.centre[0]), dr.fma(radius, sin, self.centre[1])

    def _footprint_density(self, gx: mi.Float, gy: mi.Float) -> mi.Float:
        x, y = (gx - self.centre[0]) / self.sigma, (gy - self.centre[1]) / self.sigma
        return dr.exp(-0.5 * (x * x + y * y)) / (2 * np.pi * self.sigma * self.sigma)

    def sample(self, index: mi.UInt32, count: int, rng: mi.PCG32) -> View:
        """Sample one view for each path.

        Parameters
        ----------
        index
            Number of the path, 0 to count - 1.
        count
            Number of paths.
        rng
            Random numbers of the paths.
        """
        if self.use_footprint:
            of_footprint = (index & 1) == 1
            point = stratified_point(index >> 1, (count + 1) // 2, rng)
            gx, gy = self.receiver.pixels.sample(point)
            fx, fy = self._sample_footprint(point)
            gx, gy = dr.select(of_footprint, fx, gx), dr.select(of_footprint, fy, gy)
        else:
            gx, gy = self.receiver.pixels.sample(stratified_point(index, count, rng))
        pixel, pixels_here = self.receiver.pixels.pixel_at(gx, gy, rng.next_float32())
        density = pixels_here / self.receiver.pixels.area
        if self.use_footprint:
            density = 0.5 * (density + self._footprint_density(gx, gy))
        # A point in several pixels stands for each of them in turn: weight by their number.
        weight = pixels_here * (self.receiver.optics.collection / count) * solid_angle_factor(gx, gy) / density
        return View(self.receiver.pose.direction(gx, gy), pixel, dr.select(pixels_here > 0, weight, 0))
