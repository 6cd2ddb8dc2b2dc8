"""Light at depth against radiative-transfer benchmarks, exact moments, small-angle theory, and energy conservation."""

from functools import partial
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracles.echo_times import layered_time_ns
from significance import largest_error, largest_z

from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.lidar.level_sea import fresnel, snell
from mitransient_lidar.transport.laser import BeamSampler
from mitransient_lidar.transport.merging.segments import SegmentBuffer
from mitransient_lidar.transport.paths.passes import PathClasses
from mitransient_lidar.transport.paths.random_walk import RandomWalk, RandomWalkPath
from mitransient_lidar.transport.plane_crossings import CrossingTracer
from mitransient_lidar.transport.rng import pass_streams
from mitransient_lidar.transport.scene_parts import find_lidar_scene

#: A pencil that goes straight down into water without refraction.
MATCHED = {"refractive_index": 1.0001, "group_index": 1.0}
PENCIL = {"off_nadir_deg": 0.0, "divergence_mrad": 0.01}
VIEW = {"off_nadir_deg": 0.0, "field_of_view_mrad": 200.0, "layout": "1x1"}
LARGE_SEA = {"size": 4000.0, "slope_variance": "2e-5"}


def parts_of(lidar_scene, water, tx=PENCIL, **options):
    water = {"backscattering": 0.0, **water}
    scene = lidar_scene(tx=tx, rx=VIEW, sea=LARGE_SEA, water=water, **options)
    return find_lidar_scene(scene, scene.sensors()[0])


@pytest.fixture
def system(lidar_scene):
    return partial(parts_of, lidar_scene)


def fluxes(system, depths, photons, passes):
    """Return the shares of the energy that cross planes downwards and upwards, each of shape (passes, planes)."""
    tracer = CrossingTracer(system, np.asarray(depths), photons)
    down, up = np.zeros((2, passes, len(depths)))
    for number in range(passes):
        light, _ = tracer.trace(1, number)
        for flux, which in ((down, light.downward), (up, ~light.downward)):
            flux[number] = np.bincount(light.plane[which], light.weight[which], len(depths))
    return down / system.transmitter.energy, up / system.transmitter.energy


#: Water above clear water, and the shares of light that it transmits and reflects.
SLAB = {
    **{"layer_tops": "0, 20", "attenuation": "0.1, 0", "scattering": "0.09, 0"},
    **{"phase_function": "hg", "phase_g": 0.75},
}
SLAB_SHARES = 0.66096, 0.09739


@pytest.mark.slow
def test_slab_transmits_and_reflects_as_tabulated(system, z_score):
    # Van de Hulst (1980): Henyey-Greenstein g = 0.75, albedo 0.9, optical thickness 2, matched index, normal incidence.
    # Below the slab is clear water and a black bottom. Here the thickness is 20 m, and reflected light crosses a plane
    # at a ten-thousandth of a mean free path.
    down, up = fluxes(system({**MATCHED, **SLAB}, bottom=21.0, rho=0.0), [1e-3, 20.0], 2**16, 16)
    for share, expected in zip((down[:, 1], up[:, 0]), SLAB_SHARES, strict=True):
        z, error = z_score(share, expected)
        assert abs(z) < largest_z(16, 2), (share.mean(), expected)
        assert error < largest_error(16, 0.0029)


@pytest.mark.slow
def test_light_that_leaves_for_ever_is_counted(system):
    # No bottom: the last leg of nearly all light, through the clear water below, has no end.
    water = {"layer_tops": "0, 1", "attenuation": "0.2, 0", "scattering": "0, 0"}
    down, up = fluxes(system({**MATCHED, **water}, bottom=None), [0.5, 2.0, 30.0], 4096, 2)
    np.testing.assert_allclose(down, np.tile(np.exp([-0.1, -0.2, -0.2]), (2, 1)), rtol=1e-4)
    assert np.all(up == 0)


#: Mean cosine of the scattering angle, depth of the source [m], and distance of the points [m] in `moments`, b = 1 /m.
MEAN_COSINE, SOURCE_DEPTH, STEP = 0.924, 150.0, 10.0


def moments(system, passes):
    """Return depth, its square, and the squared radius of light after 10, 20 and 30 m, shape (passes, lengths, 3)."""
    water = {**MATCHED, "attenuation": 1.0, "scattering": 1.0, "phase_function": "hg", "phase_g": MEAN_COSINE}
    parts = system(water, bottom=None)
    count = 2**13
    samples = np.zeros((passes, 3, 3))
    for number in range(passes):
        rng = pass_streams(3, number, count)
        down = mi.Point2f(dr.zeros(mi.Float, count), 0)
        path = RandomWalkPath.walking(parts, parts.transmitter.pose, down, dr.ones(mi.Float, count), mi.Float(STEP))
        path.point, path.in_water = mi.Point3f(0, 0, -SOURCE_DEPTH), mi.Bool(True)
        path.at_start, path.length = mi.Bool(False), mi.Float(1)
        segments = SegmentBuffer(parts, PathClasses(), STEP, count, 150 * count)
        end = parts.reference_length + 500.0
        RandomWalk(parts, mi.TransportMode.Importance, parts.receiver.pose, end).run(
            path, rng, segments, on_solid=lambda *_: None, past_solids=False
        )
        points, wanted = segments.finalize()
        assert wanted <= segments.capacity
        found = segments.points(dr.arange(mi.UInt32, points))
        x, y, z = np.array(found.point, dtype=np.float64)
        depth = -z - SOURCE_DEPTH
        stop = np.rint((np.array(found.length) - 1) / STEP).astype(int)
        for k in range(3):
            at = stop == k + 1
            assert np.count_nonzero(at) == count
            samples[number, k] = depth[at].mean(), (depth[at] ** 2).mean(), (x[at] ** 2 + y[at] ** 2).mean()
    return samples


