"""Draw scene.png: the page of a scene in a browser, without its controls.

    python docs/images/draw_scene.py gated_mine

It needs chromium and chromedriver.
"""

import io
import shutil
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image
from selenium import webdriver

from mitransient_lidar.plots.viewer import view_scene

#: Sides of the picture in pixels of the page [1], of which the file has twice as many, and longest wait [s].
SIZE, PATIENCE_S = (800, 560), 60.0

#: The drawing fills the page, and its parts have short names in one row.
ALONE = """
document.querySelectorAll("header, footer").forEach((part) => part.remove());
document.documentElement.style.overflow = "hidden";
document.body.style.padding = 0;
const plot = document.getElementById("plot");
Object.assign(plot.style, { margin: 0, height: "100vh" });
const { eye } = plot._fullLayout.scene.camera;
const nearer = Object.fromEntries(Object.entries(eye).map(([axis, value]) => [axis, 0.93 * value]));
const hidden = plot.data.map((trace) => /laser|receiver|lines/.test(trace.name));
Plotly.restyle(plot, { showlegend: plot.data.map((trace, i) => !hidden[i] && trace.showlegend !== false) });
Plotly.relayout(plot, {
  "scene.camera.eye": nearer, "font.size": 13, "legend.x": 0.5, "legend.xanchor": "center", width: innerWidth,
  height: innerHeight,
});
"""


def picture(scene):
    """Return the picture of a scene."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for argument in ("--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader"):
        options.add_argument(argument)
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
    metrics = {"width": SIZE[0], "height": SIZE[1], "deviceScaleFactor": 2, "mobile": False}
    with tempfile.TemporaryDirectory() as folder:
        page = view_scene(scene).save(Path(folder) / "scene.html")
        try:
            browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
            browser.get(page.as_uri())
            end = time.monotonic() + PATIENCE_S
            while not browser.execute_script("return document.body.dataset.ready"):
                if time.monotonic() > end:
                    sys.exit("the page has drawn nothing")
                time.sleep(0.1)
            browser.execute_script(ALONE)
            time.sleep(5.0)
            return Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
        finally:
            browser.quit()


if __name__ == "__main__":
    drawn = picture(*sys.argv[1:])
    drawn.save(Path(__file__).with_name("scene.png"), optimize=True)
