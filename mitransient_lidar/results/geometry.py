"""Lidar geometry and other numbers, read back from a dataset's coordinates and attributes.

A pixel's line of sight is the mean direction from which it sees light directly, weighted with the beam. A result has,
over its pixels, the coordinates ``sight_x`` and ``sight_y`` [mrad], ``off_nadir`` [degree], ``surface_time`` and
``surface_spread`` [ns], ``depth_per_ns`` [m/ns] and ``beam_share``; see `LinesOfSight`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, in_range
from mitransient_lidar.physics.lidar import level_sea
from mitransient_lidar.physics.lidar.pose import Pose
from mitransient_lidar.physics.lidar.pulse import Pulse
from mitransient_lidar.results.attributes import described

Attributes = Mapping[str, Any]

#: Decimals kept in the coordinates of `LinesOfSight`.
_SIGHT = {
    **{"sight_x": 6, "sight_y": 6, "off_nadir": 7, "surface_time": 6, "surface_spread": 6},
    **{"depth_per_ns": 10, "beam_share": 9},
}


@dataclass(frozen=True)
class LinesOfSight:
    """Pixel lines of sight over a level sea: arrays with one shape, such as (pixels,)."""

    #: Tangent-plane angles about the receiver's axis [rad].
    sight_x: FloatArray
    sight_y: FloatArray
    off_nadir: FloatArray  #: Angle from the vertical in air [rad].
    #: Echo arrival from the mean sea level [ns], the zero of depth, and its standard deviation over the pixel's direct
    #: light.
    surface_time: FloatArray
    surface_spread: FloatArray
    #: Depth per delay [m/ns]: c0 cos(theta_water)/(2 n_g) with transmitter and receiver at one location.
    depth_per_ns: FloatArray
    beam_share: FloatArray  #: Share of the beam's energy in the pixel, 0 to 1; NaN if unknown.

    @classmethod
    def from_dataset(cls, dataset: xr.Dataset, dims: tuple[str, ...] | None = None) -> LinesOfSight:
        """Read the lines of sight in a result or gate stack.

        Without their coordinates, they go to the pixel centres, with the mean arrival in the attribute
        ``surface_time_ns`` if it is known. Arrays have the dimensions `dims`, flattened to one, by default the pixels':
        ``pixel``, or ``row`` and ``column``. Raises `UserError` if coordinates and attributes do not determine the
        geometry.
        """
        if dims is None:
            dims = ("row", "column") if "row" in dataset.dims else ("pixel",)
        shape = tuple(dataset.sizes[dim] for dim in dims)

        def coordinate(name: str) -> FloatArray:
            values = dataset[name]
            axes = {dim: size for dim, size in zip(dims, shape, strict=True) if dim not in values.dims}
            return np.asarray(values.expand_dims(axes).transpose(*dims).values, dtype=np.float64).ravel()

        if all(name in dataset.coords for name in _SIGHT):
            found = {name: coordinate(name) for name in _SIGHT}
            found["off_nadir"] = np.radians(found["off_nadir"])
            return cls(**found | {name: 1e-3 * found[name] for name in ("sight_x", "sight_y")})
        axis = lidar_geometry(dataset.attrs)
        known = "angle_x" in dataset.coords and "angle_y" in dataset.coords
        count = math.prod(shape)
        x, y = (1e-3 * coordinate(name) if known else np.zeros(count) for name in ("angle_x", "angle_y"))
        pose = pose_of(dataset.attrs) or Pose.from_angles(axis.height, math.degrees(axis.off_nadir))
        down = -pose.directions(np.stack([x, y], axis=1))[:, 2]
        if np.any(down <= 0):
            raise UserError("angle_x and angle_y must point below the horizon: the lines of sight must meet the sea")
        off_nadir = np.arccos(np.minimum(down, 1))
        time = level_sea.surface_time_ns(axis.height, off_nadir)
        measured = optional_number(dataset.attrs, "surface_time_ns")
        if measured is not None:
            time = time + measured - time.mean()
        water = np.cos(level_sea.snell(off_nadir, axis.refractive_index))
        unknown = np.full(count, np.nan)
        return cls(x, y, off_nadir, time, np.zeros(count), axis.metres_per_ns * water, unknown)

    def coordinates(self, dims: tuple[str, ...], shape: tuple[int, ...]) -> dict[str, Any]:
        """Return the coordinates for a dataset over dimensions with a shape, rounded so that files stay small."""
        values = vars(self) | {"off_nadir": np.degrees(self.off_nadir)}
        values |= {name: 1e3 * values[name] for name in ("sight_x", "sight_y")}
        return {
            name: (dims, np.round(values[name], digits).reshape(shape), described(name))
            for name, digits in _SIGHT.items()
        }

    def at(self, index: slice | npt.NDArray[np.intp]) -> LinesOfSight:
        """Return some lines of sight."""
        return LinesOfSight(**{name: values[index] for name, values in vars(self).items()})

    def combined(self) -> LinesOfSight:
        """Return the line of sight for the pixel sum, weighted with the beam, shape (1,)."""
        known = np.isfinite(self.beam_share).all() and self.beam_share.sum() > 0
        weight = (
            self.beam_share / self.beam_share.sum() if known else np.ones(self.off_nadir.shape) / self.off_nadir.size
        )
        mean = {name: np.array([np.sum(weight * values)]) for name, values in vars(self).items()}
        apart = np.sum(weight * (self.surface_time - mean["surface_time"]) ** 2)
        mean["surface_spread"] = np.sqrt(np.sum(weight * self.surface_spread**2, keepdims=True) + apart)
        return LinesOfSight(**mean | {"beam_share": np.array([self.beam_share.sum()])})

    def reshaped(self, shape: tuple[int, ...]) -> LinesOfSight:
        """Return the lines of sight in arrays with another shape."""
        return LinesOfSight(**{name: values.reshape(shape) for name, values in vars(self).items()})

    def depth_of_time(self, time_ns: npt.ArrayLike) -> FloatArray:
        """Return the depths [m] below the mean sea level for echoes at times [ns], shape (pixels, ...)."""
        return self.depth_of_delay(np.asarray(time_ns, np.float64) - _columns(self.surface_time, np.ndim(time_ns)))

    def depth_of_delay(self, delay_ns: npt.ArrayLike) -> FloatArray:
        """Return the depths [m] for delays from the surface [ns], shape (pixels, ...)."""
        return np.asarray(np.asarray(delay_ns, np.float64) * _columns(self.depth_per_ns, np.ndim(delay_ns)))

    def time_of_depth(self, depth: npt.ArrayLike) -> FloatArray:
        """Return the arrival times [ns] for echoes from depths [m] below the mean sea level, shape (pixels, ...)."""
        size = max(np.ndim(depth), 1)
        delay = np.asarray(depth, np.float64) / _columns(self.depth_per_ns, size)
        return np.asarray(_columns(self.surface_time, size) + delay)

    def spreading(self, geometry: level_sea.LidarGeometry, time_ns: FloatArray) -> FloatArray:
        """Return the aperture's solid angle at times [ns], shape (time,), relative to the surface; 1 above it.

        The shape is (pixels, time). The geometry provides the height and the refractive index.
        """
        depth = np.maximum(self.depth_of_time(np.broadcast_to(time_ns, (self.off_nadir.size, time_ns.size))), 0)
        theta = self.off_nadir[:, np.newaxis]
        at, n = level_sea.solid_angle_per_area, geometry.refractive_index
        return np.asarray(at(geometry.height, depth, theta, n) / at(geometry.height, 0.0, theta, n))


def lidar_geometry(
    attributes: Attributes, *, surface: Literal["any", "level", "measured"] = "any"
) -> level_sea.LidarGeometry:
    """Read a lidar's geometry from a result's attributes.

    They are ``altitude`` [m], ``off_nadir_deg``, ``refractive_index``, ``group_index`` and, optionally,
    ``surface_time_ns``, the mean arrival over the pixels. This is the surface echo time if `surface` is ``measured``.
    With ``level``, it is the mean sea level's on the axis, and with ``any`` the first of these that is known. Raises
    `UserError` if an attribute is missing, negative, no number or out of range, or the lidar is under water.
    """
    if surface == "measured":
        required_number(attributes, "surface_time_ns")
    if (height := optional_number(attributes, "altitude")) is not None and height < 0:
        raise UserError(f"altitude = {height:g} is under water: this needs a lidar above the sea")
    names = ("altitude", "off_nadir_deg", "refractive_index", "group_index")
    height, degrees, refractive_index, group_index = (required_number(attributes, name) for name in names)
    measured = None if surface == "level" else optional_number(attributes, "surface_time_ns")
    time = math.nan if measured is None else measured
    return level_sea.LidarGeometry(height, math.radians(degrees), refractive_index, group_index, surface_time_ns=time)


def lidar_system(attributes: Attributes, efficiency: float | None = None) -> level_sea.LidarSystem:
    """Return the lidar equation's system, with the whole beam's energy and the open aperture area.

    The efficiency, 0 to 1, includes transmitter, receiver and two-way atmospheric transmittance; by default it is the
    attribute ``two_way_efficiency``. `share_in_view` is the share of the energy that the pixels see. Raises `UserError`
    if the efficiency is out of range or unknown, or another attribute is missing.
    """
    energy = 1e-3 * required_number(attributes, "pulse_energy_mj") * two_way_efficiency(attributes, efficiency)
    geometry = lidar_geometry(attributes)
    blocked = in_range("obscuration", optional_number(attributes, "obscuration") or 0.0, 0, 1)
    area = required_number(attributes, "aperture_area") * (1 - blocked)
    return level_sea.LidarSystem(**vars(geometry), energy=energy, aperture_area=area)


def spot_diameter(attributes: Attributes) -> float:
    """Return the receiver's field-of-view diameter on the sea surface [m]."""
    return 1e-3 * required_number(attributes, "field_of_view_mrad") * lidar_geometry(attributes).slant_range


