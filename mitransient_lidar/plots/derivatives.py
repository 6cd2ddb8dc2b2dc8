"""Figures for waveform derivatives by scene parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots import drawing, palette

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

#: Panel height [inch], and largest number of panels.
_PANEL, _MOST = 1.5, 12

#: Share of the largest power below which relative changes are not drawn.
_SMALLEST = 1e-3


def plot_derivatives(dataset: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw how much the waveform over all pixels changes where a parameter grows, with its standard error.

    A panel for each parameter, below the waveform: the change in percent for 1 % more of the parameter, where the power
    is at least a thousandth of the largest. Pixels share photons, so that the error of their sum is unknown; the band
    over several pixels is an upper bound, the sum of their errors.

    Raises UserError if the result has no derivatives.

    Parameters
    ----------
    dataset : xarray.Dataset
        A result of `rendering.render.render` with derivatives, for one shot.
    path : path, optional
        File to write.
    """
    name = "waveform_derivative"
    if name not in dataset or "shot" in dataset[name].dims:
        raise UserError(f"the dataset has no variable {name} of one shot: render it with derivatives")
    pixels = [dim for dim in dataset["waveform"].dims if dim != "time"]
    power = dataset["waveform"].sum(pixels).values
    slopes = dataset[name].sum(pixels).transpose("parameter", "time").values
    errors = dataset[f"{name}_stderr"].sum(pixels).transpose("parameter", "time").values
    parameters = [str(one) for one in dataset["parameter"].values][:_MOST]
    lit = power > _SMALLEST * np.nanmax(power, initial=0.0)
    factor, prefix = drawing.si_prefix(float(np.nanmax(power, initial=0.0)) or 1.0)
    figure = drawing.new_figure(path, 8.0, _PANEL * (len(parameters) + 1.4))
    panels = figure.subplots(len(parameters) + 1, 1, sharex=True, squeeze=False)[:, 0]
    panels[0].plot(dataset["time"], power / factor, color="black", linewidth=1.3)
    panels[0].set_ylabel(f"power ({prefix}W)")
    for number, (parameter, ax) in enumerate(zip(parameters, panels[1:], strict=True)):
        value = float(dataset["parameter_value"].values[number])
        scale = np.where(lit, (value or 1.0) / np.where(lit, power, 1.0), np.nan)
        change, spread = slopes[number] * scale, errors[number] * np.abs(scale)
        time, colour = dataset["time"].values, palette.CATEGORIES[number % len(palette.CATEGORIES)]
        ax.axhline(0, color="0.6", linewidth=0.8)
        ax.fill_between(time, change - spread, change + spread, color=colour, alpha=0.35, linewidth=0)
        ax.plot(time, change, color=colour, linewidth=1.2)
        unit = str(dataset["parameter_units"].values[number])
        shown = f"{parameter} = {value:.4g}" + ("" if unit == "1" else f" {unit}")
        ax.set_title(shown, loc="left", fontsize="medium", pad=3)
        ax.set_ylabel("% per %" if value else "relative")
    panels[-1].set_xlabel(drawing.TIME_LABEL)
    for ax in panels:
        ax.set_xlim(drawing.time_limits(dataset))
        drawing.add_grid(ax, hide=("right", "top"))
    bands = "standard errors" if dataset["waveform"].isel(time=0).size == 1 else "upper bounds of standard errors"
    text = f"change of the received power with parameters of the scene; bands, where wider than lines: {bands}"
    figure.suptitle(text, fontsize="medium")
    return drawing.save(figure, path)
