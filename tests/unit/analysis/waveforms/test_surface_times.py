"""Surface echoes against beam and geometry: which are a pixel's own, and the errors of those that are inferred."""

import numpy as np
import pytest
from significance import largest_chi2, largest_count, largest_z

from mitransient_lidar.analysis.waveforms.surface_times import surface_times
from mitransient_lidar.core.constants import C0
from mitransient_lidar.results.geometry import LinesOfSight

HALF = 0.5e-9 * C0  # metres of range per nanosecond
ANGLE = np.radians(20)
#: Four pixels 4 mrad about the axis, and one that the beam does not reach.
X, Y = np.array([4, 4, -4, -4, 0.0]) * 1e-3, np.array([-4, 4, -4, 4, 12.0]) * 1e-3
SHARE = np.array([0.25, 0.25, 0.25, 0.249, 1e-6])


def lines(shots, share=SHARE):
    cosine = (np.cos(ANGLE) - np.sin(ANGLE) * X) / np.sqrt(1 + X**2 + Y**2)
    values = (X, Y, np.arccos(cosine), 200 / cosine / HALF, np.full(5, 0.5), np.full(5, 0.106), share)
    return LinesOfSight(*(np.tile(one, (shots, 1)) for one in values))


def tilts(at, slope_variance):
    """Deviation [ns] of pixels by slopes of the sea about the middle of their light, as a closed form."""
    away = at.surface_time * HALF
    x, y = away * at.sight_x / np.cos(at.off_nadir), away * at.sight_y
    share = at.beam_share / at.beam_share.sum(axis=1, keepdims=True)
    x, y = (one - np.sum(share * one, axis=1, keepdims=True) for one in (x, y))
    return np.sqrt(0.5 * slope_variance) * np.hypot(x, y) / (np.cos(at.off_nadir) * HALF)


def infer(time, error=0.05, heights=(-1.0, 1.0), share=SHARE, slope_variance=0.02, method=0.0):
    errors, methods = (np.full(time.shape, one) for one in (error, method))
    at = lines(len(time), share)
    return surface_times(time, errors, methods, at, slope_variance=slope_variance, heights_m=heights, echo_fwhm_ns=5.0)


def test_times_of_tilted_seas_are_kept_and_the_dark_pixel_follows_them():
    """2000 planes with random heights, slopes and errors: z of the inferred time has the variance 1 or less."""
    rng = np.random.default_rng(1)
    shots = 2000
    at = lines(shots)
    away = at.surface_time * HALF
    x, y = away * at.sight_x / np.cos(at.off_nadir), away * at.sight_y
    height = 0.2 * rng.standard_normal((shots, 1))
    height = height + 0.1 * (rng.standard_normal((shots, 1)) * x + rng.standard_normal((shots, 1)) * y)
    truth = at.surface_time - height / (np.cos(at.off_nadir) * HALF)
    noise = np.hypot(0.05, 0.5) * rng.standard_normal(truth.shape)
    seen = truth + noise
    seen[:, 4] += 9.0  # scattered light rises a metre late
    found = infer(seen)
    # One in 1400 looks late by chance.
    assert np.count_nonzero(~found.own[:, :4]) <= largest_count(4 * shots, 1e-3)
    assert not found.own[:, 4].any()
    # Their noise is small beside the heights and slopes of the sea.
    np.testing.assert_allclose(found.time_ns[found.own], seen[found.own], atol=0.03)
    z = (found.time_ns - truth)[:, 4] / found.stderr_ns[:, 4]
    assert abs(z.mean()) < largest_z(shots) / np.sqrt(shots)
    # The true slopes have the assumed variance; the part of the echoes' shape, which this model lacks, is small.
    assert 0.8 < z.std() < np.sqrt(largest_chi2(shots) / shots)


def test_an_echo_outside_the_heights_of_the_sea_is_not_the_surface():
    """A bottom 8 m deep, 75 ns late in all pixels, refers to the mean sea level, whose heights are its error."""
    found = infer(lines(1).surface_time + 75)
    assert not found.own.any()
    np.testing.assert_allclose(found.time_ns, lines(1).surface_time)
    np.testing.assert_allclose(found.stderr_ns, 0.25 / np.cos(lines(1).off_nadir) / HALF)
    unknown = infer(lines(1).surface_time + np.nan, heights=(-np.inf, np.inf))
    assert np.isnan(unknown.time_ns).all()


