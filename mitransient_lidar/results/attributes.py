"""Results' variables, attributes and coordinates: units and long names (CF-1.11), types in files, and ranges.

The file ``variables.csv`` registers variables. `label` describes a dataset's variables by their names. Standard errors
and limits follow from their variable. A name with several meanings has an entry for each dataset kind, ``kind.name``.
Variables for an instrument's infrared channel have their own names.
"""

from __future__ import annotations

import csv
import importlib.resources
import json
import math
from collections.abc import Callable, Hashable, Mapping
from datetime import UTC, datetime
from enum import IntEnum, IntFlag
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar._version import release
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.formats.documents import parse_json
from mitransient_lidar.core.parameters.catalogue import limits
from mitransient_lidar.core.validation import shown as printed


def _read() -> dict[str, tuple[str, str]]:
    """Return each variable's unit, empty for texts, and long name."""
    table = importlib.resources.files("mitransient_lidar.results") / "variables.csv"
    return {row[0]: (row[1], row[2]) for row in csv.reader(table.read_text("utf-8").splitlines()[1:])}


VARIABLES = _read()

_DOWN = ("gate_depth", "depth")  #: Directions of coordinates that count downwards.


class PointClass(IntEnum):
    """Point class, by the codes in LAS 1.4 and in its profile for bathymetry; 1 is an object above the water."""

    UNCLASSIFIED = 1
    GROUND = 2
    BOTTOM = 40
    SURFACE = 41
    OBJECT = 43
    NO_ECHO = 45

    @property
    def text(self) -> str:
        """Class name in tables and legends."""
        names = {"SURFACE": "water surface", "UNCLASSIFIED": "above the water", "GROUND": "land"}
        return names.get(self.name, self.name.lower().replace("_", " "))


def described(name: str, kind: str = "", unit: str | None = None) -> dict[str, Any]:
    """Return a variable's attributes ``units`` and ``long_name``, empty if it is not in the registry.

    ``_stderr``, ``_low`` or ``_high`` after another one's name is its standard error or a limit of its interval. For a
    dataset kind, the entry ``kind.name`` goes first. `unit`, such as counts for signals, replaces the registry's.
    """
    for key in (f"{kind}.{name}", name):
        if key in VARIABLES:
            own, text = VARIABLES[key]
            own = own if unit is None else unit
            down = {"positive": "down"} if name in _DOWN and kind != "points" else {}
            return {**({"units": own} if own else {}), "long_name": text, **down}
    for end, what in (("_stderr", "standard error"), ("_low", "lower limit"), ("_high", "upper limit")):
        if name.endswith(end) and (of := described(name.removesuffix(end), kind, unit)):
            return {**of, "long_name": f"{what} of the {of['long_name']}"}
    return {}


def label(dataset: xr.Dataset, kind: str = "", **units: str) -> xr.Dataset:
    """Return a dataset whose variables without attributes are `described`, with other `units` for some.

    A variable with a standard error names it in ``ancillary_variables``.
    """
    dataset = dataset.copy()
    for name, variable in dataset.variables.items():
        if "long_name" not in variable.attrs and "units" not in variable.attrs:
            base = str(name).removesuffix("_stderr")
            about = described(str(name), kind, units.get(base))
            if about and f"{name}_stderr" in dataset:
                about["ancillary_variables"] = f"{name}_stderr"
            variable.attrs.update({**about, **variable.attrs})
    return dataset


def flagged(meanings: type[IntEnum] | type[IntFlag]) -> dict[str, Any]:
    """Return the attributes for a variable whose values, or bits in flags, are an enum's members."""
    key = "flag_masks" if issubclass(meanings, IntFlag) else "flag_values"
    return {key: [int(one) for one in meanings], "flag_meanings": " ".join(str(one.name).lower() for one in meanings)}


_POSITIVE, _NOT_NEGATIVE, _ANY, _INDEX = (1e-30, 1e30), (0.0, 1e30), (-1e30, 1e30), (1.0, 10.0)

