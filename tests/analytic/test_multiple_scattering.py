"""Multiple scattering, bin by bin, against an independent random walk in plain NumPy, in double precision.

The walk knows nothing of Mitsuba: photons go down through a flat, smooth surface at nadir, scatter by
Henyey-Greenstein, are reflected inside the surface by Fresnel's law, and at every event send the share of light that
the phase function turns towards the far receiver through the refracting surface (Poole, Venable and Campbell 1981,
doi:10.1364/AO.20.003653). Single scattering alone would be 20 to 90 % too low here, growing with the delay.
"""

from itertools import pairwise

import numpy as np
import pytest
from oracles.phase import henyey_greenstein
from oracles.refracted_path import refracted_path
from significance import assert_same, largest_error, mean_and_error

from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.lidar.level_sea import fresnel, solid_angle_per_area

HEIGHT, G = 200.0, 0.9
HALF_VIEW = 0.05  # tangent of the field of view's half angle: 10 m on the surface
#: The surface echo, across 1.7 ns, falls into the first gate, which is left out.
GATES_NS = 2e9 * HEIGHT / C0 + np.array([0.0, 3, *range(8, 50, 5), 58, 68, 80, 100])
#: Share of the directions that the walk draws about the vertical instead of the photon's direction, and their spread.
UPWARD_SHARE, UPWARD_G = 0.4, 0.8
ENERGY = 5e-3 * 0.81 * 0.9 * 0.025  # J m^2


def random_walk(attenuation, scattering, index, photons, seed):
    """Return the received energy [J] in each gate from light scattered once or more, without any bottom."""
    rng = np.random.default_rng(seed)
    position = np.zeros((photons, 3))
    direction = np.tile([0.0, 0.0, -1.0], (photons, 1))
    weight = np.full(photons, float(fresnel(0.0, index)[1]))
    length = np.zeros(photons)
    energy = np.zeros(len(GATES_NS) - 1)
    longest = (GATES_NS[-1] - GATES_NS[0]) * 1e-9 * C0 / index  # way in the water at the last gate's end [m]
    while len(weight):
        step = -np.log(rng.random(len(weight))) / attenuation
        # Light that gets to the surface is reflected back down; what leaves there is not the receiver's to see.
        up = direction[:, 2] > 0
        to_surface = np.where(up, -position[:, 2] / np.where(up, direction[:, 2], 1), np.inf)
        crosses = step > to_surface
        travel = np.minimum(step, to_surface)
        position += direction * travel[:, None]
        length += travel
        if crosses.any():
            sine = index * np.sqrt(np.maximum(0, 1 - direction[crosses, 2] ** 2))
            inside = np.where(sine < 1, fresnel(np.arcsin(np.minimum(sine, 1 - 1e-12)), index)[0], 1.0)
            weight[crosses] *= inside
            direction[crosses, 2] *= -1
            position[crosses, 2] = -1e-12
        event = ~crosses
        weight[event] *= scattering / attenuation
        energy += connect(position[event], direction[event], weight[event], length[event], attenuation, index)
        direction[event], factor = scatter(rng, direction[event])
        weight[event] *= factor
        keep = (length < longest) & (weight > 1e-7)
        position, direction, weight, length = position[keep], direction[keep], weight[keep], length[keep]
    return energy * ENERGY / photons


def connect(position, direction, weight, length, attenuation, index):
    """Return what the events send to the receiver, by gate [1/m^2]."""
    radius, depth = np.hypot(position[:, 0], position[:, 1]), -position[:, 2]
    theta, phi = refracted_path(radius, HEIGHT, depth, index)
    seen = np.tan(theta) < HALF_VIEW
    horizontal = -np.sin(phi)[:, None] * position[:, :2] / np.maximum(radius, 1e-12)[:, None]
    up = np.column_stack([horizontal, np.cos(phi)])
    angle = np.arccos(np.clip(np.sum(up * direction, axis=1), -1, 1))
    wet = depth / np.cos(phi)
    share = weight * henyey_greenstein(angle, G) * solid_angle_per_area(HEIGHT, depth, theta, index)
    share *= np.exp(-attenuation * wet) * fresnel(theta, index)[1]
    time_ns = 1e9 / C0 * (HEIGHT + index * (length + wet) + HEIGHT / np.cos(theta))
    return np.histogram(time_ns[seen], GATES_NS, weights=share[seen])[0]


