"""Panels in study figures: several of one kind, and the elements that each has."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mitransient_lidar.plots import drawing

_COLUMNS = 3  # panels side by side


def new_panels(
    path: drawing.FilePath | None, count: int, size: tuple[float, float], margin: tuple[float, float], **shared: Any
) -> tuple[Figure, list[Axes], list[Axes], list[Axes]]:
    """Return a figure with panels, a size in inches each, at most three side by side; all, the lowest and first panels.

    `margin` is added to width and height, and `shared` states which axes are.
    """
    columns = min(_COLUMNS, count)
    rows = -(-count // columns)
    figure = drawing.new_figure(path, size[0] * columns + margin[0], size[1] * rows + margin[1])
    axes = figure.subplots(rows, columns, squeeze=False, **shared)
    for ax in axes.flat[count:]:
        ax.axis("off")
    shown = list(axes.flat[:count])
    return figure, shown, shown[-columns:], shown[::columns]


def finish(
    ax: Axes, title: str = "", *, grid: Literal["both", "x"] = "both", zero: float | None = None, **given: Any
) -> None:
    """Add a title, a grid and a line at a value to a panel, and set labels, limits and scales that are given."""
    if title:
        ax.set_title(title, fontsize="medium")
    if zero is not None:
        ax.axhline(zero, color="0.6", linewidth=0.8)
    ax.set(**given)
    drawing.add_grid(ax, grid)


def name_sides(
    figure: Figure, lowest: Sequence[Axes], x: str, first: Sequence[Axes], y: str, title: str | None = None
) -> None:
    """Label the axes below and to the left of panels, and list the first one's curves on the right."""
    for ax in lowest:
        ax.set_xlabel(x)
        ax.tick_params(labelbottom=True)
    for ax in first:
        ax.set_ylabel(y)
    handles, labels = first[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False, title=title)
