"""Parameters of the lidar equation for a co-located transmitter and receiver over a level sea."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, in_range, positive
from mitransient_lidar.physics.lidar.refraction import fresnel, solid_angle_per_area


@dataclass(frozen=True)
class LidarSystem:
    """Co-located transmitter and receiver."""

    height: float  #: Height above the mean sea level [m], positive.
    off_nadir: float  #: Angle of the axis from the vertical [rad], 0 to below pi/2.
    energy: float  #: Pulse energy [J], positive, times efficiencies of both optics and two-way transmission of the air.
    aperture_area: float  #: Area of the receiver normal to the ray [m^2], positive.
    refractive_index: float = 1.34  #: Refractive index of the water, at least 1, which refracts rays.
    group_index: float = 1.34  #: Group index of the water, at least 1, which determines travel times.

    def __post_init__(self) -> None:
        for name in ("height", "energy", "aperture_area"):
            positive(name, getattr(self, name))
        if not 0 <= self.off_nadir < np.pi / 2:
            raise UserError(f"off_nadir = {self.off_nadir:g} must be at least 0 and below pi/2")
        for name in ("refractive_index", "group_index"):
            in_range(name, getattr(self, name), 1, np.inf)

    def water_gain(self, depth: npt.ArrayLike, theta: npt.ArrayLike) -> FloatArray:
        """Received energy per unit of backscatter [J sr], without attenuation in the water.

        Parameters
        ----------
        depth, theta : array_like
            Depth [m], at least 0, and angle of the ray in air [rad], which broadcast.
        """
        _, transmittance = fresnel(theta, self.refractive_index)
        solid_angle = solid_angle_per_area(self.height, depth, theta, self.refractive_index)
        return np.asarray(self.energy * self.aperture_area * transmittance**2 * solid_angle)
