"""Frames of gates with own pulses: against renders of moved lidars and later seas, and waves in closed form."""

import itertools

import numpy as np
import pytest
from significance import largest_z

import mitransient_lidar
from mitransient_lidar.cli.messages import exit_if_interrupted
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.interruption import DeferredInterrupt
from mitransient_lidar.physics.sea.cox_munk import cox_munk
from mitransient_lidar.physics.sea.realization import Motion, heights_of, wave_coefficients, wave_numbers
from mitransient_lidar.physics.sea.wave_spectrum import MatchedSpectrum
from mitransient_lidar.physics.sea.wind_spectra import ElfouhailySpectrum
from mitransient_lidar.results.gate_stack import average_frames, check_stack

PATHS = {"type": "lidar_merging", "paths_per_pass": 2**13, "photons_per_pass": 2**12}
GATES = {"gate_start_depth": -2.0, "gate_width_ns": 30.0, "gate_step_ns": 20.0, "gate_count": 3}
SEA = {"wind_speed": 6.0, "group_index": 1.34, "shortest_wave": 1.0, "cell_size": 0.25}


def largest_difference(first, second, passes):
    error = np.hypot(first["gate_energy_stderr"].values, second["gate_energy_stderr"].values)
    z = np.abs(first["gate_energy"].values - second["gate_energy"].values) / error
    return float(z.max()), largest_z(passes, z.size)


@pytest.mark.slow
def test_images_are_those_of_a_moved_lidar_over_a_later_sea():
    """A pulse every 2 s, and 0.25 m/s: after 6 s the lidar has moved 1.5 m. Gates start at the same time to 1 ps."""
    scene = {**GATES, **SEA}
    motion = {"pulse_rate_hz": 0.5, "speed": 0.25, "heading_deg": 70.0}
    frames = mitransient_lidar.render_frames("table1", scene, integrator=PATHS, frames=2, passes=8, **motion)
    assert frames["gate_energy"].dims == ("frame", "pixel", "gate")
    assert frames["pulse_time"].values.tolist() == [[0.0, 2.0, 4.0], [6.0, 8.0, 10.0]]
    angle = np.radians(20.0)
    down = np.sqrt(1 - (np.sin(angle) / 1.34) ** 2)
    start = 2e9 / C0 * (200.0 / np.cos(angle) - 1.34 * 2.0 / down)
    assert frames["gate_start"].values == pytest.approx(start + 20.0 * np.arange(3), abs=1e-3)
    image = frames.isel(frame=1, gate=0)
    place = {"time": 6.0, "aim_x": float(image["platform_x"]), "aim_y": float(image["platform_y"])}
    assert place["aim_x"] == pytest.approx(1.5 * np.sin(np.radians(70.0)))
    moved = mitransient_lidar.render("table1", {**scene, **place}, integrator=PATHS, passes=8, seed=5)
    assert moved["gate_start"].values == pytest.approx(frames["gate_start"].values, abs=1e-3)
    found, limit = largest_difference(image, moved.isel(gate=0), 8)
    assert found < limit
    # The sea at the first pulse is another one.
    found, limit = largest_difference(frames.isel(frame=0, gate=0), moved.isel(gate=0), 8)
    assert found > limit


@pytest.mark.slow
def test_image_of_many_pulses_has_the_mean_of_their_seas():
    """Four pulses in 4 s, of which each of 8 passes renders one, against each pulse in a frame of its own."""
    scene = {**GATES, **SEA, "gate_count": 1}
    every = mitransient_lidar.render_frames("table1", scene, integrator=PATHS, frames=4, passes=8, pulse_rate_hz=1.0)
    summed = mitransient_lidar.render_frames(
        "table1", {**scene, "pulses": 4}, integrator=PATHS, passes=8, pulse_rate_hz=1.0, seed=9
    )
    mean = average_frames(every)
    energies = every["gate_energy"].values
    np.testing.assert_allclose(mean["gate_energy"], energies.mean(axis=0))
    np.testing.assert_allclose(
        mean["gate_energy_stderr"], np.sqrt((every["gate_energy_stderr"].values ** 2).sum(axis=0)) / 4
    )
    found, limit = largest_difference(summed.isel(frame=0), mean * 4, 8)
    assert found < limit
    # The pulses differ by more than that.
    found, limit = largest_difference(every.isel(frame=0), every.isel(frame=2), 8)
    assert found > limit
    again = mitransient_lidar.render(every)
    np.testing.assert_array_equal(again["gate_energy"], energies)
    # Functions that take one stack take the mean.
    np.testing.assert_array_equal(check_stack(every)["gate_energy"], mean["gate_energy"])


