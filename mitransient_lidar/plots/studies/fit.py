"""Figure of a fit: waveforms with their errors, the fitted model, and the differences."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from mitransient_lidar.plots import drawing

_SHOWN = 12  # pixels that are drawn; more would hide each other


def plot_fit(fitted: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw measured and fitted waveforms above their differences in standard deviations, one colour a pixel.

    `fitted` is a result of `studies.fit.fit`. Of more than 12 pixels, those with the largest peaks are drawn. The title
    gives the values with their standard errors.
    """
    time = fitted["time"].values
    rows = {name: fitted[name].values.reshape(-1, time.size) for name in ("measured", "measured_stderr", "fitted")}
    residual, used = (fitted[name].values.reshape(-1, time.size) for name in ("residual", "used"))
    strongest = np.sort(np.argsort(-rows["fitted"].max(axis=-1), kind="stable")[:_SHOWN])
    names = fitted["pixel"].values if "pixel" in fitted.coords else np.arange(len(residual)).astype(str)
    figure = drawing.new_figure(path, 9.6, 6.4)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.4, 1.0))
    shown = used[strongest].any(axis=0)
    for pixel, colour in zip(strongest, drawing.pixel_colours(strongest.size), strict=True):
        values = np.where(used[pixel] > 0, rows["measured"][pixel], np.nan)
        error = np.nan_to_num(rows["measured_stderr"][pixel])
        style = {"color": colour, "markersize": 2.5, "elinewidth": 0.7, "alpha": 0.75}
        upper.errorbar(time, values, error, fmt=".", label=str(names[pixel]), **style)
        upper.plot(time, np.where(used[pixel] > 0, rows["fitted"][pixel], np.nan), color=colour, linewidth=1.1)
        lower.plot(time, residual[pixel], ".", color=colour, markersize=3)
    peak = float(np.nanmax(rows["fitted"][strongest]))
    # Noise would fill the lower decades of a logarithmic axis.
    noise = float(np.median(np.nan_to_num(rows["measured_stderr"][strongest])))
    linear = min(max(1e-3 * peak, 3 * noise), 0.3 * peak)
    upper.set_yscale("symlog", linthresh=linear, linscale=0.5)
    upper.set_ylim(-linear, 2 * peak)
    upper.set_ylabel(f"waveform ({fitted['measured'].attrs.get('units') or 'any unit'})")
    upper.legend(frameon=False, ncols=2 if strongest.size > 4 else 1)
    lower.set_xlim(time[shown][0], time[shown][-1])
    lower.set(xlabel=drawing.TIME_LABEL, ylabel="difference\n(standard deviations)")
    lower.axhline(0, color="0.5", linewidth=0.8)
    for ax in (upper, lower):
        drawing.add_grid(ax)
    columns = (fitted[name].values for name in ("parameter", "value", "stderr"))
    text = ", ".join(f"{name} {value:.4g} ± {error:.2g}" for name, value, error in zip(*columns, strict=True))
    figure.suptitle(drawing.titled(fitted.attrs, text), fontsize="medium", wrap=True)
    return drawing.save(figure, path)
