"""The drawing of a layout: what a result tells of it, and where on the sea it is drawn."""

import json

import mitsuba as mi
import numpy as np
import pytest
from matplotlib.collections import PathCollection, QuadMesh
from matplotlib.colors import to_rgb
from matplotlib.patches import PathPatch
from typer.testing import CliRunner

from mitransient_lidar import results
from mitransient_lidar.cli import app
from mitransient_lidar.errors import UserError
from mitransient_lidar.layout_plot import describe_layout, plot_layout
from mitransient_lidar.transport.beam_profiles import enclosed_area
from mitransient_lidar.transport.system import LidarScene

HALF = 15.0  # mrad
SECTOR = {"type": "pixel_fov", "shape": "sector", "field_of_view_mrad": 30.0, "inner_mrad": 12.0}
TRIANGLE = {"type": "pixel_fov", "shape": "polygon", "vertices_mrad": "20 0, 26 -3, 26 3"}


def described(scene):
    return describe_layout(LidarScene.from_scene(scene, scene.sensors()[0]))


def lines(text):
    return [[np.array(line).reshape(-1, 2) for line in pixel] for pixel in json.loads(text)]


def result(attributes, pixels=4, grid=None, energy=None):
    values = np.full((pixels, 3), 1e-15) if energy is None else np.outer(energy, [0, 1, 0])
    return results.build(
        values,
        values,
        values,
        values,
        time_start_ns=0,
        bin_width_ns=1,
        pixel_names=[f"p{index}" for index in range(pixels)],
        pixel_centres_mrad=[(index, -index) for index in range(pixels)],
        grid=grid,
        attributes={"altitude": 200.0, "off_nadir_deg": 20.0, **attributes},
    )


def on_sea(gx_mrad):
    """Distance along the azimuth [m] of a ray in the plane of incidence, from the angle it makes with the vertical."""
    return 200 * (np.tan(np.radians(20) + np.arctan(1e-3 * gx_mrad)) - np.tan(np.radians(20)))


def patches(figure):
    """Return the filled shapes of the pixels."""
    return [patch for patch in figure.axes[0].patches if isinstance(patch, PathPatch)]


def test_outlines_enclose_the_areas_of_the_pixels(lidar_scene):
    """Holes turn the other way round, so that signed areas add up."""
    quarters = lines(described(lidar_scene())["pixel_outlines"])
    assert [len(pixel) for pixel in quarters] == [1, 1, 1, 1]
    for (line,), (far, left) in zip(quarters, [(1, -1), (1, 1), (-1, -1), (-1, 1)], strict=True):
        assert abs(enclosed_area(line)) == pytest.approx(np.pi * HALF**2 / 4, rel=3e-3)
        assert np.all(line * [far, left] > -0.02)
    nested = {"a": SECTOR | {"extent_deg": 90.0}, "b": SECTOR | {"start_deg": 90.0, "extent_deg": 270.0}, "c": TRIANGLE}
    first, second, triangle = lines(described(lidar_scene(rx=nested))["pixel_outlines"])
    ring = np.pi * (HALF**2 - 6**2)
    assert abs(enclosed_area(first[0])) == pytest.approx(ring / 4, rel=3e-3)
    assert abs(enclosed_area(second[0])) == pytest.approx(3 * ring / 4, rel=3e-3)
    assert first[0].min() > -0.02  # from +gx to +gy
    assert abs(enclosed_area(triangle[0])) == pytest.approx(18, rel=3e-3)
    whole = lines(described(lidar_scene(rx={"a": SECTOR | {"shape": "ring"}}))["pixel_outlines"])[0]
    assert len(whole) == 2
    assert abs(sum(enclosed_area(line) for line in whole)) == pytest.approx(ring, rel=3e-3)


def test_arcs_are_smooth_and_texts_short(lidar_scene):
    text = described(lidar_scene(rx={"layout": "1x1"}))["pixel_outlines"]
    ((line,),) = lines(text)
    np.testing.assert_allclose(np.hypot(*line.T), HALF, rtol=1e-3)
    chords = np.hypot(*np.diff(line, axis=0).T)
    assert chords.max() < 2.5  # the sagitta of such a chord is a thousandth of the diameter
    assert len(text) < 2500


