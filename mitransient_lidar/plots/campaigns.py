"""Campaign figure: sample records, parameter distributions, and responses."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.plots import drawing, palette

#: Sample records, most parameters and parameter pairs that are drawn, and runs that give the responses.
_SAMPLE, _MOST_PARAMETERS, _MOST_PAIRS, _MOST_RUNS = 12, 5, 3, 20_000

_CELLS = 10  #: Cells per side of a response surface.
_DYNAMIC_RANGE = {"waveform": 1e6, "signal": 1e4}  #: Range drawn below the peak, for powers and for noisy signals.

_NO_ECHO = 1  #: Flag of `analysis.waveforms.echo_detection.EchoFlag` for an echo that was not found.

_DONE = 1


def plot_campaign(dataset: xr.Dataset, path: drawing.FilePath | None = None, seed: int = 0) -> Figure:
    """Draw a campaign.

    Above: randomly sampled records, each record's first pixel. In the middle: the parameter distributions. Below, over
    parameter pairs: the mean over runs, for the share of records with a bottom echo, else for peak power, else for the
    error.

    Raises UserError if no run is done, or the file name has another suffix. `dataset`: a campaign as from
    `campaigns.store.open_campaign`. `path`: PNG, PDF or SVG file to write. `seed`: sample seed.
    """
    figure = drawing.new_figure(path, 11.0, 9.6)
    done = np.flatnonzero(dataset["status"].values == _DONE)
    if done.size == 0:
        raise UserError("the campaign has no run that is done: nothing can be drawn")
    rng = np.random.default_rng(seed)
    used = np.sort(rng.choice(done, min(done.size, _MOST_RUNS), replace=False))
    inputs = _inputs(dataset, used)
    rows: Any = figure.subfigures(3, 1, height_ratios=[1.2, 0.9, 1.2])
    _draw_sample(rows[0].subplots(), dataset, np.sort(rng.choice(done, min(done.size, _SAMPLE), replace=False)))
    _draw_distributions(rows[1], dataset, inputs)
    _draw_responses(rows[2], dataset, used, inputs)
    total, failed = dataset.sizes["run"], int(np.count_nonzero(dataset["status"].values == _DONE + 1))
    figure.suptitle(f"{dataset.attrs.get('title', 'campaign')}: {done.size} of {total} done, {failed} failed")
    return drawing.save(figure, path)


def _inputs(dataset: xr.Dataset, runs: npt.NDArray[np.intp]) -> dict[str, npt.NDArray[Any]]:
    """Return the run parameters, by name, that vary and follow from no others."""
    given = json.loads(dataset.attrs.get("campaign", "{}")).get("parameters", {})
    found = {name: dataset[stored].values[runs] for name, stored in dict(dataset.attrs.get("inputs", {})).items()}
    return {
        name: column
        for name, column in found.items()
        if np.unique(column).size > 1 and not isinstance(given.get(name), str)
    }


def _draw_sample(ax: Axes, dataset: xr.Dataset, runs: npt.NDArray[np.intp]) -> None:
    """Draw the runs' records."""
    name = next((name for name in ("signal", "waveform") if name in dataset), None)
    if name is None:
        ax.text(0.5, 0.5, "no records are kept", ha="center", va="center")
        ax.set_axis_off()
        return
    records = dataset[name].isel(run=runs)
    records = records.isel({dim: 0 for dim in records.dims if dim not in ("run", records.dims[-1])}).load()
    values, time = np.asarray(records, dtype=np.float64), records[records.dims[-1]].values
    # Records of other heights side by side: each relative to its own peak.
    peaks = values.max(axis=1, keepdims=True)
    values = values / np.where(peaks > 0, peaks, 1)
    # A logarithmic axis has no values below 0, and lower ones would be drawn as a level. So would the dark before the
    # first light: after a converter it is the code next to 0.
    values[(values < 1 / _DYNAMIC_RANGE[name]) | (values <= values[:, :1])] = np.nan
    ax.set(yscale="log", ylim=(1 / _DYNAMIC_RANGE[name], 2))
    name_of, column = next(iter(_numbers(_inputs(dataset, runs)).items()), ("run", runs))
    # The lightest colours are hard to see on white.
    colours = ScalarMappable(Normalize(column.min(), column.max() + 0.08 * np.ptp(column)), palette.SEQUENCE)
    for line, value in zip(values, column, strict=True):
        ax.plot(time, line, color=colours.to_rgba(value), linewidth=0.9)
    ax.figure.colorbar(colours, ax=ax, label=_labelled(dataset, name_of))
    drawing.finish(ax, xlabel=drawing.TIME_LABEL, ylabel=f"{name}, relative to its peak")


