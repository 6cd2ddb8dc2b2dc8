"""Flights from their files to points: places against the truth, files, interruption, and refusals."""

import tomllib

import laspy
import numpy as np
import pytest
import significance
from command_line import assert_refused, run
from oracles import las_reader
from rows import each_case, must_refuse
from significance import largest_z

from mitransient_lidar.campaigns.store import DONE, FAILED, Store
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.flights.fly import STORE, fly
from mitransient_lidar.flights.plan import FlightPlan
from mitransient_lidar.flights.products import Flown, Quality, describe_points, read_points
from mitransient_lidar.flights.renderer import FlightRenderer
from mitransient_lidar.loading.catalogue import folder_of_scenes
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.plots.scene_viewer.page import point_traces
from mitransient_lidar.rendering.describe import lines_of_sight
from mitransient_lidar.results.attributes import PointClass
from mitransient_lidar.transport.scene_parts import find_lidar_scene

#: A short flight round a cube, over a level sea with the ripples of a wind and a bottom that slopes.
FLIGHT = {
    "scene": "flight",
    "instrument": "published_airborne",
    "target_error": 0.1,
    "seed": 1,
    "parameters": {
        **{"spectrum": "flat", "bottom_ripple_height": 0, "bottom_slope_x_deg": 2, "bottom_slope_y_deg": -1},
        **{"bottom_size": 400, "cube_size": 2, "cube_x": 3, "cube_depth": 5},
    },
    "platform": {
        **{"kind": "lines", "start": [0.0, -2.0], "heading_deg": 90.0, "speed": 40.0, "height": 200.0},
        **{"duration_s": 0.1, "noise": {"roll_deg": 0.3, "pitch_deg": 0.3, "yaw_deg": 0.3, "correlation_s": 0.02}},
    },
    "scanner": {"kind": "palmer", "nadir_angle_deg": 20.0, "rate_hz": 10.0},
    "pulses": {"rate_hz": 240.0, "most": 24},
}

TOML = """
scene = "flight"
instrument = "published_airborne"
target_error = 0.3
still_sea = true
parameters = { spectrum = "flat", bottom_ripple_height = 0, cube_size = 0.5 }
scanner = { kind = "palmer", nadir_angle_deg = 20.0, rate_hz = 10.0 }
pulses = { rate_hz = 320.0, most = 32 }

[platform]
kind = "lines"
start = [0.0, 0.0]
heading_deg = 90.0
speed = 40.0
height = 200.0
duration_s = 0.1
"""


def seeded(seed):
    """Return the flight with other paths, records and motions of its platform."""
    seed += significance.seed_shift
    noise = {**FLIGHT["platform"]["noise"], "seed": seed}
    return {**FLIGHT, "seed": seed, "platform": {**FLIGHT["platform"], "noise": noise}}


