"""What is known about a flight before its first render: pulse groups, their records, coverage and places."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from mitransient_lidar.campaigns.design import Column
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import BoolArray, FloatArray, IntArray
from mitransient_lidar.flights.plan import SAME_PLACE_M, FlightPlan
from mitransient_lidar.flights.poses.mounting import PulsePoses, poses_of
from mitransient_lidar.loading.scene_source import SceneSource
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.rendering.shots.series import FARTHEST

if TYPE_CHECKING:
    import mitsuba as mi

    from mitransient_lidar.rendering.shots.batches import ShotPoses
    from mitransient_lidar.transport.scene import LidarScene

_LOG = logging.getLogger(__name__)

#: Largest range of angles from nadir [deg], and ratio of heights and of ranges, of the pulses that share a lidar.
_ANGLES, _HEIGHTS = 2.0, 1.1

#: Places of a group of pulses that decide how long their record is.
_PLACES = 6

#: Largest distance of a point in the systems of map and flight [m]: more than realisations of a datum differ.
_SAME_SYSTEM_M = 0.1

#: Margin of a record on both sides [ns], for waves and for poses that differ from that of the group.
_MARGIN_NS = 15.0


def input_columns(poses: PulsePoses) -> dict[str, Column]:
    """Return the pulses' inputs but the record start, in groups with similar angles from nadir and heights."""
    if np.any(poses.axis[:, 2] >= -0.05):
        row = int(np.argmax(poses.axis[:, 2]))
        angle = np.degrees(np.arccos(-poses.axis[row, 2]))
        raise UserError(
            f"pulse {row} at {poses.time_s[row]:.10g} s looks {angle:.4g} degrees from nadir: at most 87 may be"
        )
    if np.any(poses.origin[:, 2] <= 1):
        row = int(np.argmin(poses.origin[:, 2]))
        raise UserError(
            f"pulse {row} at {poses.time_s[row]:.10g} s is sent from a height of {poses.origin[row, 2]:g} m: the "
            "scanner must be more than 1 m above the mean sea level"
        )
    places = poses.ground_point()[:, :2]
    if (farthest := float(np.abs(places).max())) > FARTHEST:
        raise UserError(
            f"the flight reaches {farthest:g} m from the origin of the scene: at most {FARTHEST:g} m may be; give "
            "the platform an origin near it"
        )
    angle, height = np.degrees(np.arccos(-poses.axis[:, 2])), np.log(poses.origin[:, 2])
    # Near the horizon, ranges change more than angles.
    ratio, range_per_height = float(np.log(_HEIGHTS)), -np.log(-poses.axis[:, 2])
    bands = [_bands(*pair) for pair in ((angle, _ANGLES), (height, ratio), (range_per_height, ratio))]
    _, group = np.unique(np.stack(bands), axis=1, return_inverse=True)
    group = group.reshape(-1)
    order = np.lexsort((np.arange(group.size), group))
    columns: dict[str, Column] = {
        "pulse": np.arange(group.size),
        "time_s": poses.time_s,
        **{
            f"{name}_{axis}": getattr(poses, name)[:, number]
            for name in ("origin", "axis", "far", "left")
            for number, axis in enumerate("xyz")
        },
        "scan_angle_deg": poses.scan_angle_deg,
        "line": poses.line.astype(np.int64),
        "group": group.astype(np.int64),
    }
    # A level lidar in the middle of each group.
    middle = np.empty((group.size, 2))
    place = np.empty((group.size, 2))
    for one in np.unique(group):
        rows = np.flatnonzero(group == one)
        middle[rows] = [0.5 * (np.min(each[rows]) + np.max(each[rows])) for each in (angle, poses.origin[:, 2])]
        place[rows] = places[rows[0]]
    columns |= {"group_angle_deg": middle[:, 0], "group_height": middle[:, 1]}
    columns |= {"group_x": place[:, 0], "group_y": place[:, 1]}
    return {name: column[order] for name, column in columns.items()}