@pytest.mark.slow
def test_images_forget_the_waves_as_their_spectrum_does():
    """In linear waves the light on a shallow bottom is the curvature of the sea, whose images the spectrum gives.

    Longer waves than 1 m, at 3 m in clear water, in 40 images of 8 Hz. The spread over patches of large seas is the
    standard error of one patch.
    """
    count, lags = 40, np.array([1, 2, 3, 4, 6, 8, 16, 20])
    scene = {
        **{"wind_speed": 5, "shortest_wave": 1.0, "cell_size": 0.125, "ripple_focusing": "false", "off_nadir_deg": 0},
        **{"layout": "8x8", "field_of_view_shape": "square", "field_of_view_mrad": 30, "divergence_mrad": 20},
        **{"bottom_depth": 3.0, "attenuation": 0.1, "scattering": 0.0, "backscattering": 0.0},
        **{"gate_start_depth": 1.5, "gate_width_ns": 40.0, "gate_count": 1},
    }
    frames = mitransient_lidar.render_frames(
        "table1", scene, integrator=PATHS, frames=count, passes=2, pulse_rate_hz=8.0, seed=5
    )

    def correlation(images, noise=0.0):
        """Return the correlation at all lags of images (time, pixel, ...) with a variance of noise."""
        change = images - images.mean(axis=0)
        products = np.array([(change[lag:] * change[: count - lag]).mean(axis=(0, 1)) for lag in (0, *lags)])
        return products[1:] / (products[0] - noise)

    energy, stderr = (frames[name].values.reshape(count, -1) for name in ("gate_energy", "gate_energy_stderr"))
    mean = energy.mean(axis=0)
    noise = float(((stderr / mean) ** 2).mean())
    found = correlation(energy / mean, noise)
    spectrum = MatchedSpectrum(ElfouhailySpectrum(5.0, 0.84, 0.0), *cox_munk(5.0))
    ix, iy, dk = wave_numbers(96.0, 256)
    square = dk**2 * (ix**2 + iy[:, None] ** 2)
    square[square > (2 * np.pi) ** 2] = 0
    patches = []
    for seed in range(2):
        seas = (wave_coefficients(spectrum, 96.0, 256, seed, Motion(number / 8.0)) for number in range(count))
        maps = [heights_of(square * waves) for waves in seas]
        # Two cells are a pixel, of 0.75 m, and eight pixels a patch.
        pixels = np.reshape(maps, (count, 16, 8, 2, 16, 8, 2)).mean(axis=(3, 6))
        patches.append(np.moveaxis(pixels, (1, 3), (-2, -1)).reshape(count, 64, -1))
    known = correlation(np.concatenate(patches, axis=-1))
    expected, spread = known.mean(axis=1), known.std(axis=1, ddof=1)
    errors = np.hypot(spread, noise / float((energy / mean).var(axis=0).mean() - noise) / np.sqrt(64 * (count - lags)))
    assert np.all(errors < 0.25), errors
    assert np.abs((found - expected) / errors).max() < largest_z(10_000, lags.size), (found, expected, errors)
    # It falls from 1 to below 0, as waves of one length pass, and to 0.
    assert found[0] > 0.6
    assert found[3] < -0.5
    assert np.abs(found[-2:]).mean() < 0.4


@pytest.mark.slow
def test_ctrl_c_keeps_the_frames_that_are_complete():
    def interrupt(progress):
        if progress.done >= 3:
            raise KeyboardInterrupt

    few, options = {**PATHS, "paths_per_pass": 2**10}, {"frames": 500, "passes": 2, "progress": interrupt}
    frames = mitransient_lidar.render_frames("table1", {**GATES, "spectrum": "flat"}, integrator=few, **options)
    assert 1 <= frames.sizes["frame"] < 500
    with pytest.raises(KeyboardInterrupt, match=f"interrupted after {frames.sizes['frame']} of 500 frames"):
        exit_if_interrupted(frames)


@pytest.mark.slow
def test_an_interruption_between_passes_keeps_the_frames_before(monkeypatch):
    """Four passes of a first frame, and the second pass of the next images."""
    calls = itertools.count(1)

    def check():
        if next(calls) == 6:
            raise KeyboardInterrupt

    monkeypatch.setattr(DeferredInterrupt, "check", staticmethod(check))
    few = {**PATHS, "paths_per_pass": 2**10}
    frames = mitransient_lidar.render_frames(
        "table1", {**GATES, "spectrum": "flat"}, integrator=few, frames=500, passes=4
    )
    assert (frames.sizes["frame"], frames.attrs["interrupted"]) == (1, 1)


def test_frames_beyond_the_memory_are_refused_before_the_render():
    with pytest.raises(UserError, match=r"max_memory = 2 GB is less than 1000 frames of 20 gates of 16384 pixels take"):
        mitransient_lidar.render_frames("gated_mine", frames=1000)
    with pytest.raises(UserError, match="scene table1 has no gates, of which frames consist"):
        mitransient_lidar.render_frames("table1")
    with pytest.raises(UserError, match="gate_order = 'last' must be one of in_order, interleaved, random"):
        mitransient_lidar.render_frames("gated_mine", gate_order="last")


@pytest.mark.slow
def test_frames_by_light_maps_have_the_light_of_merging():
    """Two frames 4 s apart: the caustics of the other frame differ by more than the errors."""
    scene = {
        **GATES,
        **SEA,
        "layout": "16x16",
        "field_of_view_shape": "square",
        "gate_start_depth": 1.0,
        "gate_count": 2,
    }
    merged, mapped = (
        mitransient_lidar.render_frames("table1", scene, light=light, frames=2, passes=8, pulse_rate_hz=0.5)
        for light in ("merging", "maps")
    )
    assert mapped.attrs["light"] == "maps"
    found, limit = largest_difference(mapped, merged, 8)
    assert found < limit
    own, other = (each["gate_energy"].values for each in (mapped, merged))
    same, apart = (np.corrcoef(own[0].ravel(), other[frame].ravel())[0, 1] for frame in (0, 1))
    assert 1 - same < 0.3 * (1 - apart)
    np.testing.assert_array_equal(mitransient_lidar.render(mapped)["gate_energy"], mapped["gate_energy"])
    with pytest.raises(UserError, match="light = 'paths' must be one of merging, maps"):
        mitransient_lidar.render_frames("gated_mine", light="paths")
