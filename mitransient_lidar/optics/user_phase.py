"""Measured phase functions, read from a table of angles and values."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .checks import FloatArray
from .phase_table import PowerLawTable

#: Nodes of the fine table: 822 in the backward hemisphere, more than measurements have there.
_COUNT = 32768

_FEWEST_ANGLES = 10
_SMALLEST_LAST_DEG = 170.0


class UserPhase(NamedTuple):
    """A phase function from a table.

    Attributes
    ----------
    table : PowerLawTable
        The phase function, normalised to 1 over the sphere.
    integral : float
        What the values as given integrate to over the sphere; 1 if they were normalised in 1/sr.
    """

    table: PowerLawTable
    integral: float


def read_phase_table(path: str | PathLike[str]) -> UserPhase:
    """Read a phase function from a file.

    Parameters
    ----------
    path : path-like
        Text file of two columns, separated by commas or spaces: scattering angle [deg], increasing within 0 to 180, at
        least 10 of any spacing, the last 170 or more; and value, positive, in 1/sr or any other unit per solid angle
        (a volume scattering function serves). # starts a comment; a first line without numbers is a heading.

    Returns
    -------
    UserPhase
        The normalised phase function, and the integral by which the values were divided.

    Raises
    ------
    ValueError
        If the file cannot be read or does not hold such a table (the message tells the line), or if the values rise
        towards 0 so steeply that their integral diverges.

    Notes
    -----
    Between the angles ln p is linear in ln theta, as for `optics.phase.petzold_average_particle`. Below the first
    angle p goes on with the power of the first two, or constant where that would fall towards 0. If the first angle is
    0, ln p is linear in theta^2 up to the second: flat at 0. Beyond the last angle p is constant. All this is evaluated
    at the 32768 nodes of the result, 0.05 degree apart at 90 degrees but 0.4 at 165 and 3.3 at 180: kinks have their
    corners cut, and of a backward peak the value at 180 degrees is kept but not a shape narrower than 3 degrees.
    """
    theta, value = _read_columns(path)
    raw = _interpolation(path, theta, value)
    table = PowerLawTable.from_function(raw, _COUNT)
    return UserPhase(table, float(raw(np.pi) / table.value[-1]))


def _interpolation(
    path: str | PathLike[str], theta: FloatArray, value: FloatArray
) -> Callable[[npt.ArrayLike], FloatArray]:
    """Return the values as a function of the angle [rad], above 0."""
    log_theta, log_p = np.log(theta[theta > 0]), np.log(value[theta > 0])
    power = float((log_p[1] - log_p[0]) / (log_theta[1] - log_theta[0]))
    if theta[0] > 0 and power <= -2:
        raise ValueError(
            f"{path} rises as theta^{power:.3g} from {np.degrees(theta[1]):g} to {np.degrees(theta[0]):g} degrees, but"
            " the power must be above -2: its integral towards 0 would diverge"
        )

    def raw(angle: npt.ArrayLike) -> FloatArray:
        x = np.log(np.asarray(angle, dtype=np.float64))
        below = np.minimum(x - log_theta[0], 0)
        # With u = theta/theta_1: u^power, or (p_0/p_1)^(1 - u^2).
        core = min(power, 0.0) * below if theta[0] > 0 else (np.log(value[0]) - log_p[0]) * -np.expm1(2 * below)
        return np.asarray(np.exp(np.interp(x, log_theta, log_p) + core))

    return raw


def _read_columns(path: str | PathLike[str]) -> tuple[FloatArray, FloatArray]:
    """Return angles [rad], shape (N,), and values, shape (N,)."""
    try:
        with open(path, encoding="utf-8-sig") as file:
            lines = [line.split("#")[0].replace(",", " ").split() for line in file]
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not a text file in UTF-8") from error
    rows = [(number, words) for number, words in enumerate(lines, start=1) if words]
    if rows and all(_number(word) is None for word in rows[0][1]):
        del rows[0]
    degrees: list[float] = []
    values: list[float] = []
    for number, words in rows:
        here = f"{path}, line {number}"
        numbers = [_number(word) for word in words]
        if len(numbers) != 2 or None in numbers:
            raise ValueError(f"{here}: {' '.join(words)!r} must be two numbers, angle in degrees and value")
        angle, value = np.array(numbers, dtype=np.float64)
        if not 0 <= angle <= 180:
            raise ValueError(f"{here}: angle = {angle:g} must lie between 0 and 180 degrees")
        if degrees and angle <= degrees[-1]:
            raise ValueError(f"{here}: angle = {angle:g} follows {degrees[-1]:g} but angles must increase")
        if not 0 < value < np.inf:
            raise ValueError(f"{here}: value = {value:g} must be finite and greater than 0")
        degrees.append(angle)
        values.append(value)
    if len(degrees) < _FEWEST_ANGLES:
        raise ValueError(f"{path} has {len(degrees)} angles but must have at least {_FEWEST_ANGLES}")
    if degrees[-1] < _SMALLEST_LAST_DEG:
        raise ValueError(
            f"{path} ends at {degrees[-1]:g} degrees but its last angle must be at least {_SMALLEST_LAST_DEG:g}"
        )
    return np.radians(degrees), np.array(values)


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None
