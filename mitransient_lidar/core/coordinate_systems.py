"""Coordinate systems of maps, trajectories and points: axes, units, scale and vertical datum, through pyproj."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import is_there, read_text
from mitransient_lidar.core.validation import FloatArray, shown

#: Largest difference of a projection's scale from 1. UTM zones and national grids have up to 0.003, Mercator's
#: projection beyond 8 degrees of latitude has more.
LARGEST_DISTORTION = 0.01

_METRES_PER_FOOT = 0.3048


class MapSystem(NamedTuple):
    """Projected coordinate system of a map."""

    crs: Any  #: `pyproj.CRS` of the horizontal part; None for an old .prj file, which names units only.
    name: str
    unit: str  #: Unit of positions.
    metres: float  #: Its length [m].
    vertical_unit: str = ""  #: Unit of heights, "" if it is not stated.
    vertical_metres: float = 1.0  #: Its length [m].
    is_down: bool | None = None  #: Whether the vertical axis points down; None without one.
    datum: str = ""  #: Name of the vertical part.

    def check_scale(self, path: object, x: float, y: float) -> None:
        """Refuse a system whose metres at a place (x, y), in its own unit, are not metres on the ground."""
        if self.crs is None:
            return
        import pyproj

        to_degrees = pyproj.Transformer.from_crs(self.crs, self.crs.geodetic_crs, always_xy=True)
        places = [np.atleast_1d(one) for one in to_degrees.transform(x, y)]
        scale = distortions(self.crs, *places)[1][0]
        if not abs(scale - 1) < LARGEST_DISTORTION:
            raise UserError(
                f"{path} has coordinates in {self.name}, whose lengths at ({x:.10g}, {y:.10g}) are {scale:.4g} times"
                f" those on the ground: they must be within {LARGEST_DISTORTION:.0%}, as in UTM."
            )


def parsed_system(name: object, text: Any) -> Any:
    """Return the `pyproj.CRS` of a code, a WKT or attributes; `name` is the parameter or the file, for the message."""
    import pyproj

    try:
        return pyproj.CRS.from_cf(text) if isinstance(text, dict) else pyproj.CRS.from_user_input(text)
    except (pyproj.exceptions.CRSError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{name} = {shown(text)} is no coordinate system that pyproj knows, such as EPSG:32633"
        ) from error


def is_east_north(system: Any) -> bool:
    """Return whether x is east and y north, or both follow meridians near a pole, so that maps are not mirrored."""
    directions = sorted(str(axis.direction) for axis in system.axis_info[:2])
    return directions in (["east", "north"], ["north", "north"], ["south", "south"])


def map_system(path: object, system: Any) -> MapSystem:
    """Return the system of a map.

    Raises
    ------
    UserError
        If its coordinates are degrees or geocentric, or its axes do not point to east and north.
    """
    horizontal, vertical = system, None
    if system.is_compound:
        horizontal, vertical = system.sub_crs_list[0], system.sub_crs_list[1].axis_info[0]
    elif len(system.axis_info) == 3:
        vertical = system.axis_info[2]
    if horizontal.is_bound:
        horizontal = horizontal.source_crs
    name = system.name
    if horizontal.is_geographic:
        raise UserError(f"{path} has coordinates in degrees ({name}): they must be projected, in metres or feet.")
    if not horizontal.is_projected and not horizontal.is_engineering:
        raise UserError(f"{path} has coordinates in {name}: they must be projected, in metres or feet.")
    axes = horizontal.axis_info[:2]
    if horizontal.is_projected and not is_east_north(horizontal):
        directions = " and ".join(str(axis.direction) for axis in axes)
        raise UserError(f"{path} has coordinates in {name}, to {directions}: they must be to east and north.")
    unit, metres = (str(axes[0].unit_name), float(axes[0].unit_conversion_factor)) if axes else ("metre", 1.0)
    found = MapSystem(horizontal if horizontal.is_projected else None, name, unit, metres)
    if vertical is None:
        return found
    return found._replace(
        vertical_unit=str(vertical.unit_name),
        vertical_metres=float(vertical.unit_conversion_factor),
        is_down=str(vertical.direction) == "down",
        datum=system.sub_crs_list[1].name if system.is_compound else f"the ellipsoid of {name}",
    )


def read_prj(path: Path) -> MapSystem | None:
    """Return the system of the file of a grid's name that ends in .prj, None if there is none.

    Such files are WKT, or lines such as ``Projection UTM`` and ``Units METERS`` in an old format of ESRI.
    """
    prj = next((one for one in (path.with_suffix(".prj"), path.with_suffix(".PRJ")) if is_there(one)), None)
    if prj is None:
        return None
    text = read_text(prj).strip()
    if not text.lower().startswith("projection"):
        return map_system(path, parsed_system(prj, text))
    words = [line.split() for line in text.upper().splitlines()]
    old = {line[0]: " ".join(line[1:]) for line in words if len(line) > 1}
    if old["PROJECTION"].startswith("GEO") or old.get("UNITS") in ("DD", "DS", "DMS"):
        raise UserError(f"{path} has coordinates in degrees ({prj}): they must be projected, in metres or feet.")
    lengths = {"METERS": 1.0, "FEET": _METRES_PER_FOOT}
    unit, heights = old.get("UNITS", "METERS"), old.get("ZUNITS", "NO")
    for name, value, allowed in (("Units", unit, lengths), ("Zunits", heights, (*lengths, "NO"))):
        if value not in allowed:
            raise UserError(f"{path} has {name} {value} in {prj}: allowed are {', '.join(allowed)}.")
    stated = {} if heights == "NO" else {"vertical_unit": heights.lower(), "vertical_metres": lengths[heights]}
    return MapSystem(None, old["PROJECTION"], unit.lower(), lengths[unit], **stated)  # type: ignore[arg-type]


def distortions(system: Any, longitude: FloatArray, latitude: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the azimuth of true north from grid north [deg], and the scale of a projection.

    Parameters
    ----------
    system : pyproj.CRS
        Projected coordinate system.
    longitude, latitude : ndarray, shape (n,)
        Positions [deg].

    Returns
    -------
    north, scale : ndarray, shape (n,)
        Azimuths, and lengths in the projection divided by lengths on the ground, along the meridian or the parallel,
        whichever differs more from 1; NaN outside the projection.
    """
    import pyproj

    factors = pyproj.Proj(system).get_factors(longitude, latitude)
    scales = np.stack([factors.meridional_scale, factors.parallel_scale])
    scales[~np.isfinite(scales)] = np.nan
    return -np.asarray(factors.meridian_convergence), np.where(
        abs(scales[0] - 1) > abs(scales[1] - 1), scales[0], scales[1]
    )
