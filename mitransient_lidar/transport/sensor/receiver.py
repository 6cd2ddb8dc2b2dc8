"""A receiver's pose, aperture, losses and blur, and the sampling of its field of view."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.rng import Lanes, interleaved_point, pass_streams, stratified_point, unit_points
from mitransient_lidar.transport.sensor.image_sampling import ImageSampler
from mitransient_lidar.transport.sensor.pixels import PixelArray

#: The laser's footprint is sampled when the field of view contains more than this share of it.
_SMALLEST_FOOTPRINT_SHARE = 0.05

#: Radius of the core around the footprint's centre over the beam's standard deviation: samples are even within it.
_CORE_PER_SPREAD = 2.0

#: Of this many samples, the numbers that are drawn over the field of view: with few pixels, and in images.
_SETS = 4
_OF_VIEW, _OF_VIEW_IN_IMAGES = 1, 2

IMAGE_PIXELS = 4096  #: Number of pixels from which a receiver is an imager.


@dataclass(frozen=True)
class ReceiverOptics:
    """Receiver aperture and losses."""

    aperture_area: float  #: Area [m^2] normal to every ray of the (small) field of view, 1e-12 to 1000.
    optical_efficiency: float  #: Share of the collected light that reaches the detector, above 0 to 1.
    two_way_atmospheric_transmittance: float  #: Share of the light that the air transmits both ways, above 0 to 1.
    #: Time constant of the receiver's exponential (single-pole) impulse response [ns], at most 1e6; 0 is ideal.
    response_time_ns: float
    obscuration: float = 0.0  #: Share of the aperture's area that is blocked, as by a secondary mirror, 0 to 0.999.

    @property
    def collection(self) -> float:
        """Detected energy per radiance and solid angle [m^2]: open area times efficiency times transmittance."""
        open_area = self.aperture_area * (1 - self.obscuration)
        return open_area * self.optical_efficiency * self.two_way_atmospheric_transmittance


@dataclass(frozen=True)
class Receiver:
    """The attribute ``receiver`` of a sensor plugin.

    Pixels are regions on the detector. Light from the direction g falls on g + delta, with delta drawn from the
    point-spread function `blur`. Sharp optics (None) have delta = 0.
    """

    pose: KernelPose
    optics: ReceiverOptics
    pixels: PixelArray
    blur: PointSpread | None = None

    @property
    def is_imager(self) -> bool:
        """Whether it has so many pixels that paths suit an image."""
        return self.pixels.count >= IMAGE_PIXELS

    def displacement(self, rng: mi.PCG32) -> tuple[mi.Float, mi.Float]:
        """Draw displacements on the detector; sharp optics use no random numbers."""
        if self.blur is None:
            return mi.Float(0), mi.Float(0)
        return self.blur.sample(mi.Point2f(rng.next_float32(), rng.next_float32()))

    def sensor_ray(
        self, time: mi.Float, position: mi.Point2f, spread: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Return a field-of-view ray and the factor from radiance to energy, for Mitsuba's own integrators."""
        angle_x, angle_y = self.pixels.sample(position)
        _, here = self.pixels.pixel_at(angle_x, angle_y, mi.Float(0))
        if self.blur is not None:
            dx, dy = self.blur.sample(spread)
            angle_x, angle_y = angle_x - dx, angle_y - dy
        ray = mi.Ray3f(mi.Point3f(self.pose.origin.tolist()), self.pose.direction(angle_x, angle_y))
        ray.time = time
        weight = self.optics.collection * self.pixels.area * solid_angle_factor(angle_x, angle_y)
        return ray, mi.Spectrum(weight) & active & (here > 0)


def solid_angle_factor(angle_x: mi.Float, angle_y: mi.Float) -> mi.Float:
    """Return the solid angle per tangent-plane area, (1 + g^2)^(-3/2)."""
    return dr.rsqrt(dr.square(1 + angle_x * angle_x + angle_y * angle_y) * (1 + angle_x * angle_x + angle_y * angle_y))


