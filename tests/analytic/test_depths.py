"""Depths of every pixel against the point where its refracted line of sight meets the bottom, for planes and steps."""

import numpy as np
import pytest
from oracles.echo_times import bottom_time_ns
from scipy.special import ndtr
from significance import largest_chi2

from mitransient_lidar import results
from mitransient_lidar.analysis.gates.range_images import depth_image
from mitransient_lidar.analysis.waveforms import echo_table
from mitransient_lidar.physics.lidar.gate_train import GateTrain
from mitransient_lidar.physics.lidar.pulse import FWHM_PER_SIGMA
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.results.gate_stack import build_gates

N, GROUP, DEPTH = 1.34, 1.364, 8.0
ANGLE = np.radians(20.0)
#: Level, falling and rising away from the lidar [rise per metre], and a step from 6.5 m to 8 m at x = 0.
BOTTOMS = {"level": 0.0, "falls": -np.tan(np.radians(10)), "rises": np.tan(np.radians(10)), "step": None}


def depth_seen(rise, angle_x, angle_y):
    """Depth at which lines of sight from 200 m, 20 degrees off nadir, meet the bottom; NaN across the step."""
    down = np.cos(ANGLE) - np.sin(ANGLE) * angle_x
    length = np.sqrt(1 + angle_x**2 + angle_y**2)
    x = 200 * ((np.sin(ANGLE) + np.cos(ANGLE) * angle_x) / down - np.tan(ANGLE))
    run = (np.sin(ANGLE) + np.cos(ANGLE) * angle_x) / length / N
    side = angle_y / length / N
    run = run / np.sqrt(1 - run**2 - side**2)
    if rise is None:
        return np.where(x + DEPTH * run > 0.3, DEPTH, np.where(x + DEPTH * run < -0.3, 6.5, np.nan))
    return (DEPTH - rise * x) / (1 + rise * run)


def attributes(**more):
    pose = [-200 * np.tan(ANGLE), 0.0, 200.0, np.sin(ANGLE), 0.0, -np.cos(ANGLE)]
    pose += [np.cos(ANGLE), 0.0, np.sin(ANGLE), 0.0, 1.0, 0.0]
    known = {"altitude": 200.0, "off_nadir_deg": 20.0, "refractive_index": N, "group_index": GROUP}
    return {**known, "receiver_pose": pose, "pulse_fwhm_ns": 5.0, **more}


def grid(count, width=0.02):
    """Angles of the centres of count x count pixels [rad], row by row from the far edge."""
    ticks = width * ((np.arange(count) + 0.5) / count - 0.5)
    angle_x, angle_y = np.meshgrid(-ticks, ticks, indexing="ij")
    return angle_x.ravel(), angle_y.ravel()


def arrivals(rise, angle_x, angle_y):
    """Two-way times of surface and bottom [ns] of straight rays, and the true depths."""
    cosine = (np.cos(ANGLE) - np.sin(ANGLE) * angle_x) / np.sqrt(1 + angle_x**2 + angle_y**2)
    depth = depth_seen(rise, angle_x, angle_y)
    surface, bottom = (bottom_time_ns(200.0, d, np.arccos(cosine), N, GROUP) for d in (0.0, depth))
    return surface, bottom, depth


@pytest.mark.slow
@pytest.mark.parametrize("bottom", BOTTOMS)
@pytest.mark.parametrize("count", [8, 32])
def test_gates_of_an_imager_give_the_depth_of_each_pixel(bottom, count):
    """On the axis's scale, the level bottom would fall by 1.1 m from the near row to the far one."""
    angle_x, angle_y = grid(count)
    _, time, truth = arrivals(BOTTOMS[bottom], angle_x, angle_y)
    train = GateTrain(1455.0, 5.0, 1.0, 70)
    edges = train.starts_ns[:, np.newaxis] + np.array([0.0, train.width_ns])
    sigma = 5.0 / FWHM_PER_SIGMA
    shares = ndtr((edges - np.nan_to_num(time, nan=1500.0)[:, np.newaxis, np.newaxis]) / sigma)
    noise = 3e-18
    energy = 1e-16 * (shares[..., 1] - shares[..., 0])
    energy = energy + noise * np.random.default_rng(count).standard_normal(energy.shape)
    coords = results.pixel_coordinates([], 1e3 * np.stack([angle_x, angle_y], axis=1), (count, count))
    stack = build_gates(energy, np.full_like(energy, noise), train, coords=coords, attributes=attributes())
    found = depth_image(stack, reach=8)
    seen = np.isfinite(truth)
    z = (found.depth.ravel() - truth)[seen] / found.sigma.ravel()[seen]
    assert np.abs((found.depth.ravel() - truth)[seen]).max() < 0.15
    # Weights are clipped at 0, which shrinks the scatter of the centroid.
    assert 0.7 < np.sqrt(np.mean(z**2)) < 0.2 + np.sqrt(largest_chi2(z.size) / z.size)


@pytest.mark.slow
@pytest.mark.parametrize("bottom", ["level", "falls", "rises"])
@pytest.mark.parametrize(("count", "depth_from"), [(1, "mean"), (2, "echo"), (8, "mean")])
def test_waveforms_give_the_depth_of_each_pixel(bottom, count, depth_from):
    """Echoes of surface and bottom with noise, 24 shots: depths deviate by their stated errors."""
    axis = TimeAxis(1395.0, 0.5, 240)
    angle_x, angle_y = grid(count)
    surface, time, truth = arrivals(BOTTOMS[bottom], angle_x, angle_y)
    sigma = 5.0 / FWHM_PER_SIGMA
    rng = np.random.default_rng(count)
    clean = sum(np.diff(ndtr((axis.edges_ns - at[:, np.newaxis]) / sigma), axis=-1) for at in (surface, time))
    noise, coords = 2e-3, results.pixel_coordinates([], 1e3 * np.stack([angle_x, angle_y], axis=1), (count, count))
    z = []
    for _ in range(24 // count**2 + 1):
        power = clean + noise * rng.standard_normal(clean.shape)
        power = power.reshape(count, count, -1)
        error = np.full_like(power, noise)
        dataset = results.build(
            *(values.reshape(count**2, -1) for values in (power, error, power, error)),
            time=axis,
            pixel_names=[],
            pixel_centres_mrad=1e3 * np.stack([angle_x, angle_y], axis=1),
            grid=(count, count),
            attributes=attributes(),
        )
        assert set(coords) <= set(dataset.coords)
        found = echo_table.extract(dataset, depth_from=depth_from).sel(echo="bottom")
        z.append((found["depth_m"].values.ravel() - truth) / found["depth_m_stderr"].values.ravel())
    z = np.concatenate(z)
    most = np.sqrt(largest_chi2(z.size) / z.size)
    assert 2 - most - 0.05 < np.sqrt(np.mean(z**2)) < most + 0.05
