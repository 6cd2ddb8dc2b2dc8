"""Range images from gates."""

import numpy as np
import pytest
import xarray as xr
from figure_inputs import LIDAR, stack
from rows import each_row, must_refuse, refuses
from scipy.special import ndtr
from scipy.stats import binom, chi2

from mitransient_lidar.analysis.gates.range_images import depth_image, range_from_gates
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.results.geometry import LinesOfSight

MID = 0.5 + 0.25 * np.arange(64)


def echoes(depth, decay=0.6, amplitude=6.0, width=0.35):
    """Energies of an exponential column that ends at an echo, both spread as a Gaussian."""
    depth = np.asarray(depth)[..., None]
    column = np.exp(-decay * MID) * ndtr((depth - MID) / width)
    return column + amplitude * np.exp(-decay * depth) * np.exp(-0.5 * ((MID - depth) / width) ** 2)


def test_range_of_a_noiseless_echo():
    depth = np.random.default_rng(2).uniform(4, 12, 500)
    energy = echoes(depth)
    found = range_from_gates(energy, 1e-4 * energy + 1e-9, MID, reach=4)
    # The column is 8000 times as bright at the top as at the deepest echo. A gate is 0.25 m: taken with the column,
    # the centroid would lie more than 0.1 m too shallow, and the middle of the strongest gate off by up to 0.125 m.
    assert np.abs(found.depth - depth).max() < 0.03
    assert found.confidence.min() > 1 - 1e-9


def test_range_is_not_drawn_by_a_column_alone():
    energy = np.exp(-0.6 * MID)[None]
    found = range_from_gates(energy, 1e-3 * energy, MID)
    assert found.confidence[0] < 1e-3
    # The echo alone
    found = range_from_gates(energy * 0 + np.exp(-0.5 * ((MID - 9.1) / 0.3) ** 2), 1e-3 * energy, MID, reach=4)
    assert found.depth[0] == pytest.approx(9.1, abs=1e-3)


def test_range_error_is_the_spread():
    """Over 3000 noise realisations, centroids spread as the stated error says: without a column, where it is exact."""
    draws, rng = 3000, np.random.default_rng(3)
    energy = 1000 * np.exp(-0.5 * ((MID - 8.03) / 0.35) ** 2)
    error = np.full(MID.size, 3.0)
    found = range_from_gates(energy + error * rng.standard_normal((draws, MID.size)), np.tile(error, (draws, 1)), MID)
    z = (found.depth - 8.03) / found.sigma
    # Five gates cut the tails of the echo off, which moves the centroid: compare the spread, not the mean.
    low, high = chi2.ppf([5e-6, 1 - 5e-6], draws - 1) / (draws - 1)
    # The floor of the column is the error of the gates: clipped weights shrink the spread by some per cent.
    assert np.sqrt(low) - 0.1 < np.std(z, ddof=1) < np.sqrt(high)
    assert abs(np.median(found.depth) - 8.03) < 0.02


@pytest.mark.slow
def test_confidence_in_noise():
    """Where there is only noise, a confidence above p comes in at most a fraction 1 - p of the pixels."""
    pixels = 20_000
    noise = np.random.default_rng(4).standard_normal((pixels, MID.size))
    found = range_from_gates(noise, np.ones_like(noise), MID)
    for level in (0.5, 0.9, 0.99):
        allowed = binom.ppf(1 - 2e-6, pixels, 1 - level)
        assert np.count_nonzero(found.confidence > level) <= allowed
    # An echo of 8 standard errors is beyond doubt, one of 1 is not.
    noise[:, 40] += np.where(np.arange(pixels) % 2 == 0, 12, 1)
    found = range_from_gates(noise, np.ones_like(noise), MID)
    assert np.median(found.confidence[::2]) > 0.999
    assert np.median(found.confidence[1::2]) < 0.5


def test_range_without_light_or_with_holes():
    energy = np.stack([np.zeros(64), echoes(8.0), echoes(8.0)])
    energy[2, 5] = np.nan
    found = range_from_gates(energy, np.zeros_like(energy), MID, reach=4)
    np.testing.assert_array_equal(np.isnan(found.depth), [True, False, True])
    np.testing.assert_array_equal(found.confidence, [0, 1, 0])


@refuses(
    ((np.ones((2, 4)), np.ones((2, 5)), np.arange(4)), {}, "must be equal, with the 4 gates"),
    ((np.ones(2), np.ones(2), np.arange(2)), {}, "2 gates and must have at least 3"),
    ((np.ones(3), np.ones(3), [0, 2, 1]), {}, "gate_mid must increase strictly"),
    ((np.ones(3), -np.ones(3), [0, 1, 2]), {}, "stderr = -1 must not be negative"),
    ((np.ones(9), np.ones(9), np.arange(9)), {"reach": 4}, "reach = 4 must lie between 0 and 3"),
)
def test_range_refuses_bad_input(arguments, options):
    range_from_gates(*arguments, **options)


def test_the_strongest_of_two_echoes_counts_though_its_error_is_larger():
    """A sphere in front of a bottom of half its energy, with errors of a fifth and of a hundredth."""
    sphere, bottom = (height * np.exp(-0.5 * ((MID - at) / 0.3) ** 2) for height, at in ((1.0, 6.0), (0.5, 10.0)))
    energy = (sphere + bottom + 1e-3)[np.newaxis]
    found = range_from_gates(energy, (0.2 * sphere + 0.01 * bottom + 1e-4)[np.newaxis], MID, reach=4)
    assert found.depth[0] == pytest.approx(6.0, abs=0.05)


