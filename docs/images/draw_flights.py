"""Draws the axes and angles of docs/guide/flights.md: ``python docs/images/draw_flights.py [FOLDER]``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.flights.poses.records import rotation_matrices
from mitransient_lidar.flights.poses.scanner import Fixed
from mitransient_lidar.plots import drawing, palette

#: Angles of the drawing [deg].
_YAW, _ROLL, _PITCH, _NADIR_ANGLE, _AZIMUTH = 35.0, 20.0, 20.0, 32.0, 65.0

#: Lines of an aircraft in the axes of the platform, x to the right, y forward and z up, and their widths.
_AIRCRAFT = (
    ([(0, -1.1, 0), (0, 0.9, 0)], 9.0),
    ([(-1, 0.1, 0), (1, 0.1, 0)], 6.0),
    ([(-0.35, -1, 0), (0.35, -1, 0)], 4.0),
    ([(0, -1.1, 0), (0, -1.05, 0.35)], 4.0),
)

_LEVER_ARM = (0.0, 0.45, -0.22)

#: Axes of the scene to the right and up in the views from above, from behind, and from the right of a northward flight.
_ABOVE, _BEHIND, _SIDE = ((0, 1), (0, 2), (1, 2))

_GREY, _BLUE, _GREEN, _RED = palette.GREY, palette.BLUE, palette.GREEN, palette.RED


def main(path: Path) -> None:
    """Draw the axes, and the signs for yaw, roll, pitch and a scanner's angles, as the flights have them."""
    figure = drawing.new_figure(path, 8.5, 8.5)
    above, behind, side, scan = figure.subplots(2, 2).ravel()

    ax = _view(above, "Yaw (heading): clockwise from north", ("x, east", "y, north"))
    turn = _turned(yaw=_YAW)
    _aircraft(ax, _ABOVE, turn)
    _arrow(ax, (0, 0), (0, 1.75), _GREY, "north")
    _arrow(ax, (0, 0), _seen(_ABOVE, turn, (0, 1.75, 0)), _BLUE, "forward, y")
    _arrow(ax, (0, 0), _seen(_ABOVE, turn, (1.4, 0, 0)), _BLUE, "right, x")
    _arc(ax, 90, 90 - _YAW, 1.35, "yaw")

    ax = _view(behind, "Roll: right side down\n(seen from behind)", ("x", "z, up"))
    turn = _turned(roll=_ROLL)
    _aircraft(ax, _BEHIND, turn)
    ax.plot([0, 1.6], [0, 0], "--", color=_GREY)
    _arrow(ax, (0, 0), _seen(_BEHIND, turn, (1.4, 0, 0)), _BLUE, "right, x")
    _arrow(ax, (0, 0), _seen(_BEHIND, turn, (0, 0, 1.2)), _BLUE, "up, z")
    _beam(ax, _seen(_BEHIND, turn, (0, 0, -1.7)))
    _arc(ax, 0, -_ROLL, 1.2, "roll")

    ax = _view(side, "Pitch: nose up\n(seen from the right)", ("y", "z, up"))
    turn = _turned(pitch=_PITCH)
    _aircraft(ax, _SIDE, turn)
    ax.plot([0, 1.6], [0, 0], "--", color=_GREY)
    _arrow(ax, (0, 0), _seen(_SIDE, turn, (0, 1.35, 0)), _BLUE, "forward, y")
    _arrow(ax, (0, 0), _seen(_SIDE, turn, (0, 0, 1.2)), _BLUE, "up, z")
    _arc(ax, 0, _PITCH, 1.2, "pitch")
    scanner = _seen(_SIDE, turn, _LEVER_ARM)
    ax.plot(*scanner, "s", color=_RED, markersize=7)
    ax.plot([0, scanner[0]], [0, scanner[1]], color=_RED, linewidth=1)
    ax.annotate("lever arm", _pair(scanner), (8, -9), textcoords="offset points", color=_RED)
    end = scanner + _seen(_SIDE, turn, (0, 0, -1.4))
    _beam(ax, end, scanner)

    ax = _view(scan, "Scanner: angle from its nadir, azimuth\nfrom forward; far and left of the pixels", ("", ""))
    ax.set(xlim=(-1.5, 2.7), ylim=(-2.7, 1.5))
    _draw_scanner(ax)
    drawing.save(figure, path)


