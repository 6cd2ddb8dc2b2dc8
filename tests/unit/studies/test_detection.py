"""Performance of detection: needed signals, drawn shots, depths, tables, drawings and the command, without renders."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from rows import refuses
from scipy.stats import norm, t
from significance import largest_z

from mitransient_lidar.analysis.detection import trials
from mitransient_lidar.analysis.detection.trials import COMBINATIONS, Experiment, Level
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import LinearDetector
from mitransient_lidar.physics.receiver.electronics import Amplifier
from mitransient_lidar.plots.studies.targets import plot_detection
from mitransient_lidar.studies import cases, detection

NAMES = ["red", "green", "blue", "black"]
T = np.arange(40)
PULSE_NS = 5.0
ECHO = np.exp(-4 * np.log(2) * ((T - 20) / PULSE_NS) ** 2)
PHOTON = 6.62607015e-34 * 299792458 / 532e-9 / 1e-9  # power of a photon in a bin of 1 ns [W]

COUNTER = ReceiverChain(LinearDetector(1.0))
NOISY = ReceiverChain(LinearDetector(1.0), Amplifier(1e4, 100.0))


def experiment(
    levels=(1, 1, 1, 1), echoes=(0, 0, 1, 0), chain=COUNTER, renders=4, seas=False, scatter=0.01, photons=1e6
):
    """Return four pixels with steady backscatter and a target's echo."""
    random = np.random.default_rng(1)
    bare = photons * PHOTON * np.multiply.outer(np.ones(renders), np.multiply.outer(levels, np.ones(len(T))))
    own = 0.3 * photons * PHOTON * np.multiply.outer(np.ones(renders), np.multiply.outer(echoes, ECHO))
    own *= 1 + scatter * random.normal(size=(renders, 1, 1))
    return Experiment(bare, own, seas, chain, 1.0, 0.0, slice(12, 29), int(np.argmax(echoes)))


def test_one_pixel_of_four_holds_the_target():
    """Shot noise of 4 B against that of B: the pixel alone needs half, and the sum is as bad as one detector."""
    found = trials.needs(experiment(), 1e-3, 0.9)
    gains = dict(zip(COMBINATIONS, found["gain_target"][1], strict=True))
    # Not exactly 2: the echo's own shot noise adds up to 0.3 % of the variance at this level.
    assert gains["best"] == pytest.approx(2, rel=0.005)
    assert gains["brightest"] == pytest.approx(gains["best"], rel=1e-3)
    assert gains["sum"] == pytest.approx(1, rel=1e-6)


def test_needed_share_in_closed_form():
    """Backscatter's shot noise: a share f of s photons in B has a deflection of f sqrt(sum(s^2/B)), wanted is 4.372."""
    level = experiment(scatter=0.0).needed("best", "target", 1e-3, 0.9)
    sharpness = np.sqrt(np.sum((0.3e6 * ECHO[12:29]) ** 2 / 1e6))
    assert np.exp(level.log) == pytest.approx(4.3718 / sharpness, rel=0.01)


def test_needed_energy_in_closed_form():
    """Shot noise falls with the root of the energy, so that the share of it is the square of the deflections'."""
    light = experiment(scatter=0.0)
    level = light.needed("best", "energy", 1e-3, 0.9)
    photons, rise = np.exp(level.log) * 1e6, np.exp(level.log) * 0.3e6 * ECHO[12:29]
    weights = rise / (photons + rise / 2)
    lifted = weights @ rise - norm.isf(1e-3) * np.sqrt(photons * np.sum(weights**2))
    assert lifted / np.sqrt(weights**2 @ (photons + rise)) == pytest.approx(norm.ppf(0.9), abs=0.002)


def test_electronics_of_four_detectors_add_up():
    """Where amplifiers make the noise, four of them have twice that of one for the same light."""
    found = trials.needs(experiment(echoes=(1, 1, 1, 1), chain=NOISY, photons=1e3), 1e-3, 0.9)
    gains = dict(zip(COMBINATIONS, found["gain_target"][1], strict=True))
    assert gains["sum"] == pytest.approx(0.5, rel=0.01)
    assert gains["best"] == pytest.approx(0.5, rel=0.01)
    assert gains["brightest"] == pytest.approx(0.25, rel=0.01)