@pytest.mark.parametrize(("seed", "turns_with"), [pytest.param(1, "scan", marks=pytest.mark.slow)])
def test_points_of_a_flight_lie_where_surface_and_bottom_are(tmp_path, seed, turns_with):
    """All round the compass, with a rolling platform, over a slope: a wrong azimuth, sign or index is metres off.

    Errors of the method are common to all pulses: the mean error of a pulse lies within the stated one, but for what
    the spread of the pulses explains. Bottoms without refraction are 0.2 m too high and 0.6 m too far off.
    """
    flight = seeded(seed)
    points = fly({**flight, "scanner": {**flight["scanner"], "pixels": turns_with}}, tmp_path, workers=1)
    kind, pixels = points["kind"].values, 4
    assert np.count_nonzero(kind == 41) == np.count_nonzero(kind == 40) == 24 * pixels
    bottom = (kind == 40) & ~points["true_target"].values
    vertical = points["vertical_uncertainty"].values
    above = points["z"].values - points["true_z"].values
    for own in (kind == 41, bottom):
        assert np.median(vertical[own]) < 0.12
        assert_within(above, vertical, own, points)
    flown = Flown.of(Store(tmp_path / STORE))
    horizontal = points["horizontal_uncertainty"].values / np.sqrt(2)
    assert np.median(horizontal[bottom]) < 0.1
    beside = np.column_stack([points["x"], points["y"]]) - refracted_places(points, flown)
    axis = flown.poses.axis[points["shot"].values, :2]
    ahead = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    away, across = np.sum(beside * ahead, axis=1), beside[:, 1] * ahead[:, 0] - beside[:, 0] * ahead[:, 1]
    for error in (*beside.T, away, across):
        assert_within(error, horizontal, bottom, points)
    # The store alone gives the same points and their errors, as its page shows them.
    again = read_points(tmp_path)
    for name in ("x", "z", "kind", "true_z"):
        assert again[name].values.tolist() == points[name].values.tolist()
    drawn = next(one for one in point_traces(again) if one["name"].startswith("bottom"))
    assert drawn["customdata"][:, 1] == pytest.approx(100 * above[kind == 40], rel=1e-3)
    # One gain in all batches, and in the attributes.
    assert np.unique(flown.values("gain")).tolist() == [flown.attributes["gain"]]
    assert len(np.unique(np.floor(flown.values("time_s") / 0.05 + 1e-6))) >= 2
    # The bottom falls to -y and rises to +x: its height is that of the place that was found.
    x, y, z = (points[name].values[bottom] for name in "xyz")
    design = np.column_stack([x, y, np.ones_like(x)])
    slopes, residual, *_ = np.linalg.lstsq(design, z, rcond=None)
    covariance = residual[0] / (len(x) - 3) * np.linalg.inv(design.T @ design)
    true = np.tan(np.radians([2.0, -1.0]))
    for axis in (0, 1):
        # Neighbouring pixels of a pulse share their errors: as many independent ones as pulses.
        z_score = (slopes[axis] - true[axis]) / (2 * np.sqrt(covariance[axis, axis]))
        assert abs(z_score) < largest_z(24)
    assert np.ptp(x) > 100
    assert np.ptp(y) > 100
    assert np.all(flown.store.status() == DONE)
    lines = describe_points(points)
    assert lines[1].startswith("water surface")
    assert_files(tmp_path, points, flown)


@pytest.mark.slow
def test_the_automatic_gain_does_not_depend_on_the_length_of_a_flight():
    """Over waves, of which a longer flight meets brighter glints: 300 and 600 pulses that look other ways."""
    chosen = []
    for count, heading in ((300, 90.0), (600, 30.0)):
        platform = {**FLIGHT["platform"], "heading_deg": heading, "duration_s": count / 1000, "noise": {}}
        given = {"platform": platform, "parameters": {}, "pulses": {"rate_hz": 1000.0, "most": count}, "light": "maps"}
        _, columns = FlightRenderer.of(FlightPlan.of_file({**FLIGHT, **given}))
        assert np.ptp(columns["receiver_gain_0"]) == 0
        chosen.append(columns["receiver_gain_0"][0])
    assert 0 < chosen[0] < 0.5
    assert chosen[1] == pytest.approx(chosen[0], rel=0.03)


@pytest.mark.slow
def test_turned_pixels_look_where_others_did():
    """By 90 degrees each pixel takes the place of the next one, and by 45 one looks along the plane of incidence."""
    session = open_scene("flight", {"off_nadir_deg": 30.0, "layout": "2x2"})
    lidar = find_lidar_scene(session.scene, session.sensor)
    here, half, next_one = (lines_of_sight(lidar, turn) for turn in (0.0, 45.0, 90.0))
    # Red is far left, then green far right, blue near left and black near right.
    to = [2, 0, 3, 1]
    for name in ("sight_x", "sight_y", "off_nadir", "surface_time", "surface_spread", "beam_share"):
        one, other = getattr(here, name)[to], getattr(next_one, name)
        np.testing.assert_allclose(other, one, rtol=1e-4 if name in ("off_nadir", "surface_time") else 5e-3, atol=2e-5)
    radius = np.hypot(here.sight_x, here.sight_y)
    np.testing.assert_allclose(half.sight_x, radius * [0, 1, -1, 0], atol=2e-5)
    np.testing.assert_allclose(half.sight_y, radius * [1, 0, 0, -1], atol=2e-5)
    # cos(angle from nadir) of the direction along axis + x far + y left.
    x, y, theta = half.sight_x, half.sight_y, np.radians(30)
    down = (np.cos(theta) - np.sin(theta) * x) / np.sqrt(1 + x**2 + y**2)
    np.testing.assert_allclose(half.off_nadir, np.arccos(down), atol=1e-6)
    height = float(lidar.receiver.pose.origin[2])
    np.testing.assert_allclose(half.surface_time, 2e9 * height / 299792458 / down, atol=0.05)


