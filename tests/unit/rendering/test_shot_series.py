"""Series of shots: places, truth, attributes, interruption and files, without renders."""

import json
import math

import mitsuba as mi
import numpy as np
import pytest
import xarray as xr
from rows import each_case, each_row, must_refuse

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.sea.sea_surface import SeaSurface
from mitransient_lidar.rendering import render as single
from mitransient_lidar.rendering.shots import batches as shot_batches
from mitransient_lidar.rendering.shots import series as shot_series
from mitransient_lidar.rendering.shots import truth as shot_truth
from mitransient_lidar.rendering.shots.batches import ShotPoses
from mitransient_lidar.rendering.shots.scene import ShotScene
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.scene_parts import find_lidar_scene

FLAT = {"spectrum": "flat", "surface_size": 60}
PLANE = {"spectrum": "flat"}
PLACES = [(1.0, 2.0), (-3.0, 4.5), (10.0, -7.0)]
TRUTH = (
    *("aim_x", "aim_y", "true_slope_along", "true_slope_across", "true_surface_height", "true_bottom_depth"),
    *("true_bottom_depth_below_surface", "true_absorption", "true_scattering", "true_backscattering"),
    *("true_attenuation", "true_kd"),
)


MEAN_SLOPE = 0.02, -0.03


class Wave:
    """A plane wave, with the interface of a sea."""

    cell_size = line_distance = 0.25
    height_patches = SeaSurface.height_patches

    def __init__(self, k_x, k_y):
        self.k = k_x, k_y

    def heights(self, x, y):
        return 0.3 * np.cos(self.k[0] * x[..., np.newaxis, :] + self.k[1] * y[..., np.newaxis] + 0.4)

    def heights_about(self, place, x, y):
        """The mean slope, about the place, adds to the wave's."""
        dx, dy = x - place[..., :1], y - place[..., 1:]
        return self.heights(x, y) + MEAN_SLOPE[0] * dx[..., np.newaxis, :] + MEAN_SLOPE[1] * dy[..., np.newaxis]


class Beam:
    """A beam of 10 mrad, with the interface of a transmitter."""

    widest_angular_spread = 5e-3

    def __init__(self, azimuth):
        pose = KernelPose.from_angles(200.0, 40.0)
        cos, sin = math.cos(azimuth), math.sin(azimuth)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        self.pose = KernelPose(*(turn @ vector for vector in (pose.origin, pose.axis, pose.far, pose.left)))


@each_row((0.9, 0.0), (0.3, -0.8), (-0.5, 0.5))
@each_row(0.0, 0.7)
def test_truth_is_the_mean_of_a_wave_over_an_elliptic_gaussian(azimuth, k_x, k_y):
    """In closed form the wave is damped by exp(-(k_a^2 s_a^2 + k_c^2 s_c^2)/2); s_c is 5 mrad of 261 m, s_a longer."""
    x, y, across = 3.17, -8.4, 5e-3 * 200 / math.cos(math.radians(40))
    along = across / math.cos(math.radians(40))
    k_along = k_x * math.cos(azimuth) + k_y * math.sin(azimuth)
    k_across = k_y * math.cos(azimuth) - k_x * math.sin(azimuth)
    damped = 0.3 * math.exp(-0.5 * ((k_along * along) ** 2 + (k_across * across) ** 2))
    phase = k_x * x + k_y * y + 0.4
    cos, sin = math.cos(azimuth), math.sin(azimuth)
    mean = cos * MEAN_SLOPE[0] + sin * MEAN_SLOPE[1], cos * MEAN_SLOPE[1] - sin * MEAN_SLOPE[0]
    slopes = (part - k * damped * math.sin(phase) for part, k in zip(mean, (k_along, k_across), strict=True))
    expected = [*slopes, damped * math.cos(phase)]
    # Central differences of the wave's heights are flatter by up to (k h)^2/6 = 0.8 %.
    # One lidar has the azimuth, the other one is turned by it.
    for beam, turn in ((azimuth, 0.0), (0.0, azimuth)):
        found = shot_truth.footprint_means([Wave(k_x, k_y)], Beam(beam), np.array([[x, y]]), np.array([turn]))
        np.testing.assert_allclose(found[0], expected, rtol=0.01, atol=1e-4)


