"""Absolute arrival times of echoes against straight-line geometry: a wrong index on any leg shows here.

Timing the air leg with the water's index would bring every echo 241 ns late; timing the water with the refractive
index where the group index belongs is 1.8 % of the time in the water, 1.3 ns at 8 m.
"""

import mitsuba as mi
import numpy as np
import pytest
from oracles.echo_times import bottom_time_ns
from scipy.stats import norm
from significance import largest_z

from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.lidar.level_sea import surface_time_ns
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.transport.paths.histogram import TransientHistogram

BIN_NS = 0.25
#: A pencil beam from 200 m: across 0.1 mrad the arrival at 20 degrees changes by 0.05 ns, evenly about the mean.
PENCIL = {"divergence_mrad": 0.1}


def centroid_ns(energy, start_ns):
    """Return mean arrival [ns] and its standard error over the passes; the bins' centres stand for the bins."""
    total = energy.sum(axis=1)
    centres = start_ns + BIN_NS * (np.arange(energy.shape[-1]) + 0.5)
    times = (total * centres).sum(axis=1) / total.sum(axis=1)
    return times.mean(), times.std(ddof=1) / np.sqrt(len(times))


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["lidar_merging", "lidar_volpath"])
def test_bottom_arrives_to_a_tenth_of_a_millimetre(lidar_scene, passes, integrator):
    """Rays start beside the surfaces that they leave: distances without these gaps are up to 0.4 mm too short."""
    altitude, depth = 1000.0, 8.0
    pose = {"altitude": altitude, "off_nadir_deg": 0.0}
    expected = 2 * (altitude + 1.364 * depth) / C0 * 1e9
    bin_ns, bins = 1e-3, 64
    scene = lidar_scene(
        integrator={"type": integrator, "paths_per_pass": 2**12},
        tx={**pose, "divergence_mrad": 0.02},
        rx={**pose, "field_of_view_mrad": 1.0, "layout": "1x1"},
        film={"time_start_ns": expected - 0.5 * bins * bin_ns, "bin_width_ns": bin_ns, "bin_count": bins},
        sea={"slope_variance": "2e-5"},
        water={"attenuation": 0.1, "scattering": 0.0, "backscattering": 0.0, "group_index": 1.364},
        bottom=depth,
    )
    energy = passes(scene, 4)[:, 0].sum(axis=0)
    mean = bin_ns * (np.arange(bins) + 0.5 - bins / 2) @ energy / energy.sum()
    # Lengths of single precision: 0.1 mm one way.
    assert abs(mean) < 2 * 1e-4 * 1.364 / C0 * 1e9


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["lidar_volpath", pytest.param("lidar_merging", marks=pytest.mark.long)])
@pytest.mark.parametrize("angle", [pytest.param(0.0, marks=pytest.mark.long), 20.0])
def test_echoes_reach_orbit_when_geometry_says(lidar_scene, passes, angle, integrator):
    """From 500 km, to 1 mm of range; single precision resolves 3 cm in such distances, and 6 cm of the path."""
    altitude, pixel = 5e5, {"altitude": 5e5, "off_nadir_deg": angle}
    surface = float(surface_time_ns(altitude, np.radians(angle)))
    bottom = float(bottom_time_ns(altitude, 8.0, np.radians(angle), 1.34, 1.364))
    width = 0.02
    photons = {"photons_per_pass": 2**13} if integrator == "lidar_merging" else {}
    # A shallow layer of a strong absorber leaves the echo of the surface alone.
    seas = [
        (surface, {"slope_variance": "0.05"}, {"attenuation": 100.0}, None),
        (bottom, {}, {"attenuation": 0.1, "group_index": 1.364}, 8.0),
    ]
    for expected, sea, water, depth in seas:
        start = width * round((expected - 8) / width)
        scene = lidar_scene(
            integrator={"type": integrator, "paths_per_pass": 2**14, **photons},
            tx={**pixel, "divergence_mrad": 0.001},
            rx={**pixel, "field_of_view_mrad": 0.006, "layout": "1x1"},
            film={"time_start_ns": start, "bin_width_ns": width, "bin_count": round(16 / width)},
            sea=sea,
            water={**water, "scattering": 0.0, "backscattering": 0.0},
            bottom=depth,
        )
        energy = passes(scene, 8).sum(axis=1)
        times = start + width * (np.arange(energy.shape[1]) + 0.5)
        means = energy @ times / energy.sum(axis=1)
        error = means.std(ddof=1) / np.sqrt(8)
        millimetre = 2e6 / C0
        assert abs(means.mean() - expected) < millimetre + largest_z(8) * error
        assert error < 0.7 * millimetre
        assert energy.sum() > 0


