"""Spectra of waves and slopes of the sea against their published totals and terms."""

from itertools import pairwise

import numpy as np
import pytest
from oracles.wave_spectra import directional, mesh_slope_variance
from rows import each_case, each_row, must_refuse
from scipy.integrate import quad, trapezoid
from scipy.special import exp1

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.sea.cox_munk import GramCharlierSeries, cox_munk
from mitransient_lidar.physics.sea.wave_spectrum import MatchedSpectrum, SeaState
from mitransient_lidar.physics.sea.wind_spectra import (
    ElfouhailySpectrum,
    JonswapSpectrum,
    PiersonMoskowitzSpectrum,
    ShallowSpectrum,
    SwellSpectrum,
    inverse_wave_age,
)

G = 9.81


def significant_wave_height(spectrum):
    """Return four standard deviations of the elevation [m]."""
    return 4 * np.sqrt(spectrum.elevation_variance())


def partial_slopes(spectrum, k_max):
    """Return the slope variances along and across of waves up to a wavenumber [rad/m], by adaptive quadrature."""
    ends = np.log([*(k for k in spectrum.smooth_ranges if k < k_max), k_max])

    def variance(sign):
        def density(u):
            share = 0.5 + sign * spectrum.spreading(np.exp(u)) / 4
            return np.exp(3 * u) * spectrum.omnidirectional(np.exp(u)) * share

        return sum(quad(density, low, high, epsrel=1e-8, limit=200)[0] for low, high in pairwise(ends))

    return variance(1), variance(-1)


SPECTRA = {
    "elfouhaily": ElfouhailySpectrum(6, direction=0.7),
    "pierson_moskowitz": PiersonMoskowitzSpectrum(4, direction=-2.0),
    "jonswap": JonswapSpectrum(5, 4000, direction=2.0),
    "shallow": ShallowSpectrum(JonswapSpectrum(8, 20000, direction=2.0), 2.0),
    "swell": SwellSpectrum(1.5, 40, 0.5),
    "narrow_swell": SwellSpectrum(0.5, 20, 4.0, 0.03, 0.05),
    "matched": MatchedSpectrum(ElfouhailySpectrum(3, direction=1.0), *cox_munk(3)),
    "sea": SeaState((JonswapSpectrum(4, 2000, direction=0.3), SwellSpectrum(1, 30, 1.9))),
}


def elfouhaily_written_out(wind):
    """Return S(k) and Delta(k) of a fully developed sea, independently of the package."""

    def c(k):
        return np.sqrt(G / k * (1 + (k / 370.0) ** 2))

    peak = G * 0.84**2 / wind**2
    friction = np.sqrt(0.00144) * wind
    alpha_m = 0.01 * (1 + (1 if friction <= 0.23 else 3) * np.log(friction / 0.23))
    sigma = 0.08 * (1 + 4 / 0.84**3)

    def density(k):
        common = np.exp(-1.25 * (peak / k) ** 2) * 1.7 ** np.exp(-((np.sqrt(k / peak) - 1) ** 2) / (2 * sigma**2))
        low = 0.003 * np.sqrt(0.84) * c(peak) / c(k) * np.exp(-0.84 / np.sqrt(10) * (np.sqrt(k / peak) - 1))
        high = 0.5 * alpha_m * 0.23 / c(k) * np.exp(-0.25 * (k / 370 - 1) ** 2)
        return common * (low + high) / k**3

    def delta(k):
        return np.tanh(np.log(2) / 4 + 4 * (c(k) / c(peak)) ** 2.5 + 0.13 * friction / 0.23 * (0.23 / c(k)) ** 2.5)

    return density, delta, peak


@each_row((3, 0.232, 8.2, 0.01545, 0.00998), (6, 0.937, 32.7, 0.02170, 0.01478), (10, 2.633, 90.8, 0.03551, 0.02480))
def test_elfouhaily_totals(wind, height, wavelength, up, cross):
    spectrum = ElfouhailySpectrum(wind)
    assert significant_wave_height(spectrum) == pytest.approx(height, abs=5.1e-4)
    assert 2 * np.pi / spectrum.peak_wavenumber == pytest.approx(wavelength, abs=0.051)
    assert spectrum.slope_variance() == pytest.approx((up, cross), abs=1e-5)


