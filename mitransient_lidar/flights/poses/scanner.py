"""Scanners: directions of pulses, and of the pixels about them, in the frame of the scanner."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.toml_files import check_keys, required
from mitransient_lidar.core.validation import FloatArray, finite, finite_array, in_range, integer, positive, shown

#: Motions of a mirror within a cycle, between -1 and 1.
WAVES = ("triangular", "sinusoidal", "sawtooth")

#: What the pixels turn with.
PIXELS = ("scan", "platform")

#: Part of the interval between two points of a raster by which a pulse may be early.
_EARLY = 1e-6

#: Most points of a raster.
_MOST_POINTS = 10**9


class ScanDirections(NamedTuple):
    """Lines of sight in the frame of the scanner, x to its right, y forward and z up; each of shape (n, 3)."""

    axis: FloatArray  #: Unit directions of the pulses.
    far: FloatArray  #: Directions of +angle_x of the pixels.
    left: FloatArray  #: Directions of +angle_y of the pixels: far x axis.


@dataclass(frozen=True, kw_only=True)
class Scanner(ABC):
    """What all scanners have.

    The frame of the scanner has x to its right, y forward and z up; its nadir is -z. Azimuths are counted from forward,
    clockwise from above. Cycles begin at time 0 of the trajectory.

    Parameters
    ----------
    pixels
        ``scan``: far (+angle_x) points away from the nadir of the scanner, so that pixels turn with the scan; at the
        nadir itself it has the limit along the scan, or points to the right. ``platform``: far points forward at the
        nadir, and goes with the beam by the shortest rotation from there.
    """

    pixels: str = "scan"

    def __post_init__(self) -> None:
        if self.pixels not in PIXELS:
            raise UserError(f"pixels = {shown(self.pixels)} of a scanner must be one of {', '.join(PIXELS)}")
        self._check()

    @staticmethod
    def of(given: Mapping[str, Any]) -> Scanner:
        """Return the scanner of the table ``[scanner]`` of a plan: ``kind`` (`SCANNER_KINDS`) and its parameters.

        Raises
        ------
        UserError
            For a key or a value that is not allowed or is missing.
        """
        kind = required("[scanner]", given, "kind")
        if not isinstance(kind, str) or kind not in SCANNER_KINDS:
            raise UserError(f"kind = {shown(kind)} of a scanner must be one of {', '.join(SCANNER_KINDS)}")
        where, parameters = f"a scanner of kind {kind!r}", fields(SCANNER_KINDS[kind])
        values = {name: value for name, value in given.items() if name != "kind"}
        check_keys(where, values, [one.name for one in parameters])
        for one in parameters:
            if one.default is MISSING:
                required(where, given, one.name)
        return SCANNER_KINDS[kind](**values)

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
    def _check(self) -> None:
        """Convert the parameters; raise `UserError` for one out of range."""

    @abstractmethod
    def _angles(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the angles from the nadir and the azimuths [rad] at times [s], each of shape (n,)."""

    def _set(self, name: str, value: object) -> None:
        """Set a parameter while the object is made."""
        object.__setattr__(self, name, value)


