"""LAS files of a flight that other programs open: points, and points with their waveforms.

Both are LAS 1.4 (R15). They are made from the points of a whole flight, chunk by chunk, and replace former files when
they are complete.
"""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Union

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import open_file, replacing, together
from mitransient_lidar.core.validation import finite_array, integer, positive
from mitransient_lidar.flights.las_header import EXTRA_BYTES, SCALE_M, TIME_NOTES, coordinate_system_wkt, las_header
from mitransient_lidar.flights.poses.records import ADJUSTMENT_S
from mitransient_lidar.flights.waveform_packets import PacketWriter
from mitransient_lidar.results.attributes import PointClass

if TYPE_CHECKING:
    import laspy

_MOST_POINTS = 2**32 - 1  # what programs with 32-bit counters open
#: Most scanner channels, and returns of a pulse in one of them.
MOST_CHANNELS, MOST_RETURNS = 4, 15
_SCAN_ANGLE_DEG = 0.006
_LAST_INTENSITY = 2**16 - 1

Chunks = Union["xr.Dataset", Iterable["xr.Dataset"]]


def write_points(path: str | os.PathLike[str], points: Chunks, crs: str | None = None) -> int:
    """Write points in format 6 of LAS 1.4; compressed (LAZ) if the suffix is .laz.

    Parameters
    ----------
    path : path-like
        File, .las or .laz.
    points : xr.Dataset or iterable of xr.Dataset
        Points of the flight, or chunks, one in memory at a time. Variables over ``point``:

        - ``x``, ``y``, ``z``: coordinates [m] in `crs`;
        - ``gps_time``: pulse time [s]; its attribute ``time_system``, from `poses.records.TIME_SYSTEMS`, is ``flight``
          by default. Those since 1980 become adjusted standard GPS times;
        - ``kind``: class, 0 to 255: 1 an object above the water, 2 land, 40 bottom, 41 water surface, 43 submerged
          object, 45 no bottom found. The last is flagged as synthetic, since no echo is there. The attribute
          ``object_class``, 46 or 64, replaces class 43, submerged vegetation, in files;
        - ``intensity``: amplitude, with the attributes ``full_scale``, which becomes 65535, and ``units``; larger ones
          are clipped, negative and missing ones are 0. The scale is that of the first chunk;
        - ``channel``: scanner channel, 0 to 3: the pixel, or a group of pixels where more than four are;
        - ``return_number``, ``number_of_returns``: 1 to 15, of a pulse in a channel;
        - ``scan_angle_deg``: pulse angle from nadir, -180 to 180, positive right of the heading;
        - ``line``: number of the flight line, 0 to 65535;
        - ``transmitter``, the user data: 0 green, also if it is missing, 1 the infrared channel;
        - ``pixel``, 0 to 65535, and ``shot``, 0 to 2^32 - 1;
        - ``quality``: sum of `products.Quality`, 0 to 255; ``withheld``: whether maps should leave the point out;
        - ``depth``, negative on land, ``depth_uncertainty``, ``horizontal_uncertainty``, ``vertical_uncertainty`` [m],
          and, if there are any, ``pseudo_reflectance``, ``optical_depth`` and ``class_probability``; NaN if unknown.
    crs : str, optional
        Projected coordinate system in metres, such as 'EPSG:32633' or 'EPSG:32633+5773'; otherwise the scene's frame.

    Returns
    -------
    int
        Number of points.

    Raises
    ------
    UserError
        If the suffix or coordinate system is unknown or unsuitable, or there is no point or more than 2^32 - 1. If a
        coordinate is not finite or farther than 2147 km from the first point, or another value is out of range.
    WriteError
        If the operating system reports an error.
    """
    path = _checked(path, ".las", ".laz")
    first, chunks = _first(points)
    wkt = coordinate_system_wkt(crs, _place(first))
    with replacing(path) as temporary:
        header = las_header(6, _place(first), wkt, _notes(first), time_system=_time_system(first))
        return _write(temporary, header, ((chunk, {}) for chunk in chunks))


