"""Planes through surface echoes, against rays that are intersected with planes as vectors."""

import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rows import each_case
from significance import largest_z

from mitransient_lidar.analysis.retrieval.surface_echoes import SeaShots
from mitransient_lidar.analysis.retrieval.surface_slope import (
    PixelEchoes,
    PixelLight,
    fit_plane,
    slopes_on_sea,
    steepest,
    with_prior,
)

C0 = 0.299792458  # m/ns
THETA = math.radians(20)
ANGLE_X = np.array([2.8e-3, 2.8e-3, -2.8e-3, -2.8e-3])
ANGLE_Y = np.array([2.8e-3, -2.8e-3, 2.8e-3, -2.8e-3])
POINTS = PixelLight(ANGLE_X, ANGLE_Y, np.zeros(4))


def plane_times(angle_x, angle_y, along, across, height=0.0, altitude=200.0, theta=THETA):
    """Two-way times [ns] of rays to the plane z = height + along x + across y, by vectors."""
    axis = np.array([math.sin(theta), 0, -math.cos(theta)])
    far = np.array([math.cos(theta), 0, math.sin(theta)])
    ray = axis + np.outer(angle_x, far) + np.outer(angle_y, [0.0, 1.0, 0.0])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    origin = np.array([-altitude * math.tan(theta), 0, altitude])
    normal = np.array([-along, -across, 1])
    return 2 / C0 * (np.array([0, 0, height]) - origin) @ normal / (ray @ normal)


@pytest.mark.parametrize("theta", [0.0, THETA, math.radians(60)])
@each_case((0, 0, 0), (0.12, 0, 0.3), (-0.2, 0.07, -0.4), (0.05, -0.3, 0))
def test_a_plane_is_found_exactly(along, across, height, theta):
    """Any sign, factor or convention that is wrong shows: the fit has no approximation."""
    times = plane_times(ANGLE_X, ANGLE_Y, along, across, height, theta=theta)
    plane = fit_plane(times[np.newaxis], POINTS, theta)
    assert plane.along[0] == pytest.approx(along, abs=1e-9)
    assert plane.across[0] == pytest.approx(across, abs=1e-9)
    on_axis = plane_times(np.zeros(1), np.zeros(1), along, across, height, theta=theta)[0] * C0 / 2
    assert plane.range_m[0] == pytest.approx(on_axis, abs=1e-7)
    assert plane.misfit_ns[0] == pytest.approx(0, abs=1e-6)


def test_undetermined_slopes_are_nan():
    some = np.stack([plane_times(ANGLE_X, ANGLE_Y, 0.1, 0.05)] * 4)
    some[1, 3] = some[2, 2:] = some[3, 1:] = np.nan
    plane = fit_plane(some, POINTS, THETA)
    for found, slope in ((plane.along, 0.1), (plane.across, 0.05)):
        np.testing.assert_allclose(found, [slope, slope, np.nan, np.nan], atol=1e-9)
    assert np.isfinite(plane.range_m).all()
    strips = PixelLight(np.array([5.1e-3, 1.8e-3, -1.8e-3, -5.1e-3]), np.zeros(4), np.zeros(4))
    strip = fit_plane(plane_times(strips.angle_x, strips.angle_y, -0.1, 0.0)[np.newaxis], strips, THETA)
    assert (strip.along[0], strip.across[0]) == (pytest.approx(-0.1, abs=1e-9), pytest.approx(np.nan, nan_ok=True))
    empty = fit_plane(np.full((1, 4), np.nan), POINTS, THETA)
    assert np.isnan([empty.along[0], empty.range_m[0]]).all()


