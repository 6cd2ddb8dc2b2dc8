"""Figure of a layout: positions on the sea, colours and labels."""

import json

import mitsuba as mi
import numpy as np
import pytest
from command_line import run
from matplotlib.collections import PathCollection, QuadMesh
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from matplotlib.patches import PathPatch

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.plots.layout import axis_points, plot_layout
from mitransient_lidar.rendering.describe import describe_layout
from mitransient_lidar.transport.scene_parts import find_lidar_scene

HALF = 15.0  # mrad


def described(scene):
    return describe_layout(find_lidar_scene(scene, scene.sensors()[0]))


def result(attributes, pixels=4, grid=None, energy=None, centres=None):
    values = np.full((pixels, 3), 1e-15) if energy is None else np.outer(energy, [0, 1, 0])
    return results.build(
        values,
        values,
        values,
        values,
        time=TimeAxis(0, 1, values.shape[1]),
        pixel_names=[f"p{index}" for index in range(pixels)],
        pixel_centres_mrad=centres or [(index, -index) for index in range(pixels)],
        grid=grid,
        attributes={"altitude": 200.0, "off_nadir_deg": 20.0, "refractive_index": 1.34, **attributes},
    )


def on_sea(angle_x_mrad):
    """Distance along the azimuth [m] of a ray in the plane of incidence, from the angle it makes with the vertical."""
    return 200 * (np.tan(np.radians(20) + np.arctan(1e-3 * angle_x_mrad)) - np.tan(np.radians(20)))


def patches(figure):
    """Return the filled shapes of the pixels."""
    return [patch for patch in figure.axes[0].patches if isinstance(patch, PathPatch)]


def test_pixels_are_drawn_on_the_sea_in_their_colours(lidar_scene):
    """Far is up and +y to the left; far and near edges lie 3.41 and 3.38 m from the shot, the sides 3.19 m."""
    figure = plot_layout(result(described(lidar_scene())))
    shapes = patches(figure)
    assert [int(np.argmax(to_rgb(shape.get_edgecolor()))) for shape in shapes[:3]] == [0, 1, 2]
    vertices = [shape.get_path().vertices for shape in shapes]
    for index, (sign_y, edge) in enumerate([(1, HALF), (-1, HALF), (1, -HALF), (-1, -HALF)]):
        y, x = vertices[index].T
        assert x[np.argmax(np.abs(x))] == pytest.approx(on_sea(edge), rel=3e-3)
        assert y[np.argmax(np.abs(y))] == pytest.approx(sign_y * 0.015 * 200 / np.cos(np.radians(20)), rel=3e-3)
    assert on_sea(HALF) == pytest.approx(3.416, abs=1e-3)
    ax = figure.axes[0]
    left, right = ax.get_xlim()
    assert left > 0 > right
    assert ax.get_aspect() == 1
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["p0", "p1", "p2", "p3", "beam, e$^{-1/2}$", "beam, e$^{-2}$", "receiver's axis"]


def test_targets_beside_the_view_are_drawn_whole(lidar_scene):
    target = {"id": "plate", "z": [-1.0, -1.0], "line": [2, -6, 8, -6, 8, 6, 2, 6], "seen": [2, -6, 8, -6, 8, 6, 2, 6]}
    figure = plot_layout(result(described(lidar_scene()) | {"target_outlines": json.dumps([target])}))
    ax = figure.axes[0]
    left, right = ax.get_xlim()
    low, high = ax.get_ylim()
    assert left > 6
    assert right < -6
    # The view reaches 3.4 m from the shot.
    assert low < -3.4
    assert high > 8


def test_azimuth_points_up_for_every_direction_of_the_lidar(lidar_scene):
    """From a laser that looks towards -y the far edge is at negative y, and is still drawn on top."""
    pose = {"to_world": mi.ScalarTransform4f().look_at([0, 72.794, 200], [0, 0, 0], [0, 0, 1])}
    figure = plot_layout(result(described(lidar_scene(tx=pose, rx=pose))))
    top = max(shape.get_path().vertices[:, 1].max() for shape in patches(figure))
    assert top == pytest.approx(on_sea(HALF), rel=3e-3)
    assert patches(figure)[0].get_path().vertices[:, 1].min() > -0.02
    assert figure.axes[0].get_ylabel() == "away from the lidar (m); +x points 90° to the left"


