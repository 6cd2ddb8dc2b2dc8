"""Corrections of depths: interpolation, what they change, and refusals."""

import numpy as np
import pytest
import xarray as xr
from rows import each_row, refuses

from mitransient_lidar.analysis.waveforms import depth_correction
from mitransient_lidar.analysis.waveforms.depth_correction import AXES, correct_depths, summarize_depths, turned_pixels
from mitransient_lidar.analysis.waveforms.echo_detection import EchoFlag

ECHO = ["surface", "column", "target", "bottom"]


def table(instrument="riegl_vq840g"):
    """A bias that is linear in angle, wind, attenuation and depth, so that interpolation is exact."""
    axes = {"off_nadir_deg": [10.0, 20.0], "wind_speed": [0.0, 6.0], "water": ["IB", "5C"], "depth": [2.0, 6.0, 10.0]}
    names = {"estimator": ["gaussian", "peak"], "pixel": ["red", "green"]}
    grid = xr.Dataset(coords={**axes, **names})
    attenuation = xr.DataArray([0.1, 0.5], dims="water", coords={"water": axes["water"]})
    estimator = xr.DataArray([1.0, 2.0], dims="estimator", coords={"estimator": names["estimator"]})
    pixel = xr.DataArray([0.0, 1.0], dims="pixel", coords={"pixel": names["pixel"]})
    angle, wind, depth = grid["off_nadir_deg"], grid["wind_speed"], grid["depth"]
    bias = estimator * (0.01 * angle + 0.02 * wind + 0.3 * attenuation + 0.005 * depth) + pixel
    spread = xr.zeros_like(bias) + 0.01 * depth
    level = attenuation + xr.zeros_like(angle) + xr.zeros_like(wind) + xr.zeros_like(depth)
    data = {"bias": bias, "spread": spread, "found": xr.ones_like(bias), "attenuation": level}
    data["noise_error"] = xr.zeros_like(bias)
    made = xr.Dataset(data).transpose(..., "estimator", "pixel").assign_coords(ripples=("wind_speed", [5.0, 6.0]))
    return made.transpose(*AXES, "estimator", "pixel").assign_attrs(instrument=instrument)


def echoes(depth, attenuation=0.3, pixels=("red", "green"), several=True, **attributes):
    """Echoes of shots over pixels, with one depth of the bottom for all pixels of a shot."""
    depth = np.asarray(depth, dtype=float)
    shape = (depth.size, len(pixels), 2 if several else 1, 4)
    values = np.full(shape, np.nan)
    values[..., 0], values[..., 3] = 0.0, depth[:, None, None]
    if not several:
        values = values[:, :, 0]
    dims = ("shot", "pixel", *(["estimator"] if several else []), "echo")
    zeros = np.zeros(values.shape)
    data = {
        "depth_m": (dims, values),
        "depth_m_stderr": (dims, zeros + 0.02),
        "depth_m_method_error": (dims, zeros + 0.05),
        "flags": (dims, zeros.astype(int)),
        "attenuation": (("shot", "pixel"), np.full(shape[:2], attenuation)),
        "attenuation_stderr": (("shot", "pixel"), np.full(shape[:2], 0.01)),
    }
    names = ["gaussian", "peak"] if several else ["gaussian"]
    coords = {"echo": ECHO, "pixel": list(pixels), **({"estimator": names} if several else {})}
    usual = {"instrument": "riegl_vq840g", "off_nadir_deg": 15.0, "scene.wind_speed": "3", "estimators": names}
    usual["surface_heights_m"] = [-0.5, 0.5]
    return xr.Dataset(data, coords, {**usual, **attributes})


def test_the_bias_of_the_place_between_nodes_is_subtracted():
    corrected = correct_depths(echoes([4.0, 8.0, np.nan]), table())
    bottom = corrected.sel(echo="bottom")
    for e, factor in enumerate((1.0, 2.0)):
        for p in (0, 1):
            bias = factor * (0.15 + 0.06 + 0.09 + 0.005 * np.array([4.0, 8.0])) + p
            np.testing.assert_allclose(bottom["depth_m"].values[:2, p, e], np.array([4.0, 8.0]) - bias)
            np.testing.assert_allclose(bottom["depth_correction_m"].values[:2, p, e], bias)
            # The bias is linear in depth; of two nodes, the walk's variance in the middle is 0.47 of a quarter of the
            # squared difference. The nodes' spreads are 2, 6 and 10 cm.
            between = 0.47 * 0.25 * factor**2 * (0.1**2 + 0.12**2)
            left = np.sqrt(np.array([0.04, 0.08]) ** 2 + between)
            np.testing.assert_allclose(bottom["depth_m_method_error"].values[:2, p, e], left)
    assert np.isnan(bottom["depth_m"].values[2]).all()
    surface = corrected.sel(echo="surface")
    np.testing.assert_allclose(surface["depth_m"], 0)
    np.testing.assert_allclose(surface["depth_m_method_error"], 0.05)
    assert corrected.attrs["depth_corrections"] == "riegl_vq840g"