def pose_of(attributes: Attributes, name: str = "receiver_pose") -> Pose | None:
    """Return the receiver's pose, or ``transmitter_pose``, for a result that has it among its attributes."""
    given = attributes.get(name, ())
    return Pose(*np.reshape(np.asarray(given, dtype=np.float64), (4, 3))) if len(given) == 12 else None


def _columns(values: FloatArray, dimensions: int) -> FloatArray:
    """Return pixel values for arrays with so many dimensions, the pixels first."""
    return values.reshape(-1, *(1,) * (dimensions - 1))


def share_in_view(dataset: xr.Dataset) -> FloatArray:
    """Return the share of the beam's energy in all pixels in a result over ``pixel``, shape () or (shots,).

    It is the sum over the coordinate ``beam_share``: light that overlapping pixels share counts in each, as in their
    waveforms' sum. Without the coordinate, it is a Gaussian beam's share in the middle of a full field of view.
    """
    if "beam_share" in dataset.coords and "pixel" in dataset["beam_share"].dims:
        share = np.asarray(dataset["beam_share"].sum("pixel", skipna=False).values, dtype=np.float64)
        if np.isfinite(share).all():
            return share
    half = required_number(dataset.attrs, "field_of_view_mrad") / required_number(dataset.attrs, "divergence_mrad")
    if dataset.attrs.get("field_of_view_shape", "circle") == "circle":
        return np.asarray(1 - math.exp(-0.5 * half**2))
    return np.asarray(math.erf(half / math.sqrt(2)) ** 2)


