"""Figures of the signal of a target: curves, gate and maps."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_hex

from mitransient_lidar.plots.studies.target_signal import plot_target_map, plot_target_signal

NAMES = ["red", "green", "blue", "black"]
TIME = 1400 + np.arange(100.0)


def test_target_is_drawn_with_its_background_and_alone():
    background = 1e-6 * np.exp(-np.arange(100) / 20) * np.arange(1, 5)[:, np.newaxis]
    signal = 1e-7 * np.exp(-(((TIME - 1450) / 4) ** 2)) * np.arange(1, 5)[:, np.newaxis]
    over_time = ("pixel", "time")
    data = {"waveform": background + signal, "background": background, "difference": signal}
    data |= {"difference_stderr": 0.1 * signal}
    found = xr.Dataset(
        {name: (over_time, values) for name, values in data.items()}
        | {"combined_detectability": ("combination", [2.0, 3.0])},
        {"pixel": NAMES, "time": TIME},
        {"scene": "made", "gate_start_ns": 1440.0, "gate_end_ns": 1460.0},
    )
    upper, lower = plot_target_signal(found).axes
    solid, dashed = upper.lines[:8:2], upper.lines[1:8:2]
    for i in range(4):
        np.testing.assert_allclose(solid[i].get_ydata(), 1e6 * (background + signal)[i])
        np.testing.assert_allclose(dashed[i].get_ydata(), 1e6 * background[i])
        np.testing.assert_allclose(lower.lines[i].get_ydata(), 1e6 * signal[i])
        assert dashed[i].is_dashed()
        assert not solid[i].is_dashed()
        colours = {to_hex(line.get_color()) for line in (solid[i], dashed[i], lower.lines[i])}
        assert len(colours) == 1
    assert [text.get_text() for text in upper.get_legend().get_texts()] == [*NAMES, "without the target"]
    # The band of the last pixel: 0.4 µW +- 10 %.
    assert lower.collections[3].get_paths()[0].vertices[:, 1].max() == pytest.approx(0.44, rel=1e-3)
    assert (upper.get_yscale(), lower.get_yscale()) == ("log", "linear")
    assert (upper.get_ylabel(), lower.get_ylabel()) == ("received power (µW)", "signal of the target (µW)")
    for ax in (upper, lower):
        assert (ax.patches[0].get_x(), ax.patches[0].get_width()) == (1440, 20)
    assert upper.get_title() == "made: best weighting: 1.50 times the SNR of the sum"


def test_maps_have_a_panel_a_pixel_and_one_of_the_gain():
    echo = np.random.default_rng(1).uniform(0, 1, (3, 2, 4))
    whole, gain = echo.sum(axis=-1), np.array([[1.0, 1.2], [1.4, 1.6], [1.8, 2.0]])
    place = ("target_x", "target_y")
    maps = xr.Dataset(
        {
            "echo": ((*place, "pixel"), echo),
            "combined_echo": (("combination", *place), [whole, whole]),
            "combined_detectability": (("combination", *place), [np.full((3, 2), 5.0), 5.0 * gain]),
        },
        {"pixel": NAMES, "combination": ["sum", "best"], "target_x": [-1.0, 0.0, 1.0], "target_y": [-2.0, 2.0]},
    )
    panels = [ax for ax in plot_target_map(maps).axes if ax.get_xlabel() == "target_y (m)"]
    assert [ax.get_title() for ax in panels] == [*(f"{name} (%)" for name in NAMES), "SNR, best / sum"]
    for i, ax in enumerate(panels):
        (image,) = ax.images
        expected = gain if i == 4 else 100 * echo[..., i] / whole
        np.testing.assert_allclose(image.get_array(), expected)
        assert image.get_clim() == ((1.0, 2.0) if i == 4 else (0.0, 100.0))
        assert (image.origin, image.get_extent()) == ("lower", [-4.0, 4.0, -1.5, 1.5])
        assert ax.get_xlim() == (4.0, -4.0)  # seen from above with +x up, +y is on the left
        numbers = {text.get_position(): text.get_text() for text in ax.texts}
        # Along y is across the panel: the text at (2, -1) is that of target_x = -1, target_y = 2.
        assert numbers[2.0, -1.0] == (f"{expected[0, 1]:.2f}" if i == 4 else f"{expected[0, 1]:.0f}")