def test_truth_of_a_flat_sea_over_a_slope(lidar_scene):
    """The axis at 20 degrees, refracted, meets the plane z = -8 + 0.1 x at a distance in closed form."""
    # The rectangle is turned about y, so that z rises with x, and lowered.
    turned = mi.ScalarTransform4f().translate([0, 0, -8]).rotate([0, 1, 0], -math.degrees(math.atan(0.1))).scale(100)
    bottom = {"type": "rectangle", "to_world": turned, "bsdf": {"type": "diffuse"}}
    small = {"type": "sphere", "center": [0.0, 0.0, -4.0], "radius": 0.5, "bsdf": {"type": "diffuse"}}
    scene = lidar_scene(integrator={"type": "lidar_merging"}, bottom=None, extra={"floor": bottom, "target": small})
    lidar = find_lidar_scene(scene, scene.sensors()[0])
    truth = shot_truth.truth_coordinates(shot_truth.sea_of(scene), lidar, ShotPoses(np.array([*PLACES, (400.0, 0.0)])))
    depth, below = (truth[f"true_bottom_depth{end}"][1] for end in ("", "_below_surface"))
    sine = math.sin(math.radians(20)) / 1.34
    tangent = sine / math.sqrt(1 - sine**2)
    expected = [(8 - 0.1 * x) / (1 + 0.1 * tangent) for x, _ in PLACES]
    np.testing.assert_allclose(depth[:3], expected, atol=2e-4)
    assert np.isnan(depth[3])
    np.testing.assert_array_equal(below, depth)
    for name in ("slope_along", "slope_across", "surface_height"):
        np.testing.assert_array_equal(truth[f"true_{name}"][1], 0)


@each_row(
    # Kd is that of Jerlov's table and b as measured; the rest follows by the sources of `water_types.jerlov`.
    ({"jerlov": "5C"}, [4.0, np.nan], {"true_kd": 0.3072, "true_scattering": 1.21}),
    ({"kd": 0.1}, [4.0], {"true_kd": 0.1}),
    ({"secchi": 10}, [4.0], {"true_kd": 0.17, "true_attenuation": 0.7}),
    # Petzold's San Diego harbour.
    ({"petzold": "turbid"}, [4.0], {"true_absorption": 0.366, "true_scattering": 1.824}),
    # Half of the scattering by molecules is backscattering.
    ({"pure": "true"}, [4.0], {"true_scattering": 0.00196, "true_backscattering": 0.00098}),
    # 3 of 8 m are the upper layer.
    ({"jerlov": "1C, 7C", "layer_tops": "0, 3"}, [8.0], {"true_kd": (3 * 0.1272 + 5 * 0.4816) / 8}),
    ({"jerlov": "1C, 7C", "layer_tops": "0, 3"}, [np.nan], {"true_kd": np.nan, "true_scattering": np.nan}),
)
def test_coefficients_of_waters_by_name(water, depth, expected):
    medium = mi.load_dict({"type": "layered_water", **{name: str(value) for name, value in water.items()}})
    found = shot_truth.water_means(medium.water, np.array(depth))
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=3e-3)
    np.testing.assert_allclose(found["true_absorption"] + found["true_scattering"], found["true_attenuation"])


def test_backscattering_is_that_of_the_phase_function_that_is_rendered():
    """(1 - g)/(2 g) ((1 + g)/sqrt(1 + g^2) - 1) of Henyey-Greenstein's function."""
    water = {"attenuation": "1", "scattering": "0.8", "backscattering": "0.1", "phase_function": "hg", "phase_g": 0.9}
    medium = mi.load_dict({"type": "layered_water", **water})
    share = (1 - 0.9) / (2 * 0.9) * ((1 + 0.9) / math.sqrt(1 + 0.9**2) - 1)
    assert shot_truth.water_means(medium.water, np.array([5.0]))["true_backscattering"][0] == pytest.approx(
        0.8 * share, rel=1e-3
    )


