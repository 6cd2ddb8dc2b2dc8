"""Layers of other refractive indices, and layers of one water."""

import mitsuba as mi
import numpy as np
import pytest
from significance import largest_z

from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.lidar.level_sea import fresnel

HEIGHT, THETA, AREA = 200.0, np.radians(20.0), 0.025
INDEX, GROUP, THICKNESS = np.array([1.34, 1.6, 1.2]), np.array([1.36, 1.25, 1.2]), np.array([2.0, 3.0, 3.0])
WATER = {"layer_tops": "0, 2, 5", "refractive_index": "1.34, 1.6, 1.2", "group_index": "1.36, 1.25, 1.2"}


def few(integrator):
    return {"photons_per_pass": 2**13} if integrator == "lidar_merging" else {}


def across(theta):
    """Return how far a ray gets sideways from the receiver to the bottom [m], and its angles in the index layers."""
    phi = np.arcsin(np.sin(theta) / INDEX)
    return HEIGHT * np.tan(theta) + np.sum(THICKNESS * np.tan(phi)), phi


def bottom_echo(attenuation, reflectance):
    """Return arrival [ns] and energy [J] of a narrow beam's echo from the bottom below three index layers.

    The solid angle of the aperture from the bottom is that of the bundle of rays: sideways its width grows by
    offset / sin(phi), in the plane of incidence by cos(theta) d(offset)/d(phi), with phi at the bottom.
    """
    offset, phi = across(THETA)
    step = 1e-6
    (ahead, phi_ahead), (behind, phi_behind) = across(THETA + step), across(THETA - step)
    tangential = np.cos(THETA) * (ahead - behind) / (phi_ahead[-1] - phi_behind[-1])
    solid_angle = AREA / (offset / np.sin(phi[-1]) * tangential)
    slant = THICKNESS / np.cos(phi)
    sent = 5e-3 * 0.81 * 0.9 * fresnel(THETA, INDEX[0])[1] ** 2 * np.exp(-2 * attenuation * slant.sum())
    arrival = 2e9 / C0 * (HEIGHT / np.cos(THETA) + np.sum(GROUP * slant))
    return arrival, sent * reflectance / np.pi * np.cos(phi[-1]) * solid_angle


@pytest.mark.parametrize("integrator", ["lidar_volpath", pytest.param("lidar_merging", marks=pytest.mark.long)])
def test_bottom_echo_comes_in_time_and_strength_of_the_refracted_path(lidar_scene, passes, z_score, integrator):
    """With one group index for all the echo would come 5 ns late; without bending it would have a fifth less energy."""
    arrival, expected = bottom_echo(attenuation=0.1, reflectance=0.1)
    narrow = {"divergence_mrad": 0.2}
    scene = lidar_scene(
        integrator={"type": integrator, "paths_per_pass": 2**14, **few(integrator)},
        tx=narrow,
        rx={"field_of_view_mrad": 20.0, "layout": "1x1"},
        film={"bin_width_ns": 0.25, "bin_count": 640},
        sea={"slope_variance": "2e-5"},
        water={**WATER, "attenuation": 0.1, "scattering": 0.0, "backscattering": 0.0},
    )
    energy = passes(scene, 16)[:, 0]
    late = energy[:, 200:]  # without the surface echo
    time = 1390 + 0.25 * (np.arange(200, 640) + 0.5)
    assert abs(np.average(time, weights=late.mean(axis=0)) - arrival) < 0.1
    z, relative = z_score(late.sum(axis=1), expected)
    # The partial reflections between the index_layers, 1 % a crossing here, are left out by both.
    assert abs(z) < largest_z(16), (z, late.sum(axis=1).mean() / expected)
    assert relative < 0.015


@pytest.mark.slow
def test_strata_of_one_index_are_one(lidar_scene, passes):
    layered = {"layer_tops": "0, 2, 5", "refractive_index": "1.34, 1.34, 1.34"}
    energies = [passes(lidar_scene(water=water), 2) for water in (layered, {"layer_tops": "0, 2, 5"})]
    np.testing.assert_array_equal(*energies)


