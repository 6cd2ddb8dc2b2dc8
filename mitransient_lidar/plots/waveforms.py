"""Figures for a result: a few pixels' waveforms with their derivatives, or an imager's image and summed waveform."""

from __future__ import annotations

import json
from typing import Literal, NamedTuple, get_args

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mitransient_lidar.analysis.comparison import Comparison
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.results.geometry import LinesOfSight, lidar_geometry, optional_number
from mitransient_lidar.results.waveform_files import FILE

Scale = Literal["both", "linear", "log"]

_DECADES = 7  # at most, on a logarithmic axis


def plot_waveforms(dataset: xr.Dataset, path: drawing.FilePath | None = None, scale: Scale = "both") -> Figure:
    """Draw a result's waveforms or recorded signals; for an imager each pixel's total and the summed waveform.

    Bands are +-1 standard error; for a shot series, the curve is the mean over the shots, and the band contains 90 % of
    them. Depth is (t - t_surface) c0 / (2 n_g) cos(theta_water), along the line of sight for one pixel, and on the
    receiver's axis for several. Pixels are drawn in the shapes of their outlines, or as dots without them. The depth
    axis is left out if the result lacks its attributes.

    `dataset`: a result in the form of `mitransient_lidar.results.dataset`, or a record from
    `analysis.receiver.detect_waveforms`; one shot or several. `path`: file to write. `scale`: power axis scale; 'both'
    draws two panels.
    """
    if scale not in get_args(Scale):
        raise UserError(f"scale = {scale!r} must be one of {', '.join(get_args(Scale))}")
    panels = ["linear", "log"] if scale == "both" else [scale]
    figure = drawing.new_figure(path, 9.6, 4.3 if len(panels) == 1 else 6.0)
    is_image = "pixel" not in dataset.dims
    grid = figure.add_gridspec(len(panels), 2, width_ratios=(1.6, 1.0) if is_image else (4.2, 1.3))
    axes: list[Axes] = []
    for row in range(len(panels)):
        axes.append(figure.add_subplot(grid[row, 0], sharex=axes[0] if axes else None))
    curves = _curves(dataset)
    (_draw_image if is_image else _draw_pixels)(figure.add_subplot(grid[:, 1]), dataset)
    for ax, panel in zip(axes, panels, strict=True):
        _draw_waveforms(ax, dataset, curves, log=panel == "log")
    for ax in axes[:-1]:
        ax.tick_params(labelbottom=False)
    axes[-1].set_xlabel(drawing.time_label(dataset))
    _add_depth_axis(axes[0], dataset)
    figure.suptitle(_title(dataset), fontsize="large")
    return drawing.save(figure, path)


