"""Elements shared by the figures, and views of results."""

import os
import webbrowser
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from command_line import assert_refused, run
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rows import each_row, must_refuse

from mitransient_lidar import results
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.plots import drawing


def image(rows, columns):
    angle_x, angle_y = np.meshgrid(6.0 - 4.0 * np.arange(rows), -3.0 * np.arange(columns), indexing="ij")
    return xr.Dataset(coords={"angle_x": (("row", "column"), angle_x), "angle_y": (("row", "column"), angle_y)})


@each_row(
    (4, 5, (1.5, -13.5, -8.0, 8.0)),
    # The pixels of a single row or column are square.
    (1, 3, (1.5, -7.5, 4.5, 7.5)),
    (3, 1, (2.0, -2.0, -4.0, 8.0)),
    (1, 1, (0.5, -0.5, 5.5, 6.5)),
)
def test_extent_reaches_half_a_pixel_beyond_the_centres(rows, columns, extent):
    assert drawing.image_extent(image(rows, columns)) == pytest.approx(extent)
    assert drawing.image_extent(image(rows, columns).transpose("column", "row")) == pytest.approx(extent)


def test_images_are_pictures_taken_from_the_lidar_in_any_order_of_their_pixels():
    """Far is up and +angle_y left."""
    pictures = []
    values = np.arange(20.0).reshape(4, 5)
    for order in ({}, {"column": slice(None, None, -1)}, {"row": slice(None, None, -1)}):
        figure = Figure()
        canvas = FigureCanvasAgg(figure)
        ax = figure.subplots()
        one = image(4, 5).assign(values=(("row", "column"), values)).isel(order)
        drawing.draw_image(ax, one["values"].values, one, cmap="gray")
        assert (ax.get_xlim(), ax.get_ylim()) == ((1.5, -13.5), (-8.0, 8.0))
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("to the left, angle_y (mrad)", "away from nadir, angle_x (mrad)")
        canvas.draw()
        pictures.append(np.asarray(canvas.buffer_rgba())[..., 0])
    # Older versions of Matplotlib put the pixels where cells meet into either of them.
    assert np.mean(pictures[0] != pictures[1]) < 0.01
    assert np.mean(pictures[0] != pictures[2]) < 0.01
    # The values 0 (far left), 4 (far right) and 15 (near left) from black to white, in the picture's rows from the top.
    places = ax.transData.transform([(0.0, 6.0), (-12.0, 6.0), (0.0, -6.0)])
    grey = [int(pictures[0][len(pictures[0]) - 1 - int(y), int(x)]) for x, y in places]
    assert grey == pytest.approx([255 * value / 19 for value in (0, 4, 15)], abs=3)
    assert places[0, 0] < places[1, 0]
    assert places[0, 1] > places[2, 1]


@each_row(
    (3.2e-6, 1e-6, "µ"), (999.0, 1.0, ""), (1000.0, 1e3, "k"), (2e-21, 1e-18, "a"), (5e12, 1e9, "G"), (0.0, 1.0, "")
)
def test_prefixes_scale_to_between_1_and_1000(largest, factor, prefix):
    assert drawing.si_prefix(largest) == (pytest.approx(factor, rel=1e-12, abs=0), prefix)


def test_bands_end_at_the_lowest_value():
    ax = Figure().subplots()
    x, y, error = np.arange(3.0), np.array([1.0, 2.0, 3.0]), np.array([0.5, 2.5, 0.5])
    drawing.draw_band(ax, x, y, error, lowest=0.1, color="red")
    band = ax.collections[0].get_paths()[0].vertices
    ends = [(band[band[:, 0] == time, 1].min(), band[band[:, 0] == time, 1].max()) for time in x]
    np.testing.assert_allclose(ends, [(0.5, 1.5), (0.1, 4.5), (2.5, 3.5)])
    np.testing.assert_array_equal(ax.collections[0].get_facecolor()[0, :3], [1, 0, 0])


@each_row(
    # 6 % of the window of 50 ns on both sides, within the record.
    ({"window_start_ns": 20.0, "window_end_ns": 70.0}, (17.0, 73.0)),
    ({"window_start_ns": 1.0, "window_end_ns": 101.0}, (0.0, 100.0)),
    ({"window_start_ns": 200.0, "window_end_ns": 300.0}, (0.0, 100.0)),
    ({"window_start_ns": 20.0}, (0.0, 100.0)),
    ({}, (0.0, 100.0)),
)
def test_time_limits_contain_the_window_of_the_echoes(attributes, limits):
    record = xr.Dataset(coords={"time": 0.5 + np.arange(100)}, attrs={"bin_width_ns": 1.0, **attributes})
    assert drawing.time_limits(record) == pytest.approx(limits)


