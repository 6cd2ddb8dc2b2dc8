"""Files of points and waveforms, read by a reader from the specification and by other programs."""

from __future__ import annotations

import re
import resource
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
import xarray as xr
from oracles import las_reader
from rows import each_case, each_row, must_refuse

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError, WriteError
from mitransient_lidar.flights import las
from mitransient_lidar.flights.las import write_points, write_waveforms

SHOTS, PIXELS, SAMPLES = 60, 4, 50
GAIN, OFFSET = 2e-4, -0.05  # [V per count], [V]


@pytest.fixture
def points() -> xr.Dataset:
    """Points of a flight in UTM coordinates: surface and bottom of each pixel, some without an echo."""
    rng = np.random.default_rng(5)
    count = 2 * SHOTS * PIXELS
    pulse = np.arange(count) // 2
    kind = np.where(np.arange(count) % 2, rng.choice([40, 43, 45], count), 41)
    depth = np.where((kind == 40) | (kind == 43), rng.uniform(2, 9, count), np.nan)
    direction = rng.normal([0.2, 0.1, -1], 0.1, (count, 3))
    values = {
        "x": rng.uniform(499_900, 500_400, count),
        "y": rng.uniform(6_500_000, 6_501_000, count),
        "z": rng.normal(-4, 3, count),
        "gps_time": pulse // PIXELS / 1e4,
        "kind": kind,
        "return_number": 1 + np.arange(count) % 2,
        "number_of_returns": np.full(count, 2),
        "scan_angle_deg": rng.uniform(-21, 21, count),
        "line": 1 + pulse // 100,
        "pixel": pulse % PIXELS,
        "channel": pulse % PIXELS,
        "shot": pulse // PIXELS,
        "depth": depth,
        **{f"{name}_uncertainty": rng.uniform(0.01, 0.5, count) for name in ("depth", "horizontal", "vertical")},
        "quality": np.where(pulse % 7 == 0, 1, 12 * (kind == 40)),
        "withheld": pulse % 7 == 0,
        "packet": np.where(pulse % 5 == 4, -1, pulse),
        "time_in_packet_ns": rng.uniform(0, SAMPLES, count),
    }
    dataset = xr.Dataset({name: ("point", value) for name, value in values.items()})
    dataset["intensity"] = ("point", rng.uniform(0, 0.8, count), {"full_scale": 0.8, "units": "V"})
    dataset["direction"] = (("point", "axis"), direction / np.linalg.norm(direction, axis=-1, keepdims=True))
    return dataset


@pytest.fixture
def waveforms() -> xr.Dataset:
    counts = np.random.default_rng(6).integers(0, 4096, (SHOTS * PIXELS, SAMPLES)).astype(np.uint16)
    return waveform_dataset(counts)


def waveform_dataset(values: Any, **changes: float) -> xr.Dataset:
    attributes = {"gain": GAIN, "offset": OFFSET, "sampling_ns": 0.5} | changes
    return xr.Dataset({"waveform": (("packet", "sample"), values, attributes)})


def chunks(points: xr.Dataset, waveforms: xr.Dataset, pulses: int) -> tuple[list[xr.Dataset], list[xr.Dataset]]:
    """Split points and waveforms at numbers of pulses in pixels; packets count from 0 in each chunk."""
    parts, packets = [], []
    for start in range(0, SHOTS * PIXELS, pulses):
        part = points.isel(point=slice(2 * start, 2 * (start + pulses)))
        parts.append(part.assign(packet=part["packet"].where(part["packet"] < 0, part["packet"] - start)))
        packets.append(waveforms.isel(packet=slice(start, start + pulses)))
    return parts, packets


def read_column(file: las_reader.LasFile, name: str) -> np.ndarray:
    return np.array([point.extra.get(name, getattr(point, name, None)) for point in file.points])


