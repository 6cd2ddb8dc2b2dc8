"""Waves over a shallow bottom: the TMA spectrum of each depth, at most half of it high, and flat at the water line."""

import numpy as np
import pytest
from significance import assert_equal, mean_and_error

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.sea import OCEAN_SURFACE
from mitransient_lidar.physics.sea.sea_surface import SeaSurface, followed_depths
from mitransient_lidar.physics.sea.shoaling import BottomDepths, DepthResponse, band_wavenumbers
from mitransient_lidar.physics.sea.wave_spectrum import SeaState
from mitransient_lidar.physics.sea.wind_spectra import ElfouhailySpectrum, SwellSpectrum

SEEDS = range(16)
#: Total slope variances of the spectrum itself: no waves are scaled to measured ones.
SPECTRUM = {"slope_variance": "spectrum", "cell_size": 0.25, "shortest_wave": 1.0}


def over(depths, **parameters):
    read = OCEAN_SURFACE.reader(parameters.get)
    return SeaSurface.read(read, depths=followed_depths(read, depths))


def level(depth):
    return BottomDepths(depth, lambda x, y: np.full((len(y), len(x)), float(depth)))


def beach(slope=0.05):
    """Return a bottom that rises along x through the sea at x = 0."""
    return BottomDepths(-10.0, lambda x, y: np.broadcast_to(-slope * x, (len(y), len(x))).copy())


def shallow_spectrum(wind, k, depth):
    """Return S(k) [m^3] by frequencies: Kitaigorodskii's factor times the deep waves of the same frequency."""
    tanh = np.tanh(k * depth)
    ratio = 1 + 2 * k * depth / np.sinh(2 * k * depth)
    factor = tanh**2 / ratio
    # dk/d omega in deep water over that in shallow water.
    return factor * ElfouhailySpectrum(wind).omnidirectional(k * tanh) * tanh * ratio


