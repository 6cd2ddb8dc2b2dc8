"""Realisations of a wave spectrum in space and time at any resolution, and the slope variance that facets resolve."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, IntArray, positive
from mitransient_lidar.physics.sea.wave_spectrum import (
    GRAVITY,
    SLOWEST_WAVENUMBER,
    CosineSpectrum,
    SeaState,
    WaveSpectrum,
    facet_slope_variance,
)

#: Largest number of cells per grid side, and number of cells in the long-wave grids of a finer sea.
_MOST_CELLS, _LONG_WAVE_CELLS = 2048, 1024

_MOST_TILES = 31  #: Largest ratio between the periods of neighbouring grids, odd.

#: Most wavelengths per period of waves that are summed one by one. Others are interpolated on a grid with so many times
#: the fewest points, by a kernel over so many of them, whose decay suits both.
_FEW_WAVES, _FINER, _TAPS = 16, 1.5, 8
_DECAY = 0.98 * math.pi * _TAPS * (1 - 0.5 / _FINER)


@dataclass(frozen=True)
class Motion:
    """Causes of wave motion."""

    time: float = 0.0  #: Time [s].
    depth: float = math.inf  #: Depth of the water [m], positive or infinite; it slows long waves.
    current: tuple[float, float] = (0.0, 0.0)  #: Water velocity (x, y) [m/s], added to the velocity of all waves.


_STILL = Motion()


def angular_frequency(k: npt.ArrayLike, depth: float = math.inf) -> FloatArray:
    """Angular frequency of gravity-capillary waves.

    Returns omega [rad/s], in the shape of `k`.

    `k`: wavenumber [rad/m], not negative. `depth`: water depth [m], positive or infinite.

    Linear waves (Lamb 1932, Hydrodynamics, sections 229 and 267): omega^2 = (g k + (T/rho) k^3) tanh(k depth) with
    T/rho = g/(370 rad/m)^2 = 7.17e-5 m^3/s^2, the surface tension for the slowest wave in the Elfouhaily spectrum.
    """
    if not depth > 0:
        raise UserError(f"depth = {depth:g} must be greater than 0")
    wavenumber = np.asarray(k, dtype=np.float64)
    square = wavenumber * (GRAVITY + GRAVITY / SLOWEST_WAVENUMBER**2 * wavenumber**2)
    if not math.isinf(depth):
        square = square * np.tanh(wavenumber * depth)
    return np.asarray(np.sqrt(square))


def wave_coefficients(
    spectrum: WaveSpectrum | SeaState,
    period: float,
    cells: int,
    seed: int,
    motion: Motion = _STILL,
    only: int | None = None,
) -> npt.NDArray[np.complex128]:
    """Realise a periodic square patch of sea surface as a Gaussian random field; see `heights_of`.

    Raises UserError if `period` is not positive, or `cells` not even and positive.

    Returns complex wave amplitudes [m] at `wave_numbers`; the other half plane is their conjugate. The constant and the
    Nyquist wavenumbers have amplitude 0.

    `spectrum`: waves to realise. They travel towards the half plane of their direction. `period`: patch side [m],
    positive. Longer waves are missing. `cells`: cells per side, even, at least 2. `seed`: any integer. A wave depends
    only on its wavenumber and the seed: with the same period, a coarser realisation equals the finer one without its
    short waves. `motion`: time, depth and current; equal seeds are the same sea at different times. `only`: number of
    the one wave system to realise, by default all.
    """
    ix, iy, dk = wave_numbers(period, cells)
    time = motion.time
    if time != 0:
        drift = dk * (motion.current[0] * ix + motion.current[1] * iy[:, None]) * time
        advance = angular_frequency(dk * np.sqrt(ix**2 + iy[:, None] ** 2), motion.depth) * time
    coefficients = np.zeros((iy.size, ix.size), dtype=np.complex128)
    for number, waves in enumerate(spectrum.systems):
        if only not in (None, number):
            continue
        # Those of a moving sea are asked for again.
        modulus, phase = (_still_waves if time == 0 else _moving_waves)(waves, number, period, cells, seed)
        if time != 0:
            along = np.cos(waves.direction) * ix + np.sin(waves.direction) * iy[:, None]
            phase = phase - (drift + np.where(along >= 0, advance, -advance))
        coefficients.real += modulus * np.cos(phase)
        coefficients.imag += modulus * np.sin(phase)
    half = iy.size // 2
    # Hermitian symmetry within the column kx = 0: its lower half is the conjugate of the upper one.
    coefficients[half + 1 :, 0] = coefficients[half - 1 : 0 : -1, 0].conj()
    coefficients[0, 0] = 0
    # At the Nyquist wavenumber a grid cannot distinguish +k from -k.
    coefficients[half, :] = coefficients[:, half] = 0
    return coefficients


def _still_waves(
    waves: WaveSpectrum, number: int, period: float, cells: int, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Return moduli [m] and phases [rad] at time 0 of the wave system `number`, as of `wave_coefficients`."""
    ix, iy, dk = wave_numbers(period, cells)
    square, phase = _noise(seed, number, ix, iy)
    return np.sqrt(np.multiply(square, waves.mode_variances(ix, iy, dk), out=square), out=square), phase


