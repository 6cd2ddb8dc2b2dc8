"""Water in layers: when a step shows in the record, how sharply each receiver sees it, and what absorption does where.

The step is read off the ratio of a record to one with the same seeds whose lower layer lies out of reach, at 30 m: the
cells of merging are then the same, and so are the paths until they reach the step.
"""

import mitsuba as mi
import numpy as np
import pytest
from oracles.beam_average import column_energy_per_bin
from oracles.echo_times import bottom_time_ns
from scipy.optimize import curve_fit
from scipy.special import ndtr

import mitransient_lidar
from mitransient_lidar.core.constants import C0
from mitransient_lidar.loading import catalogue
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.physics.lidar.lidar_geometry import LidarSystem
from mitransient_lidar.physics.lidar.pulse import Pulse, waveform
from mitransient_lidar.physics.lidar.refraction import snell, surface_time_ns
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase import fournier_forand, fournier_forand_parameters
from mitransient_lidar.studies.shot_statistics import highest_points

ANGLE, INDEX = np.radians(20.0), 1.34
BIN_NS = 0.5
#: What a tenth of a metre of depth takes, there and back.
TENTH_NS = float(bottom_time_ns(200.0, 0.1, ANGLE, INDEX, INDEX) - surface_time_ns(200.0, ANGLE))
#: Between the 10 % and the 90 % point of a Gaussian step, in its standard deviations.
TEN_TO_NINETY = 2.5631
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


def jackknife(read_off, reference, stepped):
    """Return what is read off the ratio of means over the passes, and its standard error."""

    def of(keep):
        over, under = stepped[keep].mean(axis=0), reference[keep].mean(axis=0)
        # Before any light has come neither has a step.
        return np.asarray(read_off(np.divide(over, under, out=np.ones_like(over), where=under > 0)))

    count = len(reference)
    left_out = np.array([of(np.arange(count) != i) for i in range(count)])
    return of(np.arange(count)), np.sqrt(count - 1) * left_out.std(axis=0)


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


def closed_form_ns(side):
    """Where `steepest_ns` sees the step of figure 15 in the closed form: side -1 near pixels, 1 far ones, 0 all."""
    lidar = LidarSystem(200.0, ANGLE, INDEX, INDEX, energy=1.0, aperture_area=1.0)
    start = 1425.0
    backward = float(fournier_forand(np.pi, *fournier_forand_parameters(0.04)))

    def record(edge):
        column = WaterColumn.from_text([0, edge], [0.9, 0.5], [0.45, 0.25], [0.018, 0.010])
        bins = start + BIN_NS * np.arange(81)
        return column_energy_per_bin(
            *(bins, lidar, 5e-3, column, backward, 29.0),
            lambda angle_x, angle_y: (angle_x**2 + angle_y**2 <= 17.5e-3**2) & (side * angle_x >= 0),
            "a+bb",
        )

    return steepest_ns(record(3) / record(29), start, STEP_NS)


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


@pytest.fixture(scope="module")
def fig15():
    """Passes of figure 15's scene without and with the step in reach, from 1415 to 1490 ns."""
    return tuple(shoot("fig15_2x2", {"layer_tops": layer_tops}, 24, 1415.0, 150) for layer_tops in ("0, 30", "0, 3"))


def of_pixels(energy, pixels):
    return energy[:, pixels].sum(axis=1)


SIDES = {"single": ([0, 1, 2, 3], 0), "far": ([0, 1], 1), "near": ([2, 3], -1)}


@pytest.mark.long
def test_step_of_figure_15_is_seen_when_its_beam_says(fig15):
    """Within 0.1 m for the whole beam; earlier in the near pixels than in the far ones by 3.3 ns (2.8 without delays).

    What the closed form lacks is the delay of light that was scattered forward, 0.3 to 0.8 ns.
    """
    found = {}
    for name, (pixels, side) in SIDES.items():
        parts = (of_pixels(part, pixels) for part in fig15)
        found[name], error = jackknife(lambda ratio: steepest_ns(ratio, 1415.0, STEP_NS), *parts)
        assert error < TENTH_NS / 3
        assert abs(found[name] - closed_form_ns(side)) < 1.5 * TENTH_NS
    assert abs(found["single"] - STEP_NS) < TENTH_NS
    assert abs((found["near"] + found["far"]) / 2 - STEP_NS) < TENTH_NS
    assert 2.5 < found["far"] - found["near"] < 4


def step_model(time, start, sigma, height, growth):
    """Ratio of records about a step, 1 before and height * exp(growth * (t - start)) after it, with Gaussian blur."""
    u = time - start
    after = np.exp(growth * u + 0.5 * (growth * sigma) ** 2) * ndtr(u / sigma + growth * sigma)
    return ndtr(-u / sigma) + height * after


def width_ns(ratio, start_ns, step_ns):
    """Time from 10 to 90 % of the change at a step."""
    time = start_ns + BIN_NS * (np.arange(len(ratio)) + 0.5)
    used = np.abs(time - step_ns - 3) < 19
    fitted, _ = curve_fit(step_model, time[used], ratio[used], p0=[step_ns, 2.6, 0.56, 0.04])
    return TEN_TO_NINETY * fitted[1]


