"""Colours, line styles and markers for all figures and pages.

Readers with any colour blindness tell the colours in `CATEGORIES` apart. The closest two differ by 18 CIEDE2000 units,
in normal vision and in simulated protanopia, deuteranopia and tritanopia. Curves also differ in line style or marker.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.colors import to_hex

from mitransient_lidar.results.attributes import PointClass

#: Colours of things without an order; the first four are those of the published pixels.
CATEGORIES = RED, GREEN, BLUE, BLACK, ORANGE, SKY, PURPLE = (
    *("#cc3e02", "#168d65", "#014c7f", "#111111"),
    *("#ebb014", "#83b4fa", "#ad709b"),
)

#: Lines of reference, limits and truth.
GREY = "#777777"

BEAM, VIEW, SEA, BOTTOM, TARGET, LAYER = ORANGE, BLACK, SKY, RED, PURPLE, GREY  #: Parts of a scene.
ORIGINS = {"surface": SKY, "water": BLUE, "bottom": BOTTOM, "target": TARGET}  #: Components of the received light.

#: Points of a flight.
CLASSES = {
    PointClass.GROUND: ORANGE,
    PointClass.UNCLASSIFIED: PURPLE,
    PointClass.SURFACE: SKY,
    PointClass.BOTTOM: BLUE,
    PointClass.OBJECT: RED,
    PointClass.NO_ECHO: BLACK,
}

#: Waves from troughs to crests, and bottoms from the reflectance of wet mud to that of white sand, on pages of scenes.
WAVES = [[0.0, "#1f78b4"], [1.0, "#b5e2fa"]]
SAND = [[0.0, "#4a3b2a"], [0.2, "#957d5b"], [0.6, "#d3bd95"], [1.0, "#faf4e4"]]

#: Colour maps of quantities, of signed quantities, of light, and of the elevation of a sea.
SEQUENCE, SIGNED, LIGHT, ELEVATION = "viridis", "RdBu_r", "magma", "Blues_r"

_LINES = ("-", (0, (6, 1.6)), (0, (6, 1.6, 1.4, 1.6)), (0, (1.4, 1.4)), (0, (3, 1.2)), (0, (9, 2.5)), (0, (3, 1, 1, 1)))
_MARKERS = "os^Dv<>"


def ordered(count: int) -> list[str]:
    """Return colours of things with an order, from dark to light."""
    return [to_hex(colour) for colour in matplotlib.colormaps[SEQUENCE](np.linspace(0.0, 0.92, count))]


def pixel_colours(count: int) -> list[str]:
    """Return a colour for each pixel; for four pixels red, green, blue and black, as in the published figures."""
    if count == 1:
        return [BLACK]
    return list(CATEGORIES[:count]) if count <= len(CATEGORIES) else ordered(count)


def curves(count: int, colours: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Return each curve's colour and line style, by default with the pixels' colours."""
    return [{"color": c, "linestyle": _LINES[i % len(_LINES)]} for i, c in enumerate(colours or pixel_colours(count))]


def marked(count: int, colours: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Return colour and marker for each point series, or for curves whose line style has another meaning."""
    return [{"color": c, "marker": _MARKERS[i % len(_MARKERS)]} for i, c in enumerate(colours or pixel_colours(count))]