@dataclass(frozen=True)
class SensorSample:
    """One field-of-view sample for every path."""

    #: Tangent-plane angles and unit direction of the ray, and index of the pixel that sees it.
    angles: mi.Point2f
    direction: mi.Vector3f
    pixel: mi.UInt32
    weight: mi.Float  #: Energy per radiance [J / (J m^-2 sr^-1)] divided by the number of paths; 0 outside all pixels.

    @classmethod
    def at(cls, pose: KernelPose, x: mi.Float, y: mi.Float, pixel: mi.UInt32, weight: mi.Float) -> SensorSample:
        """Return samples at a pose's tangent-plane angles."""
        return cls(mi.Point2f(x, y), pose.direction(x, y), pixel, weight)


class SensorSampler:
    """Samples the receiver's rays: some paths over the field of view, the others around the laser's footprint.

    Around the footprint, directions are distributed in `Octaves`, as scattering spreads the light of a narrow beam.
    Both parts are weighted by the balance heuristic. Samples are stratified, and neighbours have similar directions.

    With blur, directions over the view draw the detector point p and the direction p - delta. Others draw the direction
    g and the point g + delta. Both draw delta from the point-spread function, whose density cancels.
    """

    def __init__(self, receiver: Receiver, transmitter: mi.Emitter) -> None:
        self.receiver = receiver
        spot, pixels = transmitter.pose.ground_point(), receiver.pixels
        self.centre = receiver.pose.angles_of(spot - receiver.pose.origin)
        ranges = (np.linalg.norm(spot - pose.origin) for pose in (transmitter.pose, receiver.pose))
        spread = transmitter.widest_angular_spread * float(next(ranges)) / float(next(ranges))
        self.sigma = opaque(spread)
        # The field of view's edge, at most as far from its centre as a square's corner.
        corner = 1.0 if pixels.field_of_view_shape == "circle" else float(np.sqrt(2))
        edge = 0.5 * corner * pixels.field_of_view + float(np.hypot(*self.centre))
        self._footprint = Octaves(self.centre, _CORE_PER_SPREAD * spread, edge)
        self.use_footprint = self._footprint_share() > _SMALLEST_FOOTPRINT_SHARE
        self._of_view = _OF_VIEW_IN_IMAGES if pixels.count >= IMAGE_PIXELS else _OF_VIEW

    def _footprint_share(self) -> float:
        """Return the share of a Gaussian footprint's samples that fall inside a pixel."""
        u = unit_points(4096)
        angle_x, angle_y = self._footprint.around(self.sigma * dr.sqrt(-2 * dr.log(1 - u.x)), u.y)
        dx, dy = self.receiver.displacement(pass_streams(0, 0, 4096))
        _, count = self.receiver.pixels.pixel_at(angle_x + dx, angle_y + dy, mi.Float(0.5))
        return float(dr.mean(dr.select(count > 0, mi.Float(1), 0))[0])

    def sample_shots(self, lanes: Lanes, count: int, rng: mi.PCG32) -> SensorSample:
        """Sample directions for `count` paths of each shot, with pixels counted shot after shot."""
        sample = self.sample(lanes.number, count, rng)
        pixels = self.receiver.pixels.count
        return sample if lanes.shots == 1 else replace(sample, pixel=sample.pixel + lanes.shot * pixels)

    def sample(self, index: mi.UInt32, count: int, rng: mi.PCG32) -> SensorSample:
        """Sample directions and pixels for paths number `index` of `count`."""
        if self.use_footprint:
            of_footprint = index % _SETS >= self._of_view
            point = interleaved_point(index, count, _SETS, rng)
        else:
            of_footprint, point = mi.Bool(False), stratified_point(index, count, rng)
        # Places on the detector (px, py), and directions (angle_x, angle_y) whose light falls on them.
        px, py = self.receiver.pixels.sample(point)
        dx, dy = self.receiver.displacement(rng)
        angle_x, angle_y = px - dx, py - dy
        if self.use_footprint:
            fx, fy = self._footprint.sample(point)
            angle_x, angle_y = dr.select(of_footprint, fx, angle_x), dr.select(of_footprint, fy, angle_y)
            px, py = dr.select(of_footprint, fx + dx, px), dr.select(of_footprint, fy + dy, py)
        pixel, pixels_here = self.receiver.pixels.pixel_at(px, py, rng.next_float32())
        density = pixels_here * opaque(1 / self.receiver.pixels.area)
        if self.use_footprint:
            of_view = count // _SETS * self._of_view + min(count % _SETS, self._of_view)
            density = dr.lerp(self._footprint.density(angle_x, angle_y), density, opaque(of_view / count))
        # A point in several pixels is assigned to one of them at random: weight by their number.
        collection = pixels_here * opaque(self.receiver.optics.collection / count)
        weight = collection * solid_angle_factor(angle_x, angle_y) / density
        weight = dr.select(pixels_here > 0, weight, 0)
        return SensorSample.at(self.receiver.pose, angle_x, angle_y, pixel, weight)