@pytest.mark.parametrize(("noise", "method"), [(3.0, 0.0), (0.5, 2.0), (0.05, 0.1)])
def test_times_are_the_means_given_all_echoes_and_the_heights_of_the_sea(noise, method):
    """Heights of 0.2 m and a level known to 0.15 m, deviations of single pixels, and errors of both kinds."""
    rng = np.random.default_rng(2)
    at = lines(1)
    per_metre = 1 / (np.cos(at.off_nadir) * HALF)
    variance = 0.02
    height = np.hypot(0.2, 0.15) * rng.standard_normal((4000, 1))
    own = tilts(at, variance) * rng.standard_normal((4000, 5))
    truth = at.surface_time - height * per_metre + own
    seen = truth + np.hypot(noise, method) * rng.standard_normal(truth.shape)
    found = infer(seen, error=noise, heights=(-0.8, 0.8), slope_variance=variance, method=method)
    error = np.hypot(found.stderr_ns, found.method_ns)
    z = ((found.time_ns - truth) / error)[:, :4][found.own[:, :4]]
    # Pixels of a shot share the error of the height.
    assert abs(z.mean()) < largest_z(4000) / np.sqrt(4000)
    assert z.var() == pytest.approx(1, abs=largest_z(4000) * np.sqrt(2 / 4000))
    # In a single pixel in the middle, noise and method are parts of the same share.
    if noise == 0.5:
        assert found.stderr_ns[0, 0] < found.method_ns[0, 0]
        assert error[0, 0] < 0.6 * np.hypot(noise, method)


@pytest.mark.parametrize("height", [0.05, 1e3])
def test_clocks_and_trigger_between_a_surface_and_later_echoes(height):
    """A level sea, noise, a trigger of 0.5 ns and clocks of 0.3 ns: the stated errors of the time to a later echo.

    A sea that is known to be calm draws the time to the mean sea level, so that the trigger does not cancel.
    """
    rng = np.random.default_rng(3)
    shots, noise, trigger, clock = 4000, 0.4, 0.5, 0.3
    at = lines(shots)
    errors = {"slope_variance": 0.02, "heights_m": (-height, height), "echo_fwhm_ns": 5.0}
    shift = trigger * rng.standard_normal((shots, 1)) + clock * rng.standard_normal((shots, 5))
    seen = at.surface_time + shift + noise * rng.standard_normal((shots, 5))
    stated = np.full(seen.shape, noise)
    found = surface_times(seen, stated, 0 * stated, at, **errors, trigger_ns=trigger, clock_ns=clock)
    plain = surface_times(seen, stated, 0 * stated, at, **errors)
    z = ((found.time_ns - at.surface_time - shift) / found.stderr_ns)[:, :4]
    assert found.own[:, :4].all()
    assert np.max(np.abs(z.var(axis=0) - 1)) < largest_z(shots, 4) * np.sqrt(2 / shots)
    # Its own clock cancels but for what the other pixels take of the time; the dark pixel has only theirs.
    extra = found.stderr_ns**2 - plain.stderr_ns**2
    assert np.all((extra[:, :4] > 0) & (extra[:, :4] < clock**2))
    if height > 1:
        np.testing.assert_allclose(extra[:, 4], clock**2 * (1 + 1 / 4), rtol=1e-2)
    # Without any surface echo the time is that of the mean sea level.
    none = surface_times(0 * seen + np.nan, stated, 0 * stated, at, **{**errors, "heights_m": (-1, 1)})
    late = surface_times(
        0 * seen + np.nan,
        stated,
        0 * stated,
        at,
        **{**errors, "heights_m": (-1, 1)},
        trigger_ns=trigger,
        clock_ns=clock,
    )
    np.testing.assert_allclose(late.stderr_ns**2 - none.stderr_ns**2, trigger**2 + clock**2)
