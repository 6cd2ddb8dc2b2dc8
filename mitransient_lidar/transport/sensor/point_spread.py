"""Optical blur of a receiver: the point-spread function of its optics."""

from __future__ import annotations

from abc import ABC, abstractmethod

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import in_range, positive
from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.sensor.image_sampling import ImageSampler, read_image

#: Widest blur [mrad].
_WIDEST = 1000.0


class PointSpread(ABC):
    """Displacement on the detector of the light of one direction, against the focus of sharp optics."""

    #: Angle that contains all of the light but 4e-6 [rad].
    reach: float

    @abstractmethod
    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to displacements (angle_x, angle_y) [rad] that are distributed as the light is."""

    @staticmethod
    def from_properties(props: mi.Properties) -> PointSpread | None:
        """Read ``blur_mrad``, or ``blur_file`` and ``blur_file_mrad``, of a sensor plugin; None for sharp optics.

        Raises
        ------
        UserError
            When a value is out of range, both kinds are given, or the file is not a point-spread function.
        """
        if "blur_file" not in props:
            if "blur_file_mrad" in props:
                raise UserError("blur_file_mrad is the size of blur_file, which is missing")
            width = in_range("blur_mrad", props.get("blur_mrad", 0.0), 0.0, _WIDEST)
            return GaussianPointSpread(1e-3 * width) if width > 0 else None
        if "blur_mrad" in props:
            raise UserError("blur_mrad and blur_file: give one of them, not both")
        if "blur_file_mrad" not in props:
            raise UserError("blur_file_mrad is missing: the angle [mrad] over which the image blur_file reaches")
        path = str(props["blur_file"])
        values = read_image("blur_file", path)
        if values.min() < 0 or values.max() <= 0:
            raise UserError(f"blur_file = {path!r} must hold values that are not negative and not all 0")
        width = in_range("blur_file_mrad", positive("blur_file_mrad", props["blur_file_mrad"]), 0.0, _WIDEST)
        return MeasuredPointSpread(values, 1e-3 * width)


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
