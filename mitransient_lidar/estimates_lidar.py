"""The lidar of a result, as estimators need it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import xarray as xr

from mitransient_lidar.errors import UserError
from mitransient_lidar.loading import readable_errors
from mitransient_lidar.optics.checks import in_range
from mitransient_lidar.optics.lidar_equation import LidarSystem
from mitransient_lidar.optics.refraction import surface_time_ns
from mitransient_lidar.optics.water import C0


@dataclass(frozen=True)
class Lidar:
    """Numbers of a result that estimators need: [m], [rad], indices, and mean surface [ns]."""

    height: float
    off_nadir: float
    index: float
    group: float
    surface_ns: float

    @classmethod
    def of(cls, dataset: xr.Dataset) -> Lidar:
        """Read a result's attributes.

        Raises
        ------
        UserError
            If one is missing or no number.
        """
        height, degrees = number(dataset, "altitude"), number(dataset, "off_nadir_deg")
        surface = float(surface_time_ns(height, math.radians(degrees)))
        return cls(
            height,
            math.radians(degrees),
            number(dataset, "refractive_index"),
            number(dataset, "group_index"),
            float(dataset.attrs.get("surface_time_ns", surface)),
        )

    @property
    def metres_per_ns(self) -> float:
        """Way in the water per delay [m/ns]."""
        return 1e-9 * C0 / (2 * self.group)

    def spot(self, dataset: xr.Dataset) -> float:
        """Return the diameter of what the receiver sees of the surface [m]."""
        return 1e-3 * number(dataset, "field_of_view_mrad") * self.height / math.cos(self.off_nadir)

    def system(self, dataset: xr.Dataset, efficiency: float | None) -> LidarSystem:
        """Return the lidar equation's system, its energy being that which the receiver's field of view holds."""
        energy = 1e-3 * number(dataset, "pulse_energy_mj") * _efficiency(dataset, efficiency) * _in_view(dataset)
        return LidarSystem(
            self.height, self.off_nadir, energy, number(dataset, "aperture_area"), self.index, self.group
        )


def _in_view(dataset: xr.Dataset) -> float:
    """Return the part of a Gaussian beam inside the receiver's field of view."""
    half = number(dataset, "field_of_view_mrad") / number(dataset, "divergence_mrad")
    if dataset.attrs.get("field_of_view_shape", "circle") == "circle":
        return 1 - math.exp(-0.5 * half**2)
    return math.erf(half / math.sqrt(2)) ** 2


def _efficiency(dataset: xr.Dataset, given: float | None) -> float:
    if given is not None:
        with readable_errors():
            return in_range("efficiency", given, 0, 1)
    try:
        optics, air = (
            float(dataset.attrs[f"scene.{name}"])
            for name in ("optical_efficiency", "two_way_atmospheric_transmittance")
        )
    except (KeyError, ValueError):
        raise UserError("efficiency must be given: the dataset does not tell those of the optics and the air") from None
    return optics**2 * air


def number(dataset: xr.Dataset, name: str) -> float:
    """Return an attribute that must be a number of at least 0, or raise `UserError`."""
    value = dataset.attrs.get(name)
    if not isinstance(value, (int, float)) or not math.isfinite(value) or value < 0:
        raise UserError(f"the attribute {name} = {value!r} of the dataset must be a number of at least 0")
    return float(value)