@pytest.mark.parametrize("wind", [3, 7.23, 15])
def test_elfouhaily_against_the_formula(wind):
    density, delta, peak = elfouhaily_written_out(wind)
    spectrum, k = ElfouhailySpectrum(wind), np.geomspace(peak / 10, 7400, 2000)
    np.testing.assert_allclose(spectrum.omnidirectional(k), density(k), rtol=1e-9, atol=1e-300)
    np.testing.assert_allclose(spectrum.spreading(k), delta(k), rtol=1e-9)
    assert spectrum.peak_wavenumber == pytest.approx(peak)


@each_row((20e3, (0.158, 0.405, 0.723)), (100e3, (0.217, 0.674, 1.43)))
def test_elfouhaily_heights_at_a_fetch(fetch, heights):
    for wind, height in zip((3, 6, 10), heights, strict=True):
        spectrum = ElfouhailySpectrum(wind, inverse_wave_age(wind, fetch))
        # The heights are given with three digits.
        assert significant_wave_height(spectrum) == pytest.approx(height, abs=0.5 * 10 ** (-2 if height > 1 else -3))


def test_inverse_wave_age_ends_at_full_development_and_at_the_youngest_sea():
    assert inverse_wave_age(5, 1e9) == pytest.approx(0.84)
    assert inverse_wave_age(0, 1e3) == 0.84
    with pytest.raises(ValueError, match=r"fetch = 100 must be at least (\d+) m at a wind speed of 10 m/s") as error:
        inverse_wave_age(10, 100)
    shortest = float(str(error.value).split("at least ")[1].split()[0])
    assert inverse_wave_age(10, 1.01 * shortest) == pytest.approx(5, rel=0.02)


def test_no_wind_gives_a_flat_sea():
    for spectrum in (
        ElfouhailySpectrum(0),
        PiersonMoskowitzSpectrum(0),
        MatchedSpectrum(ElfouhailySpectrum(0), *cox_munk(0)),
        SwellSpectrum(0, 10),
    ):
        assert spectrum.slope_variance() == (0, 0)
        assert significant_wave_height(spectrum) == 0
        assert not directional(spectrum, [0.0, 1.0], 1.0).any()
    assert ElfouhailySpectrum(0).peak_wavenumber == PiersonMoskowitzSpectrum(0).peak_wavenumber == np.inf


@pytest.mark.parametrize(("wind", "height", "slope"), [(3, 0.202, 0.0161), (6, 0.808, 0.0217), (10, 2.245, 0.0258)])
def test_pierson_moskowitz(wind, height, slope):
    spectrum = PiersonMoskowitzSpectrum(wind)
    upper = 1.026 * wind  # wind at 19.5 m
    # Closed form; the waves beyond the cut-off, alpha/(4 k^2) of the variance, are negligible.
    assert significant_wave_height(spectrum) == pytest.approx(2 * np.sqrt(8.1e-3 / 0.74) * upper**2 / G, rel=1e-5)
    assert significant_wave_height(spectrum) == pytest.approx(height, abs=1e-3)
    assert np.sqrt(G * spectrum.peak_wavenumber) == pytest.approx(0.877 * G / upper, rel=1e-3)
    assert sum(partial_slopes(spectrum, 62.8)) == pytest.approx(slope, abs=5.1e-5)
    for k, variances in ((62.8, partial_slopes(spectrum, 62.8)), (spectrum.CUT_OFF, spectrum.slope_variance())):
        exact = 8.1e-3 / 4 * exp1(0.74 * (G / (upper**2 * k)) ** 2)
        assert sum(variances) == pytest.approx(exact, rel=1e-5)
    assert spectrum.omnidirectional(371) == 0 < spectrum.omnidirectional(369)