@pytest.mark.slow
def test_imager_cells_lie_on_the_sea_with_their_energy(lidar_scene):
    attributes = {"field_of_view_mrad": 30.0, "field_of_view_shape": "circle"}
    attributes |= described(lidar_scene(rx={"layout": "6x6"}))
    assert "pixel_outlines" not in attributes
    centres = [(angle_x, angle_y) for angle_x in (7.5, -7.5) for angle_y in (10.0, 0.0, -10.0)]
    imager = result(attributes, 6, (2, 3), 1e-15 * np.arange(6), centres)
    figure = plot_layout(imager)
    (mesh,) = (item for item in figure.axes[0].collections if isinstance(item, QuadMesh))
    corners = mesh.get_coordinates()
    assert corners.shape == (3, 4, 2)
    # Corner (0, 0) is far at +angle_y, and the middle row of corners passes through the shot.
    assert np.all(corners[0, 0] > 0)
    assert corners[0, 0, 1] == pytest.approx(on_sea(15.0), rel=1e-2)
    assert corners[0, 0, 0] == pytest.approx(0.015 * 200 / np.cos(np.radians(20)), rel=0.02)
    np.testing.assert_allclose(corners[1, :, 1], 0, atol=1e-9)
    np.testing.assert_allclose(mesh.get_array().ravel(), np.arange(6), atol=1e-12)
    assert "received energy (fJ)" in [ax.get_xlabel() for ax in figure.axes]


def test_grazing_views_are_not_to_scale():
    attributes = {"altitude": 15.0, "off_nadir_deg": 84.6, "field_of_view_mrad": 20.0, "field_of_view_shape": "circle"}
    ax = plot_layout(result(attributes)).axes[0]
    assert ax.get_aspect() == "auto"
    assert ax.get_xlabel() == "y (m), not to scale"


def test_results_without_outlines_are_dots_and_the_field_of_view():
    """Results of earlier versions: dots at the centres, and the field of view if it is known."""
    figure = plot_layout(result({}))
    (dots,) = (item for item in figure.axes[0].collections if isinstance(item, PathCollection))
    y, x = dots.get_offsets().T
    np.testing.assert_allclose(x, on_sea(np.arange(4)), rtol=1e-3, atol=1e-9)
    assert np.all(np.diff(y) < 0)
    unknown_index = result({"bottom_point": [2.1, 0.0, -8.0], "refractive_index": float("nan")})
    assert len(plot_layout(unknown_index).axes) == 1
    figure = plot_layout(result({"field_of_view_mrad": 30.0, "field_of_view_shape": "square"}))
    assert figure.axes[0].lines[0].get_xdata().max() == pytest.approx(3.2, abs=0.05)


def under_water(angle_x_mrad, z):
    """Distance along the azimuth [m] of a ray in the plane of incidence at a height, by Snell's law."""
    theta = np.radians(20) + np.arctan(1e-3 * np.asarray(angle_x_mrad))
    return on_sea(angle_x_mrad) - z * np.tan(np.arcsin(np.sin(theta) / 1.34))


@pytest.mark.slow
def test_pixels_and_beam_are_drawn_at_the_depths_of_target_and_bottom(lidar_scene):
    extra = {"ball": {"type": "sphere", "center": [1.5, 0.4, -6], "radius": 0.5}}
    figure = plot_layout(result(described(lidar_scene(extra=extra))))
    assert [ax.get_title().splitlines()[0] for ax in figure.axes] == ["mean sea level", "depth of ball", "bottom"]
    for ax, z in zip(figure.axes, (0, -6, -8), strict=True):
        pixels = np.concatenate([patch.get_path().vertices for patch in ax.patches if isinstance(patch, PathPatch)])
        lines = {line.get_label(): np.transpose(line.get_data()) for line in ax.lines}
        assert pixels[:, 1].max() == pytest.approx(under_water(HALF, z), abs=4e-3)
        assert pixels[:, 1].min() == pytest.approx(under_water(-HALF, z), abs=4e-3)
        beam = lines["beam, e$^{-2}$"]
        assert beam[:, 1].max() == pytest.approx(under_water(10, z), abs=4e-3)
        np.testing.assert_allclose(lines["receiver's axis"], [[0, under_water(0, z)]], atol=1e-6)
    seen, true = (figure.axes[index].lines for index in (0, 1))
    (outline,) = (line for line in true if line.get_label() == "target")
    np.testing.assert_allclose(np.hypot(outline.get_xdata() - 0.4, outline.get_ydata() - 1.5), 0.5, rtol=5e-3)
    # From 200 m, the ball appears 1.58 m nearer than it is: its middle lies on the axis to 0.09 m.
    (outline,) = (line for line in seen if line.get_label().startswith("target"))
    middle = [0.5 * (np.min(values) + np.max(values)) for values in outline.get_data()]
    np.testing.assert_allclose(middle, [0.4, -0.084], atol=0.02)
    assert [text.get_text() for ax in figure.axes for text in ax.texts] == ["5.5 m", "5.5 m"]
    (shadow,) = (patch for patch in figure.axes[2].patches if patch.get_label() == "shadow of target")
    vertices = shadow.get_path().vertices
    assert 0.5 * (vertices[:, 1].min() + vertices[:, 1].max()) == pytest.approx(1.5 + 2.112 * 2 / 8, abs=0.05)


