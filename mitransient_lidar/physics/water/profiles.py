"""Continuous profiles of water: reading from a file, and division into layers within a tolerance."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import checked_path
from mitransient_lidar.core.formats.array_files import read_netcdf, readable_suffix
from mitransient_lidar.core.maps import NO_DATA, undeclared_no_data
from mitransient_lidar.core.tables.headings import METRES, PER_METRE, UNITLESS, Column, read_headings
from mitransient_lidar.core.tables.text_tables import complete_rows, read_table
from mitransient_lidar.core.validation import BoolArray, FloatArray, finite_array, in_range
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.water_types import PETZOLD_BACKSCATTER_RATIO

logger = logging.getLogger(__name__)

COEFFICIENT_FLOOR = 1e-4
"""Attenuation and scattering [1/m] below which tolerances are absolute; pure sea water scatters 20 times as much."""

BACKSCATTERING_FLOOR = 1e-6
"""Backscattering [1/m] below which tolerances are absolute; pure sea water has 1000 times as much."""

THINNEST_LAYER = 1e-6
"""Least layer thickness [m], in steep profiles."""

_PROPERTIES = ("a", "b", "c", "omega")

_COLUMNS = (
    Column("depth", ("d", "dep", "depths", "water depth"), METRES),
    Column("z", (), METRES),
    *(
        Column(name, aliases, PER_METRE, spectral=True, fill_values=True)
        for name, aliases in {
            "a": ("absorption", "absorption coefficient"),
            "b": ("scattering", "scattering coefficient"),
            "c": ("attenuation", "attenuation coefficient", "beam attenuation", "beam attenuation coefficient"),
            "bb": ("backscattering", "backscatter", "backscattering coefficient"),
        }.items()
    ),
    *(
        Column(name, aliases, UNITLESS, spectral=True, fill_values=True)
        for name, aliases in {
            "omega": ("omega0", "w0", "albedo", "single scattering albedo", "b/c"),
            "bb_ratio": ("bb/b", "backscatter ratio", "backscattering ratio"),
        }.items()
    ),
)

#: First words of other columns in probe files.
_OTHER_QUANTITIES = frozenset(
    {
        *("time", "date", "datetime", "timestamp", "hour", "station", "cast", "record", "scan", "index", "flag"),
        *("latitude", "lat", "longitude", "lon", "temperature", "temp", "t", "salinity", "sal", "s", "density"),
        *("pressure", "pres", "p", "conductivity", "cond", "oxygen", "ph", "turbidity", "chlorophyll", "chl", "chla"),
        *("fluorescence", "cdom", "fdom", "par", "kd"),
    }
)

_DISAGREEMENT = 0.02  #: Tolerance, relative to c, of more than two given properties, for rounded decimals.
_BISECTIONS = 20  #: Bisections for the end of a layer that crosses a node.

_Columns = dict[str, FloatArray]


class _RowError(UserError):
    """Invalid row of a profile; readers replace the row number by the line or index in the file."""

    def __init__(self, row: int, text: str) -> None:
        super().__init__(f"{text}, in row {row} counted from 0.")
        self.row, self.text = row, text


@dataclass(frozen=True, eq=False)
class Profile:
    """Inherent optical properties of water that change continuously with depth.

    All coefficients are linear between the nodes, constant above the first and below the last. Read one from a file
    with `read_profile`.

    `depth`: depths of the nodes below the mean sea level [m], at least 0, strictly increasing; N at least 2, shape
    (N,). `absorption`, `scattering`: absorption a and scattering b at the nodes [1/m], at least 0, shape (N,).
    `backscattering`: backscattering bb at the nodes [1/m], from 0 to `scattering`, shape (N,).
    """

    depth: FloatArray
    absorption: FloatArray
    scattering: FloatArray
    backscattering: FloatArray

    def __post_init__(self) -> None:
        for name in ("depth", "absorption", "scattering", "backscattering"):
            values = finite_array(name, getattr(self, name))
            if values.ndim != 1 or values.size < 2 or values.size != np.size(self.depth):
                raise UserError(
                    f"{name} of shape {values.shape} must be a list of one value per depth, of 2 depths or more"
                )
            _require(values >= 0, name + " = {:g} must not be negative", values)
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        z = self.depth
        before = np.append(-1.0, z[:-1])
        _require(z > before, "depth = {:g} m follows {:g} m but depths must increase", z, before)
        b, bb = self.scattering, self.backscattering
        _require(bb <= b, "bb = {:g} 1/m must not exceed b = {:g} 1/m", bb, b)

    @property
    def attenuation(self) -> FloatArray:
        """Beam attenuation coefficient c = a + b at the nodes [1/m], shape (N,)."""
        return self.absorption + self.scattering

    def layers(self, tolerance: float = 0.01) -> WaterColumn:
        """Divide the profile into layers with mean properties.

        From the surface down every layer is as thick as the tolerance allows, also across nodes. For properties that
        change monotonically this gives the least number of layers: ln(q_2/q_1) / ln(1 + 2 tolerance) from q_1 to q_2.
        Other properties need a few percent more.

        `tolerance`: largest relative deviation, 1e-5 to 0.5.

        Result: at every depth attenuation, scattering and backscattering each deviate from the profile by at most
        `tolerance` times the profile's value there. Where `COEFFICIENT_FLOOR` (`BACKSCATTERING_FLOOR`) is larger, it
        replaces this value. Layers with the least thickness `THINNEST_LAYER` are exceptions. Vertical optical depths
        from z = 0 are exact at the edges; within a layer they deviate by at most `tolerance`/2 times the layer's own
        optical depth. The last layer, which has no lower edge, begins where the profile becomes constant.
        """
        tolerance = in_range("tolerance", tolerance, 1e-5, 0.5)
        z, (a, b, bb) = self._varying_part()
        properties = [
            _LayerProperty(z, q, floor, tolerance)
            for q, floor in ((a + b, COEFFICIENT_FLOOR), (b, COEFFICIENT_FLOOR), (bb, BACKSCATTERING_FLOOR))
        ]
        layer_tops = np.array(_layer_tops(z.tolist(), properties))
        absorption, scattering, backscattering = (_means(z, q, layer_tops) for q in (a, b, bb))
        # Rounding of the interpolation may make bb exceed an equal b.
        return WaterColumn(layer_tops, absorption + scattering, scattering, np.minimum(backscattering, scattering))

    def _varying_part(self) -> tuple[FloatArray, FloatArray]:
        """Return the nodes from z = 0 to where the profile becomes constant, shape (M,), and a, b, bb, shape (3, M)."""
        values = np.stack((self.absorption, self.scattering, self.backscattering))
        z = self.depth
        if z[0] > 0:
            z, values = np.append(0.0, z), np.concatenate((values[:, :1], values), axis=1)
        changes = np.flatnonzero(np.any(np.diff(values, axis=1) != 0, axis=0))
        count = changes[-1] + 2 if changes.size else 1
        return z[:count], values[:, :count]


class _LayerProperty:
    """One property along the profile, with its extremes and integral over the current layer.

    The layers follow sequentially: plain floats are faster than NumPy here.
    """

    def __init__(self, depth: FloatArray, values: FloatArray, floor: float, tolerance: float) -> None:
        self.floor, self.tolerance = floor, tolerance
        self.depth: list[float] = depth.tolist()
        self.values: list[float] = values.tolist()
        self.slopes: list[float] = (np.diff(values) / np.diff(depth)).tolist()
        self.low = self.high = self.last = self.integral = 0.0

    def begin(self, segment: int, depth: float) -> float:
        """Begin a layer within a segment; return its largest thickness there [m]."""
        slope = self.slopes[segment]
        q = self.values[segment] + slope * (depth - self.depth[segment])
        self.low = self.high = self.last = q
        self.integral = 0.0
        if slope == 0:
            return float("inf")
        # The mean lies half-way; the lower end determines the tolerance.
        span, floor = 2 * self.tolerance, self.floor
        change = span * max(q, floor) if slope > 0 else max(q - q / (1 + span), span * floor)
        return change / abs(slope)

    def advance(self, segment: int, thickness: float) -> None:
        """Extend the layer to the end of a segment, by `thickness` [m]."""
        q = self.values[segment + 1]
        self.integral += (self.last + q) / 2 * thickness
        self.low, self.high, self.last = min(self.low, q), max(self.high, q), q

    def allows(self, segment: int, thickness: float, total: float) -> bool:
        """Return whether the layer may extend into a segment by `thickness`, to a total thickness `total` [m]."""
        q = self.last + self.slopes[segment] * thickness
        mean = (self.integral + (self.last + q) / 2 * thickness) / total
        low, high = min(self.low, q), max(self.high, q)
        lowest, highest = high - self.tolerance * max(high, self.floor), low + self.tolerance * max(low, self.floor)
        return lowest <= mean <= highest


def _layer_tops(z: list[float], properties: list[_LayerProperty]) -> list[float]:
    """Return the layers' upper edges from z[0] to z[-1], with the last one at z[-1]."""
    layer_tops = []
    start, segment = z[0], 0
    while start < z[-1]:
        layer_tops.append(start)
        while z[segment + 1] <= start:
            segment += 1
        end = start + min([item.begin(segment, start) for item in properties])
        if end >= z[segment + 1]:
            end, segment = _cross_nodes(z, properties, start, segment)
        start = max(end, start + THINNEST_LAYER)
    return [*layer_tops, z[-1]]