class Octaves:
    """Sampling of the tangent plane about a centre: even in a core, beyond it as much in each octave of distance.

    At the distance r the density is 1 / (pi ln(1 + R^2 / q^2) (r^2 + q^2)), with the core q, up to the edge R.

    `centre`: (angle_x, angle_y) of the centre [rad], shape (2,). `core`, `edge`: radii of the core and of all samples
    [rad], positive.
    """

    def __init__(self, centre: FloatArray, core: float, edge: float) -> None:
        self._centre = [opaque(angle) for angle in centre]
        self._core, self._edge, self._log_range = opaque(core), opaque(edge), opaque(np.log1p((edge / core) ** 2))

    def around(self, radius: mi.Float, turn: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Return points at distances from the centre [rad] and azimuths [turns]."""
        sin, cos = dr.sincos(dr.two_pi * turn)
        return dr.fma(radius, cos, self._centre[0]), dr.fma(radius, sin, self._centre[1])

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to points."""
        return self.around(self._core * dr.sqrt(dr.maximum(dr.exp(u.x * self._log_range) - 1, 0)), u.y)

    def density(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Float:
        """Return the density in `sample` [1/rad^2]."""
        radius2 = dr.square(angle_x - self._centre[0]) + dr.square(angle_y - self._centre[1])
        density = dr.inv_pi / (self._log_range * (radius2 + self._core * self._core))
        return dr.select(radius2 <= self._edge * self._edge, density, 0)

    def in_core(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Bool:
        """Return whether points lie in the core."""
        radius2 = dr.square(angle_x - self._centre[0]) + dr.square(angle_y - self._centre[1])
        return radius2 <= self._core * self._core


class PointSpread(ABC):
    """Light's displacement on the detector from one direction, against sharp optics' focus."""

    reach: float  #: Angle that contains all of the light but 4e-6 [rad].

    @abstractmethod
    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to displacements (angle_x, angle_y) [rad] that are distributed as the light is."""


class GaussianPointSpread(PointSpread):
    """Circular Gaussian, of a standard deviation [rad] along each axis."""

    def __init__(self, sigma: float) -> None:
        self.sigma, self.reach = sigma, 5 * sigma

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to displacements (angle_x, angle_y) [rad].

        Box and Muller 1958, doi:10.1214/aoms/1177706645.
        """
        radius = opaque(self.sigma) * dr.sqrt(-2 * dr.log(1 - u.x))
        sin, cos = dr.sincos(dr.two_pi * u.y)
        return radius * cos, radius * sin


class MeasuredPointSpread(PointSpread):
    """Measured point-spread function, constant in each square image cell about the focus of sharp optics.

    `values`: values in any unit, not negative and not all 0, shape (rows, columns). Row 0 is the far edge (+angle_x),
    column 0 the left one (+angle_y). `width`: extent of the columns along angle_y [rad], positive.
    """

    def __init__(self, values: NDArray[np.float64], width: float) -> None:
        self._sampler = ImageSampler(values)
        self._cell = width / values.shape[1]
        self.reach = 0.5 * self._cell * float(np.hypot(*values.shape))

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to displacements (angle_x, angle_y) [rad]."""
        row, column = self._sampler.sample(u)
        rows, columns = self._sampler.shape
        cell = opaque(self._cell)
        return (0.5 * rows - row) * cell, (0.5 * columns - column) * cell
