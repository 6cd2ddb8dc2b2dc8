"""All declared parameters, by plugin and by name: ranges, units and files of scene parameters."""

from __future__ import annotations

import math
import re

from mitransient_lidar.core.parameters import bottom, integrators, lidar, sea, water
from mitransient_lidar.core.parameters.fields import Parameter, Plugin

#: Plugin declarations by name.
PLUGINS: dict[str, Plugin] = {
    each.name: each
    for module in (lidar, sea, water, bottom, integrators)
    for each in vars(module).values()
    if isinstance(each, Plugin)
}

#: Names of parameters whose value is a file name.
FILE_PARAMETERS = tuple(dict.fromkeys(each.name for plugin in PLUGINS.values() for each in plugin if each.is_file))

#: Units of scene parameters that no plugin declares, such as shape positions, by name ending.
_UNIT_OF_END = {
    **{"_deg": "degree", "_seed": "1", "_count": "1"},
    **{f"_{end}": "m" for end in ("x", "y", "height", "length", "width", "left", "middle", "right")},
}

#: Plugins whose parameters are no measured quantities: time axis, gates, and estimators.
_NOT_MEASURED = (lidar.TIME_GATED_FILM, *filter(lambda each: isinstance(each, Plugin), vars(integrators).values()))


def declared(name: str, plugin: str | None = None) -> list[Parameter]:
    """Return the parameters with a name, in a plugin or in all of this package.

    If none has it, return the parameters with the name after an id: ``surface_time`` is ``time``.
    """
    if plugin is not None:
        return [each for each in PLUGINS.get(plugin, bottom.OF_MITSUBA) if each.name == name]
    known = [each for one in PLUGINS.values() for each in one]
    while name:
        if found := [each for each in known if each.name == name]:
            return found
        name = re.split("[._]", name, maxsplit=1)[1] if re.search("[._]", name) else ""
    return []


def limits(name: str, plugin: str | None = None) -> tuple[float, float] | None:
    """Return a number's lowest and highest value, for a plugin parameter or for all with this name.

    None where there is no such parameter of a limited range, or it is an integer.
    """
    ranges = [(each.low, each.high) for each in declared(name, plugin) if each.unit and each.kind != "integer"]
    low, high = min((one for one, _ in ranges), default=-math.inf), max((one for _, one in ranges), default=math.inf)
    return None if -low == high == math.inf else (low, high)


def unit_of(name: str) -> str | None:
    """Return the unit of a parameter in a plugin or a shipped scene; None for texts and other names."""
    unit = next((each.unit for each in declared(name) if each.unit), None)
    return unit or next((unit for end, unit in _UNIT_OF_END.items() if name.endswith(end)), None)


def is_quantity(name: str) -> bool:
    """Return whether a parameter may be a measured quantity: not for bins, gates, estimators or random numbers."""
    found = declared(name)
    return not found or any(
        each.kind != "integer" and not any(each in one.parameters for one in _NOT_MEASURED) for each in found
    )
