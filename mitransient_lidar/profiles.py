"""Continuous profiles of water: read from a file, and refined to layers within a stated tolerance."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mitransient_lidar.errors import UserError
from mitransient_lidar.optics.checks import FloatArray, finite_array, in_range
from mitransient_lidar.optics.water import WaterColumn

DEFAULT_BACKSCATTER_RATIO = 0.0183
"""The bb/b of Petzold's average particle, for files that tell none."""

COEFFICIENT_FLOOR = 1e-4
"""Attenuation and scattering [1/m] below which tolerances are absolute; pure sea water scatters 20 times as much."""

BACKSCATTERING_FLOOR = 1e-6
"""Backscattering [1/m] below which tolerances are absolute; that of pure sea water is 1000 times as large."""

THINNEST_LAYER = 1e-6
"""Layers are not made thinner than this [m], however steep the profile."""

_PROPERTIES = ("a", "b", "c", "omega")
_COLUMNS = ("depth", *_PROPERTIES, "bb", "bb_ratio")

#: Of more than two properties each must agree with the first two within this part of c, as rounded decimals do.
_DISAGREEMENT = 0.02

#: Halvings of the interval in which a layer that crosses a node ends.
_BISECTIONS = 20

_Columns = dict[str, FloatArray]


class _RowError(UserError):
    """A fault in one row: readers replace the number of the row by where it stands in the file."""

    def __init__(self, row: int, text: str) -> None:
        super().__init__(f"{text}, in row {row} counted from 0.")
        self.row, self.text = row, text


