"""EXR stacks: channels, header attributes, damage."""

import concurrent.futures
import os
import sys

import numpy as np
import OpenEXR
import pytest
from command_line import run
from few_paths import few_paths
from rows import must_refuse
from small_results import made

from mitransient_lidar import results
from mitransient_lidar.core import validation
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.formats.array_files import read_exr
from mitransient_lidar.results import exr


def light(values, **attributes):
    """Return a result of an imager with these powers (row, column, time), and negative errors."""
    rows, columns, bins = values.shape
    flat = np.reshape(values, (-1, bins))
    return made(flat, -flat, start=0.0, step=1.0, grid=(rows, columns), **attributes)


def header_and_channels(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return dict(file.header()), {name: channel.pixels.copy() for name, channel in file.channels().items()}


def test_layers_are_bins(tmp_path):
    values = np.arange(2 * 3 * 4, dtype=float).reshape(2, 3, 4)
    results.save(light(values), tmp_path / "a.exr")
    header, channels = header_and_channels(tmp_path / "a.exr")
    names = [f"{stack}000{k}.{part}" for stack in ("bin", "wave") for k in range(4) for part in ("Y", "stderr")]
    assert sorted(channels) == sorted(names)
    # Row 1, column 0 of bin 2 is 1*12 + 0*4 + 2.
    assert channels["wave0002.Y"][1, 0] == 14
    assert channels["wave0002.stderr"][1, 0] == -14
    assert channels["bin0000.Y"].dtype == np.float32
    kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "timeStartNs": 0, "binWidthNs": 1}
    assert {name: header[name] for name in kind} == kind


@pytest.mark.slow
def test_more_than_ten_thousand_bins_have_five_digits(tmp_path):
    values = np.arange(10001, dtype=float).reshape(1, 1, -1)
    results.save(light(values), tmp_path / "a.exr")
    assert "bin00000.Y" in exr.read_parts(tmp_path / "a.exr")[0].channels
    np.testing.assert_array_equal(results.open(tmp_path / "a.exr")["waveform"], values)


@pytest.mark.slow
def test_channels_beyond_the_memory_leave_the_other_files(tmp_path, monkeypatch):
    monkeypatch.setattr(validation, "usable_memory", lambda: 1e6)
    with pytest.raises(UserError, match=r"2000 channels of an EXR file take 0.005 GB of memory, and at most 0.001 GB"):
        results.save(light(np.zeros((1, 1, 500))), tmp_path / "a.exr")
    monkeypatch.setattr(validation, "usable_memory", lambda: 1e9)
    monkeypatch.setattr(exr, "_BYTES_PER_CHANNEL", 1e8)
    few = {"bin_count": 40, "time_start_ns": 1400, "layout": "1x1"}
    define = [part for name, value in few.items() for part in ("-D", f"{name}={value}")]
    done = run("render", few_paths("table1", tmp_path), *define, "--passes", "2", "--no-plot", "-o", tmp_path / "out")
    assert done.exit_code == 0
    assert "no EXR file: 160 channels of an EXR file take 16 GB of memory" in done.stderr
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["small.nc"]


def test_plain_attributes_are_readable_and_never_wrong(tmp_path):
    attributes = {"seed": 2**40, "small": -3, "width": 0.1, "huge": 1e300, "nothing": [], "inf": float("inf")}
    dataset = light(np.zeros((1, 1, 1)), **attributes, **{"x" * 300: 1, "mixed": [1, 2**40]})
    results.save(dataset, tmp_path / "a.exr")
    header, _ = header_and_channels(tmp_path / "a.exr")
    # Stored as a number, the seed would come back as 0.
    assert [header[f"lidar.{name}"] for name in ("seed", "small", "huge")] == ["1099511627776", -3, "1e+300"]
    assert header["lidar.width"] == pytest.approx(0.1, rel=1e-7)
    assert "lidar.nothing" not in header
    assert results.open(tmp_path / "a.exr").attrs == dataset.attrs


def test_every_truncation_and_a_flipped_byte_are_detected(tmp_path, capfd):
    values = np.broadcast_to(np.arange(20.0)[:, np.newaxis, np.newaxis], (20, 8, 2))  # two ZIP blocks of 16 lines
    whole, part = tmp_path / "whole.exr", tmp_path / "part.exr"
    results.save(light(values), whole)
    data = whole.read_bytes()
    for length in range(9, len(data), 5):
        part.write_bytes(data[:length])
        must_refuse(r"part\.exr is damaged or truncated", results.open, part)
    part.write_bytes(data[:-20] + bytes([data[-20] ^ 255]) + data[-19:])
    must_refuse("damaged", results.open, part)
    assert capfd.readouterr() == ("", "")


def test_threads_that_read_damaged_files_change_nothing_of_the_process(tmp_path, capfd):
    results.save(light(np.ones((20, 8, 50))), tmp_path / "a.exr")
    (tmp_path / "b.exr").write_bytes((tmp_path / "a.exr").read_bytes()[:-20])
    before = sys.stdout, os.fstat(2).st_ino

    def read(number):
        if number % 2:
            results.open(tmp_path / "a.exr")
        else:
            must_refuse("damaged", results.open, tmp_path / "b.exr")
        # Another one may print while a file is read.
        sys.stdout.write(f"{number}\n")

    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        list(pool.map(read, range(32)))
    assert (sys.stdout, os.fstat(2).st_ino) == before
    out, err = capfd.readouterr()
    assert sorted(map(int, out.split())) == list(range(32))
    assert err == ""


@pytest.mark.parametrize("compression", ["NO", "ZIPS", "ZIP", "PXR24"])
def test_damaged_images_are_refused_in_silence(tmp_path, capfd, compression):
    values = np.cumsum(np.random.default_rng(3).normal(size=(40, 30)), axis=1).astype(np.float32)
    kind = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "type": OpenEXR.scanlineimage}
    with OpenEXR.File(kind, {"Y": values}) as file:
        file.write(str(tmp_path / "a.exr"))
    read = read_exr(tmp_path / "a.exr")
    np.testing.assert_allclose(read["Y"], values, rtol=1e-3)
    data, random, refused = (tmp_path / "a.exr").read_bytes(), np.random.default_rng(4), 0
    for place in random.integers(4, len(data), 150):
        damaged = bytearray(data)
        damaged[place] ^= 1 << random.integers(8)
        (tmp_path / "b.exr").write_bytes(damaged if place % 2 else data[:place])
        try:
            read_exr(tmp_path / "b.exr")
        except UserError:
            refused += 1
    assert refused > 70
    assert capfd.readouterr() == ("", "")


def test_a_flipped_bit_gives_the_same_result_or_is_refused(tmp_path):
    values = np.random.default_rng(7).random((3, 2, 1))  # noise: ZIP leaves it as it is, without a checksum of its own
    whole, part = tmp_path / "whole.exr", tmp_path / "part.exr"
    results.save(light(values, scene="table1"), whole)
    data, same = whole.read_bytes(), results.open(whole)
    refused = 0
    for place in range(8, len(data), 7):
        part.write_bytes(data[:place] + bytes([data[place] ^ 1 << place % 8]) + data[place + 1 :])
        try:
            read = results.open(part)
        except UserError:
            refused += 1
            continue
        assert read.identical(same)
    assert refused > len(data) / 14