_moving_waves = functools.lru_cache(maxsize=4)(_still_waves)


def heights_of(coefficients: npt.NDArray[np.complex128], cells: int = 0) -> FloatArray:
    """Return the elevations [m] of `wave_coefficients` waves, shape (cells, cells), with mean 0.

    Element [j, i] is at x = (i - cells/2) d, y = (j - cells/2) d, d = period/cells. The grid has `cells` per side, even
    and at least as many as the coefficients, the default.
    """
    count = len(coefficients)
    cells = cells or count
    if cells > count:
        half = count // 2
        waves, coefficients = coefficients, np.zeros((cells, half + 1), dtype=np.complex128)
        coefficients[:half], coefficients[-half:] = waves[:half], waves[half:]
    # Columns without waves are not transformed.
    heights = np.fft.irfft(np.fft.ifft(coefficients, axis=0, norm="forward"), cells, axis=1, norm="forward")
    return np.asarray(np.fft.fftshift(heights), dtype=np.float64)


def wave_numbers(period: float, cells: int) -> tuple[IntArray, IntArray, float]:
    """Return numbers of wavelengths over a period along x and y, and their unit.

    `period`, `cells`: as for `wave_coefficients`.

    Returns `ix`, `iy`: column and row indices of a real FFT, shapes (cells/2 + 1,) and (cells,). `dk`: wavenumber of
    one wavelength over the period [rad/m].
    """
    positive("period", period)
    if cells != int(cells) or cells < 2 or cells % 2:
        raise UserError(f"cells = {cells} must be an even integer of at least 2")
    half = int(cells) // 2
    y = np.arange(2 * half, dtype=np.int64)
    return np.arange(half + 1, dtype=np.int64), np.where(y < half, y, y - 2 * half), 2 * np.pi / period


