"""Where a shot looks: pixels, beam and targets on the mean sea level, drawn from a result alone."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mitransient_lidar.errors import UserError
from mitransient_lidar.optics.checks import FloatArray

if TYPE_CHECKING:
    import mitsuba as mi
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from mitransient_lidar.transport.system import LidarScene

#: Receivers of more pixels than this are described by their field of view only.
_MOST_PIXELS = 256

#: Longest text of an attribute: NetCDF files keep no more than 64 KiB in one.
_LONGEST_TEXT = 60_000

#: How far lines may pass by the points that they leave out, in parts of their extent.
_SLACK = 5e-4

#: Pixels that are listed by name, and cells along a side of an imager that have edges.
_LISTED_PIXELS = 12
_EDGED_CELLS = 16

#: Footprints longer than this many times their width are drawn out of scale.
_LONGEST_SHAPE = 4.0

_BEAM_COLOUR = "#e07b00"
_TARGET_COLOUR = "#7a3fb0"
_SHARES = {0.6065: "e$^{-1/2}$", 0.1353: "e$^{-2}$", 1.0: "rim"}


def describe_layout(system: LidarScene) -> dict[str, Any]:
    """Return the attributes of a result from which `plot_layout` draws.

    Parameters
    ----------
    system
        The lidar scene.

    Returns
    -------
    dict
        ``receiver_pose`` and ``transmitter_pose``: origin [m], axis, far and left, 12 numbers each. As JSON texts:
        ``beam_outlines`` (share of the peak, and lines), ``pixel_outlines`` (lines of each pixel; not of imagers, whose
        grid is known) and ``target_outlines`` (lowest and highest point [m], and line of each). A line is closed and
        holds gx, gy [mrad] of one point after the other, or x, y [m] for targets. Too long a text is left out.
    """
    from mitransient_lidar.transport.beam_profiles import pixel_outlines, simplified

    transmitter, receiver = system.transmitter, system.receiver
    texts: dict[str, list[Any]] = {"target_outlines": _target_outlines(system), "beam_outlines": []}
    for share, lines in transmitter.profile.outlines():
        short = [_flat(simplified(1e3 * line, 1e3 * _SLACK * float(np.ptp(line)))) for line in lines]
        texts["beam_outlines"].append({"share": round(share, 4), "lines": short})
    if receiver.pixels.grid is None and receiver.pixels.count <= _MOST_PIXELS:
        texts["pixel_outlines"] = [[_flat(1e3 * line) for line in lines] for lines in pixel_outlines(receiver.pixels)]
    described: dict[str, Any] = {
        f"{name}_pose": np.concatenate([pose.origin, pose.axis, pose.far, pose.left]).tolist()
        for name, pose in (("transmitter", transmitter.pose), ("receiver", receiver.pose))
    }
    for name, value in texts.items():
        text = json.dumps(value, separators=(",", ":"))
        if value and len(text) <= _LONGEST_TEXT:
            described[name] = text
    return described


def plot_layout(dataset: xr.Dataset, path: str | os.PathLike[str] | None = None) -> Figure:
    """Draw the pixels of a result, its beam and its targets on the mean sea level, away from the lidar upwards.

    Targets are drawn where they are, not where the refracted light meets them. An imager's cells show the energy that
    they have received.

    Parameters
    ----------
    dataset : xarray.Dataset
        A result of `mitransient_lidar.results`.
    path : path, optional
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.

    Returns
    -------
    matplotlib.figure.Figure
        Independent of pyplot; needs no closing.

    Raises
    ------
    UserError
        If the result does not tell where the lidar is and what it sees, its receiver does not look at the sea, the
        suffix of `path` is another one, or the file cannot be written.
    """
    from matplotlib.figure import Figure

    from mitransient_lidar.plotting import check_format
    from mitransient_lidar.results import replacing

    if path is not None:
        check_format(Path(path))
    attributes = dataset.attrs
    ground = _Ground.of_result(attributes)
    figure = Figure(figsize=(6.8, 6.4), layout="constrained")
    ax = figure.add_subplot()
    handles: list[Any] = []
    if "pixel" in dataset.dims:
        seen = _draw_pixels(ax, dataset, ground, handles)
    else:
        seen = _draw_image(figure, ax, dataset, ground)
    lit = _draw_beam(ax, attributes, ground)
    _draw_targets(ax, attributes, ground)
    _set_limits(figure, ax, seen, lit)
    names = ("y (m)", "x (m)") if abs(ground.azimuth) < 1e-6 else ("across (m)", "along (m)")
    ax.set_xlabel(names[0] if ax.get_aspect() == 1 else f"{names[0]}, out of scale")
    ax.set_ylabel(f"{names[1]}, away from the lidar")
    handles += ax.get_legend_handles_labels()[0]
    ax.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.01, 1.01), frameon=False, handlelength=1.8)
    ax.set_title(_title(attributes), fontsize="medium")
    if path is not None:
        with replacing(path) as temporary:
            figure.savefig(temporary, dpi=160)
    return figure


@dataclass(frozen=True)
class _Ground:
    """Maps angles and places to distances across the lidar's azimuth and along it on the mean sea level [m].

    Attributes
    ----------
    receiver, transmitter
        Origin, axis, far and left, shape (4, 3).
    azimuth
        Direction of the receiver's axis, from +x towards +y [rad].
    """

    receiver: FloatArray
    transmitter: FloatArray
    azimuth: float

    @classmethod
    def of_result(cls, attributes: dict[str, Any]) -> _Ground:
        receiver, transmitter = (_pose(attributes, f"{name}_pose") for name in ("receiver", "transmitter"))
        # An axis straight down has no azimuth of its own.
        x, y = receiver[1 if math.hypot(*receiver[1, :2]) > 1e-6 else 2, :2]
        return cls(receiver, transmitter, math.atan2(y, x))

    def place(self, points: FloatArray) -> FloatArray:
        """Return (across, along) of places (x, y), shape (..., 2)."""
        cos, sin = math.cos(self.azimuth), math.sin(self.azimuth)
        x, y = points[..., 0], points[..., 1]
        return np.stack([cos * y - sin * x, cos * x + sin * y], axis=-1)

    def project(self, pose: FloatArray, angles: FloatArray) -> FloatArray:
        """Return (across, along) of rays (gx, gy) [mrad], shape (..., 2); NaN for those that look above the horizon."""
        rays = pose[1] + 1e-3 * (angles[..., :1] * pose[2] + angles[..., 1:] * pose[3])
        down = np.where(rays[..., 2:] < -1e-9, rays[..., 2:], np.nan)
        return self.place(pose[0] - pose[0, 2] * rays / down)


def _pose(attributes: dict[str, Any], name: str) -> FloatArray:
    """Return a pose, of an older result from altitude and angle."""
    from mitransient_lidar.plotting import number

    if len(attributes.get(name, ())) == 12:
        return np.array(attributes[name], dtype=np.float64).reshape(4, 3)
    altitude, off_nadir_deg = number(attributes, "altitude"), number(attributes, "off_nadir_deg")
    if altitude is None or off_nadir_deg is None:
        raise UserError("the result has no altitude and off_nadir_deg among its attributes: it has no layout to draw.")
    sin, cos = math.sin(math.radians(off_nadir_deg)), math.cos(math.radians(off_nadir_deg))
    return np.array([[-altitude * sin / cos, 0, altitude], [sin, 0, -cos], [cos, 0, sin], [0, 1, 0]])


def _draw_pixels(ax: Axes, dataset: xr.Dataset, ground: _Ground, handles: list[Any]) -> FloatArray:
    """Draw the pixels, as dots where their outlines are not known; return the points drawn."""
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Patch, PathPatch
    from matplotlib.path import Path as Line

    from mitransient_lidar.plotting import colours

    names = [str(name) for name in dataset["pixel"].values]
    fills = [(to_rgba(colour, 0.25), colour) for colour in colours(len(names))]
    if len(names) <= _LISTED_PIXELS:
        handles += [Patch(facecolor=f, edgecolor=e, label=name) for name, (f, e) in zip(names, fills, strict=True)]
    outlines = json.loads(dataset.attrs.get("pixel_outlines", "[]"))
    if len(outlines) != len(names):
        centres = ground.project(ground.receiver, np.stack([dataset["gx"].values, dataset["gy"].values], axis=-1))
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


def _draw_image(figure: Figure, ax: Axes, dataset: xr.Dataset, ground: _Ground) -> FloatArray:
    """Draw an imager's cells with the energy that they have received; return the points of its outline."""
    from matplotlib.path import Path as Line

    from mitransient_lidar.plotting import number, si_prefix

    outline = _draw_field(ax, dataset.attrs, ground)
    width = number(dataset.attrs, "field_of_view_mrad")
    if width is None or not np.isfinite(outline).all():
        return outline
    energy = dataset["impulse_response"].sum("time").values
    rows, columns = energy.shape
    far, left = np.linspace(width / 2, -width / 2, rows + 1), np.linspace(-width / 2, width / 2, columns + 1)
    corners = ground.project(ground.receiver, np.stack(np.meshgrid(far, left, indexing="ij"), axis=-1))
    factor, prefix = si_prefix(float(np.nanmax(energy, initial=0.0)))
    image = ax.pcolormesh(
        *np.moveaxis(corners, -1, 0),
        energy / factor,
        cmap="viridis",
        edgecolors="white" if max(rows, columns) <= _EDGED_CELLS else "none",
        linewidth=0.5,
    )
    image.set_clip_path(Line(outline), ax.transData)
    figure.colorbar(image, ax=ax, location="bottom", shrink=0.7, aspect=35, label=f"received energy ({prefix}J)")
    return outline


