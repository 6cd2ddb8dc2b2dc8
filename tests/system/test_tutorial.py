"""The tutorial of the gallery runs as a plain script, and prints what its text says."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from significance import largest_z

SCRIPT = Path(__file__).parents[2] / "docs" / "gallery" / "ten_minutes.py"


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """What the script prints; it leaves no files."""
    folder = tmp_path_factory.mktemp("tutorial")
    done = subprocess.run(
        [sys.executable, str(SCRIPT)],
        cwd=folder,
        env={**os.environ, "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    assert not list(folder.iterdir())
    return done.stdout


def number_after(label, text):
    found = re.search(re.escape(label) + r"\s*([-+.\d]+)", text)
    assert found, f"{label!r} is not printed in {text!r}"
    return float(found.group(1))


def rows_after(label, text):
    """Return the lists of four numbers, one a pixel, on the line that begins with a label."""
    line = next(one for one in text.splitlines() if one.startswith(label))
    return [[float(one) for one in part.split()] for part in re.findall(r"\[(.*?)\]", line)]


@pytest.mark.long
def test_shots_spread_as_the_text_says(printed):
    """Time as stated, a fifth more at most beside the scatter of a spread of 200 (5 %); depth by a third of that."""
    spread, stated = rows_after("time of the bottom", printed)
    for one, said in zip(spread, stated, strict=True):
        assert 0.8 * said < one < 1.45 * said
    spread, stated = rows_after("depth", printed)
    assert 0.2 < max(one / said for one, said in zip(spread, stated, strict=True)) < 0.6
    (mean,) = rows_after("mean depth", printed)
    assert mean == pytest.approx([8.0] * 4, abs=0.15)


@pytest.mark.long
def test_estimates_meet_the_truth(printed):
    """Within what the text promises: errors of the slope, 0.15 m, a tenth, and a few percent."""
    for name in ("slope along:", "slope across:"):
        line = next(one for one in printed.splitlines() if one.startswith(name))
        estimate, error, truth = (float(one) for one in re.findall(r"[-+]?\d+\.\d+", line))
        assert abs(truth) < 0.1
        assert abs(estimate - truth) < largest_z(10**6) * error
    assert number_after("depth (m):  ", printed) == pytest.approx(8.0, abs=0.15)
    assert number_after("reflectance:", printed) == pytest.approx(0.1, rel=0.1)
    assert number_after("a (1/m):", printed) == pytest.approx(0.15, rel=0.06)
    assert number_after("bb (1/m):", printed) == pytest.approx(0.006, rel=0.08)
    low, high = (float(one) for one in re.search(r"([\d.]+) to ([\d.]+)", printed).groups())
    # Bounds are for bb/b up to 0.03; the scene has 0.04, for which c is a little below them.
    assert 0.3 < low < 0.36 < high
