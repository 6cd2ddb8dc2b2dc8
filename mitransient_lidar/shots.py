"""Where on a sea to shoot: positions by the slope that the beam meets, and a picture of them."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mitransient_lidar import rendering, variants
from mitransient_lidar.errors import UserError
from mitransient_lidar.loading import load_scene
from mitransient_lidar.optics.checks import FloatArray, positive, whole

if TYPE_CHECKING:
    import mitsuba as mi
    import xarray as xr
    from matplotlib.axes import Axes

    from mitransient_lidar.transport.pose import Pose

#: Slopes along and across the lidar's azimuth that a kind of shot looks for, in standard deviations of the sea's.
KINDS = {"towards": (1.0, 0.0), "level": (0.0, 0.0), "away": (-1.0, 0.0), "sideways": (0.0, 1.0)}

#: Longest side of the sea that is searched [m].
_LARGEST_SEARCH = 512.0

_PASSES = 12


@dataclass(frozen=True)
class Shot:
    """A place on the sea where the beam's axis meets the mean level.

    Attributes
    ----------
    kind
        ``towards``, ``level``, ``away`` or ``sideways``; or how the caller calls it.
    x, y
        Place [m], the values of ``shot_x`` and ``shot_y``.
    along, across
        Mean slopes over the beam's footprint along the lidar's azimuth and to its left [rad]: positive along is a
        face turned towards the lidar.
    """

    kind: str
    x: float
    y: float
    along: float
    across: float


@dataclass(frozen=True)
class SeaMap:
    """Elevation of a sea, and its slopes averaged over the beam's footprint, on a grid.

    Attributes
    ----------
    x, y
        Grid lines [m].
    heights, along, across
        Elevation [m] and mean slopes along the lidar's azimuth and to its left [1], shape (len(y), len(x)).
    """

    x: FloatArray
    y: FloatArray
    heights: FloatArray
    along: FloatArray
    across: FloatArray

    @classmethod
    def of_scene(cls, scene: mi.Scene) -> SeaMap:
        """Find the sea and the beam of a loaded scene.

        Raises
        ------
        UserError
            When the scene has no ``ocean_surface`` with waves.
        """
        from scipy.ndimage import gaussian_filter

        sea = next((shape.sea for shape in scene.shapes() if hasattr(shape, "sea")), None)
        if sea is None or not math.isfinite(sea.cell_size):
            raise UserError("the scene has no ocean_surface with waves: every shot on a flat sea is the same")
        transmitter = _transmitter(scene)
        count = getattr(sea.waves, "heights", np.zeros((0, 0))).shape[0] or int(sea.extent / sea.cell_size)
        count = min(count, int(_LARGEST_SEARCH / sea.cell_size)) // 2
        lines = np.arange(-count, count) * sea.cell_size
        heights = sea.heights(lines, lines)
        azimuth, spread_along, spread_across = _footprint(transmitter)
        # The footprint is an ellipse; its mean radius serves a search.
        sigma = math.sqrt(spread_along * spread_across) / sea.cell_size
        # What has waves repeats itself at its edges, or there is nothing beyond them.
        smooth = gaussian_filter(heights, sigma, mode="wrap" if sea.spectrum != "height_map" else "nearest")
        up, right = np.gradient(smooth, sea.cell_size)
        cos, sin = math.cos(azimuth), math.sin(azimuth)
        return cls(lines, lines, heights, cos * right + sin * up, cos * up - sin * right)

    def slope_at(self, x: float, y: float) -> tuple[float, float]:
        """Return the mean slopes (along, across) [1] over a footprint at a place [m]; the sea repeats itself."""
        spacing = self.x[1] - self.x[0]
        i = round((x - self.x[0]) / spacing) % len(self.x)
        j = round((y - self.y[0]) / spacing) % len(self.y)
        return float(self.along[j, i]), float(self.across[j, i])

    def find(self, kind: str, steepness: float, count: int, apart: float) -> list[Shot]:
        """Return the places whose slopes are nearest to those of a kind, at least `apart` metres from each other."""
        spread = np.sqrt([np.mean(self.along**2), np.mean(self.across**2)])
        wanted = steepness * np.array(KINDS[kind]) * spread
        distance = np.hypot((self.along - wanted[0]) / spread[0], (self.across - wanted[1]) / spread[1])
        shots: list[Shot] = []
        for index in np.argsort(distance, axis=None):
            j, i = np.unravel_index(index, distance.shape)
            x, y = float(self.x[i]), float(self.y[j])
            if all(math.hypot(x - shot.x, y - shot.y) >= apart for shot in shots):
                shots.append(Shot(kind, x, y, float(self.along[j, i]), float(self.across[j, i])))
            if len(shots) == count:
                break
        return shots


def find_shots(
    scene: Any, params: Mapping[str, Any] | None = None, *, steepness: float = 2.0, count: int = 1
) -> list[Shot]:
    """Find places of each kind of slope on the sea of a scene.

    Parameters
    ----------
    scene, params
        As `rendering.render` takes them.
    steepness
        Slopes to look for, in standard deviations of the mean slope over a footprint, greater than 0.
    count
        Places of each kind, 1 to 100.

    Returns
    -------
    list of Shot
        Those of one kind by how near their slopes are to the wanted ones.

    Raises
    ------
    UserError
        When the scene is wrong or has no waves.
    ValueError
        When `steepness` or `count` is out of range.
    """
    steepness, count = positive("steepness", steepness), whole("count", count, 1, 100)
    variants.set_variant()
    loaded, _, _ = load_scene(scene, params)
    sea = SeaMap.of_scene(loaded)
    apart = 4 * _footprint(_transmitter(loaded))[1]
    return [shot for kind in KINDS for shot in sea.find(kind, steepness, count, apart)]


def shots_at(scene: Any, places: Sequence[tuple[float, float]], params: Mapping[str, Any] | None = None) -> list[Shot]:
    """Return shots at given places (x, y) [m] of the sea of a scene; raises as `find_shots`."""
    variants.set_variant()
    loaded, _, _ = load_scene(scene, params)
    sea = SeaMap.of_scene(loaded)
    return [Shot(f"shot {number}", x, y, *sea.slope_at(x, y)) for number, (x, y) in enumerate(places, start=1)]


def plot_shots(
    scene: Any,
    shots: Sequence[Shot],
    path: str | os.PathLike[str],
    params: Mapping[str, Any] | None = None,
    *,
    waveforms: bool = True,
) -> list[xr.Dataset]:
    """Draw the sea with the footprints of beam and pixels at some places, and the waveforms received from each.

    Parameters
    ----------
    scene, params
        An XML scene with the parameters ``shot_x`` and ``shot_y``.
    shots
        Places to draw.
    path
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.
    waveforms
        Whether to render each shot and draw its surface echo.

    Returns
    -------
    list of xarray.Dataset
        What was rendered.

    Raises
    ------
    UserError
        When the scene is wrong, has no waves or no parameters ``shot_x`` and ``shot_y``.
    """
    from matplotlib.figure import Figure

    from mitransient_lidar.plotting import check_format
    from mitransient_lidar.results import replacing

    check_format(Path(path))
    variants.set_variant()
    loaded, name, _ = load_scene(scene, params)
    sea = SeaMap.of_scene(loaded)
    results = []
    if waveforms:
        for shot in shots:
            place = {**(params or {}), "shot_x": shot.x, "shot_y": shot.y}
            results.append(rendering.render(scene, params=place, passes=_PASSES))
    columns = min(2, len(results))
    rows = -(-len(results) // columns) if results else 1
    figure = Figure(figsize=(6.0 + 3.6 * columns, max(5.4, 2.7 * rows)), layout="constrained")
    grid = figure.add_gridspec(rows, 1 + columns, width_ratios=[1.5, *[1.0] * columns])
    _draw_sea(figure.add_subplot(grid[:, 0]), loaded, sea, shots)
    for index, (shot, result) in enumerate(zip(shots, results, strict=False)):
        _draw_echo(figure.add_subplot(grid[index // columns, 1 + index % columns]), shot, result)
    figure.suptitle(name)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=160)
    return results


def _draw_sea(ax: Axes, scene: mi.Scene, sea: SeaMap, shots: Sequence[Shot]) -> None:
    """Draw elevations about the shots, and for each the pixels' and the beam's outlines on the mean level."""
    from matplotlib.patches import Ellipse

    transmitter = _transmitter(scene)
    azimuth, along, across = _footprint(transmitter)
    x, y = np.array([shot.x for shot in shots]), np.array([shot.y for shot in shots])
    margin = max(6 * along, 0.1 * max(np.ptp(x), np.ptp(y)))
    spacing = sea.x[1] - sea.x[0]
    windows = []
    for places, lines in ((x, sea.x), (y, sea.y)):
        first = math.floor((places.min() - margin - lines[0]) / spacing)
        last = math.ceil((places.max() + margin - lines[0]) / spacing)
        windows.append(np.arange(first, last + 1))
    heights = sea.heights[np.ix_(windows[1] % len(sea.y), windows[0] % len(sea.x))]
    edges = [sea.x[0] + windows[0][[0, -1]] * spacing, sea.y[0] + windows[1][[0, -1]] * spacing]
    image = ax.imshow(heights, origin="lower", extent=(*edges[0], *edges[1]), cmap="Blues_r", interpolation="bilinear")
    ax.figure.colorbar(image, ax=ax, label="elevation (m)", shrink=0.6)
    for number, shot in enumerate(shots, start=1):
        for outline, colour in _pixel_outlines(scene, shot):
            ax.contour(*outline, levels=[0.5], colors=[colour], linewidths=1.2)
        beam = Ellipse((shot.x, shot.y), 2 * along, 2 * across, angle=math.degrees(azimuth), fill=False, color="gold")
        ax.add_patch(beam)
        ax.annotate(f"{number}", (shot.x, shot.y), color="gold", ha="center", va="center", fontweight="bold")
    ax.set_aspect("equal")
    ax.set_xlabel("x (m), away from the lidar" if abs(azimuth) < 1e-6 else "x (m)")
    ax.set_ylabel("y (m)")


def _pixel_outlines(scene: mi.Scene, shot: Shot) -> list[tuple[tuple[FloatArray, FloatArray, FloatArray], Any]]:
    """Return for each pixel a mask on the mean sea level about a shot, as contours take it, and its colour."""
    import mitsuba as mi

    from mitransient_lidar.plotting import colours

    receiver = scene.sensors()[0].receiver
    pose: Pose = receiver.pose
    if receiver.pixels.count > 64:
        return []
    centre = pose.ground_point()
    reach = 0.6 * receiver.pixels.field_of_view * float(np.linalg.norm(centre - pose.origin)) / -float(pose.axis[2])
    ticks = np.linspace(-reach, reach, 301)
    x, y = np.meshgrid(ticks, ticks)
    points = np.stack([x + centre[0], y + centre[1], np.zeros_like(x)], axis=-1).reshape(-1, 3) - pose.origin
    depth = points @ pose.axis
    gx, gy = ((points @ side / depth).astype(np.float32) for side in (pose.far, pose.left))
    index, held = receiver.pixels.pixel_at(mi.Float(gx), mi.Float(gy), mi.Float(0.5))
    seen: npt.NDArray[np.int64] = np.where(np.array(held) > 0, np.array(index).astype(int), -1).reshape(x.shape)
    palette = colours(receiver.pixels.count)
    return [
        ((x + shot.x, y + shot.y, (seen == number).astype(np.float64)), palette[number])
        for number in range(receiver.pixels.count)
        if (seen == number).any()
    ]


def _draw_echo(ax: Axes, shot: Shot, result: xr.Dataset) -> None:
    """Draw the waveforms of one shot against time, with the slope that the beam has met."""
    from mitransient_lidar.plotting import colours, time_limits

    power = result["waveform"].values.reshape(-1, result.sizes["time"])
    for values, colour in zip(power, colours(len(power)), strict=True):
        ax.plot(result["time"].values, 1e3 * values, color=colour, linewidth=1.1)
    ax.set_xlim(time_limits(result))
    ax.set_ylim(0, None)
    slopes = f"{math.degrees(math.atan(shot.along)):+.1f}°, {math.degrees(math.atan(shot.across)):+.1f}°"
    ax.set_title(f"{shot.kind} ({slopes})", fontsize="small")
    ax.set_xlabel("time (ns)")
    ax.set_ylabel("power (mW)")


def _transmitter(scene: mi.Scene) -> mi.Emitter:
    transmitter = next((emitter for emitter in scene.emitters() if hasattr(emitter, "pulse_energy")), None)
    if transmitter is None or not scene.sensors():
        raise UserError("the scene needs a lidar_transmitter and a multipixel_receiver to find shots for")
    return transmitter


def _footprint(transmitter: mi.Emitter) -> tuple[float, float, float]:
    """Return the beam's azimuth [rad], and its spread on the mean sea level along and across it [m]."""
    pose: Pose = transmitter.pose
    across = transmitter.widest_angular_spread * float(np.linalg.norm(pose.ground_point() - pose.origin))
    cosine = max(-float(pose.axis[2]), 1e-3)
    azimuth = math.atan2(pose.axis[1], pose.axis[0]) if math.hypot(*pose.axis[:2]) > 1e-9 else 0.0
    return azimuth, across / cosine, across
