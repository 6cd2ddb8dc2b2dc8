"""Light maps of beams over waves and over a level sea."""

import mitsuba as mi
import numpy as np
import pytest
import significance
import xarray as xr
from rows import each_case, must_refuse, refuses
from scipy.ndimage import binary_dilation
from scipy.stats import f as f_distribution

import mitransient_lidar
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.flights.plan import FlightPlan
from mitransient_lidar.flights.renderer import FlightRenderer
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.rendering.shots.batches import ShotPoses, suits_maps
from mitransient_lidar.rendering.shots.scene import ShotScene
from mitransient_lidar.transport.light_maps.maps import HeightFields
from mitransient_lidar.transport.light_maps.renderer import LightMapRenderer
from mitransient_lidar.transport.paths.passes import PathClasses
from mitransient_lidar.transport.probe import Probe
from mitransient_lidar.transport.rng import Shots
from mitransient_lidar.transport.scene_parts import find_lidar_scene


def lidar_of(params, scene="table1"):
    """Return the lidar of a scene with other parameters, and the scene, which keeps it alive."""
    session = open_scene(scene, params)
    return find_lidar_scene(session.scene, session.sensor), session


@pytest.mark.parametrize("narrow", [{}, {"divergence_mrad": 0.5, "field_of_view_mrad": 2, "wind_speed": 12}])
def test_rays_meet_the_faces_that_the_mesh_has(narrow):
    """Waves of another place, a mirrored grid, the other diagonal and a small patch differ by centimetres."""
    lidar, _session = lidar_of({"wind_speed": 6, "off_nadir_deg": 30, "wind_direction_deg": 40, **narrow})
    lanes = Shots([0]).paths(4096)
    sample = Probe(lidar).sampler.sample_shots(lanes, 4096, Shots([0]).streams(1, lanes))
    start, _ = lidar.first_points(lidar.receiver.pose, sample.angles, sample.direction)
    found = HeightFields.about(lidar).meet(start, sample.direction, mi.Bool(True))
    wanted = lidar.mitsuba_scene.ray_intersect(mi.Ray3f(start, sample.direction))
    # Rounding of the mesh's coordinates may move a ray to the next face.
    assert np.mean(np.abs(np.array(found.t) - np.array(wanted.t)) < 2e-4) > 0.999
    for name in ("s", "t", "n"):
        own, other = (np.array(getattr(each.sh_frame, name)) for each in (found, wanted))
        assert np.mean(np.abs(own - other).max(axis=0) < 2e-3) > 0.99


@pytest.mark.slow
@pytest.mark.parametrize(
    ("params", "passes"),
    [
        ({}, 12),
        pytest.param({"wind_speed": 10, "bottom_depth": 6}, 12, marks=pytest.mark.long),
        pytest.param({"attenuation": 0.8, "scattering": 0.6, "bottom_depth": 5}, 12, marks=pytest.mark.long),
        pytest.param({"divergence_mrad": 1.5, "field_of_view_mrad": 6}, 24, marks=pytest.mark.long),
        pytest.param({"attenuation": 0.2, "scattering": 0.05, "wind_speed": 6}, 12, marks=pytest.mark.long),
        # 0.4 m deep, 5.7 m before the water line.
        pytest.param({"aim_x": -4.3, "divergence_mrad": 2, "field_of_view_mrad": 8, "wind_speed": 5}, 12),
    ],
    ids=["table1", "waves", "turbid", "narrow", "clear", "beach"],
)
def test_maps_agree_with_merging(params, passes):
    """Water and bottom of each pixel, within 1 % and their errors; times of bottoms within 0.06 ns and theirs."""
    lidar, session = lidar_of(params, "beach" if "aim_x" in params else "table1")
    merging = session.scene.integrator().prepare(session.scene, session.sensor).by_origin()
    maps = LightMapRenderer(lidar, PathClasses()).by_origin().scaled(8)

    def energies(renderer, count):
        shape = count, lidar.receiver.pixels.count, renderer.classes.count, -1
        return np.array([renderer.render_pass(seed).histogram.energy() for seed in range(count)]).reshape(shape)

    found, wanted = energies(maps, 12), energies(merging, passes)
    for origin, error in ((1, 0.01), (2, 0.01)):
        whole, other = (each[:, :, origin].sum(axis=-1) for each in (found, wanted))
        significance.assert_same(whole, other, error=error, bias=0.01)
    times = [
        np.array([(one * lidar.axis.centres_ns).sum() / one.sum() for one in each[:, :, 2].sum(axis=1)])
        for each in (found, wanted)
    ]
    (early, own), (late, others) = (significance.mean_and_error(each) for each in times)
    assert abs(early - late) < 0.06 + significance.largest_z(12) * np.hypot(own, others)


