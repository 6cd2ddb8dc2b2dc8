"""The page of gates and waveforms as a user sees it, in a real browser."""

import os
import re
import shutil
import time as clock

import matplotlib
import numpy as np
import pytest
import xarray as xr

from mitransient_lidar.plots.gate_viewer.page import rounded

PLAIN = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹−", "-0123456789-")  # of signs in labels

BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
needs_browser = pytest.mark.skipif(
    # Where CI has installed them, skipping would hide a failure.
    (BROWSER is None or DRIVER is None) and os.environ.get("BROWSER_TESTS") != "required",
    reason="chromium and chromedriver are needed",
)


class Page:
    """Actions of a user on the page, and its visible contents."""

    def __init__(self, browser):
        self.browser = browser
        self.run = browser.execute_script

    def wait(self, script):
        end = clock.monotonic() + 10
        while not self.run(script):
            assert clock.monotonic() < end, script
            clock.sleep(0.02)

    def settle(self):
        """Wait until changes are drawn: three frames after a change of size."""
        self.browser.execute_async_script(
            "const wait = (more) => (more ? requestAnimationFrame(() => wait(more - 1)) : arguments[0]()); wait(3)"
        )

    def choose(self, **values):
        for name, value in values.items():
            self.run(
                "const control = document.getElementById(arguments[0]);"
                "if (control.type === 'checkbox') control.checked = arguments[1]; else control.value = arguments[1];"
                "control.dispatchEvent(new Event('input')); control.dispatchEvent(new Event('change'))",
                name.replace("_", "-"),
                value,
            )
        self.settle()

    def press(self, key):
        from selenium.webdriver import ActionChains

        ActionChains(self.browser, duration=0).send_keys(key).perform()
        self.settle()

    def point(self, name, across, along, click=True, key=None):
        """Move the mouse to a place given as shares of an element's width and height, and click there."""
        from selenium.webdriver import ActionChains

        element = self.browser.find_element("id", name)
        size = element.rect
        actions = ActionChains(self.browser, duration=0)
        if key:
            actions.key_down(key)
        actions.move_to_element_with_offset(
            element, round((across - 0.5) * size["width"]), round((along - 0.5) * size["height"])
        )
        if click:
            actions.click()
        if key:
            actions.key_up(key)
        actions.perform()
        self.settle()

    def text(self, name):
        return self.browser.find_element("id", name).text

    def colours(self, rows, columns):
        """Return the image's colours, array of shape (row, column, 3), read from the middles of its pixels."""
        colours = self.run(
            "const [rows, columns] = arguments, canvas = document.getElementById('pixels'), found = [];"
            # Chromium warns about repeated reading of a canvas without willReadFrequently.
            "const copy = new OffscreenCanvas(canvas.width, canvas.height);"
            "const context = copy.getContext('2d', { willReadFrequently: true }); context.drawImage(canvas, 0, 0);"
            "const dots = context.getImageData(0, 0, canvas.width, canvas.height);"
            "for (let r = 0; r < rows; r++) for (let c = 0; c < columns; c++) {"
            "  const x = Math.floor((c + 0.5) * canvas.width / columns);"
            "  const y = Math.floor((r + 0.5) * canvas.height / rows);"
            "  found.push(...dots.data.subarray(4 * (y * canvas.width + x), 4 * (y * canvas.width + x) + 3)); }"
            "return found",
            rows,
            columns,
        )
        return np.array(colours).reshape(rows, columns, 3)

    def peaks(self):
        """Return the largest value of every line drawn, read from its value axis."""
        ticks = self.run(
            "return [...document.querySelectorAll('#curve-plot .value-tick')]"
            ".map((tick) => [Number(tick.getAttribute('y')) - 4, tick.textContent])"
        )
        ticks = [(y, float(re.sub("^10(?=[⁻⁰¹²³⁴⁵⁶⁷⁸⁹])", "1e", text).translate(PLAIN))) for y, text in ticks]
        paths = self.run(
            "return [...document.querySelectorAll('#curve-plot path.line:not(.bars)')]"
            ".map((line) => line.getAttribute('d'))"
        )
        (first, low), (last, high) = ticks[0], ticks[-1]
        layer_tops = [min(float(y) for y in re.findall(r" ([-\d.]+)", path)) for path in paths]
        shares = [(top - first) / (last - first) for top in layer_tops]
        if self.run("return document.getElementById('curve-log').checked"):
            return [low * (high / low) ** share for share in shares]
        return [low + (high - low) * share for share in shares]