def test_intervals_hold_the_scatter_of_renders():
    """Renders whose echoes differ by factors: the needed share has Student's interval of their mean."""
    light = experiment(renders=6, scatter=0.05)
    level = light.needed("best", "target", 1e-3, 0.9)
    factors = light.difference[:, 2, 20] / light.difference[:, 2, 20].mean()
    reach = t.ppf(0.975, 5) * factors.std(ddof=1) / np.sqrt(6)
    value, low, high = level.limits()
    assert np.log(high / value) == pytest.approx(reach, rel=0.03)
    assert np.log(value / low) == pytest.approx(reach, rel=0.03)
    # All pixels share these factors: the gain does not know them.
    _, low, high = level.limits(light.needed("single", "target", 1e-3, 0.9))
    assert high / low < 1.001


def test_hopeless_and_trivial_levels():
    nothing = experiment(echoes=(0, 0, 1e-12, 0)).needed("best", "target", 1e-3, 0.9)
    assert nothing.limits() == (np.inf, np.inf, np.inf)
    assert experiment(photons=1e30).needed("best", "target", 1e-3, 0.9).log == -np.inf


def test_drawn_shots_have_the_expected_rates():
    light = experiment(levels=(2, 2, 1, 0.5), echoes=(0, 0.2, 1, 0.5))
    share = np.exp(light.needed("best", "target", 0.05, 0.9).log)
    shots = 4000
    found = trials.drawn(light, share, 0.05, shots, 3)
    at = int(np.flatnonzero(found["false_alarm"][1] == 0.05)[0])
    for row in range(len(COMBINATIONS)):
        for name, expected in (
            ("drawn_false_alarm", 0.05),
            ("drawn_detection", found["expected_detection"][1][row][at]),
        ):
            error = np.sqrt(expected * (1 - expected) / shots)
            assert abs(found[name][1][row, at] - expected) < largest_z(shots, 8) * error
    assert found["expected_detection"][1][-1][at] == pytest.approx(0.9, abs=1e-3)
    # The target whose whole signal is that share is detected as often.
    whole = trials.detected(replace(light, difference=share * light.difference), 0.05)["detection"][1]
    np.testing.assert_allclose(whole, [row[at] for row in found["expected_detection"][1]], atol=1e-3)
    # Rates and area agree: the best weighting beats one pixel far beyond the intervals.
    assert found["area_low"][1][3] > found["area_high"][1][0]
    assert np.all(np.abs(found["area"][1] - found["expected_area"][1]) < 0.03)


def test_interval_of_detection_is_that_of_the_scatter_of_renders():
    """In amplifier noise the deflection is proportional to the echo, whose logarithms scatter by 20 %."""
    light = experiment(echoes=(0, 0, 1, 0), chain=NOISY, renders=6, scatter=0.2, photons=4e4)
    found = trials.detected(light, 0.02)
    low, value, high = (norm.ppf(found[f"detection{end}"][1][3]) + norm.isf(0.02) for end in ("_low", "", "_high"))
    factors = light.difference[:, 2, 20] / light.difference[:, 2, 20].mean()
    reach = t.ppf(0.975, 5) * factors.std(ddof=1) / np.sqrt(6)
    np.testing.assert_allclose([low / value, high / value], [1 - reach, 1 + reach], rtol=0.02)
    # The pixels without an echo raise false alarms alone, and the brightest is one of the pixels.
    alone, combined = found["pixel_detection"][1], found["detection"][1]
    np.testing.assert_allclose(alone[[0, 1, 3]], 0.02)
    assert alone[2] == pytest.approx(combined[2])


@pytest.fixture(scope="module")
def result():
    """A result as of `detect`, from synthetic light."""
    light = experiment(levels=(2, 2, 1, 0.5), echoes=(0, 0.2, 1, 0.5))
    data = trials.needs(light, 1e-3, 0.9) | trials.detected(light, 1e-3)
    share = float(data["needed_target"][1][-1])
    data |= trials.drawn(light, share, 1e-3, 200, 1) | trials.depth_errors(light, 200, 1, PULSE_NS, 0.11)
    data |= trials.by_depth([light, experiment(photons=1.0)], [4.0, 8.0], 1e-3, 0.9)
    for name, values in (("background", light.background), ("difference", light.difference)):
        data[name] = (("pixel", "time"), values.mean(axis=0), {"units": "W"})
    coords = {"combination": list(COMBINATIONS), "pixel": NAMES, "time": 0.5 + T}
    attributes = {"scene": "made_up", "receiver": "apd", "pfa": 1e-3, "pd": 0.9, "shots": 200, "clutter": 0}
    attributes |= {"drawn_share": share, "confidence": 0.95, "brightest": "blue", "gain_pixels": 1.0}
    return xr.Dataset(data, coords, {**attributes, "gain_single": 0.5, "pulse_fwhm_ns": PULSE_NS})


