"""Lidar geometry read back from attributes, against formulas written out for a lidar at nadir and off nadir."""

import math

import pytest

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.results.geometry import LidarGeometry, optional_number

C0 = 0.299792458  # m/ns
THETA, N, GROUP = math.radians(20), 1.34, 1.364
COS_WATER = math.sqrt(1 - (math.sin(THETA) / N) ** 2)
ATTRIBUTES = {
    "altitude": 200.0,
    "off_nadir_deg": 20.0,
    "refractive_index": N,
    "group_index": GROUP,
    "field_of_view_mrad": 30.0,
    "divergence_mrad": 10.0,
    "pulse_energy_mj": 5.0,
    "aperture_area": 0.025,
    "scene.optical_efficiency": "0.9",
    "scene.two_way_atmospheric_transmittance": "0.8",
}


def test_times_depths_and_paths():
    geometry = LidarGeometry.from_attributes({**ATTRIBUTES, "surface_time_ns": 1425.0})
    time = 1425.0 + 2 * GROUP * 8.0 / COS_WATER / C0
    assert geometry.time_of_depth(8.0) == pytest.approx(time, abs=1e-9)
    assert geometry.depth_of_time(time) == pytest.approx(8.0, abs=1e-9)
    assert geometry.path_of_time(time) == pytest.approx(8.0 / COS_WATER, abs=1e-9)
    assert geometry.depth_per_ns == pytest.approx(C0 / (2 * GROUP) * COS_WATER)


def test_surface_time_of_the_mean_sea_level():
    level = 2 * 200 / math.cos(THETA) / C0
    assert LidarGeometry.from_attributes(ATTRIBUTES).surface_time_ns == pytest.approx(level)
    measured = {**ATTRIBUTES, "surface_time_ns": 1425.0}
    assert LidarGeometry.from_attributes(measured, surface="level").surface_time_ns == pytest.approx(level)
    assert LidarGeometry.from_attributes(measured, surface="measured").surface_time_ns == 1425.0
    with pytest.raises(UserError, match="no attribute surface_time_ns"):
        LidarGeometry.from_attributes(ATTRIBUTES, surface="measured")


def test_spreading_at_nadir_is_the_inverse_square():
    geometry = LidarGeometry.from_attributes({**ATTRIBUTES, "off_nadir_deg": 0.0})
    expected = [1.0, 1.0, (N * 200 / (N * 200 + 10)) ** 2]
    assert geometry.spreading([-5.0, 0.0, 10.0]).tolist() == pytest.approx(expected)


def test_beam_edge_and_spot():
    geometry = LidarGeometry.from_attributes(ATTRIBUTES)
    # The path in water that takes as long as the far edge's longer path in air.
    longer = 200 / math.cos(THETA + 5e-3) - 200 / math.cos(THETA)
    assert geometry.surface_depth(5e-3) == pytest.approx(longer / GROUP * COS_WATER)
    assert geometry.spot_diameter(ATTRIBUTES) == pytest.approx(0.03 * 200 / math.cos(THETA))


def test_system_of_the_lidar_equation():
    system = LidarGeometry.from_attributes(ATTRIBUTES).lidar_system(ATTRIBUTES)
    # A circle of 3 standard deviations of the beam.
    assert system.energy == pytest.approx(5e-3 * 0.9**2 * 0.8 * (1 - math.exp(-4.5)))
    square = {**ATTRIBUTES, "field_of_view_shape": "square"}
    energy = LidarGeometry.from_attributes(square).lidar_system(square, efficiency=0.5).energy
    assert energy == pytest.approx(5e-3 * 0.5 * math.erf(3 / math.sqrt(2)) ** 2)


def test_numbers_that_are_missing_or_invalid():
    missing = {name: value for name, value in ATTRIBUTES.items() if name != "refractive_index"}
    with pytest.raises(UserError, match="the dataset has no attribute refractive_index"):
        LidarGeometry.from_attributes(missing)
    for value in ("high", -1.0, float("nan")):
        with pytest.raises(UserError, match=r"the attribute altitude = .* must be a number of at least 0"):
            LidarGeometry.from_attributes({**ATTRIBUTES, "altitude": value})
    assert optional_number({"a": "x", "b": 3}, "a") is None
    assert optional_number({"a": "x", "b": -3}, "b") == -3.0
