"""Reading of depth surveys: tables of points, and Bathymetric Attributed Grids (BAG)."""

from __future__ import annotations

import itertools
import os
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from mitransient_lidar.core.array_files import Grid, check_hdf5, check_size, damaged_file
from mitransient_lidar.core.documents import check_xml
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import open_file
from mitransient_lidar.core.validation import FloatArray, positive

#: Largest table of points [bytes], and most points in it.
_LARGEST_TABLE, _MOST_POINTS = 2**29, 10**7

#: Beginning of a table in which its heading and its separator are found [bytes].
_HEAD = 2**16

_COMMENTS = ("#", "//", "%", "!")

#: Names of the columns x, y and z in a heading, in lower case, and those of angles, which are refused.
_NAMES = (("x", "easting", "east", "e"), ("y", "northing", "north", "n"), ("z", "height", "elevation", "depth", "h"))
_ANGLES = frozenset({"lat", "latitude", "lon", "long", "longitude"})

#: Value of BAG cells without a measurement.
_BAG_EMPTY = 1e6

#: Largest metadata of a BAG file [bytes].
_LARGEST_METADATA = 2**24

#: Largest deviation of the corners of a BAG file from its cells, in cells.
_CORNER_TOLERANCE = 0.1


def read_points(path: Path) -> FloatArray:
    """Read a table of points.

    Columns are separated by commas, semicolons or blanks, in metres. A heading, which may be a comment (#, //, %, !),
    names them: x, y and z, or easting, northing, and height, elevation or depth. Without one they are the first three.
    Rows without a height (nan) are left out.

    Returns
    -------
    ndarray
        x, y and z as in the file, shape (points, 3).

    Raises
    ------
    UserError
        If the file is larger than 512 MiB, has more than 10^7 points, fewer than three columns, or entries that are not
        numbers; its columns are angles; or a position is not finite.
    """
    with open_file(path) as file:
        if (size := os.fstat(file.fileno()).st_size) > _LARGEST_TABLE:
            raise UserError(
                f"{path} has {size / 2**20:.4g} MiB: a table of points may have {_LARGEST_TABLE / 2**20:g} MiB."
            )
        head = file.read(_HEAD).decode("utf-8-sig", "replace").splitlines()
    columns, skipped, separator = _layout(path, head)
    try:
        with path.open(encoding="utf-8-sig") as file:
            # NumPy warns of tables without rows, and of blank lines.
            rows = filter(_is_row, itertools.islice(file, skipped, None))
            first, points = list(itertools.islice(rows, 1)), np.empty((0, 3))
            if first:
                chosen = itertools.chain(first, itertools.islice(rows, _MOST_POINTS))
                points = np.loadtxt(chosen, delimiter=separator, usecols=columns, comments=_COMMENTS, ndmin=2)
    except (ValueError, OverflowError) as error:
        raise UserError(f"{path} is not a table of points x, y and z: {' '.join(str(error).split())[:200]}.") from error
    if len(points) > _MOST_POINTS:
        raise UserError(f"{path} has more than {_MOST_POINTS} points, the most of a table.")
    points = points[~np.isnan(points[:, 2])]
    for row in np.flatnonzero(~np.isfinite(points).all(axis=1))[:1]:
        raise UserError(f"{path} has the point {', '.join(f'{one:g}' for one in points[row])}: points must be finite.")
    return points


def _is_row(line: str) -> bool:
    """Return whether a line of a table is neither blank nor a comment."""
    text = line.strip()
    return bool(text) and not text.startswith(_COMMENTS)


def _layout(path: Path, head: list[str]) -> tuple[tuple[int, ...], int, str | None]:
    """Return the columns of x, y and z, the lines above the first row, and the separator, None for blanks."""
    comment = ""
    for number, line in enumerate(head):
        text = line.strip()
        mark = next((one for one in _COMMENTS if text.startswith(one)), None)
        if mark is not None:
            comment = text.lstrip("#/%! ")
            continue
        if not text:
            continue
        separator = next((one for one in ";," if one in text), None)
        if all(map(_is_number, text.split(separator)[:3])):
            names = _columns(path, comment, next((one for one in ";," if one in comment), None))
            return names or (0, 1, 2), number, separator
        names = _columns(path, text, separator)
        if names is None:
            raise UserError(
                f"{path}, line {number + 1}: {text[:80]!r} must be numbers, or names x, y and z of columns."
            )
        return names, number + 1, separator
    raise UserError(f"{path} has no points.")


