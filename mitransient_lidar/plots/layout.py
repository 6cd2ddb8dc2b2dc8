"""Figure of the layout of a result: pixels, beam and targets on the mean sea level."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path as Line
from matplotlib.patheffects import withStroke

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.plots import drawing
from mitransient_lidar.results.geometry import optional_number

#: Most cells along a side of an imager that are drawn with edges.
_EDGED_CELLS = 16

#: Largest ratio of length and width of a footprint that is drawn to scale.
_LARGEST_ASPECT = 4.0

_BEAM_COLOUR = "#e07b00"
_TARGET_COLOUR = "#7a3fb0"
_LEVELS = {0.6065: "e$^{-1/2}$", 0.1353: "e$^{-2}$", 1.0: "rim"}

#: White outline that separates lines from pixels of any colour.
_HALO = [withStroke(linewidth=3.4, foreground="white", alpha=0.8)]


def plot_layout(dataset: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the pixels, the beam and the targets of a result on the mean sea level, away from the lidar upwards.

    Targets are drawn at their true positions, without refraction. The cells of an imager show the received energy.

    Raises
    ------
    UserError
        If the attributes of the result hold no pose of the lidar or no field of view, or the receiver looks above the
        horizon.
    """
    figure = drawing.new_figure(path, 6.8, 6.4)
    attributes = dataset.attrs
    ground = _Ground.of_result(attributes)
    ax = figure.add_subplot()
    handles: list[Any] = []
    has_pixels = "pixel" in dataset.dims
    seen = _draw_pixels(ax, dataset, ground, handles) if has_pixels else _draw_image(ax, dataset, ground)
    lit = _draw_beam(ax, attributes, ground)
    _draw_targets(ax, attributes, ground)
    _set_limits(figure, ax, seen, lit)
    names = ("y (m)", "x (m)") if abs(ground.azimuth) < 1e-6 else ("across (m)", "along (m)")
    ax.set_xlabel(names[0] if ax.get_aspect() == 1 else f"{names[0]}, not to scale")
    ax.set_ylabel(f"{names[1]}, away from the lidar")
    handles += ax.get_legend_handles_labels()[0]
    ax.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.01, 1.01), frameon=False, handlelength=1.8)
    ax.set_title(_title(attributes), fontsize="medium")
    return drawing.save(figure, path)


@dataclass(frozen=True)
class _Ground:
    """Map of angles and positions to distances across and along the lidar's azimuth on the mean sea level [m].

    A pose has origin, axis, far and left, shape (4, 3).
    """

    receiver: FloatArray
    transmitter: FloatArray
    azimuth: float  #: Direction of the receiver's axis, from +x towards +y [rad].

    @classmethod
    def of_result(cls, attributes: dict[str, Any]) -> _Ground:
        receiver, transmitter = (_pose(attributes, f"{name}_pose") for name in ("receiver", "transmitter"))
        # A vertical axis has no azimuth; its far direction has one.
        x, y = receiver[1 if math.hypot(*receiver[1, :2]) > 1e-6 else 2, :2]
        return cls(receiver, transmitter, math.atan2(y, x))

    def place(self, points: FloatArray) -> FloatArray:
        """Return (across, along) of positions (x, y), shape (..., 2)."""
        cos, sin = math.cos(self.azimuth), math.sin(self.azimuth)
        x, y = points[..., 0], points[..., 1]
        return np.stack([cos * y - sin * x, cos * x + sin * y], axis=-1)

    def project(self, pose: FloatArray, angles: FloatArray) -> FloatArray:
        """Return (across, along) of rays (angle_x, angle_y) [mrad], shape (..., 2); NaN for rays above the horizon."""
        rays = pose[1] + 1e-3 * (angles[..., :1] * pose[2] + angles[..., 1:] * pose[3])
        down = np.where(rays[..., 2:] < -1e-9, rays[..., 2:], np.nan)
        return self.place(pose[0] - pose[0, 2] * rays / down)


def _pose(attributes: dict[str, Any], name: str) -> FloatArray:
    """Return a pose; for a result without poses that of its altitude and off-nadir angle."""
    if len(attributes.get(name, ())) == 12:
        return np.array(attributes[name], dtype=np.float64).reshape(4, 3)
    altitude, off_nadir_deg = (optional_number(attributes, key) for key in ("altitude", "off_nadir_deg"))
    if altitude is None or off_nadir_deg is None:
        raise UserError("the result has no altitude and off_nadir_deg among its attributes: it has no layout to draw.")
    sin, cos = math.sin(math.radians(off_nadir_deg)), math.cos(math.radians(off_nadir_deg))
    return np.array([[-altitude * sin / cos, 0, altitude], [sin, 0, -cos], [cos, 0, sin], [0, 1, 0]])


def _draw_pixels(ax: Axes, dataset: xr.Dataset, ground: _Ground, handles: list[Any]) -> FloatArray:
    """Draw the outlines of the pixels, or dots at their centres where there are none; return the points drawn."""
    names = [str(name) for name in dataset["pixel"].values]
    fills = [(to_rgba(colour, 0.25), colour) for colour in drawing.pixel_colours(len(names))]
    if len(names) <= drawing.LISTED_PIXELS:
        handles += [Patch(facecolor=f, edgecolor=e, label=name) for name, (f, e) in zip(names, fills, strict=True)]
    outlines = json.loads(dataset.attrs.get("pixel_outlines", "[]"))
    if len(outlines) != len(names):
        angles = np.stack([dataset["angle_x"].values, dataset["angle_y"].values], axis=-1)
        centres = ground.project(ground.receiver, angles)
        ax.scatter(centres[:, 0], centres[:, 1], c=[colour for _, colour in fills], s=24, zorder=3)
        return np.concatenate([centres, _draw_field(ax, dataset.attrs, ground)])
    drawn = [np.zeros((0, 2))]
    for lines, (fill, edge) in zip(outlines, fills, strict=True):
        loops = [ground.project(ground.receiver, _points(line)) for line in lines]
        loops = [loop for loop in loops if np.isfinite(loop).all()]
        if loops:
            # One patch of all lines keeps holes open.
            shape = Line.make_compound_path(*(Line(loop, closed=True) for loop in loops))
            ax.add_patch(PathPatch(shape, facecolor=fill, edgecolor=edge, linewidth=1.3))
            drawn += loops
    return np.concatenate(drawn)