def _draw_scanner(ax: Axes) -> None:
    """Draw a scanner's beam in its frame, in an oblique view from behind and above on the right."""
    to_view = np.array([(0.9, 0.42, 0.0), (-0.28, 0.5, 0.82)])
    axis, far, left = (
        to_view @ one[0] for one in Fixed(nadir_angle_deg=_NADIR_ANGLE, azimuth_deg=_AZIMUTH).directions([0])
    )
    for vector, name in (((1.3, 0, 0), "right, x"), ((0, 1.7, 0), "forward, y"), ((0, 0, 0.7), "up, z")):
        _arrow(ax, (0, 0), to_view @ vector, _BLUE, name)
    depth, cone = 1.9, np.radians(_NADIR_ANGLE)
    inner = 0.6 * cone
    circle = depth / np.cos(cone) * _directions(cone, np.linspace(0, 2 * np.pi, 181)) @ to_view.T
    ground = depth / np.cos(inner) * _directions(inner, np.linspace(0, np.radians(_AZIMUTH), 31)) @ to_view.T
    meridian = 0.9 * _directions(np.linspace(0, cone, 31), np.radians(_AZIMUTH)) @ to_view.T
    nadir, end = to_view @ (0, 0, -depth), axis * depth / np.cos(cone)
    ax.plot(*circle.T, color=_GREY, linewidth=1)
    ax.plot([0, nadir[0]], [0, nadir[1]], "--", color=_GREY)
    for point in (circle[0], end):
        ax.plot([nadir[0], point[0]], [nadir[1], point[1]], color=_GREY, linewidth=1)
    _beam(ax, end)
    for line, name in ((meridian, "angle from nadir "), (ground, "azimuth ")):
        ax.plot(*line.T, color=_RED)
        ax.text(*_pair(line[0]), name, color=_RED, ha="right")
    for side, name in ((far, "far"), (left, "left")):
        _arrow(ax, end, end + 0.95 * side, "black", name)


def _directions(nadir_angle: FloatArray | float, azimuth: FloatArray | float) -> FloatArray:
    """Return unit vectors at angles from the nadir and azimuths from y [rad], shape (n, 3)."""
    sin, cos, azimuth = np.broadcast_arrays(np.sin(nadir_angle), np.cos(nadir_angle), azimuth)
    return np.column_stack([sin * np.sin(azimuth), sin * np.cos(azimuth), -cos])


def _view(ax: Axes, title: str, labels: tuple[str, str]) -> Axes:
    """Prepare a view with equal scales and no ticks."""
    ax.set(title=title, xlabel=labels[0], ylabel=labels[1], xlim=(-2.1, 2.1), ylim=(-2.1, 2.1), aspect="equal")
    ax.set(xticks=[], yticks=[])
    return ax


def _turned(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> FloatArray:
    """Return an attitude's matrix [deg]."""
    return rotation_matrices(roll, pitch, yaw)


def _seen(view: tuple[int, int], turn: FloatArray, vector: npt.ArrayLike) -> FloatArray:
    """Return a platform vector in a view."""
    return np.asarray(turn @ np.asarray(vector, dtype=np.float64))[list(view)]


def _aircraft(ax: Axes, view: tuple[int, int], turn: FloatArray) -> None:
    """Draw the aircraft."""
    for points, width in _AIRCRAFT:
        line = np.stack([_seen(view, turn, point) for point in points])
        ax.plot(*line.T, color="#c4ccd6", linewidth=width, solid_capstyle="round", zorder=1)


def _arrow(ax: Axes, start: npt.ArrayLike, end: npt.ArrayLike, colour: str, name: str) -> None:
    """Draw an axis with its name."""
    tail, head = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    _line_with_head(ax, tail, head, color=colour)
    offset = _pair(np.array([28, 11]) * (head - tail) / np.linalg.norm(head - tail))
    ax.annotate(
        name, _pair(head), offset, textcoords="offset points", ha="center", va="center", color=colour, fontsize=9
    )


def _arc(ax: Axes, first: float, last: float, radius: float, name: str) -> None:
    """Draw an angle's arc, from one direction on the page to another [deg], with an arrow at its end."""
    angle = np.radians(np.linspace(first, last, 41))
    line = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    ax.plot(*line[:-1].T, color=_RED)
    _line_with_head(ax, line[-4], line[-1], color=_RED)
    x, y = _pair(1.18 * line[20])
    ax.text(x, y, name, color=_RED, ha="center", va="center")


def _beam(ax: Axes, end: npt.ArrayLike, start: npt.ArrayLike = (0, 0)) -> None:
    """Draw a pulse."""
    _line_with_head(ax, start, end, color=_GREEN, linewidth=2)


def _line_with_head(ax: Axes, start: npt.ArrayLike, end: npt.ArrayLike, **style: Any) -> None:
    """Draw an arrow."""
    ax.annotate("", _pair(end), _pair(start), arrowprops={"arrowstyle": "-|>", "shrinkA": 0, "shrinkB": 0, **style})


def _pair(point: npt.ArrayLike) -> tuple[float, float]:
    """Return a point of the page as Matplotlib takes it."""
    x, y = np.asarray(point, dtype=np.float64).tolist()
    return x, y


if __name__ == "__main__":
    main((Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent) / "flights_mounting.png")