@pytest.mark.slow
def test_shots_of_a_series_are_those_of_their_places():
    """A shot among others has the light that it has alone but for its random numbers; calls repeat their bits."""
    places = np.array([[3.0, -2.0], [40.0, 25.0]])
    series = ShotScene("table1", {}, places, light="maps", check=False).batches(2, 1.0, None)
    both, again = (series.render(ShotPoses(places), [1, 2]).whole[0] for _ in range(2))
    np.testing.assert_array_equal(both, again)
    lidar, _session = lidar_of({"aim_x": 40, "aim_y": 25})
    alone = LightMapRenderer(lidar, PathClasses())
    energy = np.array([alone.render_pass(seed).histogram.energy().sum() for seed in range(8)])
    mean, error = significance.mean_and_error(energy)
    # Two passes have half of the variance of one.
    limit = significance.largest_z(8) * np.hypot(error, energy.std(ddof=1) / np.sqrt(2))
    assert abs(both[1].sum() - mean) < limit
    assert limit < 0.2 * mean


@pytest.mark.slow
def test_series_by_maps_are_rendered_again():
    series = mitransient_lidar.render_shots("table1", positions=[[0, 0], [9, 9]], light="maps")
    assert series.attrs["light"] == "maps"
    xr.testing.assert_identical(mitransient_lidar.render(series)["waveform"], series["waveform"])


@each_case(
    ({"light": "paths"}, "light = 'paths' must be one of merging, maps"),
    ({"light": "maps", "derivatives": "attenuation"}, "light = 'maps' has no derivatives"),
    (
        {"light": "maps", "params": {"off_nadir_deg": 60}},
        "maps do not suit the scene: the receiver looks more than 45 degrees from nadir; use light = 'merging'",
    ),
)
def test_what_maps_are_not_for(options, message):
    for render, more in ((mitransient_lidar.render, {}), (mitransient_lidar.render_shots, {"positions": [[0, 0]]})):
        must_refuse(message, render, "table1", **more, **options)


@pytest.mark.slow
def test_shots_that_light_a_target_are_merged():
    """The light is 1.4 m ahead of the place: where a cube of 1 m is met, and not beyond 2 m beside it."""
    places = np.array([[-42.6, 60.0], [-41.0, 60.0], [-45.0, 60.0], [-41.0, 63.0], [0.0, 0.0]])
    scene = ShotScene("flight", {"cube_x": -41, "cube_y": 60}, places, light="maps", check=False)
    np.testing.assert_array_equal(suits_maps(scene.lidar, ShotPoses(places)), [False, False, True, True, True])


@pytest.mark.slow
def test_vertical_sides_keep_scattered_light():
    """A cube of 3 m in turbid water, seen at 30 degrees from nadir: without light on its sides it has 0.76 of its own.

    Its sides get less scattered light than they should: 0.93 of the whole.
    """
    params = {
        **{"spectrum": "flat", "layout": "1x1", "off_nadir_deg": 30, "field_of_view_mrad": 60, "aim_x": -2.6},
        **{"cube_size": 3, "cube_x": 0, "cube_y": 0, "cube_depth": 2, "bottom_depth": 6, "bottom_ripple_height": 0},
        **{"bottom_slope_x_deg": 0, "bottom_slope_y_deg": 0},
        **{"attenuation": 0.6, "scattering": 0.45, "backscattering": 0.009},
    }
    lidar, session = lidar_of(params, "flight")
    merging = session.scene.integrator().prepare(session.scene, session.sensor).by_origin()
    maps = LightMapRenderer(lidar, PathClasses()).by_origin().scaled(8)
    of_cube = [
        np.array([renderer.render_pass(seed).histogram.energy()[..., 3, :].sum() for seed in range(8)])
        for renderer in (maps, merging)
    ]
    assert maps.classes.names[3] == "cube"
    significance.assert_same(*(energy[:, np.newaxis] for energy in of_cube), error=0.03, bias=0.1)


