"""Detection of the published targets, from scenes to numbers.

Rationale: with backscatter as the limit, pixels that see the target against little backscatter should be weighted more;
one pixel for all light cannot do so. Expectation: at the same false-alarm rate the best weighting needs less of the
target's signal than one pixel, in 2x2 and more so in 1x4 pixels. Tolerance: the 95 % interval of the gain, over the
renders' errors, must lie above 1.2 and 1.5; with many renders the gains are 1.48 and 1.97.
"""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import binom
from significance import FALSE_ALARM, largest_z

from mitransient_lidar.analysis.detection import images
from mitransient_lidar.analysis.detection.images import ImageTrial
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.physics.receiver.receiver_files import CAMERAS
from mitransient_lidar.studies.detection import detect
from mitransient_lidar.studies.target_signal import target_gates

pytestmark = pytest.mark.long

NEAR = {"surface_size": 60, "time_start_ns": 1410, "bin_count": 120}
FEW = {"type": "lidar_merging", "paths_per_pass": 2**13, "photons_per_pass": 2**13}
OPTIONS = {"renders": 3, "shots": 2000, "integrator": FEW}


@pytest.fixture(scope="module")
def squares():
    return detect("fig13_2x2", NEAR, **OPTIONS)


def test_best_weighting_of_squares_needs_less_than_one_pixel(squares):
    best = squares.sel(combination="best")
    assert best["gain_target_low"] > 1.2
    assert best["gain_energy_low"] > 1.1
    assert best["depth_gain_low"] > 1.05
    assert best["area_low"] > squares["area_high"].sel(combination="single")


def test_drawn_shots_are_detected_as_wanted(squares):
    """The share of 0.9 was found in closed form: drawn shots, whose noise is not normal, must not miss it by much."""
    at = squares.sel(combination="best", false_alarm=squares.attrs["pfa"])
    assert abs(at["drawn_detection"] - 0.9) < 0.01 + largest_z(2000) * np.sqrt(0.09 / 2000)
    assert 2000 * at["drawn_false_alarm"] <= binom.isf(FALSE_ALARM, 2000, 0.003)


GATED = {
    **{"layout": "16x16", "field_of_view_shape": "square", "field_of_view_mrad": 14, "surface_size": 40},
    **{"target_depth": 5, "target_x": 1.4, "target_reflectance": 0.05, "bottom_depth": 7, "pulse_energy_mj": 1e-4},
    **{"gate_start_depth": 4.2, "gate_width_ns": 3, "gate_step_ns": 3, "gate_count": 10},
}


@pytest.mark.parametrize("wind", [1, 5])
def test_rates_of_drawn_images_are_those_predicted_from_other_renders(wind):
    """Three cameras and two seas: 2000 images of a sphere and of its absence, drawn from the light of a later render.

    Weights and probabilities are from four renders. The light is such that one frame detects in 60 to 80 % of the
    images; the interval of the renders is allowed for. A normal distribution would give alarms of 0.02 to 0.035.
    """
    scene = open_scene("fig02_mine", {**GATED, "wind_speed": wind})
    renders = [target_gates(scene, passes=16, seed=1000 * i, integrator=FEW)["gate_light"].values for i in range(5)]
    light, fresh = np.moveaxis(np.array(renders[:4]), 1, 0), renders[4].mean(axis=1)
    for name in ("icmos", "emccd", "spad_camera"):

        def trial(scale, camera=CAMERAS[name]):
            return ImageTrial(scale * light, False, camera, 3.0, 200, 0.0)

        def margin(log, trial=trial):
            return float(trial(np.exp(log)).products.statistic(1).detection(0.05)) - 0.7

        scale = float(np.exp(brentq(margin, -7, 7, rtol=1e-2)))
        own = trial(scale)
        expected, found = own.products.statistic(1), images.detected(own.products, [1], 0.05, 0.9)
        maps, rates = own.maps(1), []
        for which in (1, 0):
            drawn = own.camera.sample(scale * fresh[which], 3.0, 2000, which, 0.0, 200).signal
            values = np.tensordot(drawn - maps["background"], maps["filter_weight"], 3)
            rates.append(float(np.mean(values > expected.threshold(0.05))))
        low, value, high = (found[f"detection{end}"][1][0] for end in ("_low", "", "_high"))
        assert abs(rates[0] - 0.05) < largest_z(2000) * np.sqrt(0.05 * 0.95 / 2000)
        assert abs(rates[1] - value) < 0.01 + (high - low) + largest_z(2000) * np.sqrt(value * (1 - value) / 2000)