#: Lowest and highest value of number attributes; NaN is unknown.
_NUMBERS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("bin_width_ns", "aperture_area", "divergence_mrad", "divergence_across_mrad"), _POSITIVE),
    **dict.fromkeys(("field_of_view_mrad", "pulse_energy_mj", "wavelength_nm", "gate_step_ns"), _POSITIVE),
    **dict.fromkeys(("pulse_fwhm_ns", "response_time_ns", "obscuration", "two_way_efficiency"), _NOT_NEGATIVE),
    **dict.fromkeys(("surface_slope_variance", "gate_rise_ns", "gate_fall_ns", "max_memory_gb"), _NOT_NEGATIVE),
    **dict.fromkeys(("passes", "most_passes", "pulses", "shots", "elapsed_s", "pass_share"), _NOT_NEGATIVE),
    **dict.fromkeys(("time_start_ns", "altitude", "surface_time_ns", "window_start_ns", "window_end_ns"), _ANY),
    **dict.fromkeys(("off_nadir_deg", "ellipse_deg"), (-360.0, 360.0)),
    **dict.fromkeys(("refractive_index", "group_index"), _INDEX),
    **dict.fromkeys(("gain", "optical_density", "noise_bandwidth_hz", "background_power_w"), _NOT_NEGATIVE),
}

#: Attributes that are a list over the pixels where they differ.
PER_PIXEL = ("gain", "optical_density", "background_power_w", "fitting_gain", "fitting_optical_density")

_COUNTS = ("passes", "most_passes", "pulses", "shots")  #: Those that count something, which is known.

#: Number of values in attributes that are lists of finite numbers, None for any.
_LISTS: dict[str, int | None] = {
    "transmitter_pose": 12,
    "receiver_pose": 12,
    "bottom_point": 3,
    "field_of_view_sides_mrad": 2,
    "surface_heights_m": 2,
    "slope_deviation": 2,
    **dict.fromkeys(("error_inflation_bins", "error_inflation", "pulse_times_ns", "pulse_power")),
    **dict.fromkeys(("wave_focusing_depths", "wave_focusing")),
}

#: Attributes that are empty where there are none: views of hexagons and of separate pixels have no sides.
_MAY_BE_EMPTY = ("field_of_view_sides_mrad", "error_inflation_bins", "error_inflation")

_TEXTS = ("scene", "beam_profile", "field_of_view_shape", "layout", "variant", "integrator", "instrument", "sensor")

#: JSON text attributes: lists of outlines, each a list of lines x, y, x, y, ...; or with a name.
_OUTLINES, _LISTED = ("pixel_outlines",), {"beam_outlines": ("share", "lines"), "target_outlines": ("id", "z", "line")}

#: Coordinates that hold finite numbers, or NaN where they are unknown.
_COORDINATES = (
    *("angle_x", "angle_y", "sight_x", "sight_y", "off_nadir", "surface_time", "surface_spread", "depth_per_ns"),
    *("beam_share", "gate_start", "gate_width", "gate_depth", "aim_x", "aim_y", "shot", "shot_passes"),
    *("true_slope_along", "true_slope_across", "true_surface_height", "true_bottom_depth"),
    *("true_bottom_depth_below_surface", "true_absorption", "true_scattering", "true_backscattering"),
    *("true_attenuation", "true_kd"),
)

#: Attributes of a file beside the one with all others, the most there may be, and those that go first.
MOST_SHOWN = 39
_FIRST = (
    *("Conventions", "title", "source", "history", "comment", "references", "scene", "instrument", "receiver"),
    *("time_start_ns", "bin_width_ns", "layout", "altitude", "off_nadir_deg", "wavelength_nm", "pulse_energy_mj"),
    *("pulse_fwhm_ns", "divergence_mrad", "field_of_view_mrad", "aperture_area", "two_way_efficiency"),
    *("refractive_index", "group_index", "surface_time_ns", "window_start_ns", "window_end_ns", "gate_step_ns"),
    *("pulses", "shots", "seed", "passes", "error_median", "error_p95", "elapsed_s", "integrator", "variant"),
    *("mitsuba_version", "drjit_version", "scene_xml"),
)


def provenance(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result's attributes, checked, with ``title``, ``source`` and ``history`` added.

    Raises `ValueError` if an attribute is no int, float, str or list with one such type.
    """
    return {
        "Conventions": "CF-1.11",
        "title": titled("Received lidar power", attributes),
        "source": release(),
        "history": step_of_history("rendered"),
        **{text(name): attribute(name, value) for name, value in attributes.items()},
    }


def made_from(attributes: Mapping[Any, Any], title: str, done: str) -> dict[str, str]:
    """Return ``title`` and ``history`` for a dataset that is made from one with these attributes."""
    return {"title": titled(title, attributes), "history": step_of_history(done, attributes)}


def titled(what: str, attributes: Mapping[Any, Any]) -> str:
    """Return a title that names the scene in the attributes, if they have one."""
    return f"{what}, scene {attributes['scene']}" if "scene" in attributes else what


def step_of_history(done: str, attributes: Mapping[Any, Any] | None = None) -> str:
    """Return a dataset's attribute ``history`` with a line about the latest operation."""
    line = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} {done} by {release()}"
    return "\n".join(part for part in (str((attributes or {}).get("history", "")), line) if part)


