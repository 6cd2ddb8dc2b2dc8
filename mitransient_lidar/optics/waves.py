"""Waves of the sea: how fast they run, realisations of a spectrum in space and time, and what a mesh shows of them."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite, finite_array, positive
from .wave_spectrum import GRAVITY, SLOWEST_WAVENUMBER, IntArray, WaveSpectrum, variances_along

UIntArray = npt.NDArray[np.uint64]


def angular_frequency(k: npt.ArrayLike, depth: float = math.inf) -> FloatArray:
    """Angular frequency of gravity-capillary waves.

    Parameters
    ----------
    k : array_like
        Wavenumber [rad/m], not negative.
    depth : float
        Depth of the water [m], positive or infinite.

    Returns
    -------
    ndarray
        omega [rad/s], of the shape of `k`.

    Raises
    ------
    ValueError
        If the depth is not greater than 0.

    Notes
    -----
    Linear waves (Lamb 1932, Hydrodynamics, sections 229 and 267): omega^2 = (g k + (T/rho) k^3) tanh(k depth) with
    T/rho = g/(370 rad/m)^2 = 7.17e-5 m^3/s^2, the surface tension of the Elfouhaily spectrum's slowest wave.
    """
    _check_depth(depth)
    wavenumber = np.asarray(k, dtype=np.float64)
    square = wavenumber * (GRAVITY + GRAVITY / SLOWEST_WAVENUMBER**2 * wavenumber**2)
    if not math.isinf(depth):
        square = square * np.tanh(wavenumber * depth)
    return np.asarray(np.sqrt(square))


def realise(
    spectrum: WaveSpectrum,
    period: float,
    cells: int,
    seed: int,
    time: float = 0.0,
    depth: float = math.inf,
    current: tuple[float, float] = (0.0, 0.0),
) -> FloatArray:
    """Realise a periodic square patch of sea surface as a Gaussian random field.

    Parameters
    ----------
    spectrum : WaveSpectrum
        Waves to realise. They run towards the half plane of their direction.
    period : float
        Side of the patch [m], positive. Waves longer than it are missing.
    cells : int
        Cells per side, even, at least 2.
    seed : int
        Any integer. A wave depends only on its wavenumber and the seed: at a given period, a coarser realisation is
        the finer one without its short waves.
    time : float
        Time at which the sea is seen [s]. Equal seeds are the same sea.
    depth : float
        Depth of the water [m], positive or infinite; it slows long waves down.
    current : tuple of float
        Velocity (x, y) [m/s] of the water, which carries all waves along.

    Returns
    -------
    ndarray, shape (cells, cells)
        Elevation [m] at x = (i - cells/2) d, y = (j - cells/2) d for heights[j, i], d = period/cells. Its mean is 0.

    Raises
    ------
    ValueError
        If `period` or `depth` is not positive, `cells` not even and positive, or `time` or `current` not finite.
    """
    from scipy.fft import fftshift, irfft2

    ix, iy, dk = _wave_grid(period, cells)
    finite("time", time)
    _check_depth(depth)
    velocity = finite_array("current", current)
    if velocity.shape != (2,):
        raise ValueError(f"current of shape {velocity.shape} must be two velocities, along x and y")
    turned = _turned_phases(ix, iy, dk, time, depth, velocity)
    coefficients = np.zeros((iy.size, ix.size), dtype=np.complex128)
    for number, waves in enumerate(spectrum.travelling_parts()):
        square, phase = _noise(seed, number, ix, iy)
        modulus = np.sqrt(np.multiply(square, waves.mode_variances(ix, iy, dk), out=square), out=square)
        if turned is not None:
            with_current, own = turned
            along = np.cos(waves.direction) * ix + np.sin(waves.direction) * iy[:, None]
            phase -= with_current + np.where(along >= 0, own, -own)
        coefficients.real += modulus * np.cos(phase)
        coefficients.imag += modulus * np.sin(phase)
    half = iy.size // 2
    # Hermitian symmetry within the column kx = 0: its lower half repeats the upper one conjugated.
    coefficients[half + 1 :, 0] = coefficients[half - 1 : 0 : -1, 0].conj()
    coefficients[0, 0] = 0
    # A coarser grid could not tell +k from -k at its Nyquist wavenumber.
    coefficients[half, :] = coefficients[:, half] = 0
    heights = irfft2(coefficients, s=(iy.size, iy.size), norm="forward", overwrite_x=True)
    return np.asarray(fftshift(heights), dtype=np.float64)


def mesh_slope_variance(
    spectrum: WaveSpectrum, period: float, cells: int, direction: float | None = None
) -> tuple[float, float]:
    """Compute the expected slope variances of the triangles spanned by `realise`.

    Parameters
    ----------
    spectrum, period, cells
        As for `realise`.
    direction : float, optional
        Axis of the variances [rad], counter-clockwise from +x. Default: the direction of the spectrum.

    Returns
    -------
    along, across : float
        Slope variances [1] of the linear facets along and across the direction, fewer than those of the waves by the
        facets' low-pass.

    Notes
    -----
    The legs of a facet are forward differences along x and y, with the transfer 2 sin(k d/2)/d each. Their covariance
    is that of cells split along the diagonal from (i+1, j) to (i, j+1), averaged over both triangles of a cell:
    4 sin(a) sin(b) cos(a - b)/d^2 with a = kx d/2, b = ky d/2. It matters only for winds oblique to the mesh.
    """
    ix, iy, dk = _wave_grid(period, cells)
    axis = spectrum.direction if direction is None else direction
    half = iy.size // 2
    variance = spectrum.mode_variances(ix, iy, dk)
    variance[half, :] = variance[:, half] = 0
    variance[:, 1:] *= 2  # the half plane that the grid leaves out
    # sin(a) sin(b) cos(a - b) = sin(2a) sin(2b)/4 + sin(a)^2 sin(b)^2
    a, b = ix * np.pi / cells, iy * np.pi / cells
    square_a, square_b = np.sin(a) ** 2, np.sin(b) ** 2
    x, y = variance.sum(axis=0) @ square_a, variance.sum(axis=1) @ square_b
    xy = np.sin(2 * b) @ variance @ np.sin(2 * a) / 4 + square_b @ variance @ square_a
    return variances_along(np.array([[x, xy], [xy, y]]) * (2 * cells / period) ** 2, axis)


def _check_depth(depth: float) -> None:
    if not depth > 0:
        raise ValueError(f"depth = {depth:g} must be greater than 0")


def _wave_grid(period: float, cells: int) -> tuple[IntArray, IntArray, float]:
    """Wave counts of a real FFT's columns and rows, shapes (cells/2 + 1,) and (cells,), and their spacing [rad/m]."""
    positive("period", period)
    if cells != int(cells) or cells < 2 or cells % 2:
        raise ValueError(f"cells = {cells} must be an even whole number of at least 2")
    half = int(cells) // 2
    y = np.arange(2 * half, dtype=np.int64)
    return np.arange(half + 1, dtype=np.int64), np.where(y < half, y, y - 2 * half), 2 * np.pi / period


