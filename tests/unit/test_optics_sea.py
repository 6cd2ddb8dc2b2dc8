import numpy as np
import pytest
from scipy.integrate import trapezoid

from mitransient_lidar.optics.sea import (
    ElfouhailySpectrum,
    cox_munk,
    mesh_slope_variance,
    realise,
    ripple_variance,
)


@pytest.mark.parametrize(("wind", "total"), [(3, 0.01836), (6, 0.03372), (10, 0.0542)])
def test_cox_munk_totals(wind, total):
    up, cross = cox_munk(wind)
    assert up == pytest.approx(3.16e-3 * wind)
    # The published total has its own regression, 0.003 + 5.12e-3 W.
    assert up + cross == pytest.approx(total, rel=0.01)


@pytest.mark.parametrize(
    ("wind", "height", "up", "cross"),
    [(3, 0.232, 0.01545, 0.00998), (6, 0.937, 0.02170, 0.01478), (10, 2.633, 0.03551, 0.02480)],
)
def test_elfouhaily_totals(wind, height, up, cross):
    spectrum = ElfouhailySpectrum(wind)
    assert spectrum.significant_wave_height() == pytest.approx(height, abs=5.1e-4)
    assert spectrum.slope_variance() == pytest.approx((up, cross), abs=1e-5)


@pytest.mark.parametrize(
    ("wind", "spacing", "up", "cross"),
    [
        (3, 0.05, 0.01235, 0.00749),
        (3, 0.25, 0.00816, 0.00416),
        (3, 1.00, 0.00396, 0.00150),
        (6, 0.10, 0.01419, 0.00896),
        (6, 0.50, 0.01045, 0.00590),
        (10, 0.05, 0.01927, 0.01306),
        (10, 1.00, 0.01182, 0.00693),
    ],
)
def test_elfouhaily_cumulative_slopes(wind, spacing, up, cross):
    assert ElfouhailySpectrum(wind).slope_variance(np.pi / spacing) == pytest.approx((up, cross), abs=1e-5)


def test_directional_spectrum_integrates_to_elevation_and_slope_variance():
    spectrum = ElfouhailySpectrum(6)
    k = np.geomspace(0.02, 8000, 4000)[:, None]
    phi = np.arange(64) * 2 * np.pi / 64
    kx, ky = k * np.cos(phi), k * np.sin(phi)
    psi = spectrum.directional(kx, ky, wind_direction=0.7)
    variance = trapezoid((psi * k**2).mean(axis=1) * 2 * np.pi, np.log(k[:, 0]))
    assert 4 * np.sqrt(variance) == pytest.approx(0.937, abs=1e-3)
    along = np.cos(0.7) * kx + np.sin(0.7) * ky
    upwind = trapezoid((psi * along**2 * k**2).mean(axis=1) * 2 * np.pi, np.log(k[:, 0]))
    # A direction counted clockwise, or one that mistook up- for crosswind, gives 0.0148 to 0.019.
    assert upwind == pytest.approx(0.02170, abs=2e-5)


@pytest.mark.parametrize("wind", [1e-6, 0.5, 1.5, 30])
def test_extreme_winds_stay_finite_and_non_negative(wind):
    spectrum = ElfouhailySpectrum(wind, inverse_wave_age=2.0)
    s = spectrum.omnidirectional(np.geomspace(1e-4, 1e5, 500))
    assert np.all(np.isfinite(s))
    assert np.all(s >= 0)
    assert np.all(np.isfinite(realise(spectrum, 10, 16, 1)))


def test_no_wind_gives_a_flat_sea():
    spectrum = ElfouhailySpectrum(0)
    assert not realise(spectrum, 10, 32, 1).any()
    assert spectrum.slope_variance() == (0, 0)
    assert spectrum.significant_wave_height() == 0
    assert mesh_slope_variance(spectrum, 10, 32) == (0, 0)


