"""LAS 1.4 header: coordinate system, extra bytes and notes, as records that the specification names."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from mitransient_lidar._version import __version__
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.maps import map_system, parsed_system

if TYPE_CHECKING:
    import laspy

SCALE_M = 0.001  #: Unit of the integer coordinates [m].

#: Coordinate system of the scene, for a flight without one on the Earth.
SCENE_WKT = (
    'LOCAL_CS["mitransient-lidar scene",LOCAL_DATUM["mean sea level",0],UNIT["metre",1],'
    'AXIS["x",EAST],AXIS["y",NORTH],AXIS["z",UP]]'
)

#: What the times of points are, by their system (`poses.records.TIME_SYSTEMS`).
TIME_NOTES = {
    "flight": "seconds as in the trajectory of the flight, not of a known GPS week",
    "gps_week": "seconds of the GPS week",
    "gps": "adjusted standard GPS time, seconds since 6 January 1980 less 1e9",
    "adjusted_gps": "adjusted standard GPS time, seconds since 6 January 1980 less 1e9",
}

_DESCRIPTOR = struct.Struct("<2xBB32s4xd16x8x16x8x16x8x16x8x16x32s")
_SOFTWARE = "mitransient-lidar"
_NO_DATA = 1  # bit of the options: the value for missing data is relevant


class ExtraBytes(NamedTuple):
    """One point attribute beyond the point format."""

    name: str
    dtype: str  #: Type in NumPy's notation.
    data_type: int  #: Its number in the specification.
    description: str  #: At most 32 characters.


EXTRA_BYTES = (
    ExtraBytes("pixel", "u2", 3, "index of the receiver's pixel"),
    ExtraBytes("shot", "u4", 5, "number of the laser pulse"),
    ExtraBytes("quality", "u1", 1, "bits, see text area description"),
    ExtraBytes("pseudo_reflectance", "f4", 9, "of a Lambertian plane in air [1]"),
    ExtraBytes("optical_depth", "f4", 9, "of the water column, one way [1]"),
    ExtraBytes("class_probability", "f4", 9, "of the class, figure of merit [1]"),
    ExtraBytes("depth", "f4", 9, "water depth, positive down [m]"),
    ExtraBytes("depth_uncertainty", "f4", 9, "depth, 1 sigma [m]"),
    ExtraBytes("horizontal_uncertainty", "f4", 9, "horizontal position, 1 sigma [m]"),
    ExtraBytes("vertical_uncertainty", "f4", 9, "z, 1 sigma [m]"),
)


def coordinate_system_wkt(crs: str | None, place: tuple[float, float] | None = None) -> str:
    """Return a coordinate system as WKT by OGC's specification (2001), which LAS 1.4 needs.

    `crs`: what pyproj understands: a code such as 'EPSG:32633' or 'EPSG:32633+5773' (with heights), a WKT. None: the
    scene frame, an engineering system in metres with x east, y north, z up. `place`: point x, y [m] at which its metres
    must be those on the ground.

    Raises `UserError` if the system is unknown, has no such WKT, is not a projected one in metres to east and north, or
    has another scale than the ground.
    """
    if crs is None:
        return SCENE_WKT
    system = parsed_system("crs", crs)
    horizontal = map_system(f"crs = {crs!r}", crs, "crs")
    wkt = str(system.to_wkt("WKT1_GDAL") or "")
    if any(axis.unit_name != "metre" for axis in system.axis_info) or not wkt:
        raise UserError(f"crs = {crs!r} must be a projected coordinate system in metres, such as EPSG:32633")
    if place is not None:
        horizontal.check_scale(f"crs = {crs!r}", *place)
    return wkt


def check_same_system(crs: str, epsg: int) -> None:
    """Raise `UserError` if positions are not in the horizontal part of a `coordinate_system_wkt` system."""
    import pyproj

    whole = pyproj.CRS.from_user_input(crs)
    level = next(iter(whole.sub_crs_list), whole)
    if not level.equals(pyproj.CRS.from_epsg(epsg), ignore_axis_order=True):
        raise UserError(f"epsg = {epsg} of the platform must be the coordinate system of the points, crs = {crs!r}")


def las_header(
    point_format: int,
    first: tuple[float, float],
    wkt: str,
    notes: str,
    descriptor: bytes = b"",
    *,
    time_system: str = "flight",
) -> laspy.LasHeader:
    """Return a LAS 1.4 header.

    `point_format`: 6, or 9 with waveforms in an external file. `first`: first point's coordinates x, y [m]; offsets are
    whole kilometres near it, and 0 for z. `wkt`: coordinate system. `notes`: text for the reader, as Text Area
    Description. `descriptor`: Waveform Packet Descriptor for format 9. `time_system`: pulse time system, from
    `TIME_NOTES`.
    """
    import laspy
    from laspy.header import GpsTimeType

    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.generating_software = f"{_SOFTWARE} {__version__}"[:32]
    header.system_identifier = "SIMULATION"
    header.scales = [SCALE_M] * 3
    header.offsets = [*(1000.0 * math.floor(value / 1000) for value in first), 0.0]
    header.global_encoding.wkt = True
    since_1980 = time_system in ("gps", "adjusted_gps")
    header.global_encoding.gps_time_type = GpsTimeType.STANDARD if since_1980 else GpsTimeType.WEEK_TIME
    if descriptor:  # setting False sets the bit before laspy 2.7
        header.global_encoding.waveform_data_packets_external = True
    header.add_extra_dims([laspy.ExtraBytesParams(name=extra.name, type=extra.dtype) for extra in EXTRA_BYTES])
    # laspy's own record holds minima and maxima, which NaN spoils.
    header.vlrs.extract("ExtraBytesVlr")
    records = [
        ("LASF_Projection", 2112, "OGC coordinate system WKT", wkt.encode() + b"\0"),
        ("LASF_Spec", 3, "Text area description", notes.encode() + b"\0"),
        ("LASF_Spec", 4, "Extra bytes", b"".join(_descriptor(extra) for extra in EXTRA_BYTES)),
    ]
    if descriptor:
        records.append(("LASF_Spec", 100, "Waveform packet descriptor", descriptor))
    header.vlrs.extend(laspy.VLR(*record) for record in records)
    return header


def is_simulated(path: Path) -> bool:
    """Return whether a LAS or LAZ file, perhaps beside a waveform file, has a `las_header` header."""
    points = path.with_suffix(".las") if path.suffix == ".wdp" else path
    if not points.is_file():
        return False
    # The generating software is 58 bytes behind the start.
    with points.open("rb") as file:
        header = file.read(90)
    return header.startswith(b"LASF") and header[58:].startswith(_SOFTWARE.encode())


def _descriptor(extra: ExtraBytes) -> bytes:
    """Return the 192 bytes that describe an attribute; numbers that may be missing are NaN then."""
    missing = extra.dtype == "f4"
    options, no_data = (_NO_DATA, math.nan) if missing else (0, 0.0)
    return _DESCRIPTOR.pack(extra.data_type, options, extra.name.encode(), no_data, extra.description.encode())
