"""Enhancement of echoes by ripples: a factor by depth and order of scattering, for meshes of any detail."""

import copy

import mitsuba as mi
import numpy as np
import pytest

from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.sea.double_passage import LEAST_DEPTH
from mitransient_lidar.transport.opaque import aligned
from mitransient_lidar.transport.paths.passes import PathClasses
from mitransient_lidar.transport.paths.path import PathPoint
from mitransient_lidar.transport.paths.ripple_focusing import Echo

SEA = {"spectrum": "elfouhaily", "wind_speed": 3.0, "slope_variance": "cox_munk", "shortest_wave": 1.0}
CLEAR = {"attenuation": 0.1, "scattering": 1e-4, "backscattering": 1e-6, "group_index": 1.364}


def renderer_of(scene, **options):
    return scene.integrator().prepare(scene, scene.sensors()[0], **options)


def factors_at(focusing, depth, events):
    """Return the table at depths [m] by interpolation in NumPy."""
    depths = np.geomspace(LEAST_DEPTH, 60, focusing.factors.shape[1])
    return np.interp(np.log(depth), np.log(depths), focusing.factors[events])


@pytest.mark.parametrize("integrator", [pytest.param("lidar_merging", marks=pytest.mark.slow), "lidar_volpath"])
def test_echoes_in_clear_water_have_the_factor_of_their_depth(lidar_scene, integrator):
    """The same paths with it and with factors of 1: bottom, column, and a surface echo that stays."""
    pose = {"altitude": 200.0, "off_nadir_deg": 8.0}
    parts = {"tx": {**pose, "divergence_mrad": 0.5}, "rx": {**pose, "layout": "1x1", "field_of_view_mrad": 5.0}}
    parts |= {"film": {"time_start_ns": 1330.0}, "integrator": {"type": integrator, "paths_per_pass": 2**13}}
    renderer = renderer_of(lidar_scene(**parts, sea=SEA, water=CLEAR)).by_origin()
    focusing, ones = renderer.focusing, copy.copy(renderer.focusing)
    # Another table has the same kernels.
    ones._table = aligned(mi.Float, np.ones_like(focusing.factors, np.float32))
    energies = []
    for renderer.focusing in (focusing, ones):
        energies.append(renderer.render_pass(3).histogram.energy().reshape(-1, 160))
    time = 1330.0 + np.arange(160) + 0.5
    sine = np.sin(np.radians(8.0))
    surface = 2e9 / C0 * 200.0 / np.sqrt(1 - sine**2)
    depth = (time - surface) * 1e-9 * C0 / (2 * 1.364) * np.sqrt(1 - (sine / 1.34) ** 2)
    names = renderer.classes.names
    with np.errstate(invalid="ignore"):
        ratio = energies[0] / energies[1]
    lit = energies[1] > 1e-3 * energies[1].max(axis=1, keepdims=True)
    row = names.index("surface")
    np.testing.assert_allclose(ratio[row][lit[row]], 1, rtol=1e-6)
    # The pixel's centre stands for its whole light, and a bin for its middle.
    row = names.index("water")
    used = lit[row] & (depth > 1.0) & (depth < 7.5)
    assert used.sum() > 20
    np.testing.assert_allclose(ratio[row][used], factors_at(focusing, depth[used], 0), rtol=0.06)
    bottom = energies[0][2].sum() / energies[1][2].sum()
    assert bottom == pytest.approx(factors_at(focusing, 8.0, 0), rel=0.01)
    assert bottom > 1.1


def test_factors_by_events_and_solids(lidar_scene):
    """One event turns light in the water, none on a solid."""
    scene = lidar_scene(sea=SEA, water={"attenuation": 0.3, "scattering": 0.15, "backscattering": 0.006})
    focusing = renderer_of(scene).focusing
    assert np.all(np.diff(focusing.factors[:5], axis=0)[:, :12] < 0)
    depth = np.array([0.6, 2.0, 5.0, 20.0])
    # Depth to length by hand: n_g 1.34 in these scenes, 20 degrees.
    length = 0.7 + 2 * 1.34 * depth / np.sqrt(1 - (np.sin(np.radians(20)) / 1.34) ** 2)
    for order, on_solid, events in ((1, False, 0), (3, False, 2), (0, True, 0), (2, True, 2), (30, False, 7)):
        echo = Echo(mi.Float(0.7), on_solid)
        found = focusing.of(echo, mi.UInt32(order), mi.Float(length))
        np.testing.assert_allclose(np.array(found), factors_at(focusing, depth, events), rtol=1e-3)
        at_surface = focusing.of(echo, mi.UInt32(order), mi.Float([0.7, 0.2]))
        np.testing.assert_allclose(np.array(at_surface), 1, atol=1e-3)
    glint = focusing.of(Echo(mi.Float(0.7), False), mi.UInt32(0), mi.Float(length))
    np.testing.assert_array_equal(np.array(glint), 1)


def test_a_switch_must_be_true_or_false(lidar_scene):
    with pytest.raises(Exception, match="ripple_focusing = 'maybe' must be true or false"):
        lidar_scene(sea=SEA | {"ripple_focusing": "maybe"})


@pytest.mark.parametrize(
    "parts",
    [
        {"sea": SEA | {"ripple_focusing": "false"}},
        {"sea": SEA, "tx": {"altitude": -2.0}, "rx": {"altitude": -2.0}, "film": {"time_start_ns": 0.0}},
    ],
    ids=["without", "under water"],
)
def test_seas_without_it(lidar_scene, parts):
    assert renderer_of(lidar_scene(**parts)).focusing is None


def test_labels_keep_pixel_and_events():
    classes = PathClasses(counted=True)
    events = mi.UInt32([0, 3, 15, 40])
    point = PathPoint(pixel=mi.UInt32(200_000_000), scatterings=events, reversals=mi.UInt32(7))
    found = classes.unpack(classes.pack(point))
    assert set(found) == {"pixel", "scatterings"}
    np.testing.assert_array_equal(np.array(found["pixel"]), 200_000_000)
    np.testing.assert_array_equal(np.array(found["scatterings"]), [0, 3, 15, 15])