def test_realised_elevation_variance():
    spectrum, size, n = ElfouhailySpectrum(5), 60.0, 64
    k = 2 * np.pi / size * np.arange(-n // 2 + 1, n // 2)
    expected = spectrum.directional(k, k[:, None], 0.4).sum() * (2 * np.pi / size) ** 2
    variances = np.array([realise(spectrum, size, n, seed, 0.4).var() for seed in range(200)])
    assert abs(variances.mean() - expected) < 4 * variances.std() / np.sqrt(variances.size)
    assert variances.std() / np.sqrt(variances.size) < 0.03 * expected


def test_coarse_realisation_is_the_low_passed_fine_one():
    spectrum = ElfouhailySpectrum(6)
    fine, coarse = realise(spectrum, 40, 128, 9, 0.3), realise(spectrum, 40, 32, 9, 0.3)
    f = np.fft.fftshift(np.fft.fft2(np.fft.ifftshift(fine))) / 128**2
    low = f[48:80, 48:80].copy()
    low[0, :] = low[:, 0] = 0
    kept = np.fft.fftshift(np.fft.ifft2(np.fft.ifftshift(low)).real) * 32**2
    np.testing.assert_allclose(coarse, kept, atol=1e-13)
    # The origin is vertex (resolution/2, resolution/2) of both.
    assert abs(coarse[16, 16] - kept[16, 16]) < 1e-13 < abs(coarse[16, 16] - kept[0, 0])


def test_seeds_differ_and_repeat():
    spectrum = ElfouhailySpectrum(6)
    first = realise(spectrum, 40, 32, 1)
    np.testing.assert_array_equal(first, realise(spectrum, 40, 32, 1))
    other = realise(spectrum, 40, 32, 2)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.6
    assert np.isfinite(realise(spectrum, 40, 32, -5)).all()
    # Values frozen on purpose: stored scenes must show the same sea in later versions.
    np.testing.assert_allclose(first[16, 15:18], [0.188771089, 0.184545047, 0.199352481], atol=1e-9)


def test_facet_slopes_have_the_predicted_variance():
    spectrum, size, n, wind_direction = ElfouhailySpectrum(6), 8.0, 32, 0.6
    d = size / n
    cos, sin = np.cos(wind_direction), np.sin(wind_direction)
    measured = []
    for seed in range(1000):
        h = realise(spectrum, size, n, seed, wind_direction)
        sx, sy = (np.roll(h, -1, 1) - h) / d, (np.roll(h, -1, 0) - h) / d
        upwind = crosswind = 0.0
        # Triangles with the right angle at (i, j) and at (i + 1, j + 1)
        for a, b in ((sx, sy), (np.roll(sx, -1, 0), np.roll(sy, -1, 1))):
            upwind += 0.5 * np.mean((cos * a + sin * b) ** 2)
            crosswind += 0.5 * np.mean((cos * b - sin * a) ** 2)
        measured.append((upwind, crosswind))
    measured = np.array(measured)
    expected = mesh_slope_variance(spectrum, size, n, wind_direction)
    error = measured.std(axis=0) / np.sqrt(len(measured))
    np.testing.assert_array_less(np.abs(measured.mean(axis=0) - expected), 4 * error)
    # Without the facets' low-pass the crosswind prediction would be a sixth higher: the test can tell.
    k = 2 * np.pi / size * np.arange(-n // 2 + 1, n // 2)
    across = cos * k[:, None] - sin * k
    unfiltered = np.sum(spectrum.directional(k, k[:, None], wind_direction) * across**2) * (2 * np.pi / size) ** 2
    assert unfiltered - expected[1] > 8 * error[1]


def test_ripples_complete_the_mesh():
    spectrum = ElfouhailySpectrum(10)
    resolved = mesh_slope_variance(spectrum, 64, 256)
    ripples = ripple_variance(spectrum, 64, 256)
    np.testing.assert_allclose(np.add(resolved, ripples), cox_munk(10), rtol=1e-12)
    ripples = ripple_variance(spectrum, 64, 256, total="spectrum")
    np.testing.assert_allclose(np.add(resolved, ripples), spectrum.slope_variance(), rtol=1e-12)
    # At 3 m/s a very fine mesh resolves more than Cox and Munk saw upwind.
    assert ripple_variance(ElfouhailySpectrum(3), 10, 512)[0] == 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ElfouhailySpectrum(31), "wind_speed = 31 must lie between 0 and 30"),
        (lambda: ElfouhailySpectrum(np.nan), "wind_speed = nan must be finite"),
        (lambda: ElfouhailySpectrum(5, 0.5), "inverse_wave_age = 0.5 must lie between 0.84 and 5"),
        (lambda: cox_munk(-1), "wind_speed = -1"),
        (lambda: realise(ElfouhailySpectrum(5), 10, 15, 1), "resolution = 15 must be an even"),
        (lambda: realise(ElfouhailySpectrum(5), -1, 16, 1), "size = -1"),
        (lambda: ripple_variance(ElfouhailySpectrum(5), 10, 16, total="all"), "total = 'all'"),
        (lambda: ElfouhailySpectrum(5).slope_variance(0), "k_max = 0"),
    ],
)
def test_bad_parameters_are_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call()
