"""Page of gate stacks in a real browser: displayed values, controls, and no access to the network."""

import re

import numpy as np
import pytest
from browser_page import BALL, METRES_PER_NS, PLAIN, PLATE, SIZE, expected_colours, needs_browser, point_at, scene_of

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scene():
    return scene_of(SIZE)


@needs_browser
def test_gates(show, scene):
    stack, result = scene
    energy = stack["gate_energy"].values
    page = show(stack, result)
    # It opens at the brightest gate.
    brightest = int(energy.sum((0, 1)).argmax())
    assert page.text("number") == f"{brightest} / 39"
    assert page.text("summary") == "64 × 64 pixels · 40 gates · 1 pulse · altitude 200 m · 20° off nadir"

    # One range for all gates, from 0 to the largest value.
    page.choose(slider=20, log=False)
    assert page.text("caption") == f"Gate 20 · 1462.00 to 1467.00 ns · depth {44.5 * METRES_PER_NS:.2f} m"
    assert (page.colours(SIZE, SIZE) == expected_colours(energy[..., 20], 0, energy.max(), "viridis")).all()
    page.choose(slider=26, range="one", map="magma")
    shown = energy[..., 26]
    assert (page.colours(SIZE, SIZE) == expected_colours(shown, shown.min(), shown.max(), "magma")).all()
    # A logarithmic range leaves out the lowest hundredth; a clipped one the brightest.
    page.choose(log=True, clip="0.01")
    low, high = np.sort(shown, axis=None)[[int(0.01 * shown.size), int(0.99 * shown.size)]]
    same = page.colours(SIZE, SIZE) == expected_colours(shown, low, high, "magma", log=True)
    assert same.all(-1).mean() > 0.999  # logarithms may differ in their last digit

    # Arrow keys, and the ends.
    page.choose(clip="0", map="gray")
    page.press("\ue014")
    assert page.text("number") == "27 / 39"
    page.press("\ue011")
    assert page.text("number") == "0 / 39"
    page.press("\ue012")
    assert page.text("number") == "0 / 39"
    page.press("\ue010")
    assert page.text("number") == "39 / 39"
    page.browser.find_element("id", "play").click()
    page.wait("return document.getElementById('number').textContent === '1 / 39'")
    page.browser.find_element("id", "play").click()


@needs_browser
def test_left_is_left_as_seen_from_the_lidar(show, scene):
    """Angles to the left fall along the axis, also of a stack whose columns a user has turned."""
    stack, result = scene
    for one in (stack, stack.isel(column=slice(None, None, -1))):
        page = show(one, result)
        labels = page.run(
            "const texts = [...document.querySelectorAll('#image-axes text[text-anchor=middle]:not(.name)')];"
            "return texts.map((text) => [Number(text.getAttribute('x')), text.textContent])"
        )
        places, angles = zip(*((x, float(text.translate(PLAIN))) for x, text in sorted(labels)), strict=True)
        assert angles[0] == -angles[-1] > 0
        assert np.all(np.diff(angles) < 0)
        # The angle 0 is in the middle of the canvas.
        left, width = page.run(
            "const c = document.getElementById('pixels'); return [parseFloat(c.style.left), parseFloat(c.style.width)]"
        )
        assert places[angles.index(0.0)] == pytest.approx(left + width / 2, abs=1)
        page.choose(slider=26, log=False)
        values = stack["gate_energy"].values[..., 26]
        assert (
            page.colours(SIZE, SIZE) == expected_colours(values, 0, stack["gate_energy"].values.max(), "viridis")
        ).all()
        point_at(page, PLATE)
        assert "angle_x −3.98, angle_y 2.58 mrad" in page.text("reading")


@needs_browser
def test_records(show, scene):
    stack, result = scene
    power, energy = result["waveform"].values, stack["gate_energy"].values
    page = show(stack, result)
    page.choose(slider=22)
    point_at(page, PLATE)
    assert page.peaks() == pytest.approx([1e9 * power[PLATE].max()], rel=0.01)
    value, error = energy[PLATE][22], stack["gate_energy_stderr"].values[PLATE][22]
    assert page.text("reading").startswith("row 40, column 26 · angle_x −3.98, angle_y 2.58 mrad: ")
    shown, shown_error = re.search(r"mrad: ([\d.]+) ± ([\d.]+) aJ", page.text("reading")).groups()
    assert float(shown) == pytest.approx(1e18 * value, rel=0.01)
    assert float(shown_error) == pytest.approx(1e18 * error, rel=0.06)
    page.choose(curve_log=True)
    assert page.peaks() == pytest.approx([1e9 * power[PLATE].max()], rel=0.02)

    # A pinned one stays; what is pointed at is previewed.
    page.press("p")
    point_at(page, BALL, key="\ue008")
    point_at(page, (32, 32), click=False)
    page.choose(curve_log=False)
    assert page.peaks()[:2] == pytest.approx([1e9 * power[place].max() for place in (PLATE, BALL)], rel=0.01)
    lines = page.text("list").splitlines()
    assert [line for line in lines if line.startswith("row")] == [
        f"row {row}, column {column} · angle_x {angle_x}, angle_y {angle_y} mrad"
        for row, column, angle_x, angle_y in (
            (40, 26, "−3.98", "2.58"),
            (23, 41, "3.98", "−4.45"),
            (32, 32, "−0.23", "−0.23"),
        )
    ]

    # A click on the record goes to the gate of that time.
    page.point("curve-plot", 0.5, 0.5)
    time, gate = float(page.text("moment").split()[1]), int(page.text("number").split()[0])
    assert abs(time - stack["gate_start"].values[gate] - 2.5) <= 1.26
    at_time = 1e12 * power[PLATE][np.abs(result["time"].values - time).argmin()]
    shown = next(line for line in page.text("list").splitlines() if "±" in line)
    assert float(shown.split()[0]) * {"pW": 1, "nW": 1000}[shown.split()[-1]] == pytest.approx(at_time, rel=0.01)

    page.choose(source="gates")
    assert page.peaks()[:2] == pytest.approx([1e18 * energy[place].max() for place in (PLATE, BALL)], rel=0.01)
    # By script: the list may still move below a mouse.
    page.run("document.querySelector('#list button').click()")
    page.settle()
    assert page.peaks()[0] == pytest.approx(1e18 * energy[BALL].max(), rel=0.01)


@needs_browser
def test_text_is_only_text(show, scene):
    page = show(scene[0])
    assert page.browser.title == "sphere & <b>plate · gate stack"
    assert page.browser.find_element("css selector", "h1").text == "sphere & <b>plate"
    page.run("document.getElementById('provenance').open = true")
    assert "note </script><script>document.title = 'broken'</script>" in page.text("attributes")
    assert page.run("return document.querySelector('b') === null")
    # Without a render the record is the gates.
    assert not page.browser.find_element("id", "source").is_displayed()
    assert page.peaks() == pytest.approx([1e18 * scene[0]["gate_energy"].values[SIZE // 2, SIZE // 2].max()], rel=0.01)
