"""Elliptic and measured beams in whole scenes: a bottom echo in closed form, and the two integrators."""

import numpy as np
import pytest
from oracles.lidar_equation import bottom_energy
from rows import each_case
from significance import assert_equal, largest_z

from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.lidar.level_sea import LidarSystem
from mitransient_lidar.physics.water.layers import WaterColumn

ENERGY = 5e-3 * 0.81 * 0.9
DEPTH = 1.0
CLEAR = {"attenuation": 0.1, "scattering": 0.0, "backscattering": 0.0}

#: Row 0 is far, column 0 left (+angle_y): no symmetry hides a flip.
IMAGE = np.array([[1.0, 0.0, 2.0, 5.0], [0.0, 4.0, 8.0, 1.0], [3.0, 1.0, 0.0, 0.0]])


def image_parameters(folder):
    np.save(folder / "beam.npy", IMAGE)
    return {"beam_profile": "image", "profile_file": str(folder / "beam.npy"), "profile_mrad": 8.0}


def expected_bottom(density, field):
    """Integrate the echo of a Lambertian bottom over the beam [J]: midpoint rule over +-25 mrad.

    Parameters
    ----------
    density
        Share of the energy per tangent-plane area, a function of (angle_x, angle_y) [rad].
    field
        Predicate on (angle_x, angle_y): what a pixel sees.
    """
    line = (np.arange(1000) - 499.5) * 5e-5
    angle_x, angle_y = np.meshgrid(line, line, indexing="ij")
    seen = field(angle_x, angle_y)
    angle_x, angle_y = angle_x[seen], angle_y[seen]
    sin, cos = np.sin(np.radians(20)), np.cos(np.radians(20))
    theta = np.arctan2(np.hypot(sin + angle_x * cos, angle_y), cos - angle_x * sin)
    system = LidarSystem(200.0, np.radians(20), 1.34, 1.34, energy=ENERGY, aperture_area=0.025)
    echo = bottom_energy(system, WaterColumn.from_text(0, 0.1, 0, 0), DEPTH, 0.1, theta)
    return float(np.sum(density(angle_x, angle_y) * echo) * 5e-5**2)


def ellipse(along, across, turn, top_hat):
    """Return the density of a Gaussian or even ellipse of half angles [rad] whose first axis is turned."""

    def density(angle_x, angle_y):
        a = (angle_x * np.cos(turn) + angle_y * np.sin(turn)) / along
        b = (angle_y * np.cos(turn) - angle_x * np.sin(turn)) / across
        if top_hat:
            return (a**2 + b**2 < 1) / (np.pi * along * across)
        return np.exp(-0.5 * (a**2 + b**2)) / (2 * np.pi * along * across)

    return density


def cells(angle_x, angle_y):
    row, column = np.floor((3e-3 - angle_x) / 2e-3).astype(int), np.floor((4e-3 - angle_y) / 2e-3).astype(int)
    inside = (row >= 0) & (row < 3) & (column >= 0) & (column < 4)
    return np.where(inside, IMAGE[row.clip(0, 2), column.clip(0, 3)], 0) / IMAGE.sum() / 4e-6


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["gaussian", "image"])
def test_bottom_echo_through_a_narrow_view(kind, lidar_scene, passes, z_score, tmp_path):
    """2x2 pixels of a view narrower than the beam's long axis; a mirrored turn would swap left and right pixels."""
    if kind == "image":
        transmitter, density, half = image_parameters(tmp_path), cells, 2.5e-3
    else:
        transmitter = {"beam_profile": kind, "divergence_mrad": 12.0, "divergence_across_mrad": 3.0}
        transmitter |= {"ellipse_deg": 30.0}
        density, half = ellipse(6e-3, 1.5e-3, np.radians(30), kind == "top_hat"), 3e-3
    scene = lidar_scene(
        tx=transmitter,
        rx={"field_of_view_mrad": 2e3 * half},
        water=CLEAR,
        film={"time_start_ns": 1424.0},
        # Deep down, ripples would carry some per cent of the light over the edge between a dark and a bright cell.
        sea={"slope_variance": "2e-5"},
        bottom=DEPTH,
        integrator={"paths_per_pass": 2**14},
    )
    energy = passes(scene, 16).sum(axis=-1)
    quadrants = [
        lambda angle_x, angle_y, far=far, left=left: (
            (angle_x**2 + angle_y**2 < half**2) & ((angle_x > 0) == far) & ((angle_y > 0) == left)
        )
        for far in (True, False)
        for left in (True, False)
    ]
    expected = np.array([expected_bottom(density, quadrant) for quadrant in quadrants])
    assert expected.max() > 1.3 * expected.min()
    z, relative = z_score(energy, expected)
    assert np.all(relative < 0.012), relative
    # The grid of the closed form resolves rims and the edge of the view to 1e-3, and ripples still carry that much.
    assert np.all(np.abs(energy.mean(axis=0) / expected - 1) < largest_z(16, 4) * relative + 2e-3), (
        z,
        energy.mean(axis=0) / expected,
    )


@pytest.mark.slow
@each_case(("lidar_volpath", 5e-4, 0.48, 0.7e-3), ("lidar_merging", 1e-5, 0.48, 0.7e-3))
def test_bottom_in_beam_and_view_of_millimetres(integrator, variance, depth, spread, lidar_scene, passes):
    """Patches that grew with depth as broad light does, from a millimetre, lost 88 % of it.

    Slopes of the variance s^2 in each direction turn light and lines of sight by D s, D = 1 - 1/n, so that a share
    1 - exp(-R^2 / 2 (sigma^2 + 2 D^2 s^2 z^2)) of the light at the depth z lies within the view of radius R.
    """
    height, index, radius = 11.0, 1.34, 2 * spread
    pose = {"altitude": height, "off_nadir_deg": 0.0}
    photons = {"photons_per_pass": 2**13} if integrator == "lidar_merging" else {}
    scene = lidar_scene(
        integrator={"type": integrator, "paths_per_pass": 2**13, **photons},
        tx={**pose, "divergence_mrad": 2e3 * spread / height, "pulse_energy_mj": 4.0},
        rx={**pose, "field_of_view_mrad": 2e3 * radius / height, "layout": "1x1", "obscuration": 0.0},
        film={"time_start_ns": 74.0, "bin_count": 40},
        sea={"slope_variance": str(2 * variance)},
        water=CLEAR,
        bottom=depth,
    )
    collection, energy = scene.sensors()[0].receiver.optics.collection, scene.emitters()[0].energy
    system = LidarSystem(height, 0.0, index, 1.34, energy=energy * collection, aperture_area=1.0)
    whole = float(bottom_energy(system, WaterColumn.from_text(0, 0.1, 0, 0), depth, 0.1, np.array(0.0)))
    wider = (1 + depth / (index * height)) ** 2
    spot = spread**2 * wider + 2 * ((1 - 1 / index) * depth) ** 2 * variance
    expected = whole * (1 - np.exp(-0.5 * radius**2 * wider / spot))
    found = passes(scene, 16)[:, 0]
    # The surface's light is in the first bins.
    begin = int(2 * (height + index * depth) / C0 * 1e9 - 74.0)
    assert_equal(found[:, begin - 1 : begin + 2].sum(axis=1), expected, error=0.02, bias=8e-3)