def test_standard_errors_are_those_of_noise():
    """Variance of 4000 noisy fits over the stated one: chi-squared with 3999 degrees."""
    rng = np.random.default_rng(7)
    error = np.array([0.1, 0.2, 0.3, 0.15])
    times = plane_times(ANGLE_X, ANGLE_Y, 0.1, -0.05) + error * rng.normal(size=(4000, 4))
    plane = fit_plane(times, POINTS, THETA, stderr_ns=np.broadcast_to(error, times.shape))
    for name, truth in (("along", 0.1), ("across", -0.05)):
        values, stated = getattr(plane, name), getattr(plane, f"{name}_stderr")
        assert abs(np.mean(((values - truth) / stated) ** 2) - 1) < largest_z(4000, 3) * math.sqrt(2 / 4000)
    reach = plane.range_m - plane_times(np.zeros(1), np.zeros(1), 0.1, -0.05)[0] * C0 / 2
    assert abs(reach.mean()) < largest_z(4000, 3) * reach.std() / math.sqrt(4000)


def test_uneven_light_counts_as_error():
    """One facet anywhere in each pixel, drawn with a spread of 1 mrad on a level sea, alike by 0.4 side by side."""
    rng = np.random.default_rng(3)
    spread = np.full(4, 1e-3)
    draws = math.sqrt(0.6) * rng.normal(size=(1500, 4)) + math.sqrt(0.4) * np.repeat(rng.normal(size=(1500, 2)), 2, 1)
    times = np.array([plane_times(ANGLE_X + spread * one, ANGLE_Y, 0, 0) for one in draws])
    plane = fit_plane(times, PixelLight(ANGLE_X, ANGLE_Y, spread), THETA)
    for name in ("along", "across"):
        z = getattr(plane, name) / getattr(plane, f"{name}_stderr")
        assert abs(np.mean(z**2) - 1) < 0.04 + 5 * math.sqrt(2 / 1500)
    # Of the sums of a pair the variance is (1 + 0.4)/2, of the differences (1 - 0.4)/2.
    assert np.median(plane.along_stderr / plane.across_stderr) == pytest.approx(
        math.sqrt(1.4 / 0.6) * math.cos(THETA), rel=0.01
    )


# Centres and spread of the light in quarters and strips of a circle of 15 mrad, and in quarters of 30 mrad.
QUARTERS, WIDE = (
    PixelLight(x * np.array([1, 1, -1, -1]), x * np.array([1, -1, 1, -1]), np.full(4, spread))
    for x, spread in ((2.822e-3, 1.874e-3), (3.916e-3, 2.898e-3))
)
STRIPS = PixelLight(
    1e-3 * np.array([5.143, 1.768, -1.768, -5.143]), np.zeros(4), 1e-3 * np.array([0.954, 1.066, 1.066, 0.954])
)


