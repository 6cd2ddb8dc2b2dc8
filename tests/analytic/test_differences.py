"""Derivatives by geometry against closed forms, and against renders beside the scene on other random numbers."""

import itertools

import numpy as np
import pytest
import significance
from rows import each_case

from mitransient_lidar.core.constants import C0
from mitransient_lidar.loading.parameters import with_value
from mitransient_lidar.loading.scenes import choose_integrator, open_scene
from mitransient_lidar.rendering.derivatives import Differences
from mitransient_lidar.rendering.passes import pass_seed
from mitransient_lidar.transport.scene_parts import find_lidar_scene

pytestmark = pytest.mark.slow

LEVEL = {"spectrum": "flat", "surface_size": 1000, "layout": "1x1"}
SMALL = {"type": "lidar_merging", "paths_per_pass": 2**13, "photons_per_pass": 2**13}
PASSES = 16
#: Seeds of renders to compare with, other than those of the derivatives.
OTHERS = 1000


def each_slope(session, name, integrator=SMALL, steps=None):
    """Return derivatives of the energy [J per unit], shape (passes, pixels, bins)."""
    found = Differences(session, choose_integrator(session.scene, integrator), [name], steps=steps)
    sums = [np.zeros(())]
    for number in range(PASSES):
        found.add_pass(pass_seed(0, number))
        sums.append(found.light.energy.count * found.light.energy.mean[0])
    return np.array([after - before for before, after in itertools.pairwise(sums)])


def slopes(name, params, steps=None):
    """Return derivatives of the energy [J per unit], a row for each pass, and the session."""
    session = open_scene("table1", {**LEVEL, **params})
    return each_slope(session, name, steps=steps).sum(axis=1), session


def axis_of(session):
    return find_lidar_scene(session.scene, session.sensor).axis


def each_energy(session, integrator=SMALL, seed=OTHERS, axis=None):
    """Return energies [J], by default with the scene's own time bins, shape (passes, pixels, bins)."""
    renderer = choose_integrator(session.scene, integrator).prepare(session.scene, session.sensor, axis=axis)
    passes = (renderer.render_pass(pass_seed(seed, number)) for number in range(PASSES))
    return np.array([one.histogram.energy() for one in passes])


def energies(session, seed=OTHERS, axis=None):
    return each_energy(session, seed=seed, axis=axis).sum(axis=1)


def in_bins(samples, bins=8):
    """Return sums over neighbouring bins, as many as there are whole ones."""
    count = samples.shape[-1] // bins
    return samples[..., : count * bins].reshape(*samples.shape[:-1], count, bins).sum(axis=-1)


def test_bottom_depth_moves_its_echo_in_time():
    """The mean time of the echo grows by 2 n / (c cos(angle in water)); the sum over all ways changes it by 0.5 %."""
    water = {"scattering": 0, "backscattering": 0}
    found, session = slopes("bottom_depth", water)
    axis = axis_of(session)
    record = energies(session)
    bottom = axis.centres_ns > 2 * 200.0 / np.cos(np.deg2rad(20)) / (C0 * 1e-9) + 30.0
    energy, times = record[:, bottom].mean(axis=0), axis.centres_ns[bottom]
    mean = energy @ times / energy.sum()
    moved = found[:, bottom] @ (times - mean) / energy.sum()
    cosine = np.sqrt(1 - (np.sin(np.deg2rad(20)) / 1.34) ** 2)
    significance.assert_equal(moved[:, None], [2 * 1.364 / (C0 * 1e-9) / cosine], error=0.02, bias=0.01)


@pytest.mark.long
def test_light_just_above_a_dark_bottom_that_sinks():
    """The last light of the water, against the reference, which has no cells.

    In cells that end where the bottom was, the derivative is twice as large: 20 standard errors, twice the limit.
    """
    record = {"time_start_ns": 1410, "bin_width_ns": 1, "bin_count": 100}
    session = open_scene("table1", {**LEVEL, **record, "bottom_reflectance": 5e-4})
    reference = {"type": "lidar_volpath", "paths_per_pass": 2**16}
    found, wanted = (in_bins(each_slope(session, "bottom_depth", chosen), 4) for chosen in (SMALL, reference))
    (a, da), (b, db) = (significance.mean_and_error(values) for values in (found, wanted))
    scale = np.abs(b).max()
    assert np.hypot(da, db).max() < significance.largest_error(PASSES, 0.15) * scale
    lit = np.hypot(da, db) > 0
    z = np.maximum(np.abs(a - b) - 0.01 * scale, 0)[lit] / np.hypot(da, db)[lit]
    assert z.max() < significance.largest_z(PASSES, z.size), z.max()


