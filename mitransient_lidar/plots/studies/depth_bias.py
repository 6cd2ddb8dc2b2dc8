"""Figure of the errors of an instrument's depths against the angle from nadir."""

from __future__ import annotations

import xarray as xr
from matplotlib.figure import Figure

from mitransient_lidar.plots import drawing

_COLUMNS = 3


def plot_depth_bias(found: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the biases of a result of `studies.depth_bias` against the angle, one panel for each sea, water and depth.

    Lines are those of the estimators, means over the channels, with the spread of single depths as bars.
    """
    cells = found[["bias", "spread"]].mean("pixel").stack(cell=("wind_speed", "water", "depth"))
    columns = min(_COLUMNS, cells.sizes["cell"])
    rows = -(-cells.sizes["cell"] // columns)
    figure = drawing.new_figure(path, 4.2 * columns + 1.6, 3.4 * rows + 0.5)
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False)
    names = [str(name) for name in found["estimator"].values]
    for number, ax in enumerate(axes.flat):
        if number >= cells.sizes["cell"]:
            ax.axis("off")
            continue
        one = cells.isel(cell=number)
        for name, colour in zip(names, drawing.pixel_colours(10), strict=False):
            bias, spread = (100 * one[part].sel(estimator=name).values for part in ("bias", "spread"))
            style = {"color": colour, "marker": "o", "markersize": 3.5, "linewidth": 1.3, "capsize": 2}
            ax.errorbar(found["off_nadir_deg"], bias, spread, label=name.replace("_", " "), **style)
        ax.axhline(0, color="0.5", linewidth=0.8)
        wind, water, depth = one["cell"].item()
        sea = f"{wind:g} m/s" if wind else f"level sea, ripples of {float(one['ripples']):g} m/s"
        ax.set_title(f"{sea}, Jerlov {water}, {depth:g} m", fontsize="medium")
        drawing.add_grid(ax)
    for ax in axes[-1]:
        ax.set_xlabel("angle from nadir (°)")
    for ax in axes[:, 0]:
        ax.set_ylabel("bias of the depth (cm), deep is positive")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False)
    figure.suptitle(f"{found.attrs['instrument']}, receiver {found.attrs['receiver']}")
    return drawing.save(figure, path)
