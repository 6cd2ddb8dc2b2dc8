"""Names of the parameters of our plugins, from their manual pages, and messages about unknown ones."""

from __future__ import annotations

import difflib
import functools
import importlib
import inspect
import re


def unknown_parameters(message: str) -> str | None:
    """Return the sentence for Mitsuba's message about parameters that a plugin does not have, or about no plugin."""
    if found := re.search(r'unreferenced propert\w+ in [\w ]+ of type "(\w+)":((?:\s+- \w+ "[^"]+"[^"]*)+)', message):
        allowed = plugin_parameters(found[1])
        names = re.findall(r'- \w+ "([^"]+)"', found[2])
        close = [near for name in names for near in difflib.get_close_matches(name, allowed, n=1)]
        hint = f"did you mean {' and '.join(close)}" if close else f"it has {', '.join(allowed)}"
        return f"{found[1]}: there is no parameter {' or '.join(names)}" + (f"; {hint}" if allowed else "")
    if found := re.search(r'Plugin "([^"]*)" not found', message):
        close = difflib.get_close_matches(found[1], [*_plugin_modules(), *_OTHERS], n=2)
        return f"type = {found[1]!r} is not a plugin" + (f"; did you mean {' or '.join(close)}" if close else "")
    return None


@functools.cache
def plugin_parameters(plugin: str) -> list[str]:
    """Return the names of the parameters in the manual page of one of our plugins, empty for other plugins."""
    module = _plugin_modules().get(plugin)
    if module is None:
        return []
    classes = [one for one in vars(importlib.import_module(module)).values() if isinstance(one, type)]
    names: list[str] = []
    for page in (inspect.cleandoc(one.__doc__ or "") for one in classes):
        rules = list(re.finditer(r"^(=+)  =[= ]+$", page, re.MULTILINE))
        if f"``{plugin}``" in page and len(rules) >= 3:
            rows = page[rules[1].end() : rules[2].start()].splitlines()
            cells = ", ".join(row[: len(rules[0][1])] for row in rows)
            names += re.findall(r"(?<![\w(.])[a-z]\w*(?![\w).])", cells)
    return list(dict.fromkeys(names))


#: Plugins of Mitsuba that lidar scenes use.
_OTHERS = ("rectangle", "sphere", "cylinder", "cube", "disk", "ply", "obj", "diffuse", "twosided", "dielectric", "hg")


def is_own_plugin(plugin: str) -> bool:
    """Return whether a plugin is one of ours."""
    return plugin in _plugin_modules()


def _plugin_modules() -> dict[str, str]:
    """Return the modules of our plugins by the plugins' names."""
    from mitransient_lidar.loading.variants import PLUGIN_MODULES

    return {name.rpartition(".")[2]: f"mitransient_lidar.plugins.{name}" for name in PLUGIN_MODULES}