@pytest.mark.slow
def test_shots_over_land_are_merged():
    """The water line of `beach` is at x = 1.4 m, and 5 cm deep water at 0.7 m; half of the beam is 4 m long."""
    places = np.array([[-30.0, 0.0], [-6.0, 8.0], [0.0, 0.0], [4.0, 0.0], [30.0, 0.0]])
    scene = ShotScene("beach", {"divergence_mrad": 2, "field_of_view_mrad": 8}, places, light="maps", check=False)
    np.testing.assert_array_equal(suits_maps(scene.lidar, ShotPoses(places)), [True, True, False, False, False])
    with pytest.raises(UserError, match="do not suit the scene: solids reach the surface in 3 shots"):
        mitransient_lidar.render_shots("beach", positions=places, light="maps")


@pytest.mark.slow
def test_bottoms_of_narrow_beams_have_little_noise_and_state_it():
    """Energies of 64 seeds, two passes each: 12 looks at the bottom for each ray instead of 48 spread by 8.4 %."""
    params = {"wind_speed": 3, "altitude": 600, "jerlov": "1C", "cube_x": 60, "bottom_ripple_height": 0}
    places = np.zeros((64, 2))
    given = {"light": "maps", "instrument": "riegl_vq880g2", "components": True, "check": False}
    batches = ShotScene("flight", params, places, **given).batches(2, 1.0, None)
    renderer = batches.at(ShotPoses(places))(2)
    energy = renderer.render_pass(list(range(128))).histogram.energy()
    shape = 64, 2, renderer.scene.receiver.pixels.count, renderer.classes.count, -1
    bottom = energy.reshape(shape)[:, :, :, 2].sum(axis=(2, 3))
    stated, spread = np.mean(np.diff(bottom) ** 2) / 4, bottom.mean(axis=1).var(ddof=1)
    assert np.sqrt(spread) < 0.06 * bottom.mean()
    limit = f_distribution.isf(1e-6, 63, 64)
    assert 1 / limit < spread / stated < limit


@pytest.mark.slow
def test_series_that_maps_do_not_suit_are_merged():
    """Over foam, and with a target in the beam; over a bottom alone maps give other light."""
    flat = {"spectrum": "flat", "surface_size": 60, "layout": "1x1"}
    options = {"positions": [(0, 0)], "passes": 2, "pass_share": 1 / 64, "merge_unsuited": True}
    for scene, params, is_merged in (
        ("table1", {**flat, "foam": 0.1}, True),
        ("fig13_2x2", flat, True),
        ("table1", flat, False),
    ):
        rows = [
            mitransient_lidar.render_shots(scene, params, light=light, **options)["waveform"].values
            for light in ("merging", "maps")
        ]
        assert np.array_equal(*rows) == is_merged


@pytest.mark.slow
def test_flights_by_maps_find_the_same_bottoms():
    """Depths of both ways to compute the light of 8 pulses differ by their errors, and not by 2 cm in the mean."""
    shipped = FlightPlan.read("semi_arc")
    given = {"scene": "flight", "instrument": "published_airborne", "still_sea": True}
    given["parameters"] = {"bottom_ripple_height": 0}
    given |= {"platform": shipped.platform, "scanner": shipped.scanner, "pulses": {"rate_hz": 50.0, "most": 8}}
    echoes = {}
    for light in ("merging", "maps"):
        renderer, columns = FlightRenderer.of(FlightPlan.of_file({**given, "light": light}))
        found = [
            renderer.stacked(np.array(rows), {name: column[rows] for name, column in columns.items()})
            for rows in renderer.batches(columns)
        ]
        names = ("echo_depth_m", "echo_depth_m_stderr")
        echoes[light] = [np.concatenate([one[name].values for one in found])[:, :, 3] for name in names]
    (depth, error), (other, own) = echoes["merging"], echoes["maps"]
    seen = np.isfinite(depth) & np.isfinite(other)
    assert seen.mean() > 0.95
    z = ((other - depth) / np.hypot(error, own))[seen]
    assert np.sum(z**2) < 1.5 * significance.largest_chi2(z.size)
    assert abs(np.mean((other - depth)[seen])) < 0.02 + 4 * np.std((other - depth)[seen]) / np.sqrt(z.size)