@pytest.mark.parametrize("point_format", [6, 9])
def test_read_from_the_specification(
    tmp_path: Path, points: xr.Dataset, waveforms: xr.Dataset, point_format: int
) -> None:
    path = tmp_path / "flight.las"
    if point_format == 6:
        assert write_points(path, points) == points.sizes["point"]
    else:
        assert write_waveforms(path, points, waveforms) == points.sizes["point"]
    file = las_reader.read(path)
    assert (file.version, file.header_size, file.format) == ((1, 4), 375, point_format)
    # GPS week time, external waveforms in format 9, WKT.
    assert file.encoding == (0b10000 if point_format == 6 else 0b10100)
    assert (file.start_of_waveforms, file.extended_records, file.legacy_counts) == (0, 0, [0] * 6)
    assert file.by_return == [SHOTS * PIXELS] * 2 + [0] * 13
    assert len(file.points) == points.sizes["point"]
    # Coordinates, angles and intensities are rounded to their units; all other numbers are exact.
    position = read_column(file, "position")
    given = np.stack([points[axis] for axis in "xyz"], axis=-1)
    assert np.max(np.abs(position - given)) <= 0.5e-3 + 1e-9
    assert np.all(position.min(axis=0) >= np.array(file.low) - 1e-9)
    assert np.all(position.max(axis=0) <= np.array(file.high) + 1e-9)
    assert np.max(np.abs(read_column(file, "scan_angle_deg") - points["scan_angle_deg"])) <= 0.003 + 1e-9
    pairs = {"classification": "kind", "source": "line", "shot": "shot", "pixel": "pixel", "gps_time": "gps_time"}
    for read, name in {**pairs, "return_number": "return_number", "number_of_returns": "number_of_returns"}.items():
        np.testing.assert_array_equal(read_column(file, read), points[name])
    for name in ("depth", "depth_uncertainty", "horizontal_uncertainty", "vertical_uncertainty"):
        np.testing.assert_array_equal(read_column(file, name).astype(np.float32), points[name].astype(np.float32))


@each_case(
    ("flight", 0, 0, "as in the trajectory of the flight, not of a known GPS week"),
    ("gps_week", 0, 0, "seconds of the GPS week"),
    ("adjusted_gps", 0, 1, "adjusted standard GPS time"),
    ("gps", 1e9, 1, "adjusted standard GPS time"),
)
def test_times_their_type_and_the_notes_agree(system, less, bit, text, tmp_path, points, waveforms):
    """Adjusted standard GPS time is GPS time less 10^9 s (LAS 1.4 R15, table 4, bit 0 of the global encoding)."""
    points["gps_time"] = points["gps_time"] + less + 1000
    points["gps_time"].attrs["time_system"] = system
    write_points(tmp_path / "points.las", points)
    write_waveforms(tmp_path / "waveforms.las", points, waveforms)
    for name in ("points.las", "waveforms.las"):
        file = las_reader.read(tmp_path / name)
        assert file.encoding & 1 == bit
        assert text in file.records["LASF_Spec", 3].decode("ascii")
        np.testing.assert_array_equal(read_column(file, "gps_time"), points["gps_time"] - less)


def test_notes_give_the_scale_of_intensities(tmp_path: Path, points: xr.Dataset) -> None:
    points["intensity"].values[:3] = [-0.1, 7.0, np.nan]
    write_points(tmp_path / "points.las", points)
    file = las_reader.read(tmp_path / "points.las")
    notes = file.records["LASF_Spec", 3].rstrip(b"\0").decode("ascii")
    step = float(re.search(r"Intensity: 1 is (\S+) V\.", notes)[1])
    read = read_column(file, "intensity")
    assert read[:3].tolist() == [0, 65535, 0]
    assert np.max(np.abs(step * read[3:] - points["intensity"][3:])) <= 0.5001 * step


def test_echoes_between_surface_and_bottom_may_be_vegetation(tmp_path: Path, points: xr.Dataset) -> None:
    """Class 46 of the draft profile, also in the notes; user data is the transmitter."""
    kind, infrared = points["kind"].values, points["shot"].values % 2
    points["kind"].attrs["object_class"] = 46
    write_points(tmp_path / "points.las", points.assign(transmitter=("point", infrared)))
    file = las_reader.read(tmp_path / "points.las")
    assert b"46 submerged vegetation" in file.records["LASF_Spec", 3]
    assert [point.classification for point in file.points] == np.where(kind == 43, 46, kind).tolist()
    np.testing.assert_array_equal(laspy.read(tmp_path / "points.las").user_data, infrared)


def test_points_without_an_echo_are_synthetic_and_doubtful_ones_withheld(tmp_path: Path, points: xr.Dataset) -> None:
    write_points(tmp_path / "points.las", points)
    file = las_reader.read(tmp_path / "points.las")
    synthetic, withheld = ([point.flags >> bit & 1 for point in file.points] for bit in (0, 2))
    assert synthetic == [point.classification == 45 for point in file.points]
    np.testing.assert_array_equal(withheld, points["withheld"])
    np.testing.assert_array_equal(read_column(file, "quality"), points["quality"])