@dataclass(frozen=True, kw_only=True)
class Palmer(Scanner):
    """Full circles at a constant angle from the nadir, as of a rotating mirror or prism.

    Parameters
    ----------
    nadir_angle_deg
        Angle of the pulses from the nadir of the scanner [deg], 0 to 90.
    rate_hz
        Circles per second [Hz], clockwise from above; negative for the other sense.
    phase_deg
        Azimuth at time 0 [deg].
    """

    nadir_angle_deg: float
    rate_hz: float
    phase_deg: float = 0.0

    def _check(self) -> None:
        self._set("nadir_angle_deg", in_range("nadir_angle_deg", self.nadir_angle_deg, 0.0, 90.0))
        for name in ("rate_hz", "phase_deg"):
            self._set(name, finite(name, getattr(self, name)))

    def _angles(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        azimuth = 2 * np.pi * _cycles(times, self.rate_hz, self.phase_deg)
        return np.full(times.shape, np.radians(self.nadir_angle_deg)), azimuth


@dataclass(frozen=True, kw_only=True)
class SemiArc(Scanner):
    """Arcs at a constant angle from the nadir, in front of the platform or to one side.

    Parameters
    ----------
    nadir_angle_deg
        Angle of the pulses from the nadir of the scanner [deg], 0 to 90.
    rate_hz
        Cycles per second [Hz], positive: there and back, or one way for ``sawtooth``.
    arc_deg
        Range of azimuths of the arc [deg], above 0 to 360.
    centre_deg
        Azimuth of the middle of the arc [deg]: 0 forward, 90 to the right, 180 backward.
    wave
        Azimuth over a cycle: ``triangular`` (constant speed), ``sinusoidal``, or ``sawtooth``, which jumps back.
    phase_deg
        Phase of the cycle at time 0 [deg]. At phase 0 the beam is in the middle of the arc and moves clockwise; a
        ``sawtooth`` begins at the counterclockwise end.
    """

    nadir_angle_deg: float
    rate_hz: float
    arc_deg: float = 180.0
    centre_deg: float = 0.0
    wave: str = "triangular"
    phase_deg: float = 0.0

    def _check(self) -> None:
        self._set("nadir_angle_deg", in_range("nadir_angle_deg", self.nadir_angle_deg, 0.0, 90.0))
        self._set("rate_hz", positive("rate_hz", self.rate_hz))
        self._set("arc_deg", in_range("arc_deg", positive("arc_deg", self.arc_deg), 0.0, 360.0))
        for name in ("centre_deg", "phase_deg"):
            self._set(name, finite(name, getattr(self, name)))
        _check_wave(self.wave)

    def _angles(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        share = _wave(self.wave, _cycles(times, self.rate_hz, self.phase_deg))
        azimuth = np.radians(self.centre_deg + 0.5 * self.arc_deg * share)
        return np.full(times.shape, np.radians(self.nadir_angle_deg)), azimuth


@dataclass(frozen=True, kw_only=True)
class Oscillating(Scanner):
    """Lines across the flight, as of an oscillating mirror; a ``sawtooth`` is that of a rotating polygon.

    Parameters
    ----------
    half_angle_deg
        Largest angle of the pulses from the nadir, to each side [deg], above 0 to 90.
    rate_hz
        Cycles per second [Hz], positive: two lines each, or one for ``sawtooth``.
    wave
        Angle over a cycle: ``sinusoidal``, ``triangular`` (constant speed), or ``sawtooth``, which jumps back.
    phase_deg
        Phase of the cycle at time 0 [deg]. At phase 0 the beam is at the nadir and moves to the right; a ``sawtooth``
        begins at the left end.
    """

    half_angle_deg: float
    rate_hz: float
    wave: str = "sinusoidal"
    phase_deg: float = 0.0

    def _check(self) -> None:
        angle = positive("half_angle_deg", self.half_angle_deg)
        self._set("half_angle_deg", in_range("half_angle_deg", angle, 0.0, 90.0))
        self._set("rate_hz", positive("rate_hz", self.rate_hz))
        self._set("phase_deg", finite("phase_deg", self.phase_deg))
        _check_wave(self.wave)

    def _angles(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        share = _wave(self.wave, _cycles(times, self.rate_hz, self.phase_deg))
        return np.abs(share) * np.radians(self.half_angle_deg), np.where(share < 0, -0.5 * np.pi, 0.5 * np.pi)


@dataclass(frozen=True, kw_only=True)
class Raster(Scanner):
    """Parallel lines of points, as of a mast or a gimbal with two axes.

    The outer axis points to the right, and turns the beam from the nadir forward by the angle along; the inner one
    turns it to the right by the angle across. All points of a line follow each other, then those of the next line, at
    equal times: a pulse rate of rate_hz * lines * points gives one pulse to each point, also at GPS times, which are
    rounded. A flight line begins with a whole point.

    Parameters
    ----------
    along_deg
        Angle along of the first and the last line [deg], -180 to 180; (60, 80) is in front of a mast.
    across_deg
        Angle across of the first and the last point of each line [deg], -90 to 90.
    lines, points
        Number of lines, and of points of each, 1 or more; one is in the middle.
    rate_hz
        Rasters per second [Hz], positive.
    """

    along_deg: tuple[float, float]
    across_deg: tuple[float, float]
    lines: int
    points: int
    rate_hz: float

    def _check(self) -> None:
        for name, most in (("along_deg", 180.0), ("across_deg", 90.0)):
            ends = finite_array(name, getattr(self, name))
            if ends.shape != (2,):
                raise UserError(f"{name} = {shown(getattr(self, name))} must be two angles in degrees")
            self._set(name, tuple(in_range(name, end, -most, most) for end in ends))
        for name in ("lines", "points"):
            self._set(name, integer(name, getattr(self, name), 1, _MOST_POINTS))
        if self.lines * self.points > _MOST_POINTS:
            raise UserError(f"lines x points = {self.lines * self.points} must be at most {_MOST_POINTS}")
        self._set("rate_hz", positive("rate_hz", self.rate_hz))

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
    """One direction.

    Parameters
    ----------
    nadir_angle_deg
        Angle of the pulses from the nadir of the scanner [deg], 0 to 180.
    azimuth_deg
        Azimuth of the pulses [deg], clockwise from forward.
    """

    nadir_angle_deg: float = 0.0
    azimuth_deg: float = 0.0

    def _check(self) -> None:
        self._set("nadir_angle_deg", in_range("nadir_angle_deg", self.nadir_angle_deg, 0.0, 180.0))
        self._set("azimuth_deg", finite("azimuth_deg", self.azimuth_deg))

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


def _check_wave(wave: str) -> None:
    """Raise `UserError` unless a wave is one of `WAVES`."""
    if wave not in WAVES:
        raise UserError(f"wave = {shown(wave)} must be one of {', '.join(WAVES)}")


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
