"""A receiver's optical blur: the point-spread function of its optics."""

from __future__ import annotations

from abc import ABC, abstractmethod

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.sensor.image_sampling import ImageSampler


class PointSpread(ABC):
    """Displacement on the detector of light from one direction, against the focus of sharp optics."""

    #: Angle that contains all of the light but 4e-6 [rad].
    reach: float

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
    """Measured point-spread function, constant in each square cell of an image about the focus of sharp optics.

    Parameters
    ----------
    values
        Values in any unit, not negative and not all 0, shape (rows, columns). Row 0 is the far edge (+angle_x), column
        0 the left one (+angle_y).
    width
        Extent of the columns along angle_y [rad], positive.
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
