"""File of the page of gate stacks: embedded data, size limit, and rejected arguments."""

import base64
import json
import logging
import re
import zlib

import numpy as np
import pytest
import xarray as xr
from rows import each_row

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots.gate_viewer.page import page_text

ROWS, COLUMNS, GATES, BINS = 30, 21, 40, 120


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(5)
    angles = {
        "angle_x": (("row", "column"), np.repeat(np.linspace(3, -3, ROWS)[:, None], COLUMNS, 1)),
        "angle_y": (("row", "column"), np.repeat(np.linspace(2, -2, COLUMNS)[None], ROWS, 0)),
    }
    gates = {"gate_start": ("gate", 1400 + 2.0 * np.arange(GATES)), "gate_width": ("gate", np.full(GATES, 4.0))}
    depth = {"gate_depth": ("gate", 0.22 * np.arange(GATES) - 0.5)}
    energy = rng.uniform(1, 2, (2, ROWS, COLUMNS, GATES))
    power = rng.uniform(1, 2, (2, ROWS, COLUMNS, BINS))
    names = ("gate_energy", "gate_energy_stderr"), ("waveform", "waveform_stderr")
    stack = {name: (("row", "column", "gate"), values) for name, values in zip(names[0], energy, strict=True)}
    render = {name: (("row", "column", "time"), values) for name, values in zip(names[1], power, strict=True)}
    attributes = {"scene": "a & b", "note": "</script><!--<script>", "seed": 3}
    return (
        xr.Dataset(stack, angles | gates | depth, attributes),
        xr.Dataset(render, angles | {"time": 1400.5 + np.arange(BINS)}),
    )


def write_page(stack, path, *options, **named):
    path.write_text(page_text(stack, *options, **named), "utf-8")


def embedded(path):
    """Return the metadata and the arrays of a page, and the encoded lengths of the arrays."""
    elements = dict(re.findall(r'<script type="[^"]*" id="(\w+)">([^<]*)</script>', path.read_text(encoding="utf-8")))
    metadata = json.loads(elements.pop("metadata"))
    arrays = {}
    for name, text in elements.items():
        planes = np.frombuffer(zlib.decompress(base64.b64decode(text), -15), np.uint8).reshape(4, -1)
        arrays[name] = np.ascontiguousarray(planes.T).view("<f4").ravel()
    return metadata, arrays, {name: len(text) for name, text in elements.items()}


def means(variable, block):
    """Return means over blocks of pixels, one after the other."""
    values = variable.values
    rows, columns = (range(0, count, block) for count in (ROWS, COLUMNS))
    return np.array([[values[r : r + block, c : c + block].mean((0, 1)) for c in columns] for r in rows])


def numbered(dataset):
    """Return an image with the coordinates that its files have."""
    return dataset.assign_coords({dim: np.arange(dataset.sizes[dim]) for dim in ("row", "column")})


def test_page_of_waveforms(scene, tmp_path):
    """The time bins of waveforms are their gates; the arrays are there once."""
    result = numbered(scene[1]).assign_attrs(altitude=200.0, off_nadir_deg=20.0, refractive_index=1.34)
    result = result.assign_attrs(group_index=1.364, surface_time_ns=1422.0)
    path = tmp_path / "page.html"
    write_page(result, path)
    metadata, arrays, _ = embedded(path)
    assert set(arrays) == {"waveform", "waveform_stderr", "surface_time", "depth_per_ns"}
    for name in ("waveform", "waveform_stderr"):
        assert (arrays[name] == result[name].values.ravel().astype("f4")).all()
    assert metadata["quantity"] == {"name": "received power", "unit": "W"}
    assert metadata["gate_start"] == [1400.0 + k for k in range(BINS)]
    assert set(metadata["gate_width"]) == {1.0}
    # Energy [J] of a power [W] in bins of 1 ns.
    assert metadata["sum"] == pytest.approx(1e-9)
    # c0 cos(theta_water) / (2 n_g), with the surface at 1422 ns.
    per_ns = 0.299792458 / (2 * 1.364) * np.sqrt(1 - (np.sin(np.radians(20)) / 1.34) ** 2)
    assert metadata["depth_of_time"] == pytest.approx([-1422 * per_ns, per_ns], rel=1e-6)
    assert metadata["shapes"] is None


