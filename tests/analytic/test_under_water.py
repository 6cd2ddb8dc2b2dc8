"""Lidars under water: closed forms of bottom, column and surface, and agreement of the integrators."""

from dataclasses import replace
from itertools import pairwise

import mitsuba as mi
import numpy as np
import pytest
from oracles.phase import henyey_greenstein
from scipy.integrate import quad
from significance import largest_error, largest_z, mean_and_error

import mitransient_lidar
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.level_sea import fresnel
from mitransient_lidar.rendering.accumulators import placed_gates
from mitransient_lidar.rendering.describe import lines_of_sight
from mitransient_lidar.rendering.scene_checks import check_scene
from mitransient_lidar.transport.scene_parts import find_lidar_scene

GROUP = 1.34
#: Pulse energy and area of the aperture with all losses [J m^2]: a factor of n^2 would be 1.8 or 0.56.
SYSTEM = 5e-3 * 0.81 * 0.9 * 0.025
START, BINS = 9.0, 96
CLEAR = {"attenuation": 0.1, "scattering": 0.0, "backscattering": 0.0}
INTEGRATORS = ["lidar_merging", "lidar_volpath"]


@pytest.fixture
def build(lidar_scene):
    def scene(
        altitude,
        off_nadir_deg,
        integrator="lidar_merging",
        tx=None,
        rx=None,
        paths=2**14,
        bins=BINS,
        start=START,
        film=None,
        **options,
    ):
        pose = {"altitude": altitude, "off_nadir_deg": off_nadir_deg}
        photons = {"photons_per_pass": paths // 2} if integrator == "lidar_merging" else {}
        return lidar_scene(
            integrator={"type": integrator, "paths_per_pass": paths, **photons},
            tx={**pose, "divergence_mrad": 4.0, **(tx or {})},
            rx={**pose, "layout": "1x1", "field_of_view_mrad": 40.0, **(rx or {})},
            film={"time_start_ns": start, "bin_width_ns": 1.0, "bin_count": bins, **(film or {})},
            **options,
        )

    return scene


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["lidar_volpath", pytest.param("lidar_merging", marks=pytest.mark.long)])
def test_bottom_below_a_boat(build, passes, z_score, integrator):
    """A Lambertian bottom 7 m below a lidar at 1 m: E rho/pi A exp(-2 c d)/d^2, after 2 n_g d / c0."""
    distance = 7.0
    energy = passes(build(-1.0, 0.0, integrator, water=CLEAR), 8)[:, 0]
    expected = SYSTEM * 0.1 / np.pi * np.exp(-0.2 * distance) / distance**2
    z, error = z_score(energy.sum(axis=1), expected)
    assert abs(z) < largest_z(8) + 1e-3 / error  # the beam's rim is 0.1 % weaker
    assert error < largest_error(8, 0.01)
    due = 2e9 * GROUP * distance / C0
    assert energy[:, int(due - START)].sum() > 0.99 * energy.sum()


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("angle", [90.0, 150.0, 35.0])
def test_target_ahead_in_any_direction(build, passes, z_score, integrator, angle):
    """A plate 5 m ahead, level, above or below a lidar at 9 m, in an automatic record: as the bottom below a boat."""
    distance, depth, along = 5.0, 9.0, np.radians(angle)
    ahead = np.array([np.sin(along), 0.0, -np.cos(along)])
    place, lidar = [0, 0, -depth] + distance * ahead, [0.0, 0.0, -depth]
    plate = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.2}}}
    plate["to_world"] = mi.ScalarTransform4f().look_at(place.tolist(), lidar, [0, 1, 0])
    water = {**CLEAR, "attenuation": 0.25}
    record = {"start": "auto", "bins": "auto", "bottom": None, "extra": {"plate": plate}}
    energy = passes(build(-depth, angle, integrator, water=water, **record), 8)[:, 0]
    expected = SYSTEM * 0.2 / np.pi * np.exp(-2 * 0.25 * distance) / distance**2
    z, error = z_score(energy.sum(axis=1), expected)
    assert abs(z) < largest_z(8) + 1e-3 / error
    assert error < largest_error(8, 0.01)
    due = 2e9 * GROUP * distance / C0
    assert energy[:, int(due - 1.0)].sum() > 0.99 * energy.sum()


