"""Reader of LAS 1.4 files from the text of the specification (R15), with nothing but struct: formats 6 and 9, WDP."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

# Section 2.4: file source, global encoding, project, version, system, software, day, year, header size, offset to the
# points, number of records, format, length of a point, legacy counts, scales, offsets, extents, starts, counts.
_HEADER = struct.Struct("<4sHH16sBB32s32sHHHIIBH I5I 3d3d 6d QQI Q15Q")
_RECORD = struct.Struct("<2x16sHH32s")
_EXTENDED = struct.Struct("<H16sHQ32s")
_EXTRA = struct.Struct("<2xBB32s4xd16xd16xd16xd16xd16x32s")
_POINT = struct.Struct("<iii HBBBBhHd")
_WAVE = struct.Struct("<BQI4f")
_DESCRIPTOR = struct.Struct("<BBIIdd")
_TYPES = {1: "B", 2: "b", 3: "H", 4: "h", 5: "I", 6: "i", 7: "Q", 8: "q", 9: "f", 10: "d"}

Vector = tuple[float, float, float]


class Descriptor(NamedTuple):
    bits: int
    compression: int
    samples: int
    spacing_ps: int
    gain: float
    offset: float

    @classmethod
    def of(cls, record: bytes) -> Descriptor:
        return cls(*_DESCRIPTOR.unpack(record))


class Packet(NamedTuple):
    descriptor: int
    start: int
    size: int
    location_ps: float
    step: Vector  # [m/ps]


@dataclass
class Point:
    position: Vector
    intensity: int
    return_number: int
    number_of_returns: int
    flags: int
    channel: int
    classification: int
    scan_angle_deg: float
    source: int
    gps_time: float
    packet: Packet | None
    extra: dict[str, float]


class Extra(NamedTuple):
    name: str
    type: str
    options: int
    no_data: float
    description: str


@dataclass
class LasFile:
    header_size: int
    version: tuple[int, int]
    encoding: int
    format: int
    length: int
    system: str
    software: str
    scales: Vector
    low: Vector
    high: Vector
    start_of_waveforms: int
    extended_records: int
    by_return: list[int]
    legacy_counts: list[int]
    records: dict[tuple[str, int], bytes]
    extra: list[Extra]
    points: list[Point]

    def descriptor(self, packet: Packet) -> Descriptor:
        return Descriptor.of(self.records["LASF_Spec", 99 + packet.descriptor])


def read(path: Path) -> LasFile:
    data = path.read_bytes()
    assert _HEADER.size == 375
    (magic, _, encoding, _, major, minor, system, software, _, _, size, start, n_records, kind, length, *rest) = (
        _HEADER.unpack_from(data)
    )
    assert magic == b"LASF"
    legacy, scales, offsets, extent, (waves, _, extended, count), by_return = (
        rest[:6], rest[6:9], rest[9:12], rest[12:18], rest[18:22], rest[22:],
    )  # fmt: skip
    at, records = size, {}
    for _ in range(n_records):
        user, number, after, _ = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        records[_text(user), number] = data[at : at + after]
        at += after
    assert at <= start
    assert len(data) == start + count * length or kind & 0x80
    extra = [_extra(*item) for item in _EXTRA.iter_unpack(records.get(("LASF_Spec", 4), b""))]
    points = []
    for number in range(count if not kind & 0x80 else 0):
        points.append(_point(data, start + number * length, kind, scales, offsets, extra))
        assert _size(kind) + sum(struct.calcsize(item.type) for item in extra) == length
    low, high = tuple(extent[1::2]), tuple(extent[0::2])
    return LasFile(
        size, (major, minor), encoding, kind, length, _text(system), _text(software), tuple(scales), low, high, waves,
        extended, list(by_return), legacy, records, extra, points,
    )  # fmt: skip


def packet_header(path: Path) -> tuple[str, int, int]:
    """Return user, record number, and bytes that follow, of a file of waveform packets."""
    with path.open("rb") as file:
        reserved, user, number, after, _ = _EXTENDED.unpack(file.read(60))
    assert reserved == 0
    return _text(user), number, after


def volts(path: Path, packet: Packet, descriptor: Descriptor) -> list[float]:
    """Return the samples of a packet of 16 bits; byte offsets count from the beginning of the file."""
    assert (descriptor.bits, descriptor.compression) == (16, 0)
    with path.open("rb") as file:
        file.seek(packet.start)
        raw = struct.unpack(f"<{descriptor.samples}H", file.read(packet.size))
    return [descriptor.offset + descriptor.gain * value for value in raw]


def sample_position(returns: list[tuple[Vector, float, Vector]], time_ps: float) -> Vector:
    """Return the place of light that arrives a time after a packet's first sample, of returns (point, L, d) in order.

    Figure "LAS_FWF_illustration_refracted" of the LAS working group: the vector d of a return, which points towards the
    lidar, holds from this return up to the one before it, of the last return also beyond it.
    """
    point, location, step = next((item for item in returns if time_ps <= item[1]), returns[-1])
    return tuple(p + (location - time_ps) * d for p, d in zip(point, step, strict=True))


def _point(data: bytes, at: int, kind: int, scales: list[float], offsets: list[float], extra: list[Extra]) -> Point:
    x, y, z, intensity, returns, flags, group, _, angle, source, time = _POINT.unpack_from(data, at)
    packet = None
    if kind == 9:
        descriptor, start, size, location, *step = _WAVE.unpack_from(data, at + _POINT.size)
        packet = Packet(descriptor, start, size, location, tuple(step)) if descriptor else None
    at += _size(kind)
    values = {}
    for item in extra:
        (values[item.name],) = struct.unpack_from(f"<{item.type}", data, at)
        at += struct.calcsize(item.type)
    position = tuple(n * s + o for n, s, o in zip((x, y, z), scales, offsets, strict=True))
    return Point(
        position, intensity, returns & 15, returns >> 4, flags & 15, flags >> 4 & 3, group, angle * 0.006, source, time,
        packet, values,
    )  # fmt: skip


def _size(kind: int) -> int:
    return {6: 30, 9: 59}[kind & 0x3F]


def _extra(kind: int, options: int, name: bytes, no_data: float, *rest: float | bytes) -> Extra:
    return Extra(_text(name), _TYPES[kind], options, no_data, _text(rest[-1]))


def _text(value: bytes) -> str:
    return value.rstrip(b"\0").decode("ascii")
