"""Light among plants: echoes of leaves and through their gaps, against closed forms and between the integrators."""

import mitsuba as mi
import numpy as np
import pytest
import significance
from rows import each_case
from significance import assert_equal, largest_z, mean_and_error

from mitransient_lidar.physics.plants import Canopy

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