def shown(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes that other programs see: numbers and texts, at most 39, the most telling first."""
    plain = {name: value for name, value in attributes.items() if not isinstance(value, list)}
    if len(plain) > MOST_SHOWN:
        first = {name: plain[name] for name in _FIRST if name in plain}
        return dict(list(first.items())[:MOST_SHOWN])
    return plain


def attribute(name: str, value: Any) -> int | float | str | list[int] | list[float] | list[str]:
    """Convert an attribute to a Python type that both file formats return unchanged.

    Raises `ValueError` if it is no int, float, str or list with one such type.
    """
    if isinstance(value, (tuple, list, np.ndarray)):
        items = [attribute(name, item) for item in value]
        if {type(item) for item in items} == {int, float}:
            items = [float(item) for item in items]  # type: ignore[arg-type]
        if len({type(item) for item in items}) <= 1 and not any(isinstance(item, list) for item in items):
            return items  # type: ignore[return-value]
    elif isinstance(value, (bool, int, np.bool_, np.integer)):
        if -(2**63) <= int(value) < 2**63:
            return int(value)
    elif isinstance(value, (float, np.floating)):
        return float(value)
    elif isinstance(value, (str, Path)):
        return text(value)
    raise ValueError(f"attribute {name} = {value!r} must be a 64-bit int, a float, a str or a list of one of those.")


def text(value: str | Path) -> str:
    """Replace text that UTF-8 or NetCDF cannot store: bytes in undecodable file names, and NUL."""
    return str(value).replace("\0", "\ufffd").encode("utf-8", "replace").decode("utf-8")


def check_attributes(place: object, attributes: Mapping[Any, Any]) -> None:
    """Raise `UserError` if a known result attribute has another kind than a render writes, or is out of range."""
    for name, (low, high) in _NUMBERS.items():
        high = min(high, (limits(name) or (low, high))[1])
        value = attributes.get(name, low)
        if name in PER_PIXEL and _are_numbers(value) and min(value) >= low and max(value) <= high:
            continue
        if not _is_number(value) or value < low or value > high or (name in _COUNTS and math.isnan(value)):
            raise _refusal(place, name, value, f"a number between {low:g} and {high:g}")
    for name, length in _LISTS.items():
        value = attributes.get(name, ())
        if name in _MAY_BE_EMPTY and np.size(value) == 0:
            continue
        if name in attributes and not (_are_numbers(value) and length in (None, np.size(value))):
            raise _refusal(place, name, value, f"{length or 'one or more'} finite numbers")
    bins, inflation = (attributes.get(name, ()) for name in ("error_inflation_bins", "error_inflation"))
    if np.size(bins) != np.size(inflation):
        raise _refusal(place, "error_inflation", inflation, f"{np.size(bins)} numbers, as error_inflation_bins")
    for name in _TEXTS:
        if not isinstance(attributes.get(name, ""), str):
            raise _refusal(place, name, attributes[name], "a text")
    for name in (*_OUTLINES, *_LISTED):
        if name in attributes and not _are_outlines(attributes[name], _LISTED.get(name)):
            raise _refusal(place, name, attributes[name], "a text of JSON with outlines")


def check_coordinates(place: object, dataset: xr.Dataset, name: str) -> None:
    """Raise `UserError` if a result's known coordinate or variable does not contain numbers over its dimensions."""
    dims = set(dataset[name].dims)
    for one in (*_COORDINATES, name, f"{name}_stderr"):
        if one not in dataset.variables:
            continue
        values = dataset[one]
        if values.dtype.kind not in "fiu":
            kind = "texts" if values.dtype.kind in "USO" else f"values of type {values.dtype}"
            raise UserError(f"{place} has {one} with {kind}: it must hold numbers")
        if one in _COORDINATES and np.isinf(values.values).any():
            raise UserError(f"{place} has {one} = {values.values[np.isinf(values.values)][0]}: it must be finite")
        if one == f"{name}_stderr" and values.dims != dataset[name].dims:
            raise UserError(f"{place} has {one} over ({', '.join(map(str, values.dims))}), unlike {name}")
        if one in ("angle_x", "angle_y") and not set(values.dims) <= dims:
            raise UserError(f"{place} has {one} over ({', '.join(map(str, values.dims))}), not over its pixels")
    if ("angle_x" in dataset.coords) != ("angle_y" in dataset.coords):
        raise UserError(f"{place} has one of the coordinates angle_x and angle_y: it must have both")


def _refusal(place: object, name: str, value: object, allowed: str) -> UserError:
    return UserError(f"{place} has the attribute {name} = {printed(value)}: it must be {allowed}")


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float, np.number)) and not isinstance(value, bool)