def _turned_phases(
    ix: IntArray, iy: IntArray, dk: float, time: float, depth: float, current: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Phases [rad] that waves have turned by in a time: by the current, and by running along k. None if by nothing."""
    if time == 0:
        return None
    doppler = dk * (current[0] * ix + current[1] * iy[:, None])
    return np.asarray(doppler * time), angular_frequency(dk * np.sqrt(ix**2 + iy[:, None] ** 2), depth) * time


def _noise(seed: int, number: int, ix: IntArray, iy: IntArray) -> tuple[FloatArray, FloatArray]:
    """Squared moduli, of mean 1, and phases [rad] of complex Gaussian numbers, shape (iy, ix) (Box-Muller).

    They depend only on the seed, the number of the part of the sea, and the indices.
    """
    key = _mix(np.array([int(seed) & 0xFFFFFFFFFFFFFFFF], dtype=np.uint64))
    if number > 0:
        # Hashed first: a small number would be the key of the first part's column ix = number.
        key = _mix(key ^ _mix(np.array([number], dtype=np.uint64)))
    key = _mix(_mix(key ^ ix.astype(np.uint64)) ^ iy.astype(np.uint64)[:, None])
    # 53 bits each; the half keeps the logarithm's argument above 0
    first = ((key >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53
    phase = (_mix(key) >> np.uint64(11)).astype(np.float64)
    phase *= 2 * np.pi * 2.0**-53
    return -np.log(first, out=first), phase


def _mix(x: UIntArray) -> UIntArray:
    """SplitMix64: one step of its counter and the finaliser (Steele, Lea and Flood 2014)."""
    x = x + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
