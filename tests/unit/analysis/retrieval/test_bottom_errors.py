"""Reflectances of synthetic bottoms: light and aperture, targets, layers of the water, and stated errors."""

import json
import math

import numpy as np
import pytest
from rows import each_case
from synthetic_shots import (
    BB,
    C0,
    COS_WATER,
    DEPTH,
    ENERGY,
    LEVEL,
    RHO,
    SURFACE,
    THETA,
    TIME,
    N,
    on_axis,
    result,
    waveform,
)

from mitransient_lidar.analysis.retrieval import bottom_errors, retrieve, scattered_light, surface_inputs
from mitransient_lidar.analysis.retrieval.bottom_errors import ReflectanceFlag
from mitransient_lidar.analysis.waveforms import echo_table
from mitransient_lidar.analysis.waveforms.records import Waveforms
from mitransient_lidar.results.geometry import lidar_system
from mitransient_lidar.results.sum_errors import with_correlation

pytestmark = pytest.mark.usefixtures("scattered_once")


def with_shares(shot, shares):
    """Add the lines of sight of pixels that all look along the axis and hold these shares of the beam."""
    sight = {"sight_x": 0.0, "sight_y": 0.0, "off_nadir": 20.0, "surface_time": SURFACE, "surface_spread": 0.0}
    sight["depth_per_ns"] = C0 * COS_WATER / (2 * N)
    coordinates = {name: ("pixel", np.full(len(shares), value)) for name, value in sight.items()}
    return shot.assign_coords({**coordinates, "beam_share": ("pixel", shares)})


def test_reflectance_is_of_the_light_that_enters_the_open_aperture():
    """The same waveforms, from half of the beam or through 0.7 of the aperture: reflectance and bb in inverse ratio."""
    whole, half = (with_shares(on_axis(), [share] * 4) for share in (0.25, 0.125))
    plain = retrieve.bottom(whole, LEVEL)["reflectance"].values
    # These waters scatter once, so that their columns decay as the light of the bottom does.
    np.testing.assert_allclose(plain, RHO, rtol=0.02)
    np.testing.assert_allclose(retrieve.bottom(half, LEVEL)["reflectance"], 2 * plain, rtol=1e-9)
    obscured = whole.assign_attrs(obscuration=0.3)
    np.testing.assert_allclose(retrieve.bottom(obscured, LEVEL)["reflectance"], plain / 0.7, rtol=1e-9)
    for shot, factor in ((half, 2), (obscured, 1 / 0.7)):
        np.testing.assert_allclose(retrieve.water(shot)["backscattering"], factor * BB, rtol=0.02)
    scale = surface_inputs.energy_scale(obscured, None)
    assert scale == pytest.approx(0.7 * ENERGY)
    dark = retrieve.bottom(with_shares(on_axis(), [0.01] * 4), LEVEL)
    assert int(dark["reflectance_flags"]) == ReflectanceFlag.NO_DIRECT_LIGHT
    assert np.isnan(dark["reflectance"]).all()


def target(top, deepest, line):
    return {"id": "mine", "z": [-deepest, -top], "line": line, "seen": line}


POSE = [
    *(-200 * math.tan(THETA), 0.0, 200.0, math.sin(THETA), 0.0, -math.cos(THETA)),
    *(math.cos(THETA), 0.0, math.sin(THETA), 0.0, 1.0, 0.0),
]
SQUARE = [-1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0]


def test_light_of_a_target_is_not_the_bottoms():
    """The only echo comes from 8 m: of a target there, unless the bottom is; one far above the echo does not matter."""
    for top, floor, refused in ((7.8, 15.0, True), (7.8, 8.0, False), (3.0, 8.0, False)):
        outlines = json.dumps([target(top, top + 0.5, SQUARE)])
        found = retrieve.bottom(on_axis().assign_attrs(target_outlines=outlines, bottom_point=[0, 0, -floor]), LEVEL)
        assert int(found["reflectance_flags"]) == (ReflectanceFlag.TARGET if refused else 0)
        for name in ("reflectance", "depth_m", "bottom_energy", "class_probability"):
            assert np.isnan(found[name]).all() if refused else np.isfinite(found[name]).any()


def test_an_echo_before_the_bottoms_leaves_no_reflectance():
    """A second echo from 5 m, without a target in the scene that would tell how much light it takes."""
    values = np.stack([waveform() + waveform(depth=5.0, glint=0.0)] * 4)
    found = retrieve.bottom(result(values), LEVEL)
    assert int(found["reflectance_flags"]) & ReflectanceFlag.EARLIER_ECHO
    assert np.isnan(found["reflectance"]).all()
    np.testing.assert_allclose(found["depth_m"].sel(correction="level"), DEPTH, atol=0.02)