def _cross_nodes(z: list[float], properties: list[_LayerProperty], start: float, segment: int) -> tuple[float, int]:
    """Return the end [m] of a layer that extends at least to the next node, and its segment."""
    node = start
    while True:
        for item in properties:
            item.advance(segment, z[segment + 1] - node)
        segment += 1
        node = z[segment]
        if segment == len(z) - 1:
            return node, segment - 1
        full = z[segment + 1] - node
        if not all([item.allows(segment, full, z[segment + 1] - start) for item in properties]):
            break
    allowed, refused = 0.0, full
    for _ in range(_BISECTIONS):
        thickness = (allowed + refused) / 2
        if all([item.allows(segment, thickness, node - start + thickness) for item in properties]):
            allowed = thickness
        else:
            refused = thickness
    return node + allowed, segment


def _means(z: FloatArray, q: FloatArray, layer_tops: FloatArray) -> FloatArray:
    """Return layer means of a piecewise linear property; the last layer has the last node's value."""
    grid = np.union1d(z, layer_tops)
    values = np.interp(grid, z, q)
    pieces = np.diff(grid) * (values[1:] + values[:-1]) / 2
    integrals = np.add.reduceat(pieces, np.searchsorted(grid, layer_tops[:-1]))
    return np.append(integrals / np.diff(layer_tops), q[-1])