@pytest.mark.slow
def test_index_changes_within_the_waves_are_refused(lidar_scene, passes):
    water = {"layer_tops": "0, 0.01", "refractive_index": "1.335, 1.34"}
    scene = lidar_scene(sea={"spectrum": "elfouhaily", "wind_speed": 6.0, "size": 60.0}, water=water)
    with pytest.raises((RuntimeError, ValueError), match=r"refractive_index changes at 0.01 m, within the waves"):
        passes(scene, 1)


@pytest.mark.slow
def test_layers_below_the_bottom_are_refused(lidar_scene, passes):
    with pytest.raises(
        (RuntimeError, ValueError), match=r"layer_tops = 9 m is a layer below the bottom: .* less than 8 m"
    ):
        passes(lidar_scene(water={"layer_tops": "0, 9", "attenuation": "0.3, 0.4"}), 1)


@pytest.mark.parametrize("integrator", ["lidar_volpath", pytest.param("lidar_merging", marks=pytest.mark.long)])
def test_a_plate_on_a_boundary_is_that_above_it(lidar_scene, integrator):
    """The same random numbers: light would pass through the plate, upwards as well, and 8 % of its echo be missing."""
    energies = []
    for above in (0.0, 2e-4):
        place = mi.ScalarTransform4f().translate([0, 0, above - 2]).scale(0.8)
        plate = {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": 0.5}}
        scene = lidar_scene(
            integrator={"type": integrator, "paths_per_pass": 2**13, **few(integrator)},
            water={**WATER, "attenuation": 0.2, "scattering": 0.1},
            extra={"plate": plate},
            film={"bin_width_ns": 1000.0, "bin_count": 1},
        )
        renderer = scene.integrator().prepare(scene, scene.sensors()[0]).by_origin()
        energy = renderer.render_pass(0).histogram.energy()
        # By name: Mitsuba's loader may turn the order of solids.
        of_origin = dict(
            zip(renderer.classes.names, energy.reshape(-1, renderer.classes.count).sum(axis=0), strict=True)
        )
        energies.append([of_origin[name] for name in sorted(of_origin)])
    np.testing.assert_allclose(*energies, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", [pytest.param("lidar_merging", marks=pytest.mark.long), "lidar_volpath"])
def test_layers_of_one_water_are_that_water(lidar_scene, passes, integrator):
    """Same seeds, same light: to the bit where layers are equal, as they are joined.

    Where they differ by 1e-7 flights through the edges are rounded, which moves one contribution in 1e5. A path that
    ends elsewhere may shift the random numbers of all that follow, as in one of 50 passes of 2^14 paths, and of 200 of
    2^12: most of five are compared.
    """

    # Paths, not waves, are compared: a coarse mesh is made in no time.
    sea = {"spectrum": "elfouhaily", "size": 60.0, "cell_size": 0.5}

    def record(layer_tops, attenuation="0.9", scattering=0.7):
        water = {"layer_tops": layer_tops, "attenuation": attenuation, "scattering": scattering}
        water |= {"backscattering": 0.014}
        engine = {"type": integrator, "paths_per_pass": 2**12}
        if integrator == "lidar_merging":
            engine["photons_per_pass"] = 2**12
        return passes(lidar_scene(integrator=engine, water=water, sea=sea), 5)

    whole = record("0")
    lit = np.sum(whole > 0, axis=(1, 2))

    def share_of_equal_bins(other):
        equal = np.isclose(whole, other, rtol=1e-5, atol=0) & (whole > 0)
        return np.median(equal.sum(axis=(1, 2)) / lit)

    np.testing.assert_array_equal(record("0, 1.1, 2.3, 5.7"), whole)
    divided = record("0, 1.1, 2.3, 5.7", "0.9, 0.9000001, 0.9, 0.9000001")
    assert share_of_equal_bins(divided) > 0.9
    np.testing.assert_allclose(np.median(divided.sum(axis=2) / whole.sum(axis=2), axis=0), 1, atol=1e-4)
    # Of other water the surface echo alone is the same, in a twentieth of the bins.
    assert share_of_equal_bins(record("0", scattering=0.701)) < 0.1