def test_page_of_a_series_shows_the_mean_of_its_shots(scene, tmp_path):
    one = numbered(scene[1])
    series = xr.concat([one, 3 * one, 2 * one], "shot").assign_coords(shot=[0, 1, 2])
    series = series.assign_coords({name: one[name] for name in ("angle_x", "angle_y")}).transpose("shot", ...)
    write_page(series, tmp_path / "page.html")
    metadata, arrays, _ = embedded(tmp_path / "page.html")
    assert metadata["notes"] == ["The waveforms are means over 3 shots."]
    np.testing.assert_allclose(arrays["waveform"], 2 * one["waveform"].values.ravel(), rtol=1e-6)
    errors = np.sqrt(1 + 9 + 4) / 3 * one["waveform_stderr"].values.ravel()
    np.testing.assert_allclose(arrays["waveform_stderr"], errors, rtol=1e-6)


def test_page_contains_all_data(scene, tmp_path):
    path = tmp_path / "page.html"
    write_page(scene[0].transpose("gate", "column", "row"), path, scene[1].transpose("time", ...))
    metadata, arrays, _ = embedded(path)
    assert set(arrays) == {"gate_energy", "gate_energy_stderr", "waveform", "waveform_stderr"}
    for name, values in arrays.items():
        data = scene[0] if "gate" in name else scene[1]
        order = ("gate", "row", "column") if "gate" in name else ("row", "column", "time")
        assert (values == data[name].transpose(*order).values.ravel().astype(np.float32)).all()
    assert (metadata["rows"], metadata["columns"], metadata["notes"]) == (ROWS, COLUMNS, [])
    assert ["note", "</script><!--<script>"] in metadata["attributes"]
    # The centre of pixel (0, 0) is at angle_x = 3, angle_y = 2; depth = 0.22 (t - 1402) / 2 - 0.5.
    axes = metadata["axes"]
    assert axes["top"] - axes["along"] / 2 == pytest.approx(3)
    assert axes["left"] + axes["across"] / 2 == pytest.approx(2)
    assert (axes["along"], axes["across"]) == pytest.approx((6 / 29, -4 / 20))
    assert metadata["depth_of_time"] == pytest.approx([-0.5 - 0.11 * 1402, 0.11])


def test_many_values_are_rounded(tmp_path, monkeypatch, scene):
    monkeypatch.setattr("mitransient_lidar.plots.gate_viewer.page._EXACT", 100)
    stack, result = scene[0].copy(deep=True), scene[1]
    stack["gate_energy_stderr"][0, 0, 0] = 0.0
    stack["gate_energy"][0, 0, 1] = np.nan
    write_page(stack, tmp_path / "page.html", result)
    _, arrays, letters = embedded(tmp_path / "page.html")
    for name, values in (
        ("gate_energy", np.moveaxis(stack["gate_energy"].values, -1, 0)),
        ("waveform", result["waveform"]),
    ):
        errors = stack["gate_energy_stderr"] if name == "gate_energy" else result["waveform_stderr"]
        errors = np.ravel(np.moveaxis(errors.values, -1, 0) if name == "gate_energy" else errors)
        difference = np.abs(arrays[name] - np.ravel(values))
        # Without an error, to 12 binary digits.
        assert np.nanmax(difference - np.where(errors > 0, errors / 16, 2 / 2**12)) <= 0
        assert 0.3 < np.nanmean(difference / np.maximum(errors, 0.1)) * 16 * 1.5 < 1
        np.testing.assert_allclose(arrays[f"{name}_stderr"], errors, rtol=1 / 64)
        assert letters[name] < 0.3 * 4 / 3 * 4 * difference.size
    assert np.isnan(arrays["gate_energy"][ROWS * COLUMNS])


