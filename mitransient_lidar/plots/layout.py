"""Layout figure for a result: pixels, beam and targets on the mean sea level and under water."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.path import Path as Line
from matplotlib.patheffects import withStroke

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.level_sea import LevelSea
from mitransient_lidar.physics.lidar.pose import Pose
from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.results.geometry import optional_number, pose_of

_EDGED_CELLS = 16  #: Most cells along a side of an imager that are drawn with edges.
_LARGEST_ASPECT = 4.0  #: Largest ratio between length and width of a footprint that is drawn to scale.
_MOST_TARGET_PLANES, _MOST_COLUMNS = 3, 3  #: Most planes through targets, and planes side by side.

#: Heights of targets that differ by less are drawn on one plane [m], and axes that differ by less as one [m].
_SAME_PLANE, _SAME_POINT = 0.05, 1e-3

_LONGEST_NAME = 32  #: Longest list of target names in a title.

_SHADOW_COLOUR = "#00000055"
_LEVELS = {0.6065: "e$^{-1/2}$", 0.1353: "e$^{-2}$", 1.0: "rim"}

#: White outline that separates lines from pixels of any colour.
_HALO = [withStroke(linewidth=3.4, foreground="white", alpha=0.8)]


@dataclass(frozen=True)
class _Plane:
    """Horizontal plane on which pixels and beam are drawn.

    `targets` are the targets at about its height; `outline` is the kind of line drawn for each target in the result:
    ``seen``, ``line`` or ``shadow``.
    """

    z: float
    name: str
    outline: str
    targets: list[dict[str, Any]]


def plot_layout(dataset: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw a result's pixels, beam and targets on horizontal planes, seen from above, away from the lidar upwards.

    What is left of the line of sight is on the left, as in a picture taken from the lidar. Where the lidar does not
    look along +x, the vertical axis label gives the direction of +x.

    The planes are the mean sea level, the targets' mean heights, and the bottom height on the receiver's axis. At most
    three targets have planes; others are drawn on the nearest one. A level sea refracts lines of sight and the beam.
    Targets are drawn on the sea level where the receiver sees them, and on their planes at their true positions. Their
    shadows in the laser light are drawn on the bottom. Each plane's title gives the point on the receiver's axis. An
    imager's cells show the received energy.

    Results without refractive index, targets or bottom in their attributes have fewer planes.

    Raises UserError if the result's attributes contain no lidar pose or no field of view, or the receiver looks above
    the horizon.
    """
    attributes = dataset.attrs
    ground = _Ground.of_result(attributes)
    targets = json.loads(attributes.get("target_outlines", "[]"))
    planes = _planes(attributes, targets)
    columns = math.ceil(len(planes) / math.ceil(len(planes) / _MOST_COLUMNS))
    rows = math.ceil(len(planes) / columns)
    figure = drawing.new_figure(path, 2.2 + 4.6 * columns, 6.4 * rows)
    handles: list[Any] = []
    heights = []
    for index, plane in enumerate(planes):
        ax = figure.add_subplot(rows, columns, index + 1)
        heights.append(_draw_plane(ax, dataset, ground.at(plane.z), plane, handles if index == 0 else []))
        title = "\n".join([plane.name, *ground.axis_points(plane.z)])
        ax.set_title(f"{_title(attributes)}\n{title}" if len(planes) == 1 else title, fontsize="medium")
        names = ground.axis_names()
        ax.set_xlabel(names[0] if ax.get_aspect() == 1 else f"{names[0]}, not to scale")
        ax.set_ylabel("" if index % columns else names[1])
    figure.set_figheight(sum(max(heights[row * columns : (row + 1) * columns]) for row in range(rows)))
    labelled = {
        label: handle for ax in figure.axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles=[*handles, *labelled.values()], loc="outside right upper", frameon=False, handlelength=1.8)
    if len(planes) > 1:
        figure.suptitle(_title(attributes), fontsize="medium")
    return drawing.save(figure, path)


def draw_sea_level(ax: Axes, dataset: xr.Dataset) -> None:
    """Draw pixels, beam and targets on the mean sea level, as `plot_layout`; targets are where the receiver sees them.

    Raises UserError as `plot_layout`.
    """
    ground = _Ground.of_result(dataset.attrs)
    plane = _planes(dataset.attrs, json.loads(dataset.attrs.get("target_outlines", "[]")))[0]
    _draw_plane(ax, dataset, ground.at(plane.z), plane, [])
    across, along = ground.axis_names()
    ax.set(xlabel=across, ylabel=along)