@each_case((3, 1e4, 0.204), (6, 1e4, 0.377), (10, 1e4, 0.594), (10, 1e5, 2.139))
def test_jonswap(wind, fetch, height):
    spectrum = JonswapSpectrum(wind, fetch)
    assert significant_wave_height(spectrum) == pytest.approx(height, abs=5.1e-4)
    peak = 22 * (G**2 / (wind * fetch)) ** (1 / 3)
    assert np.sqrt(G * spectrum.peak_wavenumber) == pytest.approx(peak)
    for ratio in (0.7, 0.95, 1.0, 1.1, 3.0):
        omega = ratio * peak
        width = 0.07 if ratio <= 1 else 0.09
        density = 0.076 * (wind**2 / (fetch * G)) ** 0.22 * G**2 / omega**5 * np.exp(-1.25 / ratio**4)
        density *= 3.3 ** np.exp(-((ratio - 1) ** 2) / (2 * width**2))
        k = omega**2 / G
        # S(k) dk = S(omega) d omega in deep water
        assert spectrum.omnidirectional(k) == pytest.approx(density * 0.5 * np.sqrt(G / k), rel=1e-9)
    plain = JonswapSpectrum(wind, fetch, peak_enhancement=1)
    k = spectrum.peak_wavenumber
    assert spectrum.omnidirectional(k) / plain.omnidirectional(k) == pytest.approx(3.3)


def test_shallow_water_limits_the_long_waves():
    """TMA: the spectrum of frequencies times Kitaigorodskii's factor, from omega_h^2/2 for long waves to 1."""
    deep, depth = JonswapSpectrum(10.0, 1e5), 3.0
    shallow = ShallowSpectrum(deep, depth)
    for k in (0.02, 0.1, 0.3, 1.0, 10.0):
        omega = np.sqrt(G * k * np.tanh(k * depth))
        step = 1e-6 * k
        slope = (np.sqrt(G * (k + step) * np.tanh((k + step) * depth)) - omega) / step
        # S(omega) = S(k) / (d omega / dk), in both waters.
        of_shallow, of_deep = shallow.omnidirectional(k) / slope, deep.omnidirectional(omega**2 / G) * 2 * omega / G
        # k^-3 dk/d omega over that of deep water, 2 g^2 omega^-5.
        factor = k**-3 / slope * omega**5 / (2 * G**2)
        assert of_shallow == pytest.approx(factor * of_deep, rel=1e-5)
        if k * depth < 0.1:
            assert factor == pytest.approx(0.5 * omega**2 * depth / G, rel=0.01)
    assert significant_wave_height(shallow) < 0.7 * significant_wave_height(deep)
    height = significant_wave_height(ShallowSpectrum(deep, 500.0))
    assert height == pytest.approx(significant_wave_height(deep), rel=1e-3)
    peak = shallow.peak_wavenumber
    assert peak * np.tanh(peak * depth) == pytest.approx(deep.peak_wavenumber, rel=1e-9)
    assert shallow.omnidirectional(5.0) == pytest.approx(deep.omnidirectional(5.0), rel=1e-9)


def test_jonswap_ends_where_the_sea_is_fully_developed():
    """100 km at 3 m/s would make waves of 0.735 m, three times those of a fully developed sea."""
    must_refuse(r"fetch = 100000 must not exceed 1\.56e\+04 m .* sea is fully developed", JonswapSpectrum, 3, 1e5)
    oldest = JonswapSpectrum(3, 15.6e3)
    assert oldest.peak_wavenumber == pytest.approx(PiersonMoskowitzSpectrum(3).peak_wavenumber, rel=2e-3)


def test_swell_has_the_given_height_and_length():
    swell = SwellSpectrum(2.0, 80.0, 0.3, relative_bandwidth=0.05, directional_spread=0.1)
    assert significant_wave_height(swell) == pytest.approx(2.0, rel=1e-7)
    assert swell.peak_wavenumber == pytest.approx(2 * np.pi / 80)
    along, across = swell.slope_variance()
    # <k^2> = k0^2 (1 + b^2), and <cos 2 phi> = e^(-2 s^2) of a Gaussian hump.
    curvature = 0.25 * swell.peak_wavenumber**2 * (1 + 0.05**2)
    assert along + across == pytest.approx(curvature, rel=1e-6)
    assert along - across == pytest.approx(curvature * np.exp(-2 * 0.1**2), rel=1e-6)