@pytest.mark.slow
@pytest.mark.parametrize(("pd", "verdict"), [(0.1, "detected"), (0.9, "undecided"), (0.99, "not detected")])
def test_sentence_answers_whether_the_target_is_detected(result, pd, verdict):
    shown = result.copy().assign_attrs(pd=pd)
    shown["detection"], shown["detection_low"], shown["detection_high"] = (
        ("combination", [0.5, 0.4, 0.6, value]) for value in (0.92, 0.85, 0.97)
    )
    text, *lines = detection.describe_detection(shown)
    assert text.startswith(f"{verdict}: P_d = 0.92 (0.85 .. 0.97) with the best weighting")
    assert "one pixel for all light 0.5" in text
    assert all(f"{name} " in text for name in NAMES)
    rows = [line.split()[0] for line in lines]
    assert [rows.count(name) for name in COMBINATIONS] == [3, 3, 3, 3]
    best = next(line for line in lines if line.startswith("best"))
    assert f"{100 * float(result['needed_target'][3]):.3g} (" in best


@pytest.mark.slow
def test_clutter_that_all_pixels_share_is_weighted_away():
    """Backscatter that differs by 20 % from sea to sea, alike in all pixels, hides the target from one pixel alone."""
    random = np.random.default_rng(2)
    light = experiment(renders=8, seas=True)
    light.background[:] *= 1 + 0.2 * random.normal(size=(8, 1, 1))
    found = trials.needs(light, 1e-2, 0.9)
    gains = dict(zip(COMBINATIONS, found["gain_target"][1], strict=True))
    assert gains["best"] > 1.5


def test_depth_errors_reach_the_bound():
    found = trials.depth_errors(experiment(scatter=0.0, photons=1e5), 4000, 5, PULSE_NS, 0.11)
    spread, bound = found["depth_spread"][1], np.array(found["depth_bound"][1])
    # 4000 shots know a spread to 1.1 %; 1 % for what noise does not do to a linear estimate.
    np.testing.assert_allclose(spread, bound, rtol=largest_z(4000, 4) * 0.0112 + 0.01)
    assert np.all(np.abs(found["depth_bias"][1]) < largest_z(4000, 4) * bound / np.sqrt(4000))
    assert 1.7 < found["depth_gain_low"][1][3] < found["depth_gain"][1][3] < 2.0


def test_detectable_depth_is_where_the_whole_signal_suffices(monkeypatch):
    """Needed shares of e^-1 at 4 m and e^3 at 8 m cross 1 at 5 m; renders of e^-1.1 and e^-0.9 shift that."""
    changes = np.array([-0.1, 0.1, 0.0])
    levels = iter([Level(-1.0, changes), Level(3.0, 0 * changes)] * 3 + [Level(1.0, changes), Level(3.0, changes)])
    monkeypatch.setattr(Experiment, "needed", lambda *_: next(levels))
    found = trials.by_depth([experiment(), experiment()], [4.0, 8.0], 1e-3, 0.9)
    reached, low = found["detectable_depth"][1], found["detectable_depth_low"][1]
    assert reached[0] == pytest.approx(5)
    moved = [4 + 4 * (1 - c) / (4 - c) for c in changes]
    error = np.sqrt(2 / 3 * np.sum((np.array(moved) - np.mean(moved)) ** 2))
    assert 5 - low[0] == pytest.approx(t.ppf(0.975, 2) * error)
    assert np.isnan(reached[3])
    assert found["needed_at_depth"][1][0, 1] == pytest.approx(np.exp(3))


@pytest.mark.slow
def test_figure_shows_the_numbers_of_the_result(result):
    figure = plot_detection(result)
    light, characteristic, required, gains, errors, depths = figure.axes
    np.testing.assert_allclose(light.lines[4].get_ydata().max(), 1e6 * result["difference"][2].max())
    assert [text.get_text() for text in light.get_legend().get_texts()] == [*NAMES, "without the target"]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[:4] == ["one pixel for all light", "sum of the pixels", "brightest pixel alone", "best weighting"]
    assert labels[4] == "200 simulated shots"
    for i, name in enumerate(COMBINATIONS):
        np.testing.assert_allclose(characteristic.lines[2 * i].get_ydata(), result["expected_detection"][i])
        np.testing.assert_allclose(
            depths.lines[2 * i].get_ydata(), 100 * result["needed_at_depth"].sel(combination=name)
        )
    assert characteristic.get_title().endswith("% of the target's signal")
    assert required.get_title() == "required for $P_d$ = 0.9 at $P_{fa}$ = 0.001"
    # Points of each combination: the share of the target's signal at 0, that of the pulse energy at 1.
    points = [container.lines[0].get_data() for container in required.containers]
    shares = [float(value) for x, (value,) in points if x[0] < 0.5]
    np.testing.assert_allclose(shares, 100 * result["needed_target"])
    heights = {round(bar.get_x() + bar.get_width() / 2, 6): bar.get_height() for bar in gains.patches}
    for i in range(4):
        assert heights[round(0.2 * (i - 1.5), 6)] == pytest.approx(float(result["gain_target"][i]))
    spreads = {round(bar.get_x() + bar.get_width() / 2, 6): bar.get_height() for bar in errors.patches}
    assert spreads[0.3] == pytest.approx(1e3 * float(result["depth_spread"][3]))
    assert figure.get_suptitle() == "made_up, receiver apd: detection in noise, 95 % confidence intervals"