def test_large_pages_show_means(scene, tmp_path, caplog):
    stack, result = scene
    path = tmp_path / "page.html"
    write_page(stack, path, result)
    letters = embedded(path)[2]
    gates, waveforms = (sum(letters[name] for name in (kind, f"{kind}_stderr")) for kind in ("gate_energy", "waveform"))
    rest = path.stat().st_size - gates - waveforms
    # The bound on the metadata is a few kB too large. Shares of blocks: 1/4, 1/13, 1/52.
    cases = [
        (gates + 1.10 * waveforms, 1, 1),
        (gates + 0.50 * waveforms, 1, 2),
        (gates + 0.20 * waveforms, 1, 4),
        (0.80 * gates, 2, 4),
        (0.18 * gates, 4, 8),
    ]
    for room, block, waveform_block in cases:
        limit = (rest + room + 8000) / 1e6
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            write_page(stack, path, result, limit)
        assert path.stat().st_size <= 1e6 * limit
        metadata, arrays, _ = embedded(path)
        assert (metadata["block"], metadata["waveform"]["block"] * metadata["block"]) == (block, waveform_block)
        for name in ("gate_energy", "gate_energy_stderr"):
            np.testing.assert_allclose(arrays[name], np.moveaxis(means(stack[name], block), -1, 0).ravel(), rtol=1e-6)
        for name in ("waveform", "waveform_stderr"):
            np.testing.assert_allclose(arrays[name], means(result[name], waveform_block).ravel(), rtol=1e-6)
        assert (metadata["rows"], metadata["columns"]) == (-(-ROWS // block), -(-COLUMNS // block))
        assert metadata["axes"]["along"] == pytest.approx(block * 6 / 29)
        notes = metadata["notes"]
        assert len(notes) == (block > 1) + (waveform_block > 1)
        assert all(f"{limit:g} MB" in note for note in notes)
        assert [record.getMessage() for record in caplog.records] == [f"the page: {note}" for note in notes]


@each_row(
    (
        lambda stack, result: (result[["waveform_stderr"]], "page.html"),
        "the dataset is no gate stack: it has no variable gate_energy",
    ),
    (lambda stack, result: (result, "page.html"), "the dataset has no coordinate row"),
    (
        lambda stack, result: (result.isel(row=0).rename(column="pixel").drop_vars("angle_x"), "page.html"),
        "the dataset has no coordinate pixel",
    ),
    (
        lambda stack, result: (numbered(result).drop_vars(["angle_x", "angle_y"]), "page.html"),
        "the result has no coordinate angle_x over (row, column): it has no map to draw",
    ),
    (lambda stack, result: (numbered(result), "page.html", None, 0.01), "limit_mb = 0.01 is too small for this stack"),
    (lambda stack, result: (stack, "page.html", result[["waveform_stderr"]]), "has no variable waveform"),
    (lambda stack, result: (stack, "page.html", result.isel(row=slice(3))), "must be those of the gate stack"),
    (lambda stack, result: (stack.isel(row=0), "page.html"), "(row, column, gate) or (pixel, gate)"),
    (lambda stack, result: (stack, "page.html", None, 0), "limit_mb = 0 must be greater than 0"),
    (lambda stack, result: (stack, "page.html", None, 0.01), "limit_mb = 0.01 is too small for this stack"),
)
def test_invalid_input_is_rejected_in_one_sentence(change, message, scene, tmp_path):
    stack, name, *rest = change(*(data.isel(row=slice(0, 4), column=slice(0, 4)) for data in scene))
    with pytest.raises(UserError, match=re.escape(message)) as caught:
        write_page(stack, tmp_path / name, *rest)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_page_is_self_contained(scene, tmp_path):
    write_page(scene[0], tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    # Metadata, two arrays and the script: no text ends or begins an element.
    assert page.count("<script") == page.count("</script>") == 4
    assert page.count("<!--") == 0
    assert "<title>a &amp; b · gate stack</title>" in page
    assert set(re.findall(r"(?:https?:)?//[\w.-]+\.\w+[^\s\"']*", page)) == {"http://www.w3.org/2000/svg"}
    assert "default-src 'none'" in page
    assert not re.search(r"\b(eval|innerHTML|import|fetch)\b", page)
    assert '<script>\n"use strict";' in page


def test_page_of_a_record_of_a_gated_scene(scene, tmp_path):
    """A record that still has the coordinates of the gates, of another number than its bins."""
    of_gates = {name: one for name, one in scene[0].coords.items() if one.dims == ("gate",)}
    gated = numbered(scene[1]).assign_coords({"gate": np.arange(GATES), **of_gates})
    write_page(gated.rename(waveform="signal", waveform_stderr="signal_mean_stderr"), tmp_path / "page.html")
    assert len(embedded(tmp_path / "page.html")[0]["gate_start"]) == BINS
