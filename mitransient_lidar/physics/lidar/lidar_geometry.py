"""Co-located lidar over a level sea: ranges, depths, times, and the lidar equation; definitions of divergence."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.fields import Read
from mitransient_lidar.core.validation import Checked, FloatArray, checked, finite_array, in_range, positive
from mitransient_lidar.physics.lidar.level_sea import fresnel, snell, solid_angle_per_area, surface_time_ns
from mitransient_lidar.physics.lidar.pose import Pose


def _below_horizon(name: str, value: float) -> float:
    """Return an angle from the vertical; reject one outside [0, pi/2) rad."""
    if not 0 <= value < np.pi / 2:
        raise UserError(f"{name} = {value:g} must be at least 0 and below pi/2")
    return value


@dataclass(frozen=True)
class LidarGeometry(Checked):
    """Co-located transmitter and receiver over a level sea, along their axis.

    Values out of range raise UserError.
    """

    height: float = checked(positive)  #: Height above the mean sea level [m], positive.
    off_nadir: float = checked(_below_horizon)  #: Angle of the axis from the vertical [rad], 0 to below pi/2.
    #: Refractive index of the water, at least 1, which refracts rays.
    refractive_index: float = checked(in_range, 1, np.inf)
    #: Group index of the water, at least 1, which determines travel times.
    group_index: float = checked(in_range, 1, np.inf)
    #: Surface echo arrival [ns], the zero of depths; by default (NaN) from the mean sea level along the axis.
    surface_time_ns: float = field(default=math.nan, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if math.isnan(self.surface_time_ns):
            level = float(surface_time_ns(self.height, self.off_nadir))
            object.__setattr__(self, "surface_time_ns", level)

    @classmethod
    def of_pose(cls, pose: Pose, refractive_index: float, group_index: float) -> LidarGeometry:
        """Return a lidar's geometry from its pose above water with these indices."""
        pose.require_above_sea()
        return LidarGeometry(float(pose.origin[2]), math.radians(pose.off_nadir_deg), refractive_index, group_index)

    @property
    def angle_in_water(self) -> float:
        """Angle of the axis from the vertical in the water [rad]."""
        return float(snell(self.off_nadir, self.refractive_index))

    @property
    def cos_water(self) -> float:
        """Cosine of the axis's angle from the vertical in the water."""
        return float(np.cos(self.angle_in_water))

    @property
    def slant_range(self) -> float:
        """Distance to the mean sea level along the axis [m]."""
        return self.height / math.cos(self.off_nadir)

    @property
    def surface_ns_per_rad(self) -> float:
        """Change of the arrival from the mean sea level with the angle from the vertical [ns/rad]."""
        return 2e9 / C0 * self.slant_range * math.tan(self.off_nadir)

    @property
    def metres_per_ns(self) -> float:
        """One-way path in the water per nanosecond of delay [m/ns]."""
        return 0.5e-9 * C0 / self.group_index

    @property
    def depth_per_ns(self) -> float:
        """Depth per nanosecond of delay [m/ns]: c0 cos(theta_water)/(2 n_g)."""
        return self.metres_per_ns * self.cos_water

    def path_of_time(self, time_ns: npt.ArrayLike) -> FloatArray:
        """Return the one-way path in the water [m] of echoes at times [ns]."""
        return np.asarray(self.metres_per_ns * (finite_array("time_ns", time_ns) - self.surface_time_ns))

    def depth_of_time(self, time_ns: npt.ArrayLike) -> FloatArray:
        """Return the echo depth [m] for times [ns]."""
        return np.asarray((finite_array("time_ns", time_ns) - self.surface_time_ns) * self.depth_per_ns)

    def time_of_depth(self, depth: npt.ArrayLike) -> FloatArray:
        """Return the arrival times [ns] of echoes from depths [m]."""
        return np.asarray(self.surface_time_ns + finite_array("depth", depth) / self.depth_per_ns)

    def solid_angle_per_area(self, path: npt.ArrayLike) -> FloatArray:
        """Return the solid angle of the aperture per area [sr/m^2] at one-way paths in the water [m]."""
        depth = np.asarray(path, dtype=np.float64) * self.cos_water
        return solid_angle_per_area(self.height, depth, self.off_nadir, self.refractive_index)

    def spreading(self, path: npt.ArrayLike) -> FloatArray:
        """Return the solid angle of the aperture at paths in the water [m] over that at the surface; 1 above it."""
        return np.asarray(self.solid_angle_per_area(np.maximum(path, 0)) / self.solid_angle_per_area(0.0))

    def surface_depth(self, edge: float) -> float:
        """Return the depth [m] on the axis that is simultaneous with the far surface echo of a half angle [rad]."""
        farthest = self.height / math.cos(min(self.off_nadir + edge, 0.5 * math.pi - 1e-3))
        return (farthest - self.slant_range) / self.group_index * self.cos_water


@dataclass(frozen=True, kw_only=True)
class LidarSystem(LidarGeometry):
    """Co-located transmitter and receiver of a given energy and aperture."""

    #: Pulse energy [J], positive, times efficiencies of both optics and two-way transmission of the air.
    energy: float = checked(positive)
    aperture_area: float = checked(positive)  #: Area of the receiver normal to the ray [m^2], positive.

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


#: Ratio of each definition's full width to a Gaussian beam's e^-1/2 full width (2 sigma).
WIDTHS = {"divergence_mrad": 1.0, "divergence_fwhm_mrad": math.sqrt(2 * math.log(2)), "divergence_1e2_mrad": 2.0}


def read_divergence(read: Read, is_top_hat: bool = False) -> float | None:
    """Read a beam's divergence from one of its three parameters.

    Returns the full angle [rad] between the points where the irradiance has fallen to e^-1/2 of its peak; None if no
    parameter is given.

    Raises UserError if the value is out of range.

    Parameters
    ----------
    read
        Reader of the plugin parameters.
    is_top_hat
        Whether the irradiance is even up to the beam's edge instead of Gaussian.

    Notes
    -----
    A Gaussian exp(-r^2/(2 sigma^2)) has fallen to e^-1/2, to a half and to e^-2 at diameters of 2 sigma, 2 sqrt(2 ln 2)
    sigma = 2.355 sigma and 4 sigma. A top-hat beam has its full irradiance up to its edge and none beyond: all three
    are its full angle.
    """
    given = read.given(*WIDTHS)
    return 1e-3 * read(given[0]) / (1.0 if is_top_hat else WIDTHS[given[0]]) if given else None