def test_pixels_of_a_pulse_are_told_apart_by_standard_fields(tmp_path: Path, points: xr.Dataset) -> None:
    write_points(tmp_path / "points.laz", points)
    read = laspy.read(tmp_path / "points.laz")
    np.testing.assert_array_equal(read.scanner_channel, points["pixel"])
    keys = np.stack([read.gps_time, read.scanner_channel, read.return_number], axis=1)
    assert len(np.unique(keys, axis=0)) == points.sizes["point"]


def test_extra_bytes_are_described_and_missing_numbers_are_nan(tmp_path: Path, points: xr.Dataset) -> None:
    write_points(tmp_path / "points.laz", points)
    extra = las_reader.read(tmp_path / "points.laz").extra
    assert [item.name for item in extra] == [item.name for item in las.EXTRA_BYTES]
    for item in extra:
        assert item.description
        missing = item.type == "f"
        assert item.options == missing
        assert np.isnan(item.no_data) == missing


def test_compressed_points_are_those_without_compression(tmp_path: Path, points: xr.Dataset) -> None:
    for name in ("points.las", "points.laz"):
        write_points(tmp_path / name, points)
    plain, compressed = (laspy.read(tmp_path / name) for name in ("points.las", "points.laz"))
    assert compressed.header.are_points_compressed
    assert (tmp_path / "points.laz").stat().st_size < 0.7 * (tmp_path / "points.las").stat().st_size
    assert compressed.points.array.tobytes() == plain.points.array.tobytes()
    np.testing.assert_allclose(compressed.x, points["x"], rtol=0, atol=0.51e-3)
    np.testing.assert_array_equal(compressed["shot"], points["shot"])


@each_row("EPSG:32633", "EPSG:32633+5773")
def test_coordinate_system_by_code(crs, tmp_path, points):
    write_points(tmp_path / "points.las", points, crs)
    record = las_reader.read(tmp_path / "points.las").records["LASF_Projection", 2112]
    assert pyproj.CRS.from_wkt(record.rstrip(b"\0").decode()).equals(pyproj.CRS(crs), ignore_axis_order=True)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:2263", "EPSG:4978", "EPSG:99999999", "somewhere"])
def test_unsuitable_coordinate_systems(tmp_path: Path, points: xr.Dataset, crs: str) -> None:
    with pytest.raises(UserError, match=rf"^crs = '{re.escape(crs)}' .*(EPSG:32633|must be projected)"):
        write_points(tmp_path / "points.las", points, crs)
    assert not any(tmp_path.iterdir())


def test_web_mercator_is_refused_where_its_metres_are_not_those_on_the_ground(tmp_path, points):
    x, y = pyproj.Transformer.from_crs(4326, 3857, always_xy=True).transform(12, 58)
    moved = points.assign(x=0 * points.x + x, y=0 * points.y + y)
    with pytest.raises(UserError, match=r"crs = 'EPSG:3857' has coordinates in .*Mercator, .* are 1\.887 times"):
        write_points(tmp_path / "points.las", moved, "EPSG:3857")
    assert not any(tmp_path.iterdir())


def test_packets(tmp_path: Path, points: xr.Dataset, waveforms: xr.Dataset) -> None:
    write_waveforms(tmp_path / "waveforms.las", points, waveforms)
    file, wdp = las_reader.read(tmp_path / "waveforms.las"), tmp_path / "waveforms.wdp"
    assert las_reader.packet_header(wdp) == ("LASF_Spec", 65535, 2 * SAMPLES * SHOTS * PIXELS)
    assert wdp.stat().st_size == 60 + 2 * SAMPLES * SHOTS * PIXELS
    for index, point in enumerate(file.points):
        number = int(points["packet"][index])
        if number < 0:
            assert point.packet is None
            continue
        descriptor = file.descriptor(point.packet)
        assert descriptor == (16, 0, SAMPLES, 500, GAIN, OFFSET)
        assert (point.packet.descriptor, point.packet.size) == (1, 2 * SAMPLES)
        expected = OFFSET + GAIN * waveforms["waveform"].values[number]
        np.testing.assert_allclose(las_reader.volts(wdp, point.packet, descriptor), expected, rtol=1e-12, atol=1e-15)
        assert point.packet.location_ps == pytest.approx(1e3 * float(points["time_in_packet_ns"][index]), rel=1e-7)


