"""Estimates from synthetic results: slopes, bottom and water of the lidar equation, files, drawings, the command."""

import json
import math

import numpy as np
import pytest
import xarray as xr
from rows import must_refuse, refuses
from scipy.stats import truncnorm
from synthetic_shots import (
    ANGLE_X,
    ANGLE_Y,
    BB,
    BINS,
    C0,
    COS_WATER,
    DEPTH,
    LEVEL,
    RHO,
    SURFACE,
    THETA,
    TIME,
    A,
    N,
    on_axis,
    plane_delays,
    result,
    waveform,
)

from mitransient_lidar.analysis.retrieval import retrieval_table, retrieve, surface_inputs
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots.studies import shots as retrieval

pytestmark = pytest.mark.usefixtures("scattered_once")


def test_a_slope_that_the_sea_cannot_have_is_refused():
    """A plane of 40 degrees along, in a sea whose slopes have a standard deviation of 0.1 in each direction."""
    shot = result(np.stack([waveform(delay) for delay in plane_delays(0.84, 0.05)]), surface_slope_variance=0.02)
    found = retrieve.surface_slopes(shot)
    assert np.isnan([found["slope_along"], found["slope_along_stderr"]]).all()
    assert float(found["slope_refused"]) == 1
    assert float(found["slope_across"]) == pytest.approx(0.05, abs=0.03)
    # With a prior, only the prior is left; of an unknown sea, it is kept.
    along = retrieve.surface_slopes(shot, slope_deviation=(0.1, 0.1))
    assert (float(along["slope_along"]), float(along["slope_along_stderr"])) == (0.0, pytest.approx(0.1))
    kept = retrieve.surface_slopes(result(shot["waveform"].values))
    assert float(kept["slope_along"]) == pytest.approx(0.84, rel=0.1)


def test_a_receiver_of_one_pixel_gives_bottom_and_water():
    one = result(4 * waveform()[np.newaxis])
    found = retrieve.retrieve(one)
    assert np.isnan(found["slope_along"])
    assert float(found["surface_height"]) == pytest.approx(0, abs=0.1)
    assert float(found["depth_m"].sel(correction="level")) == pytest.approx(DEPTH, abs=0.02)
    # The error of the surface's range by a glint of 4 ns is an optical depth of 0.03.
    np.testing.assert_allclose(found["reflectance"], RHO, rtol=0.04)
    np.testing.assert_allclose([found["absorption"], found["backscattering"]], [A, BB], rtol=0.05)
    must_refuse("at least 2 pixels", retrieve.surface_slopes, one)


def test_the_tail_of_a_bottom_counts_and_its_focusing_does_not():
    """A tail of 6 % behind the echo, of which the Gaussian has less than 1 %, and waves that focus light."""
    shot = on_axis()
    plain = float(retrieve.bottom(shot, LEVEL)["reflectance"][0])
    delay = 2 * N * DEPTH / COS_WATER / C0
    energy = float(retrieve.bottom(shot, LEVEL)["bottom_energy"]) / 4
    tail = 0.06 * energy * 1e9 * np.where(SURFACE + delay < TIME, np.exp(-(TIME - SURFACE - delay) / 8) / 8, 0)
    longer = retrieve.bottom(result(shot["waveform"].values + tail), LEVEL)
    assert float(longer["reflectance"][0]) == pytest.approx(1.06 * plain, rel=0.01)
    waves = on_axis().assign_attrs(wave_focusing=[1.2, 1.2], wave_focusing_depths=[0.01, 1.0])
    assert float(retrieve.bottom(waves, LEVEL)["reflectance"][0]) == pytest.approx(plain / 1.2, rel=0.01)


def series(shots):
    return xr.concat(shots, "shot", combine_attrs="override").assign_coords(shot=np.arange(len(shots)))


def test_slopes_of_shots():
    planes = [(0.0, 0.0), (0.1, -0.05), (-0.15, 0.08)]
    shots = series([result(np.stack([waveform(t) for t in plane_delays(*one)])) for one in planes])
    found = retrieve.surface_slopes(shots)
    assert found["slope_along"].dims == ("shot",)
    # 0.01 ns of an echo's time are 0.0015 of a slope here.
    np.testing.assert_allclose(found["slope_along"], [along for along, _ in planes], atol=2e-3)
    np.testing.assert_allclose(found["slope_across"], [across for _, across in planes], atol=2e-3)
    np.testing.assert_allclose(found["surface_height"], 0, atol=0.01)
    assert float(found["slope_direction_deg"][1]) == pytest.approx(math.degrees(math.atan2(-0.05, 0.1)), abs=2)
    assert float(found["slope_deg"][2]) == pytest.approx(math.degrees(math.atan(0.17)), abs=0.15)
    assert found["slope_along"].attrs["units"] == "1"


