"""Figures and animations of gate stacks: contents, positions and colours."""

import math
import stat
import sys

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from PIL import Image

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots.gates.echoes import plot_depths
from mitransient_lidar.plots.gates.images import animate_gates, colour_scale, plot_gates, reached_by_surface

SURFACE_NS, STEP_NS, WIDTH_NS = 1420.0, 5.0, 5.0
METRES_PER_NS = 0.1
ROWS, COLUMNS = 4, 5


def make(gates=12, energy=None, pixels=False, attributes=()):
    """Return a stack whose first gate opens 5 ns before the surface echo; by default gate k holds (k + 1) fJ."""
    start = SURFACE_NS + STEP_NS * (np.arange(gates) - 1)
    shape, dims = ((3,), ("pixel",)) if pixels else ((ROWS, COLUMNS), ("row", "column"))
    if energy is None:
        energy = np.broadcast_to(1e-15 * (1 + np.arange(gates)), (*shape, gates)).copy()
    angle_x, angle_y = np.meshgrid(6.0 - 4.0 * np.arange(ROWS), 3.0 * (2 - np.arange(COLUMNS)), indexing="ij")
    coords = {
        "gate": np.arange(gates),
        "gate_start": ("gate", start),
        "gate_width": ("gate", np.full(gates, WIDTH_NS)),
        "gate_depth": ("gate", (start + WIDTH_NS / 2 - SURFACE_NS) * METRES_PER_NS),
        "angle_x": (dims, angle_x[:3, 0] if pixels else angle_x),
        "angle_y": (dims, angle_y[:3, 0] if pixels else angle_y),
    }
    coords |= {"pixel": ["near", "middle", "far"]} if pixels else {}
    variables = {"gate_energy": ((*dims, "gate"), energy), "gate_energy_stderr": ((*dims, "gate"), 0.01 * energy)}
    known = {"scene": "sand.xml", "surface_time_ns": SURFACE_NS, "pulse_fwhm_ns": 5.0, "pulses": 20}
    return xr.Dataset(variables, coords, known | dict(attributes))


def images(figure):
    return [ax.get_images()[0] for ax in figure.axes if ax.get_images()]