def read_profile(path: str | os.PathLike[str], wavelength_nm: float | None = None) -> Profile:
    """Read a profile from a file.

    Parameters
    ----------
    path : path
        ``.csv``, ``.txt``, ``.dat`` or ``.tsv``, a table that `text_tables.read_table` reads, or ``.nc``, NetCDF-4 with
        variables over the dimension ``depth`` or ``z``, whose attributes ``units`` and ``positive`` are read. Column
        names, in any order, with or without unit and wavelength (``depth_m``, ``a532``, ``c(532) 1/m``):

        ``depth`` or ``z``
            depth [m], at least 0; z may also be the height, at most 0;
        ``a``, ``b``, ``c``, ``omega``
            absorption, scattering, attenuation [1/m], at least 0, and albedo b/c, 0 to 1: any two of them. If there
            are more, the first two in this order are used, and the others must agree with them within 2 % of c;
        ``bb`` or ``bb_ratio``
            backscattering [1/m], at most b, or its ratio to b, 0 to 1. Default: the ratio 0.0183.

        Rows are sorted by depth, and rows at one depth are averaged. Rows with missing values are left out; in
        coefficients, -99, -999, -9999 and -99999 count as missing. The log reports all this. Other quantities that a
        probe measures, such as temperature or time, are not used. All other columns are rejected as possible
        misspellings.
    wavelength_nm : float, optional
        Which wavelength [nm] to read from a file with several. Columns without wavelength belong to all.

    Returns
    -------
    Profile
        a, b and bb are linear between the depths of the file.

    Raises
    ------
    UserError
        If the file is missing, damaged or in another format; names or units are unknown, missing or repeated; a value
        is not a number within its range, or contradicts the others; or there are fewer than 2 depths. The message names
        the line, or the index along the dimension.
    """
    path = checked_path("path", path)
    readers = {**dict.fromkeys((".csv", ".txt", ".dat", ".tsv"), _read_text), ".nc": _read_netcdf}
    columns, places = readers[readable_suffix(path, readers, "profile")](path, wavelength_nm)
    try:
        columns = _in_order(path, _checked(path, columns))
    except _RowError as error:
        raise UserError(f"{path}, {places[error.row]}: {error.text}") from None
    if columns["depth"].size < 2:
        raise UserError(f"{path} has {columns['depth'].size} depths but a profile must have at least 2")
    return Profile(**columns)


