"""Page of waveforms in a real browser: shapes of pixels, selection by a click, and views over time."""

import json

import numpy as np
import pytest
import xarray as xr
from browser_page import needs_browser

pytestmark = [pytest.mark.slow, needs_browser]

BINS, START_NS = 60, 1400.5
NAMES = ["far", "ring", "centre"]


def circle(radius):
    """Return a circle as a line angle_x, angle_y, ... [mrad]."""
    angle = np.linspace(0, 2 * np.pi, 61)[:-1]
    return (radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).ravel().tolist()


@pytest.fixture(scope="module")
def waveforms():
    """A result of a rectangle above a ring, with a pixel in the hole of the ring."""
    time = START_NS + np.arange(BINS)
    peaks = np.array([20, 30, 40])
    power = 1e-6 * np.array([3.0, 1.0, 2.0])[:, None] * np.exp(-0.5 * ((np.arange(BINS) - peaks[:, None]) / 2.0) ** 2)
    outlines = [[[6, 4, 6, -4, 9, -4, 9, 4]], [circle(5.0), circle(2.0)], [circle(2.0)]]
    return xr.Dataset(
        {"waveform": (("pixel", "time"), power, {"units": "W"}), "waveform_stderr": (("pixel", "time"), 0.1 * power)},
        {"pixel": NAMES, "time": time, "angle_x": ("pixel", [7.5, 0.0, 0.0]), "angle_y": ("pixel", [0.0, 0.0, 0.0])},
        {"scene": "ring", "time_start_ns": START_NS - 0.5, "bin_width_ns": 1.0, "pixel_outlines": json.dumps(outlines)},
    )


def share(page, angle_x, angle_y):
    """Return the place of an angle as shares of the width and height of the map."""
    axes = page.run("return JSON.parse(document.getElementById('metadata').textContent)")["axes"]
    across = (angle_y - axes["left"]) / (axes["across"] * len(NAMES))
    return across, (axes["top"] - angle_x) / axes["along"]


def test_a_click_on_a_pixel_shows_its_waveform(show, waveforms):
    page = show(waveforms)
    assert page.text("summary") == "3 pixels · 60 time bins"
    # (6, 0) to (9, 0) is the rectangle, 3.5 is in the ring to the left, 1 in its hole.
    for number, place in enumerate([(7.5, 1.0), (0.0, 3.5), (-1.0, 0.5)]):
        page.point("pixels", *share(page, *place))
        assert page.text("reading").startswith(f"{NAMES[number]}: ")
        peak = float(waveforms["waveform"].isel(pixel=number).max())
        assert page.peaks() == pytest.approx([1e6 * peak], rel=0.01)
        band = page.run("return document.querySelector('#curve-plot .own .band').getAttribute('d').length")
        assert band > 100
    # Beside all pixels, a click keeps the selection.
    page.point("pixels", *share(page, 5.5, 4.5))
    assert page.text("reading").startswith("centre: ")
    # A click on the waveform goes to its time bin.
    page.point("curve-plot", 0.5, 0.5)
    time = float(page.text("moment").split()[1])
    number = int(page.text("number").split()[0])
    assert abs(START_NS + number - time) <= 0.5 + 0.01
    assert page.text("caption") == f"Time bin {number} · {1400 + number}.00 to {1401 + number}.00 ns"


def test_signals_have_their_unit_and_no_energy(show, waveforms):
    """Of two shots the page shows the mean."""
    volts = np.stack([1e3 * waveforms["waveform"].values, 3e3 * waveforms["waveform"].values])
    recorded = xr.Dataset(
        {
            "signal": (("shot", "pixel", "time"), volts, {"units": "V"}),
            "signal_deviation": (("pixel", "time"), np.full(volts.shape[1:], 1e-3)),
        },
        waveforms.coords | {"shot": [0, 1]},
        {**waveforms.attrs, "pixel_outlines": "[]"},
    )
    page = show(recorded)
    page.choose(slider=20)
    assert page.text("notes") == "The waveforms are means over 2 shots."
    assert "recorded signal (mV)" in page.run("return document.getElementById('curve-plot').textContent")
    options = page.run("return [...document.getElementById('view').options].map((option) => option.textContent)")
    assert options == ["recorded signal at the time", "depth of the strongest echo", "mean depth of the energy"]
    page.point("pixels", 0.5 / 3, 0.5)
    # The error of the mean of two records of 1 mV.
    assert page.text("reading") == "far: 6.00 ± 0.71 mV"