def colour_at(figure, ax, x, y):
    """Return the colour (red, green, blue) at a position in the axes."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba())
    column, row = ax.transData.transform((x, y))
    return picture[picture.shape[0] - 1 - int(row), int(column), :3]


def test_contact_sheet_shows_every_gate_at_its_position():
    stack = make()
    figure = plot_gates(stack)
    drawn = images(figure)
    assert len(drawn) == 12
    for k, image in enumerate(drawn):
        np.testing.assert_allclose(image.get_array(), np.full((ROWS, COLUMNS), k + 1.0))  # fJ
        assert image.get_extent() == [7.5, -7.5, -8.0, 8.0]
        assert image.norm is drawn[0].norm
    # Gate 5 opens 20 ns after the surface; its middle is 22.5 ns or 2.25 m below it.
    assert drawn[5].axes.get_title() == "#5  2.25 m\n1440.0 to 1445.0 ns"
    assert drawn[0].axes.get_title() == "#0  -0.25 m\n1415.0 to 1420.0 ns"
    assert figure.get_suptitle() == "sand: 12 gates of 5 ns, 20 pulses"
    assert (figure.get_supxlabel(), figure.get_supylabel()) == (
        "to the left, angle_y (mrad)",
        "away from nadir, angle_x (mrad)",
    )
    assert figure.axes[-1].get_xlabel() == "energy in the gate (fJ)"  # of the colour bar


@pytest.mark.slow
def test_far_row_is_on_top_and_left_is_left():
    energy = np.full((ROWS, COLUMNS, 4), 1e-18)
    energy[0, 0] = 1e-15
    figure = plot_gates(make(4, energy))
    ax = images(figure)[2].axes
    assert colour_at(figure, ax, 6.0, 6.0).sum() > 600  # far, on the left
    for angle_x, angle_y in ((6.0, -6.0), (-6.0, 6.0), (-6.0, -6.0)):
        assert colour_at(figure, ax, angle_y, angle_x).sum() < 30
    assert ax.transData.transform((0, 6.0))[1] > ax.transData.transform((0, -6.0))[1]
    assert ax.transData.transform((6.0, 0))[0] < ax.transData.transform((-6.0, 0))[0]


@pytest.mark.slow
def test_surface_echo_does_not_darken_the_rest():
    stack = make(16)
    # A pulse of 5 ns reaches gates that open less than 7.5 ns after the surface: 0, 1 and 2.
    stack["gate_energy"][..., :3] = 1e-10
    figure = plot_gates(stack)
    image = images(figure)[0]
    assert (image.norm.vmin, image.norm.vmax) == (0.0, pytest.approx(16.0))
    label = figure.axes[-1].get_xlabel()
    assert label == "energy in the gate (fJ); 19 % of the values, including the surface echo, are brighter"  # 3 of 16

    # Without the time of the surface: one gate in ten may be brighter than the scale.
    stack = make(21)
    stack["gate_energy"][..., 1] = 1e-10
    del stack.attrs["surface_time_ns"]
    assert images(plot_gates(stack))[0].norm.vmax == pytest.approx(20.0)


def test_bright_spot_of_less_than_a_hundredth_of_the_image_is_clipped():
    rng = np.random.default_rng(5)
    energy = 1e-15 * rng.random((40, 40, 4))
    energy[0, :9] = 1e-12  # 9 of 1600 pixels
    dims = ("row", "column", "gate")
    stack = make(4).drop_vars(["gate_energy", "gate_energy_stderr", "angle_x", "angle_y"])
    stack = stack.assign(gate_energy=(dims, energy), gate_energy_stderr=(dims, 0.01 * energy))
    scale = colour_scale(stack, log=False)
    assert scale.norm.vmax * scale.factor < 1.001e-15
    assert scale.extend == "max"


@pytest.mark.slow
def test_logarithmic_colours():
    energy = np.full((ROWS, COLUMNS, 6), 1e-15)
    energy[..., 3], energy[..., 4] = 1e-20, 0.0
    energy[0, 0, 5] = np.nan
    figure = plot_gates(make(6, energy), log=True)
    drawn = images(figure)
    norm = drawn[0].norm
    assert isinstance(norm, LogNorm)
    assert norm.vmax / norm.vmin == pytest.approx(1000.0)
    # Zero is dark, not missing; NaN is grey.
    assert colour_at(figure, drawn[4].axes, 0.0, 2.0).sum() < 30
    np.testing.assert_allclose(colour_at(figure, drawn[5].axes, 6.0, 6.0), 153, atol=1)


@pytest.mark.slow
@pytest.mark.parametrize(("gates", "shown"), [(36, 36), (37, 19), (64, 32), (200, 34), (1, 1)])
def test_at_most_36_gates_evenly(gates, shown):
    drawn = images(plot_gates(make(gates)))
    numbers = [int(image.axes.get_title().split()[0].lstrip("#")) for image in drawn]
    assert len(numbers) == shown
    assert set(np.diff(numbers)) <= {math.ceil(gates / 36)}
    assert [image.get_array()[0, 0] for image in drawn] == pytest.approx([number + 1.0 for number in numbers])  # fJ


@pytest.mark.slow
def test_written_sheet_is_wide_enough(tmp_path):
    plot_gates(make(2), tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.width == 1536
        assert picture.convert("RGB").getpixel((2, 2)) == (255, 255, 255)


def test_unknown_depth_is_left_out():
    figure = plot_gates(make(2).drop_vars("gate_depth"))
    assert images(figure)[1].axes.get_title() == "#1\n1420.0 to 1425.0 ns"


def test_pixels_are_lines_over_depth():
    stack = make(pixels=True)
    stack["gate_energy"][1] *= 3
    for log in (False, True):
        ax = plot_gates(stack, log=log).axes[0]
        near, middle, _ = ax.get_lines()
        np.testing.assert_allclose(near.get_xdata(), stack["gate_depth"])
        np.testing.assert_allclose(near.get_ydata(), 1.0 + np.arange(12))
        np.testing.assert_allclose(middle.get_ydata(), 3.0 * (1 + np.arange(12)))
        assert [text.get_text() for text in ax.get_legend().get_texts()] == ["near", "middle", "far"]
        assert ax.get_yscale() == ("log" if log else "linear")
        assert ax.get_ylabel() == "energy in the gate (fJ)"


@pytest.mark.slow
def test_gif_has_one_frame_a_gate(tmp_path):
    energy = np.full((ROWS, COLUMNS, 5), 1e-18)
    for k in range(5):
        energy[:, k, k] = 1e-15  # a bright column that moves to the right
    animate_gates(make(5, energy), tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as movie:
        assert movie.n_frames == 5
        frames = []
        for k in range(5):
            movie.seek(k)
            assert 100 <= movie.info["duration"] <= 150
            frames.append(np.asarray(movie.convert("RGB"), dtype=int))
    assert frames[0].shape == (540, 840, 3)
    # The bright column moves by a fifth of the image's width (about 340 of the 840 points) a frame.
    bright = [np.flatnonzero(frame[210, 100:450].sum(axis=-1) > 600) for frame in frames]
    assert np.diff([columns.mean() for columns in bright[1:4]]) == pytest.approx([68, 68], abs=7)
    # The text below the colour bar does not move.
    assert ((frames[1][500:] < 128) == (frames[3][500:] < 128)).all()
    assert (frames[1][500:] < 128).any()


FAKE_FFMPEG = """#!/bin/sh
for last; do :; done
cat > "$last"
exit {status}
"""


@pytest.fixture
def fake_ffmpeg(tmp_path):
    """Replace ffmpeg by a program that stores the raw frames."""

    def install(status):
        program = tmp_path / "ffmpeg"
        program.write_text(FAKE_FFMPEG.format(status=status))
        program.chmod(program.stat().st_mode | stat.S_IXUSR)
        return mpl.rc_context({"animation.ffmpeg_path": str(program)})

    return install


@pytest.mark.long
def test_mp4_passes_every_frame_to_ffmpeg(tmp_path, fake_ffmpeg):
    with fake_ffmpeg(status=0):
        animate_gates(make(3), tmp_path / "a.mp4")
    assert (tmp_path / "a.mp4").stat().st_size == 3 * 840 * 540 * 4  # raw frames


@pytest.mark.slow
def test_mp4_needs_no_program_besides_the_extra(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    animate_gates(make(3), tmp_path / "a.mp4")
    assert (tmp_path / "a.mp4").read_bytes()[4:8] == b"ftyp"  # the first box of an MP4 file


@pytest.mark.long
def test_failing_or_missing_ffmpeg(tmp_path, fake_ffmpeg, monkeypatch):
    with fake_ffmpeg(status=3), pytest.raises(UserError, match=r"a\.mp4: ffmpeg ended with the error 3"):
        animate_gates(make(3), tmp_path / "a.mp4")
    missing = {"animation.ffmpeg_path": str(tmp_path / "none")}
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with mpl.rc_context(missing), pytest.raises(UserError, match=r"needs the program ffmpeg.*choose \.gif"):
        animate_gates(make(3), tmp_path / "a.mp4")
    assert [path.name for path in tmp_path.iterdir()] == ["ffmpeg"]


def echoes(depths, gates=60, surface=100.0):
    """Return a stack with a Gaussian echo at each depth above an exponential column, and a stronger surface echo."""
    start = SURFACE_NS + STEP_NS / 5 * (np.arange(gates) - 5)
    middle = (start + WIDTH_NS / 2 - SURFACE_NS) * METRES_PER_NS
    energy = np.exp(-((middle - depths[..., np.newaxis]) ** 2) / (2 * 0.25**2)) + 0.2 * np.exp(-0.2 * middle)
    energy += surface * np.exp(-(middle**2) / (2 * 0.25**2))
    dims = ("row", "column", "gate") if depths.ndim == 2 else ("pixel", "gate")
    stack = make(gates, pixels=depths.ndim == 1)
    stack = stack.assign_coords(gate_start=("gate", start), gate_depth=("gate", middle))
    return stack.assign(gate_energy=(dims, 1e-15 * energy), gate_energy_stderr=(dims, np.full(energy.shape, 1e-17)))


def test_depth_map_shows_the_depth_below_the_surface():
    truth = np.linspace(3.0, 4.0, ROWS * COLUMNS).reshape(ROWS, COLUMNS)
    stack = echoes(truth)
    # One pixel without an echo: noise of 1 % of an echo on the column.
    alone = 0.2e-15 * np.exp(-0.2 * stack["gate_depth"].values)
    stack["gate_energy"][3, 4] = alone + 1e-17 * np.random.default_rng(2).normal(size=alone.size)
    figure = plot_depths(stack)
    depth, confidence = (image.get_array() for image in images(figure)[:2])
    inside = np.ones((ROWS, COLUMNS), dtype=bool)
    inside[3, 4] = False
    np.testing.assert_allclose(depth[inside], truth[inside], atol=0.03)  # a third of a gate's step
    assert confidence[inside].min() > 0.999
    assert confidence[3, 4] < 0.99
    np.testing.assert_array_equal(images(figure)[0].get_alpha(), confidence)
    assert images(figure)[0].get_extent() == [7.5, -7.5, -8.0, 8.0]
    # The first gate that opens 7.5 ns after the surface or later is at 8 + 2.5 ns.
    assert figure.get_suptitle() == "sand: depth of the strongest echo, gates at 1.05 to 5.65 m on the axis"
    bar = next(ax for ax in figure.axes if ax.get_ylabel() == "depth (m)")
    assert bar.get_ylim()[0] > bar.get_ylim()[1]  # deep below


def test_depth_map_begins_below_the_latest_surface_of_lit_pixels():
    """One row has its surface 5 ns later than the mean, and a dark pixel 50 ns later, which does not count."""
    stack = echoes(np.full((ROWS, COLUMNS), 4.0))
    times, share = np.full((ROWS, COLUMNS), SURFACE_NS), np.ones((ROWS, COLUMNS))
    times[0], times[1, 0], share[1, 0] = SURFACE_NS + 5, SURFACE_NS + 50, 0.0
    dims = ("row", "column")
    found = reached_by_surface(stack.assign_coords(surface_time=(dims, times), beam_share=(dims, share)))
    start = stack["gate_start"].values
    np.testing.assert_array_equal(found, start < SURFACE_NS + 5 + 7.5)


def test_depth_map_of_pixels():
    truth = np.array([3.0, 3.5, 4.2])
    upper, lower = plot_depths(echoes(truth)).axes
    drawn = [container.lines[0].get_ydata()[0] for container in upper.containers]
    np.testing.assert_allclose(drawn, truth, atol=0.03)
    assert [label.get_text() for label in lower.get_xticklabels()] == ["near", "middle", "far"]
    assert [bar.get_height() for bar in lower.patches] == pytest.approx([1.0] * 3, abs=1e-3)
    assert upper.yaxis_inverted()


def test_depth_map_needs_three_gates_with_depths(tmp_path):
    stack = echoes(np.full((ROWS, COLUMNS), 3.0))
    with pytest.raises(
        UserError, match=r"1 of 60 gates lie below from_depth = 5\.6 m, but a drawing of depths needs at least 3"
    ):
        plot_depths(stack, tmp_path / "a.png", from_depth=5.6)
    with pytest.raises(UserError, match="0 of 3 gates lie below the surface echo"):
        plot_depths(make(3), tmp_path / "a.png")
    with pytest.raises(UserError, match="no gate_depth"):
        plot_depths(stack.drop_vars("gate_depth"), tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_wrong_files_and_datasets(tmp_path):
    for draw in (plot_gates, plot_depths):
        with pytest.raises(UserError, match=r"must end in \.png, \.pdf or \.svg"):
            draw(make(), tmp_path / "a.gif")
        with pytest.raises(UserError, match="no gate stack"):
            draw(make().drop_vars("gate_energy"), tmp_path / "a.png")
    with pytest.raises(UserError, match=r"animation must end in \.gif or \.mp4"):
        animate_gates(make(), tmp_path / "a.png")
    with pytest.raises(UserError, match="this stack has 3 single pixels; draw its contact sheet"):
        animate_gates(make(pixels=True), tmp_path / "a.gif")
    with pytest.raises(UserError, match="No such file"):
        plot_gates(make(1), tmp_path / "missing" / "a.png")


def test_the_label_of_a_sheet_is_below_its_ticks():
    angle_x, angle_y = np.meshgrid(np.linspace(15, -15, 8), np.linspace(15, -15, 8), indexing="ij")
    stack = make(12, energy=np.ones((ROWS, COLUMNS, 12))).isel(row=[0] * 8, column=[0] * 8)
    stack = stack.assign_coords(angle_x=(("row", "column"), angle_x), angle_y=(("row", "column"), angle_y))
    figure = plot_gates(stack)
    FigureCanvasAgg(figure).draw()
    ticks = [text.get_window_extent().y0 for ax in figure.axes[8:12] for text in ax.get_xticklabels()]  # the last row
    label = next(text for text in figure.texts if text.get_text().startswith("to the left")).get_window_extent()
    assert label.y1 < min(ticks)
