"""Phase functions of particles in closed form, and their tables."""

from functools import partial

import numpy as np
import pytest
from oracles.phase import henyey_greenstein, two_term_henyey_greenstein
from rows import each_row
from scipy.integrate import quad, simpson

from mitransient_lidar.physics.water.phase import (
    fournier_forand,
    fournier_forand_backscatter_ratio,
    fournier_forand_cdf,
    fournier_forand_parameters,
    henyey_greenstein_backscatter_ratio,
    petzold_average_particle,
)
from mitransient_lidar.physics.water.phase_table import PowerLawTable

# bb/b, mu, n, p(180), p(90) of the one-parameter Fournier-Forand family
FAMILY = [
    (0.005, 3.365605, 1.066376, 7.2867e-4, 1.23315e-3),
    (0.0183, 3.583417, 1.099963, 2.855692e-3, 4.190592e-3),
    (0.040, 3.769232, 1.128616, 6.613178e-3, 8.564872e-3),
    (0.050, 3.832395, 1.138355, 8.429564e-3, 1.045472e-2),
]
# Degrees, p, cumulative at n = 1.10, mu = 3.5835
PETZOLD_LIKE = np.array(
    [
        (0.1, 2.07509e3, 0.068287),
        (0.5, 2.05088e2, 0.172814),
        (1, 7.27838e1, 0.254567),
        (2, 2.42444e1, 0.367201),
        (5, 4.70246, 0.558957),
        (20, 2.07733e-1, 0.839555),
        (45, 2.51908e-2, 0.937488),
        (90, 4.19332e-3, 0.981687),
        (120, 2.62489e-3, 0.991725),
        (150, 2.67342e-3, 0.997678),
        (180, 2.85777e-3, 1.0),
    ]
)


def integral(p, low=1e-12, high=np.pi):
    """Solid-angle integral of p by Simpson's rule in ln(theta)."""
    x = np.linspace(np.log(low), np.log(high), 200_001)
    theta = np.exp(x)
    return simpson(2 * np.pi * p(theta) * np.sin(theta) * theta, x=x)


@pytest.mark.parametrize(("ratio", "mu", "n", "p180", "p90"), FAMILY)
def test_fournier_forand_family(ratio, mu, n, p180, p90):
    solved_n, solved_mu = fournier_forand_parameters(ratio)
    assert solved_mu == pytest.approx(mu, abs=1e-6)
    assert solved_n == pytest.approx(n, abs=1e-6)
    np.testing.assert_allclose(fournier_forand([np.pi, np.pi / 2], solved_n, solved_mu), [p180, p90], rtol=1e-5)
    table = PowerLawTable.fournier_forand(solved_n, solved_mu)
    assert table.backscatter_ratio == pytest.approx(ratio, rel=1e-4)


@each_row((0.005, 0.97655), (0.03, 0.89464), (0.04, 0.86658), (0.05, 0.83992), (0.0183, 0.93000))
def test_fournier_forand_mean_cosine(ratio, g):
    n, mu = fournier_forand_parameters(ratio)
    # <cos> = 1 - 2 <s> = 1 - 2 int_0^1 (1 - F) ds counts the light within a nanoradian, too.
    beyond = quad(lambda s: 1 - fournier_forand_cdf(2 * np.arcsin(np.sqrt(s)), n, mu), 0, 1, points=[1e-4, 1e-2])[0]
    assert 1 - 2 * beyond == pytest.approx(g, abs=1e-5)
    assert PowerLawTable.fournier_forand(n, mu).mean_cosine == pytest.approx(1 - 2 * beyond, abs=1e-5)


def test_fournier_forand_values_and_cumulative():
    theta = np.radians(PETZOLD_LIKE[:, 0])
    np.testing.assert_allclose(fournier_forand(theta, 1.10, 3.5835), PETZOLD_LIKE[:, 1], rtol=5e-6)
    np.testing.assert_allclose(fournier_forand_cdf(theta, 1.10, 3.5835), PETZOLD_LIKE[:, 2], atol=6e-7)
    table = PowerLawTable.fournier_forand(1.10, 3.5835)
    np.testing.assert_allclose(table.eval(theta), PETZOLD_LIKE[:, 1], rtol=2e-4)
    np.testing.assert_allclose(table.cdf_s(np.sin(theta / 2) ** 2), PETZOLD_LIKE[:, 2], atol=3e-6)


@each_row((1.021, 3.0742, 1.03e-4), (1.08, 3.483, 1.0037e-2), (1.15, 4.874, 0.40052))
def test_fournier_forand_backscatter_ratio(n, mu, ratio):
    assert fournier_forand_backscatter_ratio(n, mu) == pytest.approx(ratio, rel=5e-3)
    assert integral(lambda t: fournier_forand(t, n, mu), np.pi / 2) == pytest.approx(ratio, rel=5e-3)