def test_errors_grow_beyond_the_ends_of_a_table():
    """The bias of the middle depth is 3 cm off the line through the others: a rate of 3^2/2 cm^2/m."""
    made = table()
    made["bias"][{"depth": 1}] += 0.03
    bottom = correct_depths(echoes([10.0, 12.0, 14.0], several=False), made, 0.0).sel(echo="bottom", pixel="red")
    squares = bottom["depth_m_method_error"].values ** 2
    np.testing.assert_allclose(np.diff(squares), 2 * 0.03**2 / 2, rtol=1e-6)
    np.testing.assert_allclose(bottom["depth_correction_m"], bottom["depth_correction_m"][0])


def test_unknown_water_is_all_waters_in_which_the_bottom_is_seen():
    """Without attenuation the mean over the waters counts, and their spread: the clearest water is no better known."""
    made = table()
    made["bias"][:], made["spread"][:] = 0.0, 0.0
    made["bias"].loc[{"water": "IB"}], made["bias"].loc[{"water": "5C"}] = 0.02, 0.12
    left, stated = [], []
    for bias in (0.02, 0.12):
        bottom = correct_depths(echoes([6.0 + bias], np.nan, several=False), made).sel(echo="bottom", pixel="red")
        left.append(bottom["depth_m"].item() - 6)
        stated.append(bottom["depth_m_method_error"].item())
    np.testing.assert_allclose(left, [-0.05, 0.05], atol=1e-12)
    np.testing.assert_allclose(stated, 0.05, atol=1e-12)
    # One column in three is too long for chance: no water is known by it.
    found = echoes([6.0] * 3, np.nan, several=False)
    found["attenuation"][0] = 0.5
    assert correct_depths(found, made)["depth_correction_m"].values[0, 0, 3] == pytest.approx(0.07)
    made["found"].loc[{"water": "5C", "depth": 10.0}] = 0.0
    deep = correct_depths(echoes([10.0], np.nan, several=False), made)
    assert deep["depth_correction_m"].values[0, 0, 3] == pytest.approx(0.02)


def test_ripples_are_an_axis_of_level_seas():
    """Biases of 1 and 7 cm with ripples of 3 and 6 m/s are linear in the inverse slope variance, as is their walk."""
    made = xr.concat([table().isel(wind_speed=[0]), table()], "wind_speed")
    made = made.assign_coords(ripples=("wind_speed", [3.0, 6.0, 6.0]))
    made["bias"][:], made["spread"][:] = 0.0, 0.0
    made["bias"][{"wind_speed": 0}], made["bias"][{"wind_speed": 1}] = 0.01, 0.07

    def inverse(ripples):
        return 1 / (0.003 + 5.08e-3 * ripples)  # Cox and Munk

    whole = inverse(3.0) - inverse(6.0)
    for ripples in (2.0, 3.0, 3.5, 5.0, 9.0):
        found = echoes([6.0], several=False, surface_heights_m=[0.0, 0.0], **{"scene.wind_speed": ripples})
        bottom = correct_depths(found, made).sel(echo="bottom", pixel="red")
        low, high = inverse(3.0) - inverse(ripples), inverse(ripples) - inverse(6.0)
        away = -low if low < 0 else -high if high < 0 else low * high / whole
        bias = 0.01 + 0.06 * np.clip(low / whole, 0, 1)
        assert bottom["depth_correction_m"].item() == pytest.approx(bias)
        walked = np.sqrt(0.47 * 0.06**2 / whole * away)
        assert bottom["depth_m_method_error"].item() == pytest.approx(walked, abs=1e-9)
    found = echoes([6.0], several=False, surface_heights_m=[0.0, 0.0], **{"scene.wind_speed": 3.0})
    bottom = correct_depths(found, made.isel(wind_speed=[1, 2])).sel(echo="bottom", pixel="red")
    assert bottom["depth_m_method_error"].item() == pytest.approx(np.sqrt(whole * depth_correction._OF_RIPPLES))