@pytest.mark.slow
def test_maps_of_images_resolve_fine_waves(monkeypatch):
    """Water within 3 m of waves from 0.1 m: cells of a shot, 0.2 m wide, focus it more, and finer cells no less."""
    lidar, _session = lidar_of({"wind_speed": 3, "shortest_wave": 0.1, "cell_size": 0.03, "bin_width_ns": 1})
    times = lidar.axis.centres_ns - Probe(lidar).echoes.surface_ns.mean()
    near = (times > 4) & (times <= 28)

    def energies(renderer):
        shape, seeds = (lidar.receiver.pixels.count, renderer.classes.count, -1), range(24)
        passes = [renderer.render_pass(significance.seed_shift + seed).histogram.energy() for seed in seeds]
        return np.array([energy.reshape(shape)[:, 1, near].sum() for energy in passes])[:, np.newaxis]

    wide = energies(LightMapRenderer(lidar, PathClasses()).by_origin().scaled(16))
    own = energies(LightMapRenderer(lidar, PathClasses(), image=True).by_origin().scaled(0.25))
    monkeypatch.setattr("mitransient_lidar.transport.light_maps.renderer._CELLS_PER_WAVE", 4)
    fine = energies(LightMapRenderer(lidar, PathClasses(), image=True).by_origin().scaled(0.25))
    significance.assert_same(own, fine, error=0.0035)
    # 3 %, with a standard error of 0.25 %.
    assert wide.mean() > 1.015 * own.mean()


#: A mine at 9 m over sand at 12 m, in gates of 0.43 m from 8 m on.
MINE = {"target_depth": 9, "target_x": 2.2, "bottom_depth": 12, "gate_start_depth": 8, "gate_width_ns": 4}
MINE |= {"gate_step_ns": 4, "gate_count": 10, "layout": "16x16", "plate_x": 60}


@pytest.mark.slow
def test_a_target_in_an_image_has_an_echo_a_halo_and_a_shadow():
    """The mine's pixels, a ring about them, and the others, in gates on mine, water and sand.

    By unscattered views and beams without shadows, in the last gate the mine's pixels have half the light, and in the
    first gates 1.4 times, and others half.
    """
    passes = 12
    maps, merged = (
        mitransient_lidar.render("gated_mine", MINE, passes=passes, seed=significance.seed_shift + number, light=light)
        for number, light in enumerate(("maps", "merging"))
    )
    echo = merged["gate_energy"].values[..., 1]
    mine = echo > 0.25 * echo.max()
    near = binary_dilation(mine)
    pixels = np.array([mine, near & ~mine, ~binary_dilation(near)])
    assert mine.sum() > 6
    sums = [np.einsum("prc,rcg->pg", pixels, each["gate_energy"].values) for each in (maps, merged)]
    squares = [np.einsum("prc,rcg->pg", pixels, each["gate_energy_stderr"].values ** 2) for each in (maps, merged)]
    ratio = sums[0] / sums[1]
    error = ratio * np.sqrt(sum(square / each**2 for square, each in zip(squares, sums, strict=True)))
    assert np.all(np.abs(ratio - 1) < 0.1 + significance.largest_z(passes, ratio.size) * error), (ratio, error)
    assert np.all(error[:, [1, 9]] < 0.05)


@pytest.mark.slow
def test_images_by_maps_are_rendered_again():
    params = {"layout": "64x64", "gate_count": 10, "gate_width_ns": 4, "target_depth": 9, "bottom_depth": 12}
    stack = mitransient_lidar.render("gated_mine", params, light="maps", passes=2)
    assert stack.attrs["light"] == "maps"
    again = mitransient_lidar.render(stack)
    xr.testing.assert_identical(again["gate_energy"], stack["gate_energy"])


LEVEL = {"spectrum": "flat"}


def look(scene, params, **options):
    return mitransient_lidar.render(scene, params, light="level", components=True, **options)


def by_origin(dataset, origin):
    """Return energies of an origin by pixel, their standard errors, and mean times [ns]."""
    energy = dataset["impulse_response_by_origin"].sel(origin=origin)
    error = np.sqrt((dataset["impulse_response_by_origin_stderr"].sel(origin=origin) ** 2).sum("time"))
    total = energy.sum("time")
    return total.values, error.values, ((energy * energy["time"]).sum("time") / total).values