@pytest.mark.long
@pytest.mark.parametrize("what", ["impulse_response", "waveform"])
def test_four_pixels_resolve_the_step_better_than_one(fig15, what):
    """Each sees half the arrival times, and smears the step the less; the pulse and delayed light blur all alike.

    Impulse response: 8.8 ns (0.95 m) in one pixel, 5.6 to 6.5 ns in four; after the pulse 10.6 ns and 8.5 to 8.9 ns.
    """
    kernel = Pulse.gaussian(5.0).kernel(BIN_NS, 0.0)
    records = [waveform(part, BIN_NS, kernel) if what == "waveform" else part for part in fig15]

    def widths(ratios):
        return [width_ns(ratio, 1415.0, STEP_NS) for ratio in ratios]

    # As further pixels of one record: their passes are the same, so that differences have errors of their own.
    wholes = [np.stack([of_pixels(part, pixels) for pixels, _ in SIDES.values()], axis=1) for part in records]
    (single, *_), (single_error, *_) = jackknife(widths, *wholes)
    gain, gain_error = jackknife(lambda ratios: widths(ratios)[0] - np.mean(widths(ratios)[1:]), *wholes)
    each, each_errors = jackknife(widths, *records)
    assert np.all(each_errors < 0.1 * each)
    assert np.all(single - each > 4 * np.hypot(each_errors, single_error))
    assert gain > 5 * gain_error
    assert gain > {"impulse_response": 0.2, "waveform": 0.1}[what] * single


def absorbing(upper, lower):
    """Water of figure 15's particles in a tenth of their number, so thin that light scatters once."""
    b = np.array([0.045, 0.025])
    a = np.array([upper, lower])
    texts = (", ".join(f"{value:.6f}" for value in values) for values in (a + b, b, 0.04 * b))
    return {"layer_tops": "0, 3", **dict(zip(("attenuation", "scattering", "backscattering"), texts, strict=True))}


@pytest.mark.long
def test_absorption_changes_the_bins_behind_it_and_no_others(lidar_scene, passes):
    """A path's absorption is a weight: other absorption, same paths, and exp(-da L) for the way L through it."""
    start, bins = 1410.0, 150

    def record(upper, lower):
        scene = lidar_scene(
            integrator={"type": "lidar_merging"},
            tx={"divergence_mrad": 0.5},
            rx={"field_of_view_mrad": 2.0, "layout": "1x1"},
            film={"time_start_ns": start, "bin_width_ns": BIN_NS, "bin_count": bins},
            sea={"slope_variance": "2e-5"},
            water=absorbing(upper, lower),
            bottom=None,
        )
        return passes(scene, 3).sum(axis=(0, 1))

    before = record(0.45, 0.25)
    below, above, moved = record(0.45, 0.35), record(0.35, 0.25), record(0.35, 0.35)
    time = start + BIN_NS * (np.arange(bins) + 0.5)
    surface = float(surface_time_ns(200.0, ANGLE))
    way = 1e-9 * C0 / INDEX * (time - surface)
    through_upper = 2 * 3.0 / np.cos(snell(ANGLE, INDEX))

    # A cell of water, 0.3 m thick, mixes light of both sides of the edge: 2.8 ns.
    early, late = (time > surface + 2) & (time < STEP_NS - 3), time > STEP_NS + 3
    assert np.all(before[early | late] > 0)
    np.testing.assert_array_equal(below[early], before[early])
    np.testing.assert_array_equal(moved[early], above[early])
    more, less = np.exp(0.1 * np.minimum(way, through_upper)), np.exp(-0.1 * (way - through_upper))
    # The field of view of 2 mrad sees surfaces 0.5 ns nearer and farther: 0.5 % of absorption in single bins.
    np.testing.assert_allclose(above[early] / before[early], more[early], rtol=5e-3)
    np.testing.assert_allclose(above[late] / before[late], more[late], rtol=5e-3)
    np.testing.assert_allclose(below[late] / before[late], less[late], rtol=5e-3)
    np.testing.assert_allclose(moved[late] / before[late], (more * less)[late], rtol=5e-3)
    # Behind as much of the lower water as of the upper the two changes cancel.
    again = np.abs(way - 2 * through_upper) < 0.1
    assert again.any()
    assert (moved[again] / before[again]).mean() == pytest.approx(1, abs=0.01)


@pytest.mark.long
def test_thin_layer_echoes_from_its_depth():
    """Near pixels have the echo of its middle, 4.2 m deep, before the axis has it, far ones as long after it."""
    shot = mitransient_lidar.render("thin_layer", passes=16)
    middle = float(bottom_time_ns(200.0, 4.2, ANGLE, INDEX, 1.364))
    _, times = highest_points(shot, middle - 10, middle + 10)
    assert np.all(np.isfinite(times))
    assert abs(times.mean() - middle) < TENTH_NS / 2
    assert 3 < times[:2].mean() - times[2:].mean() < 5
