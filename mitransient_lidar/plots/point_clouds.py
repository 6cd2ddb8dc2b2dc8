"""Flight pictures: pulses, points by class, a profile with its waveforms, and height errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import setp
from matplotlib.axes import Axes

from mitransient_lidar.core.constants import C0
from mitransient_lidar.flights.products import Flown
from mitransient_lidar.physics.lidar.level_sea import refract_level
from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.results.attributes import PointClass

#: Classes of solid points.
_SOLID = (PointClass.GROUND, PointClass.UNCLASSIFIED, PointClass.BOTTOM, PointClass.OBJECT)

_STRIP, _MOST_WAVEFORMS = 1.5, 2000  #: Half the width of a profile's strip [m], and most waveforms in it.

#: Heights in a profile above sea and land and below the deepest point [m], and most cell columns in its picture.
_ABOVE, _BELOW, _COLUMNS = 1.0, 1.5, 200

_RARE = 50  #: Most points of a class that are drawn large.
_PER_NS = 0.5e-9 * C0  #: Range of a nanosecond between pulse and echo in the air [m].
_DECADES = 3.0  #: Orders of magnitude of the signals in a profile.


def plot_flight(flown: Flown, points: xr.Dataset, folder: Path) -> list[Path]:
    """Draw a flight into the files flight.png and profile.png in a folder.

    The first one has the pulse locations, all points in a side view by class, and maps with bottom heights and their
    errors. The second one has the waveforms and points in a strip, through a target if points lie on one. The side view
    is along x or y, over which points extend farther, the strip along x or y and through most points.

    Returns the files.

    `flown`: the pulses. `points`: their points, as from `flights.products.points_of`. `folder`: folder for the files.
    """
    paths = [folder / "flight.png", folder / "profile.png"]
    figure = drawing.new_figure(paths[0], 11, 8.5)
    track, side, heights, errors = figure.subplots(2, 2).ravel()
    _draw_track(track, flown, points)
    _draw_side(side, points)
    wet = points.isel(point=np.isin(points["kind"].values, _SOLID))
    error = wet["z"].values - wet["true_z"].values
    limit = float(np.nanquantile(np.abs(error), 0.98)) if error.size else 1.0
    deepest, highest = np.quantile(wet["z"].values, [0.002, 0.99]) if error.size else (-1.0, 0.0)
    scale = {"cmap": palette.SEQUENCE, "vmin": deepest, "vmax": highest}
    for ax, values, label, style in (
        (heights, wet["z"].values, "height of bottom and land (m)", scale),
        (errors, error, "error of the height (m)", {"cmap": palette.SIGNED, "vmin": -limit, "vmax": limit}),
    ):
        drawn = ax.scatter(wet["x"].values, wet["y"].values, c=values, s=3, linewidths=0, **style)
        _set_map(ax, "Bottom and land" if ax is heights else "Errors of heights")
        figure.colorbar(drawn, ax=ax, label=label)
    drawing.save(figure, paths[0])
    figure = drawing.new_figure(paths[1], 10, 5)
    _draw_profile(figure.subplots(), flown, points)
    drawing.save(figure, paths[1])
    return paths


def _draw_track(ax: Axes, flown: Flown, points: xr.Dataset) -> None:
    """Draw the scanner's track, and where its pulses' axes meet the sea level."""
    poses = flown.poses
    ax.plot(*poses.ground_point()[:, :2].T, ".", color=palette.BLUE, markersize=1.5, label="pulses at the sea level")
    ax.plot(*poses.origin[:, :2].T, color="black", linewidth=1.5, label="scanner")
    if np.any(chosen := points["true_target"].values.astype(bool)):
        x, y = (points[name].values[chosen] for name in "xy")
        ax.plot(x, y, "s", color=palette.RED, markersize=4, label="above a target")
    _set_map(ax, f"{len(poses.origin)} pulses")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), fontsize="small")


def _set_map(ax: Axes, title: str) -> None:
    """Set a map's axes, which may be narrow."""
    ax.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title=title)
    ax.locator_params("x", nbins=3)


def _exaggeration(ax: Axes) -> str:
    """Return how much larger the scale of heights is, as text."""
    ratio = np.ptp(ax.get_xlim()) / ax.bbox.width / (np.ptp(ax.get_ylim()) / ax.bbox.height)
    return f"\nheights about × {float(f'{ratio:.1g}'):g}"


def _fullest_strip(points: xr.Dataset) -> tuple[str, str, float]:
    """Return the coordinates along and across the strip with most points, through targets if any, and its middle."""
    target, found = points["true_target"].values.astype(bool), []
    for along, across in (("x", "y"), ("y", "x")):
        side = points[across].values
        number, edges = np.histogram(side, np.arange(side.min(), side.max() + 4 * _STRIP, 2 * _STRIP))
        middle = float(np.median(side[target])) if np.any(target) else float(edges[np.argmax(number)] + _STRIP)
        found.append((np.count_nonzero(np.abs(side - middle) < _STRIP), along, across, middle))
    return max(found)[1:]


