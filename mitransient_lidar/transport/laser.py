"""The laser's beam in tangent-plane angles: profiles with density, widths and contours, and sampling for a view."""

from __future__ import annotations

from abc import ABC, abstractmethod

import contourpy
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import positive
from mitransient_lidar.transport.opaque import aligned, opaque
from mitransient_lidar.transport.rng import interleaved_point, stratified_point, unit_points
from mitransient_lidar.transport.sensor.image_sampling import ImageSampler
from mitransient_lidar.transport.sensor.outlines import Outline, enclosed_area
from mitransient_lidar.transport.sensor.receiver import Octaves, Receiver

#: Shares of the peak irradiance at which a beam's outlines are drawn.
OUTLINE_LEVELS = (float(np.exp(-0.5)), float(np.exp(-2)))

_LONGEST_SIDE = 2048  #: Longest image side: 32-bit random numbers do not resolve finer cells.
_SMALLEST_ISLAND = 0.02  #: Image outlines that enclose less than this share of the largest one are dropped as noise.


class BeamProfile(ABC):
    """Beam energy over the tangent plane, normalised to 1."""

    #: Root-mean-square angles along the beam's two principal axes, about its centre of gravity [rad].
    spreads: tuple[float, float]
    rotation: float  #: Azimuth of the first axis, from +angle_x towards +angle_y [rad].
    #: Full angles along these axes [rad], as defined for the transmitter parameter ``divergence_mrad``.
    divergence: tuple[float, float]
    reach: float  #: Angle from the optical axis that contains all of the energy but 4e-6 [rad].

    @abstractmethod
    def density(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Float:
        """Return the share of the energy per tangent-plane area [1/rad^2]."""

    @abstractmethod
    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers in the unit square to points distributed as the density."""

    @abstractmethod
    def outlines(self) -> list[tuple[float, list[Outline]]]:
        """Return contours: share of the peak irradiance, and closed lines (angle_x, angle_y) [rad], shape (n, 2)."""


class _Ellipse(BeamProfile):
    """Elliptic beam of positive half angles [rad] along its first and its second axis."""

    #: Root-mean-square angles, and the largest angle, over the half angles.
    _SPREAD: float
    _REACH: float

    def __init__(self, along: float, across: float, rotation: float = 0.0) -> None:
        self.along, self.rotation = along, rotation
        self.divergence = 2 * along, 2 * across
        self.spreads = self._SPREAD * along, self._SPREAD * across
        self.reach = self._REACH * max(along, across)
        self._ratio = across / along
        self._sin, self._cos = float(np.sin(rotation)), float(np.cos(rotation))

    def _to_circle(self, angle_x: mi.Float, angle_y: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Map (angle_x, angle_y) to a circular beam of half angle `along`."""
        if self.rotation != 0:
            sin, cos = self._sin, self._cos
            angle_x, angle_y = cos * angle_x + sin * angle_y, cos * angle_y - sin * angle_x
        return angle_x, angle_y / self._ratio

    def _from_circle(self, x: mi.Float, y: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Invert `_to_circle`."""
        y = y * self._ratio
        if self.rotation == 0:
            return x, y
        return self._cos * x - self._sin * y, self._sin * x + self._cos * y

    def _rim(self, scale: float) -> Outline:
        azimuth = np.linspace(0, 2 * np.pi, 97)
        angle_x, angle_y = self._from_circle(scale * self.along * np.cos(azimuth), scale * self.along * np.sin(azimuth))
        return np.stack([angle_x, angle_y], axis=-1)


class GaussianBeam(_Ellipse):
    """Gaussian beam: the half angles are standard deviations."""

    _SPREAD, _REACH = 1.0, 5.0

    def density(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Float:
        """Return the share of the energy per tangent-plane area [1/rad^2]."""
        x, y = self._to_circle(angle_x, angle_y)
        steepness, peak = 0.5 / self.along**2, 0.5 / (np.pi * self.along**2 * self._ratio)
        return opaque(peak) * dr.exp(-opaque(steepness) * (x * x + y * y))

    def width_slope(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Float:
        """Return the derivative of the logarithmic density by the logarithmic widths, with their ratio held fixed."""
        x, y = self._to_circle(angle_x, angle_y)
        return (x * x + y * y) * opaque(1 / self.along**2) - 2

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to points by Box and Muller's transform."""
        # 1 - u lies in (0, 1], so that the logarithm is finite.
        radius = opaque(self.along) * dr.sqrt(-2 * dr.log(1 - u.x))
        sin, cos = dr.sincos(dr.two_pi * u.y)
        return self._from_circle(radius * cos, radius * sin)

    def outlines(self) -> list[tuple[float, list[Outline]]]:
        """Return the ellipses at one and two standard deviations."""
        return [(level, [self._rim(float(np.sqrt(-2 * np.log(level))))]) for level in OUTLINE_LEVELS]


class TopHatBeam(_Ellipse):
    """Beam of uniform irradiance within an ellipse: the half angles are its semi-axes."""

    _SPREAD, _REACH = 0.5, 1.0

    def density(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Float:
        """Return the share of the energy per tangent-plane area [1/rad^2]."""
        x, y = self._to_circle(angle_x, angle_y)
        inside = x * x + y * y <= opaque(self.along**2)
        return dr.select(inside, opaque(1 / (np.pi * self.along**2 * self._ratio)), 0)

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to uniform points in the ellipse."""
        radius = opaque(self.along) * dr.sqrt(u.x)
        sin, cos = dr.sincos(dr.two_pi * u.y)
        return self._from_circle(radius * cos, radius * sin)

    def outlines(self) -> list[tuple[float, list[Outline]]]:
        """Return the rim."""
        return [(1.0, [self._rim(1.0)])]


class ImageBeam(BeamProfile):
    """Measured beam: uniform irradiance within each cell of an image that is centred on the optical axis.

    `irradiance`: image in any unit, shape (rows, columns), 1 to 2048 each. Row 0 is the far edge (+angle_x), column 0
    the left one (+angle_y). Finite, not negative, not all 0; else UserError. `side`: full angle [rad] from the first
    column's outer edge to the last one's, positive. Cells are squares.
    """

    def __init__(self, irradiance: NDArray[np.float64], side: float) -> None:
        image = np.asarray(irradiance, dtype=np.float64)
        if image.ndim != 2 or 0 in image.shape or max(image.shape) > _LONGEST_SIDE:
            raise UserError(
                f"beam image of shape {image.shape} must have two dimensions of 1 to {_LONGEST_SIDE} cells each"
            )
        if not np.isfinite(image).all():
            raise UserError(f"beam image holds {image[~np.isfinite(image)][0]} but every irradiance must be finite")
        if image.min() < 0:
            raise UserError(f"beam image holds {image.min():g} but no irradiance may be negative")
        if image.max() == 0:
            raise UserError("beam image holds zeros only but must have light in at least one cell")
        # Scaled first, as the sum of irradiances in small units may overflow.
        self._share = image / image.max()
        self._share /= self._share.sum()
        self._rows, self._columns = image.shape
        self._cell = positive("side of the beam image", side) / self._columns
        self.reach = 0.5 * self._cell * float(np.hypot(self._rows, self._columns))
        self._sampler = ImageSampler(self._share)
        self._density = aligned(mi.Float, self._share / self._cell**2)
        self._measure()

    def _measure(self) -> None:
        """Set widths and azimuth from the second moments about the centre of gravity."""
        far = self._cell * (0.5 * self._rows - np.arange(self._rows) - 0.5)
        left = self._cell * (0.5 * self._columns - np.arange(self._columns) - 0.5)
        rows, columns = self._share.sum(axis=1), self._share.sum(axis=0)
        dx, dy = far - rows @ far, left - columns @ left
        # Variance of even light within a cell.
        within = self._cell**2 / 12
        mixed = float(dx @ self._share @ dy)
        moments = np.array([[rows @ dx**2 + within, mixed], [mixed, columns @ dy**2 + within]])
        variances, axes = np.linalg.eigh(moments)
        self.spreads = float(np.sqrt(variances[1])), float(np.sqrt(variances[0]))
        self.rotation = float(np.arctan2(axes[1, 1], axes[0, 1]))
        self.divergence = 2 * self.spreads[0], 2 * self.spreads[1]

    def density(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Float:
        """Return the share of the energy per tangent-plane area [1/rad^2]."""
        row = 0.5 * self._rows - angle_x / self._cell
        column = 0.5 * self._columns - angle_y / self._cell
        inside = (row >= 0) & (row < self._rows) & (column >= 0) & (column < self._columns)
        index = mi.UInt32(dr.select(inside, row, 0)) * self._columns + mi.UInt32(dr.select(inside, column, 0))
        return dr.gather(mi.Float, self._density, index, inside)

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to points distributed as the density."""
        row, column = self._sampler.sample(u)
        return self._cell * (0.5 * self._rows - row), self._cell * (0.5 * self._columns - column)

    def outlines(self) -> list[tuple[float, list[Outline]]]:
        """Return the lines of equal irradiance, without noise islands."""
        # A dark frame closes every line.
        padded = np.pad(self._share / self._share.max(), 1)
        far = self._cell * (0.5 * self._rows + 0.5 - np.arange(self._rows + 2))
        left = self._cell * (0.5 * self._columns + 0.5 - np.arange(self._columns + 2))
        lines = contourpy.contour_generator(left, far, padded)
        found = []
        for level in OUTLINE_LEVELS:
            loops = [np.asarray(line)[:, ::-1] for line in lines.lines(level)]
            areas = [abs(enclosed_area(loop)) for loop in loops]
            large = _SMALLEST_ISLAND * max(areas)
            found.append((level, [loop for loop, area in zip(loops, areas, strict=True) if area >= large]))
        return found


_SMALLEST_SHARE = 0.5  #: The field of view is sampled separately when it contains less than this share of the beam.
_ROOM = 1.5  #: Core radius of the sampled region relative to the field of view, as light around it scatters into it.
_BEAM_EDGE = 3.0  #: Width around that core beyond which there is little light, over the beam's standard deviation.


class BeamSampler:
    """Samples the beam by its energy; half the samples lie about the field of view when that is much narrower.

    Light that enters the water farther from the view the deeper reaches it, so that those samples are distributed in
    `Octaves`. Both halves are weighted by the balance heuristic. Samples are stratified.

    `spread`: distance from the view, on the sea, from which light reaches the view in the water [m].
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
        """Return tangent-plane angles for photon numbers `index` among `count`, and each photon's energy [J]."""
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