@dataclass(frozen=True, eq=False)
class Profile:
    """Inherent optical properties of water that change continuously with depth.

    All coefficients are linear between the nodes, constant above the first and below the last. Read one from a file
    with `read_profile`.

    Parameters
    ----------
    depth : array_like, shape (N,)
        Depths of the nodes below the mean sea level [m], at least 0, strictly increasing; N at least 2.
    absorption, scattering : array_like, shape (N,)
        Absorption a and scattering b at the nodes [1/m], at least 0.
    backscattering : array_like, shape (N,)
        Backscattering bb at the nodes [1/m], from 0 to `scattering`.

    Raises
    ------
    ValueError
        If the arrays do not have this form.
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
                    f"{name} of shape {values.shape} must be a list of one value per depth, of 2 depths or more."
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
        """Refine the profile to layers, each with its mean properties.

        From the surface down every layer is made as thick as the tolerance allows, across nodes where they permit.
        Where properties change monotonically that yields the fewest layers, ln(q_2/q_1) / ln(1 + 2 tolerance) for one
        that goes from q_1 to q_2; where they waver, a few percent more than the fewest.

        Parameters
        ----------
        tolerance : float
            Largest relative deviation, 1e-5 to 0.5.

        Returns
        -------
        WaterColumn
            At every depth attenuation, scattering and backscattering each deviate from the profile by at most
            `tolerance` times the profile's value there, or times `COEFFICIENT_FLOOR` (`BACKSCATTERING_FLOOR`) if that
            is larger. Only layers that would be thinner than `THINNEST_LAYER` are made that thick and deviate further.
            Vertical optical depths from z = 0 are exact at the edges; within a layer they deviate by at most
            `tolerance`/2 of that layer's own optical depth. The last layer, which has no lower edge, begins where the
            profile becomes constant.

        Raises
        ------
        ValueError
            If `tolerance` lies outside its range.
        """
        tolerance = in_range("tolerance", tolerance, 1e-5, 0.5)
        z, (a, b, bb) = self._varying_part()
        courses = [
            _Course(z, q, floor, tolerance)
            for q, floor in ((a + b, COEFFICIENT_FLOOR), (b, COEFFICIENT_FLOOR), (bb, BACKSCATTERING_FLOOR))
        ]
        tops = np.array(_layer_tops(z.tolist(), courses))
        absorption, scattering, backscattering = (_means(z, q, tops) for q in (a, b, bb))
        # Interpolation may round bb above an equal b.
        return WaterColumn(tops, absorption + scattering, scattering, np.minimum(backscattering, scattering))

    def _varying_part(self) -> tuple[FloatArray, FloatArray]:
        """Return the nodes from z = 0 to where the profile becomes constant, shape (M,), and a, b, bb, shape (3, M)."""
        values = np.stack((self.absorption, self.scattering, self.backscattering))
        z = self.depth
        if z[0] > 0:
            z, values = np.append(0.0, z), np.concatenate((values[:, :1], values), axis=1)
        changes = np.flatnonzero(np.any(np.diff(values, axis=1) != 0, axis=0))
        count = changes[-1] + 2 if changes.size else 1
        return z[:count], values[:, :count]


class _Course:
    """One property along the profile, with its extremes and integral over the layer that is being made.

    Plain floats: the layers come one after the other, and NumPy is slow on single numbers.
    """

    def __init__(self, depth: FloatArray, values: FloatArray, floor: float, tolerance: float) -> None:
        self.floor, self.tolerance = floor, tolerance
        self.depth: list[float] = depth.tolist()
        self.values: list[float] = values.tolist()
        self.slopes: list[float] = (np.diff(values) / np.diff(depth)).tolist()
        self.low = self.high = self.last = self.integral = 0.0

    def begin(self, segment: int, depth: float) -> float:
        """Begin a layer within a segment; return how thick it may become there [m]."""
        slope = self.slopes[segment]
        q = self.values[segment] + slope * (depth - self.depth[segment])
        self.low = self.high = self.last = q
        self.integral = 0.0
        if slope == 0:
            return float("inf")
        # The mean lies half-way; the tolerance is that of the lower end.
        span, floor = 2 * self.tolerance, self.floor
        change = span * max(q, floor) if slope > 0 else max(q - q / (1 + span), span * floor)
        return change / abs(slope)

    def advance(self, segment: int, thickness: float) -> None:
        """Let the layer go on to the end of a segment, by `thickness` [m]."""
        q = self.values[segment + 1]
        self.integral += (self.last + q) / 2 * thickness
        self.low, self.high, self.last = min(self.low, q), max(self.high, q), q

    def allows(self, segment: int, thickness: float, total: float) -> bool:
        """Tell whether the layer may go on into a segment by `thickness`, to become `total` thick [m]."""
        q = self.last + self.slopes[segment] * thickness
        mean = (self.integral + (self.last + q) / 2 * thickness) / total
        low, high = min(self.low, q), max(self.high, q)
        lowest, highest = high - self.tolerance * max(high, self.floor), low + self.tolerance * max(low, self.floor)
        return lowest <= mean <= highest


def _layer_tops(z: list[float], courses: list[_Course]) -> list[float]:
    """Return the upper edges of the layers from z[0] to z[-1], and of the last one at z[-1]."""
    tops = []
    start, segment = z[0], 0
    while start < z[-1]:
        tops.append(start)
        while z[segment + 1] <= start:
            segment += 1
        end = start + min([course.begin(segment, start) for course in courses])
        if end >= z[segment + 1]:
            end, segment = _cross_nodes(z, courses, start, segment)
        start = max(end, start + THINNEST_LAYER)
    return [*tops, z[-1]]


def _cross_nodes(z: list[float], courses: list[_Course], start: float, segment: int) -> tuple[float, int]:
    """Return where a layer ends that fills the rest of a segment at least, and in which segment."""
    node = start
    while True:
        for course in courses:
            course.advance(segment, z[segment + 1] - node)
        segment += 1
        node = z[segment]
        if segment == len(z) - 1:
            return node, segment - 1
        whole = z[segment + 1] - node
        if not all([course.allows(segment, whole, z[segment + 1] - start) for course in courses]):
            break
    allowed, refused = 0.0, whole
    for _ in range(_BISECTIONS):
        thickness = (allowed + refused) / 2
        if all([course.allows(segment, thickness, node - start + thickness) for course in courses]):
            allowed = thickness
        else:
            refused = thickness
    return node + allowed, segment


def _means(z: FloatArray, q: FloatArray, tops: FloatArray) -> FloatArray:
    """Return the means over layers of what is linear between nodes; the last layer has the last node's value."""
    grid = np.union1d(z, tops)
    values = np.interp(grid, z, q)
    pieces = np.diff(grid) * (values[1:] + values[:-1]) / 2
    integrals = np.add.reduceat(pieces, np.searchsorted(grid, tops[:-1]))
    return np.append(integrals / np.diff(tops), q[-1])


def read_profile(path: str | os.PathLike[str]) -> Profile:
    """Read a profile from a file.

    Parameters
    ----------
    path : path
        ``.csv``, columns separated by commas below a line with their names, # starts a comment; or ``.nc``, NetCDF-4
        with variables over the dimension ``depth``. Names:

        ``depth``
            depth [m], at least 0, increasing;
        ``a``, ``b``, ``c``, ``omega``
            absorption, scattering, attenuation [1/m], at least 0, and albedo b/c, 0 to 1: any two of them. Of more
            the first two in this order count, with which the others must agree within 2 % of c;
        ``bb`` or ``bb_ratio``
            backscattering [1/m], at most b, or its ratio to b, 0 to 1. Default: the ratio 0.0183.

        Other columns, or variables over the depth alone, are refused: one might be a name misspelt.

    Returns
    -------
    Profile
        a, b and bb are linear between the rows of the file.

    Raises
    ------
    ValueError
        If the file is missing, damaged or of another kind; names are unknown, missing or twice there; a value is not a
        finite number within its range, or contradicts the others; depths do not increase, or are fewer than 2. The
        message tells the line, or the index along ``depth``.
    """
    path = Path(path)
    readers = {".csv": _read_csv, ".nc": _read_netcdf}
    if path.suffix.lower() not in readers:
        raise UserError(f"cannot read {path}: the name of a profile must end in {', '.join(readers)}.")
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}.") from error
    columns, places = readers[path.suffix.lower()](path)
    if len(places) < 2:
        raise UserError(f"{path} has {len(places)} depths but a profile must have at least 2.")
    try:
        return _profile(columns)
    except _RowError as error:
        raise UserError(f"{path}, {places[error.row]}: {error.text}.") from None