def test_beam_outlines_are_where_the_irradiance_says(lidar_scene):
    shape = {"divergence_mrad": 12.0, "divergence_across_mrad": 4.0, "ellipse_deg": 90.0}
    rim, outer = json.loads(described(lidar_scene(tx=shape))["beam_outlines"])
    for outline, share, scale in ((rim, np.exp(-0.5), 1), (outer, np.exp(-2), 2)):
        assert outline["share"] == pytest.approx(share, abs=1e-4)
        (line,) = lines(json.dumps([outline["lines"]]))[0]
        # Turned by 90 degrees: the long axis, half of 12 mrad, lies along gy.
        np.testing.assert_allclose(np.hypot(line[:, 0] / 2, line[:, 1] / 6), scale, rtol=5e-3)
    (edge,) = json.loads(described(lidar_scene(tx={"beam_profile": "top_hat"}))["beam_outlines"])
    assert edge["share"] == 1
    np.testing.assert_allclose(np.hypot(*np.reshape(edge["lines"][0], (-1, 2)).T), 5, rtol=1e-3)


def test_targets_are_described_and_bottoms_are_not(lidar_scene):
    turn = mi.ScalarTransform4f().translate([0.5, 1, -5]).rotate([0, 0, 1], 45).scale(float(np.sqrt(0.5)))
    extra = {
        "ball": {"type": "sphere", "center": [-1, 2, -6], "radius": 0.5},
        "plate": {"type": "rectangle", "to_world": turn},
        "box": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([1, -1, -7]).scale([0.5, 1, 0.25])},
        "far_away": {"type": "sphere", "center": [50, 0, -6]},
    }
    targets = json.loads(described(lidar_scene(extra=extra))["target_outlines"])
    by_depth = {round(target["z"][1], 2): np.reshape(target["line"], (-1, 2)) for target in targets}
    assert sorted(by_depth) == [-6.75, -5.5, -5.0]
    np.testing.assert_allclose(np.hypot(*(by_depth[-5.5] - [-1, 2]).T), 0.5, rtol=5e-3)
    corners = {tuple(np.round(point, 2)) for point in by_depth[-5.0]}
    assert corners == {(1.5, 1.0), (-0.5, 1.0), (0.5, 2.0), (0.5, 0.0)}
    np.testing.assert_allclose([by_depth[-6.75].min(axis=0), by_depth[-6.75].max(axis=0)], [[0.5, -2], [1.5, 0]])


def test_upright_plate_is_a_line(lidar_scene):
    upright = mi.ScalarTransform4f().translate([0, 0, -6]).rotate([1, 0, 0], 90)
    extra = {"plate": {"type": "rectangle", "to_world": upright}}
    (target,) = json.loads(described(lidar_scene(extra=extra))["target_outlines"])
    np.testing.assert_allclose(np.sort(np.unique(np.reshape(target["line"], (-1, 2))[:, 0])), [-1, 1], atol=1e-3)
    np.testing.assert_allclose(target["z"], [-7, -5], atol=1e-3)


def test_pixels_are_drawn_on_the_sea_in_their_colours(lidar_scene):
    """Far is up and +y to the right; far and near edges lie 3.41 and 3.38 m from the shot, the sides 3.19 m."""
    figure = plot_layout(result(described(lidar_scene())))
    shapes = patches(figure)
    assert [int(np.argmax(to_rgb(shape.get_edgecolor()))) for shape in shapes[:3]] == [0, 1, 2]
    vertices = [shape.get_path().vertices for shape in shapes]
    for index, (sign_y, edge) in enumerate([(-1, HALF), (1, HALF), (-1, -HALF), (1, -HALF)]):
        y, x = vertices[index].T
        assert x[np.argmax(np.abs(x))] == pytest.approx(on_sea(edge), rel=3e-3)
        assert y[np.argmax(np.abs(y))] == pytest.approx(sign_y * 0.015 * 200 / np.cos(np.radians(20)), rel=3e-3)
    assert on_sea(HALF) == pytest.approx(3.416, abs=1e-3)
    ax = figure.axes[0]
    assert ax.get_aspect() == 1
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts == ["p0", "p1", "p2", "p3", "beam, e$^{-1/2}$", "beam, e$^{-2}$"]


def test_azimuth_is_up_wherever_the_lidar_stands(lidar_scene):
    """From a laser that looks towards -y the far edge is at negative y, and is still drawn on top."""
    pose = {"to_world": mi.ScalarTransform4f().look_at([0, 72.794, 200], [0, 0, 0], [0, 0, 1])}
    figure = plot_layout(result(described(lidar_scene(tx=pose, rx=pose))))
    top = max(shape.get_path().vertices[:, 1].max() for shape in patches(figure))
    assert top == pytest.approx(on_sea(HALF), rel=3e-3)
    assert patches(figure)[0].get_path().vertices[:, 1].min() > -0.02
    assert figure.axes[0].get_ylabel() == "along (m), away from the lidar"


