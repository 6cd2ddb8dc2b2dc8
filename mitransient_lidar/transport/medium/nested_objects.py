"""Objects that a plugin makes within its constructor."""

from __future__ import annotations

from typing import Any

import mitsuba as mi


def create_object(kind: str, **values: Any) -> Any:
    """Return a Mitsuba object of a plugin type with given parameters, nested objects among them.

    Constructors must not call ``mitsuba.load_dict``. It replaces Mitsuba's file resolver while it works;
    ``mitsuba.load_file`` makes objects in several threads. One may just use the resolver to find a plugin's library: 5
    to 15 % of processes then failed in their first load, as with "basic_string::_M_create".
    """
    properties = mi.Properties(kind)
    for name, value in values.items():
        properties[name] = value
    return mi.PluginManager.instance().create_object(properties)
