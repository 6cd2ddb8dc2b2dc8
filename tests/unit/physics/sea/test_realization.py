"""Seas as realisations of a spectrum: patches, bands and periods."""

import numpy as np
import pytest
from frequencies import assert_uniform
from oracles.wave_spectra import directional, mesh_slope_variance, realise
from rows import each_row
from scipy import stats
from significance import largest_z

from mitransient_lidar.physics.sea.cox_munk import cox_munk
from mitransient_lidar.physics.sea.realization import Band, Motion, angular_frequency, realise_heights
from mitransient_lidar.physics.sea.wave_spectrum import MatchedSpectrum, SeaState
from mitransient_lidar.physics.sea.wind_spectra import (
    ElfouhailySpectrum,
    JonswapSpectrum,
    PiersonMoskowitzSpectrum,
    SwellSpectrum,
)

SPECTRA = {
    "elfouhaily": ElfouhailySpectrum(6, direction=0.3),
    "pierson_moskowitz": PiersonMoskowitzSpectrum(4, direction=2.0),
    "jonswap": JonswapSpectrum(5, 3000, direction=-1.0),
    "swell": SwellSpectrum(0.5, 8, 0.5),
    "matched": MatchedSpectrum(ElfouhailySpectrum(3, direction=1.0), *cox_munk(3)),
    "sea": SeaState((ElfouhailySpectrum(3, direction=0.3), SwellSpectrum(0.5, 8, 1.9))),
}


def fourier(heights):
    """Return the complex amplitudes of all waves, row and column 0 those of the longest against the axes."""
    return np.fft.fftshift(np.fft.fft2(np.fft.ifftshift(heights))) / heights.size