def test_swell_variance_is_conserved_in_a_short_period():
    """Sampled at the waves of the period, swell of 60 m would be 0.2 m or 30 m high in periods of a few lengths."""
    swell = SwellSpectrum(1.0, 60.0, 0.4, relative_bandwidth=0.02, directional_spread=0.03)
    index = np.arange(-60, 61)
    for period in (61, 200, 256, 1100):
        variances = swell.mode_variances(index, index, 2 * np.pi / period)
        assert 4 * np.sqrt(variances.sum()) == pytest.approx(1.0, rel=1e-6)
        np.testing.assert_array_equal(variances, variances[::-1, ::-1])
    # The nearest wave has most of the variance: 256/60 = 4.3 periods along 0.4 rad
    variances = swell.mode_variances(index, index, 2 * np.pi / 256)
    j, i = np.unravel_index(np.argmax(variances), variances.shape)
    assert (abs(index[i]), abs(index[j])) == (4, 2)
    assert index[i] * index[j] > 0


@each_row(*SPECTRA)
def test_directional_spectrum_integrates_to_elevation_and_slopes(kind):
    """A direction counted clockwise, or along taken for across, changes the slopes by a fifth and more."""
    spectrum = SPECTRA[kind]
    k = np.geomspace(2e-3, 8000, 4000)
    if kind not in ("elfouhaily", "pierson_moskowitz", "jonswap", "matched"):
        k = k[k < 400]
    k = k[:, None]
    count = 128 if kind not in ("elfouhaily", "matched") else 8
    phi = (np.arange(count) + 0.5) * 2 * np.pi / count
    kx, ky = k * np.cos(phi), k * np.sin(phi)
    ring = directional(spectrum, kx, ky) * k**2 * 2 * np.pi

    def integral(weight):
        return trapezoid((ring * weight).mean(axis=1), np.log(k[:, 0]))

    # Steps at a cut-off or at the edge of a table cost the plain rule here some 1e-4.
    assert spectrum.elevation_variance() == pytest.approx(integral(1), rel=1e-3)
    covariance = np.array([[integral(kx * kx), integral(kx * ky)], [integral(kx * ky), integral(ky * ky)]])
    np.testing.assert_allclose(spectrum.slope_covariance(), covariance, atol=1e-3 * np.trace(covariance))
    axis = np.array([np.cos(spectrum.direction), np.sin(spectrum.direction)])
    along, across = spectrum.slope_variance()
    assert along == pytest.approx(axis @ covariance @ axis, abs=1e-3 * np.trace(covariance))
    assert along + across == pytest.approx(np.trace(covariance), rel=1e-3)
    middle = np.array([0.3, 0.5, 1.0])[:, None]
    rings = 2 * np.pi * middle * directional(spectrum, middle * np.cos(phi), middle * np.sin(phi))
    np.testing.assert_allclose(spectrum.omnidirectional(middle[:, 0]), rings.mean(axis=1), rtol=2e-3, atol=1e-12)
    # Opposite waves have equal density.
    kx, ky = np.random.default_rng(1).uniform(-1, 1, (2, 200))
    there = directional(spectrum, kx, ky)
    np.testing.assert_allclose(there, directional(spectrum, -kx, -ky), rtol=1e-12)
    assert there.any()


@each_row("elfouhaily", "pierson_moskowitz", "jonswap", "matched", "swell")
def test_mode_variances_are_the_directional_spectrum(kind):
    """For these as fast as each |k| is looked up once; a mirrored or turned lookup would show."""
    spectrum = SPECTRA[kind]
    ix, iy, dk = np.arange(0, 40), np.r_[0:20, -20:0], 0.011
    expected = directional(spectrum, ix * dk, iy[:, None] * dk) * dk**2
    np.testing.assert_allclose(spectrum.mode_variances(ix, iy, dk), expected, rtol=1e-9, atol=1e-18)


