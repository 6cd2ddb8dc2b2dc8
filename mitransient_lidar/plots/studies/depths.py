"""Figures for an instrument's depths: their errors against the angle, their uncertainty, and survey orders."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure

from mitransient_lidar.analysis.depth_uncertainty import SURVEY_ORDERS
from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.plots.drawing import finish, name_sides, new_panels

#: Colours for the orders from the strictest on, for none, and for an unknown depth.
_ORDER_COLOURS = (*palette.ordered(5), "0.9")

#: Their names and letters, and the first one of a light colour.
_NAMES = (*(one.name for one in SURVEY_ORDERS), "none", "no depth")
_LETTERS, _LIGHT = (*(one.name[0].upper() for one in SURVEY_ORDERS), "–", ""), 2


def plot_depth_bias(found: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the biases in a result of `studies.depth_bias` against the angle, one panel for each sea, water and depth.

    Lines show the estimators, means over the channels, with the spread of single depths as bars.
    """
    cells = found[["bias", "spread"]].mean("pixel").stack(cell=("wind_speed", "water", "depth"))
    figure, axes, lowest, first = new_panels(path, cells.sizes["cell"], (4.2, 3.4), (1.6, 0.5), sharex=True)
    names = [str(name) for name in found["estimator"].values]
    for number, ax in enumerate(axes):
        one = cells.isel(cell=number)
        for name, mark in zip(names, palette.marked(len(names)), strict=True):
            bias, spread = (100 * one[part].sel(estimator=name).values for part in ("bias", "spread"))
            style = {"markersize": 4, "linewidth": 1.3, "capsize": 2, **mark}
            ax.errorbar(found["off_nadir_deg"], bias, spread, label=name.replace("_", " "), **style)
        wind, water, depth = one["cell"].item()
        sea = f"{wind:g} m/s" if wind else f"level sea, ripples of {float(one['ripples']):g} m/s"
        finish(ax, f"{sea}, Jerlov {water}, {depth:g} m", zero=0)
    name_sides(figure, lowest, "angle from nadir (°)", first, "bias of the depth (cm), deep is positive")
    figure.suptitle(f"{found.attrs['instrument']}, receiver {found.attrs['receiver']}")
    return drawing.save(figure, path)