def pilot_rows(inputs: Mapping[str, Column], most: int) -> IntArray:
    """Return pilot pulses' rows, spread over the groups and angles from nadir in a flight.

    So those of flights with the same scanner and height look alike, however many pulses they have.
    """
    order = np.lexsort((np.round(inputs["axis_z"], 6), inputs["group"]))
    count = min(order.size, most)
    chosen: IntArray = order[((np.arange(count) + 0.5) * order.size / count).astype(int)]
    return chosen


def axis_of(plan: FlightPlan, source: SceneSource, inputs: Mapping[str, Column]) -> tuple[TimeAxis, int]:
    """Return time bins that contain the light for one group's pulses, relative to the group's lidar.

    The number is that of pulses which meet the bottom beyond its height map.

    Raises UserError if the bottom does not cover the places of the pulses or lies elsewhere than the flight says, or
    its light arrives after the record.
    """
    from mitransient_lidar.transport.plugin_types import SeabedShape
    from mitransient_lidar.transport.probe import axis_on_bottom
    from mitransient_lidar.transport.scene_parts import find_lidar_scene

    angle, height, *aim = lidar_of(inputs)
    params = {**plan.parameters, "off_nadir_deg": angle, "altitude": height, "aim_x": aim[0], "aim_y": aim[1]}
    session = open_scene(source, params)
    check_maps(plan, session.scene)
    lidar = find_lidar_scene(session.scene, session.sensor)
    if lidar.receiver.pixels.grid is not None:
        raise UserError(f"scene {plan.scene} has an imager: a flight needs a receiver whose pixels are a list")
    poses = shot_poses(lidar, inputs)
    given = poses_of(inputs.__getitem__)
    x, y, bottom = axis_on_bottom(lidar, given.origin - lidar.frame_origin, given.axis).T
    if not lidar.bottoms:
        raise UserError(f"scene {plan.scene} has no bottom below the flight")
    if missed := np.count_nonzero(np.isnan(bottom)):
        row = int(np.argmax(np.isnan(bottom)))
        raise UserError(
            f"the bottom does not cover the flight: {missed} of {bottom.size} pulses miss it, the first one, pulse "
            f"{inputs['pulse'][row]}, at x = {poses.places[row, 0]:.1f} m, y = {poses.places[row, 1]:.1f} m"
        )
    beyond = sum(
        int(np.count_nonzero(bed.is_beyond_map(x, y))) for bed in lidar.bottoms if isinstance(bed, SeabedShape)
    )
    # The places of the extremes of depth, and others.
    depths = np.argsort(bottom)
    chosen = np.unique(np.concatenate([depths[[0, -1]], depths[:: max(depths.size // _PLACES, 1)]]))
    shifts = [(float(dx), float(dy)) for dx, dy in poses.places[chosen] - poses.places[0]]
    fixed: TimeAxis | None = session.sensor.film().axis
    if fixed is None:
        own = find_lidar_scene(session.scene, session.sensor, shifts=shifts).axis
        first, last = own.start_ns - _MARGIN_NS, own.end_ns + _MARGIN_NS
        return TimeAxis.covering(first, last, own.bin_width_ns), beyond
    way, _ = lidar.level_sea.lengths(-float(bottom.min()), np.sin(np.radians(angle)))
    arrival = 1e9 / C0 * (lidar.reference_length + 2 * float(way))
    if arrival > fixed.end_ns:
        raise UserError(
            f"no bottom within the record: that of pulse {inputs['pulse'][depths[0]]}, {-bottom.min():.1f} m deep, "
            f"arrives at {arrival:.0f} ns, but the record of the scene ends at {fixed.end_ns:.0f} ns"
        )
    return fixed, beyond


def check_maps(plan: FlightPlan, scene: mi.Scene) -> None:
    """Raise `UserError` if a height map has its own coordinates elsewhere than a flight has those of its points.

    Their systems may have other names, if a point has the same coordinates in both.
    """
    from mitransient_lidar.physics.sea.height_maps import HeightMap
    from mitransient_lidar.transport.plugin_types import SeabedShape, SeaShape

    if (wanted := plan.stated_origin) is None:
        return
    for shape in scene.shapes():
        waves = shape.sea.waves if isinstance(shape, SeaShape) else None
        is_map = isinstance(shape, SeabedShape)
        terrain = shape.height_map if is_map else waves if isinstance(waves, HeightMap) else None
        if terrain is None or (found := terrain.origin) is None:
            continue
        system, other = terrain.system, plan.system
        if system is not None and other is not None:
            distance = system.distance_from(other, *found)
            if not distance <= _SAME_SYSTEM_M:
                raise UserError(
                    f"the map of shape {shape.id()} has coordinates in {system.name}, which are {distance:.3g} m beside"
                    f" those of the flight, in {other.name}: both must be in one coordinate system"
                )
        if max(abs(one - own) for one, own in zip(found, wanted, strict=True)) <= SAME_PLACE_M:
            continue
        x, y = wanted
        cure = f"give the seabed origin_x = {x:.10g} and origin_y = {y:.10g}, or " if is_map else "give "
        raise UserError(
            f"the map of shape {shape.id()} has its point ({found[0]:.10g}, {found[1]:.10g}) at x = y = 0, where the "
            f"flight has its origin ({x:.10g}, {y:.10g}): {cure}the flight the origin of the map"
        )


def beyond_angles(angle_deg: FloatArray, table: xr.Dataset) -> BoolArray:
    """Return which angles from nadir [deg] lie outside a correction table by more than half a group."""
    low, high = (float(table["off_nadir_deg"][end]) for end in (0, -1))
    return np.asarray((angle_deg < low - _ANGLES / 2) | (angle_deg > high + _ANGLES / 2))


def warn_of_angles(angle_deg: FloatArray, table: xr.Dataset) -> None:
    """Warn about pulses outside a correction table's angles from nadir."""
    low, high = (float(table["off_nadir_deg"][end]) for end in (0, -1))
    if outside := np.count_nonzero(beyond_angles(angle_deg, table)):
        _LOG.warning(
            f"{outside} of {angle_deg.size} pulses have corrections beyond the angles of their table, {low:g} to "
            f"{high:g} degrees from nadir: set corrections to none, or to a table of depth-bias with these angles"
        )


@contextlib.contextmanager
def telling_errors_alone() -> Iterator[None]:
    """Keep the package from repeating messages about a scene."""
    logger = logging.getLogger("mitransient_lidar")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def warn_of_maps(beyond: int, pulses: int) -> None:
    """Warn about pulses beyond a bottom's height map."""
    if beyond:
        _LOG.warning(
            "%d of %d pulses meet the bottom beyond its height map, whose edge continues there", beyond, pulses
        )


def tell_forecast(saturated: int, sampled: int, is_automatic: bool, pulses: int, seconds: float) -> None:
    """Log how many pilot pulses saturate, and a flight's processor time from one pilot's [s]."""
    share = 100 * saturated / sampled
    text = f"{saturated} of {sampled} pilot pulses saturate the receiver, {share:.0f} % of the flight"
    if saturated and not is_automatic:
        _LOG.warning("%s; saturated echoes are withheld, and gain = 'auto' in [receiver] avoids most of it", text)
    else:
        _LOG.info("%s", text)
    _LOG.info("%d pulses take about %.0f s of processor time, estimated from the pilots", pulses, pulses * seconds)


def lidar_of(inputs: Mapping[str, Column]) -> tuple[float, float, float, float]:
    """Return angle from nadir [deg], height, and lidar place for one group's pulses [m]."""
    angle, height, x, y = (float(inputs[f"group_{name}"][0]) for name in ("angle_deg", "height", "x", "y"))
    return angle, height, x, y


def shot_poses(lidar: LidarScene, inputs: Mapping[str, Column]) -> ShotPoses:
    """Return one group's pulse poses."""
    from mitransient_lidar.rendering.shots.batches import ShotPoses

    return ShotPoses.of_receiver(lidar, poses_of(inputs.__getitem__))


def _bands(values: FloatArray, step: float) -> IntArray:
    """Return band numbers for values; bands are equally wide, at most a step."""
    low, high = float(values.min()), float(values.max())
    count = max(int(np.ceil((high - low) / step)), 1)
    return np.minimum(((values - low) / max((high - low) / count, 1e-12)).astype(np.int64), count - 1)
