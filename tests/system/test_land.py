"""Land, cliffs and piers, and waves that hide what a mast sees."""

import mitsuba as mi
import numpy as np
import pytest
from rows import each_case, each_row
from significance import largest_z, mean_and_error

import mitransient_lidar
from mitransient_lidar.core.constants import C0
from mitransient_lidar.loading import scenes
from mitransient_lidar.loading.scenes import choose_integrator, open_scene
from mitransient_lidar.rendering.shots.series import render_shots

NS = 1e9 / C0
RHO = 0.2
PIER = """<shape type="cube" id="pier">
<transform name="to_world"><scale x="1" y="1" z="5"/><translate z="-3"/></transform>
<bsdf type="diffuse"><spectrum name="reflectance" value="0.3"/></bsdf></shape>"""


@pytest.fixture
def shore(tmp_path):
    """Return the file of a scene of a shore along y, with heights of land and bottom by x."""

    def write(heights=lambda x: np.clip(0.1 * x, -5, 3), more="", layout="1x1"):
        x = np.arange(-100.0, 101.0)
        np.savez(tmp_path / "map.npz", heights=np.tile(heights(x), (x.size, 1)), x=x, y=x)
        path = tmp_path / "shore.xml"
        path.write_text(
            f"""<scene version="3.0.0"><integrator type="lidar_merging"/><emitter type="lidar_transmitter"/>
            <sensor type="multipixel_receiver"><string name="layout" value="{layout}"/>
            <film type="time_gated_film"><float name="bin_width_ns" value="1"/></film></sensor>
            <shape type="ocean_surface" id="surface"><float name="wind_speed" value="3"/>
            <medium type="layered_water" name="interior"/></shape>
            <shape type="seabed" id="bottom"><string name="filename" value="{tmp_path}/map.npz"/>
            <float name="reflectance" value="{RHO}"/></shape>{more}</scene>"""
        )
        return path

    return write


def by_origin(path, params, integrator, passes, paths=None, first=0):
    """Return names of origins, energies of passes, shape (passes, origins), and the renderer."""
    session = open_scene(path, params)
    renderer = choose_integrator(session.scene, integrator).prepare(session.scene, session.sensor).by_origin()
    found = []
    for seed in range(first, first + passes):
        energy = renderer.render_pass(seed, paths=paths).histogram.energy()
        found.append(energy.reshape(-1, renderer.classes.count, energy.shape[-1]).sum(axis=(0, 2)))
    return renderer.classes.names, np.array(found), renderer


@pytest.mark.slow
@each_row(("lidar_merging", 1.0), ("lidar_volpath", 1.0), ("lidar_volpath", 40.0))
def test_dry_land_has_its_closed_form(integrator, height, shore):
    """E rho cos A / (pi R^2) of a narrow beam, to 0.1 %, and nothing of the sea below."""
    path = shore(lambda x: 0 * x + height)
    params = {"divergence_mrad": 0.5, "field_of_view_mrad": 5.0}
    _, found, renderer = by_origin(path, params, integrator, 4)
    lidar = renderer.scene
    cosine = np.cos(np.radians(20))
    distance = (200 - height) / cosine
    optics = lidar.receiver.optics
    solid_angle = optics.aperture_area / distance**2
    expected = lidar.transmitter.energy * optics.optical_efficiency * optics.two_way_atmospheric_transmittance
    expected *= RHO * cosine / np.pi * solid_angle
    assert found.sum(axis=1) == pytest.approx(expected, rel=1e-3)
    # The axis holds the echo, with quiet bins before it, and ends soon after.
    echo = 2 * NS * distance
    assert lidar.axis.start_ns < echo - 20
    assert echo + 10 < lidar.axis.end_ns < echo + 40


@pytest.mark.slow
@each_case(
    pytest.param(-4.0, 0.0, 0, marks=pytest.mark.long),
    (-1.0, 0.17, 0),
    *(pytest.param(0.0, 0.5, cell, marks=pytest.mark.long) for cell in (0, 0.2)),
    (2.0, 0.97, 0),
)
def test_footprints_with_more_and_less_land_agree(aim, land, cell, shore):
    """Light was merged beyond the water line, too: wide patches lost 2 % of the bottom, and a thin wedge 5 % of it."""
    path, params = shore(), {"aim_x": aim, "spectrum": "flat"}
    merging = {"type": "lidar_merging", "cell_size": cell} if cell else "lidar_merging"
    names, merged, renderer = by_origin(path, params, merging, 12)
    _, reference, _ = by_origin(path, params, "lidar_volpath", 12, 2**16, 500)
    assert renderer.probe.echoes.on_land == pytest.approx(land, abs=0.03)
    for number, name in enumerate(names):
        (a, ea), (b, eb) = (mean_and_error(samples[:, number]) for samples in (merged, reference))
        error = np.hypot(ea, eb)
        assert abs(a - b) <= largest_z(12) * error, (aim, cell, name, a / b)