def test_sea_is_the_sum_of_its_components_along_the_axes_of_the_first():
    wind, swell = ElfouhailySpectrum(5, direction=0.2), SwellSpectrum(1, 50, 0.2 + np.pi / 2)
    sea = SeaState([wind, swell])
    assert sea.direction == 0.2
    assert significant_wave_height(sea) == pytest.approx(
        np.hypot(significant_wave_height(wind), significant_wave_height(swell))
    )
    # Swell across the wind swaps its axes.
    assert sea.slope_variance() == pytest.approx(np.add(wind.slope_variance(), swell.slope_variance()[::-1]))
    assert sea.peak_wavenumber == swell.peak_wavenumber
    assert SeaState((wind, SwellSpectrum(0.1, 50))).peak_wavenumber == wind.peak_wavenumber


@each_row(1, 3, 6, 10, 15, 30)
@each_row(ElfouhailySpectrum, PiersonMoskowitzSpectrum, JonswapSpectrum)
def test_matched_totals(kind, wind):
    options = {"fetch": 3000 * wind**2 / G} if kind is JonswapSpectrum else {}
    plain = kind(wind, direction=0.8, **options)
    matched = MatchedSpectrum(plain, *cox_munk(wind))
    # No approximation: each wave is scaled, and nothing had to be clipped.
    assert matched.slope_variance() == pytest.approx(cox_munk(wind), rel=1e-12)
    assert min(matched.scales) > 0
    assert matched.direction == 0.8
    # Long waves, and with them the height, are unchanged.
    assert matched.scaled_from == 2 * np.pi
    k = np.geomspace(0.01, 6.28, 30)
    np.testing.assert_array_equal(matched.omnidirectional(k), plain.omnidirectional(k))
    np.testing.assert_allclose(matched.spreading(k), plain.spreading(k), rtol=1e-12)
    # Short ones have the factors along and across.
    k = np.geomspace(6.29, 350, 30)
    for sign, scale in zip((1, -1), matched.scales, strict=True):
        ratio = matched.omnidirectional(k) * (0.5 + sign * matched.spreading(k) / 4)
        ratio /= plain.omnidirectional(k) * (0.5 + sign * plain.spreading(k) / 4)
        np.testing.assert_allclose(ratio, scale, rtol=1e-9)
    # Another quadrature, which does not step over the jump at 1 m either
    long, short = np.geomspace(plain.peak_wavenumber / 10, 2 * np.pi, 20001), np.geomspace(2 * np.pi, 7400, 200001)
    short[0] *= 1 + 1e-12
    if plain.peak_wavenumber < 2 * np.pi:
        total = sum(trapezoid(matched.omnidirectional(k) * k**3, np.log(k)) for k in (long, short))
        assert total == pytest.approx(sum(cox_munk(wind)), rel=1e-5 if kind is ElfouhailySpectrum else 1e-4)


@each_row(
    (ElfouhailySpectrum(6), 0.0010, 0.0005),  # less than the waves longer than 1 m have
    (PiersonMoskowitzSpectrum(6), 0.004, 0.011),
)
def test_matched_totals_far_from_the_spectrum(plain, upwind, crosswind):
    matched = MatchedSpectrum(plain, upwind, crosswind)
    assert matched.slope_variance() == pytest.approx((upwind, crosswind), rel=1e-10)
    assert min(matched.scales) >= 0
    assert np.all(np.abs(matched.spreading(np.geomspace(0.01, 1000, 500))) <= 1)
    k = 0.99 * matched.scaled_from
    assert matched.omnidirectional(k) == plain.omnidirectional(k)
    assert matched.scaled_from <= 2 * np.pi


def test_matched_totals_of_too_large_a_ratio_miss_the_larger():
    assert MatchedSpectrum(ElfouhailySpectrum(6), 0.03, 0.005).slope_variance() == pytest.approx((0.015, 0.005))
    assert MatchedSpectrum(ElfouhailySpectrum(6), 0.005, 0.03).slope_variance() == pytest.approx((0.005, 0.015))