def test_volts_become_counts_and_short_packets_are_padded(tmp_path: Path, points: xr.Dataset) -> None:
    volts = np.random.default_rng(7).uniform(OFFSET, OFFSET + GAIN * 65535, (SHOTS * PIXELS, SAMPLES))
    volts[3, 20:] = np.nan
    parts, packets = chunks(points, waveform_dataset(volts), SHOTS * PIXELS // 2)
    packets[1] = packets[1].isel(sample=slice(30))
    write_waveforms(tmp_path / "waveforms.las", parts, packets)
    file, wdp = las_reader.read(tmp_path / "waveforms.las"), tmp_path / "waveforms.wdp"
    given = volts.copy()
    given[SHOTS * PIXELS // 2 :, 30:] = np.nan
    given[np.isnan(given)] = 0
    for index, number in enumerate(points["packet"].values):
        if number >= 0:
            packet = file.points[index].packet
            read = np.array(las_reader.volts(wdp, packet, file.descriptor(packet)))
            assert np.max(np.abs(read - given[number])) <= 0.5 * GAIN * (1 + 1e-9)


@pytest.mark.parametrize("pulses", [23, 97])
def test_chunks_make_the_same_files(tmp_path: Path, points: xr.Dataset, waveforms: xr.Dataset, pulses: int) -> None:
    write_points(tmp_path / "whole.laz", points)
    write_waveforms(tmp_path / "whole.las", points, waveforms)
    parts, packets = chunks(points, waveforms, pulses)
    parts.insert(1, points.isel(point=slice(0)))
    packets.insert(1, waveforms.isel(packet=slice(0)))
    write_points(tmp_path / "parts.laz", iter(parts))
    write_waveforms(tmp_path / "parts.las", iter(parts), iter(packets))
    for suffix in (".laz", ".las", ".wdp"):
        assert (tmp_path / f"parts{suffix}").read_bytes() == (tmp_path / f"whole{suffix}").read_bytes()


def test_published_example_of_the_vector_along_the_beam() -> None:
    """The figure's returns 1 of 3 and 2 of 3 lie where the vectors of the returns below them lead."""
    air, water = (5.09232e-5, 6.42373e-6, 1.34235e-4), (2.9922e-5, 1.89773e-6, 1.38175e-4)
    first, second, third = (523374.66, 2432928.34, 5.68), (523372.71, 2432928.09, 0.53), (523371.65, 2432928.02, -4.36)
    returns = [(first, 14681.2, air), (second, 53043.8, air), (third, 88432.8, water)]
    # The figure rounds coordinates to centimetres.
    np.testing.assert_allclose(las_reader.sample_position(returns[1:], 14681.2), first, rtol=0, atol=0.0101)
    np.testing.assert_allclose(las_reader.sample_position(returns[2:], 53043.8), second, rtol=0, atol=0.0101)


def test_samples_lie_on_the_refracted_ray(tmp_path: Path, points: xr.Dataset, waveforms: xr.Dataset) -> None:
    """Light from 300 m to a bottom at 12 m: each sample is where the light was at half its time, in air and water."""
    n, group_index, height, depth, lead_ns = 1.34, 1.364, 300.0, 12.0, 20.0
    sine = np.sin(np.radians(20))
    air = np.array([sine * 0.6, sine * 0.8, -np.sqrt(1 - sine**2)])
    water = np.array([*(air[:2] / n), -np.sqrt(1 - (sine / n) ** 2)])
    lidar = np.array([5e5 + 12.3456, 6.5e6 - 7.89, height])
    surface = lidar + air * height / -air[2]
    bottom = surface + water * depth / -water[2]
    surface_ns = 2e9 * height / -air[2] / C0
    water_ns = 2e9 * group_index * depth / -water[2] / C0
    pair = points.isel(point=slice(2))
    for number, axis in enumerate("xyz"):
        pair[axis] = ("point", [surface[number], bottom[number]])
    pair["direction"] = (("point", "axis"), [air, water])
    pair["group_speed"] = ("point", [C0, C0 / group_index])
    pair["time_in_packet_ns"] = ("point", [lead_ns, lead_ns + water_ns])
    write_waveforms(tmp_path / "waveforms.las", pair, waveforms)
    read = las_reader.read(tmp_path / "waveforms.las").points
    returns = [(point.position, point.packet.location_ps, point.packet.step) for point in read]
    rounding = np.sqrt(3) * 0.5e-3 + 1e-5  # of coordinates, and of single precision over 20 m
    for time_ns in np.linspace(0, lead_ns + water_ns + 10, 40):
        half_s = 0.5e-9 * (surface_ns - lead_ns + time_ns)
        true = lidar + air * C0 * half_s
        if time_ns > lead_ns:
            true = surface + water * C0 / group_index * 0.5e-9 * (time_ns - lead_ns)
        assert np.linalg.norm(las_reader.sample_position(returns, 1e3 * time_ns) - true) < rounding
    # The vectors point up to the lidar: the first sample is above the sea, the last one below the bottom.
    assert las_reader.sample_position(returns, 0)[2] > 2
    assert las_reader.sample_position(returns, 1e3 * (lead_ns + water_ns + 10))[2] < -depth - 0.5


@each_case(
    ("x", np.nan, "x holds nan"),
    ("z", np.inf, "z holds inf"),
    ("y", 1e10, "y = 1e+10 m must be within 2147 km of 6.5e+06 m"),
    ("gps_time", np.nan, "gps_time holds nan"),
    ("return_number", 3, "return_number = 3 must be at most number_of_returns, 2"),
    ("number_of_returns", 16, "number_of_returns = 16 must lie between 1 and 15"),
    ("return_number", 0, "return_number = 0 must lie between 1 and 15"),
    ("kind", 256, "kind = 256 must lie between 0 and 255"),
    ("scan_angle_deg", -181, "scan_angle_deg = -181 must lie between -180 and 180"),
    ("pixel", 65536, "pixel = 65536 must lie between 0 and 65535"),
    ("quality", 256, "quality = 256 must lie between 0 and 255"),
    ("channel", 4, "channel = 4 must lie between 0 and 3"),
    ("shot", -1, "shot = -1 must lie between 0 and 4294967295"),
    ("line", 70000, "line = 70000 must lie between 0 and 65535"),
    ("packet", 240, "packet = 240 must lie between -1, for none, and 239, the last packet"),
    ("time_in_packet_ns", np.nan, "time_in_packet_ns holds nan"),
    ("direction", 0.5, "direction has the length"),
)
def test_wrong_points(name, value, message, tmp_path, points, waveforms):
    path = tmp_path / "waveforms.las"
    path.write_text("former")
    points[name].values[7] = value
    must_refuse(re.escape(message), write_waveforms, path, points, waveforms)
    assert path.read_text() == "former"
    assert list(tmp_path.iterdir()) == [path]


@each_row(
    ({"gain": 0.0}, "gain = 0 must be greater than 0"),
    ({"offset": np.nan}, "offset = nan"),
    ({"sampling_ns": 0.8333}, "sampling_ns = 0.8333 must be a whole number of picoseconds"),
    ({"sampling_ns": -1.0}, "sampling_ns = -1 must be greater than 0"),
    ({"gain": 1e-6}, "must lie between -0.05 and 0.015535 V"),
)
def test_wrong_waveforms(changes, message, tmp_path, points):
    values = waveform_dataset(np.full((SHOTS * PIXELS, SAMPLES), 0.5), **changes)
    must_refuse(re.escape(message), write_waveforms, tmp_path / "waveforms.las", points, values)
    assert not any(tmp_path.iterdir())


def test_later_waveforms_that_differ(tmp_path: Path, points: xr.Dataset, waveforms: xr.Dataset) -> None:
    parts, packets = chunks(points, waveforms, 20)
    for second, message in (
        (waveform_dataset(np.zeros((20, SAMPLES + 1))), "51 samples is longer than the first ones, 50"),
        (waveform_dataset(np.zeros((20, SAMPLES)), gain=1e-3), "gain = 0.001 must be that of the first waveforms"),
    ):
        packets[1] = second
        must_refuse(re.escape(message), write_waveforms, tmp_path / "waveforms.las", parts, packets)
        assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["points.las", "points.laz", "waveforms.las"])
def test_files_that_cannot_be_completed(tmp_path: Path, points: xr.Dataset, waveforms: xr.Dataset, name: str) -> None:
    many = xr.concat([points] * 20, "point").assign(packet=("point", np.full(20 * points.sizes["point"], -1)))
    (tmp_path / name).write_text("former")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(WriteError, match=rf"^cannot write .*{name[:-4]}\.\w+: File too large$"):
            write_waveforms(tmp_path / name, many, waveforms) if "wave" in name else write_points(tmp_path / name, many)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (tmp_path / name).read_text() == "former"
    assert len(list(tmp_path.iterdir())) == 1