def _draw_image(ax: Axes, dataset: xr.Dataset, ground: _Ground) -> FloatArray:
    """Draw the received energy in the cells of an imager; return the points of its outline."""
    outline = _draw_field(ax, dataset.attrs, ground)
    width = optional_number(dataset.attrs, "field_of_view_mrad")
    if width is None or not np.isfinite(outline).all():
        return outline
    energy = dataset["impulse_response"].sum("time").values
    rows, columns = energy.shape
    far, left = np.linspace(width / 2, -width / 2, rows + 1), np.linspace(-width / 2, width / 2, columns + 1)
    corners = ground.project(ground.receiver, np.stack(np.meshgrid(far, left, indexing="ij"), axis=-1))
    factor, prefix = drawing.si_prefix(float(np.nanmax(energy, initial=0.0)))
    image = ax.pcolormesh(
        *np.moveaxis(corners, -1, 0),
        energy / factor,
        cmap="viridis",
        edgecolors="white" if max(rows, columns) <= _EDGED_CELLS else "none",
        linewidth=0.5,
    )
    image.set_clip_path(Line(outline), ax.transData)
    ax.figure.colorbar(image, ax=ax, location="bottom", shrink=0.7, aspect=35, label=f"received energy ({prefix}J)")
    return outline


def _draw_field(ax: Axes, attributes: dict[str, Any], ground: _Ground) -> FloatArray:
    """Draw the outline of the field of view if it is known; return its points."""
    width, shape = optional_number(attributes, "field_of_view_mrad"), attributes.get("field_of_view_shape")
    if width is None or shape not in ("circle", "square", "rectangle"):
        return np.zeros((0, 2))
    azimuth = np.linspace(0, 2 * np.pi, 181)
    angles = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    if shape != "circle":
        angles /= np.abs(angles).max(axis=1, keepdims=True)
    sides = np.array(attributes.get("field_of_view_sides_mrad") or [width, width])
    points = ground.project(ground.receiver, sides / 2 * angles)
    ax.plot(*points.T, color="0.2", linewidth=1.2, label="field of view")
    return points


def _draw_beam(ax: Axes, attributes: dict[str, Any], ground: _Ground) -> FloatArray:
    """Draw lines of equal irradiance; return their points."""
    drawn = [np.zeros((0, 2))]
    for outline, style in zip(json.loads(attributes.get("beam_outlines", "[]")), ("-", "--"), strict=False):
        label = f"beam, {_LEVELS.get(outline['share'], outline['share'])}"
        for line in outline["lines"]:
            points = ground.project(ground.transmitter, _points(line))
            ax.plot(*points.T, style, color=_BEAM_COLOUR, linewidth=1.8, label=label, path_effects=_HALO, zorder=4)
            drawn.append(points)
            label = "_"
    return np.concatenate(drawn)


def _draw_targets(ax: Axes, attributes: dict[str, Any], ground: _Ground) -> None:
    """Draw the outlines of the targets with the depths of their highest points."""
    label = "target"
    for target in json.loads(attributes.get("target_outlines", "[]")):
        points = ground.place(_points(target["line"]))
        marks: dict[str, Any] = {"color": _TARGET_COLOUR, "path_effects": _HALO, "zorder": 5}
        ax.plot(*points.T, linewidth=1.6, linestyle=(0, (4, 1.2)), label=label, **marks)
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        depth = f"{-target['z'][1]:.3g} m"
        ax.annotate(depth, middle, ha="center", va="center", fontsize="small", annotation_clip=True, **marks)
        label = "_"


def _set_limits(figure: Figure, ax: Axes, seen: FloatArray, lit: FloatArray) -> None:
    """Show the footprints of all pixels, and the beam up to one footprint beyond them."""
    seen, lit = (points[np.isfinite(points).all(axis=1)] for points in (seen, lit))
    if len(seen) == 0:
        raise UserError("the result has no pixels that look at the sea: it has no layout to draw.")
    low, high = seen.min(axis=0), seen.max(axis=0)
    size = np.maximum(high - low, 1e-3)
    lit = np.clip(lit, low - size, high + size)
    low, high = np.min([low, *lit], axis=0) - 0.05 * size, np.max([high, *lit], axis=0) + 0.05 * size
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    aspect = float((high[1] - low[1]) / (high[0] - low[0]))
    to_scale = 1 / _LARGEST_ASPECT <= aspect <= _LARGEST_ASPECT
    ax.set_aspect("equal" if to_scale else "auto")
    drawing.add_grid(ax)
    figure.set_figheight(min(max(5.0 * aspect, 3.6), 8.0) if to_scale else 6.4)


def _title(attributes: dict[str, Any]) -> str:
    parts = [drawing.scene_name(attributes)]
    for name, text in (("altitude", "altitude {:.4g} m"), ("off_nadir_deg", "{:.3g}° off nadir")):
        value = optional_number(attributes, name)
        parts.append("" if value is None else text.format(value))
    return "  ·  ".join(part for part in parts if part)


def _points(line: Sequence[float]) -> FloatArray:
    return np.array(line, dtype=np.float64).reshape(-1, 2)