def _numbers(inputs: dict[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    return {name: column for name, column in inputs.items() if column.dtype.kind in "if"}


def _labelled(dataset: xr.Dataset, name: str) -> str:
    """Return a parameter's name with its unit, if known."""
    unit = dataset[dataset.attrs.get("inputs", {}).get(name, name)].attrs.get("units", "1")
    return name if unit == "1" else f"{name} ({unit})"


def _draw_distributions(figure: Any, dataset: xr.Dataset, inputs: dict[str, npt.NDArray[Any]]) -> None:
    """Draw how often each parameter value occurs."""
    shown = dict(itertools.islice(inputs.items(), _MOST_PARAMETERS))
    if not shown:
        return
    for ax, (name, column) in zip(np.atleast_1d(figure.subplots(1, len(shown))), shown.items(), strict=True):
        values, numbers = np.unique(column, return_counts=True)
        if values.size <= _CELLS:
            ax.bar([str(value) for value in values], numbers, color="0.55")
        else:
            ax.hist(column, bins=_edges(column), color="0.55")
            _set_scale(ax.set_xscale, ax.xaxis, column)
        ax.set_xlabel(_labelled(dataset, name))
        drawing.add_grid(ax, "y", hide=("top", "right"))
    figure.axes[0].set_ylabel("runs")


def _draw_responses(
    figure: Any, dataset: xr.Dataset, runs: npt.NDArray[np.intp], inputs: dict[str, npt.NDArray[Any]]
) -> None:
    """Draw the mean response over parameter pairs."""
    response, label = _response(dataset, runs)
    axes = _numbers(inputs)
    pairs = list(itertools.islice(itertools.combinations(axes, 2), _MOST_PAIRS))
    if not pairs:
        return
    image = None
    limits = float(np.nanmin(response)), float(np.nanmax(response))
    for ax, (x, y) in zip(np.atleast_1d(figure.subplots(1, len(pairs))), pairs, strict=True):
        edges = [_edges(axes[name]) for name in (x, y)]
        places = [
            np.clip(np.digitize(axes[name], edge) - 1, 0, len(edge) - 2)
            for name, edge in zip((x, y), edges, strict=True)
        ]
        shape = tuple(len(edge) - 1 for edge in edges)
        index, known = np.ravel_multi_index(places, shape), np.isfinite(response)
        count = np.bincount(index[known], minlength=shape[0] * shape[1])
        total = np.bincount(index[known], weights=response[known], minlength=shape[0] * shape[1])
        with np.errstate(invalid="ignore"):
            mean = (total / count).reshape(shape)
        image = ax.pcolormesh(edges[0], edges[1], mean.T, vmin=limits[0], vmax=limits[1], cmap=palette.SEQUENCE)
        ax.set(xlabel=_labelled(dataset, x), ylabel=_labelled(dataset, y))
        _set_scale(ax.set_xscale, ax.xaxis, axes[x])
        _set_scale(ax.set_yscale, ax.yaxis, axes[y])
    figure.colorbar(image, ax=figure.axes, label=label)


def _response(dataset: xr.Dataset, runs: npt.NDArray[np.intp]) -> tuple[FloatArray, str]:
    """Return a quantity for each run, and its name."""
    if "echo_flags" in dataset:
        flags = dataset["echo_flags"].sel(echo="bottom").isel(run=runs).values.reshape(len(runs), -1)
        return np.asarray(np.mean((flags & _NO_ECHO) == 0, axis=1)), "share of records with a bottom echo"
    if "waveform" in dataset:
        peak = dataset["waveform"].isel(run=runs).max([dim for dim in dataset["waveform"].dims if dim != "run"]).values
        return np.log10(np.maximum(peak.astype(np.float64), 1e-30)), "peak power (log10 W)"
    return dataset["error_median"].values[runs].astype(np.float64), "relative error of the median bin"


def _set_scale(scale: Callable[[str], Any], axis: Axis, column: npt.NDArray[Any]) -> None:
    """Draw a value axis in logarithms where they are spread so, with plain numbers."""
    if _is_logarithmic(column):
        scale("log")
        drawing.plain_logarithms(axis)


def _is_logarithmic(column: npt.NDArray[Any]) -> bool:
    """Return whether the values are spread more evenly over their logarithms."""
    low, high = float(column.min()), float(column.max())
    return low > 0 and high / low > _CELLS - 1 and float(np.median(column)) < 0.4 * (low + high)


def _edges(column: npt.NDArray[Any]) -> FloatArray:
    """Return cell edges: about each value if they are few, else even ones over their range."""
    values = np.unique(column).astype(np.float64)
    if values.size <= _CELLS:
        middle = 0.5 * (values[1:] + values[:-1])
        return np.concatenate([[1.5 * values[0] - 0.5 * values[1]], middle, [1.5 * values[-1] - 0.5 * values[-2]]])
    if _is_logarithmic(column):
        return np.asarray(np.geomspace(values[0], values[-1], _CELLS + 1))
    return np.linspace(values[0], values[-1], _CELLS + 1)