def exact_moments():
    """Return the same moments, exact at every path length: directions' correlations decay as exp(-b (1 - g_l) s)."""
    s = STEP * np.arange(1, 4)
    k1, kappa = 1 - MEAN_COSINE, 1 - MEAN_COSINE**2
    z1 = (1 - np.exp(-k1 * s)) / k1
    square = 2 / k1**2 * (k1 * s - 1 + np.exp(-k1 * s))
    z2 = 2 / (3 * k1) * (s - z1) + 4 / 3 / (k1 - kappa) * ((1 - np.exp(-kappa * s)) / kappa - z1)
    return np.stack([z1, z2, square - z2], axis=1)


@pytest.mark.slow
def test_moments_of_an_infinite_medium(system, z_score):
    passes, expected = 12, exact_moments()
    # The same formulas evaluated elsewhere, for s = 10.
    np.testing.assert_allclose(expected[0], [7.00439, 59.509, 19.323], rtol=1e-4)
    score, error = z_score(moments(system, passes), expected)
    assert np.all(np.abs(score) < largest_z(passes, score.size)), score
    assert np.all(error < largest_error(passes, 0.006))


@pytest.mark.slow
def test_white_bottom_returns_all_light(system):
    # Water that does not absorb: what leaves upwards and what the surface reflects at once is what was sent.
    water = {"attenuation": 0.3, "scattering": 0.3, "phase_function": "hg", "phase_g": 0.9}
    parts = system({**water, "refractive_index": 1.34, "group_index": 1.34}, bottom=8.0, rho=1.0)
    count, passes = 2**13, 16
    returned, first = np.zeros((2, passes))
    for number in range(passes):
        rng = pass_streams(5, number, count)
        beam = BeamSampler(parts.transmitter, parts.receiver)
        angles, energy = beam.sample(dr.arange(mi.UInt32, count), count, rng)
        start = RandomWalkPath.walking(parts, parts.transmitter.pose, angles, energy, mi.Float(0))
        nothing = SimpleNamespace(add=lambda path, *_: path.offset)
        end = RandomWalk(parts, mi.TransportMode.Importance, parts.receiver.pose, 6000.0).run(
            start, rng, nothing, on_solid=lambda *_: None, past_solids=True
        )
        left = ~np.array(end.in_water) & (np.array(end.direction.z) > 0)
        share = np.array(end.throughput, dtype=np.float64) * left / parts.transmitter.energy
        returned[number] = share.sum()
        first[number] = share[np.array(end.length) < 0.001].sum()
    error = returned.std(ddof=1) / np.sqrt(passes)
    assert abs(returned.mean() - 1) < 0.001 + largest_z(passes) * error
    assert error < largest_error(passes, 0.002)
    assert first.mean() == pytest.approx(float(fresnel(0.0, 1.34)[0]), abs=0.001)


@pytest.mark.slow
def test_no_crossing_is_lost_or_counted_twice(system):
    # Without absorption each path crosses every plane once more downwards than upwards if it ends on the black bottom,
    # and as often if it leaves through the surface: net fluxes agree pass by pass.
    water = {"layer_tops": "0, 3", "attenuation": "1, 2", "scattering": "1, 2", "phase_function": "hg", "phase_g": 0.7}
    indices = {"refractive_index": "1.3, 1.4", "group_index": "1.3, 1.4"}
    down, up = fluxes(system({**water, **indices}, bottom=5.0, rho=0.0), [0.5, 2.9, 3.0, 3.1, 4.999], 2**14, 2)
    assert np.all(up[:, :-1] > 0.1)
    np.testing.assert_allclose(down - up, np.tile((down - up)[:, :1], (1, 5)), rtol=1e-5)


@pytest.mark.slow
def test_ways_through_strata(system):
    """Unscattered light arrives where and when Snell's law says, and hardly scattered light is hardly late."""
    oblique = {**PENCIL, "off_nadir_deg": 30.0}
    water = {"layer_tops": "0, 3", "attenuation": 0.2, "scattering": 0.2, "phase_function": "hg", "phase_g": 0.999}
    indices = {"refractive_index": "1.3, 1.5", "group_index": "1.35, 1.6"}
    parts = system({**water, **indices}, tx=oblique, bottom=8.0, rho=0.0)
    light, _ = CrossingTracer(parts, np.array([2.0, 3.0, 7.0]), 2**13).trace(0, 0)
    angle = np.radians(30.0)
    first, second = (np.tan(snell(angle, n)) for n in (1.3, 1.5))
    for plane, (upper, lower) in enumerate([(2.0, 0.0), (3.0, 0.0), (3.0, 4.0)]):
        here = light.select((light.plane == plane) & light.downward)
        direct = here.scatterings == 0
        assert direct.sum() > 1000
        assert here.x[direct].mean() == pytest.approx(upper * first + lower * second, abs=2e-3)
        two_way = layered_time_ns(200.0, [upper, lower], angle, [1.3, 1.5], [1.35, 1.6])
        assert here.length[direct].mean() == pytest.approx(0.5e-9 * C0 * two_way, abs=4e-3)
        # Most of the scattered light is turned by less than a degree: shifted by millimetres, late by picoseconds.
        assert np.median(np.hypot(here.shift_x, here.shift_y)[~direct]) < 0.06
        assert np.median(np.abs(here.delay[~direct])) < 0.1e-9
