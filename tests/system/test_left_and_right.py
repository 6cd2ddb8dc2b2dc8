"""One order of arrays, files and pictures: that of a picture taken from the lidar, row 0 far and column 0 left.

The lidar looks towards +x, so that a target at +y is left of its line of sight.
"""

import numpy as np
import OpenImageIO
import pytest
from matplotlib.image import imread

import mitransient_lidar
from mitransient_lidar import results
from mitransient_lidar.analysis.gates.cut import cut_gates
from mitransient_lidar.physics.lidar.gate_train import GateTrain
from mitransient_lidar.plots.gates.images import plot_gates
from mitransient_lidar.plots.layout import plot_layout

#: A bright target at 3 m, far and to the left of the axis, over a level sea.
PLACE = {"target_x": 2.5, "target_y": 1.5, "target_depth": 3.0, "target_reflectance": 0.9, "spectrum": "flat"}
SIZE = 12


def rendered(layout):
    integrator = {"type": "lidar_merging", "paths_per_pass": 2**14, "photons_per_pass": 2**14}
    params = {**PLACE, "layout": layout}
    return mitransient_lidar.render("fig13_2x2", params=params, passes=6, seed=3, integrator=integrator)


def echo_ns(dataset):
    return dataset.attrs["surface_time_ns"] + 3.0 / 0.1077  # 0.1077 m/ns on the axis


def near_echo(dataset):
    """Return whether bins may hold the target's echo."""
    return np.abs(dataset["time"] - echo_ns(dataset)) < 8


@pytest.fixture(scope="module")
def imager():
    return rendered(f"{SIZE}x{SIZE}")


@pytest.fixture(scope="module")
def stack(imager):
    """Three gates, the second of which holds the target's echo."""
    start = np.floor(echo_ns(imager)) - 15
    return cut_gates(imager, GateTrain(start, 10.0, 10.0, 3))


def far_left_exceeds(image):
    """Return whether the far left quarter of an image is the brightest by far, and has the brightest pixel."""
    rows, columns = (size // 2 for size in image.shape)
    quarters = [image[:rows, :columns], image[:rows, columns:], image[rows:, :columns], image[rows:, columns:]]
    sums = [float(quarter.sum()) for quarter in quarters]
    return sums[0] > 1.5 * max(sums[1:]) and quarters[0].max() == image.max()


@pytest.mark.slow
def test_arrays(stack):
    """The difference of the halves in standard errors; errors of pixels, which share photons, add up at most."""
    energy, error = (stack[name].isel(gate=1) for name in ("gate_energy", "gate_energy_stderr"))
    assert far_left_exceeds(energy.values)
    left, right = (slice(0, SIZE // 2), slice(SIZE // 2, SIZE))
    difference = float(energy.isel(column=left).sum() - energy.isel(column=right).sum())
    assert difference > 5 * float(error.sum())
    # The echo's centre has the angles of the target as refracted by a level sea: 1.5 m to the left at 217 m.
    bright = energy.where(energy > 0.5 * energy.max(), 0)
    assert float((bright * stack["angle_y"]).sum() / bright.sum()) == pytest.approx(1e3 * 1.5 / 215.5, abs=1.5)
    assert np.all(np.diff(stack["angle_y"]) < 0)
    assert np.all(np.diff(stack["angle_x"], axis=0) < 0)


@pytest.mark.slow
def test_published_pixels():
    """Red is far and left, green far and right, blue and black are near."""
    shot = rendered("2x2")
    late = near_echo(shot)
    energy, error = (shot[name].where(late, 0).sum("time") for name in ("impulse_response", "impulse_response_stderr"))
    assert shot["pixel"].values.tolist() == ["red", "green", "blue", "black"]
    for other in ("green", "blue", "black"):
        difference = float(energy.sel(pixel="red") - energy.sel(pixel=other))
        assert difference > 5 * float(error.sel(pixel=["red", other]).sum())


@pytest.mark.slow
def test_exr_files_in_another_reader(imager, stack, tmp_path):
    results.save(imager, tmp_path / "a.exr")
    image = OpenImageIO.ImageInput.open(str(tmp_path / "a.exr"))
    names, values = image.spec().channelnames, np.asarray(image.read_image("float"))
    image.close()
    at = [names.index(f"bin{index:04d}.Y") for index in np.flatnonzero(near_echo(imager))]
    assert far_left_exceeds(values[..., at].sum(axis=-1))
    results.save(stack, tmp_path / "b.exr")
    image = OpenImageIO.ImageInput.open(str(tmp_path / "b.exr"))
    assert image.seek_subimage(1, 0)
    names, values = image.spec().channelnames, np.asarray(image.read_image("float"))
    image.close()
    assert far_left_exceeds(values[..., names.index("Y")])


@pytest.mark.slow
def test_pictures(stack, imager, tmp_path):
    """Written images: the second panel of the sheet, and the cells on the sea."""
    figure = plot_gates(stack, tmp_path / "a.png")
    picture = imread(tmp_path / "a.png")[..., :3]
    ax = [ax for ax in figure.axes if ax.get_images()][1]
    height, width = picture.shape[:2]
    box = ax.get_position()
    rows = slice(round(height * (1 - box.y1)) + 4, round(height * (1 - box.y0)) - 4)
    columns = slice(round(width * box.x0) + 4, round(width * box.x1) - 4)
    # Viridis rises in green from dark to bright.
    assert far_left_exceeds(picture[rows, columns, 1] ** 4)
    # On the sea, the brightest cell is drawn left of the axis.
    late = imager.where(near_echo(imager), 0)
    ax = plot_layout(late.assign_attrs(target_outlines="[]")).axes[0]
    (mesh,) = (item for item in ax.collections if item.get_array() is not None and item.get_array().size == SIZE**2)
    corners = mesh.get_coordinates()
    row, column = np.unravel_index(np.argmax(mesh.get_array()), (SIZE, SIZE))
    cell = corners[row : row + 2, column : column + 2].reshape(-1, 2).mean(axis=0)
    place, axis = ax.transData.transform([cell, (0.0, 0.0)])
    assert place[0] < axis[0]
    assert place[1] > axis[1]
