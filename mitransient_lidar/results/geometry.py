"""Lidar geometry and other numbers, read back from the attributes of a dataset."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, in_range
from mitransient_lidar.physics.lidar import gate_train, refraction
from mitransient_lidar.physics.lidar.lidar_equation import LidarSystem

Attributes = Mapping[str, Any]


@dataclass(frozen=True)
class LidarGeometry:
    """Co-located lidar over a level sea."""

    height: float  #: Height above the mean sea level [m].
    off_nadir: float  #: Angle of the axis from the vertical [rad].
    refractive_index: float
    group_index: float
    surface_time_ns: float  #: Arrival time of the surface echo [ns], the zero of the depth axis.

    @classmethod
    def level(cls, height: float, off_nadir: float, refractive_index: float, group_index: float) -> LidarGeometry:
        """Return the geometry whose surface echo arrives from the mean sea level along the axis."""
        surface = float(refraction.surface_time_ns(height, off_nadir))
        return cls(height, off_nadir, refractive_index, group_index, surface)

    @classmethod
    def from_attributes(
        cls, attributes: Attributes, *, surface: Literal["any", "level", "measured"] = "any"
    ) -> LidarGeometry:
        """Read the attributes of a result.

        Parameters
        ----------
        attributes
            ``altitude`` [m], ``off_nadir_deg``, ``refractive_index``, ``group_index`` and, optionally,
            ``surface_time_ns``, the mean arrival over the pixels.
        surface
            Time of the surface echo: ``measured`` is ``surface_time_ns``, ``level`` that of the mean sea level on the
            axis, ``any`` the first of these that is known.

        Raises
        ------
        UserError
            If an attribute is missing or is not a number of at least 0.
        """
        if surface == "measured":
            required_number(attributes, "surface_time_ns")
        names = ("altitude", "off_nadir_deg", "refractive_index", "group_index")
        height, degrees, refractive_index, group_index = (required_number(attributes, name) for name in names)
        geometry = cls.level(height, math.radians(degrees), refractive_index, group_index)
        measured = None if surface == "level" else optional_number(attributes, "surface_time_ns")
        return geometry if measured is None else replace(geometry, surface_time_ns=measured)

    @property
    def cos_water(self) -> float:
        """Cosine of the axis's angle from the vertical in the water."""
        return float(np.cos(refraction.snell(self.off_nadir, self.refractive_index)))

    @property
    def slant_range(self) -> float:
        """Distance to the mean sea level along the axis [m]."""
        return self.height / math.cos(self.off_nadir)

    @property
    def metres_per_ns(self) -> float:
        """One-way path in the water per nanosecond of delay [m/ns]."""
        return 1e-9 * C0 / (2 * self.group_index)

    @property
    def depth_per_ns(self) -> float:
        """Depth per nanosecond of delay [m/ns]."""
        return self.metres_per_ns * self.cos_water

    def path_of_time(self, time_ns: npt.ArrayLike) -> FloatArray:
        """Return the one-way path in the water [m] of echoes at times [ns]."""
        return np.asarray(self.metres_per_ns * (np.asarray(time_ns, dtype=np.float64) - self.surface_time_ns))

    def depth_of_time(self, time_ns: npt.ArrayLike) -> FloatArray:
        """Return the depth [m] of echoes at times [ns]."""
        return gate_train.depth_of_time(time_ns, self.surface_time_ns, self.group_index, self.cos_water)

    def time_of_depth(self, depth: npt.ArrayLike) -> FloatArray:
        """Return the arrival times [ns] of echoes from depths [m]."""
        return gate_train.time_of_depth(depth, self.surface_time_ns, self.group_index, self.cos_water)

    def solid_angle_per_area(self, path: npt.ArrayLike) -> FloatArray:
        """Return the solid angle of the aperture per area [sr/m^2] at one-way paths in the water [m]."""
        depth = np.asarray(path, dtype=np.float64) * self.cos_water
        return refraction.solid_angle_per_area(self.height, depth, self.off_nadir, self.refractive_index)

    def spreading(self, path: npt.ArrayLike) -> FloatArray:
        """Return the solid angle of the aperture at paths in the water [m] over that at the surface; 1 above it."""
        return np.asarray(self.solid_angle_per_area(np.maximum(path, 0)) / self.solid_angle_per_area(0.0))

    def surface_depth(self, edge: float) -> float:
        """Return the depth [m] on the axis that is simultaneous with the far surface echo of a half angle [rad]."""
        farthest = self.height / math.cos(min(self.off_nadir + edge, 0.5 * math.pi - 1e-3))
        return (farthest - self.slant_range) / self.group_index * self.cos_water

    def spot_diameter(self, attributes: Attributes) -> float:
        """Return the diameter of the receiver's field of view on the sea surface [m]."""
        return 1e-3 * required_number(attributes, "field_of_view_mrad") * self.height / math.cos(self.off_nadir)

    def lidar_system(self, attributes: Attributes, efficiency: float | None = None) -> LidarSystem:
        """Return the system of the lidar equation, with the pulse energy inside the receiver's field of view.

        The efficiency, 0 to 1, includes transmitter, receiver and two-way transmittance of the atmosphere; by default
        it follows from the scene's parameters ``optical_efficiency`` and ``two_way_atmospheric_transmittance``.

        Raises
        ------
        UserError
            If the efficiency is out of range or unknown, or another attribute is missing.
        """
        energy = 1e-3 * required_number(attributes, "pulse_energy_mj") * _efficiency(attributes, efficiency)
        return LidarSystem(
            self.height,
            self.off_nadir,
            energy * _fraction_in_view(attributes),
            required_number(attributes, "aperture_area"),
            self.refractive_index,
            self.group_index,
        )


def _fraction_in_view(attributes: Attributes) -> float:
    """Return the fraction of a Gaussian beam inside the receiver's field of view."""
    half = required_number(attributes, "field_of_view_mrad") / required_number(attributes, "divergence_mrad")
    if attributes.get("field_of_view_shape", "circle") == "circle":
        return 1 - math.exp(-0.5 * half**2)
    return math.erf(half / math.sqrt(2)) ** 2


def _efficiency(attributes: Attributes, given: float | None) -> float:
    if given is not None:
        return in_range("efficiency", given, 0, 1)
    names = ("scene.optical_efficiency", "scene.two_way_atmospheric_transmittance")
    try:
        optics, atmosphere = (float(attributes[name]) for name in names)
    except (KeyError, ValueError):
        raise UserError(f"efficiency must be given: the dataset has no attributes {' and '.join(names)}") from None
    return optics**2 * atmosphere


def optional_number(attributes: Attributes, name: str) -> float | None:
    """Return an attribute that is a finite number, or None."""
    value = attributes.get(name)
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None


def required_number(attributes: Attributes, name: str) -> float:
    """Return an attribute that is a number of at least 0; raise `UserError` otherwise."""
    if name not in attributes:
        raise UserError(f"the dataset has no attribute {name}")
    number = optional_number(attributes, name)
    if number is None or number < 0:
        raise UserError(f"the attribute {name} = {attributes[name]!r} of the dataset must be a number of at least 0")
    return number