def _draw_field(ax: Axes, attributes: dict[str, Any], ground: _Ground) -> FloatArray:
    """Draw the outline of the field of view where it is known; return its points."""
    from mitransient_lidar.plotting import number

    width, shape = number(attributes, "field_of_view_mrad"), attributes.get("field_of_view_shape")
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
        label = f"beam, {_SHARES.get(outline['share'], outline['share'])}"
        for line in outline["lines"]:
            points = ground.project(ground.transmitter, _points(line))
            ax.plot(*points.T, style, color=_BEAM_COLOUR, linewidth=1.8, label=label, path_effects=_halo(), zorder=4)
            drawn.append(points)
            label = "_"
    return np.concatenate(drawn)


def _draw_targets(ax: Axes, attributes: dict[str, Any], ground: _Ground) -> None:
    label = "target"
    for target in json.loads(attributes.get("target_outlines", "[]")):
        points = ground.place(_points(target["line"]))
        marks: dict[str, Any] = {"color": _TARGET_COLOUR, "path_effects": _halo(), "zorder": 5}
        ax.plot(*points.T, linewidth=1.6, linestyle=(0, (4, 1.2)), label=label, **marks)
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        depth = f"{-target['z'][1]:.3g} m"
        ax.annotate(depth, middle, ha="center", va="center", fontsize="small", annotation_clip=True, **marks)
        label = "_"