def write_waveforms(path: str | os.PathLike[str], points: Chunks, waveforms: Chunks, crs: str | None = None) -> int:
    """Write points in LAS 1.4 format 9, uncompressed, and their waveforms beside it in a .wdp file.

    Parameters
    ----------
    path : path-like
        File, .las.
    points : xr.Dataset or iterable of xr.Dataset
        As in `write_points`, with ``packet``, ``time_in_packet_ns``, ``direction`` and optionally ``group_speed``
        (`PacketWriter.append`).
    waveforms : xr.Dataset or iterable of xr.Dataset
        Waveforms (`PacketWriter.append`) that `points` refer to; a chunk for each chunk of points, which counts its
        packets from 0.
    crs : str, optional
        As in `write_points`.

    Returns
    -------
    int
        Number of points.

    Raises
    ------
    UserError
        As in `write_points`, and if waveforms differ in gain, offset or spacing, are out of range, or longer than those
        of the first chunk.
    WriteError
        If the operating system reports an error.
    """
    path = _checked(path, ".las")
    (first, chunks), (first_waveforms, packets) = _first(points), _first(waveforms)
    wkt = coordinate_system_wkt(crs, _place(first))
    with together(), replacing(path) as las, replacing(path.with_suffix(".wdp")) as wdp, open(wdp, "wb") as file:
        writer = PacketWriter(file, first_waveforms)
        about = _place(first), wkt, _notes(first), writer.descriptor
        header = las_header(9, *about, time_system=_time_system(first))
        pairs = zip(chunks, packets, strict=True)
        count = _write(las, header, ((chunk, writer.append(packet, chunk)) for chunk, packet in pairs))
        writer.finish()
    return count


def read_las(path: Path) -> xr.Dataset:
    """Return a LAS or LAZ file's coordinates [m], classes and, if known, stated vertical errors [m].

    Variables over ``point``: ``x``, ``y``, ``z``, ``kind``, and ``vertical_uncertainty``.
    """
    import laspy

    _checked(path, ".las", ".laz", doing="read")
    try:
        with open_file(path) as file:
            found = laspy.read(file)
    except (laspy.LaspyException, RuntimeError, ValueError) as error:
        raise UserError(f"{path} is no LAS file, or damaged: {error}") from error
    data = {name: np.array(found[name], np.float64) for name in "xyz"} | {"kind": np.array(found["classification"])}
    if "vertical_uncertainty" in found.point_format.dimension_names:
        data["vertical_uncertainty"] = np.array(found["vertical_uncertainty"], np.float64)
    return xr.Dataset({name: ("point", values) for name, values in data.items()})


def _checked(path: str | os.PathLike[str], *suffixes: str, doing: str = "write") -> Path:
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise UserError(f"cannot {doing} {path}: its suffix must be {' or '.join(suffixes)}")
    return path


def _first(given: Chunks) -> tuple[xr.Dataset, Iterator[xr.Dataset]]:
    """Return the first chunk, and all chunks from it on."""
    chunks = iter([given] if isinstance(given, xr.Dataset) else given)
    first = next(chunks, None)
    if first is None or not all(first.sizes.values()):
        raise UserError("there is no point to write, or the first chunk of points or waveforms is empty")
    return first, chain([first], chunks)


def _place(first: xr.Dataset) -> tuple[float, float]:
    """Return x and y of the first point."""
    x, y = (float(finite_array(name, first[name].values[:1])[0]) for name in ("x", "y"))
    return x, y


def _time_system(first: xr.Dataset) -> str:
    """Return the points' time system."""
    return str(first["gps_time"].attrs.get("time_system", "flight"))


def _object_class(points: xr.Dataset) -> int:
    """Return the class of echoes between surface and bottom."""
    return int(points["kind"].attrs.get("object_class", PointClass.OBJECT))


def _notes(first: xr.Dataset) -> str:
    intensity = first["intensity"].attrs
    step = positive("full_scale", intensity["full_scale"]) / _LAST_INTENSITY
    of_object = _object_class(first)
    objects = "object" if of_object == PointClass.OBJECT else "vegetation"
    return (
        f"Simulated by mitransient-lidar. Intensity: 1 is {step:.9g} {intensity['units']}. "
        f"GPS time: {TIME_NOTES[_time_system(first)]}. "
        f"Class 1 object above the water, 2 land, 40 bottom, 41 water surface, {of_object} submerged {objects}, "
        "45 no bottom found (flagged synthetic: "
        "no echo is there). User data: 0 green, 1 infrared channel. "
        "The scanner channel is the pixel, or one of four pixel groups. "
        "Return numbers count the echoes of a pulse in one channel; the fifteenth may be several. "
        "Quality: 1 saturated, 2 poor fit, 4 corrected depth, 8 beyond the correction table, "
        "16 surface and bottom merged, 32 above the water, 64 class below 90 % probable, 128 surface from infrared. "
        "Points of saturated echoes and poor fits are withheld. "
        "Depths and uncertainties (1 sigma) are NaN where unknown."
    )


