"""Parameters of the lidar equation for a co-located transmitter and receiver over a level sea."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.validation import FloatArray, positive
from mitransient_lidar.physics.lidar.lidar_geometry import LidarGeometry
from mitransient_lidar.physics.lidar.refraction import fresnel, solid_angle_per_area


@dataclass(frozen=True, kw_only=True)
class LidarSystem(LidarGeometry):
    """Co-located transmitter and receiver of a given energy and aperture."""

    energy: float  #: Pulse energy [J], positive, times efficiencies of both optics and two-way transmission of the air.
    aperture_area: float  #: Area of the receiver normal to the ray [m^2], positive.

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("energy", "aperture_area"):
            positive(name, getattr(self, name))

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

    @property
    def column_gain(self) -> float:
        """Power of the column's signal at the surface over the backscatter at 180 degrees, b p(pi) [W m sr]."""
        return float(self.water_gain(0.0, self.off_nadir)) * 1e9 * self.metres_per_ns