def _halo() -> list[Any]:
    """Return a light rim, which sets lines off from pixels of any colour."""
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=3.4, foreground="white", alpha=0.8)]


def _set_limits(figure: Figure, ax: Axes, seen: FloatArray, lit: FloatArray) -> None:
    """Show all that is seen, and the beam as far as it does not dwarf that."""
    seen, lit = (points[np.isfinite(points).all(axis=1)] for points in (seen, lit))
    if len(seen) == 0:
        raise UserError("the result does not tell what its pixels see on the sea: it has no layout to draw.")
    low, high = seen.min(axis=0), seen.max(axis=0)
    size = np.maximum(high - low, 1e-3)
    lit = np.clip(lit, low - size, high + size)
    low, high = np.min([low, *lit], axis=0) - 0.05 * size, np.max([high, *lit], axis=0) + 0.05 * size
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    shape = float((high[1] - low[1]) / (high[0] - low[0]))
    in_scale = 1 / _LONGEST_SHAPE <= shape <= _LONGEST_SHAPE
    ax.set_aspect("equal" if in_scale else "auto")
    ax.grid(True, color="0.9", linewidth=0.7)
    ax.set_axisbelow(True)
    figure.set_figheight(min(max(5.0 * shape, 3.6), 8.0) if in_scale else 6.4)


def _title(attributes: dict[str, Any]) -> str:
    from mitransient_lidar.plotting import number

    parts = [Path(str(attributes.get("scene", ""))).stem]
    for name, text in (("altitude", "{:.4g} m high"), ("off_nadir_deg", "{:.3g}° off nadir")):
        value = number(attributes, name)
        parts.append("" if value is None else text.format(value))
    return "  ·  ".join(part for part in parts if part)


def _target_outlines(system: LidarScene) -> list[dict[str, Any]]:
    """Return depths and outlines seen from above of the solids that are smaller than what the receiver sees."""
    pose = system.receiver.pose
    spot = pose.ground_point()
    reach = 0.5 * system.receiver.pixels.field_of_view * float(np.linalg.norm(spot - pose.origin))
    reach /= max(-float(pose.axis[2]), 1e-3)
    found = []
    for solid in system.solids:
        box = solid.bbox()
        low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
        covers = np.all(low[:2] < spot[:2] - reach) and np.all(high[:2] > spot[:2] + reach)
        beside = np.any(low[:2] > spot[:2] + 2 * reach) or np.any(high[:2] < spot[:2] - 2 * reach)
        if not (covers or beside):
            found.append({"z": [round(float(z), 4) for z in (low[2], high[2])], "line": _flat(_shadow(solid))})
    return found


def _shadow(solid: mi.Shape) -> FloatArray:
    """Return the convex outline (x, y) of a solid seen from above."""
    import mitsuba as mi
    from scipy.spatial import ConvexHull, QhullError

    from mitransient_lidar.transport.beam_profiles import simplified

    known = mi.traverse(solid)
    if "vertex_positions" in known:
        points = np.array(known["vertex_positions"]).reshape(-1, 3)
    else:
        ticks = np.linspace(0, 1, 65)
        u, v = (mi.Float(g.ravel()) for g in np.meshgrid(ticks, ticks))
        points = np.array(solid.sample_position(0.0, mi.Point2f(u, v)).p).T
    flat = np.unique(points[:, :2].astype(np.float64), axis=0)
    try:
        hull = flat[ConvexHull(flat).vertices]
    except QhullError:
        hull = flat[[0, -1]]  # upright, seen from above as a line
    closed = np.concatenate([hull, hull[:1]])
    return simplified(closed, _SLACK * float(np.ptp(closed)))


def _flat(line: FloatArray) -> list[float]:
    """Round to some 1/5000 of the largest number."""
    digits = max(0, 3 - math.floor(math.log10(max(float(np.abs(line).max()), 1e-6))))
    return np.round(line, digits).ravel().tolist()


def _points(line: Sequence[float]) -> FloatArray:
    return np.array(line, dtype=np.float64).reshape(-1, 2)
