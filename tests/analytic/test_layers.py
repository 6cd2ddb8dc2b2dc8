"""Water in layers: when a step shows in the record, how sharply each receiver sees it, and what absorption does where.

The step is read off the ratio of a record to one with the same seeds whose lower layer lies out of reach, at 30 m: the
cells of merging are then the same, and so are the paths until they reach the step.
"""

import mitsuba as mi
import numpy as np
import pytest
from oracles.echo_times import bottom_time_ns
from scipy.optimize import curve_fit
from scipy.special import ndtr

from mitransient_lidar.loading import catalogue
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.physics.lidar.pulse import Pulse, waveform
from mitransient_lidar.physics.lidar.refraction import surface_time_ns

ANGLE, INDEX = np.radians(20.0), 1.34
BIN_NS = 0.5
#: What a tenth of a metre of depth takes, there and back.
TENTH_NS = float(bottom_time_ns(200.0, 0.1, ANGLE, INDEX, INDEX) - surface_time_ns(200.0, ANGLE))
#: When the step of figure 15 at 3 m shows on the axis.
STEP_NS = float(bottom_time_ns(200.0, 3.0, ANGLE, INDEX, INDEX))
FLAT = {"spectrum": "flat", "slope_variance": "1e-4"}


def shoot(name, params, count, start_ns, bins, cell_size=0.0):
    """Render passes of a scene over deep water, in bins of 0.5 ns: energies [J], shape (passes, pixels, bins)."""
    record = {"time_start_ns": start_ns, "bin_width_ns": BIN_NS, "bin_count": bins}
    scene = open_scene(name, {**params, **record, "bottom_depth": 40}).scene
    engine = mi.load_dict({"type": "lidar_merging", "cell_size": cell_size})
    renderer = engine.prepare(scene, scene.sensors()[0])
    return np.array([renderer.render_pass(seed).histogram.energy() for seed in range(count)])


def steepest_ns(ratio, start_ns, near_ns):
    """Time at which the ratio changes most between the 2 ns before and the 2 ns after, within 8 ns of a time."""
    half = round(2 / BIN_NS)
    means = np.convolve(ratio, np.ones(half) / half, mode="valid")
    change = np.abs(means[half:] - means[:-half])
    times = start_ns + BIN_NS * (half + np.arange(len(change)))
    change = np.where(np.abs(times - near_ns) < 8, change, 0)
    i = int(np.argmax(change))
    before, peak, after = change[i - 1 : i + 2]
    return times[i] + BIN_NS * 0.5 * (before - after) / (before - 2 * peak + after)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", [pytest.param("lidar_merging", marks=pytest.mark.long), "lidar_volpath"])
def test_layers_of_one_water_are_that_water(lidar_scene, passes, integrator):
    """Same seeds, same light: to the bit where layers are equal, as they are joined.

    Where they differ by 1e-7 flights through the edges are rounded, which moves one contribution in 1e5. A path that
    ends elsewhere may shift the random numbers of all that follow, as in one of 50 passes of 2^14 paths, and of 200 of
    2^12: most of five are compared.
    """

    # Paths, not waves, are compared: a coarse mesh is made in no time.
    sea = {"spectrum": "elfouhaily", "size": 60.0, "cell_size": 0.5}

    def record(layer_tops, attenuation="0.9", scattering=0.7):
        water = {
            "layer_tops": layer_tops,
            "attenuation": attenuation,
            "scattering": scattering,
            "backscattering": 0.014,
        }
        engine = {"type": integrator, "paths_per_pass": 2**12}
        if integrator == "lidar_merging":
            engine["photons_per_pass"] = 2**12
        return passes(lidar_scene(integrator=engine, water=water, sea=sea), 5)

    whole = record("0")
    lit = np.sum(whole > 0, axis=(1, 2))

    def share_of_equal_bins(other):
        equal = np.isclose(whole, other, rtol=1e-5, atol=0) & (whole > 0)
        return np.median(equal.sum(axis=(1, 2)) / lit)

    np.testing.assert_array_equal(record("0, 1.1, 2.3, 5.7"), whole)
    divided = record("0, 1.1, 2.3, 5.7", "0.9, 0.9000001, 0.9, 0.9000001")
    assert share_of_equal_bins(divided) > 0.9
    np.testing.assert_allclose(np.median(divided.sum(axis=2) / whole.sum(axis=2), axis=0), 1, atol=1e-4)
    # Of other water the surface echo alone is the same, in a twentieth of the bins.
    assert share_of_equal_bins(record("0", scattering=0.701)) < 0.1


@pytest.mark.slow
def test_scenes_of_figure_15_differ_in_layout_only():
    first, second = (catalogue.scene_parameters(catalogue.scene_path(f"fig15_{kind}")) for kind in ("2x2", "1x1"))
    assert {name for name in first if first[name] != second[name]} == {"layout"}
    assert first.keys() == second.keys()


@pytest.mark.parametrize(
    ("name", "depth", "group_index", "sea"),
    [
        pytest.param("fig15_1x1", 3.0, 1.34, FLAT, marks=pytest.mark.long),
        pytest.param("fig15_1x1", 3.0, 1.34, {}, marks=pytest.mark.long),
        pytest.param("nepheloid_layer", 6.5, 1.364, {}, marks=pytest.mark.slow),
    ],
)
@pytest.mark.long
def test_step_is_seen_at_its_slanted_depth(name, depth, group_index, sea):
    """A beam of 2 mrad, so narrow that its own spread in time is 0.5 ns; light scattered forward comes later."""
    expected = float(bottom_time_ns(200.0, depth, ANGLE, INDEX, group_index))
    start = BIN_NS * round((expected - 18) / BIN_NS)
    params = {**sea, "divergence_mrad": 2, "layout": "1x1"}
    reference, stepped = (
        shoot(name, {**params, "layer_tops": f"0, {top}"}, 6, start, 60, 0.015)[:, 0] for top in (30, depth)
    )
    time, error = jackknife(lambda ratio: steepest_ns(ratio, start, expected), reference, stepped)
    assert error < TENTH_NS / 6
    assert abs(time - expected) < TENTH_NS / 2


