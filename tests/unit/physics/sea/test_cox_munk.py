"""Measured slopes of the sea, and the part of them that a mesh does not resolve."""

import numpy as np
import pytest
from oracles.wave_spectra import mesh_slope_variance
from rows import each_row, must_refuse

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.sea.cox_munk import GramCharlierSeries, cox_munk
from mitransient_lidar.physics.sea.wave_spectrum import MatchedSpectrum
from mitransient_lidar.physics.sea.wind_spectra import ElfouhailySpectrum, PiersonMoskowitzSpectrum


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


@pytest.mark.parametrize(
    ("wind", "nadir", "looking_upwind", "looking_downwind"), [(6, 1.109, 1.188, 0.743), (10, 1.109, 0.95, 0.87)]
)
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