def wavenumbers(period, cells):
    """Return kx and ky of `fourier`'s amplitudes, for broadcasting."""
    k = 2 * np.pi / period * np.arange(-cells // 2, cells // 2)
    return k, k[:, None]


def test_realised_waves_have_the_variances_of_their_kind():
    """Waves along the axes too: without the mirrored column those of kx = 0 would have half their variance."""
    period, cells, seeds = 40.0, 32, 50
    for spectrum in (SPECTRA["elfouhaily"], SPECTRA["sea"]):
        index = np.arange(-cells // 2, cells // 2)
        variances = spectrum.mode_variances(index, index, 2 * np.pi / period)
        scaled = np.array([fourier(realise(spectrum, period, cells, seed, 5.0)) for seed in range(seeds)])
        scaled = scaled[:, 1:, 1:] / np.sqrt(np.where(variances > 0, variances, 1.0)[1:, 1:])
        half = cells // 2
        rows = {
            "kx = 0": scaled[:, half:, half - 1],
            "ky = 0": scaled[:, half - 1, half:],
            "other": scaled[:, :, half:],
        }
        for name, amplitudes in rows.items():
            # Mean square 1 with standard error 1/sqrt(n); the mean of squares, 0, shows phases that prefer an angle.
            error = 1 / np.sqrt(amplitudes.size)
            limit = largest_z(amplitudes.size, 3) * error
            assert abs(np.mean(np.abs(amplitudes) ** 2) - 1) < limit, name
            assert abs(np.mean(amplitudes**2)) < np.sqrt(2) * limit, name
            assert abs(np.mean(amplitudes)) < limit, name


@each_row((0.0, np.inf, (0, 0)), (7.3, 3.0, (0.4, -0.2)))
@each_row(*SPECTRA)
def test_coarse_realisation_is_the_low_passed_fine_one(kind, time, depth, current):
    options = {"time": time, "depth": depth, "current": current}
    fine, coarse = (realise(SPECTRA[kind], 40, cells, 9, **options) for cells in (128, 32))
    low = fourier(fine)[48:80, 48:80].copy()
    low[0, :] = low[:, 0] = 0
    kept = np.fft.fftshift(np.fft.ifft2(np.fft.ifftshift(low)).real) * 32**2
    np.testing.assert_allclose(coarse, kept, atol=1e-13)
    # The origin is vertex (cells/2, cells/2) of both.
    assert abs(coarse[16, 16] - kept[16, 16]) < 1e-13 < abs(coarse[16, 16] - kept[0, 0])
    assert abs(fine.mean()) < 1e-14


def test_seeds_differ_and_repeat():
    spectrum = ElfouhailySpectrum(6)
    first = realise(spectrum, 40, 32, 1)
    np.testing.assert_array_equal(first, realise(spectrum, 40, 32, 1))
    other = realise(spectrum, 40, 32, 2)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.6
    assert np.isfinite(realise(spectrum, 40, 32, -5)).all()
    # Fixed values: stored scenes must give the same sea in later versions.
    np.testing.assert_allclose(first[16, 15:18], [0.188771089, 0.184545047, 0.199352481], atol=1e-9)


def test_components_of_a_sea_have_independent_waves():
    wind = ElfouhailySpectrum(6, direction=0.3)
    alone = realise(wind, 40, 64, 3)
    np.testing.assert_allclose(realise(SeaState((wind,)), 40, 64, 3), alone, atol=1e-14)
    second = realise(SeaState((wind, wind)), 40, 64, 3) - alone
    third = realise(SeaState((wind, wind, wind)), 40, 64, 3) - alone - second
    k = wavenumbers(40, 64)
    scale = np.sqrt(np.maximum(directional(wind, *k), 1e-300)) * 2 * np.pi / 40
    parts = [(fourier(part) / scale)[1:, 33:] for part in (alone, second, third)]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        # |a|^2 is exponential: products of independent amplitudes have standard error 1/sqrt(n).
        n = parts[a].size
        assert abs(np.mean(parts[a] * parts[b].conj())) < 4 / np.sqrt(n)
        assert abs(np.mean(parts[a] * parts[b])) < 4 / np.sqrt(n)
        assert np.mean(np.abs(parts[b]) ** 2) == pytest.approx(1, abs=4 / np.sqrt(n))
    # Nor is the second component the first, with columns or rows exchanged.
    first = fourier(realise(SwellSpectrum(0.5, 8, 0.0), 40, 64, 3))
    assert np.unique(np.round(np.abs(np.r_[first.ravel(), fourier(second).ravel()]), 15)).size > 64 * 32


@pytest.mark.parametrize("depth", [np.inf, 2.0])
def test_every_wave_travels_towards_the_half_plane_of_its_direction(depth):
    """The sign of the phase change of each wave between two times is that of -k . direction."""
    direction = 2.2
    spectrum = ElfouhailySpectrum(6, direction=direction)
    before, after = (fourier(realise(spectrum, 40, 32, 4, time, depth=depth)) for time in (0.0, 0.1))
    kx, ky = wavenumbers(40, 32)
    turned = np.angle((after / np.where(before == 0, 1, before))[1:, 1:])
    along = (np.cos(direction) * kx + np.sin(direction) * ky)[1:, 1:]
    expected = -np.sign(along) * angular_frequency(np.hypot(kx, ky)[1:, 1:], depth) * 0.1
    np.testing.assert_allclose(np.where(along == 0, 0, turned), expected, atol=1e-6)


@pytest.mark.parametrize("kind", ["elfouhaily", "sea"])
def test_current_carries_the_sea_along(kind):
    still = realise(SPECTRA[kind], 64, 64, 3, 4.0)
    carried = realise(SPECTRA[kind], 64, 64, 3, 4.0, current=(1.0, -0.5))
    # 4 s at 1 m/s are 4 cells along x, and 2 cells against y.
    np.testing.assert_allclose(carried, np.roll(still, (-2, 4), (0, 1)), atol=1e-12)


def test_the_longest_waves_of_a_wide_patch_have_no_negative_variance():
    """Far below the peak Delta rounds to 1, and the density across the wind to either side of 0."""
    assert np.all(np.isfinite(realise(ElfouhailySpectrum(3), 2700, 128, 1)))


def test_facet_slopes_have_the_predicted_variance():
    size, n, wind_direction = 8.0, 32, 0.6
    spectrum = ElfouhailySpectrum(6, direction=wind_direction)
    d = size / n
    cos, sin = np.cos(wind_direction), np.sin(wind_direction)
    measured = []
    for seed in range(1000):
        h = realise(spectrum, size, n, seed)
        sx, sy = (np.roll(h, -1, 1) - h) / d, (np.roll(h, -1, 0) - h) / d
        upwind = crosswind = 0.0
        # Triangles with the right angle at (i, j) and at (i + 1, j + 1)
        for a, b in ((sx, sy), (np.roll(sx, -1, 0), np.roll(sy, -1, 1))):
            upwind += 0.5 * np.mean((cos * a + sin * b) ** 2)
            crosswind += 0.5 * np.mean((cos * b - sin * a) ** 2)
        measured.append((upwind, crosswind))
    measured = np.array(measured)
    expected = mesh_slope_variance(spectrum, size, n)
    error = measured.std(axis=0) / np.sqrt(len(measured))
    np.testing.assert_array_less(np.abs(measured.mean(axis=0) - expected), largest_z(1000, 2) * error)
    # Without the facets' low-pass the crosswind prediction would be a sixth higher.
    k = 2 * np.pi / size * np.arange(-n // 2 + 1, n // 2)
    across = cos * k[:, None] - sin * k
    unfiltered = np.sum(directional(spectrum, k, k[:, None]) * across**2) * (2 * np.pi / size) ** 2
    assert unfiltered - expected[1] > 8 * error[1]


def single_wave(wavelength, direction):
    """Return swell that is one wave of a period of 64 m."""
    return SwellSpectrum(0.5, wavelength, direction, relative_bandwidth=1e-3, directional_spread=1e-3)


G = 9.81


def test_angular_frequency_in_its_limits():
    assert angular_frequency(0.1) ** 2 == pytest.approx(G * 0.1, rel=1e-6)
    # The slowest wave has 23 cm/s at 370 rad/m: slower than its neighbours.
    speeds = angular_frequency([365.0, 370.0, 375.0]) / [365.0, 370.0, 375.0]
    assert speeds[1] == pytest.approx(np.sqrt(2 * G / 370))
    assert speeds[1] == pytest.approx(0.23, abs=1e-3)
    assert speeds[1] < min(speeds[0], speeds[2])
    # Ripples of 1 mm: surface tension of clean water, 0.0728 N/m
    assert angular_frequency(6283.0) ** 2 == pytest.approx(0.0728e-3 * 6283.0**3, rel=0.03)
    # Shallow: all waves travel at sqrt(g h)
    assert angular_frequency(0.001, depth=2.0) / 0.001 == pytest.approx(np.sqrt(G * 2), rel=1e-5)
    assert angular_frequency(0.5, depth=2.0) ** 2 == pytest.approx(G * 0.5 * np.tanh(1.0), rel=1e-5)
    assert angular_frequency(0.0) == angular_frequency(0.0, 3.0) == 0
    np.testing.assert_array_equal(angular_frequency([[0.1, 2.0]], 1e4), angular_frequency([[0.1, 2.0]]))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["elfouhaily", "single"])
def test_slopes_are_gaussian(kind):
    """One slope of each of 2000 seas. With fixed amplitudes, a single wave would have an arcsine distribution."""
    if kind == "single":
        spectrum, period, cells = single_wave(16.0, 0.0), 64.0, 16
    else:
        spectrum, period, cells = ElfouhailySpectrum(4, direction=0.5), 16.0, 16
    step, slopes = period / cells, []
    for seed in range(2000):
        heights = realise(spectrum, period, cells, seed, 1.0)
        slopes.append((heights[8, 9] - heights[8, 7]) / (2 * step))
    index = np.arange(-cells // 2 + 1, cells // 2)
    dk = 2 * np.pi / period
    # A central difference has the transfer sin(kx d)/d.
    variance = np.sum(spectrum.mode_variances(index, index, dk) * (np.sin(index * dk * step) / step) ** 2)
    assert_uniform(stats.norm.cdf(np.array(slopes) / np.sqrt(variance)))


STILL = Motion(0.0, 1e4, (0.0, 0.0))
SEA = MatchedSpectrum(ElfouhailySpectrum(6.0), *cox_munk(6.0))


@pytest.mark.parametrize(("period", "cell"), [(128.0, 0.06), (512.0, 0.2)])
def test_bands_resolve_the_slope_variance_of_one_fine_grid(period, cell):
    """A gap or an overlap between the bands is a factor e in wavenumber: several per cent of the variance."""
    waves, found, variance = realise_heights(SEA, period, cell, 1, STILL, 0.0)
    assert len(waves.parts) > 1
    assert found <= cell
    # One grid of the same cells over the shortest period that still holds the long waves to 1 %.
    cells = 2 * round(0.5 * 96.0 / found)
    np.testing.assert_allclose(variance, mesh_slope_variance(SEA, cells * found, cells, 0.0), rtol=0.01)


@pytest.mark.slow
def test_long_waves_are_those_of_a_coarse_sea():
    """Averaged over half a metre, a fine sea is the coarse one with the same seed; another seed is another sea."""
    fine, cell, _ = realise_heights(SEA, 64.0, 0.03, 3, STILL, 0.0)
    assert len(fine.parts) > 1
    lines = 0.5 * np.arange(-20, 20)
    inner = cell * np.arange(-8, 9)
    averaged = np.zeros((40, 40))
    for dx in inner[::4]:
        for dy in inner[::4]:
            averaged += fine.sample(lines + dx, lines + dy) / 25
    for seed, low, high in ((3, 0.99, 1.0), (4, -0.6, 0.6)):
        coarse, spacing, _ = realise_heights(SEA, 64.0, 0.25, seed, STILL, 0.0)
        assert len(coarse.parts) == 1
        assert spacing == 0.25
        assert low < np.corrcoef(averaged.ravel(), coarse.sample(lines, lines).ravel())[0, 1] < high


def test_sea_of_bands_repeats_after_its_period():
    waves, cell, _ = realise_heights(SEA, 128.0, 0.06, 1, STILL, 0.0)
    lines = cell * np.arange(50)
    period = round(128.0 / cell) * cell
    assert period == pytest.approx(128.0, abs=1e-9)
    np.testing.assert_allclose(waves.sample(lines, lines), waves.sample(lines + period, lines - period), atol=2e-6)


@pytest.mark.slow
def test_waves_of_all_bands_move():
    """A current of 3 m/s carries a frozen sea: nearly the same after 0.01 s at a place 3 cm further on."""
    first, cell, _ = realise_heights(SEA, 64.0, 0.03, 1, STILL, 0.0)
    later = realise_heights(SEA, 64.0, 0.03, 1, Motion(cell / 3.0, 1e4, (3.0, 0.0)), 0.0)[0]
    lines = cell * np.arange(200)
    before, moved, kept = first.sample(lines, lines), later.sample(lines + cell, lines), later.sample(lines, lines)
    short = [np.diff(heights, 2, axis=1) for heights in (before, moved, kept)]
    assert np.std(short[1] - short[0]) < 0.6 * np.std(short[2] - short[0])


@pytest.mark.parametrize("reach", [20, 70])
@pytest.mark.parametrize("side", [0.3, 40.0])
def test_interpolated_waves_are_their_sum(reach, side):
    """On few close lines and on lines further apart than the period, against each wave on its own."""
    random = np.random.default_rng(reach)
    shape = (2 * reach + 1, reach + 1)
    waves = random.normal(size=shape) + 1j * random.normal(size=shape)
    x, y = (np.sort(random.uniform(-side, side, count)) + 7.0 for count in (9, 6))
    k = 2 * np.pi / 16.0 * np.arange(-reach, reach + 1)
    twice = np.where(np.arange(reach + 1) > 0, 2.0, 1.0)
    expected = (np.exp(1j * np.outer(y, k)) @ (twice * waves) @ np.exp(1j * np.outer(k[reach:], x))).real
    np.testing.assert_allclose(Band(waves, 16.0).sample(x, y), expected, atol=1e-5 * expected.std())
