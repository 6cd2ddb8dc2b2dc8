"""Wind-driven sea surface: slope statistics, the Elfouhaily spectrum, realisations, and what a mesh leaves to ripples.

Wind directions are those the wind blows towards, in rad counter-clockwise from +x. Wind speeds are at 10 m height
(Cox and Munk measured at 12.5 m; the difference is below their error).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite, in_range, positive

GRAVITY = 9.81
DRAG_COEFFICIENT = 0.00144
MAX_WIND_SPEED = 30.0
_K_M = 370.0  # wavenumber of the slowest gravity-capillary wave, rad/m
_C_M = 0.23  # its phase speed, m/s
_K_END = 20 * _K_M  # the capillary peak has fallen to e^-90 there


def cox_munk(wind_speed: float) -> tuple[float, float]:
    """Slope variances of a clean sea measured by Cox and Munk.

    Parameters
    ----------
    wind_speed : float
        Wind speed [m/s], 0 to 30. Measured between 1 and 14 m/s; linear beyond.

    Returns
    -------
    upwind, crosswind : float
        Slope variances [1]. The regression leaves 0.003 crosswind at no wind.

    Raises
    ------
    ValueError
        If the wind speed lies outside its range.

    Notes
    -----
    Cox and Munk (1954), J. Opt. Soc. Am. 44, 838, doi:10.1364/JOSA.44.000838: 3.16e-3 W and 0.003 + 1.92e-3 W.
    """
    wind = in_range("wind_speed", wind_speed, 0, MAX_WIND_SPEED)
    return 3.16e-3 * wind, 0.003 + 1.92e-3 * wind


@dataclass(frozen=True)
class ElfouhailySpectrum:
    """Unified spectrum of wind-driven gravity and capillary waves.

    Parameters
    ----------
    wind_speed : float
        Wind speed at 10 m [m/s], 0 to 30. 0 gives a flat sea.
    inverse_wave_age : float
        Omega: 0.84 for a fully developed sea, up to 5 for a young one.

    Raises
    ------
    ValueError
        If a parameter lies outside its range.

    Notes
    -----
    Elfouhaily, Chapron, Katsaros and Vandemark (1997), J. Geophys. Res. 102, 15781, doi:10.1029/97JC00467, with the
    drag coefficient 0.00144 and the low-frequency roll-off L_PM J_p also on the capillary branch, without which the
    waves of light winds come out tens of metres high. Where the capillary amplitude of eq. 44 is negative (below
    2.2 m/s) it is taken as 0.
    """

    wind_speed: float
    inverse_wave_age: float = 0.84

    def __post_init__(self) -> None:
        in_range("wind_speed", self.wind_speed, 0, MAX_WIND_SPEED)
        in_range("inverse_wave_age", self.inverse_wave_age, 0.84, 5)

    @property
    def peak_wavenumber(self) -> float:
        """Wavenumber of the spectral peak [rad/m]; infinite without wind."""
        if self.wind_speed == 0:
            return np.inf
        return GRAVITY * (self.inverse_wave_age / self.wind_speed) ** 2

    def omnidirectional(self, k: npt.ArrayLike) -> FloatArray:
        """Omnidirectional elevation spectrum S(k) [m^3]; its integral over k > 0 is the elevation variance.

        Parameters
        ----------
        k : array_like
            Wavenumber [rad/m]; S is 0 at k <= 0.

        Returns
        -------
        ndarray
            S, of the shape of `k`.
        """
        wavenumber = np.asarray(k, dtype=np.float64)
        valid = wavenumber > 0
        if self.wind_speed == 0:
            return np.zeros_like(wavenumber)
        k = np.where(valid, wavenumber, 1.0)
        omega, peak = self.inverse_wave_age, self.peak_wavenumber
        speed = _phase_speed(k)
        root = np.sqrt(k / peak)

        # Roll-off below the peak and its enhancement, common to both branches
        gamma = 1.7 + 6 * max(np.log10(omega), 0.0)
        sigma = 0.08 * (1 + 4 * omega**-3)
        roll_off = np.exp(-1.25 * (peak / k) ** 2) * gamma ** np.exp(-((root - 1) ** 2) / (2 * sigma**2))

        # Long waves: B_l = alpha_p/2 (c_p/c) F_p
        long_waves = 0.5 * 0.006 * np.sqrt(omega) * _phase_speed(np.float64(peak)) / speed
        long_waves = long_waves * np.exp(-omega / np.sqrt(10) * (root - 1))

        # Short waves: B_h = alpha_m/2 (c_m/c) F_m
        ratio = np.log(np.sqrt(DRAG_COEFFICIENT) * self.wind_speed / _C_M)
        amplitude = max(0.01 * (1 + (ratio if ratio <= 0 else 3 * ratio)), 0.0)
        short_waves = 0.5 * amplitude * _C_M / speed * np.exp(-0.25 * (k / _K_M - 1) ** 2)
        return np.asarray(np.where(valid, roll_off * (long_waves + short_waves) / k**3, 0))

    def spreading(self, k: npt.ArrayLike) -> FloatArray:
        """Upwind-crosswind ratio Delta(k) [1], 0 to 1: the angular density is (1 + Delta cos 2 phi)/(2 pi).

        Parameters
        ----------
        k : array_like
            Wavenumber [rad/m], positive.

        Returns
        -------
        ndarray
            Delta, of the shape of `k`.
        """
        if self.wind_speed == 0:
            return np.zeros(np.shape(k))
        c = _phase_speed(np.asarray(k, dtype=np.float64))
        friction = np.sqrt(DRAG_COEFFICIENT) * self.wind_speed
        long_waves = 4 * (c / _phase_speed(np.float64(self.peak_wavenumber))) ** 2.5
        short_waves = 0.13 * friction / _C_M * (_C_M / c) ** 2.5
        return np.asarray(np.tanh(np.log(2) / 4 + long_waves + short_waves))

    def directional(self, kx: npt.ArrayLike, ky: npt.ArrayLike, wind_direction: float = 0.0) -> FloatArray:
        """Directional spectrum Psi [m^4]; its integral over the whole (kx, ky) plane is the elevation variance.

        Parameters
        ----------
        kx, ky : array_like
            Wavenumber components [rad/m]; Psi is 0 at the origin.
        wind_direction : float
            Direction the wind blows towards [rad], counter-clockwise from +x.

        Returns
        -------
        ndarray
            Psi, of the broadcast shape. Waves along and against the wind count alike: a frozen surface cannot tell.
        """
        k = np.hypot(kx, ky)
        safe = np.where(k > 0, k, 1.0)
        along = (np.cos(wind_direction) * np.asarray(kx) + np.sin(wind_direction) * np.asarray(ky)) / safe
        angular = (1 + self.spreading(safe) * (2 * along**2 - 1)) / (2 * np.pi)
        return np.asarray(np.where(k > 0, self.omnidirectional(k) * angular / safe, 0))

    def slope_variance(self, k_max: float = np.inf) -> tuple[float, float]:
        """Slope variances (upwind, crosswind) [1] of all waves with wavenumbers up to `k_max` [rad/m]."""
        if not k_max > 0:
            raise ValueError(f"k_max = {k_max:g} must be greater than 0")
        k, weight = self._quadrature(k_max)
        curvature = self.omnidirectional(k) * k**2 * weight
        spreading = self.spreading(k)
        return float(np.sum(curvature * (0.5 + spreading / 4))), float(np.sum(curvature * (0.5 - spreading / 4)))

    def significant_wave_height(self) -> float:
        """Four standard deviations of the elevation [m]."""
        k, weight = self._quadrature(np.inf)
        return 4 * float(np.sqrt(np.sum(self.omnidirectional(k) * weight)))

    def _quadrature(self, k_max: float) -> tuple[FloatArray, FloatArray]:
        """Wavenumbers and weights of a midpoint rule in ln k over the whole spectrum up to `k_max`."""
        low, high = self.peak_wavenumber / 10, min(k_max, _K_END)
        if low >= high:
            return np.ones(1), np.zeros(1)
        count = 4000
        step = np.log(high / low) / count
        k = low * np.exp(step * (np.arange(count) + 0.5))
        return k, k * step


def realise(
    spectrum: ElfouhailySpectrum, size: float, resolution: int, seed: int, wind_direction: float = 0.0
) -> FloatArray:
    """Realise a periodic square patch of sea surface as a Gaussian random field.

    Parameters
    ----------
    spectrum : ElfouhailySpectrum
        Waves to realise.
    size : float
        Side of the patch [m], positive. Waves longer than it are missing.
    resolution : int
        Cells per side, even, at least 2.
    seed : int
        Any integer. A wave depends only on its wavenumber and the seed: at a given size, a coarser realisation is
        the finer one without its short waves.
    wind_direction : float
        Direction the wind blows towards [rad], counter-clockwise from +x.

    Returns
    -------
    ndarray, shape (resolution, resolution)
        Elevation [m] at x = (i - resolution/2) d, y = (j - resolution/2) d for heights[j, i], d = size/resolution.

    Raises
    ------
    ValueError
        If `size` is not positive, `resolution` not even and positive, or the direction not finite.
    """
    from scipy.fft import fftshift, irfft2

    ix, iy, kx, ky = _wave_grid(size, resolution)
    finite("wind_direction", wind_direction)
    dk = 2 * np.pi / size
    amplitude = np.sqrt(spectrum.directional(kx, ky, wind_direction)) * dk
    # Hermitian symmetry within the column kx = 0: its lower half repeats the upper one conjugated.
    mirrored = (ix == 0) & (iy < 0)
    noise = _complex_normal(seed, ix, np.where(mirrored, -iy, iy))
    coefficients = amplitude * np.where(mirrored, noise.conj(), noise)
    # A coarser grid could not tell +k from -k at its Nyquist wavenumber.
    coefficients[(ix == resolution // 2) | (iy == -(resolution // 2))] = 0
    heights = irfft2(coefficients, s=(resolution, resolution), norm="forward")
    return np.asarray(fftshift(heights), dtype=np.float64)


def mesh_slope_variance(
    spectrum: ElfouhailySpectrum, size: float, resolution: int, wind_direction: float = 0.0
) -> tuple[float, float]:
    """Compute the expected slope variances of the triangles spanned by `realise`.

    Parameters
    ----------
    spectrum, size, resolution, wind_direction
        As for `realise`.

    Returns
    -------
    upwind, crosswind : float
        Slope variances [1] of the linear facets, fewer than those of the waves by the facets' low-pass.

    Notes
    -----
    The legs of a facet are forward differences along x and y, with the transfer 2 sin(k d/2)/d each. Their covariance
    is that of cells split along the diagonal from (i+1, j) to (i, j+1), averaged over both triangles of a cell:
    4 sin(a) sin(b) cos(a - b)/d^2 with a = kx d/2, b = ky d/2. It matters only for winds oblique to the mesh.
    """
    ix, iy, kx, ky = _wave_grid(size, resolution)
    spacing, dk = size / resolution, 2 * np.pi / size
    variance = spectrum.directional(kx, ky, wind_direction) * dk**2
    variance[(ix == resolution // 2) | (iy == -(resolution // 2))] = 0
    variance[ix > 0] *= 2  # the half plane that the grid leaves out
    a, b = kx * spacing / 2, ky * spacing / 2
    x = np.sum(variance * (2 * np.sin(a) / spacing) ** 2)
    y = np.sum(variance * (2 * np.sin(b) / spacing) ** 2)
    xy = np.sum(variance * 4 * np.sin(a) * np.sin(b) * np.cos(a - b) / spacing**2)
    cos, sin = np.cos(wind_direction), np.sin(wind_direction)
    upwind = cos**2 * x + 2 * cos * sin * xy + sin**2 * y
    return float(upwind), float(x + y - upwind)


def ripple_variance(
    spectrum: ElfouhailySpectrum,
    size: float,
    resolution: int,
    wind_direction: float = 0.0,
    total: Literal["cox_munk", "spectrum"] = "cox_munk",
) -> tuple[float, float]:
    """Slope variances that a mesh does not resolve and a rough-surface model must supply.

    Parameters
    ----------
    spectrum, size, resolution, wind_direction
        As for `realise`.
    total : {'cox_munk', 'spectrum'}
        Where the total comes from: measured (Cox and Munk 1954) or the whole spectrum, which is 10 to 40 % more.

    Returns
    -------
    upwind, crosswind : float
        max(0, total - resolved) [1]. At light winds a fine mesh can resolve more than Cox and Munk measured upwind.

    Raises
    ------
    ValueError
        If `total` is unknown, or as for `realise`.
    """
    if total not in ("cox_munk", "spectrum"):
        raise ValueError(f"total = {total!r} must be 'cox_munk' or 'spectrum'")
    whole = cox_munk(spectrum.wind_speed) if total == "cox_munk" else spectrum.slope_variance()
    resolved = mesh_slope_variance(spectrum, size, resolution, wind_direction)
    return max(0.0, whole[0] - resolved[0]), max(0.0, whole[1] - resolved[1])


def _phase_speed(k: FloatArray | np.float64) -> FloatArray:
    return np.asarray(np.sqrt(GRAVITY / k * (1 + (k / _K_M) ** 2)))


def _wave_grid(
    size: float, resolution: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], FloatArray, FloatArray]:
    """Integer and physical wavenumbers of a real FFT, shapes (resolution, resolution/2 + 1)."""
    positive("size", size)
    if resolution != int(resolution) or resolution < 2 or resolution % 2:
        raise ValueError(f"resolution = {resolution} must be an even whole number of at least 2")
    half = int(resolution) // 2
    y = np.arange(2 * half, dtype=np.int64)
    signed = np.asarray(np.where(y < half, y, y - 2 * half), dtype=np.int64)
    iy, ix = np.meshgrid(signed, np.arange(half + 1, dtype=np.int64), indexing="ij")
    dk = 2 * np.pi / size
    return np.asarray(ix), np.asarray(iy), np.asarray(ix * dk, dtype=np.float64), np.asarray(iy * dk, dtype=np.float64)


def _complex_normal(seed: int, ix: npt.NDArray[np.int64], iy: npt.NDArray[np.int64]) -> npt.NDArray[np.complex128]:
    """Complex Gaussian numbers of mean square 1 that depend only on the seed and the indices (Box-Muller)."""
    key = _mix(np.array([int(seed) & 0xFFFFFFFFFFFFFFFF], dtype=np.uint64))
    key = _mix(_mix(key ^ ix.astype(np.uint64)) ^ iy.astype(np.uint64))
    # 53 bits each; the half keeps the logarithm's argument above 0
    first = ((key >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53
    second = (_mix(key) >> np.uint64(11)).astype(np.float64) * 2.0**-53
    return np.asarray(np.sqrt(-np.log(first)) * np.exp(2j * np.pi * second))


def _mix(x: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """SplitMix64: one step of its counter and the finaliser (Steele, Lea and Flood 2014)."""
    x = x + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