def test_an_echo_behind_a_single_gate_of_the_column_is_found():
    energy = np.full((1, 12), 1e-3)
    energy[0, 5] = 1.0
    found = range_from_gates(energy, 0.01 * energy, np.arange(12.0), reach=4)
    assert found.depth[0] == pytest.approx(5.0, abs=0.01)


def test_depths_are_those_of_echoes_in_the_lines_of_sight():
    """Echoes at times in gates whose middles are 2.5 ns or 0.27 m behind their starts."""
    truth = np.linspace(3, 4, 20).reshape(4, 5)
    made = stack(truth, gates=60).assign_attrs(LIDAR).isel(gate=slice(16, None))
    lines = LinesOfSight.from_dataset(made)
    expected = (LIDAR["surface_time_ns"] + 10 * truth.ravel() - lines.surface_time) * lines.depth_per_ns
    np.testing.assert_allclose(depth_image(made).depth.ravel(), expected, atol=0.06)


def test_gates_with_gaps_give_no_depths():
    stack = xr.Dataset(
        {name: (("pixel", "gate"), np.ones((1, 4))) for name in ("gate_energy", "gate_energy_stderr")},
        {"gate_start": ("gate", 18.0 * np.arange(4)), "gate_width": ("gate", np.full(4, 10.0))},
        {"pulse_fwhm_ns": 5.0},
    )
    must_refuse("the gates leave gaps of 8 ns", depth_image, stack)


def echoes_in_an_image(joules):
    """Return gates with a column and an echo of 5 ns near 1032 ns, 24 x 24 pixels, and the echo depths by time."""
    time = 1000 + 2.5 * np.arange(24)
    echo = 1032 + np.linspace(-2, 2, 24)[:, None, None] + np.zeros((24, 24, 1))
    column = np.exp(-0.05 * (time - 1000)) * ndtr((echo - time) / 2.2)
    shape = column + 6 * np.exp(-0.05 * (echo - 1000) - 0.5 * ((time - echo) / 2.2) ** 2)
    energy = (("row", "column", "gate"), joules * shape)
    return xr.Dataset(
        {"gate_energy": energy, "gate_energy_stderr": (energy[0], 0 * shape)},
        {
            "gate_start": ("gate", time),
            "gate_width": ("gate", np.full(24, 5.0)),
            "gate_depth": ("gate", 0.1 * time),
            "angle_x": (("row", "column"), np.zeros((24, 24))),
            "angle_y": (("row", "column"), np.zeros((24, 24))),
        },
        {"pulses": 500, "pulse_fwhm_ns": 5.0, "gate_step_ns": 2.5},
    ), 0.1 * echo[..., 0]


@pytest.mark.parametrize("frames", [1, 16])
def test_errors_of_depths_are_those_of_a_cameras_frames(frames):
    """Depths of drawn frames about those of their mean, in standard errors: rms 1, within what is not linear."""
    recorded = detect_waveforms(echoes_in_an_image(1e-15)[0], "gated_cmos", shots=4 * frames, seed=3)
    first = recorded.isel(frame=[0])
    quiet = first.assign(signal=0 * first["signal"] + first["signal_mean"])
    known, z = depth_image(quiet).depth, []
    for start in range(0, 4 * frames, frames):
        found = depth_image(recorded.isel(frame=slice(start, start + frames)))
        assert np.median(found.confidence) > 0.999
        z.append((found.depth - known) / found.sigma)
    assert 0.93 < np.sqrt(np.mean(np.square(z))) < 1.1
    np.testing.assert_allclose(np.median(found.sigma) * np.sqrt(frames), np.median(depth_image(quiet).sigma), rtol=0.05)


@each_row(
    ("icmos", 3e-18, 0.1), ("emccd", 1e-17, 0), ("spad_camera", 1e-16, 0.05), ("iccd", 1e-17, 0.1), ("iccd", 1e-14, 0)
)
def test_weak_and_saturated_frames_have_depths_with_errors_that_hold_or_none(camera, joules, share):
    """Signal-to-noise ratios of 2.6 to 4.4, and saturation: depths were 1.2 to 700 standard errors off, rms."""
    made, depth = echoes_in_an_image(joules)
    recorded = detect_waveforms(made, camera, shots=4, seed=3)
    found = [depth_image(recorded.isel(frame=[frame])) for frame in range(4)]
    z = np.array([(one.depth - depth) / one.sigma for one in found])
    known = np.isfinite(z)
    assert known.mean() >= share
    assert np.sqrt(np.sum(z[known] ** 2)) < 1.25 * np.sqrt(known.sum()) + 3


def test_saturated_gates_count_where_a_depth_needs_them():
    """A column that saturates before the gates of the echo's own column, and an echo that saturates."""
    energy = np.tile(echoes(8.0), (3, 1))
    saturated = np.zeros(energy.shape, bool)
    peak = int(np.argmin(np.abs(MID - 8.0)))
    saturated[0, : peak - 10], saturated[1, peak], saturated[2, 40] = True, True, True
    found = range_from_gates(energy, 1e-4 * energy, MID, reach=4, saturated=saturated)
    np.testing.assert_array_equal(np.isfinite(found.depth), [True, False, False])
    assert np.isnan(range_from_gates(energy, 0.3 * energy, MID, least_excess=4.0).depth).all()
