"""Page of gates in use: its size and loading time, on a phone, on paper, in a notebook, its files and its link."""

import base64
import io
import re

import numpy as np
import pytest
from browser_page import BALL, PLATE, SIZE, Page, needs_browser, point_at, scene_of
from PIL import Image

from mitransient_lidar.plots.gate_viewer.page import page_text
from mitransient_lidar.plots.viewer import view

pytestmark = [pytest.mark.slow, needs_browser]

PHONE = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}

#: Times [ms] from the start of the navigation at which a page says that it loads, shows a picture, and is complete.
WATCH = """
window.times = {};
const note = (name, is) => { if (is && !(name in times)) times[name] = performance.now(); };
new MutationObserver(() => {
  const main = document.querySelector("main");
  note("loading", document.getElementById("loading"));
  note("picture", main && !main.hidden);
  note("complete", main && main.getAttribute("aria-busy") === "false");
}).observe(document, { subtree: true, childList: true, attributes: true });
window.saved = [];
URL.createObjectURL = (blob) => { saved.push(blob); return "#"; };
HTMLAnchorElement.prototype.click = function () { this.name = this.download; saved.push(this.download); };
window.printed = [];
addEventListener("afterprint", () => printed.push(document.body.style.width));
"""


@pytest.fixture(scope="module")
def scene():
    return scene_of(SIZE)


@pytest.fixture
def watched(browser):
    script = browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": WATCH})
    yield browser
    browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", script)


@pytest.fixture
def phone(browser):
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", PHONE)
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True, "maxTouchPoints": 5})
    yield
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def touch(page, kind, *places):
    """Touch the canvas at places given as shares of its width and height."""
    left, top, width, height = page.run(
        "const box = byId('pixels').getBoundingClientRect(); return [box.left, box.top, box.width, box.height]"
    )
    points = [{"x": left + x * width, "y": top + y * height, "id": number} for number, (x, y) in enumerate(places)]
    page.browser.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": f"touch{kind}", "touchPoints": points})


def across(page):
    """Return angle_y at the left and the right edge of the image [mrad], as the page states it for pixels there."""
    found = []
    for share in (0.002, 0.998):
        page.run(
            "const canvas = byId('pixels'), { left, top, width, height } = canvas.getBoundingClientRect();"
            "const place = { clientX: left + arguments[0] * width, clientY: top + height / 2, pointerId: 99 };"
            "canvas.dispatchEvent(new PointerEvent('pointermove', place))",
            share,
        )
        page.settle()
        found.append(float(re.search(r"angle_y (\S+) mrad", page.text("reading"))[1].replace("−", "-")))
    return found


def files(page):
    """Return names and contents of the files that were offered."""
    page.wait("return saved.length >= 2")
    return page.browser.execute_async_script(
        "const done = arguments[0], [blob, name] = saved.splice(0), reader = new FileReader();"
        "reader.onload = () => done([name, reader.result]); reader.readAsDataURL(blob)"
    )


def test_a_large_page_is_small_and_soon_shown(watched, show):
    """An image of as many pixels as that of README's example, with its time bins."""
    stack, result = scene_of(128)
    result = result.isel(time=np.arange(260) % 120).assign_coords(time=1411.0 + np.arange(260))
    assert len(page_text(stack, result)) < 10e6
    page = show(stack, result)
    page.wait("return 'complete' in times")
    times = page.run("return times")
    assert times["loading"] < times["picture"] < times["complete"]
    assert times["picture"] < 2000
    assert page.run("return [byId('loading'), byId('source').value]") == [None, "waveform"]
    assert page.text("notes") == ""


def test_fingers_zoom_move_and_select(show, scene, phone):
    page = show(*scene)
    assert page.run("return [innerWidth, document.documentElement.scrollWidth]") == [390, 390]
    page.run("byId('pixels').scrollIntoView({ block: 'center' })")
    assert page.browser.find_element("id", "zoom-in").is_displayed()
    whole = across(page)
    touch(page, "Start", (0.45, 0.5))
    touch(page, "Start", (0.45, 0.5), (0.55, 0.5))
    for step in (0.05, 0.1, 0.15, 0.2, 0.25):
        touch(page, "Move", (0.45 - step, 0.5), (0.55 + step, 0.5))
    touch(page, "End")
    page.settle()
    near = across(page)
    # From a tenth to six tenths of the width.
    assert 4 < np.ptp(whole) / np.ptp(near) < 9
    scrolled = page.run("return scrollY")
    touch(page, "Start", (0.3, 0.5))
    for step in (0.1, 0.2, 0.3):
        touch(page, "Move", (0.3 + step, 0.5))
    touch(page, "End")
    page.settle()
    # The image follows the finger: what was left of it comes in, with larger angles.
    assert across(page)[0] > near[0]
    assert page.run("return scrollY") == scrolled
    page.browser.find_element("id", "zoom-reset").click()
    page.settle()
    assert across(page) == whole
    touch(page, "Start", ((PLATE[1] + 0.5) / SIZE, (PLATE[0] + 0.5) / SIZE))
    touch(page, "End")
    page.settle()
    assert "row 40, column 26" in page.text("list")
    assert "Tap a pixel" in page.text("hint")


