"""Sea locations with given surface slopes over the beam's footprint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.options import Option, Scene, checked, positive_option
from mitransient_lidar.core.tables.written import table_lines
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.loading import variants
from mitransient_lidar.loading.exclusive import alone
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.rendering.passes import ProgressCallback
from mitransient_lidar.rendering.shots.series import render_shots
from mitransient_lidar.rendering.shots.truth import SLOPE_KINDS, SeaMap, Shot, footprint, transmitter_of

if TYPE_CHECKING:
    import xarray as xr

    from mitransient_lidar.physics.lidar.pose import Pose
    from mitransient_lidar.transport.sensor.receiver import Receiver

#: Largest number of pixels whose footprints are mapped.
_MOST_MAPPED_PIXELS = 64

_PASSES = 12


@dataclass(frozen=True)
class RenderedShots:
    """Shots in a scene, their results, the sea, and the footprints of beam and pixels on the mean sea level."""

    scene: str
    shots: tuple[Shot, ...]
    results: list[xr.Dataset]
    sea: SeaMap
    #: Beam azimuth [rad], and standard deviations of its footprint along and across it [m].
    azimuth: float
    beam_spread: tuple[float, float]
    #: Grid lines of a map about a shot [m], shape (n,), the pixel index at each node, shape (n, n), rows along y, and
    #: the number of pixels. The index is -1 outside all pixels, and everywhere with more than 64 pixels.
    pixel_lines: FloatArray
    pixel_map: npt.NDArray[np.int64]
    pixel_count: int


@checked
@alone
def find_shots(
    scene: Scene,
    params: Mapping[str, Any] | None = None,
    *,
    at: Annotated[Sequence[tuple[float, float]], Option("A location, instead of a search", unit="m", form="X,Y")] = (),
    slope_sigmas: Annotated[float, positive_option("Slopes to find, in standard deviations")] = 2.0,
    count: Annotated[int, Option("Locations of each kind", 1, 100)] = 1,
    waveforms: Annotated[bool, Option("Also render the shots")] = True,
    max_time: Annotated[
        float | None, positive_option("Stop before this many seconds, with fewer passes or waveforms")
    ] = None,
    progress: ProgressCallback | None = None,
) -> RenderedShots:
    """Find locations for each kind of slope on a scene's sea, within 256 m of its origin, and render them.

    Where the lidar's aim is more than 250 m from the origin, they are about the aim.

    Parameters
    ----------
    scene, params, progress
        As for `rendering.shots.series.render_shots`: an XML scene with the parameters ``aim_x`` and ``aim_y``.

    Returns
    -------
    RenderedShots
        Shots by kind, the nearest slopes first.

    Raises
    ------
    UserError
        If the scene is invalid or has no waves, a number is out of range, or the sea has no such slopes.
    """
    loaded = open_scene(scene, params).scene
    sea = SeaMap.of_scene(loaded)
    if len(at):
        shots = [Shot(f"shot {number}", x, y, *sea.slope_at(x, y)) for number, (x, y) in enumerate(at, start=1)]
    else:
        apart = 4 * footprint(transmitter_of(loaded))[1]
        shots = [shot for kind in SLOPE_KINDS for shot in sea.find(kind, slope_sigmas, count, apart)]
    return render_found_shots(scene, shots, params, waveforms=waveforms, max_time=max_time, progress=progress)


def describe_found_shots(rendered: RenderedShots) -> list[str]:
    """Return table lines for locations and slopes."""
    columns = (("kind", "<10"), ("aim_x", ">10.2f"), ("aim_y", ">10.2f"), ("along (deg)", ">13.2f"))
    angles = [np.degrees(np.arctan([shot.along, shot.across])) for shot in rendered.shots]
    rows = [(shot.kind, shot.x, shot.y, *pair) for shot, pair in zip(rendered.shots, angles, strict=True)]
    return table_lines((*columns, ("across (deg)", ">14.2f")), rows)


@alone
def render_found_shots(
    scene: Any,
    shots: Sequence[Shot],
    params: Mapping[str, Any] | None = None,
    *,
    waveforms: bool = True,
    max_time: float | None = None,
    progress: ProgressCallback | None = None,
) -> RenderedShots:
    """Render shots of a scene with the parameters ``aim_x`` and ``aim_y``, and map sea and footprints.

    `results` may hold the first shots alone. Raises `UserError` if the scene is invalid or has no waves.
    """
    if waveforms:
        variants.leave_the_gpu("shots are rendered")
    session = open_scene(scene, params)
    loaded = session.scene
    sea = SeaMap.of_scene(loaded)
    results: list[xr.Dataset] = []
    if waveforms:
        places = [(shot.x, shot.y) for shot in shots]
        series = render_shots(scene, params, positions=places, passes=_PASSES, max_time=max_time, progress=progress)
        results = [series.isel(shot=number) for number in range(series.sizes["shot"])]
    azimuth, along, across = footprint(transmitter_of(loaded))
    lines, pixel_map = _pixel_map(session.sensor.receiver)
    count = session.sensor.receiver.pixels.count
    return RenderedShots(session.name, tuple(shots), results, sea, azimuth, (along, across), lines, pixel_map, count)


def _pixel_map(receiver: Receiver) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Return `pixel_lines` and `pixel_map` of `RenderedShots`."""
    import mitsuba as mi

    pose: Pose = receiver.pose
    centre = pose.ground_point()
    reach = 0.6 * receiver.pixels.field_of_view * pose.ground_range / -float(pose.axis[2])
    lines = np.linspace(-reach, reach, 301)
    x, y = np.meshgrid(lines, lines)
    if receiver.pixels.count > _MOST_MAPPED_PIXELS:
        return lines, np.full(x.shape, -1)
    points = np.stack([x + centre[0], y + centre[1], np.zeros_like(x)], axis=-1).reshape(-1, 3)
    angle_x, angle_y = pose.angles_of(points - pose.origin).astype(np.float32).T
    index, held = receiver.pixels.pixel_at(mi.Float(angle_x), mi.Float(angle_y), mi.Float(0.5))
    return lines, np.where(np.array(held) > 0, np.array(index).astype(int), -1).reshape(x.shape)
