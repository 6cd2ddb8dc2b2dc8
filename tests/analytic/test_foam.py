"""Foam: a Lambertian plate on the sea, as much of it as the wind says, on crests and in surf."""

import mitsuba as mi
import numpy as np
import pytest
from oracles.beam_average import echo_energies
from rows import each_row
from significance import assert_equal

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.sea import OCEAN_SURFACE
from mitransient_lidar.physics.lidar.level_sea import LidarSystem
from mitransient_lidar.physics.sea.cox_munk import cox_munk
from mitransient_lidar.physics.sea.foam import LAWS, foam_cover
from mitransient_lidar.physics.sea.sea_surface import SeaSurface
from mitransient_lidar.physics.sea.shoaling import BottomDepths
from mitransient_lidar.physics.water.layers import WaterColumn

BLACK = {"attenuation": 20.0, "scattering": 0.0, "backscattering": 0.0}
#: Of the field of view [rad].
RADIUS = 15e-3


def closed_form(variance, reflectance, index):
    """Return energies [J] of the echoes of sea and Lambertian plate at z = 0 in a field of view of 30 mrad."""
    lidar = LidarSystem(200.0, np.radians(20.0), index, index, energy=5e-3 * 0.81 * 0.9, aperture_area=0.025)
    water = WaterColumn.from_text(0.0, 1e-9, 0.0, 0.0)
    return echo_energies(
        lidar, 5e-3, water, 0.0, 1e-6, reflectance, variance, field_of_view=lambda x, y: np.hypot(x, y) < RADIUS
    )


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["lidar_volpath", "lidar_merging"])
def test_whole_cover_is_a_lambertian_plate(lidar_scene, passes, integrator):
    """The water below gets no light."""
    scene = lidar_scene(
        integrator={"type": integrator, "paths_per_pass": 2**14},
        film={"time_start_ns": 1400.0, "bin_width_ns": 40.0, "bin_count": 2},
        sea={"foam": "1", "foam_reflectance": 0.4},
    )
    energy = passes(scene, 8).sum(axis=(1, 2))
    assert_equal(energy, closed_form((0.01, 0.01), 0.4, 1.0).bottom, error=0.003)


@pytest.mark.slow
@each_row("wind, foam", [(5.0, LAWS[0]), (10.0, LAWS[1]), (15.0, LAWS[2]), (15.0, "0.3")])
def test_mean_surface_echo_is_the_sum_of_its_shares(lidar_scene, passes, wind, foam):
    """A level sea has the cover everywhere; its water is black."""
    variance = cox_munk(wind)
    scene = lidar_scene(
        integrator={"type": "lidar_volpath", "paths_per_pass": 2**13},
        film={"time_start_ns": 1400.0, "bin_width_ns": 40.0, "bin_count": 1},
        sea={"slope_variance": "cox_munk", "wind_speed": wind, "foam": foam},
        water=BLACK,
    )
    energy = passes(scene, 8).sum(axis=(1, 2))
    cover = foam_cover(foam, wind)
    sea, plate = closed_form(variance, 0.22, 1.34).surface, closed_form(variance, 0.22, 1.0).bottom
    # Smith's masking by facets, which closed forms lack, is below 1e-3 here.
    assert_equal(energy, (1 - cover) * sea + cover * plate, error=0.005, bias=0.004)


def read(depths=None, **parameters):
    return SeaSurface.read(OCEAN_SURFACE.reader(parameters.get), depths=depths)


def test_foam_lies_on_crests():
    """As much of it as there should be, and only surf has more."""
    patch = {"cell_size": 0.25, "shortest_wave": 1.0, "refined_size": 64.0, "size": 64.0, "wind_speed": 10.0}
    shares, heights = [], []
    for seed in range(8):
        mesh = read(**patch, foam="0.05", surface_seed=seed).mesh()
        shares.append(mesh.foam.mean())
        z = mesh.vertices[mesh.faces, 2].mean(axis=1)
        heights.append(z[mesh.foam == 1].mean() - z.mean())
    assert_equal(np.array(shares)[:, None], np.array([0.05]), error=0.1)
    assert np.mean(heights) > 0.1
    # No cover is no foam: the same faces with the same BSDF.
    assert not read(**patch, foam="0").has_foam
    assert read(**patch, foam="0").mesh().foam is None
    sea = read(**patch, foam="0.05")
    both, _ = sea.patches(np.array([[0.0, 0.0], [40.0, 9.0]]), 16.0, [sea, sea])
    alone, _ = sea.patches(np.array([[40.0, 9.0]]), 16.0, [sea])
    np.testing.assert_array_equal(both.foam[len(both.foam) // 2 :], alone.foam)
    assert 0 < alone.foam.mean() < 0.2
    beach = BottomDepths(-10.0, lambda x, y: np.broadcast_to(-0.05 * x, (len(y), len(x))).copy())
    mesh = read(beach, **patch, foam="0.01", surf_foam=0.5, shoaling="bottom", centre_x=-16.0).mesh()
    x = mesh.vertices[mesh.faces, 0].mean(axis=1)
    assert mesh.foam[x < -44].mean() < 0.05
    assert 0.3 < mesh.foam[(x > -12) & (x < -2)].mean() < 0.6


def test_laws_and_refusals():
    # Albert et al. 2016, doi:10.5194/acp-16-13725-2016, quote the second law; its parts meet at 10.2 m/s.
    table = {LAWS[0]: (0.0098, 0.0406), LAWS[1]: (0.00795, 0.0236), LAWS[2]: (0.00433, 0.0570)}
    for law, covers in table.items():
        np.testing.assert_allclose([foam_cover(law, wind) for wind in (10.0, 15.0)], covers, rtol=5e-3)
        assert foam_cover(law, 3.0) < 2e-4
    low, high = (foam_cover(LAWS[1], wind) for wind in (10.18, 10.19))
    assert 0 < high / low - 1 < 0.01
    for given, message in (
        ({"foam": "1.5"}, "foam = 1.5 must lie between 0 and 1"),
        ({"foam": "koepke"}, "foam = 'koepke' must be none, monahan"),
        ({"surf_foam": 0.3}, "surf_foam = 0.3 needs foam"),
        ({"foam": "0.1", "foam_reflectance": 1.2}, "foam_reflectance = 1.2 must"),
    ):
        with pytest.raises(Exception, match=message):
            mi.load_dict({"type": "ocean_surface", **given})
    nested = {"type": "ocean_surface", "foam": "0.1", "rough": {"type": "roughdielectric"}}
    with pytest.raises(Exception, match="is beside ripples, which a nested bsdf replaces"):
        mi.load_dict(nested)
    with pytest.raises(UserError, match="foam"):
        foam_cover("-0.1", 5.0)
