"""Elevations of periodic waves at any resolution, and the slope variance that facets of that resolution have."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.sea.realization import (
    facet_slope_variance,
    heights_of,
    wave_coefficients,
    wave_numbers,
)
from mitransient_lidar.physics.sea.wave_spectrum import WaveSpectrum

#: Largest number of cells per side of one grid, and number of cells of the grids for the long waves of a finer sea.
_MOST_CELLS, _LONG_WAVE_CELLS = 2048, 1024

#: Largest ratio of the periods of neighbouring grids, odd.
_MOST_TILES = 31


@dataclass(frozen=True)
class Motion:
    """What moves waves; see `realization.realise`."""

    time: float  #: Time [s].
    depth: float  #: Depth of the water [m].
    current: tuple[float, float]  #: Velocity (x, y) of the water [m/s].


@dataclass(frozen=True, eq=False)
class PeriodicHeights:
    """Elevations of waves on one grid that is as fine as the facets."""

    heights: FloatArray  #: Elevation [m], shape (cells, cells), as from `realization.realise`.
    cell_size: float  #: Spacing of the grid [m].

    @property
    def cells(self) -> int:
        """Number of cells of the grid per period."""
        return len(self.heights)

    def sample(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return elevations [m] at the grid points nearest to the grid lines x and y [m], shape (len(y), len(x))."""
        count = self.cells
        i, j = ((np.rint(np.asarray(lines) / self.cell_size).astype(int) + count // 2) % count for lines in (x, y))
        return np.asarray(self.heights[np.ix_(j, i)])


@dataclass(frozen=True, eq=False)
class Band:
    """Waves of a range of wavenumbers as Fourier amplitudes."""

    #: Amplitudes [m] of waves with -h to h wavelengths per period along y and 0 to h along x, shape (2 h + 1, h + 1).
    coefficients: npt.NDArray[np.complex128]
    period: float  #: Period [m].

    def sample(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the sum of the waves [m] on grid lines x and y [m], shape (len(y), len(x))."""
        half = self.coefficients.shape[1] - 1
        unit = 2j * np.pi / self.period
        along_x = np.exp(unit * np.outer(np.arange(half + 1), x))
        along_x[1:] *= 2  # for the half plane kx < 0
        along_y = np.exp(unit * np.outer(y, np.arange(-half, half + 1)))
        amplitudes = along_y @ self.coefficients
        return np.asarray(amplitudes.real @ along_x.real - amplitudes.imag @ along_x.imag)


@dataclass(frozen=True, eq=False)
class NestedHeights:
    """Elevations of waves whose period is too long for one grid of the facets' cells.

    The longest waves are those of a coarse grid over the period. Each band of shorter ones has a period that is an odd
    fraction of the last, so that the wavenumbers of all bands fill the plane without gap or overlap.
    """

    bands: tuple[Band, ...]  #: Waves by decreasing period, at least one band.
    short_waves: PeriodicHeights | None  #: The waves of the shortest period, unless they are the last band.

    @property
    def cells(self) -> int:
        """Number of cells per period of the grid that holds the longest waves."""
        return _LONG_WAVE_CELLS

    @property
    def cell_size(self) -> float:
        """Spacing of the grid that holds the longest waves [m]."""
        return self.bands[0].period / _LONG_WAVE_CELLS

    def sample(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return elevations [m] on grid lines x and y [m], shape (len(y), len(x)); see `PeriodicHeights.sample`."""
        parts = [band.sample(x, y) for band in self.bands]
        return sum(parts if self.short_waves is None else [*parts, self.short_waves.sample(x, y)], np.zeros(()))


def realise_heights(
    spectrum: WaveSpectrum,
    period: float,
    cell: float,
    seed: int,
    motion: Motion,
    axis: float,
    shortest_wave: float = 0.0,
) -> tuple[PeriodicHeights | NestedHeights, float, tuple[float, float]]:
    """Realise a sea for facets of a given size.

    Parameters
    ----------
    spectrum, seed
        As for `realization.realise`.
    period
        Period of the sea [m], positive.
    cell
        Largest side of the cells [m], positive.
    motion
        Time, depth and current.
    axis
        Direction of the slope variances [rad], counter-clockwise from +x.
    shortest_wave
        Wavelength of the shortest waves [m]; shorter than two cells, the waves end there.

    Returns
    -------
    waves, cell, variance
        Elevations, the side of the cells [m], and the expected slope variances [1] of the facets along and across the
        axis.
    """
    details = motion.time, motion.depth, motion.current

    def grid_of_waves(part: float) -> int:
        """Return the cells per period of the coarsest grid that holds all waves."""
        finest = even_cells(cell, part)
        return min(finest, 2 * int(part / shortest_wave) + 2) if shortest_wave > 0 else finest

    # The cell of the last grid is that of the facets of all bands.
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

    bands: list[Band] = []
    short_waves = None
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
        coefficients = wave_coefficients(spectrum, part, count, seed + number * 2**54, *details)
        coefficients[is_missing] = 0
        variance = spectrum.mode_variances(ix, iy, dk)
        variance[is_missing] = 0
        resolved += facet_slope_variance(variance, ix, iy, part, part / cell, axis)
        if is_last and cells <= _MOST_CELLS:
            short_waves = PeriodicHeights(heights_of(coefficients, cells), cell)
        else:
            rows = np.roll(np.arange(count), count // 2)[count // 2 - outer : count // 2 + outer + 1]
            bands.append(Band(coefficients[rows, : outer + 1], part))
    found = float(resolved[0]), float(resolved[1])
    if short_waves is not None and not bands:
        return short_waves, cell, found
    return NestedHeights(tuple(bands), short_waves), cell, found


def even_cells(cell: float, period: float) -> int:
    """Return an even number of cells per period, not longer than `cell` [m], that is fast to transform."""
    half = max(2, math.ceil(0.5 * period / cell - 1e-9))
    while not _is_product_of_small_primes(half):
        half += 1
    return 2 * half


def _is_product_of_small_primes(number: int) -> bool:
    """Return whether a number has no prime factors but 2, 3 and 5, so that Fourier transforms of its size are fast."""
    for factor in (2, 3, 5):
        while number % factor == 0:
            number //= factor
    return number == 1
