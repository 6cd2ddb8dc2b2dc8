"""All declared parameters, by plugin and by name: ranges, units and files of parameters of scenes."""

from __future__ import annotations

import math

from mitransient_lidar.core.parameters import bottom, integrators, lidar, sea, water
from mitransient_lidar.core.parameters.fields import Parameter, Plugin

#: Declarations of the plugins by name.
PLUGINS: dict[str, Plugin] = {
    each.name: each
    for module in (lidar, sea, water, bottom, integrators)
    for each in vars(module).values()
    if isinstance(each, Plugin)
}

#: Names of parameters whose value is the name of a file.
FILE_PARAMETERS = tuple(dict.fromkeys(each.name for plugin in PLUGINS.values() for each in plugin if each.is_file))

#: Units of parameters of shipped scenes, which have names of their own, by the ends of these.
_UNIT_OF_END = {
    **{"_deg": "degree", "_reflectance": "1", "_seed": "1", "_count": "1", "_time": "s"},
    **{f"_{end}": "m" for end in ("x", "y", "depth", "height", "size", "length", "width", "left", "middle", "right")},
    "_wave": "m",
}


def limits(name: str, plugin: str | None = None) -> tuple[float, float] | None:
    """Return lowest and highest value of a number, a parameter of a plugin or of all that have one of this name.

    None where there is no such parameter of a limited range, or it is an integer.
    """
    ranges = [(each.low, each.high) for each in _declared(name, plugin) if each.unit and each.kind != "integer"]
    low, high = min((one for one, _ in ranges), default=-math.inf), max((one for _, one in ranges), default=math.inf)
    return None if -low == high == math.inf else (low, high)


def unit_of(name: str) -> str | None:
    """Return the unit of a parameter of a plugin or a shipped scene; None for texts and other names."""
    unit = next((each.unit for each in _declared(name) if each.unit), None)
    return unit or next((unit for end, unit in _UNIT_OF_END.items() if name.endswith(end)), None)


def _declared(name: str, plugin: str | None = None) -> list[Parameter]:
    """Return the parameters of a name."""
    plugins = PLUGINS.values() if plugin is None else filter(None, [PLUGINS.get(plugin)])
    return [each for one in plugins for each in one if each.name == name]