@pytest.fixture
def rendered(monkeypatch):
    """Replace renders by made-up waveforms; return places, seeds and time bins of all batches."""
    asked = []

    def render(batches, poses, seeds):
        places, lidar = poses.places, batches.at(poses)(1).scene
        asked.append({"places": places.tolist(), "seeds": list(seeds), "passes": batches.passes, "axis": lidar.axis})
        power = np.ones((len(places), lidar.receiver.pixels.count, lidar.axis.bin_count))
        power *= 1 + np.array(seeds)[:, None, None]
        made, passes = 2 * (power, 0.1 * power), np.full(len(places), batches.passes)
        return shot_batches.ReceivedShots(made, 0.0, passes, errors=np.full(1, 0.1))

    monkeypatch.setattr(shot_batches.ShotBatches, "render", render)
    return asked


@pytest.mark.slow
def test_shots_at_given_places(rendered, tmp_path):
    done = []
    series = shot_series.render_shots("fig09_2x2", FLAT, positions=PLACES, passes=3, progress=done.append)
    # A launch holds one shot of three full passes.
    assert [one["places"] for one in rendered] == [[list(place)] for place in PLACES]
    assert [(one["seeds"], one["passes"]) for one in rendered] == [([number], 3) for number in range(3)]
    assert [(one.done, one.planned, one.unit) for one in done] == [(1, 3, "shot"), (2, 3, "shot"), (3, 3, "shot")]
    assert done[-1].error_median == pytest.approx(0.1)
    assert series["waveform"].dims == ("shot", "pixel", "time")
    assert series["waveform"].values[:, 0, 0].tolist() == [1, 2, 3]
    np.testing.assert_array_equal(np.array([series["aim_x"], series["aim_y"]]).T, PLACES)
    assert all(series[name].dims == ("shot",) and name in series.coords for name in TRUTH)
    np.testing.assert_allclose(series["true_bottom_depth"], 8.0)
    assert (series.attrs["shots"], series.attrs["interrupted"], series.attrs["pass_share"]) == (3, 0, 1.0)
    assert not {"scene.aim_x", "receiver_pose", "places_seed", "slope_deviation"} & set(series.attrs)
    results.save(series, tmp_path / "shots.nc")
    xr.testing.assert_identical(results.open(tmp_path / "shots.nc"), series)
    with pytest.raises(UserError, match=r"shots\.exr: an EXR file holds a single shot; use a \.nc file"):
        results.save(series, tmp_path / "shots.exr")
    assert len(shot_series.describe_shots(series)) == 4


@pytest.mark.slow
def test_shots_over_a_slope_have_the_time_bins_of_the_deepest(rendered):
    """The bottom lies 10 m deeper at x = -57 m: 9.4 ns of each metre, and a quarter more for scattered light."""
    scene, slope = "scenes/examples/survey_lidar.xml", {**PLANE, "bottom_slope_deg": 10}
    for places in ([(0, 0)], [(0, 0), (-57, 0)]):
        shot_series.render_shots(scene, slope, positions=places)
    flat, deep = rendered[0]["axis"], rendered[1]["axis"]
    assert rendered[2]["axis"] == deep
    assert 85 < deep.end_ns - flat.end_ns < 145
    assert deep.start_ns == pytest.approx(flat.start_ns, abs=5)
    shot_series.render_shots(scene, slope, positions=[(0, 0)], axis=deep)
    assert rendered[3]["axis"] == deep


@pytest.mark.slow
def test_places_beside_the_bottom_are_told(rendered, caplog):
    """The bottom of the scene is a square of 1 km."""
    series = shot_series.render_shots("fig09_2x2", FLAT, positions=[(0, 0), (600, 0)])
    np.testing.assert_array_equal(series["true_bottom_depth"], [8.0, np.nan])
    assert "the axis of 1 of 2 shots misses the bottom" in caplog.text


