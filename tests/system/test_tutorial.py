"""The tutorial notebook: its cells run, say what its text says, and its stored outputs are those of its cells.

No Jupyter is needed: the code cells run one after the other in a fresh interpreter.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from significance import largest_z

NOTEBOOK = Path(__file__).parents[2] / "docs" / "tutorial.ipynb"

# Lines that begin with % are for Jupyter only. Warnings are errors once the first cell has imported everything.
RUNNER = """
import contextlib, io, json, sys, traceback, warnings
names = {"__name__": "__main__"}
printed = []
for number, source in enumerate(json.load(open(sys.argv[1], encoding="utf-8")), 1):
    text = "".join("#" + line if line.startswith("%") else line for line in source.splitlines(keepends=True))
    out = io.StringIO()
    try:
        with contextlib.redirect_stdout(out):
            exec(compile(text, f"code cell {number}", "exec"), names)
    except BaseException:
        sys.exit(f"code cell {number} failed:\\n{source}\\n\\n{out.getvalue()}\\n{traceback.format_exc()}")
    warnings.simplefilter("error")
    printed.append(out.getvalue())
print(json.dumps(printed))
"""


@pytest.fixture(scope="module")
def cells():
    book = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert book["nbformat"] == 4
    return [cell for cell in book["cells"] if cell["cell_type"] == "code"]


@pytest.fixture(scope="module")
def printed(cells, tmp_path_factory):
    """What each code cell prints when all run in order."""
    folder = tmp_path_factory.mktemp("tutorial")
    (folder / "cells.json").write_text(json.dumps(["".join(cell["source"]) for cell in cells]), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", RUNNER, "cells.json"],
        cwd=folder,
        env={**os.environ, "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def stored(cell):
    """Text that a cell has printed when the notebook was saved."""
    return "".join("".join(out["text"]) for out in cell["outputs"] if out["output_type"] == "stream")


def shape(text):
    """Words of a text, with a sign for each number: brackets stand closer to some numbers than to others."""
    return re.sub(r"[-+]?\d+(\.\d*)?", "#", re.sub(r"[][]", " ", text)).split()


def number_after(label, text):
    found = re.search(re.escape(label) + r"\s*([-+.\d]+)", text)
    assert found, f"{label!r} is not printed in {text!r}"
    return float(found.group(1))


def rows_after(label, text):
    """Return the lists of four numbers, one a pixel, on the line that begins with a label."""
    line = next(one for one in text.splitlines() if one.startswith(label))
    return [[float(one) for one in part.split()] for part in re.findall(r"\[(.*?)\]", line)]


@pytest.mark.long
def test_outputs_are_those_of_the_cells(cells, printed):
    for number, (cell, text) in enumerate(zip(cells, printed, strict=True), 1):
        assert cell["execution_count"] == number, "save the notebook after one run of all its cells"
        assert shape(stored(cell)) == shape(text), f"code cell {number} prints something else than what is stored"


@pytest.mark.slow
def test_every_cell_shows_something(cells):
    pictures = 0
    for number, cell in enumerate(cells, 1):
        assert cell["outputs"], f"code cell {number} has no output"
        kinds = {out["output_type"] for out in cell["outputs"]}
        assert "error" not in kinds
        assert {out.get("name", "stdout") for out in cell["outputs"]} == {"stdout"}
        drawn = sum("image/png" in out.get("data", {}) for out in cell["outputs"])
        source = "".join(cell["source"])
        assert drawn == ("plt.show()" in source or source.startswith("plot_")), f"picture of code cell {number}"
        pictures += drawn
    assert pictures == 4


@pytest.mark.slow
def test_file_is_small_and_knows_no_machine():
    text = NOTEBOOK.read_text(encoding="utf-8")
    assert len(text) < 600_000
    assert not re.search(r"/(home|root|tmp|work|Users)/", text)


@pytest.mark.slow
def test_cells_are_short(cells):
    for cell in cells:
        assert len("".join(cell["source"]).splitlines()) <= 20


@pytest.mark.long
def test_the_receiver_saturates_and_then_does_not(printed):
    shares = [number_after("at the limit of the amplifier:", text) for text in printed if "at the limit" in text]
    assert shares[0] > 40
    assert shares[1] == 0


@pytest.mark.long
def test_shots_spread_as_the_text_says(printed):
    """Time as stated, a fifth more at most beside the scatter of a spread of 200 (5 %); depth by half of that."""
    text = next(text for text in printed if "time of the bottom" in text)
    spread, stated = rows_after("time of the bottom", text)
    for one, said in zip(spread, stated, strict=True):
        assert 0.8 * said < one < 1.45 * said
    spread, stated = rows_after("depth", text)
    assert 0.3 < max(one / said for one, said in zip(spread, stated, strict=True)) < 1.3
    (mean,) = rows_after("mean depth", text)
    assert mean == pytest.approx([8.0] * 4, abs=0.15)


@pytest.mark.long
def test_estimates_meet_the_truth(printed):
    """Within what the text promises: errors of the slope, 0.15 m, a tenth, and a few percent."""
    text = next(text for text in printed if "slope along" in text)
    for name in ("slope along:", "slope across:"):
        line = next(one for one in text.splitlines() if one.startswith(name))
        estimate, error, truth = (float(one) for one in re.findall(r"[-+]?\d+\.\d+", line))
        assert abs(truth) < 0.1
        assert abs(estimate - truth) < largest_z(10**6) * error
    assert number_after("depth (m):", text) == pytest.approx(8.0, abs=0.15)
    assert number_after("reflectance:", text) == pytest.approx(0.1, rel=0.1)
    assert number_after("a (1/m):", text) == pytest.approx(0.15, rel=0.06)
    assert number_after("bb (1/m):", text) == pytest.approx(0.006, rel=0.08)
    low, high = (float(one) for one in re.search(r"([\d.]+) to ([\d.]+)", text).groups())
    assert low < 0.3 < high


@pytest.mark.long
def test_gates_are_as_accurate_as_stored(cells, printed):
    for texts in ([stored(cell) for cell in cells], printed):
        text = next(text for text in texts if text.startswith("gate "))
        errors = [int(one) for one in re.findall(r"(\d+) %", text)]
        assert len(errors) == 2
        assert all(10 <= one <= 30 for one in errors)