def test_paper_has_picture_and_records_without_controls(watched, show, scene):
    page = show(*scene)
    point_at(page, PLATE)
    page.press("p")
    pdf = base64.b64decode(watched.execute_cdp_cmd("Page.printToPDF", {"printBackground": False})["data"])
    assert 1 <= len(re.findall(rb"/Type\s*/Page\b", pdf)) <= 2
    # It was as wide as the paper until this was over.
    assert page.run("return [printed, document.body.style.width]") == [["680px"], ""]
    watched.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    try:
        for name in ("play", "slider", "view", "pin", "hint", "help"):
            assert not page.browser.find_element("id", name).is_displayed(), name
        for name in ("pixels", "curve-plot", "list", "caption", "provenance"):
            assert page.browser.find_element("id", name).is_displayed(), name
        inside = page.run(
            "return [...document.querySelectorAll('section')].map((one) => getComputedStyle(one).breakInside)"
        )
        assert inside == ["avoid", "avoid"]
    finally:
        watched.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})


def test_records_are_saved_as_a_table(watched, show, scene):
    page = show(*scene)
    point_at(page, PLATE)
    page.press("p")
    point_at(page, BALL)
    page.browser.find_element("id", "save-csv").click()
    name, content = files(page)
    assert name == "sphere & <b>plate · gate stack.csv"
    head, *lines = base64.b64decode(content.split(",")[1]).decode().splitlines()
    assert head.startswith(
        'time_ns,depth_m,"row 40, column 26 · angle_x −3.98, angle_y 2.58 mrad: received power (W)",'
    )
    table = np.array([line.split(",") for line in lines], dtype=float)
    power = scene[1]["waveform"].values
    np.testing.assert_allclose(table[:, 0], scene[1]["time"].values)
    for column, pixel in ((2, PLATE), (4, BALL)):
        np.testing.assert_allclose(table[:, column], power[pixel], rtol=0.06 / 16 * 1.01, atol=1e-25)
        np.testing.assert_allclose(table[:, column + 1], 0.06 * power[pixel], rtol=1 / 64)


def test_the_picture_is_saved_as_seen(watched, show, scene):
    page = show(*scene)
    page.choose(slider=26, map="magma")
    page.browser.find_element("id", "save-png").click()
    name, content = files(page)
    assert name == "sphere & <b>plate · gate stack.png"
    picture = Image.open(io.BytesIO(base64.b64decode(content.split(",")[1]))).convert("RGB")
    box = page.run(
        "const [one, image] = ['pixels', 'image'].map((name) => byId(name).getBoundingClientRect());"
        "return [one.left - image.left, one.top - image.top, one.width, one.height]"
    )
    middle = lambda number, start, length: round(2 * (start + (number + 0.5) / SIZE * length))  # noqa: E731
    shown = page.colours(SIZE, SIZE)
    for row, column in (PLATE, BALL, (5, 60)):
        place = middle(column, box[0], box[2]), middle(row, 34 + box[1], box[3])
        np.testing.assert_allclose(picture.getpixel(place), shown[row, column], atol=6)
    # Texts and axes are there: below the image the drawing is not empty.
    dots = np.asarray(picture.crop((0, round(2 * (34 + box[1] + box[3] + 6)), picture.width // 2, picture.height)))
    assert len(np.unique(dots.reshape(-1, 3), axis=0)) > 20


def test_the_address_keeps_gate_and_pixels(show, scene):
    page = show(*scene)
    page.choose(slider=20)
    point_at(page, BALL)
    page.press("p")
    point_at(page, PLATE)
    page.wait("return location.hash === '#gate=20&pixel=40,26&pinned=23,41'")
    address = page.browser.current_url
    page.browser.get("about:blank")
    page.browser.get(address)
    page.wait("return document.querySelectorAll('#curve-plot .line').length === 2")
    assert page.text("number") == "20 / 39"
    assert "row 23, column 41" in page.text("list")
    assert "row 40, column 26" in page.text("list")
    # What is no place of the page is left out.
    page.run("location.hash = '#gate=99&pixel=1,64&pinned=-1,2;x;3,4'")
    page.wait("return byId('list').textContent.includes('row 3, column 4')")
    assert page.text("number") == "20 / 39"
    assert "row 40, column 26" in page.text("list")


def test_keys_are_listed_and_playing_is_not_spoken(show, scene):
    page = show(*scene)
    assert not page.run("return byId('help').open")
    page.press("?")
    assert "space\tplay or pause" in page.text("help").replace(" play", "\tplay")
    page.press("?")
    page.press(" ")
    assert page.run("return byId('caption').getAttribute('aria-live')") == "off"
    page.press(" ")
    assert page.run("return byId('caption').getAttribute('aria-live')") == "polite"


@pytest.mark.parametrize("width", [740, 900, 1200])
def test_a_notebook_shows_it_without_scroll_bar(browser, tmp_path, scene, width):
    frame = view(*scene)._repr_html_()
    (tmp_path / "cell.html").write_text(f'<!DOCTYPE html><div style="width: {width}px">{frame}</div>', "utf-8")
    browser.set_window_size(1400, 1000)
    browser.get(f"file://{tmp_path}/cell.html")
    browser.switch_to.frame(0)
    page = Page(browser)
    page.wait("return document.querySelectorAll('#curve-plot .line').length > 0")
    page.settle()
    height, inner = page.run("return [document.documentElement.scrollHeight, innerHeight]")
    assert (inner, height <= inner) == (view(*scene).height, True), height
    point_at(page, PLATE)
    page.press("p")
    page.settle()
    assert page.run("return document.documentElement.scrollHeight <= innerHeight")
    browser.switch_to.default_content()
    browser.set_window_size(1280, 800)
    assert browser.get_log("browser") == []
