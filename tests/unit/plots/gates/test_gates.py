"""Figures and animations of gate stacks and of images by daylight: contents, positions and colours."""

import numpy as np
import pytest
from figure_inputs import frames, stack
from PIL import Image
from rows import must_refuse

from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots.gates.echoes import plot_depths
from mitransient_lidar.plots.gates.images import (
    animate_gates,
    animate_passive,
    colour_scale,
    plot_gates,
    reached_by_surface,
)

ROWS, COLUMNS = 4, 5


def make(gates=12, energy=None, **options):
    """Return a stack; without energies, gate k holds (k + 1) fJ in every pixel."""
    made = stack(gates=gates, **options)
    if energy is None:
        energy = np.broadcast_to(1e-15 * (1 + np.arange(gates)), made["gate_energy"].shape).copy()
    dims = made["gate_energy"].dims
    return made.assign(gate_energy=(dims, energy), gate_energy_stderr=(dims, 0.01 * energy))


def images(figure):
    return [ax.get_images()[0] for ax in figure.axes if ax.get_images()]


@pytest.mark.slow
def test_surface_echo_does_not_darken_the_rest():
    made = make(16)
    # A pulse of 5 ns reaches gates that open less than 7.5 ns after the surface: 0, 1 and 2.
    made["gate_energy"][..., :3] = 1e-10
    figure = plot_gates(made)
    image = images(figure)[0]
    assert (image.norm.vmin, image.norm.vmax) == (0.0, pytest.approx(16.0))
    label = figure.axes[-1].get_xlabel()
    assert label == "energy in the gate (fJ); 19 % of the values, including the surface echo, are brighter"  # 3 of 16

    # Without the time of the surface: one gate in ten may be brighter than the scale.
    made = make(21)
    made["gate_energy"][..., 1] = 1e-10
    del made.attrs["surface_time_ns"]
    assert images(plot_gates(made))[0].norm.vmax == pytest.approx(20.0)


def test_bright_spot_of_less_than_a_hundredth_of_the_image_is_clipped():
    rng = np.random.default_rng(5)
    energy = 1e-15 * rng.random((40, 40, 4))
    energy[0, :9] = 1e-12  # 9 of 1600 pixels
    dims = ("row", "column", "gate")
    made = make(4).drop_vars(["gate_energy", "gate_energy_stderr", "angle_x", "angle_y"])
    made = made.assign(gate_energy=(dims, energy), gate_energy_stderr=(dims, 0.01 * energy))
    scale = colour_scale(made, log=False)
    assert scale.norm.vmax * scale.factor < 1.001e-15
    assert scale.extend == "max"


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


def test_depth_map_begins_below_the_latest_surface_of_lit_pixels():
    """One row has its surface 5 ns later than the mean, and a dark pixel 50 ns later, which does not count."""
    made = stack(np.full((ROWS, COLUMNS), 4.0), gates=60)
    times, share = np.full((ROWS, COLUMNS), 1420.0), np.ones((ROWS, COLUMNS))
    times[0], times[1, 0], share[1, 0] = 1420.0 + 5, 1420.0 + 50, 0.0
    dims = ("row", "column")
    found = reached_by_surface(made.assign_coords(surface_time=(dims, times), beam_share=(dims, share)))
    start = made["gate_start"].values
    np.testing.assert_array_equal(found, start < 1420.0 + 5 + 7.5)


def test_depth_map_of_frames_leaves_out_weak_and_saturated_echoes():
    """The echoes of 1e-15 J saturate the camera, and those of 1e-19 J give it less than a photoelectron."""
    made = stack(np.full((ROWS, COLUMNS), 4.0), gates=60)
    for factor, shown in ((1.0, False), (1e-2, True), (1e-4, False)):
        dimmed = made.assign(
            gate_energy=factor * made["gate_energy"], gate_energy_stderr=0 * made["gate_energy_stderr"]
        )
        depth = images(plot_depths(detect_waveforms(dimmed, "icmos", shots=2, seed=1)))[0].get_array()
        assert np.isfinite(np.ma.filled(depth, np.nan)).any() == shown


def test_depth_map_needs_three_gates_with_depths(tmp_path):
    made = stack(np.full((ROWS, COLUMNS), 3.0), gates=60)
    with pytest.raises(
        UserError, match=r"1 of 60 gates lie below from_depth = 5\.6 m, but a drawing of depths needs at least 3"
    ):
        plot_depths(made, tmp_path / "a.png", from_depth=5.6)
    must_refuse("0 of 3 gates lie below the surface echo", plot_depths, make(3), tmp_path / "a.png")
    must_refuse("no gate_depth", plot_depths, made.drop_vars("gate_depth"), tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []


def test_animation_shows_the_frames_in_their_time(tmp_path):
    radiances = frames()
    animate_passive(radiances, tmp_path / "a.gif")
    animate_passive(radiances.isel(column=slice(None, None, -1)), tmp_path / "turned.gif")
    assert (tmp_path / "turned.gif").read_bytes() == (tmp_path / "a.gif").read_bytes()
    with Image.open(tmp_path / "a.gif") as movie:
        assert (movie.n_frames, movie.info["duration"], movie.info["loop"]) == (3, 250, 0)
        assert movie.size == (400, 320)  # 8 x 8 points a pixel, for a width of at least 384
        shown = []
        for index in range(3):
            movie.seek(index)
            shown.append(np.asarray(movie.convert("L"))[4::8, 4::8])
    assert shown[0][1, 2] == shown[1][3, 4] == 255
    assert np.corrcoef(shown[2].ravel(), radiances["radiance"][2].values.ravel())[0, 1] > 0.99