def test_imager_cells_lie_on_the_sea_with_their_energy(lidar_scene):
    attributes = {"field_of_view_mrad": 30.0, "field_of_view_shape": "circle"}
    attributes |= described(lidar_scene(rx={"layout": "6x6"}))
    assert "pixel_outlines" not in attributes
    figure = plot_layout(result(attributes, 6, (2, 3), 1e-15 * np.arange(6)))
    (mesh,) = (item for item in figure.axes[0].collections if isinstance(item, QuadMesh))
    corners = mesh.get_coordinates()
    assert corners.shape == (3, 4, 2)
    # Corner (0, 0) is far at -gy, and the middle row of corners passes through the shot.
    assert corners[0, 0, 0] < 0 < corners[0, 0, 1]
    np.testing.assert_allclose(corners[1, :, 1], 0, atol=1e-9)
    np.testing.assert_allclose(mesh.get_array().ravel(), np.arange(6), atol=1e-12)
    assert figure.axes[1].get_xlabel() == "received energy (fJ)"


def test_grazing_views_are_stretched_and_say_so():
    attributes = {"altitude": 15.0, "off_nadir_deg": 84.6, "field_of_view_mrad": 20.0, "field_of_view_shape": "circle"}
    ax = plot_layout(result(attributes)).axes[0]
    assert ax.get_aspect() == "auto"
    assert ax.get_xlabel() == "y (m), out of scale"


def test_older_results_show_what_they_know(tmp_path):
    """Dots at the centres, and the whole field of view where it is known."""
    figure = plot_layout(result({}), tmp_path / "a.png")
    (dots,) = (item for item in figure.axes[0].collections if isinstance(item, PathCollection))
    y, x = dots.get_offsets().T
    np.testing.assert_allclose(x, on_sea(np.arange(4)), rtol=1e-3, atol=1e-9)
    assert np.all(np.diff(y) < 0)
    assert (tmp_path / "a.png").stat().st_size > 1000
    figure = plot_layout(result({"field_of_view_mrad": 30.0, "field_of_view_shape": "square"}))
    assert figure.axes[0].lines[0].get_xdata().max() == pytest.approx(3.2, abs=0.05)


def test_files_hold_all_that_is_drawn(lidar_scene, tmp_path):
    attributes = described(lidar_scene(extra={"ball": {"type": "sphere", "center": [0, 0, -6], "radius": 0.5}}))
    drawn = []
    for suffix in (".nc", ".exr"):
        results.save(result(attributes), tmp_path / f"a{suffix}")
        done = CliRunner().invoke(app, ["plot", str(tmp_path / f"a{suffix}"), "--layout"])
        assert (done.exit_code, done.stdout) == (0, f"{tmp_path / 'a_layout.png'}\n")
        drawn.append((tmp_path / "a_layout.png").read_bytes())
    assert drawn[0] == drawn[1]


def test_long_texts_are_left_out(lidar_scene, tmp_path):
    """256 pixels of a circle have outlines that NetCDF could not keep together with other attributes."""
    attributes = described(lidar_scene(rx={"layout": "16x16", "imager": False}))
    assert all(len(value) <= 60_000 for value in attributes.values())
    results.save(result(attributes, 256), tmp_path / "a.nc")
    plot_layout(results.open(tmp_path / "a.nc"))
    assert "pixel_outlines" not in described(lidar_scene(rx={"layout": "20x20", "imager": False}))


def test_refusals(tmp_path):
    nowhere = result({})
    del nowhere.attrs["altitude"]
    with pytest.raises(UserError, match="no altitude and off_nadir_deg among its attributes"):
        plot_layout(nowhere)
    with pytest.raises(UserError, match="does not tell what its pixels see"):
        plot_layout(result({"off_nadir_deg": 100.0, "field_of_view_mrad": 30.0}))
    with pytest.raises(UserError, match=r"must end in \.png, \.pdf or \.svg"):
        plot_layout(result({}), tmp_path / "a.txt")
    results.save(result({}), tmp_path / "a.nc")
    done = CliRunner().invoke(app, ["plot", str(tmp_path / "a.nc"), "--layout", "--log"])
    assert done.exit_code == 2
    assert "--layout does not go with --log or --linear" in done.output