def of_a_sea(**changes):
    """A shot whose pixels are squares of 6 mrad in a beam of 10 mrad over a sea of 6 m/s."""
    lines = [np.array([[0, 0], [x, 0], [x, y], [0, y]]) for x, y in zip(2 * ANGLE_X, 2 * ANGLE_Y, strict=True)]
    sea = {"scene.spectrum": "elfouhaily", "scene.slope_variance": "cox_munk", "scene.wind_speed": "6"}
    outlines = json.dumps([[line.ravel().tolist()] for line in lines])
    return result(**{"pixel_outlines": outlines, "divergence_mrad": 10.0, **sea, **changes})


def test_prior_weighs_slopes():
    shot = of_a_sea()
    shot.attrs = {name: value for name, value in shot.attrs.items() if not name.startswith("scene.")}
    raw = retrieve.surface_slopes(shot)
    # Squares of 6 mrad in a beam of 5 mrad: Gaussians cut at 0 and 6.
    light = truncnorm(0, 1.2, scale=5e-3)
    assert surface_inputs.pixel_light(shot).angle_x == pytest.approx(np.sign(ANGLE_X) * light.mean(), rel=1e-3)
    # Far and near pair with two facets each, alike by 0.4; the time determines tan(theta - tilt).
    slope = float(raw["slope_along"])
    tilt = math.atan(slope)
    lever = light.std() * math.sqrt(1.4) / (2 * light.mean()) * (math.cos(THETA - tilt) / math.cos(tilt)) ** 2
    level = lever * math.tan(THETA)
    expected = lever * math.hypot(math.tan(THETA - math.atan(0.5 * slope)), level / math.sqrt(2))
    assert float(raw["slope_along_stderr"]) == pytest.approx(expected, rel=0.01)
    weighed = retrieve.surface_slopes(shot, slope_deviation=(0.05, 0.04))
    error = float(raw["slope_along_stderr"])
    assert float(weighed["slope_along_stderr"]) == pytest.approx(0.05 * error / math.hypot(0.05, error))


def test_corrections_that_do_not_help_are_not_applied():
    """One shot whose slope is known worse than the sea's slopes, and eight shots that the slope makes scatter more."""
    shot = on_axis()
    sloped = LEVEL.assign(slope_along=0.1, slope_along_stderr=0.2, slope_across_stderr=np.nan, surface_range_stderr=0.0)
    for deviation, applied in ((0.1, False), (0.3, True)):
        found = retrieve.bottom(shot, sloped.assign_attrs(slope_prior_deviation=[deviation, deviation, 0.0]))
        assert bool(found["depth_corrected"].sel(correction="slope")) == applied
        assert bool(found["reflectance_corrected"].sel(correction="slope")) == applied
        level, slope = (float(found["depth_m"].sel(correction=name)) for name in ("level", "slope"))
        assert (abs(slope - level) > 0.01) == applied
    shots = series([shot] * 8)
    slopes = LEVEL.expand_dims(shot=8).assign(slope_along=("shot", np.linspace(-0.2, 0.2, 8)))
    found = retrieve.bottom(shots, slopes)
    assert not found["reflectance_corrected"].any()
    assert found["depth_corrected"].sel(correction="slope").all()
    np.testing.assert_allclose(found["reflectance"].std("shot"), 0, atol=1e-12)


def test_bottom_and_water_of_the_lidar_equation():
    shot = on_axis()
    seabed = retrieve.bottom(shot, LEVEL)
    np.testing.assert_allclose(seabed["depth_m"].sel(correction=["level", "slope"]), DEPTH, atol=0.01)
    # The backscatter that the column shows is 1.13 times that of bb.
    # Once scattered light decays as that of the bottom does.
    np.testing.assert_allclose(seabed["reflectance"], RHO, rtol=0.02)
    assert seabed["class_probability"].sel(bottom_class="bright") > 0.9
    found = retrieve.water(shot)
    assert float(found["column_attenuation"]) == pytest.approx(A + BB, rel=0.01)
    assert float(found["absorption"]) == pytest.approx(A, rel=0.01)
    assert float(found["backscattering"]) == pytest.approx(BB, rel=0.02)
    assert float(found["kd"]) == pytest.approx(A + 4.18 * (1 - 0.52 * math.exp(-10.8 * A)) * BB, rel=0.02)
    assert found["attenuation_low"] < A + BB / 0.02 < found["attenuation_high"]
    given = retrieve.water(shot, efficiency=0.5 * 0.81 * 0.9)
    assert float(given["backscattering"]) == pytest.approx(2 * BB, rel=0.02)