def _are_numbers(value: Any) -> bool:
    """Return whether a value is a list of finite numbers."""
    listed = isinstance(value, (list, tuple, np.ndarray)) and len(value) > 0
    return listed and all(_is_number(one) and math.isfinite(one) for one in value)


def _are_outlines(text: object, keys: tuple[str, ...] | None) -> bool:
    """Return whether a text is JSON with number lists in lines, or in objects with these keys."""
    try:
        listed = json.loads(text) if isinstance(text, str) else None
    except (ValueError, RecursionError):
        return False
    if not isinstance(listed, list):
        return False
    if keys is None:
        return all(_are_lines(one) for one in listed)
    parts: dict[str, Callable[[Any], bool]] = {
        "id": lambda value: isinstance(value, str),
        "share": _is_number,
        "z": lambda value: _are_numbers(value) and len(value) == 2,
        "lines": _are_lines,
        **dict.fromkeys(("line", "seen", "shadow"), _is_line),
    }
    known = [one for one in listed if isinstance(one, dict) and set(keys) <= one.keys()]
    return known == listed and all(parts[key](one[key]) for one in known for key in parts.keys() & one.keys())


def _are_lines(value: object) -> bool:
    return isinstance(value, list) and all(map(_is_line, value))


def _is_line(value: object) -> bool:
    """Return whether a value is a list of points x, y, x, y, ..."""
    return isinstance(value, list) and len(value) % 2 == 0 and (not value or _are_numbers(value))


#: Attribute with the JSON of the attributes of the infrared channel; group of its data in files; and part of names.
INFRARED = "infrared"

_PREFIX, _SHARED, _ENDED = f"{INFRARED}_", "shot", "interrupted"


def uninterrupted(result: xr.Dataset) -> xr.Dataset:
    """Return a result of which all is needed; raise KeyboardInterrupt if its render was interrupted."""
    if result.attrs.get(_ENDED):
        raise KeyboardInterrupt
    return result


def join(green: xr.Dataset, infrared: xr.Dataset) -> xr.Dataset:
    """Return one dataset with both channels.

    The infrared channel's variables and dimensions have the prefix ``infrared_``; both channels share ``shot``. From
    two series, the shots that both have remain. The attribute ``interrupted`` is 1 where one channel was interrupted.
    """
    names: dict[Hashable, str] = {name: f"{_PREFIX}{name}" for name in (*infrared.variables, *infrared.dims)}
    names.pop(_SHARED, None)
    attributes = {str(name): attribute(str(name), value) for name, value in infrared.attrs.items()}
    own = infrared.rename(names)
    if _SHARED in green.dims:
        count = min(green.sizes[_SHARED], own.sizes[_SHARED])
        green, own = (one.isel({_SHARED: slice(count)}) for one in (green, own))
        green, attributes = green.assign_attrs(shots=count), {**attributes, "shots": count}
    of_both = {INFRARED: json.dumps(attributes), **({_ENDED: 1} if infrared.attrs.get(_ENDED) else {})}
    return green.assign_coords(own.coords).assign(own.data_vars).assign_attrs(of_both)


def split(dataset: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset | None]:
    """Return a dataset's green and infrared channel, the latter None where it has none."""
    own = [name for name in dataset.variables if str(name).startswith(_PREFIX)]
    green = dataset.drop_vars(own)
    green.attrs = {name: value for name, value in dataset.attrs.items() if name != INFRARED}
    if INFRARED not in dataset.attrs or not own:
        return green, None
    attributes = parse_json(str(dataset.attrs[INFRARED]), f"the attribute {INFRARED}")
    if not isinstance(attributes, dict):
        raise UserError(f"the attribute {INFRARED} must be an object of JSON")
    kept = own + [name for name in (_SHARED,) if name in dataset.coords]
    infrared = dataset[[name for name in kept if name not in dataset.coords]]
    infrared = infrared.assign_coords({name: dataset.coords[name] for name in kept if name in dataset.coords})
    infrared = infrared.drop_vars([name for name in infrared.coords if name not in kept])
    listed = [*infrared.variables, *infrared.dims]
    names = {name: str(name).removeprefix(_PREFIX) for name in listed if str(name).startswith(_PREFIX)}
    infrared = infrared.rename(names)
    infrared.attrs = attributes
    return green, infrared