def _draw_side(ax: Axes, points: xr.Dataset) -> None:
    """Draw all points from the side, by class."""
    along = "x" if np.ptp(points["x"].values) >= np.ptp(points["y"].values) else "y"
    for kind, colour in palette.CLASSES.items():
        chosen = points["kind"].values == kind
        if np.any(chosen):
            label = f"{kind.text} ({np.count_nonzero(chosen)})"
            # Points of rare classes are larger, so that they are seen.
            size = 1.5 if np.count_nonzero(chosen) > _RARE else 4
            ax.plot(points[along].values[chosen], points["z"].values[chosen], ".", color=colour, ms=size, label=label)
    ax.set(xlabel=f"{along} (m)", ylabel="z (m)", title=f"Points by class, from the side{_exaggeration(ax)}")
    drawing.add_grid(ax)
    handles: Any = ax.legend(loc="best", fontsize="small").legend_handles
    setp(handles, markersize=7)


def _draw_profile(ax: Axes, flown: Flown, points: xr.Dataset) -> None:
    """Draw the waveforms and points of a strip along x or y, through points above targets or else most points."""
    along, across, middle = _fullest_strip(points)
    strip = points.isel(point=np.abs(points[across].values - middle) < _STRIP)
    wet = np.isin(strip["kind"].values, _SOLID)
    surface = strip["kind"].values == PointClass.SURFACE
    depth = float(np.max(-strip["z"].values[wet], initial=1.0)) + _BELOW
    top = float(np.max(strip["z"].values[wet], initial=0.0)) + _ABOVE
    seen = np.unique(strip["shot"].values)
    first, last = np.quantile(strip[along].values, [0.0, 1.0])
    width = float(flown.store.attributes["bin_width_ns"])
    group, index = (float(flown.attributes[name]) for name in ("group_index", "refractive_index"))
    # Cells with a few pulses and samples each, so that they fill the picture.
    rows = (depth + top) / (2 * _PER_NS * width / group)
    shape = int(np.clip(len(seen) / 3, 10, _COLUMNS)), max(int(rows), 10)
    cells = np.linspace(first, last, shape[0] + 1), np.linspace(-depth, top, shape[1] + 1)
    total, number = np.zeros(shape), np.zeros(shape)
    signal, start = flown.values("signal"), flown.values("sample_start_ns")
    origin, axis = flown.poses.origin, flown.poses.axis
    for shot in seen[:: max(len(seen) // _MOST_WAVEFORMS, 1)]:
        way = _PER_NS * (start[shot] + (np.arange(signal.shape[-1]) + 0.5) * width)
        to_sea = -origin[shot, 2] / axis[shot, 2]
        down = refract_level(axis[shot], index)
        # In the air up to the sea level, below it at the group velocity of the water.
        wet_way = np.maximum(way - to_sea, 0) / group
        place = origin[shot] + np.minimum(way, to_sea)[:, None] * axis[shot] + wet_way[:, None] * down
        values = np.abs(signal[shot]).mean(axis=0)
        for grid, weight in ((total, values), (number, np.ones_like(values))):
            grid += np.histogram2d(place[:, "xy".index(along)], place[:, 2], bins=cells, weights=weight)[0]
    with np.errstate(invalid="ignore", divide="ignore"):
        image = np.log10(total / number).T
    highest = float(np.nanmax(image[np.isfinite(image)], initial=-np.inf))
    shown = np.where(np.isfinite(image), image, np.nan)
    drawn = ax.pcolormesh(*cells, shown, cmap=palette.LIGHT, vmin=highest - _DECADES, vmax=highest)
    ax.figure.colorbar(drawn, ax=ax, label=f"log10 of the mean signal ({flown.store.attributes.get('unit', 'V')})")
    for chosen, mark, colour, label in (
        (surface, "v", palette.SKY, PointClass.SURFACE.text),
        (wet, "o", palette.GREEN, "land, bottom or object"),
    ):
        ax.plot(strip[along].values[chosen], strip["z"].values[chosen], mark, color=colour, ms=3, label=label)
    order = np.argsort(strip[along].values[wet])
    truth = (strip[name].values[wet][order] for name in (along, "true_z"))
    ax.plot(*truth, "-", color="white", linewidth=1.2, label="truth")
    ax.set_facecolor("black")
    title = f"Waveforms and points within {_STRIP:g} m of {across} = {middle:.1f} m"
    ax.set(xlabel=f"{along} (m)", ylabel="z (m)", title=f"{title}{_exaggeration(ax)}")
    ax.legend(loc="lower right", fontsize="small", facecolor="#555555", labelcolor="white")
