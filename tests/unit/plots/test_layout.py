"""Figure of a layout: positions on the sea, colours and labels."""

import mitsuba as mi
import numpy as np
import pytest
from figure_inputs import result
from matplotlib.patches import PathPatch

from mitransient_lidar.plots.layout import plot_layout
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
    return [patch for patch in figure.axes[0].patches if isinstance(patch, PathPatch)]


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
