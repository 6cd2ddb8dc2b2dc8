"""Foam on the sea, and plants at the bottom."""

import mitsuba as mi
import numpy as np
import pytest
import rasterio
import significance
from oracles.beam_average import echo_energies
from rows import each_case, each_row, must_refuse
from significance import assert_equal, largest_z, mean_and_error

from mitransient_lidar.core.parameters.sea import OCEAN_SURFACE
from mitransient_lidar.physics.lidar.level_sea import LidarSystem
from mitransient_lidar.physics.plants import Canopy
from mitransient_lidar.physics.sea.cox_munk import LAWS, cox_munk, foam_cover, foam_whiteness
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
@pytest.mark.parametrize("integrator", ["lidar_volpath", "lidar_merging"])
def test_bottom_close_below_foam_that_transmits(lidar_scene, passes, integrator):
    """Light leaves the water with T / n^2: foam and bottom reflect R + T^2 rho / n^2 / (1 - R rho) together.

    Without the reciprocity of diffuse light (T on both ways) it would be 45 % more.
    """
    scene = lidar_scene(
        integrator={"type": integrator, "paths_per_pass": 2**14},
        film={"time_start_ns": 1400.0, "bin_width_ns": 40.0, "bin_count": 2},
        sea={"foam": "1", "foam_reflectance": 0.2, "foam_transmittance": 0.7},
        water={"attenuation": 0.0, "scattering": 0.0, "backscattering": 0.0},
        bottom=0.02,
        rho=0.8,
    )
    both = 0.2 + 0.7**2 * 0.8 / 1.34**2 / (1 - 0.2 * 0.8)
    energy = passes(scene, 16).sum(axis=(1, 2))
    assert_equal(energy, closed_form((0.01, 0.01), both, 1.0).bottom, error=0.005)


@pytest.mark.slow
def test_foam_over_a_bottom_in_turbid_water(lidar_scene, passes):
    """Half of a sea transmits diffuse light; both integrators find as much below it."""
    found = []
    for integrator, count, photons in (("lidar_volpath", 48, {}), ("lidar_merging", 24, {"photons_per_pass": 2**13})):
        scene = lidar_scene(
            integrator={"type": integrator, "paths_per_pass": 2**14, **photons},
            film={"time_start_ns": 1425.0, "bin_width_ns": 60.0, "bin_count": 1},
            sea={"foam": "0.5", "foam_reflectance": 0.2, "foam_transmittance": 0.7},
            bottom=2.0,
            rho=0.5,
        )
        # Paths of a seed are partly the same.
        found.append(mean_and_error(passes(scene, count, 1000 * len(found)).sum(axis=(1, 2))))
    (first, error), (second, other) = found
    assert np.hypot(error, other) < 0.005 * second
    assert abs(first - second) < largest_z(24) * np.hypot(error, other)


@pytest.mark.slow
@each_row((5.0, LAWS[0]), (10.0, LAWS[1]), (15.0, LAWS[2]), (15.0, "0.3"))
def test_mean_surface_echo_is_the_sum_of_its_shares(wind, foam, lidar_scene, passes):
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


def test_a_mask_is_read_as_a_map(tmp_path):
    """Foam lies where the map has it, in the map's rows and columns, and nowhere beyond it."""
    path = tmp_path / "mask.npz"
    mask = np.zeros((9, 9))
    mask[:, 6:] = 1.0
    mask[:2, :] = 0.0
    np.savez(path, heights=mask, x=np.arange(-4.0, 5.0), y=np.arange(-4.0, 5.0))
    patch = {"cell_size": 0.25, "shortest_wave": 1.0, "refined_size": 32.0, "size": 32.0}
    mesh = read(**patch, foam_map=str(path)).mesh()
    x, y, _ = np.moveaxis(mesh.vertices[mesh.faces].mean(axis=1), -1, 0)
    assert (mesh.foam[(x > 2) & (x < 4) & (y > -2) & (y < 4)] == 1).all()
    assert (mesh.foam[(x < 1) | (x > 5) | (y < -3) | (y > 5)] == 0).all()
    # A GeoTIFF whose middle lies 1 m west and 2 m north of the origin in its coordinates.
    corner = rasterio.Affine(1, 0, 499_999 - 4.5, 0, -1, 6_500_002 + 4.5)
    shape = {"width": 9, "height": 9, "count": 1, "dtype": "float32", "crs": "EPSG:32633", "transform": corner}
    with rasterio.open(tmp_path / "mask.tif", "w", driver="GTiff", **shape) as file:
        file.write(mask[::-1].astype(np.float32), 1)
    moved = read(**patch, foam_map=str(tmp_path / "mask.tif"), origin_x=500_000.0, origin_y=6_500_000.0).mesh()
    x, y, _ = np.moveaxis(moved.vertices[moved.faces].mean(axis=1), -1, 0)
    assert (moved.foam[(x > 1) & (x < 3) & (y > 0) & (y < 6)] == 1).all()
    assert (moved.foam[(x < 0) | (x > 4) | (y < -1) | (y > 7)] == 0).all()
    np.savez(path, heights=255 * mask, x=np.arange(-4.0, 5.0), y=np.arange(-4.0, 5.0))
    must_refuse(r"mask.npz has values from 0 to 255: shares of foam lie from 0 to 1", read, foam_map=str(path))