def scatter(rng, direction):
    """Return directions, some of them about the vertical, and phase function over density of drawing them."""
    upward = rng.random(len(direction)) < UPWARD_SHARE
    axis, g = np.where(upward[:, None], [0.0, 0.0, 1.0], direction), np.where(upward, UPWARD_G, G)
    u = rng.random(len(direction))
    cosine = (1 + g**2 - ((1 - g**2) / (1 - g + 2 * g * u)) ** 2) / (2 * g)
    sine, azimuth = np.sqrt(np.maximum(0, 1 - cosine**2)), 2 * np.pi * rng.random(len(direction))
    helper = np.where(np.abs(axis[:, [2]]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    first = np.cross(axis, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(axis, first)
    side = np.cos(azimuth)[:, None] * first + np.sin(azimuth)[:, None] * second
    turned = cosine[:, None] * axis + sine[:, None] * side
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    phase = henyey_greenstein(np.arccos(np.clip(np.sum(turned * direction, axis=1), -1, 1)), G)
    about_vertical = henyey_greenstein(np.arccos(np.clip(turned[:, 2], -1, 1)), UPWARD_G)
    return turned, phase / ((1 - UPWARD_SHARE) * phase + UPWARD_SHARE * about_vertical)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((0.3, 0.15, 1.34), marks=pytest.mark.long),
        pytest.param((0.8, 0.64, 1.34), marks=pytest.mark.long),
        pytest.param((0.8, 0.64, 1.0001), marks=pytest.mark.long),
    ],
    ids=str,
)
def walks(request):
    """Return attenuation, scattering and index, and the energies of independent walks."""
    return request.param, np.array([random_walk(*request.param, 6000, seed) for seed in range(20)])


@pytest.mark.parametrize(
    ("integrator", "view", "count", "paths"),
    [pytest.param("lidar_volpath", 0.5e-3, 48, 2**16, marks=pytest.mark.long), ("lidar_merging", 5e-3, 16, 2**14)],
    ids=str,
)
def test_waveform_agrees_with_an_independent_random_walk(lidar_scene, passes, walks, integrator, view, count, paths):
    (attenuation, scattering, index), references = walks
    # By reciprocity (tested on its own) the pencil beam and the wide view of the walk may be exchanged: a wide beam
    # lights every vertex, where a pencil would be met by chance. Energies go with the solid angle that is seen. Merging
    # would be slow with a view that is smaller than a cell.
    beam = 2 * HALF_VIEW
    photons = {"photons_per_pass": paths} if integrator == "lidar_merging" else {}
    scene = {
        "integrator": {"type": integrator, "paths_per_pass": paths, **photons},
        "tx": {"off_nadir_deg": 0.0, "beam_profile": "top_hat", "divergence_mrad": 1e3 * beam},
        "rx": {"off_nadir_deg": 0.0, "field_of_view_mrad": 1e3 * view, "layout": "1x1"},
        "film": {"time_start_ns": float(GATES_NS[0]), "bin_width_ns": 0.5, "bin_count": 200},
        "bottom": None,
    }
    water = {"attenuation": attenuation, "scattering": scattering, "backscattering": 0.01}
    water |= {"phase_function": "hg", "phase_g": G, "refractive_index": index, "group_index": index}
    energy = passes(lidar_scene(**scene, water=water), count)[:, 0] * (beam / view) ** 2
    edges = np.round((GATES_NS - GATES_NS[0]) / 0.5).astype(int)
    rendered = np.array([energy[:, a:b].sum(axis=1) for a, b in pairwise(edges)]).T[:, 1:]
    reference = references[:, 1:]
    # Few bright walks make the light of the last gates: its mean is compared where it happens to be known to 10 %.
    early = np.hypot(*(np.divide(*mean_and_error(energies[:, :9])[::-1]) for energies in (rendered, reference)))
    assert np.all(early < largest_error(min(count, len(reference)), 0.05)), early
    assert_same(rendered, reference, error=0.01)