@pytest.mark.parametrize("angle", [0.0, 40.0, 90.0, 120.0, 180.0])
def test_automatic_records_begin_where_they_may(build, angle):
    """Also where the film has gates, which may lie before the surface echo; 0.45 ns is 5 cm from the lidar."""
    gates = {"gate_count": 3, "gate_start_range": 1.0, "gate_width_ns": 5.0}
    scene = build(-3.0, angle, start="auto", bins="auto", film=gates)
    renderer = scene.integrator().prepare(scene, scene.sensors()[0])
    check_scene(renderer.probe)
    assert renderer.scene.axis.start_ns == 1.0
    train = placed_gates(renderer.scene, None, 0.0)
    assert train.start_ns == pytest.approx(2e9 * GROUP * 1.0 / C0, abs=1e-9)
    if angle != 90.0:
        # The depth of that range.
        deeper = replace(renderer.scene.gates, given="gate_start_depth", start=3.0 + np.cos(np.radians(angle)))
        assert renderer.scene.gate_train(deeper).start_ns == pytest.approx(train.start_ns, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("view", [40.0, pytest.param(5.0, marks=pytest.mark.long)])
def test_single_scattering_below_a_boat(build, passes, integrator, view):
    """E A beta(pi) exp(-2 c r) / r^2 times the share of the Gaussian beam in the view."""
    scattering = 1.5e-5
    water = {"attenuation": 0.4, "scattering": scattering, "backscattering": 3e-7}
    water |= {"phase_function": "hg", "phase_g": 0.6}
    scene = build(-1.0, 0.0, integrator, water=water, bottom=60.0, rx={"field_of_view_mrad": view})
    energy = passes(scene, 16)[:, 0].reshape(16, -1, 8).sum(axis=2)[:, :8]
    level = SYSTEM * scattering * float(henyey_greenstein(np.pi, 0.6)) * (1 - np.exp(-0.5 * (view / 4.0) ** 2))
    edges = 1e-9 * C0 / (2 * GROUP) * (START + 8.0 * np.arange(9))
    spans = pairwise(edges)
    expected = np.array([quad(lambda r: level * np.exp(-0.8 * r) / r**2, *span)[0] for span in spans])
    error = energy.std(axis=0, ddof=1) / np.sqrt(16)
    z = (energy.mean(axis=0) - expected) / error
    assert np.abs(z).max() < largest_z(16, z.size), z
    assert np.all(error < largest_error(16, 0.03) * expected)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["lidar_volpath", pytest.param("lidar_merging", marks=pytest.mark.long)])
def test_surface_above_a_diver(build, passes, z_score, integrator):
    """Gaussian slopes of variance s^2 seen from 5 m below: E A R(0) exp(-2 c d) / (4 pi s^2 d^2)."""
    depth, variance = 5.0, 0.05
    scene = build(-depth, 180.0, integrator, water=CLEAR, sea={"slope_variance": str(variance)}, bottom=None)
    energy = passes(scene, 8)[:, 0]
    reflectance = float(fresnel(0.0, 1 / 1.34)[0])
    expected = SYSTEM * reflectance * np.exp(-0.2 * depth) / (4 * np.pi * variance * depth**2)
    z, error = z_score(energy.sum(axis=1), expected)
    assert abs(z) < largest_z(8) + 1e-3 / error
    assert error < largest_error(8, 0.008)
    due = 2e9 * GROUP * depth / C0
    assert energy[:, int(due - START)].sum() > 0.99 * energy.sum()


@pytest.mark.parametrize(("angle", "beside"), [(0.0, 0.0), (40.0, 0.0), (180.0, 0.0), (0.0, 0.5)])
def test_lines_of_sight_give_depths_below_the_mean_sea_level(build, angle, beside):
    """A point at 8 m below a lidar at 3 m, or the surface above it; a receiver aside meets it at its own distance."""
    scene = build(-3.0, angle, rx={"aim_y": beside, "field_of_view_mrad": 400.0}, tx={"divergence_mrad": 0.1})
    lidar = find_lidar_scene(scene, scene.sensors()[0])
    found = lines_of_sight(lidar)
    depth = 8.0 if angle < 90 else 0.0
    way = abs(depth - 3.0) / abs(np.cos(np.radians(angle)))
    time = 1e9 * GROUP / C0 * (way + np.hypot(way, beside))
    # Beside the laser, depth is linear in time to a few centimetres.
    assert float(found.depth_of_time(np.array([[time]]))[0, 0]) == pytest.approx(depth, abs=0.05 if beside else 2e-3)


def test_records_end_where_the_sea_reflects_the_beam(build):
    """Beyond the critical angle, 48.3 degrees, light goes on to the bottom; at 45 degrees most leaves the water."""
    distance = 3.0 / np.cos(np.radians(60))
    due = 2e9 * GROUP * distance / C0
    scene = build(-3.0, 120.0, tx={"divergence_mrad": 0.1}, rx={"field_of_view_mrad": 1.0}, bins="auto")
    lidar = find_lidar_scene(scene, scene.sensors()[0])
    assert lidar.axis.start_ns == START
    assert due - 2 < lidar.axis.end_ns <= due
    with pytest.raises(UserError, match=r"^time_start_ns = 9 .* must end by 5\d\.\d ns, when the sea reflects beam"):
        mitransient_lidar.render(build(-3.0, 120.0), passes=2)
    scene = build(-3.0, 135.0, bins="auto")
    assert find_lidar_scene(scene, scene.sensors()[0]).axis.end_ns > 2e9 * GROUP * 3 / np.cos(np.pi / 4) / C0 + 12


@pytest.mark.slow
def test_multiple_scattering_is_the_same_in_all_directions(build, passes):
    """Far from surface and bottom, turbid water returns as much light obliquely, ahead and upwards as downwards."""
    water = {"attenuation": 0.4, "scattering": 0.3, "backscattering": 0.01, "phase_function": "hg", "phase_g": 0.8}
    options = {"water": water, "bottom": None, "paths": 2**14, "rx": {"field_of_view_mrad": 60.0}}
    (down, its_error), *others = (
        mean_and_error(
            passes(build(-60.0, angle, **options), 24, first_seed=100 * seed)[:, 0]
            .reshape(24, -1, 12)
            .sum(axis=2)[:, :5]
        )
        for seed, angle in enumerate((0.0, 40.0, 90.0, 150.0))
    )
    for turned, error in others:
        z = (turned - down) / np.hypot(its_error, error)
        assert np.abs(z).max() < largest_z(24, 3 * z.size), z
        assert np.all(error[:3] < largest_error(24, 0.02) * down[:3])
