"""Detection in gated images: predictions against drawn frames of cameras, and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import significance
from scipy.special import ndtr, ndtri
from scipy.stats import norm, skew
from significance import largest_z

from mitransient_lidar.analysis.detection.images import ImageTrial, detected, single_gates
from mitransient_lidar.analysis.gates.recording import jittered_beside
from mitransient_lidar.physics.receiver.camera import Camera

PHOTON = 6.62607015e-34 * 299792458 / 532e-9  # [J]
SIZE, GATES, PULSES = 16, 6, 200
#: Kind of camera, and photons of the first gate in a pixel for which the detection is neither 0 nor 1.
INTENSIFIED = {"kind": "intensified", "quantum_efficiency": 0.2, "gain": 100.0, "excess_noise": 1.8}
INTENSIFIED |= {"intensifier_mtf": 0.3, "read_noise": 8.0, "electrons_per_dn": 4.0, "offset_dn": 100.0}
CAMERAS = {
    "intensified": (Camera(**INTENSIFIED), 30),
    "counting": (Camera(kind="counting", quantum_efficiency=0.3, open_dark_hz=1e3, bits=8), 12),
    "direct": (Camera(kind="direct", quantum_efficiency=0.6, read_noise=5.0, offset_dn=100.0), 30),
}


def light(level, renders=1, seas=0.0, noise=0.0, seed=0, echo=0.12, shadow=0.2):
    """Return energies of renders as of `ImageTrial`: a disc that shines in gate 2 and darkens gates 4 and 5.

    Seas tilt the image at random, and change each pixel by half as much; `noise` is that of the renders.
    """
    random = np.random.default_rng(seed)
    y, x = (np.mgrid[:SIZE, :SIZE] + 0.5) / SIZE - 0.5
    disc = (np.hypot(x, y) < 0.25)[..., None]
    bare = level * PHOTON * np.exp(-0.3 * np.arange(GATES)) * np.ones((SIZE, SIZE, 1))
    change = np.array([0, 0, echo, 0, -shadow, -shadow]) * disc
    found = np.empty((2, renders, 2, SIZE, SIZE, GATES))
    for render in range(renders):
        tilts, own = random.normal(size=2), random.normal(size=(SIZE, SIZE, 1))
        sea = 1 + seas * ((tilts[0] * x + tilts[1] * y)[..., None] + 0.5 * own)
        for half in range(2):
            error = 1 + noise * random.normal(size=bare.shape)
            found[:, render, half] = np.array([bare * (1 + change), bare]) * np.maximum(sea * error, 0)
    return found


def trial(camera, level, renders=3, seas=0.0, **options):
    return ImageTrial(light(level, renders, seas, **options), seas > 0, camera, 5.0, PULSES, 0.0)


def quantile(own, frames, pfa=0.01):
    return float(own.products.statistic(frames).quantile(pfa))


@pytest.mark.slow
@pytest.mark.parametrize("seas", [0.0, 0.4])
@pytest.mark.parametrize("kind", CAMERAS)
def test_predicted_probabilities_are_the_rates_of_drawn_images(kind, seas):
    """2000 images with and without the target, in one known sea or each in another one than the filter has seen.

    The statistic is taken as normal: its skewness, at most 0.1 here, changes a rate of false alarms of 0.05 by 0.003.
    """
    camera, level = CAMERAS[kind]
    own, count, pfa = trial(camera, level, 40 if seas else 3, seas), 2000, 0.05
    expected, maps = own.products.statistic(1), own.maps(1)
    found = []
    for which in (1, 0):
        lights = light(level, count if seas else 1, seas, seed=7 + which)[which]
        frames = count // len(lights)
        drawn = [camera.sample(one[0], 5.0, frames, (which, i), 0.0, PULSES).signal for i, one in enumerate(lights)]
        values = np.concatenate([np.tensordot(one - maps["background"], maps["filter_weight"], 3) for one in drawn])
        found.append(float(np.mean(values > expected.threshold(pfa))))
    for rate, chance in zip(found, (pfa, float(expected.detection(pfa))), strict=True):
        assert abs(rate - chance) < 0.003 + largest_z(count) * np.sqrt(chance * (1 - chance) / count), (rate, chance)
    assert 0.3 < expected.detection(pfa) < 0.95


@pytest.mark.slow
@pytest.mark.parametrize("kind", CAMERAS)
def test_jitter_and_fixed_pattern_are_in_the_prediction(kind):
    """Frames whose gates open 0.4 ns early or late, and pixels that differ by 20 %, with the same filters.

    The filter that knows of the jitter avoids it; behind one that does not, frames deviate more than it states.
    """
    camera, level = CAMERAS[kind]
    more = {} if kind == "counting" else {"offset_spread_dn": 5.0}
    camera = replace(camera, gate_jitter_ns=6.0, response_spread=0.2, hot_pixels=0.02, hot_factor=20.0, **more)
    mean, slope = jittered_beside(light(3 * level, 3, echo=0.06, shadow=0.08), 6.0, 6.0, 2.0, 8.0)
    own, count, pfa = ImageTrial(mean, False, camera, 5.0, PULSES, 0.0, slope), 2000, 0.05
    expected, maps = own.products.statistic(1), own.maps(1)
    known = {"background": 0.0, "pulses": PULSES, "pattern": camera.pattern((SIZE, SIZE))}
    deviations, rates = [], []
    for which in (1, 0):
        given = mean[which, 0, 0], 5.0, count, (which, 5 + significance.seed_shift)
        drawn = camera.sample(*given, slope=slope[which, 0, 0], **known).signal
        blind = replace(own, slope=None).maps(1)["filter_weight"]
        values = [np.tensordot(drawn - maps["background"], one, 3) for one in (maps["filter_weight"], blind)]
        rates.append(np.mean(values[0] > expected.threshold(pfa)))
        deviations.append([one.std(ddof=1) for one in values])
    stated = np.array([expected.null_sd, expected.target_sd])
    error = largest_z(count, 4) / np.sqrt(2 * count)
    np.testing.assert_allclose(np.array(deviations)[:, 0] / stated, 1, atol=error)
    assert deviations[0][1] > (1 + error) * replace(own, slope=None).products.statistic(1).null_sd
    for rate, chance in zip(rates, (pfa, float(expected.detection(pfa))), strict=True):
        assert abs(rate - chance) < 0.003 + largest_z(count) * np.sqrt(chance * (1 - chance) / count), (rate, chance)


def test_deflection_in_closed_form_grows_with_the_root_of_the_frames():
    """A camera of Poisson counts and read-out noise in one known sea: sqrt(N sum(s^2 / v)), with shadows."""
    camera, level = CAMERAS["direct"]
    own = trial(camera, level)
    target, null = 0.6 / PHOTON * own.light[:, 0, 0]
    variance = 0.5 * (target + null) + 25 + 1 / 12
    sharpness = np.sqrt(np.sum((target - null) ** 2 / variance))
    null_share = np.sum((target - null) ** 2 / variance**2 * (null + 25 + 1 / 12)) / sharpness**2
    for frames in (1, 9):
        deflection = own.products.statistic(frames).deflection
        assert deflection == pytest.approx(np.sqrt(frames / null_share) * sharpness, rel=1e-3)
    # The quantile is linear in the root, from that of the false alarms without a frame.
    steps = [quantile(own, frames) + norm.isf(0.01) * np.sqrt(null_share / (2 - null_share)) for frames in (1, 4, 100)]
    np.testing.assert_allclose(np.array(steps) / steps[0], [1, 2, 10], rtol=1e-3)
    found = detected(own.products, [1, 2, 5, 10, 20], 0.01, 0.9999)
    needed = found["frames_needed"][1]
    assert 2 < needed < 20
    assert quantile(own, needed - 1) < ndtri(0.9999) <= quantile(own, needed)
    assert found["detection"][1][0] == pytest.approx(float(ndtr(quantile(own, 1))))


def uneven(camera, level):
    """Return images of rare events and a target of which some parts are far brighter than the water."""
    own = trial(camera, level)
    own.light[0] = own.light[1] * np.geomspace(1, 300, SIZE)[:, None, None]
    return own


def test_filters_of_the_best_share_detect_most():
    own = uneven(CAMERAS["counting"][0], 0.003)
    best = quantile(own.tuned(1, 1e-3), 1, 1e-3)
    others = [quantile(replace(own, target_share=share), 1, 1e-3) for share in np.linspace(0.02, 1, 15)]
    assert best > max(others) - 0.05
    assert best > min(others) + 0.1


@pytest.mark.parametrize("kind", ["intensified", "counting"])
def test_rare_events_skew_the_sum_of_the_pixels(kind):
    """The skewness of a sample has an error of sqrt(6/n) where it is small, and a larger one elsewhere."""
    own, count = uneven(CAMERAS[kind][0], 5e-4), 800
    expected, weights = own.products.statistic(1), own.maps(1)["filter_weight"]
    limit = 1.5 * largest_z(count) * np.sqrt(6 / count)
    assert max(expected.null_skewness, expected.target_skewness) > limit
    for light, stated in ((own.light[1], expected.null_skewness), (own.light[0], expected.target_skewness)):
        drawn = own.camera.sample(light[0, 0], 5.0, count, 3, 0.0, PULSES).signal
        assert abs(skew(np.tensordot(drawn, weights, 3)) - stated) < limit


def test_a_shadow_alone_is_detected():
    """A black target: the same deflection with the sign turned, and the best single gate is behind it."""
    camera, level = CAMERAS["direct"]
    own = trial(camera, level, echo=0.0)
    assert own.products.statistic(1).deflection > 1.5
    assert np.max(own.maps(1)["filter_weight"]) <= 1e-12
    assert np.min(own.maps(1)["contrast"]) == pytest.approx(-0.2, abs=1e-3)
    found = single_gates(own, [1, 2], 1, 1, 0.01)
    deflection = found["gate_deflection"][1]
    assert np.nanargmax(deflection[0]) == 4
    assert np.nanargmax(deflection[1]) == 4
    # The read-out adds its noise once to both gates.
    assert deflection[0, 4] < np.hypot(*deflection[0, 4:]) < deflection[1, 4]
    assert np.isnan(deflection[1, 5])


def test_a_target_that_changes_nothing_raises_false_alarms():
    found = detected(trial(*CAMERAS["direct"], echo=0.0, shadow=0.0).products, [1, 100], 0.01, 0.9)
    np.testing.assert_allclose(found["detection"][1], 0.01)
    assert found["frames_needed"][1] == np.inf


def test_errors_of_renders_are_no_clutter():
    """Pixels with errors of 7 % in each half of a render: clutter is that of the seas alone.

    Taken as clutter, the errors would raise the deviation of the statistic without the target 1.6 times.
    """
    camera, level = CAMERAS["direct"]
    exact, noisy = (trial(camera, level, 50, 0.1, noise=noise).products.statistic(25) for noise in (0.0, 0.07))
    assert noisy.null_sd == pytest.approx(exact.null_sd, rel=0.2)
    assert noisy.deflection == pytest.approx(exact.deflection, rel=0.25)
