"""Coordinate systems of maps, trajectories and points: axes, units, scale and vertical datum, through pyproj."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, ParamSpec, TypeVar

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import is_there, read_text
from mitransient_lidar.core.validation import FloatArray, shown

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor

_P = ParamSpec("_P")
_T = TypeVar("_T")

#: Largest difference between a projection's scale and 1. UTM zones and national grids have up to 0.003, Mercator's
#: projection beyond 8 degrees latitude has more.
LARGEST_DISTORTION = 0.01

_METRES_PER_FOOT = 0.3048


@functools.cache
def _thread() -> ThreadPoolExecutor:
    """Return the thread in which pyproj reads the systems of maps."""
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(1, "pyproj")


# A forked process has no thread but its own.
os.register_at_fork(after_in_child=_thread.cache_clear)


def _in_one_thread(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Run a function in a lasting thread, and return its result, which must contain no pyproj object.

    Mitsuba reads scenes in threads that end for Python after each plugin. pyproj then destroys its data for the thread,
    and takes them again for the next plugin: the process ended in a segmentation fault.
    """

    @functools.wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        return _thread().submit(function, *args, **kwargs).result()

    return run


class MapSystem(NamedTuple):
    """Projected coordinate system of a map."""

    wkt: str | None  #: WKT of the horizontal part; None for an old .prj file, which names units only.
    name: str
    unit: str  #: Position unit.
    metres: float  #: Its length [m].
    vertical_unit: str = ""  #: Height unit, "" if it is not stated.
    vertical_metres: float = 1.0  #: Its length [m].
    is_down: bool | None = None  #: Whether the vertical axis points down; None without one.
    datum: str = ""  #: Name of the vertical part.

    @_in_one_thread
    def check_scale(self, path: object, x: float, y: float) -> None:
        """Refuse a system whose metres at a place (x, y), in its own unit, are not metres on the ground."""
        if self.wkt is None:
            return
        import pyproj

        crs = pyproj.CRS.from_wkt(self.wkt)
        to_degrees = pyproj.Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
        places = [np.atleast_1d(one) for one in to_degrees.transform(x, y)]
        scale = distortions(crs, *places)[1][0]
        if not abs(scale - 1) < LARGEST_DISTORTION:
            raise UserError(
                f"{path} has coordinates in {self.name}, whose lengths at ({x:.10g}, {y:.10g}) are {scale:.4g} times"
                f" those on the ground: they must be within {LARGEST_DISTORTION:.0%}, as in UTM"
            )

    @_in_one_thread
    def distance_from(self, other: MapSystem, x: float, y: float) -> float:
        """Return the distance between the point x, y [m] in this system and the same numbers in another one [m].

        It is the distance at the farthest corner of a 1 km square at the point.
        """
        if self.wkt is None or other.wkt is None:
            return 0.0
        import pyproj

        x_m, y_m = np.array([x, x + 1e3, x, x + 1e3]), np.array([y, y, y + 1e3, y + 1e3])
        to_other = pyproj.Transformer.from_crs(self.wkt, other.wkt, always_xy=True)
        east, north = to_other.transform(x_m / self.metres, y_m / self.metres)
        return float(np.hypot(other.metres * east - x_m, other.metres * north - y_m).max())


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


@_in_one_thread
def map_system(path: object, text: Any, name: object = None) -> MapSystem:
    """Return a map's system from a code, a WKT or attributes, which belong to `name` or to the map's own file.

    Raises `UserError` if pyproj does not know it, its coordinates are degrees or geocentric, or its axes do not point
    to east and north.
    """
    system = parsed_system(path if name is None else name, text)
    horizontal, vertical = system, None
    if system.is_compound:
        horizontal, vertical = system.sub_crs_list[0], system.sub_crs_list[1].axis_info[0]
    elif len(system.axis_info) == 3:
        vertical = system.axis_info[2]
    if horizontal.is_bound:
        horizontal = horizontal.source_crs
    called = system.name
    if horizontal.is_geographic:
        raise UserError(f"{path} has coordinates in degrees ({called}): they must be projected, in metres or feet")
    if not horizontal.is_projected and not horizontal.is_engineering:
        raise UserError(f"{path} has coordinates in {called}: they must be projected, in metres or feet")
    axes = horizontal.axis_info[:2]
    if horizontal.is_projected and not is_east_north(horizontal):
        directions = " and ".join(str(axis.direction) for axis in axes)
        raise UserError(f"{path} has coordinates in {called}, to {directions}: they must be to east and north")
    unit, metres = (str(axes[0].unit_name), float(axes[0].unit_conversion_factor)) if axes else ("metre", 1.0)
    found = MapSystem(horizontal.to_wkt() if horizontal.is_projected else None, called, unit, metres)
    if vertical is None:
        return found
    return found._replace(
        vertical_unit=str(vertical.unit_name),
        vertical_metres=float(vertical.unit_conversion_factor),
        is_down=str(vertical.direction) == "down",
        datum=system.sub_crs_list[1].name if system.is_compound else f"the ellipsoid of {called}",
    )


def read_prj(path: Path) -> MapSystem | None:
    """Return the system in the .prj file that shares a grid's name, None if there is none.

    Such files are WKT, or lines such as ``Projection UTM`` and ``Units METERS`` in an old format of ESRI.
    """
    prj = next((one for one in (path.with_suffix(".prj"), path.with_suffix(".PRJ")) if is_there(one)), None)
    if prj is None:
        return None
    text = read_text(prj).strip()
    if not text.lower().startswith("projection"):
        return map_system(path, text, prj)
    words = [line.split() for line in text.upper().splitlines()]
    old = {line[0]: " ".join(line[1:]) for line in words if len(line) > 1}
    if old["PROJECTION"].startswith("GEO") or old.get("UNITS") in ("DD", "DS", "DMS"):
        raise UserError(f"{path} has coordinates in degrees ({prj}): they must be projected, in metres or feet")
    lengths = {"METERS": 1.0, "FEET": _METRES_PER_FOOT}
    unit, heights = old.get("UNITS", "METERS"), old.get("ZUNITS", "NO")
    for name, value, allowed in (("Units", unit, lengths), ("Zunits", heights, (*lengths, "NO"))):
        if value not in allowed:
            raise UserError(f"{path} has {name} {value} in {prj}: allowed are {', '.join(allowed)}")
    stated = {} if heights == "NO" else {"vertical_unit": heights.lower(), "vertical_metres": lengths[heights]}
    return MapSystem(None, old["PROJECTION"], unit.lower(), lengths[unit], **stated)  # type: ignore[arg-type]


def distortions(system: Any, longitude: FloatArray, latitude: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the azimuth of true north from grid north [deg], and the scale of a projection, at positions [deg].

    The scale is of lengths in the projection to lengths on the ground, along the meridian or the parallel, whichever
    differs more from 1; NaN outside the projection.
    """
    import pyproj

    factors = pyproj.Proj(system).get_factors(longitude, latitude)
    scales = np.stack([factors.meridional_scale, factors.parallel_scale])
    scales[~np.isfinite(scales)] = np.nan
    return -np.asarray(factors.meridian_convergence), np.where(
        abs(scales[0] - 1) > abs(scales[1] - 1), scales[0], scales[1]
    )