def test_columns_with_and_without_attenuation_have_no_bias_in_common():
    """At 2 m no column is measured, and the bias is -20 cm; at 6 and 10 m it is 10 cm."""
    made = table()
    made["attenuation"] = made["attenuation"].where(made["depth"] > 2)
    made["bias"] = xr.zeros_like(made["bias"]) + xr.where(made["depth"] > 2, 0.1, -0.2)
    for attenuation, bias in ((0.3, 0.1), (np.nan, -0.2)):
        corrected = correct_depths(echoes([4.0], attenuation, several=False), made).isel(pixel=0, echo=-1)
        assert corrected["depth_correction_m"].item() == pytest.approx(bias)
        # The spread is 2 cm at 2 m, 6 cm at 6 m.
        assert corrected["depth_m_method_error"].item() == pytest.approx(0.06 if bias > 0 else 0.02)
    # Of a single depth without attenuation, the walk of the other columns counts.
    made["bias"] = made["bias"] + xr.where(made["depth"] > 6, 0.04, 0.0)
    corrected = correct_depths(echoes([4.0], np.nan, several=False), made).isel(pixel=0, echo=-1)
    walked = 2 * 0.47 * 0.04**2 / 4
    assert corrected["depth_m_method_error"].item() == pytest.approx(np.sqrt(0.02**2 + walked))


def test_noise_in_the_table_counts_once():
    """Of a spread of 5 cm, 3 cm are the noise that the shots state; 8 cm of noise are reduced to the 5 cm."""
    made = table()
    made["bias"][:] = 0.0
    made["spread"][:] = 0.05
    for noise, method, share in ((0.03, 0.04, 1.0), (0.08, 0.0, 0.05 / 0.08)):
        made["noise_error"][:] = noise
        bottom = correct_depths(echoes([6.0]), made).sel(echo="bottom")
        np.testing.assert_allclose(bottom["depth_m_method_error"], method, atol=1e-9)
        np.testing.assert_allclose(bottom["depth_m_stderr"], 0.02 * share)


def test_a_bias_within_its_error_counts_little():
    made = table().assign_attrs(shots=4)
    made["bias"][:], made["spread"][:] = 0.02, 0.08
    # A level sea has one place, of which several renders differ as places of waves do.
    for wind, renders, share in ((6.0, 1, 0.2), (0.0, 1, 1.0), (0.0, 4, 0.2)):
        given = made.assign_attrs(level_renders=renders)
        heights = [0.0, 0.0] if wind == 0 else [-0.5, 0.5]
        found = echoes([6.0], surface_heights_m=heights)
        corrected = correct_depths(found, given, wind or 5.0).sel(echo="bottom")
        np.testing.assert_allclose(corrected["depth_correction_m"], 0.02 * share)
        # The variance of four places, and that of their mean where they are independent.
        variance = 0.08**2 / (1 - 1 / 4) + (0.08**2 / 4 if share < 1 else 0)
        np.testing.assert_allclose(corrected["depth_m_method_error"], np.sqrt(variance))


def stated(seed, realisations=20):
    """Mean squares of error over stated error of the shots of independent tables with biases of random walks.

    Biases are the sum of a walk in angle, one in attenuation and one in depth; nodes are at every second step, shots at
    the others. Waves spread depths by 4 cm beside a noise of 3 cm, which the shots state.
    """
    rng = np.random.default_rng(seed)
    steps, places, total = (20, 20, 24), 24, np.hypot(0.04, 0.03)
    squares = []
    for _ in range(realisations):
        walks = [np.cumsum(0.02 * rng.normal(size=count)) for count in steps]
        bias = walks[0][:, None, None] + walks[1][:, None] + walks[2]
        nodes = bias[::2, ::2, ::2]
        waves = total * np.sqrt(rng.chisquare(places - 1, nodes.shape) / places)
        mean = nodes + total * rng.normal(size=nodes.shape) / np.sqrt(places)
        # Over a level sea, the first wind, biases are exact.
        values = {"bias": (nodes, mean), "spread": (0 * nodes, waves), "noise_error": (0 * nodes, 0 * nodes + 0.03)}
        values["found"] = 0 * nodes + 1, 0 * nodes + 1
        data = {name: (AXES, np.stack(pair, axis=1)) for name, pair in values.items()}
        axes = {"off_nadir_deg": np.arange(0.0, 20, 2), "wind_speed": [0.0, 5.0], "depth": np.arange(1.0, 25, 2)}
        axes["water"], axes["ripples"] = [str(number) for number in range(10)], ("wind_speed", [5.0, 5.0])
        known = xr.Dataset(data, axes, {"shots": places, "records": 60, "instrument": "riegl_vq840g"})
        known = known.expand_dims(estimator=["gaussian"], pixel=["red"], axis=(4, 5))
        opacity = 0.1 + 0.1 * np.arange(10)[:, np.newaxis]
        known["attenuation"] = AXES, np.broadcast_to(opacity, (10, 2, 10, 12)).copy()
        angle, water = 2 * rng.integers(0, 9, 2) + 1
        steps_deep = 2 * rng.integers(0, 11, 400) + 1
        error = bias[angle, water, steps_deep] + total * rng.normal(size=400)
        found = echoes(1.0 + steps_deep + error, 0.1 + 0.05 * water, ["red"], False, off_nadir_deg=float(angle))
        found["depth_m_stderr"][:] = 0.03
        bottom = correct_depths(found, known, wind_speed=5.0).sel(echo="bottom").isel(pixel=0)
        whole = np.hypot(bottom["depth_m_stderr"], bottom["depth_m_method_error"])
        squares.append(float(np.mean(((bottom["depth_m"] - 1.0 - steps_deep) / whole) ** 2)))
    return np.array(squares)