def test_infrared_foam_is_half_as_white():
    """Shape of Frouin et al. 1996 against 532 nm: table of 6S, 0.103 / 0.216 at 1064 nm."""
    assert foam_whiteness(532.0) == 1
    assert abs(foam_whiteness(1064.0) - 0.103 / 0.216) < 5e-3


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
        ({"foam": "0.1", "foam_transmittance": 0.9}, "foam_reflectance = 0.22 and foam_transmittance = 0.9 must"),
        ({"foam_map": "none.npz"}, "none.npz"),
    ):
        with pytest.raises(Exception, match=message):
            mi.load_dict({"type": "ocean_surface", **given})
    nested = {"type": "ocean_surface", "foam": "0.1", "rough": {"type": "roughdielectric"}}
    with pytest.raises(Exception, match="is beside ripples, which a nested bsdf replaces"):
        mi.load_dict(nested)
    must_refuse("foam", foam_cover, "-0.1", 5.0)


INTEGRATORS = ["lidar_merging", "lidar_volpath"]
CLEAR = {"attenuation": 0.0, "scattering": 0.0, "backscattering": 0.0}
#: A sea so smooth that light returns through the gap by which it came.
SMOOTH = {"slope_variance": "2e-5"}


def plate(bsdf):
    to_world = mi.ScalarTransform4f().translate([0, 0, -3.99]).scale(100)
    return {"plate": {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}}


def canopy(leaf_width, reflectance, transmittance, **parameters):
    leaf = {"type": "leaf", "reflectance": reflectance, "transmittance": transmittance}
    return {"plants": {"type": "canopy", "depth": 3.99, "leaf_width": leaf_width, "bsdf": leaf, **parameters}}


def echo(lidar_scene, passes, integrator, count, extra, off_nadir=0.0, water=CLEAR, sea=SMOOTH, **paths):
    photons = {
        name: number for name, number in paths.items() if integrator == INTEGRATORS[0] or name != "photons_per_pass"
    }
    scene = lidar_scene(
        integrator={"type": integrator, "paths_per_pass": 2**14, **photons},
        tx={"off_nadir_deg": off_nadir},
        rx={"layout": "1x1", "field_of_view_mrad": 30.0, "off_nadir_deg": off_nadir},
        film={"time_start_ns": 1345.0, "bin_width_ns": 1.0, "bin_count": 140},
        bottom=4.0,
        rho=0.5,
        extra=extra,
        water=water,
        sea=sea,
    )
    return passes(scene, count, significance.seed_shift)[:, 0].sum(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_light_through_a_leaf_as_wide_as_the_view(lidar_scene, passes, integrator):
    """Leaf and bottom close below reflect R + T^2 rho / (1 - R rho) together."""
    leaf = {"type": "leaf", "reflectance": 0.3, "transmittance": 0.4}
    both, error = mean_and_error(echo(lidar_scene, passes, integrator, 16, plate(leaf)))
    white = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 1.0}}
    white, of_white = mean_and_error(echo(lidar_scene, passes, integrator, 16, plate(white)))
    spread = np.hypot(error / both, of_white / white)
    assert spread < 0.007
    assert abs(both / white / (0.3 + 0.4**2 * 0.5 / (1 - 0.3 * 0.5)) - 1) < largest_z(16) * spread


@pytest.mark.slow
@each_case(*((name, "leaves") for name in INTEGRATORS), ("lidar_volpath", "blades"))
def test_direct_echo_passes_the_gaps_once(integrator, form, lidar_scene, passes):
    """exp(-G LAI) of black leaves, not its square: laser and receiver share the gaps."""
    # The plants of a seed vary more than a few paths.
    few = {"paths_per_pass": 2**13, "photons_per_pass": 2**13}
    bare = echo(lidar_scene, passes, integrator, 16, {}, **few).mean()
    seeds = range(1 + significance.seed_shift, 13 + significance.seed_shift)
    fields = [canopy(0.1, 0.0, 0.0, size=10.0, form=form, leaf_area_index=1.5, seed=seed) for seed in seeds]
    ratios = np.array([echo(lidar_scene, passes, integrator, 2, field, **few).mean() for field in fields]) / bare
    assert_equal(
        ratios, Canopy(1.5, 0.5, 0.1, np.radians(25.0) if form == "blades" else None).gap_probability(0.0), error=0.02
    )


@pytest.mark.slow
def test_plants_over_waves_in_turbid_water(lidar_scene, passes):
    water = {"attenuation": 0.3, "scattering": 0.2, "backscattering": 0.006}
    sea = {"spectrum": "elfouhaily", "slope_variance": "cox_munk"}
    plants = canopy(0.05, 0.3, 0.4, size=12.0, form="leaves")
    few = {"photons_per_pass": 2**13}
    first, second = (echo(lidar_scene, passes, name, 12, plants, 20.0, water, sea, **few) for name in INTEGRATORS)
    # Both integrators trace the same paths of the receiver for a seed, whose spread of 2.5 % a pass they share.
    difference, error = mean_and_error((first - second) / second.mean())
    assert error < 0.0015
    assert abs(difference) < largest_z(12) * error
