"""Registry of the variables in all datasets: unit and long name (CF-1.11) of each, in one place.

The registry is the file ``variables.csv``. `label` describes a dataset's variables by their names. Standard errors and
limits follow from their variable. A name with several meanings has an entry for each dataset kind, ``kind.name``.
"""

from __future__ import annotations

import csv
import importlib.resources
from enum import IntEnum, IntFlag
from typing import Any

import xarray as xr


def _read() -> dict[str, tuple[str, str]]:
    """Return the unit, empty for texts, and the long name of each variable."""
    table = importlib.resources.files("mitransient_lidar.results") / "variables.csv"
    return {row[0]: (row[1], row[2]) for row in csv.reader(table.read_text("utf-8").splitlines()[1:])}


VARIABLES = _read()

#: Directions of coordinates that count downwards.
_DOWN = ("gate_depth", "depth")


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
    """Return the attributes for a variable whose values, or bits in a set of flags, are members of an enum."""
    key = "flag_masks" if issubclass(meanings, IntFlag) else "flag_values"
    return {
        key: [int(one) for one in meanings],
        "flag_meanings": " ".join(str(one.name).lower() for one in meanings),
    }