def test_share_of_the_beam_that_a_target_hides():
    """A square of 2 x 2 m in a beam of 10 mrad: a product of error functions; its share adds to the error."""
    attributes = {"receiver_pose": POSE, "divergence_mrad": 10.0}
    sigma = 5e-3 * 200 / math.cos(THETA)
    # Near the axis a metre along the sea is a metre times cos(theta) across the beam.
    expected = math.erf(1 / sigma / math.sqrt(2)) * math.erf(math.cos(THETA) / sigma / math.sqrt(2))
    assert bottom_errors.hidden_share(attributes, [target(3, 3.5, SQUARE)]) == pytest.approx(expected, rel=0.01)
    # An ellipse along angle_y of a third of the width along angle_x: more is hidden.
    thin = {**attributes, "divergence_across_mrad": 10 / 3, "ellipse_deg": 90.0}
    expected = math.erf(1 / sigma / math.sqrt(2)) * math.erf(3 * math.cos(THETA) / sigma / math.sqrt(2))
    assert bottom_errors.hidden_share(thin, [target(3, 3.5, SQUARE)]) == pytest.approx(expected, rel=0.02)
    small = [0.2 * one for one in SQUARE]
    shot = on_axis().assign_attrs(**attributes, bottom_point=[0.0, 0.0, -DEPTH])
    plain, hidden = (
        retrieve.bottom(shot.assign_attrs(target_outlines=json.dumps(targets)), LEVEL)["reflectance_stderr"]
        for targets in ([], [target(3, 3.5, small)])
    )
    share = bottom_errors.hidden_share(attributes, [target(3, 3.5, small)])
    rho = float(retrieve.bottom(shot, LEVEL)["reflectance"][0])
    np.testing.assert_allclose(hidden**2 - plain**2, (rho * share) ** 2, rtol=0.05)


def layered(k_above, k_below, boundary):
    """Four pixels through two layers of one backscatter that decay with K [1/m] above and below a path [m]."""
    upper, lower = (np.stack([waveform(k=k)] * 4) for k in (k_above, k_below))
    path = np.clip((TIME - SURFACE) * C0 / (2 * N), 0, None)
    below = path > boundary
    # Continuous at the boundary.
    joined = np.where(below, lower * math.exp(-2 * (k_above - k_below) * boundary), upper)
    return result(joined)


def test_layers_leave_no_reflectance_that_looks_sure():
    """0.30 above and 0.12 below 4 m, and the other way round: the error includes the truth, or there is no value."""
    for above, below in ((0.30, 0.12), (0.12, 0.30), (0.2, 0.15)):
        found = retrieve.bottom(layered(above, below, 4.0), LEVEL)
        value, error = (float(found[name].sel(correction="column")) for name in ("reflectance", "reflectance_stderr"))
        assert math.isnan(value) or abs(value - RHO) < error, (above, below, value, error)
        assert math.isnan(value) == bool(int(found["reflectance_flags"]) & ReflectanceFlag.UNCERTAIN)
        assert math.isnan(value) or float(found["class_probability"].max()) < 0.95
    one = retrieve.bottom(layered(0.2, 0.2, 4.0), LEVEL)
    assert abs(float(one["reflectance"][2]) - RHO) < 0.2 * float(one["reflectance_stderr"][2])
    assert float(one["reflectance_stderr"][2]) < 0.2 * float(one["reflectance"][2])


@each_case((None, 500, True), (DEPTH - 1.5, 500, False), (None, 3.5, False))
def test_energy_of_a_bottom_is_the_sum_only_where_its_light_is_alone(target_depth, end, summed):
    """A target 1.5 m, less than four echo widths, above the bottom; a record that ends 3.5 echo widths behind it."""
    values = waveform(share=1.0) + (0 if target_depth is None else 0.5 * waveform(depth=target_depth, glint=0.0))
    last = np.searchsorted(TIME, SURFACE + 2 * N * DEPTH / COS_WATER / C0 + end * 4.0)
    shot = result(values[np.newaxis])[["waveform", "waveform_stderr"]].isel(time=slice(last))
    echoes = echo_table.extract(shot, depth_from="mean", layers=2).isel(pixel=0)
    own = echoes.sel(echo="bottom")

    def whole_energy(dataset):
        waveforms = Waveforms.from_dataset(dataset, None, None, None, None)
        light = scattered_light.of_columns(waveforms, echoes, lidar_system(shot.attrs), np.ones(()), shot)
        return bottom_errors.whole_energy(waveforms, echoes, light)

    energy, error = whole_energy(shot)
    assert (energy != own["energy"].values) == (error != own["energy_stderr"].values) == summed
    # Errors that all bins share add up.
    whole = with_correlation(shot, shot["time"].values, np.ones(2 * (shot.sizes["time"],)))
    together = whole_energy(whole)[1]
    count = np.sum((np.abs(shot["time"] - own["time_ns"] - 4.0) < 12.0).values)
    assert not summed or together > 0.5 * np.sqrt(count) * error
    known = with_correlation(on_axis(), TIME, np.eye(TIME.size))
    np.testing.assert_allclose(retrieve.bottom(known, LEVEL)["depth_m"], retrieve.bottom(on_axis(), LEVEL)["depth_m"])