def _read_text(path: Path, wavelength_nm: float | None) -> tuple[_Columns, list[str]]:
    """Return the columns by name, and the line of each row."""
    table = read_table(path, _COLUMNS, _OTHER_QUANTITIES, wavelength_nm)
    _check_names(path, list(table.columns))
    return table.columns, [f"line {number}" for number in table.lines]


def _read_netcdf(path: Path, wavelength_nm: float | None) -> tuple[_Columns, list[str]]:
    """Return the variables by name, and the index of each row along the dimension."""
    variables = read_netcdf(path).variables
    dimension = "depth" if any(item.dims == ("depth",) for item in variables.values()) else "z"
    profiles = {str(name): item for name, item in variables.items() if item.dims == (dimension,)}
    names = [f"{name} [{units}]" if (units := item.attrs["units"]) else name for name, item in profiles.items()]
    headings = read_headings(path, names, _COLUMNS, _OTHER_QUANTITIES, wavelength_nm)
    columns: _Columns = {}
    for (name, item), heading in zip(profiles.items(), headings, strict=True):
        if heading is not None:
            if item.values.dtype.kind not in "iuf":
                raise UserError(f"{path} has {name} of type {item.values.dtype}, but it must hold real numbers")
            column, values = heading.column.name, item.values.astype(np.float64) * heading.factor
            if (direction := str(item.attrs.get("positive", "")).lower()) in ("up", "down"):
                column, values = "depth", values if direction == "down" else -values
            columns[column] = values
    _check_names(path, list(columns))
    places = [f"index {i} of {dimension}" for i in range(next(iter(columns.values())).size)]
    kept = complete_rows(path, columns, places)
    return {name: values[kept] for name, values in columns.items()}, [places[row] for row in kept]


def _check_names(path: Path, names: list[str]) -> None:
    """Reject missing and contradictory columns."""
    if ("depth" in names) == ("z" in names) or sum(name in _PROPERTIES for name in names) < 2:
        raise UserError(
            f"{path} has the columns {', '.join(names) or 'none'}: needed are depth or z and two of a, b, c, omega"
        )
    if "bb" in names and "bb_ratio" in names:
        raise UserError(f"{path} has the columns bb and bb_ratio, but must have only one of them")