def _columns(path: Path, heading: str, separator: str | None) -> tuple[int, ...] | None:
    """Return the columns that a heading names x, y and z, None if it is no heading."""
    words = [re.split(r"[\s_\[(]", word.strip(" \"'").lower())[0] for word in heading.split(separator)]
    if any(word in _ANGLES for word in words):
        raise UserError(f"{path} has columns of degrees ({heading[:80]}): positions must be projected, in metres.")
    found = [[i for i, word in enumerate(words) if word in names] for names in _NAMES]
    return tuple(one[0] for one in found) if all(found) else None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def read_bag(path: Path) -> Grid:
    """Read the elevations of a Bathymetric Attributed Grid of one resolution, in projected coordinates [m].

    The format (Open Navigation Surface, "Format Specification Document: Description of Bathymetric Attributed Grid
    Object") is HDF5 with the dataset ``BAG_root/elevation``, positive up, row 0 in the south, 10^6 where there is none,
    and XML in ``BAG_root/metadata`` with the resolutions and the corners of the grid.

    Raises
    ------
    UserError
        If the file is damaged, of variable resolution, in degrees, larger than allowed, or its corners do not agree
        with its cells.
    """
    import h5py

    damaged = f"{path} is damaged, or is not a Bathymetric Attributed Grid."
    with damaged_file(damaged):
        check_hdf5(path)
    with damaged_file(damaged), h5py.File(path, "r") as file:
        root = file["BAG_root"]
        if "varres_refinements" in root:
            raise UserError(
                f"{path} has a variable resolution: a BAG must have one, as it is exported by other programs."
            )
        elevation, metadata = root["elevation"], root["metadata"]
        if elevation.ndim != 2 or elevation.dtype.kind != "f":
            raise UserError(damaged)
        check_size(path, 8.0 * elevation.size)
        check_size(path, float(metadata.size * metadata.dtype.itemsize), _LARGEST_METADATA)
        text = b"".join(np.ravel(metadata[()]).astype("S").tolist())
        values = np.asarray(elevation[()], dtype=np.float64)
        corners, cell = _placement(path, text)
    values[values == _BAG_EMPTY] = np.nan
    first = []
    for axis, count in enumerate(values.shape[::-1]):
        steps = (corners[1][axis] - corners[0][axis]) / positive(f"{path}: resolution", cell[axis])
        # Corners are the centres of cells by the specification, but some programs write their edges.
        inset = next((shift for shift in (0, 1) if abs(steps - count + 1 - shift) < _CORNER_TOLERANCE), None)
        if inset is None:
            raise UserError(
                f"{path} has {count} cells along {'xy'[axis]}, but corners that are {steps:.6g} cells apart."
            )
        first.append(corners[0][axis] + 0.5 * inset * cell[axis])
    return Grid(values, (first[0], first[1]), cell)


def _placement(path: Path, text: bytes) -> tuple[list[tuple[float, float]], tuple[float, float]]:
    """Return the corners (x, y) [m] in south-west and north-east, and the resolution along x and y [m]."""
    if b"GEOGCS" in text and b"PROJCS" not in text:
        raise UserError(f"{path} has coordinates in degrees: they must be projected, in metres.")
    text = text.rstrip(b"\0")
    check_xml(text, f"{path}: its metadata")
    tree = ElementTree.fromstring(text)
    words = "".join(_first(tree, "cornerPoints").itertext()).split()
    corners = [(float(x), float(y)) for x, y in (word.split(",")[:2] for word in words)]
    sizes = [_dimension(one) for one in tree.iter() if _name(one) == "MD_Dimension"]
    named = dict(sizes)
    rows, columns = (named.get(name, sizes[i][1]) for i, name in enumerate(("row", "column")))
    return [corners[0], corners[1]], (columns, rows)


def _dimension(element: Any) -> tuple[str, float]:
    """Return the name of a dimension, row or column, and its resolution."""
    name = _first(element, "dimensionName")
    words = "".join(name.itertext()) + " ".join(value for one in name.iter() for value in one.attrib.values())
    kind = "column" if "column" in words.lower() else "row"
    return kind, float("".join(_first(element, "resolution").itertext()))


def _first(element: Any, name: str) -> Any:
    return next(one for one in element.iter() if _name(one) == name)


def _name(element: Any) -> str:
    """Return the name of an element without its namespace, which differs by version."""
    return str(element.tag).rpartition("}")[2]
