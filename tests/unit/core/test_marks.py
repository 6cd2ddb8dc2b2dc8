"""Marks of files: kept apart from the contents, and gone once another program has changed the file."""

import os
from xml.dom import minidom

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure
from PIL import Image
from rows import each_row, must_refuse

from mitransient_lidar import results
from mitransient_lidar.core.marks import holds_mark, read_mark, write_mark
from mitransient_lidar.results import files

MARK = {"command": "render", "text": "a -- b --> ä", "parameters": {"depth": "8"}}
FIGURES = (".png", ".pdf", ".svg")


def picture():
    figure = Figure(figsize=(2, 2))
    figure.subplots().plot([1, 3, 2])
    return figure


@pytest.fixture(params=[*FIGURES, ".gif", ".html", ".nc"])
def file(request, tmp_path):
    path = tmp_path / f"file{request.param}"
    if request.param in FIGURES:
        picture().savefig(path)
    elif request.param == ".gif":
        frames = [Image.fromarray(np.full((8, 8), shade, np.uint8)) for shade in (0, 90, 200)]
        frames[0].save(path, save_all=True, append_images=frames[1:])
    elif request.param == ".nc":
        files.write_netcdf(xr.Dataset({"a": ("x", np.arange(1000.0))}, attrs={"scene": "table1"}), path)
    else:
        path.write_text("<!doctype html><title>-- page --</title><p>text")
    return path


def contents(path):
    if path.suffix in (".png", ".gif"):
        with Image.open(path) as image:
            frames = []
            for number in range(getattr(image, "n_frames", 1)):
                image.seek(number)
                frames.append(np.array(image.convert("RGB")))
            return np.stack(frames)
    if path.suffix == ".nc":
        return results.open(path)["a"].values
    return np.array([])


def test_mark_is_read_and_changes_no_contents(file):
    before = contents(file)
    assert read_mark(file) is None
    write_mark(file, MARK)
    found = read_mark(file)
    assert {name: found[name] for name in MARK} == MARK
    np.testing.assert_array_equal(contents(file), before)


def test_file_that_has_changed_has_no_mark(file):
    write_mark(file, MARK)
    data = file.read_bytes()
    file.write_bytes(b" " + data)
    assert read_mark(file) is None
    file.write_bytes(data[: len(data) // 2])
    assert read_mark(file) is None
    # As editors do that keep comments: the mark in another place.
    middle = len(data) // 3
    file.write_bytes(data[:middle] + b"more" + data[middle:])
    assert read_mark(file) is None


def test_mark_of_a_figure_stands_where_its_format_allows(tmp_path):
    for suffix in FIGURES:
        picture().savefig(tmp_path / f"a{suffix}")
        write_mark(tmp_path / f"a{suffix}", MARK)
    with Image.open(tmp_path / "a.png") as image:
        image.load()
        assert "mitransient-lidar made this file" in image.text["Comment"]
    assert minidom.parse(str(tmp_path / "a.svg")).documentElement.tagName == "svg"
    pdf = (tmp_path / "a.pdf").read_bytes()
    assert pdf.endswith(b"%%EOF\n")
    table = int(pdf.split(b"startxref\n")[1].split()[0])
    assert pdf[table : table + 4] == b"xref"


def test_checksum_of_a_marked_file_is_checked(tmp_path):
    path = tmp_path / "a.nc"
    files.write_netcdf(xr.Dataset({"a": ("x", np.arange(1000.0))}), path)
    write_mark(path, MARK)
    assert files.check_sum(path)
    data = bytearray(path.read_bytes())
    data[-3000] ^= 1
    path.write_bytes(data)
    must_refuse("SHA-256", files.check_sum, path)


def test_what_is_no_regular_file_has_no_mark(tmp_path):
    assert not holds_mark(tmp_path / "table.csv")
    os.mkfifo(tmp_path / "a.png")
    (tmp_path / "b.png").symlink_to("/dev/zero")
    (tmp_path / "c.png").symlink_to("nowhere.png")
    (tmp_path / "d.png").mkdir()
    assert not any(read_mark(tmp_path / f"{name}.png") for name in "abcde")


@each_row("{", "[1]", "1e999", '{"position": 1}', "[" * 30_000, "\xff")
def test_damaged_marks_count_as_none(text, tmp_path):
    path = tmp_path / "a.nc"
    path.write_bytes(b"data mitransient-lidar made this file: " + text.encode("latin-1"))
    assert read_mark(path) is None