def plot_components(dataset: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the waveform over all pixels by light origin: stacked areas, and curves on a logarithmic axis.

    For a shot series, it is their mean.

    Raises UserError if the result's light was not separated. `dataset`: a result of `rendering.render.render`, or a
    shot series, with components. `path`: file to write.
    """
    name = "waveform_by_origin"
    if name not in dataset:
        raise UserError(f"the dataset has no variable {name}: render it with components")
    parts = dataset[name].mean({"shot"} & set(dataset[name].dims)).transpose("origin", ..., "time")
    power = parts.sum([dim for dim in parts.dims if dim not in ("origin", "time")]).values
    time, limits = dataset["time"].values, drawing.time_limits(dataset)
    names = [str(one) for one in dataset["origin"].values]
    styles = [
        {**style, "color": palette.ORIGINS.get(one, style["color"])}
        for one, style in zip(names, palette.curves(len(names)), strict=True)
    ]
    top = float(np.nanmax(power.sum(axis=0), initial=0.0)) or 1.0
    factor, prefix = drawing.si_prefix(top)
    figure = drawing.new_figure(path, 8.0, 6.0)
    upper, lower = figure.subplots(2, 1, sharex=True)
    colours = [style["color"] for style in styles]
    upper.stackplot(time, power / factor, colors=colours, labels=names, linewidth=0)
    for values, style, label in zip(power / factor, styles, names, strict=True):
        lower.plot(time, np.where(values > 0, values, np.nan), linewidth=1.3, label=label, **style)
    lower.set(yscale="log", ylim=(1e-5 * top / factor, 2 * top / factor), xlabel=drawing.TIME_LABEL)
    for ax in (upper, lower):
        ax.legend(frameon=False)
        drawing.finish(ax, hide=("right",), xlim=limits, ylabel=f"received power ({prefix}W)")
    _add_depth_axis(upper, dataset)
    figure.suptitle(f"{_title(dataset, 'mean')}  ·  by origin", fontsize="large")
    return drawing.save(figure, path)


class _Curves(NamedTuple):
    """Curves, their bands below and above, and their errors, in a unit, over (pixel, time) without the band's."""

    power: FloatArray
    band: FloatArray
    error: FloatArray
    label: str
    unit: str


def _curves(dataset: xr.Dataset) -> _Curves:
    """Return a result's curves, or the means over a series' shots with the band that contains 90 % of them."""
    recorded = "signal" in dataset
    name = "signal" if recorded else "waveform"
    values = dataset[name]
    if {*values.dims} - {"shot"} not in ({"pixel", "time"}, {"row", "column", "time"}):
        allowed = "(pixel, time) or (row, column, time)"
        raise UserError(f"{name} has the dimensions {values.dims}: it must be over {allowed}")
    error = dataset.get("signal_deviation" if recorded else "waveform_stderr")
    if error is None:  # of a lidar's waveforms, where the spread of the shots is that of the ground
        error = xr.zeros_like(values)
    if "pixel" not in values.dims:
        # Pixels share photons: their errors do not add up in quadrature, and the error of the sum is unknown.
        values, error = (one.sum(("row", "column")).expand_dims("pixel", -2) for one in (values, 0 * error))
    power, spread = values.values, error.values
    if "shot" in values.dims:
        power = values.mean("shot").values
        band = np.abs(np.quantile(values.values, [0.05, 0.95], axis=0) - power)
        spread = np.sqrt((error.broadcast_like(values) ** 2).sum("shot").values) / values.sizes["shot"]
    else:
        band = np.stack([spread, spread])
    unit = str(values.attrs.get("units", "")) if recorded else "W"
    return _Curves(power, band, spread, "recorded signal" if recorded else "received power", unit)


def _draw_waveforms(ax: Axes, dataset: xr.Dataset, curves: _Curves, *, log: bool) -> None:
    """Draw curves in a suitable unit."""
    power, error = curves.power, curves.error
    time, limits = dataset["time"].values, drawing.time_limits(dataset)
    inside = (time >= limits[0]) & (time <= limits[1])
    shown = power[:, inside]
    # A logarithmic axis ends where the signal falls below three standard errors.
    significant = shown[np.isfinite(shown) & (shown > 0) & ~(shown < 3.0 * error[:, inside])]
    top = float(significant.max()) if significant.size else 1.0
    if "shot" in dataset.dims:
        top = max(top, float((power + curves.band[1])[:, inside].max()))
    factor, prefix = drawing.si_prefix(top)
    floor = top * 1e-3
    if curves.unit == "1":
        factor, prefix = 1.0, ""
    if significant.size:
        floor = max(0.5 * float(np.quantile(significant, 0.01)), top * 10.0**-_DECADES)
    bands = np.moveaxis(curves.band / factor, 1, 0)
    for values, spread, style in zip(power / factor, bands, palette.curves(len(power)), strict=True):
        if len(power) <= drawing.LISTED_PIXELS:
            lowest = 1e-3 * floor / factor if log else -np.inf
            drawing.draw_band(ax, time, values, spread, lowest=lowest, linewidth=1.3, **style)
        else:
            ax.plot(time, values, color=style["color"], linewidth=0.6)
    low = floor if log else min(0.0, float(np.nanmin(shown, initial=0.0)))
    ax.set(yscale="log" if log else "linear", ylim=(low / factor, top / factor * (2.0 if log else 1.08)))
    label = f"{curves.label} ({prefix}{curves.unit})" if curves.unit != "1" else f"{curves.label} per bin"
    drawing.finish(ax, hide=("right",), xlim=limits, ylabel=label)


def _add_depth_axis(ax: Axes, dataset: xr.Dataset) -> None:
    try:
        geometry = lidar_geometry(dataset.attrs, surface="measured")
        zero, metres_per_ns, label = geometry.surface_time_ns, geometry.depth_per_ns, "depth on the axis (m)"
        if dataset.sizes.get("pixel") == 1:
            line = LinesOfSight.from_dataset(dataset)
            zero, metres_per_ns, label = line.surface_time.item(), line.depth_per_ns.item(), "depth (m)"
    except UserError:
        return
    drawing.add_top_axis(ax, -zero * metres_per_ns, metres_per_ns, label)


def _draw_pixels(ax: Axes, dataset: xr.Dataset) -> None:
    """Draw the pixels in the field of view: far from nadir on top, +angle_y to the left."""
    attributes, names = dataset.attrs, [str(name) for name in dataset["pixel"].values]
    colours, curves = palette.pixel_colours(len(names)), palette.curves(len(names))
    ax.set_axis_off()
    if len(names) <= drawing.LISTED_PIXELS:
        legend = ax.legend(
            handles=[Line2D([], [], label=name, **style) for name, style in zip(names, curves, strict=True)],
            loc="upper center",
            bbox_to_anchor=(0.5, -0.08),
            ncols=1 if len(names) <= 4 else 2,
            frameon=False,
            handlelength=3.0,
        )
        legend.set_in_layout(False)  # it fits into the space below the square axes
    ax.set_anchor("N")
    points = np.stack([dataset["angle_y"].values, dataset["angle_x"].values], axis=-1)
    outlines = json.loads(attributes.get("pixel_outlines", "[]"))  # lines angle_x, angle_y, ... for each [mrad]
    if len(outlines) == len(names) and all(outlines):
        shapes = [[np.reshape([*line, *line[:2]], (-1, 2))[:, ::-1] for line in lines] for lines in outlines]
        for loops, colour in zip(shapes, colours, strict=True):
            ax.add_patch(drawing.outline_patch(loops, facecolor=colour, edgecolor="white", linewidth=0.6, alpha=0.9))
        points = np.concatenate([loop for loops in shapes for loop in loops])
    elif len(names) > 1:  # by another program, or too many for a result's attributes
        ax.scatter(points[:, 0], points[:, 1], c=colours, s=24)
    else:
        return
    low, high = points.min(axis=0), points.max(axis=0)
    middle, edge = (low + high) / 2, 0.56 * (float((high - low).max()) or 1.0)
    ax.set(xlim=(middle[0] + edge, middle[0] - edge), ylim=(middle[1] - edge, middle[1] + edge), aspect="equal")
    width = optional_number(attributes, "field_of_view_mrad")
    near = "near" if width is None else f"near · {width:g} mrad"
    for y, text, side in ((1, "far", "bottom"), (0, near, "top")):
        ax.text(0.5, y, text, ha="center", va=side, fontsize="small", color="0.3", transform=ax.transAxes)


def _draw_image(ax: Axes, dataset: xr.Dataset) -> None:
    """Draw the energy that each pixel has received, or the sum of its samples, in the mean over the shots."""
    recorded = "impulse_response" not in dataset
    total = dataset["signal" if recorded else "impulse_response"].sum("time")
    energy = total.mean({"shot"} & set(total.dims)).values
    factor, prefix = drawing.si_prefix(float(energy[np.isfinite(energy)].max(initial=0.0)))
    image = drawing.draw_image(ax, energy / factor, dataset, cmap=palette.SEQUENCE)
    ax.set_anchor("N")
    label = f"sum of the samples ({prefix}V)" if recorded else f"total energy ({prefix}J)"
    scale = ax.inset_axes((0.0, -0.24, 1.0, 0.05))
    scale.set_in_layout(False)  # it fits into the space below the square pixels
    ax.figure.colorbar(image, cax=scale, orientation="horizontal", label=label)


def _title(dataset: xr.Dataset, shown: str = "mean and 90 %") -> str:
    """Return scene, receiver, the kind of shot mean, and for waveforms their accuracy."""
    attributes = dataset.attrs
    error = None if "signal" in dataset else optional_number(attributes, "error_median")
    parts = [drawing.scene_name(attributes) or "received power"]
    if "signal" in dataset and FILE not in attributes:
        parts.append(f"receiver {attributes.get('receiver', 'custom')}")
    if "shot" in dataset.dims:
        parts.append(f"{shown} of {dataset.sizes['shot']} shots")
    elif "shot" in dataset.coords:
        parts.append(f"shot {int(dataset['shot'])}")
    if error is not None:
        parts.append(f"median standard error {100 * error:.2g} %")
    return "  ·  ".join(parts)


_PANEL, _MOST = 1.5, 12  #: Panel height [inch], and largest number of panels.
_SMALLEST = 1e-3  #: Share of the largest power below which relative changes are not drawn.


def plot_derivatives(dataset: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw how much the waveform over all pixels changes where a parameter grows, with its standard error.

    A panel for each parameter, below the waveform, shows the change in percent for a 1 % larger parameter. It leaves
    out bins with less than a thousandth of the largest power. Pixels share photons, so that the error of their sum is
    unknown; the band over several pixels is an upper bound, the sum of their errors.

    Raises UserError if the result has no derivatives. `dataset`: a result of `rendering.render.render` with
    derivatives, for one shot. `path`: file to write.
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
        drawing.finish(ax, hide=("right", "top"), xlim=drawing.time_limits(dataset))
    bands = "standard errors" if dataset["waveform"].isel(time=0).size == 1 else "upper bounds of standard errors"
    text = f"change of the received power with parameters of the scene; bands, where wider than lines: {bands}"
    figure.suptitle(text, fontsize="medium")
    return drawing.save(figure, path)


_MOST_CURVES = 64  #: Pixels above which their sum is drawn: a curve of each would take minutes, and hide the others.

_MARK_EVERY = 12  #: Bins from one marker on a curve to the next one.


def plot_comparison(
    first: xr.Dataset, second: xr.Dataset, outcome: Comparison, path: drawing.FilePath | None = None
) -> Figure:
    """Draw two results with bands of two standard errors, and below them their difference in standard errors.

    For more than 64 pixels, it draws the summed waveforms, and the range of all differences in each bin. The results
    have the same pixels and time bins; `outcome` comes from `analysis.comparison.compare`.
    """
    figure = drawing.new_figure(path, 9.6, 6.4)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.4, 1.0))
    time = first["time"].values
    are_few = len(outcome.z) <= _MOST_CURVES
    marks = palette.marked(len(outcome.z) if are_few else 1)
    powers, errors = ([_by_pixel(one, name) for one in (first, second)] for name in ("waveform", "waveform_stderr"))
    counted = np.isfinite(outcome.z)
    if not are_few:
        # Pixels share light: their sum's error differs from the error for independent pixels, and has no band.
        known = np.isfinite(powers[0]) & np.isfinite(powers[1])
        powers = [np.where(known, power, 0).sum(axis=0, keepdims=True) for power in powers]
        errors = [np.zeros_like(power) for power in powers]
    for power, error, style, label in zip(powers, errors, ("-", "--"), _labels(first, second), strict=True):
        for i, mark in enumerate(marks):
            curve = {**mark, "markevery": _MARK_EVERY, "markersize": 3.5, "label": "_" if i else label}
            curve |= {"linestyle": style, "linewidth": 0.9, "lowest": 1e-30}
            drawing.draw_band(upper, time, power[i], 2 * error[i], **curve)
    shown = powers[0][counted if are_few else counted.any(axis=0, keepdims=True)]
    quantity, unit = ("energy in the gate", "J") if "gate" in first.coords else ("received power", "W")
    limits = {"ylim": (0.5 * shown[shown > 0].min(), 2 * shown.max()), "xlim": drawing.time_limits(first)}
    upper.set(yscale="log", **limits, ylabel=f"{quantity}{'' if are_few else ', all pixels'} ({unit})")
    upper.legend(frameon=False)
    if are_few:
        for z, mark in zip(outcome.z, marks, strict=True):
            lower.plot(time, z, linestyle="none", markersize=3, **mark)
    else:
        lowest, highest = np.where(counted, outcome.z, np.inf).min(0), np.where(counted, outcome.z, -np.inf).max(0)
        lower.vlines(time[counted.any(0)], lowest[counted.any(0)], highest[counted.any(0)], color=marks[0]["color"])
    for level in (-outcome.limit, outcome.limit):
        lower.axhline(level, color="0.5", linewidth=0.8, linestyle=":")
    largest = 1.5 * max(outcome.limit, outcome.largest)
    lower.set(ylim=(-largest, largest), xlabel=drawing.time_label(first), ylabel="difference\n(standard errors)")
    for ax in (upper, lower):
        drawing.add_grid(ax)
    text = f"{outcome.bin_count} bins, rms {outcome.rms:.2f} and largest {outcome.largest:.1f} standard errors"
    text += f" (limit of chance {outcome.limit:.1f})"
    figure.suptitle(drawing.titled(first.attrs, text), fontsize="medium")
    return drawing.save(figure, path)


def _labels(first: xr.Dataset, second: xr.Dataset) -> list[str]:
    """Return labels for two results: the first of their attributes that differs."""
    for name in ("integrator", "scene", "instrument", "variant", "passes", "seed"):
        values = [str(result.attrs.get(name, "")) for result in (first, second)]
        if values[0] != values[1] and all(values):
            return [value if name in ("integrator", "scene", "instrument") else f"{name} {value}" for value in values]
    return ["first result", "second result"]


def _by_pixel(result: xr.Dataset, name: str) -> FloatArray:
    values = result[name].values
    return np.asarray(values.reshape(-1, values.shape[-1]))
