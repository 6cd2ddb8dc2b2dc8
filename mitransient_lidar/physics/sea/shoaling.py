"""Waves over a bottom whose depth varies: wave band amplitudes by the local depth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mitransient_lidar.core.validation import ArrayLike, FloatArray
from mitransient_lidar.physics.sea.realization import Interpolation, Motion, PeriodicHeights, realise_heights
from mitransient_lidar.physics.sea.wave_spectrum import CosineSpectrum, MatchedSpectrum, SeaState
from mitransient_lidar.physics.sea.wind_spectra import ShallowSpectrum, SwellSpectrum

HEIGHT_PER_DEPTH = 0.5  #: Largest significant height of waves (four standard deviations) over the local depth.

#: Ratio between the wavenumbers of neighbouring bands, the first over the peak wavenumber, and the last [rad/m].
_BAND, _FIRST_BAND, _LAST_BAND = math.sqrt(2), 0.25, 2 * math.pi

_NO_CHANGE = 1e-6  #: Amplitude deficit that counts as none: a micrometre in a wave of one metre.

#: Depths in the amplitude table: the least one [m], their ratio, and the deepest one times the first wavenumber.
_LEAST_DEPTH, _DEPTH_RATIO, _DEEPEST = 1e-4, 1.05, 10.0

#: Sharpness of smooth minima: 1 % from the smaller of two values that differ by 1.35, 9 % from equal ones.
_SHARPNESS = 8.0

#: Distance of points between which the changes of long waves are interpolated [m].
_LATTICE = 0.25

#: Wavenumbers in the integral for the elevation variance, and the least of the largest one [rad/m].
_NODES, _SHORTEST = 600, 100.0


@dataclass(frozen=True)
class BottomDepths:
    """Depth of the bottom below the mean sea level at places on a sea."""

    least: float  #: Least depth anywhere [m], negative for land.
    #: Depths [m], shape (len(y), len(x)), negative over land, on grid lines x and y [m].
    sample: Callable[[FloatArray, FloatArray], FloatArray]

    def seen_from(self, origin: FloatArray) -> BottomDepths:
        """Return the depths in coordinates in which the origin of these lies at a place (x, y) [m]."""
        return BottomDepths(self.least, lambda x, y: self.sample(x - origin[0], y - origin[1]))


def is_limited(state: SeaState, depths: BottomDepths) -> bool:
    """Return whether waves as over deep water would be higher than `HEIGHT_PER_DEPTH` allows somewhere."""
    return 4 * math.sqrt(state.elevation_variance()) > HEIGHT_PER_DEPTH * depths.least


def band_wavenumbers(state: SeaState, shortest_wave: float) -> FloatArray:
    """Return the wavenumbers [rad/m] of wind wave bands, half an octave apart, up to a shortest wave [m].

    Waves of a metre and less are one band. A sea with swell alone has one band.
    """
    first = state.components[0]
    if not isinstance(first, CosineSpectrum) or not math.isfinite(first.peak_wavenumber):
        return np.ones(1)
    low = _FIRST_BAND * first.peak_wavenumber
    high = max(min(2 * math.pi / shortest_wave, _LAST_BAND), first.peak_wavenumber)
    return np.geomspace(low, high, 1 + math.ceil(math.log(high / low) / math.log(_BAND)))


@dataclass(frozen=True, eq=False)
class DepthResponse:
    """Band amplitudes at each depth, relative to deep water.

    Wind waves with the wavenumber k have the TMA spectrum for the depth d_e (`wind_spectra.ShallowSpectrum`): the
    amplitude factor (S(k; d_e)/S(k))^(1/2). At constant frequency this is Kitaigorodskii's variance factor
    tanh(kd)^2/(1 + 2kd/sinh(2kd)). Its form in wavenumbers fits waves that are realised by wavenumber: it keeps the
    saturated tail, so that depth takes long waves away and leaves the slopes of short ones. Swell keeps its significant
    height until this exceeds half of d_e.

    The effective depth d_e is the depth d or, if less, the depth at which the significant height of all waves is d/2.
    Where waves break, the longest ones are missing, as in a shallower sea. Both limits are smooth minima (a^-8 +
    b^-8)^(-1/8). All amplitudes are 0 at d = 0 and over land.
    """

    depth: FloatArray  #: Increasing depths [m], the first 0, shape (n,).
    amplitude: FloatArray  #: Amplitude factors [1], shape (bands, n): wind waves by wavenumber, then swell.
    top: int  #: Band number of the shortest wind waves.
    #: Share by which the largest height lessens the effective depth [1], 0 in deep water to 1 at the shore, shape (n,)
    broken: FloatArray

    @classmethod
    def of_state(cls, state: SeaState, wavenumbers: FloatArray) -> DepthResponse:
        """Return the response of waves over deep water, whose wind waves have bands by `band_wavenumbers`."""
        wind = state.components[0] if isinstance(state.components[0], CosineSpectrum) else None
        swell = sum(each.elevation_variance() for each in state.components if isinstance(each, SwellSpectrum))
        deepest = max(_DEEPEST / wavenumbers[0], 100 * math.sqrt(state.elevation_variance()))
        count = math.ceil(math.log(deepest / _LEAST_DEPTH) / math.log(_DEPTH_RATIO))
        effective = np.geomspace(_LEAST_DEPTH, deepest, count)
        variance = np.zeros(count)
        rows = []
        if wind is not None:
            k = np.geomspace(wavenumbers[0] / 2, max(_SHORTEST, 20 * wavenumbers[-1]), _NODES)
            density = wind.omnidirectional(k) * k * math.log(k[1] / k[0])
            rows = list(np.transpose([_factor(wind, wavenumbers, depth) for depth in effective]))
            # As the bands have them, the shorter waves as well.
            factors = (np.interp(np.log(k), np.log(wavenumbers), row) for row in np.transpose(rows))
            variance = np.array([float(density @ factor**2) for factor in factors])
        if swell > 0:
            share = _smooth_minimum(1.0, HEIGHT_PER_DEPTH * effective / (4 * math.sqrt(swell)))
            variance, rows = variance + swell * share**2, [*rows, share]
        # The depth at which waves of an effective depth reach their largest height.
        reached = np.maximum.accumulate(4 * np.sqrt(variance) / HEIGHT_PER_DEPTH)
        capped = np.interp(effective, reached, effective, right=np.inf)
        used = _smooth_minimum(effective, np.maximum(capped, 1e-3 * _LEAST_DEPTH))
        amplitude = np.array([np.interp(used, effective, row, left=0.0) for row in rows])
        amplitude[amplitude > 1 - _NO_CHANGE] = 1.0
        broken = np.insert(1 - used / effective, 0, 1.0)
        return cls(np.append(0.0, effective), np.insert(amplitude, 0, 0.0, axis=1), len(wavenumbers) - 1, broken)


def _factor(wind: CosineSpectrum, k: FloatArray, depth: float) -> FloatArray:
    """Return the amplitude factor of wind waves with wavenumbers k [rad/m] over a depth [m]."""
    own = wind.spectrum if isinstance(wind, MatchedSpectrum) else wind
    deep = own.omnidirectional(k)
    shallow = ShallowSpectrum(own, depth).omnidirectional(k)
    return np.sqrt(np.divide(shallow, deep, out=np.zeros_like(deep), where=deep > 0))


def _smooth_minimum(one: ArrayLike, other: ArrayLike) -> FloatArray:
    """Return the smooth minimum of positive numbers, which may be infinite."""
    a, b = np.asarray(one, dtype=np.float64), np.asarray(other, dtype=np.float64)
    low, high = np.minimum(a, b), np.maximum(a, b)
    return np.asarray(low * (1 + (low / high) ** _SHARPNESS) ** (-1 / _SHARPNESS))


@dataclass(frozen=True, eq=False)
class ShoalingHeights:
    """Wave elevations that depend on the local depth."""

    waves: PeriodicHeights  #: The waves as over deep water, with their bands.
    response: DepthResponse
    depths: BottomDepths

    @property
    def cells(self) -> int:
        """Cells per period, see `PeriodicHeights`."""
        return self.waves.cells

    @property
    def cell_size(self) -> float:
        """Grid spacing for the longest waves [m]."""
        return self.waves.cell_size

    def broken(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the share of breaking on grid lines x and y [m], shape (len(y), len(x)), 0 over land."""
        depth = self.depths.sample(x, y)
        share = np.interp(depth, self.response.depth, self.response.broken)
        return np.where(depth > 0, share, 0.0)

    def sample(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return elevations [m] on grid lines x and y [m], shape (len(y), len(x)); see `HeightGrid.sample`.

        With band amplitudes a, this is a_top times all waves, plus (a - a_top) times each band. Bands over which the
        depth has no effect cost no time, and leave the heights unchanged. Where a_top does not change, the bands'
        waves are long: close lines have them by interpolation between points `_LATTICE` apart.
        """
        # Patches beside each other have the same points.
        if (np.ptp(x) / _LATTICE + 4) * (np.ptp(y) / _LATTICE + 4) < y.size * x.shape[-1]:
            lattice = Interpolation.of_lattice(_LATTICE, x, y)
            columns, rows = (np.arange(each.min(), each.max() + 1) for each in (lattice.columns, lattice.rows))
            change, more = self._changes(columns * _LATTICE, rows * _LATTICE)
            if isinstance(change, float):
                more = more[lattice.rows[..., None] - rows[0], lattice.columns[..., None, :] - columns[0]]
                return np.asarray(self.waves.sample(x, y) * change + lattice.between(more))
        change, more = self._changes(x, y)
        return np.asarray(self.waves.sample(x, y) * change + more)

    def _changes(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray | float, FloatArray]:
        """Return the amplitude of the shortest waves, one number where it is constant, and what bands add [m]."""
        table, top = self.response.amplitude, self.response.top
        place = np.interp(self.depths.sample(x, y), self.response.depth, np.arange(table.shape[1]))
        index = np.minimum(place.astype(np.intp), table.shape[1] - 2)
        used = np.arange(index.min(), index.max() + 2)

        def at(row: FloatArray) -> FloatArray | float:
            if np.ptp(row[used]) == 0:
                return float(row[used[0]])
            return np.asarray(row[index] + (row[index + 1] - row[index]) * (place - index))

        heights = np.zeros(place.shape)
        bands = [(number, band) for number, band in self.waves.bands if np.any(table[number, used] != table[top, used])]
        for period in dict.fromkeys(band.period for _, band in bands):
            numbers, own = zip(*((number, band) for number, band in bands if band.period == period), strict=True)
            grid = Interpolation.of_waves(max(band.reach for band in own), period, x, y)
            waves, excess = np.array([band.at_points(grid) for band in own]), table[list(numbers)] - table[top]
            if used.size <= len(own):
                # All bands together at each depth of the table, between which amplitudes are linear.
                for depth in used:
                    share = np.maximum(1 - np.abs(place - depth), 0)
                    heights += share * grid.between(np.tensordot(excess[:, depth], waves, 1))
            else:
                for row, one in zip(excess, waves, strict=True):
                    heights += at(row) * grid.between(one)
        return at(table[top]), heights


def limited_wake(
    wake: Callable[[FloatArray, FloatArray], FloatArray], depths: BottomDepths
) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Return a wake whose heights stay within a quarter of the local depth, smoothly, and are 0 over land."""

    def limited(x: FloatArray, y: FloatArray) -> FloatArray:
        bound = np.maximum(0.5 * HEIGHT_PER_DEPTH * depths.sample(x, y), 1e-12)
        return np.asarray(bound * np.tanh(wake(x, y) / bound))

    return limited


def waves_of_time(
    given: tuple[SeaState, float, float, int],
    motion: Motion,
    rest: tuple[float, FloatArray | None],
    bottom: tuple[DepthResponse, BottomDepths] | None,
    time: float,
) -> PeriodicHeights | ShoalingHeights:
    """Return the waves of `realise_heights`, whose parameters are given, at a time [s], maybe over a bottom."""
    waves = realise_heights(*given, replace(motion, time=time), None, *rest)[0]
    return waves if bottom is None else ShoalingHeights(waves, *bottom)