@pytest.mark.parametrize(("view", "light"), [("s22", QUARTERS), ("s14", STRIPS), ("s22w", WIDE)])
def test_stated_errors_are_those_of_a_rendered_sea(view, light):
    """200 shots each at 6 m/s: times of the surface echoes, and slopes averaged over the beam's footprint.

    The file holds what `shots.series.render_shots` made of fig09_2x2 with 8 passes, and the times that
    `waveforms.extract` read. Sea slopes differ by 0.055 along and 0.039 across. A spread of 200 is known to 5 %.
    """
    with (Path(__file__).parent / "slope_shots.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["view"] == view]
    times = np.array([[float(row[f"t{pixel}"]) for pixel in range(4)] for row in rows])
    plane = fit_plane(times, light, THETA)
    for name, deviation in (("along", 0.0546), ("across", 0.0387)):
        truth = np.array([float(row[name]) for row in rows])
        found = (getattr(plane, name), getattr(plane, f"{name}_stderr"))
        if np.isnan(found[0]).all():
            assert name == "across"
            assert view == "s14"
            continue
        for slope, error in (found, with_prior(*found, deviation)):
            z = ((slope - truth) / error)[np.isfinite(slope)]
            assert z.size > 190
            assert 0.7 < np.sqrt(np.mean(z**2)) < 1.4
        z = ((found[0] - truth) / found[1])[truth < -0.03]
        # Errors that do not grow with the slope were 1.3 to 2.1 times too small for faces turned away.
        if name == "along":
            assert np.sqrt(np.nanmean(z**2)) < 1.4


def test_prior_and_direction():
    slope, error = with_prior([0.2, np.nan], [0.1, np.nan], 0.1)
    np.testing.assert_allclose(slope, [0.1, 0.0])
    np.testing.assert_allclose(error, [0.1 / math.sqrt(2), 0.1])
    angle, direction = steepest([0.1, 0.0, -0.1], [0.0, 0.1, -0.1])
    np.testing.assert_allclose(np.degrees(direction), [0, 90, -135])
    np.testing.assert_allclose(np.tan(angle), [0.1, 0.1, 0.1 * math.sqrt(2)])


def gaussian_shots(count, seed):
    """Shots of a sea on which all relations are linear: four pixels at the corners, strengths that grow with slope."""
    rng = np.random.default_rng(seed)
    along, across, height = (deviation * rng.standard_normal(count) for deviation in (0.06, 0.04, 0.2))
    planes = -300 * np.outer(along, ANGLE_X) - 320 * np.outer(across, ANGLE_Y) - 6.3 * height[:, np.newaxis]
    time = 1420 + planes + 0.3 * rng.standard_normal((count, 4))
    # u = 8 - 40 along, for log energies of -u^2/2: the largest has u near 0.
    deviation = np.maximum(8 - 40 * along[:, np.newaxis] + 0.5 * rng.standard_normal((count, 4)), 0.5)
    return SeaShots(np.exp(-0.5 * deviation**2), time, along, across, height)


def measured(shots, **changes):
    nothing = np.zeros_like(shots.energy)
    echoes = PixelEchoes(shots.time_ns, nothing, shots.energy, nothing, np.full(4, 1e-12), np.zeros(4), 5.0)
    return replace(echoes, **changes)


@pytest.mark.parametrize("scale", [1.0, None])
def test_slopes_on_a_gaussian_sea(scale):
    """z of 2000 shots that the statistics do not contain; stated errors also hold noise of 0.15 ns and 0.25 of E."""
    rng = np.random.default_rng(4)
    shots = gaussian_shots(2000, 2)
    times = shots.time_ns + 0.15 * rng.standard_normal(shots.time_ns.shape)
    energy = shots.energy * np.exp(0.25 * rng.standard_normal(shots.energy.shape))
    found = slopes_on_sea(measured(shots, time_ns=times, energy=energy), gaussian_shots(20000, 1), scale)
    truth = np.stack([shots.along, shots.across, shots.height], axis=1)
    errors = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    # A transform of the strengths that is linear to a few percent leaves that in the variance.
    limit = 0.05 + largest_z(2000, 2) * math.sqrt(2 / 2000)
    assert np.abs(np.mean(((found.mean - truth) / errors) ** 2, axis=0) - 1).max() < limit
    assert np.all(errors**2 < np.diag(found.prior))
    with_strengths = slopes_on_sea(measured(shots), gaussian_shots(2000, 1), 1.0)
    without = slopes_on_sea(measured(shots), gaussian_shots(2000, 1), None)
    assert np.all(with_strengths.covariance[:, 0, 0] < 0.5 * without.covariance[:, 0, 0])


def test_echoes_that_are_missing_or_lost_tell_less():
    shots = gaussian_shots(3, 2)
    sea = gaussian_shots(4000, 1)
    nothing = np.full_like(shots.energy, np.nan)
    dark = measured(shots, time_ns=nothing, energy=nothing, column_energy=np.full(4, 1e3))
    lost = slopes_on_sea(dark, sea, 1.0)
    np.testing.assert_allclose(lost.covariance, np.broadcast_to(lost.prior, (3, 3, 3)), rtol=1e-2, atol=1e-4)
    np.testing.assert_allclose(lost.mean, 0, atol=0.02)
    one = shots.time_ns.copy()
    one[:, 2] = np.nan
    full, part = (slopes_on_sea(measured(shots, time_ns=times), sea, None) for times in (shots.time_ns, one))
    assert np.all(part.covariance[:, 1, 1] > full.covariance[:, 1, 1])
    np.testing.assert_allclose(part.mean[:, 2], shots.height, atol=0.2)
    hidden = measured(shots, time_spread_ns=np.ones(4), column_energy=np.full(4, 1e3))
    assert np.all(slopes_on_sea(hidden, sea, None).covariance[:, 0, 0] > 1.05 * full.covariance[:, 0, 0])
