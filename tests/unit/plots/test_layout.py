"""Figure of a layout: positions on the sea, colours and labels."""

import json

import mitsuba as mi
import numpy as np
import pytest
from command_line import run
from figure_inputs import result
from matplotlib.image import imread
from matplotlib.patches import PathPatch

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots.layout import axis_points, plot_layout
from mitransient_lidar.rendering.describe import describe_layout
from mitransient_lidar.transport.probe import Probe
from mitransient_lidar.transport.scene_parts import find_lidar_scene

HALF = 15.0  # mrad


def described(scene):
    return describe_layout(Probe(find_lidar_scene(scene, scene.sensors()[0])))


def on_sea(angle_x_mrad):
    """Distance along the azimuth [m] of a ray in the plane of incidence, from the angle it makes with the vertical."""
    return 200 * (np.tan(np.radians(20) + np.arctan(1e-3 * angle_x_mrad)) - np.tan(np.radians(20)))


def patches(figure):
    """Return the filled shapes of the pixels."""
    return [patch for patch in figure.axes[0].patches if isinstance(patch, PathPatch)]


def test_targets_beside_the_view_are_drawn_whole(lidar_scene):
    target = {"id": "plate", "z": [-1.0, -1.0], "line": [2, -6, 8, -6, 8, 6, 2, 6], "seen": [2, -6, 8, -6, 8, 6, 2, 6]}
    figure = plot_layout(result(**described(lidar_scene()), target_outlines=json.dumps([target])))
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
    figure = plot_layout(result(**described(lidar_scene(tx=pose, rx=pose))))
    top = max(shape.get_path().vertices[:, 1].max() for shape in patches(figure))
    assert top == pytest.approx(on_sea(HALF), rel=3e-3)
    assert patches(figure)[0].get_path().vertices[:, 1].min() > -0.02
    assert figure.axes[0].get_ylabel() == "away from the lidar (m); +x points 90° to the left"


def under_water(angle_x_mrad, z):
    """Distance along the azimuth [m] of a ray in the plane of incidence at a height, by Snell's law."""
    theta = np.radians(20) + np.arctan(1e-3 * np.asarray(angle_x_mrad))
    return on_sea(angle_x_mrad) - z * np.tan(np.arcsin(np.sin(theta) / 1.34))


@pytest.mark.slow
def test_pixels_and_beam_are_drawn_at_the_depths_of_target_and_bottom(lidar_scene):
    extra = {"ball": {"type": "sphere", "center": [1.5, 0.4, -6], "radius": 0.5}}
    figure = plot_layout(result(**described(lidar_scene(extra=extra))))
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
    assert axis_points(result(**attributes)) == [
        "mean sea level: axis at (0.000, 0.000, 0.000) m, laser at (0.000, 0.500, 0.000) m",
        "bottom: axis at (2.112, 0.000, -8.000) m, laser at (2.112, 0.500, -8.000) m",
    ]
    assert len(axis_points(result(**described(lidar_scene())))[0].split(",")) == 3


@pytest.mark.slow
def test_many_targets_share_three_planes(lidar_scene):
    heights = (-1.0, -1.02, -2.0, -5.0, -5.5, -7.0)
    extra = {f"b{i}": {"type": "sphere", "center": [0, 0, z], "radius": 0.2} for i, z in enumerate(heights)}
    names = [line.split(":")[0] for line in axis_points(result(**described(lidar_scene(extra=extra))))]
    assert names == ["mean sea level", "depth of b0, b1, b2", "depth of b3, b4", "depth of b5", "bottom"]


@pytest.mark.slow
def test_files_contain_everything_that_is_drawn(lidar_scene, tmp_path):
    attributes = described(lidar_scene(extra={"ball": {"type": "sphere", "center": [0, 0, -6], "radius": 0.5}}))
    drawn = []
    for suffix in (".nc", ".exr"):
        results.save(result(**attributes), tmp_path / f"a{suffix}")
        done = run("view", tmp_path / f"a{suffix}", "--layout", "--overwrite")
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
    results.save(result(**attributes), tmp_path / "a.nc")
    assert "pixel_outlines" not in described(lidar_scene(rx={"layout": "20x20", "imager": False}))


def test_invalid_results_are_rejected(tmp_path):
    nowhere = result()
    del nowhere.attrs["altitude"]
    with pytest.raises(UserError, match="no altitude and off_nadir_deg among its attributes"):
        plot_layout(nowhere)
    with pytest.raises(UserError, match=r"off_nadir_deg = 100 must lie between 0 and 89\.9"):
        plot_layout(result(off_nadir_deg=100.0))
    upwards = {f"{name}_pose": [0.0, 0, 200, 0, 0, 1, 1, 0, 0, 0, -1, 0] for name in ("receiver", "transmitter")}
    with pytest.raises(UserError, match="no pixels that look at the sea"):
        plot_layout(result(**upwards))
    with pytest.raises(UserError, match=r"must end in \.png, \.pdf or \.svg"):
        plot_layout(result(), tmp_path / "a.txt")
    results.save(result(), tmp_path / "a.nc")
    done = run("view", tmp_path / "a.nc", "--layout", "--log")
    assert done.exit_code == 2
    assert "--layout does not go with --log or --linear" in done.output
