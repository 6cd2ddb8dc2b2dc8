"""Seas of several grids: the same long waves, and the slope variance of the spectrum."""

import numpy as np
import pytest
from oracles.wave_spectra import mesh_slope_variance

from mitransient_lidar.physics.sea.cox_munk import cox_munk
from mitransient_lidar.physics.sea.realization import Band, Motion, realise_heights
from mitransient_lidar.physics.sea.wave_spectrum import MatchedSpectrum
from mitransient_lidar.physics.sea.wind_spectra import ElfouhailySpectrum

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