def assert_within(error, stated, own, points):
    """Errors of points within 6 stated ones, and the mean over the pulses within the stated and its own error."""
    assert np.all(np.abs(error[own]) < 6 * stated[own])
    shot = points["shot"].values
    # Pixels of a pulse share its noise.
    means = np.array([np.mean(error[own & (shot == pulse)]) for pulse in np.unique(shot[own])])
    limit = np.median(stated[own]) + largest_z(len(means)) * np.std(means, ddof=1) / np.sqrt(len(means))
    assert np.abs(np.mean(means)) < limit, (np.mean(means), limit)


def refracted_places(points, flown):
    """Return where refracted lines of sight meet the plane of the bottom below a level sea: x and y [m]."""
    shot, pixel = points["shot"].values, points["pixel"].values
    origin, axis, far, left = (getattr(flown.poses, name)[shot] for name in ("origin", "axis", "far", "left"))
    sight = [1e-3 * flown.coordinate(name)[pixel][:, None] for name in ("sight_x", "sight_y")]
    line = axis + sight[0] * far + sight[1] * left
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    sea = origin - line * (origin[:, 2:] / line[:, 2:])
    bent = line / flown.attributes["refractive_index"]
    bent[:, 2] = -np.sqrt(1 - np.sum(bent[:, :2] ** 2, axis=1))
    # The bottom is z = s . (x, y) + h.
    bed = (points["kind"].values == 40) & ~points["true_target"].values
    places = np.column_stack([points["x"], points["y"], np.ones(len(bed))])
    (*slopes, height), *_ = np.linalg.lstsq(places[bed], points["true_z"].values[bed], rcond=None)
    way = (sea[:, :2] @ slopes + height) / (bent[:, 2] - bent[:, :2] @ slopes)
    return (sea + way[:, None] * bent)[:, :2]