def _read_csv(path: Path) -> tuple[_Columns, list[str]]:
    """Return the columns by name, and where each row stands."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not a text file in UTF-8.") from error
    cells = [(n, [c.strip() for c in line.split("#")[0].split(",")]) for n, line in enumerate(lines, start=1)]
    rows = [(n, row) for n, row in cells if any(row)]
    names = rows[0][1] if rows else []
    _check_names(path, names)
    table = []
    for n, row in rows[1:]:
        if len(row) != len(names):
            raise UserError(f"{path}, line {n}: {len(row)} values must be {len(names)}, one for each column.")
        for name, cell in zip(names, row, strict=True):
            try:
                table.append(float(cell))
            except ValueError:
                raise UserError(f"{path}, line {n}: {name} = {cell!r} must be a number.") from None
    values = np.reshape(table, (-1, len(names)))
    return dict(zip(names, values.T, strict=True)), [f"line {n}" for n, _ in rows[1:]]


def _read_netcdf(path: Path) -> tuple[_Columns, list[str]]:
    """Return the variables by name, and where each depth stands."""
    import xarray as xr

    try:
        dataset = xr.load_dataset(path, engine="h5netcdf", decode_times=False)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{path} is damaged, or is not a NetCDF-4 file.") from error
    columns = {str(name): variable for name, variable in dataset.variables.items() if variable.dims == ("depth",)}
    _check_names(path, list(columns))
    for name, variable in columns.items():
        if variable.dtype.kind not in "iuf":
            raise UserError(f"{path} has {name} of type {variable.dtype}, but it must hold real numbers.")
    count = dataset.sizes["depth"]
    return {n: v.values.astype(np.float64) for n, v in columns.items()}, [f"index {i} of depth" for i in range(count)]


def _check_names(path: Path, names: list[str]) -> None:
    allowed = ", ".join(_COLUMNS)
    for name in names:
        if name not in _COLUMNS:
            raise UserError(f"{path} has an unknown column {name!r}: allowed are {allowed}.")
        if names.count(name) > 1:
            raise UserError(f"{path} has {names.count(name)} columns {name!r} but each may be there once.")
    if "depth" not in names or sum(name in _PROPERTIES for name in names) < 2:
        raise UserError(
            f"{path} has the columns {', '.join(names) or 'none'}: needed are depth and two of a, b, c, omega."
        )
    if "bb" in names and "bb_ratio" in names:
        raise UserError(f"{path} has the columns bb and bb_ratio, but must have only one of them.")


def _profile(columns: _Columns) -> Profile:
    """Return the profile of columns whose names are good."""
    for name, values in columns.items():
        _require(np.isfinite(values), name + " = {:g} must be finite", values)
        _require(values >= 0, name + " = {:g} must not be negative", values)
        if name in ("omega", "bb_ratio"):
            _require(values <= 1, name + " = {:g} must lie between 0 and 1", values)
    a, b = _absorption_scattering(columns)
    bb = columns["bb"] if "bb" in columns else columns.get("bb_ratio", DEFAULT_BACKSCATTER_RATIO) * b
    return Profile(columns["depth"], a, b, bb)


def _absorption_scattering(columns: _Columns) -> tuple[FloatArray, FloatArray]:
    """Return a and b [1/m] from the first two properties; the others must agree with them."""
    first, second, *others = (name for name in _PROPERTIES if name in columns)
    x, y = columns[first], columns[second]
    if second == "c":
        _require(x <= y, first + " = {:g} 1/m must not exceed c = {:g} 1/m", x, y)
        a, b = (x, y - x) if first == "a" else (y - x, x)
    elif first == "a" and second == "omega":
        _require(y < 1, "omega = {:g} must be below 1 where a = {:g} 1/m is given to tell b", y, x)
        a, b = x, x * y / (1 - y)
    elif first == "b":
        _require(y > 0, "omega = {:g} must be greater than 0 where b = {:g} 1/m is given to tell a", y, x)
        a, b = x * (1 - y) / y, x
    else:
        a, b = (x, y) if first == "a" else (x * (1 - y), x * y)
    c = a + b
    for name in others:
        given = columns[name]
        same = c if name == "c" else np.divide(b, c, out=given.copy(), where=c > 0)
        text = f"{name} = {{:g}} contradicts {first} = {{:g}} and {second} = {{:g}}, from which it is {{:g}}"
        _require(np.abs(given - same) <= _DISAGREEMENT * (c if name == "c" else 1), text, given, x, y, same)
    return a, b


def _require(good: npt.NDArray[np.bool_], text: str, *values: FloatArray) -> None:
    """Refuse the first row that is not good, with its values in the text."""
    for row in np.flatnonzero(~good)[:1]:
        raise _RowError(int(row), text.format(*(column[row] for column in values)))
