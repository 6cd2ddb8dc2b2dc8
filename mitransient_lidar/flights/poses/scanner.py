"""Scanners: directions of pulses and of the pixels about them, in the scanner frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, Plan, of_kind, positive_option
from mitransient_lidar.core.validation import FloatArray, finite_array

_EARLY = 1e-6  #: Part of the interval between two points of a raster by which a pulse may be early.
_MOST_POINTS = 10**9  #: Most points of a raster.
_TWO = "two angles in degrees"  #: Form of angles from one end to the other.

#: Motion of a mirror within a cycle, between -1 and 1, and parameters of several scanners.
Wave = Literal["triangular", "sinusoidal", "sawtooth"]
NadirAngle = Annotated[float, Option("Angle of the pulses from the nadir of the scanner", 0, 90, "deg")]
Phase = Annotated[float, Option("Phase of the cycle at time 0", unit="deg")]


class ScanDirections(NamedTuple):
    """Lines of sight in the scanner frame, x to its right, y forward and z up; shape (n, 3) each."""

    axis: FloatArray  #: Unit directions of the pulses.
    far: FloatArray  #: Directions of +angle_x of the pixels.
    left: FloatArray  #: Directions of +angle_y of the pixels: far x axis.


@dataclass(frozen=True, kw_only=True)
class Scanner(Plan, ABC):
    """What all scanners have.

    The frame of the scanner has x to its right, y forward and z up; its nadir is -z. Azimuths are counted from forward,
    clockwise from above. Cycles begin at time 0 of the trajectory.

    Pixels that turn with the ``scan`` have far (+angle_x) away from the scanner nadir. At the nadir itself it has the
    limit along the scan, or points to the right. Those of the ``platform`` have far forward at the nadir, and it goes
    with the beam by the shortest rotation from there.
    """

    pixels: Annotated[Literal["scan", "platform"], Option("What the pixels turn with")] = "scan"

    @staticmethod
    def of_table(given: object) -> Scanner:
        """Return the scanner of a plan's ``[scanner]`` table: ``kind`` (`SCANNER_KINDS`) and its parameters.

        Raises `UserError` for a key or a value that is not allowed or is missing.
        """
        return of_kind("scanner", given, SCANNER_KINDS)

    def directions(self, times: npt.ArrayLike) -> ScanDirections:
        """Return the directions of pulses at times [s], shape (n,); raise `UserError` for times that are not finite.

        The times are those of a flight line, from its first pulse on.
        """
        nadir_angle, azimuth = self._angles(np.atleast_1d(finite_array("times", times)))
        sin, cos, sin_azimuth, cos_azimuth = (f(angle) for angle in (nadir_angle, azimuth) for f in (np.sin, np.cos))
        axis = np.column_stack([sin * sin_azimuth, sin * cos_azimuth, -cos])
        away = np.column_stack([cos * sin_azimuth, cos * cos_azimuth, sin])
        beside = np.cross(away, axis)
        if self.pixels == "scan":
            return ScanDirections(axis, away, beside)
        turn, across = cos_azimuth[:, None], sin_azimuth[:, None]
        return ScanDirections(axis, turn * away + across * beside, turn * beside - across * away)

    @abstractmethod
    def _angles(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the angles from the nadir and the azimuths [rad] at times [s], each of shape (n,)."""