def _checked(path: Path, columns: _Columns) -> _Columns:
    """Return depth, absorption, scattering and backscattering of the rows, as they follow in the file."""
    z = columns.pop("z", None)
    if z is not None:
        heights = bool(np.all(z <= 0) and np.any(z < 0))
        if heights:
            logger.info("%s: z is the height, from %g to %g m", path, z.min(), z.max())
        elif np.any(z < 0):
            _require(z >= 0, "z = {:g} must not be negative, unless all z are heights of at most 0", z)
        columns["depth"] = np.abs(z)
    if suspect := undeclared_no_data(columns["depth"], numbers=NO_DATA[1:]):
        value, times, reason = suspect
        text = f"{times} depths of {value:g} m, {reason}, must not stand for missing values"
        _require(columns["depth"] != value, text, columns["depth"])
    for name, values in columns.items():
        _require(np.isfinite(values), name + " = {:g} must be finite", values)
        _require(values >= 0, name + " = {:g} must not be negative", values)
        if name in ("omega", "bb_ratio"):
            _require(values <= 1, name + " = {:g} must lie between 0 and 1", values)
    a, b = _absorption_scattering(columns)
    bb = columns["bb"] if "bb" in columns else columns.get("bb_ratio", PETZOLD_BACKSCATTER_RATIO) * b
    _require(bb <= b, "bb = {:g} 1/m must not exceed b = {:g} 1/m", bb, b)
    return {"depth": columns["depth"], "absorption": a, "scattering": b, "backscattering": bb}


def _in_order(path: Path, columns: _Columns) -> _Columns:
    """Return the columns by increasing depth, with the rows of one depth averaged."""
    falling = int(np.sum(np.diff(columns["depth"]) < 0))
    depth, index, counts = np.unique(columns["depth"], return_inverse=True, return_counts=True)
    if falling:
        logger.info("%s: sorted by depth, as %d of %d rows lie above the row before", path, falling, index.size)
    if depth.size < index.size:
        logger.warning("%s: %d rows averaged to %d different depths", path, index.size, depth.size)
    averaged = {name: np.bincount(index, values) / counts for name, values in columns.items()}
    # Rounding of the averages may make bb exceed an equal b.
    averaged["backscattering"] = np.minimum(averaged["backscattering"], averaged["scattering"])
    return {**averaged, "depth": depth}


def _absorption_scattering(columns: _Columns) -> tuple[FloatArray, FloatArray]:
    """Return a and b [1/m] from the first two properties; the others must agree with them."""
    first, second, *others = (name for name in _PROPERTIES if name in columns)
    x, y = columns[first], columns[second]
    if second == "c":
        _require(x <= y, first + " = {:g} 1/m must not exceed c = {:g} 1/m", x, y)
        a, b = (x, y - x) if first == "a" else (y - x, x)
    elif first == "a" and second == "omega":
        _require(y < 1, "omega = {:g} must be below 1 if b is to follow from a = {:g} 1/m", y, x)
        a, b = x, x * y / (1 - y)
    elif first == "b":
        _require(y > 0, "omega = {:g} must be greater than 0 if a is to follow from b = {:g} 1/m", y, x)
        a, b = x * (1 - y) / y, x
    else:
        a, b = (x, y) if first == "a" else (x * (1 - y), x * y)
    c = a + b
    for name in others:
        given = columns[name]
        derived = c if name == "c" else np.divide(b, c, out=given.copy(), where=c > 0)
        text = f"{name} = {{:g}} contradicts {first} = {{:g}} and {second} = {{:g}}, which give {{:g}}"
        _require(np.abs(given - derived) <= _DISAGREEMENT * (c if name == "c" else 1), text, given, x, y, derived)
    return a, b


def _require(valid: BoolArray, text: str, *values: FloatArray) -> None:
    """Reject the first invalid row, with its values in the text."""
    for row in np.flatnonzero(~valid)[:1]:
        raise _RowError(int(row), text.format(*(column[row] for column in values)))
