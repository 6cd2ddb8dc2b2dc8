"""Water in layers, and bubbles below waves."""

import numpy as np
import pytest
from rows import refuses

from mitransient_lidar.physics.water.bubbles import CLEAN_BACKSCATTER, WindBubbles
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase import fournier_forand, fournier_forand_parameters


@pytest.fixture
def layered():
    return WaterColumn.from_text("0, 3", [0.9, 0.5], "0.45 0.25", 0.006)


def test_properties_per_layer(layered):
    assert layered.count == 2
    np.testing.assert_allclose(layered.absorption, [0.45, 0.25])
    np.testing.assert_allclose(layered.albedo, [0.5, 0.5])
    np.testing.assert_allclose(layered.backscatter_ratio, [0.006 / 0.45, 0.024])
    np.testing.assert_allclose(layered.edge_optical_depth, [0, 2.7])
    clear = WaterColumn.from_text(0, 0, 0, 0)
    assert (clear.albedo[0], clear.backscatter_ratio[0]) == (0, 0)


def test_layer_owns_its_upper_edge_and_first_layer_fills_crests(layered):
    np.testing.assert_array_equal(layered.layer_at([-1, 0, 2.999, 3, 100]), [0, 0, 0, 1, 1])


def test_shares_of_the_layers_in_the_water_above_a_depth(layered):
    # Of 8 m, 3 m are the upper layer; mean values times depth are integrals.
    np.testing.assert_allclose(layered.layer_shares([-1, 0, 2, 8]), [[1, 0], [1, 0], [1, 0], [3 / 8, 5 / 8]])
    assert layered.layer_shares(8.0) @ layered.attenuation * 8 == pytest.approx(float(layered.cumulative(8)))
    assert np.isnan(layered.layer_shares(np.nan)).all()
    assert WaterColumn.from_text(0, 0.3, 0.1, 0).layer_shares(np.nan).tolist() == [1]


def test_slanted_segment_is_independent_of_direction(layered):
    # 2 m of the upper and 2 m of the lower layer, stretched by 1.25: (2 * 0.9 + 2 * 0.5) * 1.25
    assert layered.optical_depth(1, 5, 5) == pytest.approx(3.5)
    assert layered.optical_depth(5, 1, 5) == pytest.approx(3.5)


def test_level_and_nearly_level_segments_agree(layered):
    # A difference of cumulative depths would lose all digits here.
    level = layered.optical_depth(1.0, 1.0, 10.0)
    nearly = layered.optical_depth(1.0, np.nextafter(1.0, 2), 10.0)
    assert level == 9.0
    assert nearly == pytest.approx(9.0, rel=1e-14)
    assert layered.optical_depth(3.0, 3.0, 10.0) == 5.0


@refuses(
    (([0, 2, 2], 0.3, 0.15, 0.006), "out of order"),
    ((1, 0.3, 0.15, 0.006), "first layer must start at 0"),
    ((0, 0.3, 0.4, 0.006), r"scattering = 0.4 must not exceed attenuation = 0.3"),
    ((0, 0.3, 0.15, 0.5), r"backscattering = 0.5 must not exceed scattering = 0.15"),
    ((0, np.nan, 0.15, 0.006), "attenuation holds nan"),
    (("0, deep", 0.3, 0.15, 0.006), "layer_tops .* must hold numbers only"),
    (([0, 1, 2], [0.3, 0.4], 0.15, 0.006), "attenuation has 2 values but layer_tops has 3 layers"),
)
def test_bad_layers_are_rejected(arguments):
    WaterColumn.from_text(*arguments)


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