def axis_points(dataset: xr.Dataset) -> list[str]:
    """Return, for each plane of `plot_layout`, its name and the points where receiver's axis and laser's axis meet it.

    Raises UserError if the result's attributes contain no lidar pose.
    """
    ground = _Ground.of_result(dataset.attrs)
    planes = _planes(dataset.attrs, json.loads(dataset.attrs.get("target_outlines", "[]")))
    return [f"{plane.name}: {', '.join(ground.axis_points(plane.z))}" for plane in planes]


def _planes(attributes: dict[str, Any], targets: list[dict[str, Any]]) -> list[_Plane]:
    """Return the planes to draw, from the sea level down."""
    surface = _Plane(0.0, "mean sea level", "seen", targets)
    if _sea(attributes) is None:
        return [surface]
    groups = [[target] for target in sorted(targets, key=lambda target: -_middle(target))]
    while len(groups) > _MOST_TARGET_PLANES or (len(groups) > 1 and min(_gaps(groups)) < _SAME_PLANE):
        nearest = int(np.argmin(_gaps(groups)))
        groups[nearest] += groups.pop(nearest + 1)
    planes = [surface]
    for group in groups:
        z = float(np.mean([_middle(target) for target in group]))
        names = ", ".join(dict.fromkeys(str(target.get("id", "target")) for target in group))
        names = names if len(names) <= _LONGEST_NAME else f"{len(group)} targets"
        planes.append(_Plane(z, f"{'depth' if z < 0 else 'height'} of {names}", "line", group))
    bottom = np.atleast_1d(attributes.get("bottom_point", ()))
    if bottom.size == 3:
        planes.append(_Plane(float(bottom[2]), "bottom", "shadow", targets))
    return planes


def _gaps(groups: list[list[dict[str, Any]]]) -> FloatArray:
    """Return the distances between the heights of neighbouring target groups [m]."""
    return -np.diff([np.mean([_middle(target) for target in group]) for group in groups])


def _middle(target: dict[str, Any]) -> float:
    return 0.5 * float(target["z"][0] + target["z"][1])


def _sea(attributes: dict[str, Any]) -> LevelSea | None:
    """Return a result's water, or None if its refractive index is unknown."""
    index = optional_number(attributes, "refractive_index")
    layers = np.atleast_1d(attributes.get("index_layers", () if index is None else index))
    boundaries = np.atleast_1d(attributes.get("index_boundaries", ()))
    return LevelSea(tuple(layers.tolist()), tuple(boundaries.tolist())) if index is not None else None


def _draw_plane(ax: Axes, dataset: xr.Dataset, ground: _Ground, plane: _Plane, handles: list[Any]) -> float:
    """Draw pixels, beam, targets and axes on a plane; return a height in inches."""
    attributes = dataset.attrs
    if "pixel" in dataset.dims:
        seen = _draw_pixels(ax, dataset, ground, handles)
    elif plane.outline == "seen":
        seen = _draw_image(ax, dataset, ground)
    else:
        seen = _draw_field(ax, attributes, ground)
    lit = _draw_beam(ax, attributes, ground)
    lines = [_points(target.get(plane.outline, [])) for target in plane.targets]
    outlines = [ground.place(line) for line in lines if len(line)]
    height = _set_limits(ax, seen, lit, np.concatenate([np.zeros((0, 2)), *outlines]))
    _draw_targets(ax, ground, plane)
    for pose, marker, label in ((ground.receiver, "+", "receiver's axis"), (ground.transmitter, "x", "laser's axis")):
        if pose is ground.receiver or ground.axes_differ(plane.z):
            point = ground.project(pose, np.zeros((1, 2)))
            ax.plot(*point.T, marker, color="black", markersize=9, label=label, path_effects=_HALO, zorder=6)
    return height


