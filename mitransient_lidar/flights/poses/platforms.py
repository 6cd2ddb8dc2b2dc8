"""Flight platforms: straight and parallel lines and masts, with random attitudes, and trajectories from files."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.signal import lfilter

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, Plan, Seed, of_kind, positive_option
from mitransient_lidar.core.validation import FloatArray, finite_array
from mitransient_lidar.flights.poses.records import PlatformPoses, RotationSpec, TimeSystem, time_system
from mitransient_lidar.flights.poses.trajectory import Interpolation, Trajectory, read_sbet_records, read_text_records

_MOST_LINES, _MOST_RECORDS = 10_000, 10_000_000  #: Most flight lines, and most records of all of them.

#: Records of a correlation time: interpolated between two of them, the variance is at most 2.5 % less.
_RECORDS_PER_CORRELATION = 20

_LARGEST_EPSG = 10**6  #: Largest code of a coordinate system.
XYZ = "x, y and z in metres"  #: Form of a position.

_Deviation = Option("Standard deviation", 0, 45, "deg")
_Heading = Annotated[float, Option("Course, or direction of the forward axis, clockwise from north", unit="deg")]
_Duration = positive_option("Duration, of each line", "s")


@dataclass(frozen=True)
class AttitudeNoise(Plan):
    """Random motion of a platform about its mean attitude.

    Roll, pitch and yaw are independent stationary Ornstein-Uhlenbeck processes: normal, with the autocorrelation
    exp(-|lag| / correlation_s). Each flight line has a new realisation.
    """

    roll_deg: Annotated[float, _Deviation] = 0.0
    pitch_deg: Annotated[float, _Deviation] = 0.0
    yaw_deg: Annotated[float, _Deviation] = 0.0
    correlation_s: Annotated[float, positive_option("Correlation time", "s")] = 5.0
    seed: Seed = 0

    def sample(self, count: int, step_s: float, rng: np.random.Generator) -> FloatArray:
        """Return roll, pitch and yaw [deg] at `count` times that are `step_s` apart, shape (3, count)."""
        kept = np.exp(-step_s / self.correlation_s)
        normal = rng.standard_normal((3, count))
        normal[:, 1:] *= np.sqrt(1 - kept**2)
        deviations = np.array([[self.roll_deg], [self.pitch_deg], [self.yaw_deg]])
        return np.asarray(deviations * lfilter([1.0], [1.0, -kept], normal, axis=1))


@dataclass(frozen=True, kw_only=True)
class Platform(Plan, ABC):
    """What carries the scanner."""

    def time_system(self, time_s: FloatArray) -> TimeSystem:
        """Return the system of the times of pulses [s]; raise `UserError` if they may be Unix times."""
        return time_system(time_s)

    @abstractmethod
    def trajectory(self, folder: Path = Path()) -> Trajectory:
        """Return position and attitude over time; relative paths of files count from a folder."""


@dataclass(frozen=True, kw_only=True)
class _Moving(Platform):
    """Platform at a constant velocity, or none, with a random attitude."""

    roll_deg: Annotated[float, Option("Mean roll", unit="deg")] = 0.0
    pitch_deg: Annotated[float, Option("Mean pitch", unit="deg")] = 0.0
    noise: Annotated[AttitudeNoise, Option("Random motion about the mean attitude")] = AttitudeNoise()

    def _records(
        self, begin: FloatArray, duration: float, first: FloatArray, velocity: FloatArray, yaw: FloatArray
    ) -> PlatformPoses:
        """Return the records of lines that begin at times [s] and positions [m], with velocities [m/s], yaws [deg]."""
        noise = self.noise
        still = not (noise.roll_deg or noise.pitch_deg or noise.yaw_deg)
        steps = 1 if still else int(np.ceil(duration / noise.correlation_s * _RECORDS_PER_CORRELATION))
        if steps * len(begin) > _MOST_RECORDS:
            least = duration * len(begin) * _RECORDS_PER_CORRELATION / _MOST_RECORDS
            raise UserError(
                f"noise.correlation_s = {noise.correlation_s:g} must be at least {least:g} s for so long lines"
            )
        since = np.linspace(0.0, duration, steps + 1)
        rng = np.random.default_rng(noise.seed)
        noises = np.stack([noise.sample(since.size, duration / steps, rng) for _ in begin], axis=1)
        position = first[:, None] + velocity[:, None] * since[:, None]
        return PlatformPoses(
            (begin[:, None] + since).ravel(),
            position.reshape(-1, 3),
            (self.roll_deg + noises[0]).ravel(),
            (self.pitch_deg + noises[1]).ravel(),
            (yaw[:, None] + noises[2]).ravel(),
        )


@dataclass(frozen=True, kw_only=True)
class Lines(_Moving):
    """Straight flight lines at constant height and speed; the first one begins at time 0."""

    start: Annotated[
        tuple[float, float], Option("x and y where the first line begins", unit="m", form="x and y in metres")
    ]
    heading_deg: _Heading = 0.0
    speed: Annotated[float, positive_option("Speed", "m/s")]
    height: Annotated[float, positive_option("Height above the mean sea level", "m")]
    length: Annotated[float | None, positive_option("Length of each line, instead of duration_s", "m")] = None
    duration_s: Annotated[float | None, _Duration] = None
    count: Annotated[int, Option("Number of lines", 1, _MOST_LINES)] = 1
    spacing: Annotated[
        float | None,
        Option("From each line to the next one, to the right of the first course; several lines need it", unit="m"),
    ] = None
    alternate: Annotated[bool, Option("Whether every second line is flown back")] = True
    turn_s: Annotated[float, positive_option("Time between lines", "s")] = 60.0
    crab_deg: Annotated[float, Option("Mean of yaw less the course", unit="deg")] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.length is None) == (self.duration_s is None):
            raise UserError("a platform of kind 'lines' must have either length or duration_s")
        if self.count > 1 and self.spacing is None:
            raise UserError("a platform of kind 'lines' has no spacing: several lines must have it")

    def trajectory(self, folder: Path = Path()) -> Trajectory:
        """Return position and attitude over time."""
        duration = self.duration_s if self.length is None else self.length / self.speed
        assert duration is not None
        course = np.radians(self.heading_deg)
        ahead, right = np.array([np.sin(course), np.cos(course)]), np.array([np.cos(course), -np.sin(course)])
        begin = np.arange(self.count, dtype=np.float64) * (duration + self.turn_s)
        back = (np.arange(self.count) % 2 == 1) & self.alternate
        first: FloatArray = (
            np.array(self.start)
            + (self.spacing or 0.0) * np.arange(self.count)[:, None] * right
            + self.speed * duration * back[:, None] * ahead
        )
        velocity: FloatArray = np.where(back, -self.speed, self.speed)[:, None] * ahead
        yaw: FloatArray = self.heading_deg + 180.0 * back + self.crab_deg
        level = np.column_stack([velocity, np.zeros(self.count)])
        place = np.column_stack([first, np.full(self.count, self.height)])
        records = self._records(begin, duration, place, level, yaw)
        return Trajectory(**vars(records), lines=np.column_stack([begin, begin + duration]))


@dataclass(frozen=True, kw_only=True)
class Mast(_Moving):
    """Platform that stays where it is."""

    position: Annotated[tuple[float, float, float], Option("Position", unit="m", form=XYZ)]
    heading_deg: _Heading = 0.0
    duration_s: Annotated[float, _Duration]

    def trajectory(self, folder: Path = Path()) -> Trajectory:
        """Return position and attitude over time."""
        place, heading = np.array([self.position]), np.array([self.heading_deg])
        return Trajectory(**vars(self._records(np.zeros(1), self.duration_s, place, np.zeros((1, 3)), heading)))


@dataclass(frozen=True, kw_only=True)
class TrajectoryFile(Platform):
    """Platform whose trajectory is a file."""

    file: Annotated[str, Option("Path of the trajectory", form="the path of a trajectory")]
    origin: Annotated[
        tuple[float, float, float] | None,
        Option(
            "Position of the origin of the scene in the coordinates of the file, whose height is that of the mean sea "
            "level, by default 0, 0, 0",
            unit="m",
            form=XYZ,
        ),
    ] = None
    interpolation: Annotated[Interpolation, Option("Interpolation between records")] = "cubic"
    lines_s: Annotated[Any, Option("First and last time of each flight line, by default one line", unit="s")] = ()
    time: Annotated[TimeSystem | None, Option("System of the times, by default as of times.time_system")] = None

    def trajectory(self, folder: Path = Path()) -> Trajectory:
        """Return position and attitude over time; raise `UserError` for a file that cannot be read."""
        lines = finite_array("lines_s", self.lines_s)
        records, order = self._records(folder / self.file)
        place = records.position - np.array(self.origin or (0.0, 0.0, 0.0))
        return Trajectory(
            **vars(replace(records, position=place)), rotation_spec=order, interpolation=self.interpolation, lines=lines
        )

    def time_system(self, time_s: FloatArray) -> TimeSystem:
        """Return the system of the times of pulses [s]; raise `UserError` if they may be Unix times."""
        return self.time or time_system(time_s, self.file, is_sbet=isinstance(self, SbetFile))

    @abstractmethod
    def _records(self, path: Path) -> tuple[PlatformPoses, RotationSpec]:
        """Return a file's records, and their rotation order."""


@dataclass(frozen=True, kw_only=True)
class CsvFile(TrajectoryFile):
    """Platform whose trajectory is a text file."""

    rotation_spec: Annotated[RotationSpec, Option("Order of the rotations, by default that of HELIOS++")] = "ARINC 705"

    def _records(self, path: Path) -> tuple[PlatformPoses, RotationSpec]:
        return read_text_records(path), self.rotation_spec


@dataclass(frozen=True, kw_only=True)
class SbetFile(TrajectoryFile):
    """Platform whose trajectory is an SBET file."""

    epsg: Annotated[int, Option("EPSG code of the coordinates", 1, _LARGEST_EPSG)]

    def _records(self, path: Path) -> tuple[PlatformPoses, RotationSpec]:
        return read_sbet_records(path, self.epsg), "aerospace"


#: Kinds of platforms of a plan.
PLATFORM_KINDS: dict[str, type[Platform]] = {"lines": Lines, "mast": Mast, "csv": CsvFile, "sbet": SbetFile}


def platform_of(given: object) -> Platform:
    """Return the platform of a plan's ``[platform]`` table; raise `UserError` as `Plan.of`."""
    return of_kind("platform", given, PLATFORM_KINDS)
