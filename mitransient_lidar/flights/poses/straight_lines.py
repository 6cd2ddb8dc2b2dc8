"""Straight and parallel flight lines, and fixed platforms, with random attitudes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from scipy.signal import lfilter

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.toml_files import check_keys, required, table
from mitransient_lidar.core.validation import FloatArray, finite, finite_array, in_range, integer, positive, shown
from mitransient_lidar.flights.poses.records import TrajectoryRecords

#: Most flight lines, and most records of all of them.
_MOST_LINES, _MOST_RECORDS = 10_000, 10_000_000

#: Records of a correlation time: interpolated between two of them, the variance is at most 2.5 % less.
_RECORDS_PER_CORRELATION = 20

_ATTITUDE_KEYS = ("roll_deg", "pitch_deg", "noise")
_LINE_KEYS = (
    *("start", "heading_deg", "speed", "height", "length", "duration_s", "count", "spacing", "alternate", "turn_s"),
    *(*_ATTITUDE_KEYS, "crab_deg"),
)
_MAST_KEYS = ("position", "heading_deg", "duration_s", *_ATTITUDE_KEYS)


@dataclass(frozen=True)
class AttitudeNoise:
    """Random motion of a platform about its mean attitude.

    Roll, pitch and yaw are independent stationary Ornstein-Uhlenbeck processes: normal, with the autocorrelation
    exp(-|lag| / correlation_s). Each flight line has a new realisation.

    Parameters
    ----------
    roll_deg, pitch_deg, yaw_deg
        Standard deviations [deg], 0 to 45.
    correlation_s
        Correlation time [s], positive.
    seed
        Seed of the random numbers, 0 to 2^32 - 1.

    Values out of range raise UserError.
    """

    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    correlation_s: float = 5.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("roll_deg", "pitch_deg", "yaw_deg"):
            object.__setattr__(self, name, in_range(f"noise.{name}", getattr(self, name), 0.0, 45.0))
        object.__setattr__(self, "correlation_s", positive("noise.correlation_s", self.correlation_s))
        object.__setattr__(self, "seed", integer("noise.seed", self.seed, 0, 2**32 - 1))

    @classmethod
    def of(cls, given: object) -> AttitudeNoise:
        """Check a table of a file; raise `UserError` for a key or a value that is not allowed."""
        values = table("noise", given)
        check_keys("noise", values, [one.name for one in fields(cls)])
        return cls(**values)

    def sample(self, count: int, step_s: float, rng: np.random.Generator) -> FloatArray:
        """Return roll, pitch and yaw [deg] at `count` times that are `step_s` apart, shape (3, count)."""
        kept = np.exp(-step_s / self.correlation_s)
        normal = rng.standard_normal((3, count))
        normal[:, 1:] *= np.sqrt(1 - kept**2)
        deviations = np.array([[self.roll_deg], [self.pitch_deg], [self.yaw_deg]])
        return np.asarray(deviations * lfilter([1.0], [1.0, -kept], normal, axis=1))


def straight_lines(given: Mapping[str, Any]) -> tuple[TrajectoryRecords, FloatArray]:
    """Return the records of straight flight lines at constant height and speed, and the times of the lines.

    Parameters
    ----------
    given
        Table with ``start``, x and y [m] where the first line begins; ``heading_deg``, its course [deg] clockwise from
        north; ``speed`` [m/s], positive; ``height`` [m] above the mean sea level; ``length`` [m] or ``duration_s`` [s]
        of each line; ``count`` of lines (1); ``spacing`` [m] from each line to the next one, to the right of the first
        course (needed if there are several); ``alternate``, whether every second line is flown back (true);
        ``turn_s`` [s] between lines (60); ``roll_deg``, ``pitch_deg`` and ``crab_deg``, the mean roll and pitch, and
        the mean of yaw less the course [deg] (0); and ``noise``, a table as `AttitudeNoise` has it.

    Returns
    -------
    Records; first and last time [s] of each line, shape (lines, 2). The first line begins at time 0.

    Raises
    ------
    UserError
        For a key or a value that is not allowed, or is missing.
    """
    where = "a platform of kind 'lines'"
    check_keys(where, given, ("kind", *_LINE_KEYS))
    start = finite_array("start", required(where, given, "start"))
    if start.shape != (2,):
        raise UserError(f"start = {shown(given['start'])} must be x and y in metres")
    heading = finite("heading_deg", given.get("heading_deg", 0.0))
    speed, height = (positive(name, required(where, given, name)) for name in ("speed", "height"))
    if ("length" in given) == ("duration_s" in given):
        raise UserError(f"{where} must have either length or duration_s")
    length = positive("length", given["length"]) if "length" in given else None
    duration = length / speed if length is not None else positive("duration_s", given["duration_s"])
    count = integer("count", given.get("count", 1), 1, _MOST_LINES)
    spacing = finite("spacing", required(where, given, "spacing") if count > 1 else given.get("spacing", 0.0))
    alternate = given.get("alternate", True)
    if not isinstance(alternate, bool):
        raise UserError(f"alternate = {shown(alternate)} must be true or false")
    turn = positive("turn_s", given.get("turn_s", 60.0))

    course = np.radians(heading)
    ahead, right = np.array([np.sin(course), np.cos(course)]), np.array([np.cos(course), -np.sin(course)])
    begin = np.arange(count, dtype=np.float64) * (duration + turn)
    back = (np.arange(count) % 2 == 1) & alternate
    first: FloatArray = start + spacing * np.arange(count)[:, None] * right + speed * duration * back[:, None] * ahead
    velocity: FloatArray = np.where(back, -speed, speed)[:, None] * ahead
    yaw: FloatArray = heading + 180.0 * back + finite("crab_deg", given.get("crab_deg", 0.0))
    level = np.column_stack([velocity, np.zeros(count)])
    records = _records(given, begin, duration, np.column_stack([first, np.full(count, height)]), level, yaw)
    return records, np.column_stack([begin, begin + duration])


def fixed_platform(given: Mapping[str, Any]) -> TrajectoryRecords:
    """Return the records of a platform that stays where it is, such as a mast.

    Parameters
    ----------
    given
        Table with ``position``, x, y, z [m]; ``heading_deg`` [deg] clockwise from north (0); ``duration_s`` [s];
        ``roll_deg``, ``pitch_deg`` and ``noise`` as `straight_lines` has them.

    Raises
    ------
    UserError
        For a key or a value that is not allowed, or is missing.
    """
    where = "a platform of kind 'mast'"
    check_keys(where, given, ("kind", *_MAST_KEYS))
    position = finite_array("position", required(where, given, "position"))
    if position.shape != (3,):
        raise UserError(f"position = {shown(given['position'])} must be x, y and z in metres")
    duration = positive("duration_s", required(where, given, "duration_s"))
    heading = np.array([finite("heading_deg", given.get("heading_deg", 0.0))])
    return _records(given, np.zeros(1), duration, position[None], np.zeros((1, 3)), heading)


def _records(
    given: Mapping[str, Any],
    begin: FloatArray,
    duration: float,
    first: FloatArray,
    velocity: FloatArray,
    yaw: FloatArray,
) -> TrajectoryRecords:
    """Return the records of lines that begin at times [s] and positions [m], with velocities [m/s] and yaws [deg]."""
    noise = AttitudeNoise.of(given.get("noise", {}))
    still = not (noise.roll_deg or noise.pitch_deg or noise.yaw_deg)
    steps = 1 if still else int(np.ceil(duration / noise.correlation_s * _RECORDS_PER_CORRELATION))
    if steps * len(begin) > _MOST_RECORDS:
        least = duration * len(begin) * _RECORDS_PER_CORRELATION / _MOST_RECORDS
        raise UserError(f"noise.correlation_s = {noise.correlation_s:g} must be at least {least:g} s for so long lines")
    since = np.linspace(0.0, duration, steps + 1)
    rng = np.random.default_rng(noise.seed)
    noises = np.stack([noise.sample(since.size, duration / steps, rng) for _ in begin], axis=1)
    roll, pitch = (finite(name, given.get(name, 0.0)) for name in ("roll_deg", "pitch_deg"))
    position = first[:, None] + velocity[:, None] * since[:, None]
    return TrajectoryRecords(
        (begin[:, None] + since).ravel(),
        position.reshape(-1, 3),
        (roll + noises[0]).ravel(),
        (pitch + noises[1]).ravel(),
        (yaw[:, None] + noises[2]).ravel(),
    )