def assert_files(folder, points, flown):
    """Points as laspy reads them, and packets as a reader written from the specification does."""
    with laspy.open(folder / "points.laz") as file:
        cloud = file.read()
    assert len(cloud) == points.sizes["point"]
    np.testing.assert_allclose(cloud.z, points["z"], atol=6e-4)
    np.testing.assert_array_equal(cloud.classification, points["kind"])
    found = las_reader.read(folder / "waveforms.las")
    signal = flown.values("signal")
    shot, pixel = points["shot"].values, points["pixel"].values
    for number in (0, len(shot) // 2, len(shot) - 1):
        packet = found.points[number].packet
        samples = las_reader.volts(folder / "waveforms.wdp", packet, found.descriptor(packet))
        np.testing.assert_allclose(samples, signal[shot[number], pixel[number]], atol=np.ptp(signal) / 30_000)
    assert (folder / "waveforms.wdp").stat().st_size == 60 + 2 * signal.size


@pytest.mark.slow
@each_case(
    ({"parameters": {**FLIGHT["parameters"], "bottom_size": 60}}, "the bottom does not cover the flight"),
    ({"parameters": {"bottom_dept": 3}}, "parameter 'bottom_dept' is not one of scene flight"),
    ({"instrument": None, "parameters": {"layout": "8x8"}}, "has an imager"),
    ({"instrument": "published_mast", "corrections": "auto"}, "no shipped corrections of the instrument"),
    (
        {"instrument": "riegl_vq880g2", "infrared": True, "corrections": "auto"},
        "corrections are of surfaces from green light",
    ),
    ({"infrared": True}, "instrument = 'published_airborne' has no infrared channel; instruments with one are"),
    ({"parameters": {**FLIGHT["parameters"], "time_start_ns": 1380, "bin_count": 60}}, "no bottom within the record"),
)
def test_flights_that_cannot_be_rendered(change, message):
    with pytest.raises(Exception, match=message):
        FlightRenderer.of(FlightPlan.of_file({**FLIGHT, **change}))


@pytest.mark.long
def test_failed_pulses_end_with_exit_code_1(tmp_path, monkeypatch, in_this_process):
    """The other pulses have their points."""
    path, folder, stacked = tmp_path / "short.toml", tmp_path / "failed", FlightRenderer.stacked
    text = TOML.replace("rate_hz = 320.0, most = 32", "rate_hz = 40.0, most = 4")
    path.write_text(text.replace("still_sea = true", "still_sea = false"))

    def fails(renderer, numbers, inputs):
        if 0 in numbers:
            raise UserError("the sea is too rough")
        return stacked(renderer, numbers, inputs)

    monkeypatch.setattr(FlightRenderer, "stacked", fails)
    monkeypatch.setattr("mitransient_lidar.flights.renderer._BATCH", 2)
    out = run("fly", path, "-o", folder, "--workers", 1, "-q")
    failed = np.count_nonzero(Store(folder / STORE).status() == FAILED)
    assert 0 < failed < 4
    assert out.exit_code == 1
    assert out.stderr.splitlines()[-1] == f"{failed} of 4 shots failed, the first, shot 0, so: the sea is too rough"
    assert len(laspy.read(folder / "points.laz")) > 0


def test_command_refuses_bad_flights(tmp_path):
    path = tmp_path / "flight.toml"
    for wrong, message in (
        (TOML.replace("rate_hz = 320.0", "rate_hz = -1"), "rate_hz = -1"),
        ('crs = "EPSG:999999"' + TOML, "crs = 'EPSG:999999'"),
        ("object_class = 44" + TOML, "object_class = 44 must be one of 43, 46, 64"),
    ):
        path.write_text(wrong)
        assert_refused(run("fly", path, "-o", tmp_path / "out"), message)
        assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_weak_surfaces_are_timed_by_the_onset_of_their_column(tmp_path, in_this_process):
    """Of the shipped `semi_arc`, 20 degrees from nadir: by the level alone errors are 0.12 m, and depths 0.1 m off."""
    plan = tomllib.loads((folder_of_scenes() / "flights" / "semi_arc.toml").read_text("utf-8"))
    plan["pulses"]["most"] = 12
    plan["parameters"] = {**plan.get("parameters", {}), "bottom_ripple_height": 0}
    plan["seed"] = 1 + significance.seed_shift
    points = fly(plan, tmp_path / "flight", workers=1).load()
    bottoms = points.isel(point=points["kind"] == PointClass.BOTTOM)
    error = bottoms["z"] - bottoms["true_z"]
    assert bottoms.sizes["point"] >= 46
    assert float(bottoms["vertical_uncertainty"].median()) < 0.09
    assert float((error**2).mean()) ** 0.5 < 0.1


@pytest.mark.slow
def test_infrared_pulses_give_the_surface_of_a_flight(tmp_path, in_this_process):
    """Surfaces of green echoes alone err by 2.0 cm here (root mean square), those of the infrared by 0.5 cm."""
    plan = {
        **FLIGHT,
        "instrument": "riegl_vq880g2",
        "infrared": True,
        "still_sea": True,
        "parameters": {
            **{"wind_speed": 3, "bottom_ripple_height": 0, "bottom_slope_x_deg": 0, "bottom_slope_y_deg": 0},
            **{"bottom_depth": 0.5, "bottom_size": 400, "cube_size": 0.2, "cube_x": 100, "cube_depth": 0.3},
        },
        "platform": {**FLIGHT["platform"], "height": 300.0, "noise": {}},
        "scanner": {"kind": "palmer", "nadir_angle_deg": 4.0, "rate_hz": 10.0},
        "pulses": {"rate_hz": 120.0, "most": 12},
    }
    points = fly(plan, tmp_path / "flight", workers=1).load()
    store = Store(tmp_path / "flight" / STORE)
    gain = store.inputs(slice(0, 12))["infrared_receiver_gain_0"]
    assert np.ptp(gain) == 0 < gain[0]
    error = (points["z"] - points["true_z"]).values
    kind, infrared = points["kind"].values, (points["quality"].values & int(Quality.INFRARED)) > 0
    bottom = kind == PointClass.BOTTOM
    assert np.count_nonzero(bottom & infrared) >= 6
    assert np.sqrt(np.mean(error[bottom & infrared] ** 2)) < 0.025
    assert np.sqrt(np.mean(error[(kind == PointClass.SURFACE) & infrared] ** 2)) < 0.012
    with laspy.open(tmp_path / "flight" / "points.laz") as file:
        np.testing.assert_array_equal(file.read()["quality"] & int(Quality.INFRARED) > 0, infrared)


@pytest.mark.slow
def test_infrared_lines_of_their_own(tmp_path):
    """Twice as many pulses, straight down, whose points follow those of the green channel with their own numbers."""
    plan = {
        **{"scene": "flight", "instrument": "riegl_vq880g2", "still_sea": True, "light": "maps", "target_error": 0.3},
        "parameters": {"spectrum": "flat", "bottom_ripple_height": 0, "bottom_depth": 2, "cube_x": 99},
        "platform": {**FLIGHT["platform"], "height": 300.0, "noise": {}},
        "scanner": {"kind": "fixed", "nadir_angle_deg": 3.0},
        "pulses": {"rate_hz": 60.0, "most": 3},
        "infrared_lines": {"scanner": {"kind": "fixed"}, "pulses": {"rate_hz": 120.0, "most": 6}},
    }
    points = fly(plan, tmp_path / "flight", workers=1).load()
    kind, shot, transmitter = (points[name].values for name in ("kind", "shot", "transmitter"))
    assert shot[transmitter == 1].tolist() == [*range(6)]
    assert (kind[transmitter == 1] == PointClass.SURFACE).all()
    assert np.count_nonzero(kind[transmitter == 0] == PointClass.BOTTOM) == 3
    # Light of the water delays infrared surfaces by at most 4.7 cm.
    assert np.abs(points["z"].values[transmitter == 1]).max() < 0.04
    # The level is that of both channels.
    assert abs(points.attrs["surface_level_m"]) < 0.02
    lines = describe_points(points)
    assert lines[lines.index("Infrared channel") + 2].split()[:3] == ["water", "surface", "6"]
    with laspy.open(tmp_path / "flight" / "points.laz") as file:
        np.testing.assert_array_equal(file.read()["user_data"], transmitter)
    waveforms = laspy.read(tmp_path / "flight" / "waveforms.las")
    assert len(waveforms.points) == np.count_nonzero(transmitter == 0)
    assert read_points(tmp_path / "flight").sizes == points.sizes
    with pytest.raises(UserError, match=r"infrared = true and \[infrared_lines\] are alternatives"):
        FlightPlan.of_file({**plan, "infrared": True})
    must_refuse("has no infrared channel", FlightPlan.of_file, {**plan, "instrument": "riegl_vq840g"})


@pytest.mark.slow
def test_flight_over_a_pier(tmp_path, in_this_process):
    """Its top is ground, its edge an object above the water, and sea and bottom lie beside it."""
    plan = {
        **{
            "scene": "pier",
            "instrument": "riegl_vq880g2",
            "parameters": {"wind_speed": 1},
            "scanner": {"kind": "fixed"},
            # Over moving waves, every 0.05 s of pulses is a render of its own.
            "still_sea": True,
        },
        "platform": {
            **{"kind": "lines", "start": [-3.25, 0.0], "heading_deg": 90.0, "speed": 50.0, "height": 600.0},
            "duration_s": 0.14,
        },
        "pulses": {"rate_hz": 50.0, "most": 7},
    }
    points = fly(plan, tmp_path / "flight", workers=1).load()
    kind, x, z = (points[name].values for name in ("kind", "x", "z"))
    top = np.abs(x) < 0.6
    assert (kind[top] == PointClass.GROUND).all()
    np.testing.assert_allclose(z[top], 2.0, atol=0.1)
    beside = np.abs(x) > 1.6
    assert np.isin(kind[beside], [PointClass.SURFACE, PointClass.BOTTOM]).all()
    np.testing.assert_allclose(z[beside & (kind == PointClass.BOTTOM)], -6.0, atol=0.1)
    assert np.count_nonzero(beside & (kind == PointClass.BOTTOM)) == 4
    store = Store(tmp_path / "flight" / STORE)
    store.variables.remove("echo_class")
    must_refuse("is of an earlier version, without echo classes: fly into another folder", Flown.of, store)