def test_what_the_surface_does_to_a_shot_is_taken_out():
    """Three shots through surfaces that pass 1, 0.7 and 1.4 times the light, which echo and column share."""
    shots = series([on_axis(factor=factor) for factor in (1.0, 0.7, 1.4)])
    slopes = LEVEL.expand_dims(shot=3)
    found = retrieve.bottom(shots, slopes)["reflectance"]
    np.testing.assert_allclose(found.sel(correction="column") / found.sel(correction="column").mean(), 1, atol=2e-3)
    shares = found.sel(correction="level").values
    np.testing.assert_allclose(shares / shares[0], [1.0, 0.7, 1.4], rtol=1e-3)


def test_depth_follows_height_and_slope():
    """A surface 0.3 m above the mean level: as far from the lidar, and as much deeper, as vectors say."""
    height, along = 0.3, 0.1
    reach = (200 - height) / math.cos(THETA)
    tilt = math.atan(along)
    angle = tilt + math.asin(math.sin(THETA - tilt) / N)
    path = (DEPTH + height) / math.cos(angle)
    delay = 2 * reach / C0 - SURFACE
    shot = on_axis(delay=delay, depth=path * COS_WATER)
    slopes = LEVEL.assign(slope_along=along, surface_range=reach)
    found = retrieve.bottom(shot, slopes)["depth_m"]
    assert float(found.sel(correction="slope")) == pytest.approx(DEPTH, abs=0.01)
    assert abs(float(found.sel(correction="level")) - DEPTH) > 0.03


def test_errors_of_depths_hold_slope_and_range():
    """To first order about a level sea: the water's angle turns by 1 - cos(air)/(n cos(water)) of the tilt."""
    shot, deviations = on_axis(), {"slope_along_stderr": 0.05, "surface_range_stderr": 0.2}
    path, per_range = DEPTH / COS_WATER, math.cos(THETA) - COS_WATER / N
    turn = path * math.sin(THETA) / N * (1 - math.cos(THETA) / (N * COS_WATER))
    sea = {"slope_prior_deviation": [0.2, 0.0, 0.4]}

    def errors(slopes):
        return retrieve.bottom(shot, slopes)["depth_m_stderr"].sel(correction=["level", "slope"]).values

    exact = LEVEL.assign(dict.fromkeys([*deviations, "slope_across_stderr"], 0.0))
    level, others = errors(exact.assign_attrs(slope_prior_deviation=[1e-6, 0.0, 0.0]))
    assert others == pytest.approx(level)
    found = errors(exact.assign(deviations).assign_attrs(slope_prior_deviation=[math.inf] * 3))
    np.testing.assert_allclose(found**2 - level**2, [0, (0.05 * turn) ** 2 + (0.2 * per_range) ** 2], rtol=0.02)
    # The error through a level sea includes that by typical waves: with a known sea, less is left.
    sea = {"slope_prior_deviation": [0.01, 0.0, 0.0]}
    found = errors(exact.assign_attrs(sea))
    np.testing.assert_allclose(level**2 - found**2, [0, (0.01 * turn) ** 2], rtol=0.02, atol=1e-12)
    # A slope that is not estimated is as uncertain as on the sea.
    unseen = exact.assign(slope_along_stderr=np.nan, surface_range_stderr=0.1)
    found = errors(unseen.assign_attrs(slope_prior_deviation=[0.01, 0.0, 1.0]))[1]
    assert found == pytest.approx(math.hypot(0.01 * turn, 0.1 * per_range), rel=0.02)


def short(bins=0, depth=DEPTH):
    """Four pixels whose record ends before the bottom, or whose column is too short to be fitted."""
    shot = result(np.stack([waveform(delay, depth=depth) for delay in plane_delays(0.1, 0.0)]))
    return shot.isel(time=slice(0, bins or None))