def test_figures_replace_a_file_only_on_success(tmp_path):
    path = tmp_path / "a.png"
    path.write_text("before")
    figure = drawing.new_figure(path, 2.0, 1.0)
    figure.set_layout_engine("none")
    figure.draw = lambda *_, **__: (_ for _ in ()).throw(OSError(28, "No space left on device"))
    must_refuse(r"cannot write .*a\.png: No space left on device", drawing.save, figure, path)
    assert (path.read_text(), len(list(tmp_path.iterdir()))) == ("before", 1)
    must_refuse(r"must end in \.png, \.pdf or \.svg", drawing.new_figure, tmp_path / "a.gif", 2.0, 1.0)


@pytest.fixture
def result():
    power = np.random.default_rng(1).uniform(1, 2, (2, 20))
    return results.build(
        *(power, 0.1 * power, power, 0.1 * power),
        time=TimeAxis(1400.0, 1.0, 20),
        pixel_names=["near", "far"],
        pixel_centres_mrad=[[-1.0, 0.0], [1.0, 0.0]],
        attributes={"scene": 'a "quoted" scene'},
    )


@pytest.fixture
def opened(monkeypatch, tmp_path):
    """Addresses that a browser was asked to open, of which there is one if the list is empty."""
    addresses = []
    monkeypatch.setattr(webbrowser, "open", lambda address: addresses.append(address) or len(addresses) == 1)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return addresses


def test_the_command_opens_a_page(result, opened, tmp_path):
    results.save(result, tmp_path / "shot.nc")
    done = run("view", tmp_path / "shot.nc")
    assert (done.exit_code, done.stderr) == (0, "")
    path = Path(done.stdout.strip())
    assert opened == [path.as_uri()]
    assert "<title>a &quot;quoted&quot; scene · waveforms</title>" in path.read_text(encoding="utf-8")
    # Without a browser.
    done = run("view", tmp_path / "shot.nc", "-o", tmp_path / "new" / "shot.html")
    assert done.exit_code == 0
    assert done.stdout == f"{tmp_path / 'new' / 'shot.html'}\n"
    assert done.stderr == "no browser was found: open the page in one.\n"
    done = run("view", tmp_path / "shot.nc", "-o", tmp_path / "shot.html", "--no-browser")
    assert (done.exit_code, done.stderr, len(opened)) == (0, "", 2)


def test_the_command_refuses_what_it_cannot_show(result, opened, tmp_path):
    results.save(result, tmp_path / "shot.nc")
    assert_refused(
        run("view", tmp_path / "shot.nc", "-o", tmp_path / "shot.txt"), "must end in .png, .pdf or .svg, or .html"
    )
    assert_refused(run("view", tmp_path / "shot.nc", "--shot", 2), "--shot 2 needs a series of shots")
    result.drop_vars(list(result.data_vars)).to_netcdf(tmp_path / "empty.nc", engine="h5netcdf")
    assert_refused(run("view", tmp_path / "empty.nc"), "empty.nc")
    assert opened == []
    assert {path.name for path in tmp_path.iterdir()} == {"shot.nc", "empty.nc"}


def test_temporary_pages_of_former_calls_are_removed(result, opened, tmp_path):
    paths = [Path(run("view", file).stdout.strip()) for file in [saved(result, tmp_path)] * 2]
    assert all(path.is_file() for path in paths)
    old = paths[0].stat().st_mtime - 3700
    os.utime(paths[0].parent, (old, old))
    (tmp_path / "mine").mkdir()
    link = tmp_path / "mitransient-lidar-view-link"
    link.symlink_to(tmp_path / "mine")
    os.utime(link, (old, old), follow_symlinks=False)
    paths.append(Path(run("view", tmp_path / "shot.nc").stdout.strip()))
    assert [path.parent.exists() for path in paths] == [False, True, True]
    assert (tmp_path / "mine").is_dir()


def saved(result, folder):
    results.save(result, folder / "shot.nc")
    return folder / "shot.nc"