@dataclass(frozen=True, kw_only=True)
class Palmer(Scanner):
    """Full circles at a constant angle from the nadir, as of a rotating mirror or prism."""

    nadir_angle_deg: NadirAngle
    rate_hz: Annotated[
        float, Option("Circles per second, clockwise from above; negative for the other sense", unit="Hz")
    ]
    phase_deg: Annotated[float, Option("Azimuth at time 0", unit="deg")] = 0.0

    def _angles(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        azimuth = 2 * np.pi * _cycles(times, self.rate_hz, self.phase_deg)
        return np.full(times.shape, np.radians(self.nadir_angle_deg)), azimuth


@dataclass(frozen=True, kw_only=True)
class SemiArc(Scanner):
    """Arcs at a constant angle from the nadir, in front of the platform or to one side.

    At phase 0 the beam is in the middle of the arc and moves clockwise. A ``sawtooth`` begins at the counterclockwise
    end.
    """

    nadir_angle_deg: NadirAngle
    rate_hz: Annotated[float, positive_option("Cycles per second: there and back, or one way for sawtooth", "Hz")]
    arc_deg: Annotated[float, Option("Range of azimuths of the arc", 0, 360, "deg", above=True)] = 180.0
    centre_deg: Annotated[
        float, Option("Azimuth of the middle of the arc: 0 forward, 90 to the right, 180 backward", unit="deg")
    ] = 0.0
    wave: Annotated[Wave, Option("Azimuth over a cycle: triangular has constant speed, sawtooth jumps back")] = (
        "triangular"
    )
    phase_deg: Phase = 0.0

    def _angles(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        share = _wave(self.wave, _cycles(times, self.rate_hz, self.phase_deg))
        azimuth = np.radians(self.centre_deg + 0.5 * self.arc_deg * share)
        return np.full(times.shape, np.radians(self.nadir_angle_deg)), azimuth


@dataclass(frozen=True, kw_only=True)
class Oscillating(Scanner):
    """Lines across the flight, as by an oscillating mirror; a ``sawtooth`` as by a rotating polygon.

    At phase 0 the beam is at the nadir and moves to the right; a ``sawtooth`` begins at the left end.
    """

    half_angle_deg: Annotated[
        float, Option("Largest angle of the pulses from the nadir, to each side", 0, 90, "deg", above=True)
    ]
    rate_hz: Annotated[float, positive_option("Cycles per second: two lines each, or one for sawtooth", "Hz")]
    wave: Annotated[Wave, Option("Angle over a cycle: triangular has constant speed, sawtooth jumps back")] = (
        "sinusoidal"
    )
    phase_deg: Phase = 0.0

    def _angles(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        share = _wave(self.wave, _cycles(times, self.rate_hz, self.phase_deg))
        return np.abs(share) * np.radians(self.half_angle_deg), np.where(share < 0, -0.5 * np.pi, 0.5 * np.pi)


@dataclass(frozen=True, kw_only=True)
class Raster(Scanner):
    """Parallel lines of points, as from a mast or two-axis gimbal.

    The outer axis points to the right, and turns the beam from nadir forward by the angle along. The inner axis turns
    it to the right by the angle across. All points of a line follow each other at equal times, then the next line. A
    pulse rate of rate_hz * lines * points gives one pulse to each point, also at rounded GPS times. A flight line
    begins with a whole point. One line, or one point of each, is in the middle.
    """

    along_deg: Annotated[
        tuple[float, float],
        Option("Angle along of first and last line; (60, 80) is in front of a mast", -180, 180, "deg", form=_TWO),
    ]
    across_deg: Annotated[
        tuple[float, float], Option("Angle across of first and last point of each line", -90, 90, "deg", form=_TWO)
    ]
    lines: Annotated[int, Option("Number of lines", 1, _MOST_POINTS)]
    points: Annotated[int, Option("Number of points of each line", 1, _MOST_POINTS)]
    rate_hz: Annotated[float, positive_option("Rasters per second", "Hz")]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lines * self.points > _MOST_POINTS:
            raise UserError(f"lines x points = {self.lines * self.points} must be at most {_MOST_POINTS}")

    def _angles(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        count = self.lines * self.points
        rate = self.rate_hz * count
        # Differences from the first time are whole intervals but for the rounding of times.
        early = max(_EARLY, 2 * float(np.spacing(np.abs(times).max(initial=0.0))) * rate)
        first = np.floor(times[:1] * rate + early)
        index = (first + np.floor((times - times[:1]) * rate + early)) % count
        line, point = np.divmod(index, self.points)
        along = np.radians(_between(self.along_deg, line, self.lines))
        across = np.radians(_between(self.across_deg, point, self.points))
        right, ahead, down = np.sin(across), np.cos(across) * np.sin(along), np.cos(across) * np.cos(along)
        away = np.hypot(right, ahead)
        # At the nadir the azimuth is to the right.
        return np.arctan2(away, down), np.where(away > 0, np.arctan2(right, ahead), 0.5 * np.pi)


@dataclass(frozen=True, kw_only=True)
class Fixed(Scanner):
    """One direction."""

    nadir_angle_deg: Annotated[float, Option("Angle of the pulses from the nadir of the scanner", 0, 180, "deg")] = 0.0
    azimuth_deg: Annotated[float, Option("Azimuth of the pulses, clockwise from forward", unit="deg")] = 0.0

    def _angles(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        nadir_angle, azimuth = np.radians(self.nadir_angle_deg), np.radians(self.azimuth_deg)
        return np.full(times.shape, nadir_angle), np.full(times.shape, azimuth)


#: Kinds of scanners of a plan.
SCANNER_KINDS: dict[str, type[Scanner]] = {
    "palmer": Palmer,
    "semi_arc": SemiArc,
    "oscillating": Oscillating,
    "raster": Raster,
    "fixed": Fixed,
}


def _cycles(times: FloatArray, rate_hz: float, phase_deg: float) -> FloatArray:
    """Return the part of a cycle that has passed, 0 to 1, at times [s]."""
    return np.asarray((times * rate_hz + phase_deg / 360.0) % 1.0)


def _wave(wave: str, cycles: FloatArray) -> FloatArray:
    """Return a motion between -1 and 1 at parts of a cycle, 0 to 1."""
    if wave == "sinusoidal":
        return np.asarray(np.sin(2 * np.pi * cycles))
    if wave == "triangular":
        return 1 - 4 * np.abs((cycles + 0.25) % 1.0 - 0.5)
    return 2 * cycles - 1


def _between(ends: tuple[float, float], index: FloatArray, count: int) -> FloatArray:
    """Return values at indices of `count` equal steps from one end to the other."""
    share = index / (count - 1) if count > 1 else np.full(index.shape, 0.5)
    return ends[0] + (ends[1] - ends[0]) * share