def expected_colours(values, low, high, name, log=False):
    """Return the colours of values between the lowest and the highest of a map."""
    values = values.astype(np.float32).astype(float)
    share = np.log(values / low) / np.log(high / low) if log else (values - low) / (high - low)
    index = np.clip(np.floor(256 * share), 0, 255).astype(int)
    return matplotlib.colormaps[name](index, bytes=True)[..., :3]


METRES_PER_NS = 0.0299792458 * 5 / 1.364 * 0.967  # the depth axis at 20 degrees off nadir
SURFACE_NS = 1420.0
SIZE = 64  # rows and columns
PLATE, BALL, SAND = (40, 26), (23, 41), (50, 43)  # pixels on them


def scene_of(size, gates=40, seed=3):
    """Return (stack, render) of a sphere and a plate over rippled sand, lit by a Gaussian beam."""
    rng = np.random.default_rng(seed)
    time = 1411.0 + np.arange(120)
    angles = (np.arange(size) + 0.5) / size * 30 - 15
    angle_y, angle_x = np.meshgrid(angles[::-1], angles[::-1])
    x, y = 0.21 * angle_x[..., np.newaxis], 0.21 * angle_y[..., np.newaxis]
    depth = (time - SURFACE_NS) * METRES_PER_NS
    ripples = np.sin(2 * np.pi * (0.8 * x + 0.25 * y) / 0.7)
    floor, reflectance = 8 + 0.06 * ripples + 0.04 * x, 0.1 + 0.035 * ripples + 0.01 * np.sin(1.7 * x - 0.9 * y)
    ball = 0.7**2 - (x - 0.9) ** 2 - (y + 1.1) ** 2
    floor = np.where(ball > 0, 6.4 - np.sqrt(np.maximum(ball, 0)), floor)
    reflectance = np.where(ball > 0, 0.36 * np.sqrt(np.maximum(ball, 0)), reflectance)
    across, along = 0.94 * (x + 0.7) + 0.34 * (y - 1.2), -0.34 * (x + 0.7) + 0.94 * (y - 1.2)
    plate = (abs(across) < 0.75) & (abs(along) < 0.75)
    floor = np.where(plate, 5.5 + 0.2 * across, floor)
    reflectance = np.where(plate, 0.2 + 0.1 * ((across > 0) ^ (along > 0)), reflectance)
    waves = 0.15 * np.sin(1.1 * x + 0.6 * y) + 0.05 * np.sin(4.1 * x - 2.3 * y + 1)
    water = 1 / (1 + np.exp((waves - depth) / 0.09)) / (1 + np.exp((depth - floor) / 0.09))
    power = 0.006 * water * np.exp(-0.4 * np.maximum(depth, 0))
    power += 0.3 * reflectance * np.exp(-0.4 * floor - 0.5 * ((depth - floor) / 0.22) ** 2)
    power += 0.003 * np.exp(3 * np.sin(5 * x + 3 * np.cos(3 * y)) - 0.5 * ((depth - waves) / 0.22) ** 2)
    power *= 1e-6 * np.exp(-(x**2 + y**2) / (2 * 1.4**2)) * (1 + 0.06 * rng.standard_normal(power.shape))
    start = 1412.0 + 2.5 * np.arange(gates)
    opened = np.clip(np.minimum(time[:, None] + 0.5, start + 5) - np.maximum(time[:, None] - 0.5, start), 0, 1)
    energy = 1e-9 * power @ opened
    centres = {
        "angle_x": (("row", "column"), angle_x, {"units": "mrad"}),
        "angle_y": (("row", "column"), angle_y, {"units": "mrad"}),
    }
    attributes = {"scene": "sphere & <b>plate", "note": "</script><script>document.title = 'broken'</script>"}
    attributes |= {"altitude": 200.0, "off_nadir_deg": 20.0, "pulses": 1, "surface_time_ns": SURFACE_NS, "seed": seed}
    gate_coords = {
        "gate": np.arange(gates),
        "gate_start": ("gate", start),
        "gate_width": ("gate", np.full(gates, 5.0)),
        "gate_depth": ("gate", (start + 2.5 - SURFACE_NS) * METRES_PER_NS),
    }
    dims = ("row", "column", "gate")
    stack = xr.Dataset(
        # As the page has them.
        {"gate_energy": (dims, rounded(energy, 0.03 * energy)), "gate_energy_stderr": (dims, 0.03 * energy)},
        centres | gate_coords,
        attributes,
    )
    dims = ("row", "column", "time")
    result = xr.Dataset({"waveform": (dims, power), "waveform_stderr": (dims, 0.06 * power)}, centres | {"time": time})
    return stack, result


def point_at(page, pixel, **how):
    page.point("pixels", (pixel[1] + 0.5) / SIZE, (pixel[0] + 0.5) / SIZE, **how)
