"""Lidar geometry read back from attributes, against formulas written out for a lidar at nadir and off nadir."""

import math

import numpy as np
import pytest
import xarray as xr
from small_results import made

from mitransient_lidar import results
from mitransient_lidar.analysis.gates.cut import cut_gates
from mitransient_lidar.physics.lidar.gate_train import GateTrain
from mitransient_lidar.results.geometry import LinesOfSight, lidar_geometry, lidar_system, share_in_view

C0 = 0.299792458  # m/ns
THETA, N, GROUP = math.radians(20), 1.34, 1.364
COS_WATER = math.sqrt(1 - (math.sin(THETA) / N) ** 2)
ATTRIBUTES = {"altitude": 200.0, "off_nadir_deg": 20.0, "refractive_index": N, "group_index": GROUP}
ATTRIBUTES |= {"field_of_view_mrad": 30.0, "divergence_mrad": 10.0, "pulse_energy_mj": 5.0, "aperture_area": 0.025}
ATTRIBUTES |= {"two_way_efficiency": 0.9**2 * 0.8}


def test_times_depths_and_paths():
    geometry = lidar_geometry({**ATTRIBUTES, "surface_time_ns": 1425.0})
    time = 1425.0 + 2 * GROUP * 8.0 / COS_WATER / C0
    assert geometry.time_of_depth(8.0) == pytest.approx(time, abs=1e-9)
    assert geometry.depth_of_time(time) == pytest.approx(8.0, abs=1e-9)
    assert geometry.path_of_time(time) == pytest.approx(8.0 / COS_WATER, abs=1e-9)
    assert geometry.depth_per_ns == pytest.approx(C0 / (2 * GROUP) * COS_WATER)


def test_system_of_the_lidar_equation():
    system = lidar_system(ATTRIBUTES)
    assert (system.energy, system.aperture_area) == (pytest.approx(5e-3 * 0.9**2 * 0.8), 0.025)
    obscured = {**ATTRIBUTES, "obscuration": 0.3}
    system = lidar_system(obscured, efficiency=0.5)
    assert (system.energy, system.aperture_area) == (pytest.approx(5e-3 * 0.5), pytest.approx(0.7 * 0.025))


def test_share_of_the_beam_in_view():
    """The sum of the shares that are stored; without them, that of a circle or square of 3 standard deviations."""
    stored = xr.Dataset(coords={"beam_share": ("pixel", [0.25, 0.5])}, attrs=ATTRIBUTES)
    assert share_in_view(stored) == 0.75
    shots = xr.Dataset(coords={"beam_share": (("shot", "pixel"), [[0.25, 0.5], [0.1, 0.1]])}, attrs=ATTRIBUTES)
    np.testing.assert_allclose(share_in_view(shots), [0.75, 0.2])
    unknown = xr.Dataset(coords={"beam_share": ("pixel", [0.25, np.nan])}, attrs=ATTRIBUTES)
    for dataset in (unknown, xr.Dataset(attrs=ATTRIBUTES)):
        assert share_in_view(dataset) == pytest.approx(1 - math.exp(-4.5))
    square = xr.Dataset(attrs={**ATTRIBUTES, "field_of_view_shape": "square"})
    assert share_in_view(square) == pytest.approx(math.erf(3 / math.sqrt(2)) ** 2)


def image(sights=True):
    """Return a result of 2 x 3 pixels, with lines of sight or without."""
    angles = np.stack(np.meshgrid([5.0, -5.0], [8.0, 0.0, -8.0], indexing="ij"), axis=-1).reshape(-1, 2)
    built = made(np.ones((6, 100)), step=1.0, grid=(2, 3), centres=angles, **ATTRIBUTES, surface_time_ns=1420.0)
    number = np.arange(6.0)
    angle, share = THETA + 1e-3 * number, number / 21
    values = (1e-3 * number, -1e-3 * number, angle, 1419 + number, 0.1 * number, 0.106 + 1e-4 * number, share)
    lines = LinesOfSight(*values)
    return (built.assign_coords(lines.coordinates(("row", "column"), (2, 3))) if sights else built), lines


def assert_same(found, lines):
    for name, values in vars(lines).items():
        np.testing.assert_allclose(getattr(found, name), values, rtol=1e-8, atol=1e-9, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".exr", ".nc"])
def test_lines_of_sight_survive_files_and_gates(tmp_path, suffix):
    dataset, lines = image()
    results.save(dataset, tmp_path / f"a{suffix}")
    assert_same(LinesOfSight.from_dataset(results.open(tmp_path / f"a{suffix}")), lines)
    gates = cut_gates(dataset, GateTrain(1425.0, 5.0, 5.0, 3))
    results.save(gates, tmp_path / f"b{suffix}")
    stack = results.open(tmp_path / f"b{suffix}")
    assert_same(LinesOfSight.from_dataset(stack), lines)
    assert_same(LinesOfSight.from_dataset(dataset.transpose("time", "column", "row")), lines)


def test_lines_of_sight_without_coordinates_are_those_of_the_centres():
    dataset, _ = image(sights=False)
    lines = LinesOfSight.from_dataset(dataset)
    x, y = 1e-3 * dataset["angle_x"].values.ravel(), 1e-3 * dataset["angle_y"].values.ravel()
    cosine = (math.cos(THETA) - math.sin(THETA) * x) / np.sqrt(1 + x**2 + y**2)
    np.testing.assert_allclose(np.cos(lines.off_nadir), cosine)
    level = 2 * 200 / cosine / C0
    np.testing.assert_allclose(lines.surface_time, level - level.mean() + 1420.0)
    np.testing.assert_allclose(lines.depth_per_ns, C0 / (2 * GROUP) * np.sqrt(1 - (1 - cosine**2) / N**2))
    assert np.isnan(lines.beam_share).all()
    # Times and depths are inverse, in any shape.
    depths = np.linspace(0, 9, 12).reshape(6, 2)
    np.testing.assert_allclose(lines.depth_of_time(lines.time_of_depth(depths)), depths, atol=1e-9)


def test_sum_of_pixels_looks_where_most_light_is():
    """A mixture has the mean variance plus the variance of the means."""
    _, lines = image()
    total, weight, number = lines.combined(), np.arange(6.0) / 15, np.arange(6.0)
    assert total.surface_time[0] == pytest.approx(1419 + weight @ number)
    variance = weight @ (0.1 * number) ** 2 + weight @ (number - weight @ number) ** 2
    assert total.surface_spread[0] == pytest.approx(math.sqrt(variance))
