"""Figure of the received power by order of scattering."""

from __future__ import annotations

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from mitransient_lidar.plots import drawing


def plot_scattering_orders(result: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw power by order of scattering, and the share of light with several reversals, summed over the pixels.

    `result` is that of `studies.scattering_orders.scattering_orders`.
    """
    figure = drawing.new_figure(path, 9.0, 6.0)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    time = result["time"].values
    by_order = result["waveform"].sum(("pixel", "reversals")).values
    total = by_order.sum(axis=0)
    several = result["waveform"].sel(reversals="several").sum(("pixel", "order")).values
    colours = matplotlib.colormaps["viridis"](np.linspace(0, 0.92, len(by_order)))
    upper.plot(time, total, color="black", linewidth=1.6, label="all")
    for order, (power, colour) in enumerate(zip(by_order, colours, strict=True)):
        label = f"≥ {order}" if order == len(by_order) - 1 else str(order)
        upper.plot(time, power, color=colour, linewidth=1.1, label=label)
    upper.set_yscale("log")
    upper.set_ylim(1e-5 * total.max(), 2 * total.max())
    upper.set_ylabel("received power (W)")
    upper.legend(title="scattering events", frameon=False, ncols=2, fontsize="small")
    lit = total > 1e-5 * total.max()
    lower.plot(time[lit], 100 * several[lit] / total[lit], color="#b3421f", linewidth=1.2)
    lower.set(xlabel=drawing.TIME_LABEL, ylabel="several\nreversals (%)")
    lower.set_ylim(bottom=0)
    for ax in (upper, lower):
        drawing.add_grid(ax)
    upper.set_title(str(result.attrs.get("scene", "")))
    return drawing.save(figure, path)
