"""Heights in NetCDF files: variables, units, sign and coordinate system by the CF conventions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from mitransient_lidar.core.array_files import Array, Variable, read_netcdf
from mitransient_lidar.core.coordinate_systems import map_system
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.grids import Stated, stated_by, without_no_data

_NAMES = ("height", "elevation", "depth")

_NO_UNIT = ("", "1")


def read_netcdf_heights(path: Path) -> tuple[Array, dict[str, Array], Stated]:
    """Read heights or depths from a NetCDF-4 file.

    The variable is called ``height``, ``elevation`` or ``depth``, or is the only one with two dimensions. These are
    (y, x) or (x, y), with or without the coordinates ``x`` and ``y``, which may have other names if their
    ``standard_name`` is ``projection_x_coordinate`` and ``projection_y_coordinate``. Dimensions of other names count as
    (y, x). Read are ``units`` of all three, ``positive`` or ``standard_name`` of the heights, and a grid mapping.

    Returns
    -------
    values : ndarray, shape (rows, columns)
        Values as in the file, NaN where they are missing.
    positions : dict
        Positions ``x`` and ``y``, as far as the file has them, as in the file.
    stated : Stated
        What the file states of both.

    Raises
    ------
    UserError
        If it has no such variable or several, or positions in degrees.
    """
    variables = read_netcdf(path)
    data = {name: variable for name, variable in variables.items() if not variable.is_coordinate}
    flat = [name for name, variable in data.items() if variable.values.ndim == 2]
    names = [name for name in _NAMES if name in flat] or flat
    if len(names) != 1:
        found = f" ({', '.join(names)})" if names else ""
        raise UserError(
            f"{path} has {len(names)} variables that may be the heights{found}: it must have one called"
            f" {', '.join(_NAMES)}, or only one with two dimensions."
        )
    heights = data[names[0]]
    x, y = _axis(variables, "x"), _axis(variables, "y")
    positions = {axis: variables[name] for axis, name in (("x", x), ("y", y)) if name in variables}
    for name in (*heights.dims, x, y):
        units = variables[name].units if name in variables else ""
        if units.lower().startswith("deg") or name.lower() in ("lat", "lon", "latitude", "longitude"):
            raise UserError(f"{path} has positions {name} in degrees: they must be projected, in metres or feet.")
    stated = stated_by(None if (mapping := _mapping(variables)) is None else map_system(path, mapping))
    of_axes = {variable.units for variable in positions.values()}
    if len(of_axes) > 1:
        raise UserError(f"{path} has x and y in {' and '.join(sorted(of_axes))}: they must have the same units.")
    unit = "".join(of_axes - set(_NO_UNIT))
    stated = stated._replace(
        unit=stated.unit if heights.units in _NO_UNIT else heights.units,
        is_down=_is_down(names[0], heights.attributes, stated.is_down),
        position_unit=unit or stated.position_unit,
    )
    values = heights.values.T if heights.dims == (x, y) else heights.values
    if values.dtype.kind == "f":
        for attribute in ("_FillValue", "missing_value"):
            number = heights.attributes.get(attribute)
            values = without_no_data(values, None if number is None else float(number))
    return values, {name: variable.values for name, variable in positions.items()}, stated


def _axis(variables: Mapping[str, Variable], axis: str) -> str:
    """Return the name of the positions along x or y."""
    standard = f"projection_{axis}_coordinate"
    found = [name for name, one in variables.items() if one.attributes.get("standard_name") == standard]
    return found[0] if axis not in variables and len(found) == 1 else axis


def _mapping(variables: Mapping[str, Variable]) -> dict[str, object] | str | None:
    """Return the attributes of a grid mapping, or its WKT, if there is one."""
    for variable in variables.values():
        attributes = variable.attributes
        for name in ("crs_wkt", "spatial_ref"):
            if attributes.get(name):
                return str(attributes[name])
        if "grid_mapping_name" in attributes:
            return {name: value for name, value in attributes.items() if name not in ("dtype", "source")}
    return None


def _is_down(name: str, attributes: Mapping[str, object], default: bool | None) -> bool | None:
    """Return whether heights are positive down, by their attributes, their name, or a vertical axis."""
    direction = str(attributes.get("positive", "")).lower()
    if direction in ("up", "down"):
        return direction == "down"
    standard = str(attributes.get("standard_name", ""))
    if "depth" in standard or (not standard and name == "depth"):
        return True
    return False if "height" in standard or "altitude" in standard else default
