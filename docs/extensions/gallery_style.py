"""Colours, sizes of texts and places of legends of the gallery's figures: those of the package."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
from cycler import cycler
from sphinx_gallery.scrapers import matplotlib_scraper

from mitransient_lidar.plots import palette
from mitransient_lidar.plots.drawing import make_legible


def use_palette(_gallery: dict[str, Any], _name: str) -> None:
    """Draw curves in the package's colours and line styles."""
    styles = palette.curves(len(palette.CATEGORIES))
    colours, lines = (cycler(key, [one[key] for one in styles]) for key in ("color", "linestyle"))
    plt.rcParams["axes.prop_cycle"] = colours + lines


def scrape(*given: Any, **options: Any) -> str:
    """Save the figures of a block of a script, after making them legible."""
    for number in plt.get_fignums():
        figure = plt.figure(number)
        make_legible(figure, figure.canvas.get_renderer())
    return matplotlib_scraper(*given, **options)
