"""The page of gates and waveforms as a user sees it, in a real browser."""

import os
import re
import shutil
import time as clock

import matplotlib
import numpy as np
import pytest

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