@pytest.mark.parametrize(("wind", "total"), [(3, 0.01836), (6, 0.03372), (7.23, 0.0400), (10, 0.0542)])
def test_cox_munk_totals(wind, total):
    up, cross = cox_munk(wind)
    assert up == pytest.approx(3.16e-3 * wind)
    assert cross == pytest.approx(0.003 + 1.92e-3 * wind)
    # The published total has its own regression, 0.003 + 5.12e-3 W.
    assert up + cross == pytest.approx(total, rel=0.01)


@each_row(1, 3, 10)
@each_row(ElfouhailySpectrum, PiersonMoskowitzSpectrum)
def test_matched_waves_leave_ripples_to_every_mesh(kind, wind):
    """Refining the mesh moves variance from the ripples to the facets; nothing is counted twice."""
    matched = MatchedSpectrum(kind(wind, direction=0.5), *cox_munk(wind))
    before = cox_munk(wind)
    for cells in (32, 128, 512):
        resolved = mesh_slope_variance(matched, 10.0, cells)
        ripples = np.subtract(cox_munk(wind), resolved)
        assert min(resolved) > 0
        assert 0 < ripples[0] < before[0]
        assert 0 < ripples[1] < before[1]
        before = ripples


@each_case((6, 1.109, 1.188, 0.743), (10, 1.109, 0.95, 0.87))
def test_series_at_20_degrees(wind, nadir, looking_upwind, looking_downwind):
    """By hand from the published terms. Who looks upwind sees lee faces, which rise towards the wind."""
    series = GramCharlierSeries.of_clean_sea(wind)
    slope = np.tan(np.radians(20)) / np.sqrt(3.16e-3 * wind)
    assert series.ratio(0.0, 0.0) == pytest.approx(nadir, abs=5e-4)
    assert series.ratio(0.0, slope) == pytest.approx(looking_upwind, abs=5e-3)
    assert series.ratio(0.0, -slope) == pytest.approx(looking_downwind, abs=5e-3)


def normal_grid(reach=9.0, count=721):
    """Return crosswind and upwind slopes over their standard deviations, and the Gaussian's integral of each node."""
    nodes = np.linspace(-reach, reach, count)
    x, y = np.meshgrid(nodes, nodes)
    return x, y, np.exp(-0.5 * (x**2 + y**2)) / (2 * np.pi) * (nodes[1] - nodes[0]) ** 2


def test_series_has_the_moments_of_its_terms():
    series = GramCharlierSeries(-0.05, -0.16, 0.4, 0.12, 0.23)
    x, y, gaussian = normal_grid()
    density = gaussian * series.ratio(x, y)

    def mean(values):
        return float(np.sum(density * values))

    found = [mean(one) for one in (np.ones_like(x), x, y, x * x, y * y, x * y, x * x * y, y**3, x**3)]
    assert found == pytest.approx([1, 0, 0, 1, 1, 0, 0.05, 0.16, 0], abs=1e-9)
    assert [mean(x**4) - 3, mean(x * x * y * y) - 1, mean(y**4) - 3] == pytest.approx([0.4, 0.12, 0.23], abs=1e-9)
    for angle in (0.3, 2.0, 4.5):
        across, up = np.sin(angle), np.cos(angle)
        slope = across * x + up * y
        wanted = mean(slope**3), mean(slope**4) - 3
        assert series.along(across, up) == pytest.approx(wanted, abs=1e-9)


def test_series_of_strong_wind_or_a_small_part_is_refused():
    must_refuse("slope_distribution 'gram_charlier' = 15 must lie", GramCharlierSeries.of_clean_sea, 15)
    series, total = GramCharlierSeries.of_clean_sea(6.0), cox_munk(6.0)
    halves, fifths = (series.of_part(total, (share * total[0], share * total[1])) for share in (0.5, 0.2))
    halves.require_positive("")
    assert halves.negative_share < 1e-5
    assert fifths.negative_share == pytest.approx(0.444, abs=2e-3)
    with pytest.raises(UserError, match=r"negative density for 44 % of the slopes .* at most 0.5 %; smooth them"):
        fifths.require_positive("smooth them")