@pytest.mark.slow
def test_target_keeps_its_place_relative_to_the_aim(rendered):
    params = {**FLAT, "target_x": 0.5, "aim_x": 0.2}
    series = ShotScene("fig13_2x2", params, np.array(PLACES), target=(0.3, 0.0))
    (target,) = series.companions
    assert target.id() == "target"
    # In the frame of the first shot, with its aim at x = 1 m.
    assert 0.5 * (target.bbox().min.x + target.bbox().max.x) == pytest.approx(1.3, abs=1e-5)
    found = shot_series.render_shots("fig13_2x2", params, positions=PLACES, move_target=True)
    assert found.attrs["moved_target"] == 1
    assert set(json.loads(found.attrs["series_parameters"])) == {"aim_x", "aim_y", "target_x", "target_y"}


@pytest.mark.slow
@pytest.mark.parametrize("kept", [0, 2])
def test_interruption_keeps_the_shots_so_far(rendered, monkeypatch, kept):
    whole = shot_batches.ShotBatches.render

    def interrupted(batches, poses, seeds):
        if seeds[0] == kept:
            raise KeyboardInterrupt
        return whole(batches, poses, seeds)

    monkeypatch.setattr(shot_batches.ShotBatches, "render", interrupted)
    if kept == 0:
        with pytest.raises(KeyboardInterrupt):
            shot_series.render_shots("fig09_2x2", FLAT, positions=PLACES)
        return
    series = shot_series.render_shots("fig09_2x2", FLAT, positions=PLACES)
    assert series.sizes["shot"] == series["aim_x"].size == 2
    assert series.attrs["interrupted"] == 1


@each_row((single, "render", "render"), (single, "render_again", "render"), (shot_series, *["render_shots"] * 2))
def test_an_interruption_of_the_first_of_two_channels_ends_the_render(module, name, called, monkeypatch):
    calls = []
    function = getattr(module, name)
    monkeypatch.setattr(module, called, lambda *_, **__: calls.append(called) or xr.Dataset(attrs={"interrupted": 1}))
    monkeypatch.setattr(single, "split", lambda _: (None, xr.Dataset()))
    monkeypatch.setattr(single.again, "recall", lambda *_: ("render", {"scene": "table1"}))
    of_scene = {"scene": "table1", "instrument": "teledyne_czmil", "infrared": True}
    with pytest.raises(KeyboardInterrupt):
        function(**{"result": xr.Dataset()} if name == "render_again" else of_scene)
    assert calls == [called]


@each_case(
    ("fig09_2x2", {"positions": [(0, 0, 1)]}, r"positions of shape \(1, 3\) must be 1 to 100000 pairs"),
    ("fig09_2x2", {"positions": []}, r"positions of shape \(0,\) must be 1 to 100000 pairs"),
    ("fig09_2x2", {"positions": [(0, math.nan)]}, "positions holds nan"),
    ("fig09_2x2", {"positions": "here"}, "positions = 'here' must hold numbers only"),
    ("fig09_2x2", {"positions": [(0, -2e7)]}, r"positions = -2e\+07 must lie between"),
    ("fig09_2x2", {"positions": [(0, 1e5), (0, 1e6)]}, "positions are 900000 m apart along x or y: at most 20000"),
    ("fig09_2x2", {"positions": PLACES, "shot_passes": [2, 2]}, r"shot_passes of shape \(2,\) must be one number"),
    ("fig09_2x2", {"positions": PLACES, "shot_passes": [2, 9, 2]}, "shot_passes = 9 must lie between 2 and 8"),
    ("fig09_2x2", {"count": 3}, "every shot on a flat sea is the same"),
    ("fig09_2x2", {"positions": PLACES, "move_target": True}, "has no parameter target_x, which move_target needs"),
)
def test_invalid_input_is_refused_before_rendering(scene, options, message, rendered):
    must_refuse(message, shot_series.render_shots, scene, FLAT, **options)
    assert not rendered
