"""Measured phase functions, read from a table of angles and values."""

from __future__ import annotations

from os import PathLike
from typing import NamedTuple

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.tables.headings import Column
from mitransient_lidar.core.tables.text_tables import read_two_columns
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.water.data_tables import PhaseFunction, log_log_interpolation
from mitransient_lidar.physics.water.phase_table import PowerLawTable

#: Nodes of the fine table: 822 in the backward hemisphere, more than measurements have there.
_COUNT = 32768

_FEWEST_ANGLES = 10
_SMALLEST_LAST_DEG = 170.0

_DEGREES = {**dict.fromkeys(("degrees", "deg", "degree", "°"), 1.0), **dict.fromkeys(("rad", "radians"), 180 / np.pi)}
_ANGLE = Column("angle", ("theta", "scattering angle"), _DEGREES)
_VALUE = Column("value", ("p", "phase function", "beta", "beta tilde", "vsf", "volume scattering function"))


class PhaseOfFile(NamedTuple):
    """A phase function from a table."""

    table: PowerLawTable  #: The phase function, normalised to 1 over the sphere.
    integral: float  #: Integral of the given values over the sphere; 1 if they were normalised in 1/sr.


def read_phase_table(path: str | PathLike[str]) -> PhaseOfFile:
    """Read a phase function from a file.

    Parameters
    ----------
    path : path-like
        Text file with two columns, as `text_tables.read_table` reads it. The scattering angle is in degrees, or in rad
        if its heading says so, increasing within 0 to 180 degrees, at least 10 with any spacing, the last 170 or more.
        The value is positive, in 1/sr or any other unit per solid angle (such as a volume scattering function).

    Returns
    -------
    PhaseOfFile
        The normalised phase function, and the integral by which the values were divided.

    Raises
    ------
    UserError
        If the file cannot be read or does not hold such a table (the message names the line), or if the values rise
        towards 0 so steeply that their integral diverges.

    Notes
    -----
    Between the angles ln p is linear in ln theta, as for `phase.petzold_average_particle`. Below the first angle the
    power law through the first two continues, or p is constant where the power law would decrease towards 0. If the
    first angle is 0, ln p is linear in theta^2 up to the second: flat at 0. Beyond the last angle p is constant. The
    result has 32768 nodes, 0.05 degree apart at 90 degrees but 0.4 at 165 and 3.3 at 180. Kinks are smoothed
    accordingly. A backward peak keeps its value at 180 degrees, but no shape narrower than 3 degrees.
    """
    theta, value = _read_columns(path)
    raw = _interpolation(path, theta, value)
    table = PowerLawTable.from_function(raw, _COUNT)
    return PhaseOfFile(table, float(raw(np.pi) / table.value[-1]))


def _interpolation(path: str | PathLike[str], theta: FloatArray, value: FloatArray) -> PhaseFunction:
    """Return the values as a function of the angle [rad], above 0."""
    positive, p = theta[theta > 0], value[theta > 0]
    log_theta, log_p = np.log(positive), np.log(p)
    power = float((log_p[1] - log_p[0]) / (log_theta[1] - log_theta[0]))
    if theta[0] == 0:
        # (p_0/p_1)^(1 - u^2) with u = theta/theta_1
        return log_log_interpolation(positive, p, lambda below: (np.log(value[0]) - log_p[0]) * -np.expm1(2 * below))
    if power <= -2:
        raise UserError(
            f"{path} rises as theta^{power:.3g} from {np.degrees(theta[1]):g} to {np.degrees(theta[0]):g} degrees, but"
            " the power must be above -2: its integral towards 0 would diverge"
        )
    return log_log_interpolation(positive, p, lambda below: min(power, 0.0) * below)


def _read_columns(path: str | PathLike[str]) -> tuple[FloatArray, FloatArray]:
    """Return angles [rad], shape (N,), and values, shape (N,)."""
    columns, lines, _ = read_two_columns(path, _ANGLE, _VALUE)
    angles, values = columns["angle"], columns["value"]
    last = None
    for number, angle, value in zip(lines, angles, values, strict=True):
        here = f"{path}, line {number}"
        if not 0 <= angle <= 180:
            raise UserError(f"{here}: angle = {angle:g} must lie between 0 and 180 degrees")
        if last is not None and angle <= last:
            raise UserError(f"{here}: angle = {angle:g} follows {last:g} but angles must increase")
        if not 0 < value < np.inf:
            raise UserError(f"{here}: value = {value:g} must be finite and greater than 0")
        last = angle
    if len(angles) < _FEWEST_ANGLES:
        raise UserError(f"{path} has {len(angles)} angles but must have at least {_FEWEST_ANGLES}")
    if angles[-1] < _SMALLEST_LAST_DEG:
        raise UserError(
            f"{path} ends at {angles[-1]:g} degrees but its last angle must be at least {_SMALLEST_LAST_DEG:g}"
        )
    return np.radians(angles), values