def two_way_efficiency(attributes: Attributes, given: float | None = None) -> float:
    """Return a given efficiency for optics and atmosphere, or the lidar's; see `lidar_system`."""
    if given is not None:
        return in_range("efficiency", given, 0, 1)
    if "two_way_efficiency" not in attributes:
        raise UserError("efficiency must be given: the dataset has no attribute two_way_efficiency")
    return required_number(attributes, "two_way_efficiency")


def pulse_of(attributes: Attributes) -> Pulse:
    """Return a result's transmitted pulse: its samples, or a Gaussian with its width."""
    if {"pulse_times_ns", "pulse_power"} <= set(attributes):
        return Pulse.sampled(attributes["pulse_times_ns"], attributes["pulse_power"])
    return Pulse.gaussian(required_number(attributes, "pulse_fwhm_ns"))


def optional_number(attributes: Attributes, name: str) -> float | None:
    """Return an attribute that is a finite number, or None."""
    value = attributes.get(name)
    return float(value) if isinstance(value, (int, float, np.number)) and math.isfinite(value) else None


def required_number(attributes: Attributes, name: str, usual: float | None = None) -> float:
    """Return an attribute that is a number of at least 0, or the usual one; raise `UserError` otherwise."""
    if name not in attributes:
        if usual is not None:
            return usual
        raise UserError(f"the dataset has no attribute {name}")
    number = optional_number(attributes, name)
    if number is None or number < 0:
        raise UserError(f"the attribute {name} = {attributes[name]!r} of the dataset must be a number of at least 0")
    return number
