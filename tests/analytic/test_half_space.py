"""Both integrators against Chandrasekhar's exact solution: a half-space that scatters isotropically, index matched.

Light returned to a far receiver along the beam is single scattering, omega / (8 pi) of what is sent per solid angle,
times H(mu)^2 (Chandrasekhar 1960, Radiative Transfer). The attenuation is 1 /m, so that metres are mean free paths;
from 20 km the whole layer that takes part is at one distance. A wide beam and a narrower view stand for a pencil and
a wide view, which are their exchange (reciprocity is tested on its own): no light is lost sideways.
"""

import numpy as np
import pytest
from oracles.half_space import chandrasekhar_h
from rows import each_case
from significance import assert_equal, largest_z

from mitransient_lidar.core.constants import C0
from mitransient_lidar.rendering.derivatives import path_parameters

HEIGHT = 2e4
ENERGY = 5e-3 * 0.81 * 0.9 * 0.025  # J m^2
#: What the lowest index that water may have, 1.0001, does (n^2 and refraction, 5e-4 at 60 degrees), and the step of
#: about 1e-4 m by which rays start off the surface.
NOT_MATCHED = 1e-3


def single_scattering(degrees, albedo):
    """Return the energy received from light scattered once [J]."""
    return ENERGY * albedo / (8 * np.pi) * (np.cos(np.radians(degrees)) / HEIGHT) ** 2


def half_space(lidar_scene, degrees, albedo, view, beam, integrator):
    """Return the scene of a half-space, for a view and a beam of these radii [m] at the surface."""
    slant = HEIGHT / np.cos(np.radians(degrees))
    pose = {"altitude": HEIGHT, "off_nadir_deg": degrees}
    # Light that comes later has been absorbed, but for exp(-8) of the little that stays in the water so long. The far
    # edge of a slanted view is seen later than its middle.
    longest = 8 / (1 - albedo) + 2 * view * np.tan(np.radians(degrees))
    return lidar_scene(
        integrator=integrator,
        tx={**pose, "beam_profile": "top_hat", "divergence_mrad": 2e3 * beam / slant},
        rx={**pose, "field_of_view_mrad": 2e3 * view / slant, "layout": "1x1"},
        film={"time_start_ns": 0.0, "bin_width_ns": 1e9 / C0 * (2 * slant + longest), "bin_count": 1},
        sea={"slope_variance": "1e-3"},
        water={
            **{"attenuation": 1.0, "scattering": albedo, "backscattering": albedo / 2},
            **{"phase_function": "hg", "phase_g": 0.0, "refractive_index": 1.0001, "group_index": 1.0},
        },
        bottom=None,
    )


def returned(lidar_scene, passes, count, degrees, albedo, view, beam, integrator):
    scene = half_space(lidar_scene, degrees, albedo, view, beam, integrator)
    # Energies go with the solid angle that is seen.
    return passes(scene, count)[:, 0, 0] * (beam / view) ** 2


@each_case(
    pytest.param(0.5, 0.0, marks=pytest.mark.long),
    pytest.param(0.5, 40.0, marks=pytest.mark.long),
    pytest.param(0.9, 20.0, marks=pytest.mark.long),
    pytest.param(0.9, 60.0, marks=pytest.mark.slow),
    pytest.param(0.99, 0.0, marks=pytest.mark.long),
    pytest.param(0.99, 60.0, marks=pytest.mark.long),
)
def test_reference_returns_h_squared(albedo, degrees, lidar_scene, passes, z_score):
    """Light of up to hundreds of scatterings; at albedo 0.99 it is 3 to 6 times the single scattering."""
    # No direction is drawn towards the laser: each such draw costs variance, and here are hundreds.
    walk = {"paths_per_pass": 2**15, "guiding_probability": 0.0, "roulette_threshold": 0.5}
    beam = {0.5: 20.0, 0.9: 40.0, 0.99: 100.0}[albedo]
    energy = returned(lidar_scene, passes, 24, degrees, albedo, 0.1, beam, walk)
    expected = single_scattering(degrees, albedo) * chandrasekhar_h(np.cos(np.radians(degrees)), albedo) ** 2
    z, relative = z_score(energy, expected)
    assert relative < 1.2e-3
    assert abs(z) < largest_z(24) + NOT_MATCHED / relative, energy.mean() / expected
    assert abs(energy.mean() / expected - 1) < 5e-3


@each_case(
    pytest.param("lidar_volpath", 0.5, 0.0, 0.1, 20.0, marks=pytest.mark.slow),
    pytest.param("lidar_volpath", 0.9, 60.0, 0.1, 40.0, marks=pytest.mark.long),
    pytest.param("lidar_merging", 0.5, 0.0, 4.0, 14.0, marks=pytest.mark.long),
    pytest.param("lidar_merging", 0.9, 60.0, 5.0, 22.0, marks=pytest.mark.long),
)
def test_derivatives_by_absorption_and_scattering(integrator, albedo, degrees, view, beam, lidar_scene):
    """The energy is a function of the albedo w = b / (a + b) alone, w H(mu, w)^2, since lengths do not matter.

    With a + b = 1 the derivatives are -w dE/dw by a at fixed b, and (1 - w) dE/dw by b at fixed a. H is differentiated
    numerically. Biases are those of the energy, by the index and by the blur of cells.
    """
    count, mu, step = 16, np.cos(np.radians(degrees)), 1e-4
    options = {"type": integrator, "paths_per_pass": 2**14}
    if integrator == "lidar_volpath":
        options |= {"guiding_probability": 0.0, "roulette_threshold": 0.5}
    else:
        options |= {"paths_per_pass": 2**13, "photons_per_pass": 2**13, "cell_size": 0.2, "point_spacing": 0.3 * mu}
    scene = half_space(lidar_scene, degrees, albedo, view, beam, options)
    renderer = scene.integrator().prepare(scene, scene.sensors()[0])
    parameters = path_parameters(renderer, ["attenuation", "scattering"])
    renderer = renderer.perturbed([one.perturbation for one in parameters])
    by_c, by_b = np.array([renderer.render_pass(seed).histogram.perturbed()[:, 0, 0] for seed in range(count)]).T
    received = [omega * chandrasekhar_h(mu, omega) ** 2 for omega in (albedo - step, albedo + step)]
    slope = single_scattering(degrees, 1.0) * (received[1] - received[0]) / (2 * step)
    # By a with b fixed, all that is added to c; by b with a fixed, as much is added to c and to b.
    found = np.stack([-by_c, by_c + by_b]) * (beam / view) ** 2
    bias = NOT_MATCHED + (4e-3 if integrator == "lidar_merging" else 0.0)
    for samples, wanted in zip(found, (albedo * slope, (1 - albedo) * slope), strict=True):
        assert_equal(samples[:, None], [wanted], error=0.012, bias=bias)