@dataclass(frozen=True)
class _Ground:
    """Map from angles and positions to distances [m] to the left of and along the lidar's azimuth on a level plane."""

    receiver: Pose
    transmitter: Pose
    azimuth: float  #: Direction of the receiver's axis, from +x towards +y [rad].
    sea: LevelSea
    z: float = 0.0  #: Plane height [m].

    @classmethod
    def of_result(cls, attributes: dict[str, Any]) -> _Ground:
        receiver, transmitter = (_pose(attributes, f"{name}_pose") for name in ("receiver", "transmitter"))
        # A vertical axis has no azimuth; its far direction has one.
        x, y = (receiver.axis if math.hypot(*receiver.axis[:2]) > 1e-6 else receiver.far)[:2]
        return cls(receiver, transmitter, math.atan2(y, x), _sea(attributes) or LevelSea((1.0,)))

    def at(self, z: float) -> _Ground:
        """Return the map to the plane at another height [m]."""
        return replace(self, z=z)

    def place(self, points: FloatArray) -> FloatArray:
        """Return (across, along) of positions (x, y), shape (..., 2)."""
        cos, sin = math.cos(self.azimuth), math.sin(self.azimuth)
        x, y = points[..., 0], points[..., 1]
        return np.stack([cos * y - sin * x, cos * x + sin * y], axis=-1)

    def project(self, pose: Pose, angles: FloatArray) -> FloatArray:
        """Return (across, along) of rays (angle_x, angle_y) [mrad], shape (..., 2); NaN for rays above the horizon."""
        return self.place(self.sea.at_height(pose.origin, pose.rays(1e-3 * angles), self.z))

    def axis_names(self) -> tuple[str, str]:
        """Return the axis names across and along the lidar's azimuth, with the direction of +x."""
        if abs(self.azimuth) < 1e-6:
            return "y (m)", "x (m), away from the lidar"
        side = "right" if self.azimuth > 0 else "left"
        turn = f"{abs(math.degrees(self.azimuth)):.3g}° to the {side}"
        return "to the left (m)", f"away from the lidar (m); +x points {turn}"

    def axis_points(self, z: float) -> list[str]:
        """Return the points where the receiver's axis, and the laser's where it differs, meet a height, as text."""
        drawn = [("axis", self.receiver), *([("laser", self.transmitter)] if self.axes_differ(z) else [])]
        # Adding 0 turns -0 into 0.
        places = [(name, np.round([*self._axis_at(pose, z), z], 3) + 0.0) for name, pose in drawn]
        return [f"{name} at ({x:.3f}, {y:.3f}, {z:.3f}) m" for name, (x, y, z) in places]

    def axes_differ(self, z: float) -> bool:
        """Return whether the laser's axis meets a height more than a millimetre away from the receiver's."""
        points = [self._axis_at(pose, z) for pose in (self.receiver, self.transmitter)]
        return float(np.linalg.norm(points[0] - points[1])) > _SAME_POINT

    def _axis_at(self, pose: Pose, z: float) -> FloatArray:
        return self.sea.at_height(pose.origin, pose.axis, z)


def _pose(attributes: dict[str, Any], name: str) -> Pose:
    """Return a pose; for a result without poses from its altitude and off-nadir angle."""
    pose = pose_of(attributes, name)
    if pose is not None:
        if pose.submerged:
            raise UserError("the lidar is under water: it has no layout on the sea to draw")
        return pose
    altitude, off_nadir_deg = (optional_number(attributes, key) for key in ("altitude", "off_nadir_deg"))
    if altitude is None or off_nadir_deg is None:
        raise UserError("the result has no altitude and off_nadir_deg among its attributes: it has no layout to draw")
    return Pose.from_angles(altitude, off_nadir_deg)


def _draw_pixels(ax: Axes, dataset: xr.Dataset, ground: _Ground, handles: list[Any]) -> FloatArray:
    """Draw the outlines of the pixels, or dots at their centres where there are none; return the points drawn."""
    names = [str(name) for name in dataset["pixel"].values]
    fills = [(to_rgba(colour, 0.25), colour) for colour in palette.pixel_colours(len(names))]
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
            ax.add_patch(drawing.outline_patch(loops, facecolor=fill, edgecolor=edge, linewidth=1.3))
            drawn += loops
    return np.concatenate(drawn)


def _draw_image(ax: Axes, dataset: xr.Dataset, ground: _Ground) -> FloatArray:
    """Draw the received energy in an imager's cells; return the points of its outline."""
    outline = _draw_field(ax, dataset.attrs, ground)
    if len(outline) == 0 or not np.isfinite(outline).all():
        return outline
    seen = drawing.as_seen(dataset)
    energy = seen["impulse_response"].sum("time").values
    rows, columns = energy.shape
    left, right, near, far = drawing.image_extent(dataset)
    angles = np.meshgrid(np.linspace(far, near, rows + 1), np.linspace(left, right, columns + 1), indexing="ij")
    corners = ground.project(ground.receiver, np.stack(angles, axis=-1))
    factor, prefix = drawing.si_prefix(float(np.nanmax(energy, initial=0.0)))
    edges: dict[str, Any] = {"edgecolors": "white" if max(rows, columns) <= _EDGED_CELLS else "none", "linewidth": 0.5}
    image = ax.pcolormesh(*np.moveaxis(corners, -1, 0), energy / factor, cmap=palette.SEQUENCE, **edges)
    image.set_clip_path(Line(outline), ax.transData)
    ax.figure.colorbar(image, ax=ax, location="bottom", shrink=0.7, aspect=35, label=f"received energy ({prefix}J)")
    return outline