def test_axes_of_receiver_and_laser_are_printed(lidar_scene):
    """A laser that looks 0.5 m beside the receiver's axis has a point of its own on every plane."""
    attributes = described(lidar_scene(tx={"aim_y": 0.5}))
    assert axis_points(result(attributes)) == [
        "mean sea level: axis at (0.000, 0.000, 0.000) m, laser at (0.000, 0.500, 0.000) m",
        "bottom: axis at (2.112, 0.000, -8.000) m, laser at (2.112, 0.500, -8.000) m",
    ]
    assert len(axis_points(result(described(lidar_scene())))[0].split(",")) == 3


@pytest.mark.slow
def test_many_targets_share_three_planes(lidar_scene):
    heights = (-1.0, -1.02, -2.0, -5.0, -5.5, -7.0)
    extra = {f"b{i}": {"type": "sphere", "center": [0, 0, z], "radius": 0.2} for i, z in enumerate(heights)}
    names = [line.split(":")[0] for line in axis_points(result(described(lidar_scene(extra=extra))))]
    assert names == ["mean sea level", "depth of b0, b1, b2", "depth of b3, b4", "depth of b5", "bottom"]


def test_targets_of_earlier_versions_are_refracted_as_well():
    """Results without outlines as seen: the projection at the target's mean height, and no plane of the bottom."""
    line = [1.084, -0.5, 2.084, -0.5, 2.084, 0.5, 1.084, 0.5, 1.084, -0.5]
    targets = json.dumps([{"z": [-6.0, -6.0], "line": line}])
    figure = plot_layout(
        result({"target_outlines": targets, "field_of_view_mrad": 30.0, "field_of_view_shape": "circle"})
    )
    assert [ax.get_title().splitlines()[0] for ax in figure.axes] == ["mean sea level", "depth of target"]
    (outline,) = (line for line in figure.axes[0].lines if line.get_label().startswith("target"))
    middle = [0.5 * (np.min(values) + np.max(values)) for values in outline.get_data()]
    np.testing.assert_allclose(middle, [0, 0], atol=0.01)


@pytest.mark.slow
def test_files_contain_everything_that_is_drawn(lidar_scene, tmp_path):
    attributes = described(lidar_scene(extra={"ball": {"type": "sphere", "center": [0, 0, -6], "radius": 0.5}}))
    drawn = []
    for suffix in (".nc", ".exr"):
        results.save(result(attributes), tmp_path / f"a{suffix}")
        done = run("plot", tmp_path / f"a{suffix}", "--layout", "--overwrite")
        assert done.exit_code == 0
        assert done.stdout.splitlines() == [
            str(tmp_path / "a_layout.png"),
            "mean sea level: axis at (0.000, 0.000, 0.000) m",
            "depth of ball: axis at (1.584, 0.000, -6.000) m",
            "bottom: axis at (2.112, 0.000, -8.000) m",
        ]
        drawn.append(imread(tmp_path / "a_layout.png"))
    np.testing.assert_array_equal(*drawn)


@pytest.mark.long
def test_long_texts_are_left_out(lidar_scene, tmp_path):
    """256 pixels of a circle have outlines that NetCDF could not keep together with other attributes."""
    attributes = described(lidar_scene(rx={"layout": "16x16", "imager": False}))
    assert all(len(value) <= 60_000 for value in attributes.values())
    results.save(result(attributes, 256), tmp_path / "a.nc")
    plot_layout(results.open(tmp_path / "a.nc"))
    assert "pixel_outlines" not in described(lidar_scene(rx={"layout": "20x20", "imager": False}))


def test_invalid_results_are_rejected(tmp_path):
    nowhere = result({})
    del nowhere.attrs["altitude"]
    with pytest.raises(UserError, match="no altitude and off_nadir_deg among its attributes"):
        plot_layout(nowhere)
    with pytest.raises(UserError, match=r"off_nadir_deg = 100 must lie between 0 and 89\.9"):
        plot_layout(result({"off_nadir_deg": 100.0, "field_of_view_mrad": 30.0}))
    upwards = {f"{name}_pose": [0.0, 0, 200, 0, 0, 1, 1, 0, 0, 0, -1, 0] for name in ("receiver", "transmitter")}
    with pytest.raises(UserError, match="no pixels that look at the sea"):
        plot_layout(result({**upwards, "field_of_view_mrad": 30.0}))
    with pytest.raises(UserError, match=r"must end in \.png, \.pdf or \.svg"):
        plot_layout(result({}), tmp_path / "a.txt")
    results.save(result({}), tmp_path / "a.nc")
    done = run("plot", tmp_path / "a.nc", "--layout", "--log")
    assert done.exit_code == 2
    assert "--layout does not go with --log or --linear" in done.output
