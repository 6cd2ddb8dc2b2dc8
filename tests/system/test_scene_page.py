"""Pages of scenes in a real browser: what they draw, their views and numbers, and their width on a phone."""

import re
from pathlib import Path

import pytest
from browser_page import Page, needs_browser

from mitransient_lidar.plots.viewer import view_scene

pytestmark = [pytest.mark.slow, needs_browser]

EXAMPLES = Path(__file__).parents[2] / "scenes" / "examples"

#: Most bytes of a page.
LARGEST = 6e6


@pytest.fixture(scope="module", params=["table1", EXAMPLES / "gated_target.xml"], ids=["table1", "gated_target"])
def written(request, tmp_path_factory):
    return view_scene(request.param).save(tmp_path_factory.mktemp("page") / "scene.html")


@pytest.fixture
def page(written, browser):
    """The page on a screen as wide as a phone; it may log no error, and ask for nothing."""
    browser.get_log("browser")
    size = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get(written.as_uri())
    page = Page(browser)
    page.wait("return document.body.dataset.ready === 'true'")
    yield page
    # Chromium warns of the time that reading a drawing takes; what the policy of the page blocks is an error.
    assert [one for one in browser.get_log("browser") if one["level"] == "SEVERE"] == []
    assert page.run("return performance.getEntriesByType('resource').map((entry) => entry.name)") == []
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def scene(page):
    """Return ranges of the axes [m] and sides of the drawing."""
    return page.run(
        "const { xaxis, yaxis, zaxis, aspectratio } = document.getElementById('plot')._fullLayout.scene;"
        "return [[xaxis, yaxis, zaxis].map((axis) => axis.range), [aspectratio.x, aspectratio.y, aspectratio.z]]"
    )


def per_metre(page):
    """Return the lengths of a metre along each axis, relative to x."""
    ranges, sides = scene(page)
    found = [side / (high - low) for (low, high), side in zip(ranges, sides, strict=True)]
    return [one / found[0] for one in found]


def test_the_page_is_small_and_fits_on_a_phone(written, page):
    assert written.stat().st_size < LARGEST
    assert page.run("return [innerWidth, document.documentElement.scrollWidth <= innerWidth]") == [390, True]
    # All parts are drawn, and something is on the canvas.
    traces, canvases = page.run(
        "const plot = document.getElementById('plot');"
        "return [plot.data.length, plot.querySelectorAll('.gl-container canvas').length]"
    )
    assert traces >= 10
    assert canvases >= 1


def test_views_are_to_scale(page):
    (_, _, (low, high)), _ = scene(page)
    assert -12 < low < -8 < 0 < high < 3
    assert per_metre(page) == pytest.approx([1, 1, 1], rel=1e-6)
    page.choose(exaggeration="5")
    page.wait("return document.getElementById('plot')._fullLayout.scene.aspectratio.z === 1")
    assert per_metre(page) == pytest.approx([1, 1, 5], rel=1e-6)
    page.choose(exaggeration="1")
    page.run("document.querySelectorAll('#views button')[1].click()")
    page.wait("return document.getElementById('plot')._fullLayout.scene.zaxis.range[1] > 199")
    assert per_metre(page) == pytest.approx([1, 1, 1], rel=1e-6)
    page.choose(**{"from": "0,-1,0"})
    page.wait("return document.getElementById('plot')._fullLayout.scene.camera.projection.type === 'orthographic'")


def test_parts_are_listed_and_walls_left_out(page):
    page.run("document.getElementById('parts').open = true")
    rows = page.text("parts").splitlines()
    bottom = next(row for row in rows if row.startswith("bottom"))
    assert re.match(r"bottom height -[89] m, reflectance 0\.1", bottom)
    count = "return document.getElementById('plot')._fullData.filter((one) => one.visible === true).length"
    before = page.run(count)
    page.run("document.querySelector('#filled input').click()")
    page.wait(f"{count} < {before}")
    # Those of the beam and of each pixel, or of an imager's view.
    assert before - page.run(count) in (3, 6)


def test_numbers_appear_where_one_points(page):
    """Somewhere along the height of the drawing is the beam, and the bottom below it."""
    found = set()
    for share in range(20, 75, 4):
        page.point("plot", 0.5, share / 100, click=False)
        page.settle()
        found.add(page.run("return document.querySelector('#plot .hovertext')?.textContent ?? ''"))
    text = " ".join(found)
    assert "half angles" in text
    assert "where it ends" in text
