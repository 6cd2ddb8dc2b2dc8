"""Ship wake: Kelvin waves of a thin hull on deep water, as a height field."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, finite, increasing_array, positive
from mitransient_lidar.physics.sea.wave_spectrum import GRAVITY

#: Least distance, in wavelengths, between the grid and the periodic images of the wake that the discrete sum causes.
_CLEARANCE = 8.0

_NODES_AT_ONCE = 1024  # limits each matrix of 4000 grid lines to 64 MB
_MOST_NODES = 2**17  # take a minute

ComplexArray = npt.NDArray[np.complex128]


def kelvin_wake(
    x: npt.ArrayLike,
    y: npt.ArrayLike,
    speed: float,
    bearing: float,
    length: float,
    beam: float | None = None,
    draught: float | None = None,
    ship_x: float = 0.0,
    ship_y: float = 0.0,
    smallest_wavelength: float = 0.1,
) -> FloatArray:
    """Height of a ship's steady wake on grid lines.

    Parameters
    ----------
    x, y : array_like, shapes (columns,) and (rows,)
        Positions of the grid lines [m], strictly increasing, at least 2 each. They need not be evenly spaced.
    speed : float
        Speed U of the ship through the water [m/s], positive.
    bearing : float
        Travel direction [rad], counter-clockwise from +x.
    length : float
        Waterline length L [m], positive.
    beam, draught : float, optional
        Full width B and depth T of the hull [m], positive; L/8 and L/20 by default. Heights are proportional to B.
    ship_x, ship_y : float
        Position of the ship's middle [m].
    smallest_wavelength : float
        Shortest wavelength in the result [m], positive. The theory neglects surface tension, which increases the phase
        speed of 0.1 m waves by 1.4 %.

    Returns
    -------
    ndarray, shape (rows, columns)
        Elevation [m] of the waves at (x[i], y[j]) for heights[j, i].

    Raises
    ------
    UserError
        If a size or the speed is not positive, a number not finite, the grid lines are fewer than 2 or not increasing,
        or the ship is too far away for its shortest waves on the grid.

    Notes
    -----
    Linear waves behind a thin hull, symmetric fore and aft, of parabolic waterlines and frames (Wigley's),
    y = +-(B/2) (1 - (2x/L)^2) (1 - (z/T)^2). In the ship's frame, x' ahead and y' to port,

        zeta = Re integral_{-pi/2}^{pi/2} A(theta) exp(i k (x' cos(theta) + y' sin(theta))) dtheta,
        k = k0 sec(theta)^2, k0 = g/U^2,

    with waves that are stationary in this frame. The hull displaces the water like sources -2 U dY/dx on its centre
    plane (Michell 1898), Y its half width. Each source generates Havelock's waves (1932), so that

        A(theta) = -(2i/pi) k0^2 sec(theta)^4 P,
        P = integral of Y exp(k z) cos(k0 x sec(theta)) over the centre plane = B L T j1(a)/a V(k T),
        a = k0 L sec(theta)/2, V(t) = integral_0^1 (1 - s^2) exp(-t s) ds = 1/t - 2/t^3 + 2 exp(-t) (1/t^2 + 1/t^3),

    j1 the spherical Bessel function; this is the form of Tuck, Scullen and Lazauskas (2002). The hull's wave
    resistance is ``(pi/2) rho U^2 integral |A|^2 cos(theta)^3 dtheta`` (Newman 1977), Michell's integral.

    Only these free waves are included, not the local elevation about the hull, so that heights next to the hull are
    rough. Ahead of the ship's middle the integral yields mirrored, negated waves, which are removed. The others grow
    smoothly from 0 amidships to their full height at the stern. The theory exaggerates the short steep waves on the
    track, where a real ship leaves turbulent water.

    A grid line has the full amplitude of waves longer than both four times its distance to the next line and twice
    `smallest_wavelength`. Shorter waves fade out, down to 0 at half that length, against aliasing. A wake's longest
    wave has the length 2 pi/k0 = 2 pi U^2/g: a ship too slow for the grid has the wake 0.

    The integral is a sum over evenly spaced k sin(theta). It is exact except for the wake's periodic images, which are
    kept off the grid. A sum of plane waves over a grid is a product of two matrices.

    References
    ----------
    Michell, J. H. (1898), The wave-resistance of a ship, Philosophical Magazine 45, 106-123,
    doi:10.1080/14786449808621111.
    Havelock, T. H. (1932), The theory of wave resistance, Proceedings of the Royal Society A 138, 339-348.
    Newman, J. N. (1977), Marine Hydrodynamics, MIT Press, chapter 6.
    Tuck, E. O., Scullen, D. C., and Lazauskas, L. (2002), Wave patterns and minimum wave resistance for high-speed
    vessels, 24th Symposium on Naval Hydrodynamics, Fukuoka.
    """
    columns, rows = increasing_array("x", x), increasing_array("y", y)
    k0 = GRAVITY / positive("speed", speed) ** 2
    length = positive("length", length)
    beam = length / 8 if beam is None else positive("beam", beam)
    draught = length / 20 if draught is None else positive("draught", draught)
    ahead = np.array([math.cos(finite("bearing", bearing)), math.sin(bearing)])
    east, north = columns - finite("ship_x", ship_x), rows - finite("ship_y", ship_y)
    smallest = positive("smallest_wavelength", smallest_wavelength)
    limit_x, limit_y = (2 * np.pi / np.maximum(2 * _spacing(lines), smallest) for lines in (columns, rows))

    heights = np.zeros((rows.size, columns.size))
    upper = float(min(limit_x.max(), limit_y.max()))
    # By octaves: short waves need many nodes per metre, but only where the grid is fine.
    while upper > k0:
        lower = upper / 2 if upper > 4 * k0 else 0.0
        longest = max(lower / 2, k0)
        i, j = np.flatnonzero(limit_x > longest), np.flatnonzero(limit_y > longest)
        period = _image_distance(east[i], north[j], ahead, length) + _CLEARANCE * 2 * np.pi / longest
        kx, ky, k, amplitude = _plane_waves(k0, upper, period, length, beam, draught)
        amplitude *= _low_pass(k, upper) - (_low_pass(k, lower) if lower > 0 else 0)
        grid_kx, grid_ky = ahead[0] * kx - ahead[1] * ky, ahead[1] * kx + ahead[0] * ky
        for first in range(0, k.size, _NODES_AT_ONCE):
            some = slice(first, first + _NODES_AT_ONCE)
            along_x = _low_pass(k[some], limit_x[i, None]) * np.exp(1j * grid_kx[some] * east[i, None])
            along_y = _low_pass(k[some], limit_y[j, None]) * np.exp(1j * grid_ky[some] * north[j, None])
            heights[np.ix_(j, i)] += ((along_y * amplitude[some]) @ along_x.T).real
        upper = lower
    behind = -(ahead[0] * east + ahead[1] * north[:, None])
    return np.asarray(heights * _smooth_step(2 * behind / length))


def _plane_waves(
    k0: float, upper: float, period: float, length: float, beam: float, draught: float
) -> tuple[FloatArray, FloatArray, FloatArray, ComplexArray]:
    """Plane waves up to the wavenumber `upper` [rad/m] whose sum is the wake, periodic across the track [m].

    Returns wavenumbers along and across the track and their moduli [rad/m], and amplitudes [m], shape (waves,).
    With dk_y = k0 sec^3 (1 + sin^2) dtheta, A dtheta = -(2i/pi) kx P/(2 - k0/k) dk_y.
    """
    from scipy.special import spherical_jn

    step = 2 * np.pi / period
    count = int(np.sqrt(upper * (upper - k0)) / step)
    if count > _MOST_NODES:
        raise UserError(
            f"wake_x, wake_y: the wake spreads over {period:.3g} m before this sea, too far for waves of "
            f"{2 * np.pi / upper:.2g} m"
        )
    ky = step * np.arange(-count, count + 1, dtype=np.float64)
    k = (k0 + np.sqrt(k0**2 + 4 * ky**2)) / 2
    kx = np.sqrt(k0 * k)
    half = kx * length / 2
    moment = beam * length * draught * spherical_jn(1, half) / half * _depth_factor(k * draught)
    return kx, ky, k, -2j / np.pi * kx * moment / (2 - k0 / k) * step


def _depth_factor(t: FloatArray) -> FloatArray:
    """Integral of (1 - s^2) exp(-t s) over s from 0 to 1, for t > 0."""
    closed = 1 / t - 2 / t**3 + 2 * np.exp(-t) * (1 / t**2 + 1 / t**3)
    # The closed form cancels at small t, where nine terms of the power series are accurate to 1e-12.
    term, series = np.ones_like(t), np.zeros_like(t)
    for n in range(9):
        series += term * 2 / ((n + 1) * (n + 3))
        term *= -np.minimum(t, 0.3) / (n + 1)
    return np.where(t < 0.3, series, closed)


def _image_distance(east: FloatArray, north: FloatArray, ahead: FloatArray, length: float) -> float:
    """Smallest period [m] across the track at which the wake's images do not overlap the grid behind the bow."""
    corner_east, corner_north = east[[0, 0, -1, -1]], north[[0, -1, 0, -1]]
    along = ahead[0] * corner_east + ahead[1] * corner_north
    across = ahead[0] * corner_north - ahead[1] * corner_east
    behind = max(0.0, length / 2 - float(along.min()))
    # The energy stays within Kelvin's angle: dk_x/dk_y <= 1/sqrt(8).
    return float(np.abs(across).max()) + behind / math.sqrt(8)


def _low_pass(k: FloatArray, limit: FloatArray | float) -> FloatArray:
    """Amplitude factor of the low-pass: 1 up to half the limiting wavenumber, 0 from the limit on."""
    return _smooth_step(2 - 2 * k / limit)


def _smooth_step(s: FloatArray) -> FloatArray:
    """Step from 0 at s = 0 to 1 at s = 1 with continuous curvature."""
    s = np.clip(s, 0, 1)
    return np.asarray(s**3 * (10 + s * (6 * s - 15)))


def _spacing(lines: FloatArray) -> FloatArray:
    """Distance of every grid line to its farther neighbour [m]."""
    gaps = np.diff(lines)
    return np.asarray(np.maximum(np.append(gaps, gaps[-1]), np.insert(gaps, 0, gaps[0])))
