"""Reference of the plugins: one page each, its class docstring, with its example rendered."""

from __future__ import annotations

import importlib
import inspect
import re
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from generated import remove_others, write

from mitransient_lidar.loading.variants import PLUGIN_MODULES

if TYPE_CHECKING:
    from sphinx.application import Sphinx

#: Passes of the pictures: enough for errors that are hardly seen.
PASSES = 8
#: Plugins that only daylight shows.
DAYLIGHT = ("sun", "sky", "passive_volpath")
#: BSDF of the sea; others are of solids.
RIPPLES = "gram_charlier_dielectric"

#: Kinds by the name of Mitsuba's function that registers them, in the order of the index.
_KINDS = {
    "emitter": "Emitters",
    "sensor": "Sensors",
    "film": "Films",
    "shape": "Shapes",
    "medium": "Media",
    "phase": "Phase functions",
    "bsdf": "BSDFs",
    "integrator": "Integrators",
}

_INTRODUCTION = """\
Plugins
=======

The parts of a scene that this package adds to Mitsuba. Any Mitsuba shape, BSDF or phase function works with them. A
page is the docstring of the plugin's class. Both forms of its example are loaded by a test; the picture is a render of
it by ``python docs/images/draw_plugins.py``.
"""


class Plugin(NamedTuple):
    """A plugin: name, kind as in `_KINDS`, and docstring."""

    name: str
    kind: str
    manual: str


def setup(sphinx: Sphinx) -> dict[str, bool]:
    """Write the pages when the build starts."""
    sphinx.connect("builder-inited", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def plugins() -> list[Plugin]:
    """Return the plugins by kind, in the order of `_KINDS`, and by name."""
    found = []
    for name, (place, kind) in PLUGIN_MODULES.items():
        module = importlib.import_module(f"mitransient_lidar.plugins.{place}")
        manuals = {one.__doc__ for one in vars(module).values() if isinstance(one, type)}
        (manual,) = (text for text in manuals if text and f"(``{name}``)" in text.partition("\n")[0])
        found.append(Plugin(name, kind, inspect.cleandoc(manual)))
    return sorted(found, key=lambda one: (list(_KINDS).index(one.kind), one.name))


def _write(sphinx: Sphinx) -> None:
    folder = Path(sphinx.srcdir) / "reference" / "plugins"
    found = plugins()
    for plugin in found:
        write(folder / f"{plugin.name}.rst", _page(plugin))
    write(folder / "index.rst", _index(found))
    remove_others(folder, ["index.rst", *(f"{plugin.name}.rst" for plugin in found)])


def _index(found: list[Plugin]) -> str:
    """Return the index: a table for each kind."""
    parts = [_INTRODUCTION]
    for kind, title in _KINDS.items():
        rows = [f"   * - :doc:`{one.name}`\n     - {_summary(one)}" for one in found if one.kind == kind]
        parts.append(f"{title}\n{'-' * len(title)}\n\n.. list-table::\n   :widths: 35 65\n\n" + "\n".join(rows) + "\n")
    contents = "".join(f"   {one.name}\n" for one in found)
    return "\n".join([*parts, f".. toctree::\n   :hidden:\n\n{contents}"])


def _summary(plugin: Plugin) -> str:
    """Return the first line of the manual without the plugin's name."""
    return plugin.manual.partition("\n")[0].partition(" (``")[0]


def pictures(plugin: Plugin) -> dict[str, str]:
    """Return the legends for a plugin's pictures by their files in ``docs/images/plugins``."""
    legends = {}
    if plugin.kind == "phase":
        legends[f"{plugin.name}_angles.png"] = "The phase function of this example against the scattering angle."
    place = {
        "phase": "in the water",
        "medium": "as the water",
        "film": "in a receiver of one pixel",
        "bsdf": "on the sea" if plugin.name == RIPPLES else "on the bottom",
    }.get(plugin.kind, "in a scene")
    shown = "radiance by daylight" if plugin.name in DAYLIGHT else "waveform, above linear and below logarithmic"
    legends[f"{plugin.name}.png"] = (
        f"This example {place}, the rest at the defaults of the plugins: {shown}; {PASSES} passes."
    )
    return legends


def _page(plugin: Plugin) -> str:
    """Return the page: the manual with sections, its examples side by side, and pictures."""
    _, _, rest = plugin.manual.partition("\n")
    text, xml_block, _ = rest.partition(".. code-block:: xml")
    assert xml_block, f"{plugin.name}: no example in XML"
    # The table of parameters comes first; it has a class for the style sheet.
    table, prose = re.fullmatch(r"(.. list-table::\n(?:   .*\n|\n)+)(.*)", text.strip(), re.DOTALL).groups()
    prose = re.sub(r"doi:(10\.\S*[^\s.,;)])", r"`doi:\1 <https://doi.org/\1>`__", prose)
    text = f"Parameters\n----------\n\n.. rst-class:: parameters\n\n{table}\n{prose}\n"
    tabs = "".join(
        f"   .. tab-item:: {title}\n\n      .. code-block:: {language}\n\n"
        + textwrap.indent(example(plugin.manual, language), " " * 9)
        + "\n\n"
        for title, language in (("XML", "xml"), ("Python", "python"))
    )
    figures = "".join(
        f".. figure:: ../../images/plugins/{file}\n\n   {legend}\n\n" for file, legend in pictures(plugin).items()
    )
    title = plugin.name
    return (
        f"{title}\n{'=' * len(title)}\n\n{_summary(plugin)}. Kind: {plugin.kind}.\n\n{text}\n"
        f"Example\n-------\n\n.. tab-set::\n\n{tabs}{figures}"
    )


def example(manual: str, language: str) -> str:
    """Return a manual's example in ``xml`` or ``python``."""
    block = re.search(rf"^\.\. code-block:: {language}\n\n((?:(?: .*)?\n?)+)", manual, re.MULTILINE)
    assert block is not None
    return textwrap.dedent(block[1]).strip()