def _noise(seed: int, number: int, ix: IntArray, iy: IntArray) -> tuple[FloatArray, FloatArray]:
    """Squared moduli, with mean 1, and phases [rad] of complex Gaussian numbers, shape (iy, ix) (Box-Muller).

    They depend on the seed, the wave system's number, and the indices.
    """
    key = _mix(np.array([int(seed) & 0xFFFFFFFFFFFFFFFF], dtype=np.uint64))
    if number > 0:
        # Hashed first: a small number would give the key of the first system's column ix = number.
        key = _mix(key ^ _mix(np.array([number], dtype=np.uint64)))
    key = _mix(_mix(key ^ ix.astype(np.uint64)) ^ iy.astype(np.uint64)[:, None])
    # 53 bits each; the added half keeps the argument of the logarithm above 0.
    first = ((key >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53
    phase = (_mix(key) >> np.uint64(11)).astype(np.float64)
    phase *= 2 * np.pi * 2.0**-53
    return -np.log(first, out=first), phase


def _mix(x: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """SplitMix64: one step of its counter and the finaliser (Steele, Lea and Flood 2014)."""
    x = x + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@dataclass(frozen=True, eq=False)
class HeightGrid:
    """Elevations of waves on one grid that is as fine as the facets."""

    heights: FloatArray  #: Elevation [m], shape (cells, cells), as from `heights_of`.
    cell_size: float  #: Grid spacing [m].

    def sample(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return elevations [m] at the grid points nearest to the grid lines x and y [m], shape (len(y), len(x)).

        Lines of several patches, shapes (n, len(x)) and (n, len(y)), give theirs, shape (n, len(y), len(x)).
        """
        count = len(self.heights)
        i, j = ((np.rint(np.asarray(lines) / self.cell_size).astype(int) + count // 2) % count for lines in (x, y))
        return np.asarray(self.heights[j[..., :, None], i[..., None, :]])


@dataclass(frozen=True, eq=False)
class Band:
    """Waves in a wavenumber range as Fourier amplitudes."""

    #: Wave amplitudes [m] with -h to h wavelengths per period along y and 0 to h along x, shape (2 h + 1, h + 1).
    coefficients: npt.NDArray[np.complex128]
    period: float  #: Period [m].

    @property
    def reach(self) -> int:
        """Most wavelengths per period."""
        return len(self.coefficients) // 2

    def sample(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the sum of the waves [m] on grid lines x and y [m], shape (len(y), len(x)).

        Many waves are interpolated, with errors below 1e-5 of the standard deviation of the heights.
        """
        if self.reach <= _FEW_WAVES:
            return self._direct(x, y, np.ones(2 * self.reach + 1))
        grid = Interpolation.of_waves(self.reach, self.period, x, y)
        return grid.between(self._grid[grid.rows[..., :, None], grid.columns[..., None, :]])

    def at_points(self, grid: Interpolation) -> FloatArray:
        """Return what to interpolate between the points of an interpolation of these waves or shorter ones [m]."""
        x, y = (np.asarray(points * (self.period / grid.cells), np.float64) for points in (grid.columns, grid.rows))
        return self._direct(x, y, _shares(self.reach, grid.cells))

    def _direct(self, x: FloatArray, y: FloatArray, share: FloatArray) -> FloatArray:
        """Return the sum of waves with shares by their number of wavelengths along either axis, shape (2 h + 1,)."""
        unit = 2j * np.pi / self.period
        along_x = share[self.reach :, None] * np.exp(unit * (np.arange(self.reach + 1)[:, None] * x[..., None, :]))
        along_x[..., 1:, :] *= 2  # for the half plane kx < 0
        along_y = share * np.exp(unit * (y[..., :, None] * np.arange(-self.reach, self.reach + 1)))
        amplitudes = along_y @ self.coefficients
        return np.asarray(amplitudes.real @ along_x.real - amplitudes.imag @ along_x.imag)

    @functools.cached_property
    def _grid(self) -> npt.NDArray[np.float32]:
        """What to interpolate at the points of all periods [m], shape (cells, cells) along y and x."""
        from scipy import fft

        cells, number = _cells_of(self.reach), np.arange(-self.reach, self.reach + 1)
        share = _shares(self.reach, cells)
        waves = np.zeros((cells, self.reach + 1), dtype=np.complex64)
        waves[number] = self.coefficients * share[:, None] * share[self.reach :]
        waves = fft.ifft(waves, axis=0, norm="forward", overwrite_x=True)
        return np.asarray(fft.irfft(waves, cells, axis=1, norm="forward", overwrite_x=True))


@dataclass(frozen=True)
class Interpolation:
    """Interpolation between the points of a grid, in single precision.

    For waves on a periodic grid it is a non-uniform Fourier transform of type 2 with the kernel
    exp(b ((1 - z^2)^(1/2) - 1)) (Barnett, Magland and af Klinteberg 2019, SIAM J. Sci. Comput. 41, C479). Waves are
    divided by the transform of the kernel. On other grids it is the cubic convolution of third order (Keys 1981, IEEE
    Trans. Acoust. Speech Signal Process. 29, 1153).
    """

    cells: int  #: Grid points per period.
    #: Numbers of the points along y and x, counted from 0 within the period, shapes (..., points).
    rows: IntArray
    columns: IntArray
    #: Weights of the points on each line along y and x, shapes (..., lines, points).
    along_y: npt.NDArray[np.float32]
    along_x: npt.NDArray[np.float32]

    @classmethod
    def of_waves(cls, reach: int, period: float, x: FloatArray, y: FloatArray) -> Self:
        """Return the interpolation to grid lines x and y [m] for at most so many wavelengths per period [m]."""
        cells = _cells_of(reach)
        (rows, along_y), (columns, along_x) = (
            _weights(np.asarray(lines) * (cells / period), _TAPS, lambda z: _kernel(z / (0.5 * _TAPS)), cells)
            for lines in (y, x)
        )
        return cls(cells, rows % cells, columns % cells, along_y, along_x)

    @classmethod
    def of_lattice(cls, step: float, x: FloatArray, y: FloatArray) -> Self:
        """Return the interpolation to grid lines x and y [m] between multiples of a step [m], whose period is one."""
        (rows, along_y), (columns, along_x) = (_weights(np.asarray(lines) / step, 4, _cubic, 0) for lines in (y, x))
        return cls(1, rows, columns, along_y, along_x)

    def between(self, values: npt.NDArray[np.floating[Any]]) -> FloatArray:
        """Return values on the lines, shape (..., lines, lines), from those at the points, as by `Band.at_points`."""
        along_x = np.swapaxes(self.along_x, -1, -2)
        return np.asarray(self.along_y @ values.astype(np.float32, copy=False) @ along_x, dtype=np.float64)


def _weights(
    place: FloatArray, taps: int, kernel: Callable[[FloatArray], FloatArray], cells: int
) -> tuple[IntArray, npt.NDArray[np.float32]]:
    """Return numbers of grid points and their weights on lines at places in cells, for a kernel over so many points.

    The grid has a period of `cells`, or none (0).
    """
    first = np.ceil(place - 0.5 * taps).astype(np.int64)
    points, low = first[..., None] + np.arange(taps), first.min(axis=-1, keepdims=True)
    most = int(np.max(first - low)) + taps
    used = np.arange(min(most, cells) if cells else most)
    weights = np.zeros((*place.shape, used.size), dtype=np.float32)
    values = kernel(points - place[..., None]).astype(np.float32)
    np.put_along_axis(weights, (points - low[..., None]) % (cells or most), values, axis=-1)
    return low + used, weights


def _cells_of(reach: int) -> int:
    """Return the grid points per period that interpolate at most so many wavelengths."""
    return even_cells(1.0, max(_FINER * (2 * reach + 1), _TAPS))


@functools.lru_cache(maxsize=64)
def _shares(reach: int, cells: int) -> FloatArray:
    """Return the shares of waves along one axis by their wavelengths per period, shape (2 reach + 1,)."""
    z, weight = np.polynomial.legendre.leggauss(8 * _TAPS)
    waves = np.cos(np.pi * _TAPS / cells * np.outer(np.arange(-reach, reach + 1), z))
    return np.asarray(2 / _TAPS / (waves @ (weight * _kernel(z))))


def _cubic(z: FloatArray) -> FloatArray:
    """Return the kernel of cubic convolution at distances in cells."""
    z = np.abs(z)
    return np.where(z < 1, (1.5 * z - 2.5) * z * z + 1, np.where(z < 2, ((2.5 - 0.5 * z) * z - 4) * z + 2, 0.0))


def _kernel(z: FloatArray) -> FloatArray:
    """Return the kernel of interpolations at places from -1 to 1 between its ends."""
    return np.asarray(np.exp(_DECAY * (np.sqrt(np.maximum(1 - z * z, 0)) - 1)))


@dataclass(frozen=True, eq=False)
class PeriodicHeights:
    """Wave elevations on one grid, or with a period that is too long for one grid with the facets' cells.

    The longest waves are waves of a coarse grid over the period. Each band of shorter ones has a period that is an odd
    fraction of the previous one. The bands' wavenumbers thus fill the plane without gap or overlap.
    """

    parts: tuple[Band | HeightGrid, ...]  #: Waves by decreasing period, of which the last may be on a grid.
    cells: int  #: Cells per period in the grid with the longest waves.
    cell_size: float  #: Spacing of that grid [m].
    #: Numbers of bands of neighbouring wavenumbers, and each band's waves except the shortest wind waves, whose sum are
    #: the waves of all parts.
    bands: tuple[tuple[int, Band], ...] = ()

    @property
    def size(self) -> int:
        """Number of heights that are kept."""
        return sum(_cells_of(one.reach) ** 2 if isinstance(one, Band) else one.heights.size for one in self.parts)

    def sample(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return elevations [m] on grid lines x and y [m], shape (len(y), len(x)); see `HeightGrid.sample`."""
        return functools.reduce(np.add, (part.sample(x, y) for part in self.parts))


def realise_heights(
    spectrum: WaveSpectrum | SeaState,
    period: float,
    cell: float,
    seed: int,
    motion: Motion,
    axis: float | None,
    shortest_wave: float = 0.0,
    wavenumbers: FloatArray | None = None,
) -> tuple[PeriodicHeights, float, tuple[float, float]]:
    """Realise a sea for facets with a given size.

    Returns the elevations, the cell side [m], and the expected slope variances [1] of the facets along and across the
    axis.

    `spectrum`, `seed`: as for `wave_coefficients`. `period`: sea period [m], positive. `cell`: largest cell side [m],
    positive. `motion`: time, depth and current. `axis`: axis of the slope variances [rad], counter-clockwise from +x;
    None for variances of 0, in less time. `shortest_wave`: wavelength of the shortest waves [m]; shorter than two
    cells, the waves end there. `wavenumbers`: band wavenumbers [rad/m], increasing, by which the waves are also
    divided; by default not divided. A band's share in a wave is a linear function of the logarithm of its wavenumber
    between neighbouring ones. Swell is the last band, on its own.
    """

    def grid_of_waves(part: float) -> int:
        """Return the cells per period of the coarsest grid that holds all waves."""
        finest = even_cells(cell, part)
        return min(finest, 2 * int(part / shortest_wave) + 2) if shortest_wave > 0 else finest

    # The last grid's cell is the facet cell for all bands.
    periods, limits = [period], [0]
    while grid_of_waves(periods[-1]) > _MOST_CELLS:
        tiles = 3
        while tiles < _MOST_TILES and grid_of_waves(periods[-1] / tiles) > _MOST_CELLS:
            tiles += 2
        # Up to h wavelengths in this period, from j + 1 in the next: (h + 1/2)/period = (j + 1/2)/next period.
        limits.append((_LONG_WAVE_CELLS // 2 - 1 - tiles // 2) // tiles)
        periods.append(periods[-1] / tiles)
    cells = even_cells(cell, periods[-1])
    cell = periods[-1] / cells

    parts: list[Band | HeightGrid] = []
    bands: list[tuple[int, Band]] = []
    resolved = np.zeros(2)
    for number, (part, inner) in enumerate(zip(periods, limits, strict=True)):
        is_last = number == len(periods) - 1
        count = grid_of_waves(part) if is_last else _LONG_WAVE_CELLS
        ix, iy, dk = wave_numbers(part, count)
        if is_last:
            outer = count // 2 - 1
        else:
            tiles = round(part / periods[number + 1])
            outer = tiles * limits[number + 1] + tiles // 2
        furthest = np.maximum(np.abs(iy)[:, None], ix)
        is_missing = (furthest > outer) | (furthest <= inner) & (number > 0)
        is_missing |= np.hypot(iy[:, None], ix) * shortest_wave > part
        # Each band has other random numbers: plugins allow seeds up to 2^53.
        coefficients = wave_coefficients(spectrum, part, count, seed + number * 2**54, motion)
        coefficients[is_missing] = 0
        if axis is not None:
            variance = spectrum.mode_variances(ix, iy, dk)
            variance[is_missing] = 0
            resolved += facet_slope_variance(variance, ix, iy, part, part / cell, axis)
        if is_last and cells <= _MOST_CELLS:
            parts.append(HeightGrid(heights_of(coefficients, cells), cell))
        else:
            rows = np.roll(np.arange(count), count // 2)[count // 2 - outer : count // 2 + outer + 1]
            parts.append(Band(coefficients[rows, : outer + 1], part))
        if wavenumbers is None:
            continue
        for system, waves in enumerate(spectrum.systems):
            if len(spectrum.systems) > 1:
                coefficients = wave_coefficients(spectrum, part, count, seed + number * 2**54, motion, system)
                coefficients[is_missing] = 0
            is_wind = isinstance(waves, CosineSpectrum)
            bands += _bands_of(coefficients, part, wavenumbers if is_wind else None, len(wavenumbers) if system else 0)
    longest = cells if isinstance(parts[0], HeightGrid) else _LONG_WAVE_CELLS
    spacing = cell if isinstance(parts[0], HeightGrid) else period / _LONG_WAVE_CELLS
    return PeriodicHeights(tuple(parts), longest, spacing, tuple(bands)), cell, (float(resolved[0]), float(resolved[1]))


def _bands_of(
    coefficients: npt.NDArray[np.complex128], period: float, wavenumbers: FloatArray | None, whole: int
) -> list[tuple[int, Band]]:
    """Return the bands of `wave_coefficients` waves: by wavenumber except the last band, or all as the band `whole`."""
    ix, _, dk = wave_numbers(period, len(coefficients))
    most = len(ix) - 2
    if wavenumbers is None:
        rows = np.arange(-most, most + 1)
        return [(whole, Band(coefficients[rows, : most + 1], period))]
    most = min(most, int(wavenumbers[-1] / dk))
    k = dk * np.hypot(np.arange(-most, most + 1)[:, None], ix[: most + 1])
    place = np.interp(np.log(np.maximum(k, wavenumbers[0])), np.log(wavenumbers), np.arange(len(wavenumbers)))
    found = []
    for number, end in enumerate(wavenumbers[1:]):
        reach = min(most, int(end / dk))
        rows = np.arange(-reach, reach + 1)
        share = np.maximum(1 - np.abs(place[most + rows, : reach + 1] - number), 0)
        waves = share * coefficients[rows, : reach + 1]
        if np.any(waves):
            found.append((number, Band(waves, period)))
    return found


def even_cells(cell: float, period: float) -> int:
    """Return an even number of cells per period, not longer than `cell` [m], that is fast to transform."""
    half = max(2, math.ceil(0.5 * period / cell - 1e-9))
    # Transforms are fast if its prime factors are 2, 3 and 5: if it divides a high power of 30.
    while pow(30, 64, half):
        half += 1
    return 2 * half