def _write(path: Path, header: laspy.LasHeader, chunks: Iterable[tuple[xr.Dataset, dict[str, Any]]]) -> int:
    """Write chunks of points with their waveform fields."""
    import laspy

    compression = {"do_compress": path.suffix.lower() == ".laz", "laz_backend": laspy.LazBackend.Lazrs}
    count, full_scale = 0, None
    with _written(path) as file, laspy.LasWriter(file, header, closefd=False, **compression) as writer:
        for points, fields in chunks:
            count += points.sizes["point"]
            if count > _MOST_POINTS:
                raise UserError(f"more than {_MOST_POINTS} points are too many for one file: split the flight")
            full_scale = full_scale or float(points["intensity"].attrs["full_scale"])
            record = laspy.ScaleAwarePointRecord.zeros(points.sizes["point"], header=header)
            for name, values in (_attributes(points, header.offsets, full_scale) | fields).items():
                record[name] = values
            writer.write_points(record)
    return count


class _RawFile(io.FileIO):
    """File that keeps the error of a write."""

    failure: OSError | None = None

    def write(self, data: Any, /) -> int:
        """Write bytes, as many as fit."""
        try:
            return super().write(data)
        except OSError as error:
            self.failure = error
            raise


@contextlib.contextmanager
def _written(path: Path) -> Iterator[IO[bytes]]:
    """Open a new file; write errors are raised as they were; lazrs alone would hide their kind."""
    raw = _RawFile(path, "wb")
    try:
        with io.BufferedWriter(raw) as file:
            yield file
    except RuntimeError as error:
        raise raw.failure or error from None


def _attributes(points: xr.Dataset, offsets: Iterable[float], full_scale: float) -> dict[str, npt.NDArray[Any]]:
    """Return a chunk's values by laspy's field names."""
    returns = _whole(points, "number_of_returns", 1, MOST_RETURNS)
    number = _whole(points, "return_number", 1, MOST_RETURNS)
    if np.any(number > returns):
        bad = np.argmax(number > returns)
        raise UserError(f"return_number = {number[bad]} must be at most number_of_returns, {returns[bad]}")
    kind = _whole(points, "kind", 0, 255)
    angle = finite_array("scan_angle_deg", points["scan_angle_deg"].values)
    if np.any(np.abs(angle) > 180):
        raise UserError(f"scan_angle_deg = {angle[np.argmax(np.abs(angle))]:g} must lie between -180 and 180")
    scaled = np.nan_to_num(points["intensity"].values / full_scale, nan=0.0)
    unknown = np.full(kind.shape, np.nan)
    names = [item.name for item in EXTRA_BYTES if item.dtype == "f4"]
    extra = {name: points[name].values if name in points else unknown for name in names}
    return {
        **{name: _coordinate(points, name.lower(), offset) for name, offset in zip("XYZ", offsets, strict=True)},
        "gps_time": finite_array("gps_time", points["gps_time"].values)
        - ADJUSTMENT_S * (_time_system(points) == "gps"),
        "classification": np.where(kind == PointClass.OBJECT, _object_class(points), kind),
        "synthetic": kind == PointClass.NO_ECHO,
        "withheld": points["withheld"].values,
        "quality": _whole(points, "quality", 0, 255),
        "intensity": np.round(np.clip(scaled, 0, 1) * _LAST_INTENSITY),
        "scanner_channel": _whole(points, "channel", 0, MOST_CHANNELS - 1),
        "return_number": number,
        "number_of_returns": returns,
        "scan_angle": np.round(angle / _SCAN_ANGLE_DEG),
        "point_source_id": _whole(points, "line", 0, 2**16 - 1),
        "pixel": _whole(points, "pixel", 0, 2**16 - 1),
        "shot": _whole(points, "shot", 0, 2**32 - 1),
        "user_data": _whole(points, "transmitter", 0, 255) if "transmitter" in points else np.zeros(kind.shape),
        **extra,
    }


def _coordinate(points: xr.Dataset, name: str, offset: float) -> npt.NDArray[np.int32]:
    values = finite_array(name, points[name].values)
    steps = np.round((values - offset) / SCALE_M)
    outside = np.abs(steps) > 2**31 - 1
    if np.any(outside):
        raise UserError(
            f"{name} = {values[outside][0]:g} m must be within 2147 km of {offset:g} m: LAS has 32 bits for millimetres"
        )
    return steps.astype(np.int32)


def _whole(points: xr.Dataset, name: str, low: int, high: int) -> npt.NDArray[Any]:
    """Return integers in [low, high]."""
    values = points[name].values
    suspects = [*values[np.mod(values, 1) != 0][:1], values.min(), values.max()] if values.size else []
    for value in suspects:
        integer(name, value, low, high)
    return values