def _draw_field(ax: Axes, attributes: dict[str, Any], ground: _Ground) -> FloatArray:
    """Draw the field-of-view outline if it is known; return its points."""
    width, shape = optional_number(attributes, "field_of_view_mrad"), attributes.get("field_of_view_shape")
    if width is None or shape not in ("circle", "square", "rectangle"):
        return np.zeros((0, 2))
    azimuth = np.linspace(0, 2 * np.pi, 185)  # with the corners of a square
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
            ax.plot(*points.T, style, color=palette.BEAM, linewidth=1.8, label=label, path_effects=_HALO, zorder=4)
            drawn.append(points)
            label = "_"
    return np.concatenate(drawn)


def _draw_targets(ax: Axes, ground: _Ground, plane: _Plane) -> None:
    """Draw the targets' outlines, with the depths of their highest points, or their shadows."""
    marks: dict[str, Any] = {"color": palette.TARGET, "path_effects": _HALO, "zorder": 5}
    for target in plane.targets:
        line = _points(target.get(plane.outline, []))
        if len(line) == 0:
            continue
        points = ground.place(line)
        if plane.outline == "shadow":
            ax.fill(*points.T, facecolor=_SHADOW_COLOUR, edgecolor="none", label=_once(ax, "shadow of target"))
            continue
        label = _once(ax, "target" if plane.outline == "line" else "target as seen, refracted")
        style = (0, (4, 1.2)) if plane.outline == "line" else (0, (1.5, 1.2))
        ax.plot(*points.T, linewidth=1.6, linestyle=style, label=label, **marks)
        first, last = np.transpose([sorted(ax.get_xlim()), ax.get_ylim()])
        low, high = np.maximum(points.min(axis=0), first), np.minimum(points.max(axis=0), last)
        if np.any(low > high):
            continue
        # At the upper edge of the visible part: the middle may be hidden by the axis.
        place, text = (0.5 * (low[0] + high[0]), high[1]), {"ha": "center", "va": "top", "fontsize": "small", **marks}
        ax.annotate(f"{-target['z'][1]:.3g} m", place, (0, -3), textcoords="offset points", **text)


def _once(ax: Axes, label: str) -> str:
    """Return a label, or one that legends leave out if the axes have it already."""
    return "_" if label in ax.get_legend_handles_labels()[1] else label


def _set_limits(ax: Axes, seen: FloatArray, lit: FloatArray, outlines: FloatArray) -> float:
    """Show the footprints of all pixels, the beam up to one footprint beyond them, and targets up to three.

    Return a height in inches.
    """
    seen, lit, outlines = (points[np.isfinite(points).all(axis=1)] for points in (seen, lit, outlines))
    if len(seen) == 0:
        raise UserError("the result has no pixels that look at the sea: it has no layout to draw")
    low, high = seen.min(axis=0), seen.max(axis=0)
    size = np.maximum(high - low, 1e-3)
    lit = np.clip(lit, low - size, high + size)
    outlines = np.clip(outlines, low - 3 * size, high + 3 * size)
    lit = np.concatenate([lit, outlines])
    low, high = np.min([low, *lit], axis=0) - 0.05 * size, np.max([high, *lit], axis=0) + 0.05 * size
    ax.set(xlim=(high[0], low[0]), ylim=(low[1], high[1]))
    aspect = float((high[1] - low[1]) / (high[0] - low[0]))
    to_scale = 1 / _LARGEST_ASPECT <= aspect <= _LARGEST_ASPECT
    ax.set_aspect("equal" if to_scale else "auto")
    drawing.add_grid(ax)
    return min(max(5.0 * aspect, 3.6), 8.0) if to_scale else 6.4


def _title(attributes: dict[str, Any]) -> str:
    parts = [drawing.scene_name(attributes)]
    for name, text in (("altitude", "altitude {:.4g} m"), ("off_nadir_deg", "{:.3g}° off nadir")):
        value = optional_number(attributes, name)
        parts.append("" if value is None else text.format(value))
    return "  ·  ".join(part for part in parts if part)


def _points(line: Sequence[float]) -> FloatArray:
    return np.array(line, dtype=np.float64).reshape(-1, 2)