def test_figure_without_depths_and_with_infinite_values(result):
    hopeless = result.drop_dims("depth").copy(deep=True)
    hopeless["needed_energy"][:] = np.inf
    *_, required, _, _, depths = plot_detection(hopeless).axes
    assert not depths.axison
    assert len(depths.get_legend().get_texts()) == 5
    assert {round(container.lines[0].get_xdata()[0]) for container in required.containers} == {0}


@pytest.mark.slow
def test_seas_and_depths_are_asked_for(monkeypatch):
    """Four other seas than the scene's, surface_seed 8, at its own depth of 8 m and at those for which there is time.

    Renders take a second each: of depths of 7 and 7.5 m only the first begins within 5 s.
    """
    asked: list[tuple[int, float, int]] = []
    monkeypatch.setattr(cases.time, "perf_counter", lambda: float(len(asked)))
    random = np.random.default_rng(3)

    def signal(session, **options):
        own = session.parameters
        asked.append((int(own["surface_seed"]), float(own["target_depth"]), options["seed"]))
        light = experiment(levels=random.uniform(0.9, 1.1, 4), photons=1e5 if own["target_depth"] == "7" else 1e6)
        data = {"background": light.background[0], "difference": light.difference[0]}
        coords = {"pixel": ["red", "green", "blue", "black"], "time": 0.5 + T}
        return xr.Dataset({name: (("pixel", "time"), values) for name, values in data.items()}, coords)

    monkeypatch.setattr(detection, "target_signal", signal)
    done = []
    # Ten meshes are made, of which nothing is rendered.
    coarse = {"surface_size": 60, "surface_cell_size": 0.5}
    count = {"clutter": 4, "shots": 200, "receiver": "ideal"}
    count |= {"progress": lambda state: done.append((state.done, state.planned))}
    found = detection.detect("fig13_2x2", coarse, depths=(7, 7.5), max_time=5, **count)
    assert [(seed, depth) for seed, depth, _ in asked] == [(9 + i, d) for d in (8, 7) for i in range(4)]
    # The same random numbers at each depth, others for each sea.
    assert len({seed for *_, seed in asked}) == 4
    assert done == [(i + 1, 12) for i in range(8)]
    assert found.attrs["depths_left_out"] == "7.5"
    assert found["needed_at_depth"].sizes == {"combination": 4, "depth": 1}
    assert found.attrs["renders"] == found.attrs["clutter"] == 4
    assert found.attrs["scene.surface_seed"] == "8"
    assert np.all(found["needed_at_depth"] > found["needed_target"])
    assert "noise and 4 seas" in detection.describe_detection(found)[1]


GATES = {"layout": "8x8", "gate_start_depth": 4, "gate_width_ns": 6, "gate_step_ns": 3, "gate_count": 5}


