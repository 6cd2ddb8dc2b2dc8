"""Bubbles by wind speed: moments of the spectrum by quadrature, and the backscatter of their phase function."""

import numpy as np
import pytest

from mitransient_lidar.physics.water.bubbles import CLEAN_BACKSCATTER, WindBubbles
from mitransient_lidar.physics.water.phase import fournier_forand, fournier_forand_parameters


def spectrum(wind):
    """Return radii [m], and bubbles per volume and radius at the surface [1/m^4] by Hall and Novarini."""
    radius = np.geomspace(10e-6, 1000e-6, 20_001)
    shape = np.where(radius <= 54.4e-6, (54.4e-6 / radius) ** 4, (54.4e-6 / radius) ** 4.37)
    return radius, 1.6e10 * (wind / 13) ** 3 * shape


def integral(values, radius):
    return np.sum(0.5 * (values[1:] + values[:-1]) * np.diff(radius))


@pytest.mark.parametrize("wind", [5.0, 7.5, 10.0, 15.0])
def test_void_fraction_and_scattering_are_those_of_the_spectrum(wind):
    """Volume 4/3 pi a^3 of each bubble, and a scattering cross-section of 2 pi a^2."""
    radius, density = spectrum(wind)
    bubbles = WindBubbles.of_wind(wind)
    assert bubbles.void_fraction == pytest.approx(integral(4 / 3 * np.pi * radius**3 * density, radius), rel=1e-6)
    assert bubbles.scattering == pytest.approx(integral(2 * np.pi * radius**2 * density, radius), rel=1e-6)


def test_layer_is_as_deep_as_the_wind_makes_it():
    for wind, depth in ((3.0, 0.4), (7.5, 0.4), (10.0, 0.6875), (20.0, 1.8375)):
        assert WindBubbles.of_wind(wind).depth == pytest.approx(depth)
    assert WindBubbles.of_wind(0.0).scattering == 0


@pytest.mark.parametrize("backscatter", [100.0, CLEAN_BACKSCATTER, 1445.0])
def test_phase_function_scatters_back_as_the_bubbles_do(backscatter):
    bubbles = WindBubbles.of_wind(12.0)
    function = fournier_forand_parameters(bubbles.backscatter_ratio(backscatter))
    found = bubbles.scattering * float(fournier_forand(np.pi, *function)) / bubbles.void_fraction
    assert found == pytest.approx(backscatter, rel=1e-6)