@pytest.mark.slow
def test_shots_on_land_end_as_soon_as_wet_ones_and_have_the_truth_of_land(shore):
    """Dry pulses had waited for the errors of a sea that is not there."""
    series = render_shots(shore(), positions=[(-30, 0), (10, 0), (40, 0)], target_error=0.05)
    assert series.attrs["error_median"] < 0.05
    dry = render_shots(shore(), positions=[(20.0 + x, 0) for x in range(4)], target_error=0.05)
    assert dry.attrs["error_p95"] < 0.05
    assert dry.shot_passes.max() == 4
    depth = series["true_bottom_depth"].values
    # Where the axis meets the land, not below it.
    slope = np.tan(np.radians(20))
    np.testing.assert_allclose(depth[1], -0.1 * 10 / (1 + 0.1 * slope), atol=2e-3)
    np.testing.assert_allclose(depth[2], -3, atol=2e-3)
    assert depth[0] == pytest.approx(3, abs=0.2)
    for name in ("true_surface_height", "true_bottom_depth_below_surface", "true_slope_along", "true_attenuation"):
        assert np.isfinite(series[name].values).tolist() == [True, False, False], name


@pytest.mark.slow
def test_cliff_is_recorded_before_the_sea(shore):
    """Land at 40 m comes 267 ns earlier than the sea at nadir, and 284 ns at 20 degrees."""
    path = shore(lambda x: np.where(x < 20, -4.0, 40.0))
    result = mitransient_lidar.render(path, params={"aim_x": 60}, passes=2)
    early = result.attrs["time_start_ns"] + float(result.waveform.values.argmax())
    assert early == pytest.approx(2 * NS * 160 / np.cos(np.radians(20)), abs=2)
    assert "surface_time_ns" not in result.attrs
    assert result.attrs["beam_on_land"] == 1
    assert result.attrs["beam_outside_surface"] == 0
    assert result.attrs["error_p95"] < 0.01


@pytest.mark.slow
def test_pier_has_its_own_light_and_truth(shore, caplog):
    path = shore(lambda x: 0 * x - 8, PIER)
    names, merged, _ = by_origin(path, {"spectrum": "flat"}, "lidar_merging", 12)
    _, reference, _ = by_origin(path, {"spectrum": "flat"}, "lidar_volpath", 12, 2**16, 500)
    for number, name in enumerate(names):
        (a, ea), (b, eb) = (mean_and_error(samples[:, number]) for samples in (merged, reference))
        assert abs(a - b) < largest_z(12) * np.hypot(ea, eb), (name, a / b)
    assert "enlarge" not in caplog.text
    series = render_shots(path, positions=[(0, 0), (30, 0)], passes=2)
    assert np.isfinite(series["true_surface_height"].values).tolist() == [False, True]


@pytest.mark.slow
def test_waves_hide_what_geometry_says():
    """Rays from the sea to the mast against the horizon of height profiles in plain NumPy, towards -x."""
    scene = scenes.open_scene("fig04_mast", {"wind_speed": 6}).scene
    sea = next(shape.sea for shape in scene.shapes() if hasattr(shape, "sea"))
    mast = scene.sensors()[0].receiver.pose.origin
    rows = np.arange(-20, 20) * 4 * sea.cell_size
    columns = np.arange(-int(18 / sea.cell_size), int(10 / sea.cell_size)) * sea.cell_size
    heights = sea.heights(columns, rows)
    # Slope of the ray to the mast against the steepest slope to what stands in between.
    places = range(len(columns) // 2, len(columns))
    hidden = np.zeros((len(rows), len(places)), dtype=bool)
    for index, place in enumerate(places):
        away = columns[place] - columns[:place]
        steepest = np.max((heights[:, :place] - heights[:, [place]]) / away, axis=1)
        hidden[:, index] = steepest > (mast[2] - heights[:, place]) / (columns[place] - mast[0])
    x, y = np.meshgrid(columns[len(columns) // 2 :], rows)
    z = heights[:, len(columns) // 2 :]
    point = np.stack([x, y, z + 1e-3], axis=-1).reshape(-1, 3)
    towards = mast - point
    towards[:, 1] = 0  # in the plane of the profile
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    ray = mi.Ray3f(mi.Point3f(point.T.copy()), mi.Vector3f(towards.T.copy()))
    ray.maxt = 14.0
    blocked = np.array(scene.ray_test(ray)).reshape(hidden.shape)
    assert 0.02 < hidden.mean() < 0.9
    # Facets hang a little below and above the profile's points between them.
    assert abs(blocked.mean() - hidden.mean()) < 0.03
    assert (blocked == hidden).mean() > 0.95