@pytest.mark.slow
@pytest.mark.parametrize("clutter", [0, 4])
def test_images_of_a_camera_are_filtered(monkeypatch, tmp_path, clutter):
    """A target of a pixel that shines in gate 1 and darkens gate 3, at its depth and at 5 m, where it is brighter."""
    asked, random = [], np.random.default_rng(4)

    def gates(session, **options):
        own = session.parameters
        asked.append((own["surface_seed"], own["target_depth"], options["seed"]))
        change = np.zeros((8, 8, 5))
        change[2, 5] = [0, 0.6, 0, -0.9, 0]
        light = 2e-17 * random.uniform(0.99, 1.01, (2, 8, 8, 5))
        both = np.stack([light * (1 + (3 if own["target_depth"] == "5" else 1) * change), light])
        dims = ("row", "column", "gate")
        data = {"gate_light": (("kind", "half", *dims), np.maximum(both, 0)), "gate_energy": (dims, both[0, 0])}
        start, depth = 1450 + 3.0 * np.arange(5), 4.33 + 0.33 * np.arange(5)
        coords = {name: (dims[:2], random.normal(size=(8, 8))) for name in ("angle_x", "angle_y")}
        coords |= {
            "gate_start": ("gate", start),
            "gate_depth": ("gate", depth),
            "gate_width": ("gate", np.full(5, 6.0)),
        }
        coords |= {"row": np.arange(8), "column": np.arange(8), "gate": np.arange(5)}
        stack = xr.Dataset(data, coords, {"gate_step_ns": 3.0})
        return stack.assign(gate_energy_stderr=0 * stack["gate_energy"])

    monkeypatch.setattr(detection, "target_gates", gates)
    coarse = {"surface_size": 40, "surface_cell_size": 0.5, **GATES}
    options = {"receiver": "icmos", "clutter": clutter, "renders": 4, "pfa": 0.01, "frames": 3}
    found = detection.detect("fig02_mine", coarse, depths=(5,), **options)
    assert [one[:2] for one in asked] == [(str(2 + i if clutter else 1), d) for d in ("9", "5") for i in range(4)]
    assert found["snr"].dims == ("row", "column", "gate")
    assert found["frames"].values[:4].tolist() == [1, 2, 3, 5]
    place = found["contrast_to_noise"].argmax(...)
    assert {name: int(one) for name, one in place.items()} == {"row": 2, "column": 5, "gate": 1}
    assert float(found["contrast"].min()) < -0.1  # behind the blur of optics and intensifier
    # One pixel: every second gate adjoins, and three at most; an echo beside its shadow is no better.
    assert found["adjoining"].values.tolist() == [1, 2, 3]
    assert found["frames_needed_at_depth"] < found["frames_needed"]
    lines = detection.describe_detection(found)
    assert "3 frames of each of 5 gates, at P_fa = 0.01" in lines[0]
    assert lines[1].startswith(f"fig02_mine, receiver icmos, noise{' and 4 seas' * bool(clutter)};")
    assert "most clearly in row 2, column 5, gate 1 (4.66 m)" in lines[2]
    assert "most clearly in row 2, column 5, gate 3 (5.32 m)" in lines[3]
    figure = plot_detection(found, tmp_path / "images.png")
    np.testing.assert_allclose(figure.axes[3].lines[0].get_ydata(), found["detection"])


@pytest.mark.slow
@refuses(
    # A dead time of 30 ns, which the first of a million photons starts.
    (0, "spad", "receiver spad does not see the target"),
    (15, "apd", r"the record must hold 1\.5 pulse widths about the target's echo at 35\.5 ns"),
)
def test_echoes_that_are_not_recorded_are_reported(late, receiver, monkeypatch):
    light = experiment()
    data = {"background": light.background[0], "difference": np.roll(light.difference[0], late, axis=-1)}
    record = xr.Dataset({name: (("pixel", "time"), values) for name, values in data.items()}, {"time": 0.5 + T})
    monkeypatch.setattr(detection, "target_signal", lambda *_, **__: record)
    detection.detect("fig13_2x2", renders=3, receiver=receiver)


@pytest.mark.slow
@refuses(
    ("fig13_2x2", {}, {"depths": (8, 14), "progress": pytest.fail}, r"below the bottom, up to z = -14 m"),
    ("fig09_2x2", {}, {"depths": (4, 8)}, "scene fig09_2x2 has no parameter target_depth, which depths needs"),
    ("fig13_2x2", {"spectrum": "flat"}, {"clutter": 4}, "clutter needs waves"),
    ({}, None, {"clutter": 4}, "depths and clutter need an XML scene"),
    ("fig02_mine", GATES, {"receiver": "apd"}, r"is an image of 8x8: it needs gates and a camera \(iccd, "),
    ("fig13_2x2", {}, {"grid": 3}, "grid = 3 needs receiver = 'none', which maps the target's signal"),
    ("fig13_2x2", {}, {"receiver": "none", "depths": [4]}, r"depths = \[4\] is ignored: receiver = 'none' measures"),
    ("fig13_2x2", {}, {"receiver": "none", "max_offset": 1}, "max_offset = 1.0 is ignored"),
    ("fig13_2x2", {}, {"frames": 5}, "frames = 5 is of cameras, and receiver = 'apd' records waveforms"),
    ("gated_mine", {}, {"receiver": "iccd", "shots": 500}, "shots = 500 is of waveforms: receiver = 'iccd' is a"),
    ("fig02_mine", {}, {"receiver": "icmos"}, "scene fig02_mine has no gates, which a camera needs"),
)
def test_mistakes_are_reported_before_rendering(scene, params, options):
    detection.detect(scene, params, **options)