def test_estimates_without_a_column(caplog):
    """A record that ends 15 ns behind the surface, and a bottom 1.6 m deep, whose echo leaves no column free."""
    for shot, depth in ((short(bins=100), math.nan), (short(depth=1.6), 1.6)):
        found = retrieve.retrieve(shot)
        assert float(found["slope_along"]) == pytest.approx(0.1, abs=0.02)
        assert float(found["depth_m"].sel(correction="slope")) == pytest.approx(depth, abs=0.1, nan_ok=True)
        for name in ("reflectance", "class_probability", "kd"):
            assert np.isnan(found[name]).all()
        assert "no waveform has a column long enough for a fit" in caplog.text


def test_no_estimate():
    with pytest.raises(UserError, match="nothing can be estimated: no waveform has a surface echo"):
        retrieve.retrieve(result(np.full((4, BINS), 1e-12)))


@pytest.fixture
def shots_with_truth():
    """Three shots of level planes at other heights, with their truth."""
    heights = [0.0, 0.2, -0.3]
    delays = [2 * height / math.cos(THETA) / C0 for height in heights]
    shots = series([result(np.stack([waveform(-delay)] * 4)) for delay in delays])
    truth = {"true_slope_along": [0.0] * 3, "true_slope_across": [0.0] * 3, "true_surface_height": heights}
    truth |= {"true_bottom_depth": [DEPTH - height for height in heights]}
    return shots.assign_coords({name: ("shot", values) for name, values in truth.items()})


def test_estimates_of_a_series_are_compared_with_its_truth(shots_with_truth):
    found = retrieve.retrieve(shots_with_truth, slope_deviation=(1e-4, 1e-4))
    listed = {one.head: one for one in retrieval_table.estimates(found)}
    np.testing.assert_allclose(listed["height (m)"].values, listed["height (m)"].truth, atol=0.02)
    np.testing.assert_allclose(listed["depth (m)"].values, listed["depth (m)"].truth, atol=0.05)
    made = retrieval_table.Estimate(
        "depth (m)", np.array([1.0, 2.0, 3.0, np.nan]), np.full(4, 0.5), np.array([1.0, 1.0, 2, 3])
    )
    text = "depth (m): bias +0.667, rms error 0.816, correlation +0.87, rms of error / standard error 1.63, 3 shots"
    assert retrieval_table.truth_statistics(made) == text
    assert retrieval_table.truth_statistics(made._replace(truth=None)) == ""
    figure = retrieval.plot_retrieval(found)
    # The truth of the reflectance is not known, and nothing is drawn.
    assert [ax.get_ylabel() for ax in figure.axes] == [f"estimated {head}" for head in listed if head != "reflectance"]
    np.testing.assert_allclose(figure.axes[3].lines[0].get_xdata(), [8.0, 7.8, 8.3])
    # Slopes that are all the same have no spread to be drawn over.
    assert figure.axes[0].get_xlabel() == "shot"
    with pytest.raises(UserError, match="found has no truth"):
        retrieval.plot_retrieval(found.drop_vars([name for name in found.coords if str(name).startswith("true_")]))


def drop(name):
    shot = result()
    del shot.attrs[name]
    return shot


@refuses(
    (lambda: retrieve.surface_slopes(on_axis().isel(pixel=[0])), "waveforms of at least 2 pixels"),
    (lambda: retrieve.surface_slopes(drop("altitude")), "the dataset has no attribute altitude"),
    (lambda: retrieve.surface_slopes(of_a_sea(), wind_speed=0.1), r"wind_speed = 0\.1 must lie between 1 and 30"),
    (lambda: retrieve.surface_slopes(result(), wind_speed=6), "wind_speed = 6 needs a result of a round Gaussian"),
    *(
        (
            lambda name=name: retrieve.surface_slopes(of_a_sea(), slope_deviation=(0.1, 0.1), **{name: 6}),
            f"slope_deviation = .* and {name} = 6 are alternatives",
        )
        for name in ("wind_speed", "wind_direction_deg")
    ),
    (lambda: retrieve.bottom(result().drop_vars("waveform"), LEVEL), "the dataset has no waveform"),
    (lambda: retrieve.bottom(result(obscuration=2.0), LEVEL), "obscuration = 2.0: it must be a number between 0"),
    (lambda: retrieve.bottom(drop("two_way_efficiency"), LEVEL), "efficiency must be given"),
    (lambda: retrieve.water(result(field_of_view_mrad=20.0)), r"spot_diameter = 4\.2\d+ must be at least 6"),
    (lambda: retrieve.water(result().isel(pixel=0)), r"waveform has the dimensions \('time',\)"),
)
def test_invalid_input(call):
    call()