@pytest.mark.slow
def test_surface_echo_from_orbit_has_the_shape_of_the_beam(lidar_scene, passes):
    """A Gaussian beam of 2.5 m on the sea at 20 degrees: the echo is the Gaussian of its ranges."""
    altitude, theta, spread = 5e5, np.radians(20.0), 5e-6
    pose = {"altitude": altitude, "off_nadir_deg": 20.0}
    centre, width = float(surface_time_ns(altitude, theta)), 0.2
    deviation = centre * spread * np.tan(theta)
    start = width * round((centre - 3 * deviation) / width)
    bins = round(6 * deviation / width)
    scene = lidar_scene(
        integrator={"paths_per_pass": 2**16},
        tx={**pose, "divergence_mrad": 2e3 * spread},
        rx={**pose, "field_of_view_mrad": 20e3 * spread, "layout": "1x1"},
        film={"time_start_ns": start, "bin_width_ns": width, "bin_count": bins},
        sea={"slope_variance": "0.05"},
        water={"attenuation": 100.0, "scattering": 0.0, "backscattering": 0.0},
        bottom=None,
    )
    energy = passes(scene, 16).sum(axis=1)
    edges = start + width * np.arange(bins + 1)
    shape = np.diff(norm.cdf(edges, centre, deviation))
    shares = energy / energy.sum(axis=1, keepdims=True)
    error = shares.std(axis=0, ddof=1) / 4
    strong = shape > 0.1 * shape.max()
    z = (shares.mean(axis=0) - shape / shape.sum())[strong] / error[strong]
    assert np.abs(z).max() < largest_z(16, z.size), z
    assert np.all(error[strong] < 0.06 * shape[strong])


def test_tilted_bottom_arrives_by_its_own_distance(lidar_scene, passes):
    """A bottom tilted by 10 degrees about y, under a pencil beam at nadir, is hit at its centre's depth."""
    expected = float(bottom_time_ns(200.0, 8.0, 0.0, 1.34, 1.34))
    start = BIN_NS * round((expected - 8) / BIN_NS)
    tilted = mi.ScalarTransform4f().translate([0, 0, -8]).rotate([0, 1, 0], 10).scale(40)
    scene = lidar_scene(
        integrator={"max_scatterings": 0, "paths_per_pass": 2**14},
        tx={**PENCIL, "off_nadir_deg": 0.0},
        rx={"field_of_view_mrad": 2.0, "layout": "1x1", "off_nadir_deg": 0.0},
        film={"time_start_ns": start, "bin_width_ns": BIN_NS, "bin_count": 64},
        water={"attenuation": 0.1, "scattering": 0.0, "backscattering": 0.0},
        bottom=None,
        extra={"tilted": {"type": "rectangle", "to_world": tilted, "bsdf": {"type": "diffuse"}}},
    )
    mean, error = centroid_ns(passes(scene, 8), start)
    assert error < BIN_NS / 10
    assert abs(mean - expected) < BIN_NS / 2


def test_plate_in_the_air_without_any_water(lidar_scene, passes):
    """Energy E0 eta^2 T^2 rho/pi cos(theta) A / R^2 and time 2 R / c0 of a Lambertian plate at 20 degrees."""
    distance = 200.0 / np.cos(np.radians(20.0))
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "lidar_volpath", "paths_per_pass": 2**16},
            "tx": {"type": "lidar_transmitter", **PENCIL},
            "rx": {
                "type": "multipixel_receiver",
                "field_of_view_mrad": 2.0,
                "film": {"type": "time_gated_film", "time_start_ns": 1410.0, "bin_width_ns": 0.25, "bin_count": 64},
            },
            "plate": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(10),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.1}},
            },
        }
    )
    energy = passes(scene, 16)
    totals = energy.sum(axis=(1, 2))
    expected = 5e-3 * 0.81 * 0.9 * 0.1 / np.pi * np.cos(np.radians(20.0)) * 0.025 / distance**2
    error = totals.std(ddof=1) / np.sqrt(16)
    # Across the 0.01 mrad beam the closed form is exact to 1e-5.
    assert abs(totals.mean() - expected) < largest_z(16) * error + 1e-4 * expected
    assert error < 0.005 * expected
    mean, _ = centroid_ns(energy, 1410.0)
    assert abs(mean - 2e9 * distance / C0) < BIN_NS / 2


def test_bins_are_half_open_and_their_sum_is_the_energy():
    histogram = TransientHistogram(TimeAxis(0.0, 1.0, 4), (2,), emitted=128.0)
    metre = 299792458e-9  # optical length of 1 ns
    times = np.array([-0.001, 0.0, 0.999, 1.001, 2.5, 3.999, 4.001, np.nan])
    histogram.add(mi.UInt32(1), mi.Float(times * metre), mi.Float(np.arange(1.0, 9.0)), mi.Bool(True))
    assert histogram.energy().tolist() == [[0, 0, 0, 0], [2 + 3, 4, 5, 6]]