def plot_uncertainty(found: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the total vertical uncertainty at 95 % against depth, one panel per water, with the S-44 orders.

    `found` is a result of `studies.depth_bias.tpu` at one altitude and angle. Lines with full markers show corrected
    depths, or measured ones without corrections; open markers show measured depths.
    """
    waters = found["water"].values
    figure, axes, lowest, first = new_panels(path, waters.size, (3.9, 3.1), (1.2, 0.6), sharex=True, sharey=True)
    winds = found["wind_speed"].values
    marks = palette.marked(winds.size, palette.ordered(winds.size))
    for number, (ax, water) in enumerate(zip(axes, waters, strict=True), start=1):
        _draw_orders(ax, float(found["depth"].max()), named=number in (3, 6, 9, waters.size))
        for wind, mark in zip(winds, marks, strict=True):
            one = found["tvu"].sel(water=water, wind_speed=wind)
            if one.sizes["correction"] > 1:
                ax.plot(found["depth"], one.isel(correction=0), ":", markersize=7, mfc="none", linewidth=0.8, **mark)
            ax.plot(found["depth"], one.isel(correction=-1), markersize=4.5, label=f"{wind:g} m/s", **mark)
        finish(ax, f"Jerlov {water}")
    axes[0].set_ylim(0, 1.15 * max(float(found["tvu"].fillna(0).max()), float(SURVEY_ORDERS[1].largest_tvu(0.0))))
    name_sides(figure, lowest, "depth (m)", first, "TVU at 95 % (m)", title="wind")
    figure.suptitle(_title(found, "total vertical uncertainty"))
    return drawing.save(figure, path)


def plot_orders(found: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the strictest S-44 order met against wind and water, one panel per depth.

    `found` is a result of `studies.depth_bias.tpu` at one altitude and angle; corrected depths count where there are
    any. Cells for omitted seas are empty.
    """
    depths = found["depth"].values
    figure = drawing.new_figure(path, 2.3 * depths.size + 1.8, 3.4)
    colours = ListedColormap(_ORDER_COLOURS)
    norm = BoundaryNorm(np.arange(len(_ORDER_COLOURS) + 1) - 0.5, len(_ORDER_COLOURS))
    axes = figure.subplots(1, depths.size, sharey=True, squeeze=False)[0]
    orders = found["order"].isel(correction=-1).transpose("water", "wind_speed", "depth").values
    rendered = found["found"].transpose("water", "wind_speed", "depth").notnull().values
    shown = np.where(rendered, np.where(orders < 0, len(_ORDER_COLOURS) - 1, orders), np.nan)
    for number, (ax, depth) in enumerate(zip(axes, depths, strict=True)):
        image = ax.imshow(shown[..., number], cmap=colours, norm=norm, origin="upper", aspect="auto")
        for (row, column), order in np.ndenumerate(shown[..., number]):
            if np.isfinite(order):
                colour = "white" if order < _LIGHT else "black"
                ax.text(column, row, _LETTERS[int(order)], ha="center", va="center", size=7, color=colour)
        ax.set_xticks(range(found.sizes["wind_speed"]), [f"{wind:g}" for wind in found["wind_speed"].values])
        ax.set_yticks(range(found.sizes["water"]), found["water"].values.tolist())
        ax.set_title(f"{depth:g} m", fontsize="medium")
        ax.set_xlabel("wind (m/s)")
    axes[0].set_ylabel("Jerlov type")
    bar = figure.colorbar(image, ax=axes, ticks=range(len(_ORDER_COLOURS)), pad=0.01)
    bar.ax.set_yticklabels([f"{letter}  {name}" for letter, name in zip(_LETTERS, _NAMES, strict=True)])
    bar.ax.invert_yaxis()
    figure.suptitle(_title(found, "order of S-44"))
    return drawing.save(figure, path)


def plot_forecast(found: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw a result of `studies.forecast.forecast`: its maps, or for a depth range the table against depth."""
    if "y" not in found.dims:
        return _plot_range(found, path)
    names = {"found": "probability that the bottom is found", "tvu": "TVU at 95 % (m)", "order": "order of S-44"}
    names["deepest"] = "deepest depth reached (m)"
    x, y = (found[axis].values for axis in "xy")
    tall = min(max(float(np.ptp(y) / np.ptp(x)), 0.4), 2.0)
    figure = drawing.new_figure(path, 12.0, 10.0 * tall + 1.2)
    for ax, (name, text) in zip(figure.subplots(2, 2, sharex=True, sharey=True).flat, names.items(), strict=True):
        values, style = found[name].values, {"vmin": 0.0, "vmax": 1.0} if name == "found" else {}
        wet = np.isfinite(found["found"].values)
        if name == "order":
            _draw_order_map(figure, ax, x, y, np.where(wet, values, np.nan))
        elif np.isfinite(values).any():
            figure.colorbar(ax.pcolormesh(x, y, values, cmap=palette.SEQUENCE, rasterized=True, **style), ax=ax)
        land = np.where(found["depth"].values <= 0, 1.0, np.nan)
        ax.pcolormesh(x, y, land, cmap=ListedColormap([palette.ORANGE]), rasterized=True)
        finish(ax, text, aspect="equal", xlabel="x (m)", ylabel="y (m)")
    figure.suptitle(_forecast_title(found))
    return drawing.save(figure, path)


def _draw_order_map(figure: Figure, ax: Axes, x: Any, y: Any, orders: Any) -> None:
    """Draw the orders that cells meet, with their names."""
    lost = len(_ORDER_COLOURS) - 1
    norm = BoundaryNorm(np.arange(lost + 2) - 0.5, lost + 1)
    shown = np.where(orders < 0, lost, orders)
    drawn = ax.pcolormesh(x, y, shown, cmap=ListedColormap(_ORDER_COLOURS), norm=norm, rasterized=True)
    bar = figure.colorbar(drawn, ax=ax, ticks=range(lost + 1))
    bar.ax.set_yticklabels(_NAMES)


def _plot_range(found: xr.Dataset, path: drawing.FilePath | None) -> Figure:
    """Draw the probability that the bottom is found, and TVU, against depth."""
    figure, (first, second), _, _ = new_panels(path, 2, (4.6, 3.6), (0.3, 0.4))
    first.plot(found["depth"], found["found"], color="0.1")
    first.plot(found["table_depth"].T, found["table_found"].T, "o", color="0.1", markersize=3)
    finish(first, xlabel="depth (m)", ylabel="probability that the bottom is found", ylim=(0, 1.02))
    deepest = float(found["depth"].max())
    _draw_orders(second, deepest, named=True)
    second.plot(found["depth"], found["tvu"], color="0.1")
    largest = float(np.nanmax(found["tvu"].values, initial=0.0))
    finish(second, xlabel="depth (m)", ylabel="TVU at 95 % (m)", ylim=(0, max(1.2 * largest, 0.6)))
    first.set_xlim(*second.get_xlim())
    figure.suptitle(_forecast_title(found))
    return drawing.save(figure, path)


def _forecast_title(found: xr.Dataset) -> str:
    place = "{altitude:g} m, {off_nadir_deg:g}° off nadir, wind {wind_speed:g} m/s".format(**found.attrs)
    return ", ".join(filter(None, (found.attrs["instrument"], place, found.attrs["water"])))


def _draw_orders(ax: Axes, deepest: float, *, named: bool) -> None:
    """Draw each order's largest vertical uncertainty, with its name on the right."""
    depth = np.linspace(0, 1.05 * deepest, 50)
    for one in SURVEY_ORDERS:
        ax.plot(depth, one.largest_tvu(depth), color="0.6", linewidth=0.9, linestyle="--")
        if named:
            end = (depth[-1], float(one.largest_tvu(depth[-1])))
            text: dict[str, Any] = {"va": "center", "color": "0.4", "textcoords": "offset points"}
            ax.annotate(one.name, end, (3, 0), annotation_clip=True, **text)
    ax.set_xlim(0, depth[-1])


def _title(found: xr.Dataset, text: str) -> str:
    depths = "corrected" if found.sizes["correction"] > 1 else "measured"
    place = f"{float(found['altitude']):g} m, {float(found['off_nadir_deg']):g}° off nadir"
    return f"{found.attrs['instrument']}, {place}: {text} of {depths} depths"