@pytest.mark.slow
@pytest.mark.parametrize(
    ("params", "water"),
    [
        # The last one has these pixels, too.
        pytest.param({"layout": "2x2"}, 0.02, marks=pytest.mark.long),
        pytest.param({"layout": "1x1", "field_of_view_mrad": 5, "divergence_mrad": 0.5}, 0.02, marks=pytest.mark.long),
        pytest.param(
            *({"layout": "1x4", "off_nadir_deg": 5, "wind_speed": 10, "wind_direction_deg": 60}, 0.02),
            marks=pytest.mark.long,
        ),
        ({"layout": "2x2", "wind_speed": 6, "wind_direction_deg": 150, "slope_distribution": "gram_charlier"}, 0.02),
    ],
    ids=["four", "narrow", "strips", "skewed slopes"],
)
def test_level_sea_agrees_with_renders(params, water):
    """Levels and times of each pixel; the water lacks light that turned twice."""
    params = {**LEVEL, **params}
    few = {"type": "lidar_merging", "paths_per_pass": 2**14, "photons_per_pass": 2**14}
    rendered = mitransient_lidar.render("table1", params=params, integrator=few, passes=12, components=True, seed=3)
    found = look("table1", params, passes=32, seed=significance.seed_shift)
    for origin, bias, shift in (("surface", 0.012, 0.05), ("water", water, 0.3), ("bottom", 0.01, 0.1)):
        energy, error, time = by_origin(found, origin)
        wanted, spread, arrival = by_origin(rendered, origin)
        # 32 and twelve passes, the largest of four pixels.
        limit = significance.largest_z(12, 4) * np.hypot(error, spread)
        assert np.all(abs(energy - wanted) < limit + bias * wanted), origin
        assert np.all(abs(time - arrival) < shift + 8 * limit / wanted), origin


def test_first_look_has_eight_passes_and_is_rendered_again():
    found = look("table1", {**LEVEL, "jerlov": "1C"})
    assert (found.attrs["light"], found.attrs["passes"]) == ("level", 8)
    np.testing.assert_allclose(found["waveform_by_origin"].sum("origin"), found["waveform"], rtol=1e-12)
    np.testing.assert_array_equal(mitransient_lidar.render(found)["waveform"], found["waveform"])


@refuses(
    ("table1", {"altitude": -3}, "the lidar is under water"),
    ("table1", {"off_nadir_deg": 60}, "more than 45 degrees from nadir"),
    ("table1", {"scattering": 2.5, "attenuation": 3}, "light scatters 21 times on its way"),
    ("ship_wake", {}, "its water has bubbles"),
    ("fresh_water_lens", {}, "several refractive indices"),
)
def test_scenes_that_the_model_is_not_for(scene, params):
    look(scene, params)


def test_series_and_derivatives_need_other_light():
    with pytest.raises(UserError, match="light = 'level' must be one of merging, maps"):
        mitransient_lidar.render_shots("table1", LEVEL, count=2, light="level")
    must_refuse("light = 'level' has no derivatives", look, "table1", LEVEL, derivatives="attenuation")


@pytest.mark.slow
def test_images_have_rays_for_each_pixel():
    """They had the 1024 rays of a single waveform for 4096 pixels; sums agree with a level sea's merged light."""
    gates = {"gate_start_ns": 1425, "gate_width_ns": 8, "gate_step_ns": 10, "gate_count": 6}
    params = {**LEVEL, **gates, "layout": "64x64"}
    image = mitransient_lidar.render("table1", params, light="level", passes=8)
    assert image.attrs["error_median"] < 0.2
    merged = mitransient_lidar.render("table1", params | {"layout": "1x1"}, light="merging", passes=16)
    total, error = image["gate_energy"].sum(("row", "column")), image["gate_energy_stderr"]
    error = np.hypot(np.sqrt((error**2).sum(("row", "column"))), merged["gate_energy_stderr"].squeeze())
    difference = total - merged["gate_energy"].squeeze()
    assert (np.abs(difference) < 0.01 * total + significance.largest_z(6) * error).all()
