"""Waveforms of LAS, LAZ and PulseWaves files, written with struct from the specifications, or by our own flights."""

from __future__ import annotations

import tracemalloc

import laspy
import numpy as np
import pytest
import xarray as xr
from command_line import assert_refused, run
from rows import each_row, must_refuse, refuses
from waveform_writers import Packets, Return, Sampling, Segment, Shot, write_las, write_pulse_waves

import mitransient_lidar
from mitransient_lidar.analysis.information.measured import measured
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.flights.las import write_waveforms
from mitransient_lidar.results.files import open as open_file
from mitransient_lidar.results.waveform_files import read_waveforms, waveform_chunks

SAMPLES, STEP_PS = 40, 500
AIR = 0.5e-12 * C0  # way of a two-way ps [m]
DIRECTION = np.array([0.2, -0.1, -1.0]) / np.linalg.norm([0.2, -0.1, -1.0])
TOWARDS = tuple(-AIR * DIRECTION)


def random_counts(count, bits=16, seed=3):
    return np.random.default_rng(seed).integers(0, 2**bits - 1, (count, SAMPLES)).tolist()


def two_returns_each(count, channels=1):
    """Return a surface and a bottom of each packet, the bottom first in the file."""
    listed = []
    for packet in range(count):
        about = {"gps_time": packet // channels / 1e3, "channel": packet % channels, "user_data": packet % channels}
        listed.append(Return(packet, (0, 0, -4000), 15_000.0, TOWARDS, **about))
        listed.append(Return(packet, (1000 * packet, 0, 250), 9000.0, TOWARDS, **about))
    return listed


@pytest.mark.parametrize("point_format", [4, 5, 9, 10])
@pytest.mark.parametrize(("bits", "internal"), [(8, True), (16, False), (32, True)])
def test_las_samples_come_back_to_the_bit(tmp_path, point_format, bits, internal):
    counts = random_counts(7, bits)
    packets = Packets(counts, bits, spacing_ps=STEP_PS, gain=0.25, offset=-3.0)
    write_las(tmp_path / "one.las", two_returns_each(7), packets, point_format, internal=internal)
    laspy.read(tmp_path / "one.las").write(tmp_path / "packed.laz")
    if not internal:
        (tmp_path / "packed.wdp").write_bytes((tmp_path / "one.wdp").read_bytes())
    names = ["one.las"] if internal else ["one.las", "packed.laz"]  # laspy copies no packets
    for name in names:
        found = read_waveforms(tmp_path / name)
        assert found["signal"].dims == ("shot", "pixel", "time")
        np.testing.assert_array_equal((found["signal"].values[:, 0] + 3.0) / 0.25, counts)
        np.testing.assert_array_equal(found["shot"], range(7))
        np.testing.assert_array_equal(found["time"], (np.arange(SAMPLES) + 0.5) * 0.5)
        np.testing.assert_array_equal(found["gps_time"], np.arange(7) / 1e3)
        # That of the earliest return, which is not the first one in the file.
        np.testing.assert_allclose(found["surface_time"], 9.25)
        assert found["signal"].attrs["units"] == "V"
        assert found.attrs["bin_width_ns"] == 0.5


@pytest.mark.parametrize("size", [1, 3, 1000])
def test_each_waveform_is_there_once(tmp_path, size):
    """Returns of one packet lie far apart, before and after those of packets with other offsets."""
    counts = random_counts(6)
    returns = [two_returns_each(6)[row] for row in (6, 10, 0, 7, 1, 4, 11, 2, 8, 5, 3, 9)]
    returns.insert(4, Return(None, (0, 0, 0), 0.0, (0.0, 0.0, 0.0)))
    write_las(tmp_path / "one.las", returns, Packets(counts))
    parts = list(waveform_chunks(tmp_path / "one.las", size=size))
    signal = np.concatenate([part["signal"].values[:, 0] for part in parts])
    np.testing.assert_array_equal(signal, [counts[packet] for packet in (3, 5, 0, 2, 1, 4)])
    np.testing.assert_array_equal(np.concatenate([part["shot"] for part in parts]), range(6))
    some = read_waveforms(tmp_path / "one.las", (2, 5), size=size)
    np.testing.assert_array_equal(some["signal"].values[:, 0], [counts[packet] for packet in (0, 2, 1)])
    np.testing.assert_array_equal(some["shot"], [2, 3, 4])


def test_channels_are_told_apart(tmp_path):
    counts = random_counts(12)
    write_las(tmp_path / "nine.las", two_returns_each(12, 3), Packets(counts))
    write_las(tmp_path / "four.las", two_returns_each(12, 3), Packets(counts), 4)
    for name in ("nine.las", "four.las"):
        found = read_waveforms(tmp_path / name)
        assert list(found["pixel"].values) == ["0", "1", "2"]
        np.testing.assert_array_equal(found["signal"], np.reshape(counts, (4, 3, SAMPLES)))
    for channel in (1, "1", "user_data=1"):
        found = read_waveforms(tmp_path / "nine.las", channel=channel)
        np.testing.assert_array_equal(found["signal"].values[:, 0], counts[1::3])
    assert read_waveforms(tmp_path / "nine.las", channel="descriptor=1").sizes["shot"] == 12
    with pytest.raises(UserError, match=r"channels 0, 1, 2 with different pulses: choose one with channel"):
        read_waveforms(tmp_path / "nine.las", (0, 11))
    with pytest.raises(UserError, match="has no waveform of channel 5 from number 0 to the last one"):
        read_waveforms(tmp_path / "nine.las", channel=5)
    with pytest.raises(UserError, match="has no field 'pixel': its points have X, Y, Z"):
        read_waveforms(tmp_path / "nine.las", channel="pixel=5")


def test_times_follow_from_the_returns(tmp_path):
    """A sample at t lies at P + (L - t) d; the vector of a point in the water has the speed and direction there."""
    height, n_group, n = 300.0, 1.364, 1.34
    bent = DIRECTION / n
    bent[2] = -np.sqrt(1 - bent[0] ** 2 - bent[1] ** 2)
    returns = [
        Return(0, (0, 0, 300), 9000.0, TOWARDS),
        Return(1, (0, 0, 300), 9000.0, tuple(-np.array(TOWARDS))),  # as files before R15 have it
        Return(2, (0, 0, -2000), 15_000.0, tuple(-AIR / n_group * bent)),
    ]
    write_las(tmp_path / "one.las", returns, Packets(random_counts(3)))
    cosine = -DIRECTION[2]
    expected = np.array([9 + 0.3 / (1e3 * AIR * cosine)] * 2 + [15 - 2 / (1e3 * AIR / n_group * -bent[2])])
    lidar = {"altitude": height, "sea_level": 0.0}
    found = read_waveforms(tmp_path / "one.las", lidar=lidar)
    np.testing.assert_allclose(found["surface_time"].values[:, 0] - 0.25, expected, rtol=1e-6)
    np.testing.assert_allclose(np.cos(np.radians(found["off_nadir"].values[:, 0])), cosine, rtol=1e-6)
    start = 2e9 * height / (C0 * cosine) - expected
    np.testing.assert_allclose(found["sample_start_ns"].values[:, 0] + 0.25, start, rtol=1e-6)
    # Without a level the first return is the surface, and nothing tells the time of the pulse.
    unknown = read_waveforms(tmp_path / "one.las", lidar={"altitude": height})
    np.testing.assert_allclose(unknown["surface_time"].values[:, 0] - 0.25, [9, 9, 15])
    assert np.isnan(unknown["sample_start_ns"].values).all()


def test_flights_come_back_to_the_bit(tmp_path):
    """Counts that flights.las has written; `las_reader` of the flights' tests checks the files themselves."""
    count, pixels = 30, 2
    counts = np.random.default_rng(8).integers(0, 2**16, (count * pixels, SAMPLES)).astype(np.uint16)
    waveform = (("packet", "sample"), counts, {"gain": 3e-4, "offset": -0.7, "sampling_ns": 0.8})
    row = np.arange(count * pixels)
    place = {"x": row * 1.0, "y": 6e6 + row, "z": np.full(row.size, 0.25), "gps_time": row // pixels / 1e4}
    whole = {"kind": 41, "return_number": 1, "number_of_returns": 1, "line": 1, "quality": 0, "scan_angle_deg": 0.0}
    each = {name: np.full(row.size, value) for name, value in {**whole, "depth_uncertainty": np.nan}.items()}
    other = {"depth": place["z"], "horizontal_uncertainty": place["z"], "vertical_uncertainty": place["z"]}
    own = {"pixel": row % pixels, "channel": row % pixels, "shot": row // pixels, "packet": row, "withheld": row < 0}
    found = {**place, **each, **other, **own, "time_in_packet_ns": 10.0 + row / 100}
    points = xr.Dataset({name: ("point", values) for name, values in found.items()})
    points["intensity"] = ("point", place["z"], {"full_scale": 1.0, "units": "V"})
    points["direction"] = (("point", "axis"), np.tile(DIRECTION, (row.size, 1)))
    write_waveforms(tmp_path / "flight.las", points, xr.Dataset({"waveform": waveform}))
    read = mitransient_lidar.open(tmp_path / "flight.las", lidar={"altitude": 400.0, "sea_level": 0.0})
    np.testing.assert_array_equal(read["signal"].values.reshape(-1, SAMPLES), -0.7 + 3e-4 * counts)
    np.testing.assert_array_equal(np.rint((read["signal"].values.reshape(-1, SAMPLES) + 0.7) / 3e-4), counts)
    np.testing.assert_array_equal(read["saturated"].values.reshape(-1, SAMPLES), counts == 2**16 - 1)
    arrival = 10.0 + row.reshape(count, pixels) / 100 + 0.25 / (1e3 * AIR * -DIRECTION[2])
    np.testing.assert_allclose(read["surface_time"] - 0.4, arrival, rtol=1e-6)


@pytest.mark.parametrize("appended", [False, True])
def test_pulse_waves(tmp_path, appended):
    """An outgoing pulse, a channel of varying segments, and one of fixed length and 16 bits, behind 3 bytes."""
    samplings = [
        Sampling(kind=1, duration_bits=0, samples_bits=0, samples=4),
        Sampling(channel=1, duration_bits=32, scale=0.01, offset=100.0, segments_bits=8, spacing_ns=0.5),
        Sampling(channel=4, duration_bits=8, samples_bits=0, samples=6, bits=16),
    ]
    rng = np.random.default_rng(4)
    shots = []
    for number in range(5):
        segments = [Segment(70_000 + 321 * k, rng.integers(0, 255, 9).tolist()) for k in range(number % 3)]
        fixed = [Segment(number, rng.integers(0, 60_000, 6).tolist())]
        anchor = 1000 * number, 0, 400_000
        target = anchor[0] + 30_000, 0, 400_000 - 147_000
        shots.append(Shot(10**6 * number, anchor, target, [[Segment(0, [9] * 4)], segments, fixed]))
    write_pulse_waves(tmp_path / "one.pls", shots, samplings, centre=7, extra=3, appended=appended)
    found = read_waveforms(tmp_path / "one.pls", channel=4, lidar={"sea_level": 20.0})
    np.testing.assert_array_equal(found["signal"].values[:, 0], [shot.segments[2][0].samples for shot in shots])
    np.testing.assert_allclose(found["sample_start_ns"].values[:, 0] + 0.5, 7 + np.arange(5))
    np.testing.assert_allclose(found["gps_time"], 1000 + np.arange(5))
    assert found["signal"].attrs["units"] == "1"
    # 147 m down in 1000 ns, from 500 m in the file's heights, 7 ns after the pulse has left the scanner.
    assert found.attrs["altitude"] == pytest.approx(500 - 20 + 7 * 0.147)
    np.testing.assert_allclose(found["surface_time"].values[:, 0] - 0.5, 480 / 0.147 - np.arange(5))
    np.testing.assert_allclose(found["off_nadir"], np.degrees(np.arctan2(30, 147)))
    segments = read_waveforms(tmp_path / "one.wvs", (1, 5), 1)
    np.testing.assert_array_equal(segments["shot"], [1, 2, 2, 4])
    listed = [one for shot in shots for one in shot.segments[1]]
    np.testing.assert_array_equal(segments["signal"].values[:, 0], [one.samples for one in listed])
    starts = [7 + 100 + 0.01 * one.duration - 0.25 for one in listed]
    np.testing.assert_allclose(segments["sample_start_ns"].values[:, 0], starts)
    must_refuse(r"has samples 0\.5 and 1 ns apart: choose one channel", read_waveforms, tmp_path / "one.pls")
    with pytest.raises(UserError, match=r"has no waveform of channel 0"):  # that of the outgoing pulse
        read_waveforms(tmp_path / "one.pls", channel=0)


def las_with(path, **options):
    write_las(path, two_returns_each(3), Packets(random_counts(3)), **options)


def las_of(path, **packets):
    write_las(path, two_returns_each(3), Packets(random_counts(3), **packets))


def cut(path, count):
    path.write_bytes(path.read_bytes()[:-count])


#: What is done after a whole file is written, or how it is written; and the sentence.
WRONG_LAS = {
    "missing": (lambda path: path.with_suffix(".wdp").unlink(), "its waveforms in bad.wdp, which must lie beside it"),
    "compressed file": (
        lambda path: path.with_suffix(".wdp").rename(path.with_suffix(".wdz")),
        "bad.wdz has compressed waveforms, which are not read: ",
    ),
    "cut": (lambda path: cut(path.with_suffix(".wdp"), 5), "bad.wdp is cut: the samples of waveform 2 of .* 5 bytes"),
    "cut points": (lambda path: cut(path, 59 * 2), "bad.las is cut: it ends before the last of its 6 points"),
    "damaged": (lambda path: cut(path, path.stat().st_size - 200), "bad.las is damaged, or is not a LAS or LAZ file"),
    "offset": (lambda path: las_with(path, shift=2000), "waveform 0 of .*bad.las has its samples at byte 2060 of"),
    "early": (lambda path: las_with(path, shift=-10), "at byte 50 of .*: the offset must lie between 60 and 299"),
    "internal offset": (lambda path: las_with(path, shift=2000, internal=True), "between 60 and 299, the last byte"),
    "descriptor": (lambda path: las_with(path, record=101), "has no descriptor 1, which waveform 0 needs"),
    "bits": (lambda path: las_of(path, bits=12), "descriptor 1 of .*bad.las has 12 bits per sample: 8, 16 and 32 are"),
    "compressed": (lambda path: las_of(path, compression=1), r"bad.las has compressed waveforms \(type 1\), which are"),
    "spacing": (lambda path: las_of(path, spacing_ps=0), "has 40 samples, 0 ps apart: both must be above 0"),
    "no waveforms": (
        lambda path: laspy.LasData(laspy.LasHeader(version="1.4", point_format=6)).write(path),
        "has point format 6, without waveforms: it must be 4, 5, 9 or 10",
    ),
}


@each_row(*WRONG_LAS)
def test_wrong_las_files_are_refused(case, tmp_path):
    change, message = WRONG_LAS[case]
    las_with(tmp_path / "bad.las")
    change(tmp_path / "bad.las")
    must_refuse(message, read_waveforms, tmp_path / "bad.las")


def pls_with(path, sampling=None, **options):
    shots = [Shot(0, (0, 0, 0), (0, 0, -150_000), [[Segment(5, [1, 2, 3])]])] * 2
    write_pulse_waves(path, shots, [sampling or Sampling()], **options)


WRONG_PLS = {
    "missing": (lambda path: path.with_suffix(".wvs").unlink(), "its waveforms in bad.wvs, which must lie beside it"),
    "compressed file": (
        lambda path: path.with_suffix(".wvs").rename(path.with_suffix(".wvz")),
        "bad.wvz has compressed waveforms, which are not read",
    ),
    "cut": (lambda path: cut(path.with_suffix(".wvs"), 2), "bad.wvs is cut: the samples of pulse 1 .* 2 bytes after"),
    "cut pulses": (lambda path: cut(path, 150), "bad.pls is cut: it ends before the last of its 2 pulses"),
    "no records": (lambda path: cut(path, 40), "bad.pls is damaged, or is not a PulseWaves file"),
    "no waves": (lambda path: path.with_suffix(".wvs").write_bytes(bytes(100)), "bad.wvs is damaged, or is not a"),
    "offset": (lambda path: pls_with(path, shift=500), "pulse 0 of .*bad.pls has its samples at byte 560 of .*bad.wvs"),
    "descriptor": (lambda path: pls_with(path, index=3), "has no descriptor 3, which pulse 0 needs"),
    "bits": (lambda path: pls_with(path, Sampling(bits=12)), "descriptor 1 of .*bad.pls has 12 bits per sample"),
    "compressed": (lambda path: pls_with(path, Sampling(compression=1)), r"has compressed waveforms \(type 1\)"),
    "compressed pulses": (lambda path: pls_with(path, packed=1), r"bad.pls has compressed waveforms \(type 1\)"),
    "compressed waves": (lambda path: pls_with(path, packed_waves=1), r"bad.wvs has compressed waveforms \(type 1\)"),
    "numbers": (lambda path: pls_with(path, Sampling(spacing_ns=0.0)), "descriptor 1 of .*bad.pls is damaged"),
}


@each_row(*WRONG_PLS)
def test_wrong_pulse_waves_files_are_refused(case, tmp_path):
    change, message = WRONG_PLS[case]
    pls_with(tmp_path / "bad.pls")
    change(tmp_path / "bad.pls")
    must_refuse(message, read_waveforms, tmp_path / "bad.pls")


@refuses(
    ({"waveforms": (3, 3)}, "waveforms = 3:3 must end after 3, the first one"),
    ({"waveforms": (-1, 3)}, "waveforms = -1 must lie between 0"),
    ({"channel": "one"}, "channel = one must be a number, or the name of a field"),
    ({"lidar": {"altitud": 3}}, "lidar states altitud, which is none of altitude, sea_level"),
    ({"lidar": {"pulse_fwhm_ns": -3}}, "lidar has the attribute pulse_fwhm_ns = -3"),
)
def test_wrong_selections_are_refused(options, tmp_path):
    las_with(tmp_path / "one.las")
    open_file(tmp_path / "one.las", **options)


def test_memory_does_not_grow_with_the_file(tmp_path):
    """Peak of arrays while all waveforms of a file and of one four times as large are read."""
    peaks = []
    for count in (1000, 4000):
        packets = Packets([[1] * 200] * count)
        write_las(tmp_path / "one.las", [Return(k, (0, 0, 0), 0.0, TOWARDS) for k in range(count)], packets)
        tracemalloc.start()
        read = sum(part.sizes["shot"] for part in waveform_chunks(tmp_path / "one.las", size=250))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert read == count
    # What is read ahead is the whole of the smaller file of samples, 0.4 MB, and up to 4 MB of the larger one.
    assert peaks[1] < peaks[0] + 3e6


WATER = {"altitude": 300.0, "pulse_fwhm_ns": 4.0, "group_index": 1.364, "refractive_index": 1.34, "sea_level": 0.0}


def water_file(path, depth=3.0, count=24, channels=1):
    """Write waveforms of a sea of a depth, seen at nadir; return the time between the echoes [ns]."""
    rng, time = np.random.default_rng(5), 0.5 * np.arange(240)
    delay = 2e9 * depth * 1.364 / C0
    down = (0.0, 0.0, AIR)
    signal, returns = [], []
    for shot in range(count):
        surface = 40 + rng.uniform(-0.5, 0.5)
        echoes = 900 * np.exp(-4 * np.log(2) * ((time - surface) / 4) ** 2)
        echoes += 400 * np.exp(-4 * np.log(2) * ((time - surface - delay) / 4) ** 2)
        signal.append(np.rint(120 + echoes + rng.normal(0, 3, time.size)).astype(int).tolist())
        pulse, channel = divmod(shot, channels)
        returns.append(Return(shot, (0, 0, 0), 1000 * surface, down, gps_time=pulse / 1e3, channel=channel))
    write_las(path, returns, Packets(signal, gain=1e-3, offset=-0.1))
    return delay


def test_echoes_of_a_file(tmp_path):
    """Depths of a known sea; the rows of a command are those of the function, part by part: here channel by channel."""
    delay = water_file(tmp_path / "sea.las", channels=2)
    found = mitransient_lidar.echoes(read_waveforms(tmp_path / "sea.las", lidar=WATER))
    bottom, surface = (found["time_ns"].sel(echo=name).values for name in ("bottom", "surface"))
    error = found["time_ns_stderr"].sel(echo="bottom").values
    assert abs(np.mean(bottom - surface) - delay) < 0.05
    assert np.std(bottom - surface) < 3 * np.median(error)
    np.testing.assert_allclose(found["depth_m"].sel(echo="bottom"), 3.0, atol=0.08)
    options = [part for name, value in WATER.items() for part in ("--lidar", f"{name}={value}")]
    written = run("echoes", tmp_path / "sea.las", *options, "--csv", tmp_path / "out.csv", "--no-table")
    assert written.exit_code == 0, written.stderr
    rows = (tmp_path / "out.csv").read_text().splitlines()
    assert [row.startswith("shot,pixel,") for row in rows] == [True] + [False] * found["time_ns"].size


def test_commands_take_files(tmp_path):
    water_file(tmp_path / "sea.las")
    same = run("compare", tmp_path / "sea.las", tmp_path / "sea.las", "-o", tmp_path / "same.png")
    assert same.stdout.splitlines()[1].startswith("agree: 240 bins, rms 0.00"), same.stderr
    for target in ("sea.png", "sea.html"):
        shown = run("view", tmp_path / "sea.las", "--waveforms", "3:9", "--no-browser", "-o", tmp_path / target)
        assert shown.exit_code == 0, shown.stderr
        assert (tmp_path / target).stat().st_size > 1000
    for options, message in (
        ((), "sea.las does not state pulse_fwhm_ns and altitude: give them with lidar (--lidar"),
        (("--waveforms", "3-9"), "--waveforms 3-9 is not of the form FIRST:END"),
        (("--waveforms", "90:"), "has no waveform from number 90 to the last one"),
        (("--lidar", "altitude"), "--lidar altitude is not of the form name=value"),
    ):
        assert_refused(run("echoes", tmp_path / "sea.las", *options), message)
    (tmp_path / "sea.wdp").unlink()
    free = ("--free", "attenuation", "--scene", "table1")
    for command, *options in (("echoes",), ("view", "--channel", "0"), ("fit", *free)):
        assert_refused(run(command, tmp_path / "sea.las", *options), "sea.las has its waveforms in sea.wdp")
    assert_refused(run("view", tmp_path / "sea.nc", "--channel", 1), "--channel is for LAS, LAZ and PulseWaves files")


def test_fits_get_the_mean_above_the_dark_level(tmp_path, caplog):
    """As from a table: times and unit unknown, except the times of one waveform that the file places."""
    water_file(tmp_path / "sea.las")
    dataset = read_waveforms(tmp_path / "sea.las", lidar=WATER)
    found = measured(dataset)
    dark = dataset["signal"].values[:, 0, :40]
    assert not found.calibrated
    assert found.template.attrs["units"] == "V"
    assert found.shots == 24
    assert abs(found.values[0, :40].mean()) < 5 * dark.std() / np.sqrt(dark.size)
    assert found.values.max() == pytest.approx(0.9, rel=0.1)
    assert not caplog.records
    one = measured(dataset.isel(shot=[2]), noise=0.003)
    start = float(dataset["sample_start_ns"][2, 0])
    np.testing.assert_allclose(one.time_ns, start + (np.arange(240) + 0.5) * 0.5)
    np.testing.assert_array_equal(one.stderr, 0.003)
    peak = one.time_ns[np.argmax(one.values[0])]
    assert abs(peak - 2e9 * 300 / C0) < 1
    measured(dataset.assign_coords(surface_time=dataset["surface_time"] * 2))
    assert "the first returns of 24 waveforms spread by" in caplog.text