@pytest.mark.long
@each_case(
    ("table1", {"layout": "2x2"}, "surface_slope_x_deg", 0.3, "lidar_merging"),
    ("table1", {"layout": "2x2"}, "surface_slope_x_deg", 0.3, "lidar_volpath"),
    ("table1", {}, "off_nadir_deg", 0.1, "lidar_merging"),
    ("table1", {}, "off_nadir_deg", 0.1, "lidar_volpath"),
    ("table1", {}, "bottom_depth", 0.1, "lidar_merging"),
    ("table1", {}, "bottom_depth", 0.1, "lidar_volpath"),
    ("flight", {"cube_depth": 20, "bottom_ripple_height": 0}, "bottom_slope_x_deg", 2.0, "lidar_merging"),
    ("flight", {"cube_depth": 20, "bottom_ripple_height": 0}, "bottom_slope_x_deg", 2.0, "lidar_volpath"),
    ("fig15_2x2", {}, "layer_tops[1]", 0.3, "lidar_merging"),
    ("table1", {"field_of_view_mrad": 12}, "field_of_view_mrad", 1.5, "lidar_merging"),
    ("table1", {"field_of_view_mrad": 12}, "field_of_view_mrad", 1.5, "lidar_volpath"),
    ("table1", {"field_of_view_mrad": 12}, "divergence_mrad", 1.5, "lidar_merging"),
    ("table1", {"field_of_view_mrad": 12}, "divergence_mrad", 1.5, "lidar_volpath"),
)
def test_geometry_against_scenes_beside_it(scene, params, name, step, integrator):
    """Every bin of 5 ns of every pixel, against the difference of two scenes on random numbers of their own.

    The difference has a bias by its step, allowed for as 3 % of the largest derivative of the pixel.
    """
    small = {"type": integrator, "paths_per_pass": 2**14}
    session = open_scene(scene, {**LEVEL, **params})
    found = in_bins(each_slope(session, name, small), 5)
    value = float(session.parameters[name.split("[")[0]].split(",")[-1])
    sides = []
    for number, sign in enumerate((1, -1)):
        moved = with_value(session.parameters, name, value + sign * step)
        other = open_scene(scene, {**LEVEL, **params, **{name.split("[")[0]: moved[name.split("[")[0]]}})
        sides.append(in_bins(each_energy(other, small, OTHERS * (number + 1), axis_of(session)), 5))
    wanted = (sides[0] - sides[1]) / (2 * step)
    (a, da), (b, db) = (significance.mean_and_error(values) for values in (found, wanted))
    scale = np.abs(b).max(axis=1, keepdims=True)
    # What is known: derivatives of the brightest bins to a tenth.
    assert np.hypot(da, db)[np.abs(b) == scale].max() < significance.largest_error(PASSES, 0.1) * scale.max()
    lit = np.hypot(da, db) > 0
    z = np.maximum(np.abs(a - b) - 0.03 * scale, 0)[lit] / np.hypot(da, db)[lit]
    assert z.max() < significance.largest_z(PASSES, z.size), z.max()


@pytest.mark.long
def test_mean_slope_of_the_sea_brightens_its_echo():
    """Facets at b = 20 degrees less the slope return light, of which there are exp(-tan(b)^2 / a^2) / cos(b)^4.

    With a^2 twice the variance along an axis, and the cosines of illumination and reflection, ln E grows by
    2 tan(b) / (a cos(b))^2 - 5 tan(b) per radian. The beam of 1 mrad is seen whole.
    """
    variance, angle = 0.01, np.deg2rad(20)
    sea = {"slope_variance": variance, "divergence_mrad": 1, "ripple_focusing": "false"}
    dark = {"scattering": 0, "backscattering": 0, "bottom_reflectance": 0}
    found, session = slopes("surface_slope_x_deg", {**sea, **dark})
    wanted = 2 * np.tan(angle) / variance / np.cos(angle) ** 2 - 5 * np.tan(angle)
    relative = np.rad2deg(found.sum(axis=1)) / energies(session).sum(axis=1).mean()
    significance.assert_equal(relative[:, None], [wanted], error=0.02, bias=0.01)