@pytest.mark.slow
def test_stated_errors_hold_for_biases_that_walk_between_nodes():
    squares = stated(1)
    error = squares.std(ddof=1) / np.sqrt(squares.size)
    assert error < 0.12
    assert abs(squares.mean() - 1) < 4 * error


def test_summary_of_depths():
    """Three of four found, one of them 0.7 m off; flagged errors are not wrong ones."""
    found = echoes([5.1, 4.9, 5.7, np.nan])
    found["flags"][{"shot": 3, "echo": 3}] = int(EchoFlag.NO_ECHO)
    numbers = summarize_depths(found, np.full(4, 5.0))
    assert numbers["found"].shape == (2, 2)
    np.testing.assert_allclose(numbers["found"], 0.75)
    np.testing.assert_allclose(numbers["bias"], 0.7 / 3)
    np.testing.assert_allclose(numbers["spread"], np.std([0.1, -0.1, 0.7]))
    np.testing.assert_allclose(numbers["wrong"], 0.25)
    np.testing.assert_allclose(numbers["error"], np.hypot(0.02, 0.05))
    np.testing.assert_allclose(numbers["z"], np.sqrt(np.mean(np.square([0.1, 0.1, 0.7]))) / np.hypot(0.02, 0.05))
    found["flags"][{"shot": 2, "echo": 3}] = int(EchoFlag.FEW_EVENTS)
    np.testing.assert_allclose(summarize_depths(found, np.full(4, 5.0))["wrong"], 0)


@refuses(
    (echoes([5.0], instrument="teledyne_czmil"), "of the instrument riegl_vq840g, but the result has instrument tele"),
    (echoes([5.0], instrument=""), "but the result has no instrument"),
    (echoes([5.0], pixels=("red", "blue")), "lack the pixel 'blue'"),
    (echoes([5.0], **{"scene.wind_speed": "strong"}), "wind speed of the result is not known"),
    (echoes([5.0]).assign_coords(estimator=["gaussian", "centroid"]), "lack the estimator 'centroid'"),
)
def test_tables_of_something_else_are_refused(found):
    correct_depths(found, table())


@each_row(
    (0, [0, 1, 2, 3, 4], None, 0),
    (90, [1, 2, 3, 0, 4], None, 0),
    (-90, [3, 0, 1, 2, 4], None, 0),
    (45, [0, 1, 2, 3, 4], [1, 2, 3, 0, 4], 0.5),
    (-60, [0, 1, 2, 3, 4], [3, 0, 1, 2, 4], 2 / 3),
)
def test_turned_pixels_have_the_biases_of_their_places(turn, first, second, share):
    """Four pixels from far left by near left and near right to far right, and one in the middle."""
    bias = np.array([0.1, 0.2, 0.5, 0.4, 0.9])
    given = xr.Dataset({"bias": ("pixel", bias), "variance": ("pixel", bias**2)}, {"pixel": list("abcde")})
    given["attenuation"] = ("water", [0.1, 0.2])
    found = turned_pixels(given, np.array([1.0, -1, -1, 1, 0]), np.array([1.0, 1, -1, -1, 0]), turn)
    beside = bias[first] if second is None else bias[second]
    np.testing.assert_allclose(found["bias"], (1 - share) * bias[first] + share * beside, atol=1e-12)
    # The second moment of the two biases, whose mean is the bias.
    square = (1 - share) * 2 * bias[first] ** 2 + share * 2 * beside**2
    np.testing.assert_allclose(found["variance"] + found["bias"] ** 2, square, atol=1e-12)
    np.testing.assert_array_equal(found["attenuation"], given["attenuation"])
    np.testing.assert_array_equal(found["pixel"], given["pixel"])


def test_depths_of_turned_pixels_are_corrected_by_the_pixel_at_their_place():
    found = echoes([5.0]).assign_coords(angle_x=("pixel", [1.0, -1.0]), angle_y=("pixel", [0.0, 0.0]))
    straight, turned = (correct_depths(found, table(), turn_deg=turn) for turn in (0.0, 180.0))
    for name in ("depth_m", "depth_m_method_error"):
        np.testing.assert_allclose(turned[name], straight[name].values[:, ::-1], atol=1e-12)
    assert np.all(np.ptp(straight["depth_m"].sel(echo="bottom").values, axis=1) > 0.5)