@pytest.mark.slow
@pytest.mark.parametrize("depth", [1.0, 3.0])
def test_spectrum_is_the_deep_one_times_the_factor_of_the_depth(depth):
    """Variance in rings of wavenumber, each wave of which is one random number of a seed."""
    wind, period, cell = 6.0, 96.0, 0.5
    cells = round(period / cell)
    x = (np.arange(cells) - cells // 2) * cell
    index = np.fft.fftfreq(cells, 1 / cells)
    k = 2 * np.pi / period * np.hypot(index[:, None], index)
    edges = 2 * np.pi / np.array([40.0, 24.0, 16.0, 10.0, 7.0, 5.0, 3.5, 2.5])
    ring = np.digitize(k, edges)
    found, deep = [], []
    for seed in SEEDS:
        given = {"wind_speed": wind, **SPECTRUM, "cell_size": cell, "surface_seed": seed, "period": period}
        for seas, bottom in ((found, "bottom"), (deep, "none")):
            heights = over(level(depth), **given, shoaling=bottom).heights(x, x)
            power = np.abs(np.fft.fft2(heights) / cells**2) ** 2
            seas.append(np.bincount(ring.ravel(), power.ravel())[1 : len(edges)])
    mean = np.where(k > 0, shallow_spectrum(wind, np.where(k > 0, k, 1), depth) / np.where(k > 0, k, 1), 0) / (
        2 * np.pi
    )
    expected = np.bincount(ring.ravel(), (mean * (2 * np.pi / period) ** 2).ravel())[1 : len(edges)]
    # Between the wavenumbers of two bands amplitudes are interpolated: at the front of the spectrum most is missing.
    main = expected > 0.02 * expected.sum()
    assert main.sum() >= 4
    assert_equal(np.array(found)[:, main], expected[main], error=0.05, bias=0.04)
    # The same waves without the depth are others.
    assert np.mean(deep, axis=0).sum() > 1.3 * expected.sum()


@pytest.mark.slow
@pytest.mark.parametrize("swell", [0.0, 2.0])
def test_heights_end_at_half_of_the_depth_and_at_the_water_line(swell):
    swell = {"swell_height": swell, "swell_wavelength": 60.0}
    x = np.arange(-200.0, 20.0, 0.25)
    y = np.arange(-100.0, 100.0, 4.0)
    depth = np.maximum(-0.05 * x, 0)
    parts = [(depth > low) & (depth <= high) for low, high in ((5.0, 10.0), (0.3, 1.0), (0.05, 0.2))]
    means, shares = [], []
    for seed in SEEDS:
        sea = over(beach(), wind_speed=10.0, **SPECTRUM, **swell, surface_seed=seed)
        heights = sea.heights(x, y)
        assert not np.any(heights[:, x >= 0])
        assert np.all(heights >= -depth)
        means.append([heights[:, part].mean() for part in parts])
        # Variance over the largest one.
        shares.append([np.mean((heights[:, part] / (depth[part] / 8)) ** 2) for part in parts])
    assert_equal(np.array(means) + 1, np.ones(3), error=0.05)
    share, error = mean_and_error(shares)
    assert np.all(share - 6 * error < 1)
    # Shallow waves are as high as they may be; of waves on 5 to 20 cm some are ripples.
    assert share[1] + 6 * error[1] > 0.9
    assert share[2] > 0.5


def test_significant_heights_of_all_depths():
    """At most half of the depth, for waves of any wind with swell; what is allowed is used; amplitudes are smooth."""
    for wind in (3.0, 8.0, 15.0):
        for swell in ((), (SwellSpectrum(1.5, 80.0),)):
            state = SeaState((ElfouhailySpectrum(wind), *swell))
            bands = band_wavenumbers(state, 0.3)
            response = DepthResponse.of_state(state, bands)
            k, weight = state.components[0].quadrature()
            density = state.components[0].omnidirectional(k) * weight
            rows = response.amplitude[: len(bands)]
            variance = [density @ np.interp(np.log(k), np.log(bands), row) ** 2 for row in rows.T]
            if swell:
                variance = variance + swell[0].elevation_variance() * response.amplitude[-1] ** 2
            ratio = 4 * np.sqrt(variance[1:]) / response.depth[1:]
            assert 0.45 < ratio.max() < 0.505
            assert np.all(response.amplitude[:, -1] == 1)
            assert np.abs(np.diff(response.amplitude, axis=1)).max() < 0.1


def test_one_factor_for_all_waves_would_flatten_the_short_ones():
    """Slopes of waves of metres stay where the heights of long ones have gone."""
    x = np.arange(0.0, 288.0, 0.5)
    heights = [over(level(1.0), wind_speed=10.0, **SPECTRUM, shoaling=one).heights(x, x) for one in ("bottom", "none")]
    height, slope = (
        np.mean(change(heights[0]) ** 2) / np.mean(change(heights[1]) ** 2) for change in (np.asarray, np.diff)
    )
    assert height < 0.06
    assert slope > 0.4


def test_deep_waters_keep_their_bits():
    """Those of no bottom, and patches of deep water in a scene with a shore."""
    x, y = np.arange(-960.0, -900.0, 0.25), np.arange(-30.0, 30.0, 0.25)
    same = over(None, wind_speed=3.0, **SPECTRUM)
    for depths, shoaling in ((level(8.0), "auto"), (level(0.3), "none"), (beach(0.5), "auto"), (beach(0.5), "bottom")):
        sea = over(depths, wind_speed=3.0, **SPECTRUM, shoaling=shoaling)
        np.testing.assert_array_equal(sea.heights(x, y), same.heights(x, y))
        assert sea.ripple_variance == same.ripple_variance
        np.testing.assert_array_equal(sea.at(3.0).heights(x, y), same.at(3.0).heights(x, y))
    limited = over(level(0.3), wind_speed=3.0, **SPECTRUM)
    assert np.std(limited.heights(x, y)) < 0.6 * np.std(same.heights(x, y))
    # A given water_depth already shoals all waves.
    given = over(level(0.3), wind_speed=3.0, **SPECTRUM, water_depth=20.0)
    np.testing.assert_array_equal(
        given.heights(x, y), over(None, wind_speed=3.0, **SPECTRUM, water_depth=20.0).heights(x, y)
    )


def test_wakes_stay_within_a_quarter_of_the_depth():
    x, y = np.arange(-80.0, -2.0, 0.25), np.arange(-40.0, 40.0, 0.5)
    ship = {"wind_speed": 0.0, "spectrum": "elfouhaily", "wake_speed": 6.0, "wake_x": -2.0, "cell_size": 0.25}
    free = over(beach(0.02), **ship, shoaling="none").heights(x, y)
    bound = over(beach(0.02), **ship, shoaling="bottom").heights(x, y)
    assert np.any(np.abs(free) > 0.02 / 4 * np.abs(x))
    assert np.all(np.abs(bound) <= 0.02 / 4 * np.abs(x))


@pytest.mark.parametrize(("spectrum", "more"), [("flat", {}), ("height_map", {"filename": "sea.npy"})])
def test_following_the_bottom_needs_a_spectrum(spectrum, more):
    with pytest.raises(UserError, match="shoaling = 'bottom' needs a spectrum of waves"):
        over(level(1.0), spectrum=spectrum, **more, shoaling="bottom")


@pytest.mark.parametrize("slope", [0.001, 0.2])
def test_bands_together_are_those_one_by_one(slope):
    """Between few depths of the table, bands are added before they are interpolated; over many each is on its own."""
    sea = over(beach(slope), wind_speed=8.0, shoaling="bottom", **SPECTRUM)
    x = -0.5 / slope + np.arange(-8, 8) * 0.25
    response, depth = sea.waves.response, beach(slope).sample(x, x)
    amplitude = [np.interp(depth, response.depth, row) for row in response.amplitude]
    expected = sea.waves.waves.sample(x, x) * amplitude[response.top]
    for number, band in sea.waves.waves.bands:
        expected += (amplitude[number] - amplitude[response.top]) * band.sample(x, x)
    np.testing.assert_allclose(sea.heights(x, x), expected, atol=1e-6)


def test_long_waves_of_close_lines_are_those_of_coarse_ones():
    """Patches of close lines, which interpolate what depth changes, against lines too far apart for it."""
    slope = BottomDepths(-10.0, lambda x, y: -0.05 * x[..., None, :] + 0 * y[..., None])
    sea = over(slope, wind_speed=6.0, **{**SPECTRUM, "cell_size": 0.05})
    first = np.array([[-120.0, 3.0], [-118.0, 4.0], [-60.0, -10.0]])
    lines = first[..., None] + sea.cell_size * np.arange(80)
    found = sea.heights(lines[:, 0], lines[:, 1])
    for heights, (x, y) in zip(found, lines, strict=True):
        # The ends and the middle, between which the points of an interpolation would be more than the lines.
        far = [0, 39, 79]
        np.testing.assert_allclose(heights[np.ix_(far, far)], sea.heights(x[far], y[far]), atol=1e-5)
    assert np.std(found) > 0.05