@pytest.mark.parametrize(("n", "mu"), [(1.0664, 3.3656), (1.10, 3.5835), (1.175, 4.065)])
def test_fournier_forand_is_smooth_and_normalised_through_delta_one(n, mu):
    # delta = 1 at this angle; a plain evaluation of the closed form is 0/0 here
    at_one = 2 * np.arcsin(np.sqrt(0.75) * (n - 1))
    theta = at_one * (1 + np.array([-0.03, -0.02, -1e-5, -1e-9, 0, 1e-9, 1e-5, 0.02, 0.03]))
    log_p = np.log(fournier_forand(theta, n, mu))
    smooth = np.polynomial.Polynomial.fit(np.log(theta), log_p, 4)(np.log(theta))
    np.testing.assert_allclose(log_p, smooth, atol=2e-8)
    assert integral(lambda t: fournier_forand(t, n, mu), 1e-4) + fournier_forand_cdf(1e-4, n, mu) == pytest.approx(
        1, abs=1e-7
    )


def test_henyey_greenstein():
    np.testing.assert_allclose(
        henyey_greenstein([0, np.pi / 2, np.pi], 0.924), [26.5075, 4.61023e-3, 1.63378e-3], rtol=1e-5
    )
    assert henyey_greenstein_backscatter_ratio(0.924) == pytest.approx(0.016989, abs=1e-6)
    assert henyey_greenstein_backscatter_ratio(0.836275) == pytest.approx(0.04, abs=1e-6)
    assert henyey_greenstein_backscatter_ratio(0) == 0.5
    assert integral(lambda t: henyey_greenstein(t, 0.99)) == pytest.approx(1, abs=1e-8)


def tables():
    n, mu = fournier_forand_parameters(0.04)
    return {
        "fournier_forand": PowerLawTable.fournier_forand(n, mu),
        "petzold": PowerLawTable.from_function(petzold_average_particle()),
        "isotropic": PowerLawTable.from_function(lambda theta: np.ones_like(theta)),
        "logarithmic": PowerLawTable.from_values(
            np.exp(-np.linspace(-20, 0, 41) * (1 - 1e-13)), -20.0, cap_probability=1.0
        ),
        "henyey_greenstein": PowerLawTable.from_function(lambda theta: henyey_greenstein(theta, 0.99)),
    }


TABLES = pytest.mark.parametrize(
    "name", ["fournier_forand", "petzold", "isotropic", "logarithmic", "henyey_greenstein"]
)


@TABLES
def test_cumulative_distribution_integrates_the_density(name):
    table = tables()[name]
    for low, high in [(1e-9, 3e-7), (1e-5, 0.02), (0.3, 1.0)]:
        inside = table.cdf_s(high) - table.cdf_s(low)
        x = np.linspace(np.log(low), np.log(high), 200_001)
        density = 4 * np.pi * table.eval_s(np.exp(x)) * np.exp(x)
        assert simpson(density, x=x) == pytest.approx(inside, rel=2e-6)


def test_table_follows_closed_form_everywhere():
    n, mu = fournier_forand_parameters(0.04)
    theta = np.concatenate((np.geomspace(1e-7, 0.1, 2000), np.linspace(0.1, np.pi, 20_001)))
    np.testing.assert_allclose(
        PowerLawTable.fournier_forand(n, mu).eval(theta), fournier_forand(theta, n, mu), rtol=3e-4
    )


@each_row((0.3, 2048), (0.7, 16384))
def test_table_follows_a_backward_lobe(g_backward, count):
    p = partial(two_term_henyey_greenstein, weight=0.97, g_forward=0.95, g_backward=g_backward)
    theta = np.linspace(np.pi / 2, np.pi, 10_001)
    np.testing.assert_allclose(PowerLawTable.from_function(p, count).eval(theta), p(theta), rtol=1e-3)


@pytest.mark.parametrize("name", ["fournier_forand", "petzold", "isotropic"])
@pytest.mark.parametrize("chi", [0.1, 0.5, 2.0, 10.0])
def test_value_at_180_degrees_by_its_ratio_to_the_backscattering(name, chi):
    before = tables()[name]
    after, ratio = before.with_chi(chi), before.backscatter_ratio
    assert after.backscatter_ratio == pytest.approx(ratio, rel=5e-4)
    assert after.eval_s(1.0) == pytest.approx(ratio / (2 * np.pi * chi), rel=1e-3)
    # The shape up to 160 degrees stays, and forward scattering.
    theta = np.radians([0.1, 10.0, 60.0, 89.0])
    np.testing.assert_allclose(after.eval(theta), before.eval(theta), rtol=1e-3)
    change = after.eval(np.radians([95.0, 130.0, 160.0])) / before.eval(np.radians([95.0, 130.0, 160.0]))
    assert np.ptp(change) < 1e-3 + 2e-4 / chi
    assert abs(change[0] - 1) < 1e-3 + 6e-3 * abs(1 / chi - 1)
    # Half of the change is reached 5 degrees from the back: exp(-(5 / 6)^2).
    changes = after.eval(np.radians([175.0, 180.0])) / before.eval(np.radians([175.0, 180.0])) - change[1]
    assert changes[0] / changes[1] == pytest.approx(np.exp(-((5 / 6) ** 2)), abs=0.03)
