"""Draw the pictures for the plugins' pages: ``python docs/images/draw_plugins.py [NAME ...]``.

The example on each page is completed to a scene by the defaults of the other plugins, rendered, and drawn to
``docs/images/plugins``. Most of the time is spent on compiling kernels.
"""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path

import mitransient_lidar  # before mitsuba: it finds LLVM for Dr.Jit

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "extensions"))

import mitsuba as mi
import numpy as np
from PIL import Image
from plugin_pages import DAYLIGHT, PASSES, RIPPLES, Plugin, example, plugins

from mitransient_lidar.plots.gates.images import plot_passive
from mitransient_lidar.plots.water import plot_phase_function
from mitransient_lidar.plots.waveforms import plot_waveforms
from mitransient_lidar.rendering.passive import render_passive

FOLDER = Path(__file__).resolve().parent / "plugins"

_PIXELS = '<string name="layout" value="1x1"/>'
_IMAGER = """<string name="layout" value="96x96"/><float name="field_of_view_mrad" value="240"/>
    <string name="field_of_view_shape" value="square"/><float name="off_nadir_deg" value="35"/>"""


def draw(plugin: Plugin, work: Path) -> None:
    """Render and draw a plugin's example."""
    angles = np.r_[0.1, 1:181]
    table = work / "harbour.csv"  # the file that the example of measured_phase reads: scattering by pure sea water
    np.savetxt(table, np.c_[angles, 0.0623 * (1 + 0.835 * np.cos(np.radians(angles)) ** 2)], delimiter=",")
    xml = example(plugin.manual, "xml").replace('"harbour.csv"', f'"{table}"')
    scene, picture = work / f"{plugin.name}.xml", FOLDER / f"{plugin.name}.png"
    scene.write_text(complete_scene(plugin, xml), encoding="utf-8")
    if plugin.name in DAYLIGHT:
        plot_passive(render_passive(scene, passes=PASSES), picture)
    else:
        plot_waveforms(mitransient_lidar.render(scene, passes=PASSES), picture)
    reduce_colours(picture)
    if plugin.kind == "phase":
        picture = FOLDER / f"{plugin.name}_angles.png"
        draw_phase_function(plugin.name, xml, picture)
        reduce_colours(picture)


def complete_scene(plugin: Plugin, xml: str) -> str:
    """Return an example's scene: the rest has the plugins' defaults."""
    by_day, kind = plugin.name in DAYLIGHT, plugin.kind
    phase = xml if kind == "phase" else ""
    water = xml if kind == "medium" else f'<medium type="layered_water" name="interior">{phase}</medium>'
    film = xml if kind == "film" else '<film type="time_gated_film"/>'
    ripples = xml if plugin.name == RIPPLES else ""
    solid = xml if kind == "bsdf" and plugin.name != RIPPLES else ""
    parts = {
        "integrator": f'<integrator type="{"passive_volpath" if by_day else "lidar_merging"}"/>',
        "emitter": f'<emitter type="{"sun" if by_day else "lidar_transmitter"}"/>',
        "sensor": f'<sensor type="multipixel_receiver">{_IMAGER if by_day else _PIXELS}{film}</sensor>',
        "ocean_surface": f'<shape type="ocean_surface">{water}{ripples}</shape>',
        "seabed": f'<shape type="seabed">{solid}</shape>',
    }
    place = plugin.name if plugin.name in parts else kind
    if place in parts:
        parts[place] = xml
    return '<scene version="3.0.0">\n' + "\n".join(parts.values()) + "\n</scene>\n"


def draw_phase_function(name: str, xml: str, path: Path) -> None:
    """Draw an example's phase function, evaluated by the plugin."""
    phase = mi.load_string(re.sub("^<phase ", '<phase version="3.0.0" ', xml))

    def value(theta: np.ndarray) -> np.ndarray:
        event = mi.MediumInteraction3f()
        event.wi = mi.Vector3f(0, 0, -1)
        outgoing = mi.Vector3f(mi.Float(np.sin(theta)), 0, mi.Float(np.cos(theta)))
        return np.asarray(phase.eval_pdf(mi.PhaseFunctionContext(), event, outgoing)[1])

    plot_phase_function(value, name, f"phase function of the example of {name}", path)


def reduce_colours(path: Path) -> None:
    """Write a picture again with 64 colours, 900 pixels wide: a quarter of its size."""
    with Image.open(path) as picture:
        scaled = picture.convert("RGB").resize((900, round(900 * picture.height / picture.width)), Image.LANCZOS)
    scaled.quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)


def main(names: list[str]) -> None:
    """Draw the pictures for some plugins, or for all."""
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as work:
        for plugin in plugins():
            if not names or plugin.name in names:
                draw(plugin, Path(work))
                print(plugin.name, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
