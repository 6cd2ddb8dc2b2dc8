"""Writers of full-waveform LAS and PulseWaves files from the text of their specifications, with nothing but struct."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

_CODES = {8: "B", 16: "H", 32: "I"}


class Return(NamedTuple):
    """One point of a LAS file that refers to a packet; None for none. The place is in mm, the vector in m/ps."""

    packet: int | None
    place: tuple[int, int, int]
    location_ps: float
    vector: tuple[float, float, float]
    gps_time: float = 0.0
    channel: int = 0
    user_data: int = 0
    descriptor: int = 1


class Packets(NamedTuple):
    """Packets of one descriptor: bits, compression, spacing [ps], gain and offset [V]."""

    counts: Sequence[Sequence[int]]
    bits: int = 16
    compression: int = 0
    spacing_ps: int = 500
    gain: float = 1.0
    offset: float = 0.0

    @property
    def descriptor(self) -> bytes:
        about = self.bits, self.compression, len(self.counts[0]), self.spacing_ps, self.gain, self.offset
        return struct.pack("<BBIIdd", *about)

    def data(self) -> list[bytes]:
        """Bytes of each packet."""
        return [struct.pack(f"<{len(one)}{_CODES.get(self.bits, 'H')}", *one) for one in self.counts]


def write_las(
    path: Path,
    returns: Sequence[Return],
    packets: Packets,
    point_format: int = 9,
    *,
    internal: bool = False,
    shift: int = 0,
    record: int = 100,
) -> None:
    """Write a file of LAS 1.4; packets lie in it or in a .wdp. `shift` is added to all offsets [bytes]."""
    data = packets.data()
    starts, at = [], 60
    for one in data:
        starts.append(at)
        at += len(one)
    points = b""
    for one in returns:
        has = one.packet is not None
        if point_format in (4, 5):
            fields = *one.place, 7, 0b001001, 2, 0, one.user_data, 3, one.gps_time
            point = struct.pack("<iiiHBBbBHd", *fields) + (b"\0" * 6 if point_format == 5 else b"")
        else:
            fields = *one.place, 7, 0x11, one.channel << 4, 2, one.user_data, 0, 3, one.gps_time
            point = struct.pack("<iiiHBBBBhHd", *fields) + (b"\0" * 8 if point_format == 10 else b"")
        start = starts[one.packet] + shift if has else 0
        size = len(data[one.packet]) if has else 0
        points += point + struct.pack("<BQI4f", one.descriptor * has, start, size, one.location_ps, *one.vector)
    vlr = struct.pack("<2x16sHH32s", b"LASF_Spec", record, 26, b"") + packets.descriptor
    first = 375 + len(vlr)
    waves_at = first + len(points)
    length = len(points) // len(returns)
    legacy = len(returns) if point_format < 6 else 0
    header = struct.pack(
        "<4sHH16sBB32s32sHHHIIBHI5I12dQQI16Q",
        *(b"LASF", 1, (1 << 1 if internal else 1 << 2), b"", 1, 4, b"TEST", b"TEST", 1, 2026, 375, first, 1),
        *(point_format, length, legacy, legacy, 0, 0, 0, 0),
        *(1e-3, 1e-3, 1e-3, 0.0, 0.0, 0.0, *[0.0] * 6),
        *((waves_at, waves_at, 1) if internal else (0, 0, 0)),
        *(len(returns), len(returns), *[0] * 14),
    )
    waves = struct.pack("<H16sHQ32s", 0, b"LASF_Spec", 65535, at - 60, b"") + b"".join(data)
    path.write_bytes(header + vlr + points + (waves if internal else b""))
    if not internal:
        path.with_suffix(".wdp").write_bytes(waves)


class Segment(NamedTuple):
    """Samples of a sampling, and the time from the anchor to the first one [sampling units over the scale]."""

    duration: int
    samples: Sequence[int]


class Sampling(NamedTuple):
    """Sampling record; numbers of bits are 0 for fixed numbers of segments or samples."""

    kind: int = 2
    channel: int = 0
    duration_bits: int = 16
    scale: float = 1.0
    offset: float = 0.0
    segments_bits: int = 0
    samples_bits: int = 16
    segments: int = 1
    samples: int = 0
    bits: int = 8
    spacing_ns: float = 1.0
    compression: int = 0

    @property
    def record(self) -> bytes:
        """Bytes of the record, with 4 bytes that later versions may add."""
        fields = 108, 0, self.kind, self.channel, 0, self.duration_bits, self.scale, self.offset
        numbers = self.segments_bits, self.samples_bits, self.segments, self.samples, self.bits, 0
        return struct.pack("<IIBBBBffBBHIHHfI", *fields, *numbers, self.spacing_ns, self.compression) + bytes(68)

    def data(self, segments: Sequence[Segment]) -> bytes:
        """Bytes of the segments of a pulse."""

        def number(bits: int, value: int) -> bytes:
            return struct.pack(f"<{_CODES[bits]}", value) if bits else b""

        return number(self.segments_bits, len(segments)) + b"".join(
            number(self.duration_bits, one.duration)
            + number(self.samples_bits, len(one.samples))
            + struct.pack(f"<{len(one.samples)}{_CODES.get(self.bits, 'H')}", *one.samples)
            for one in segments
        )


class Shot(NamedTuple):
    """Pulse with the segments of each sampling; places in mm."""

    time: int
    anchor: tuple[int, int, int]
    target: tuple[int, int, int]
    segments: Sequence[Sequence[Segment]]


def write_pulse_waves(
    path: Path,
    shots: Sequence[Shot],
    samplings: Sequence[Sampling],
    *,
    unit_ns: float = 1.0,
    centre: int = 0,
    extra: int = 0,
    appended: bool = False,
    index: int = 1,
    **header: Any,
) -> None:
    """Write a .pls and its .wvs. With `appended`, the descriptor lies behind the pulses, which name its `index`."""
    waves, starts = b"PulseWavesWaves\0" + struct.pack("<I40x", header.get("packed_waves", 0)), []
    for shot in shots:
        starts.append(len(waves))
        waves += bytes(extra) + b"".join(one.data(own) for one, own in zip(samplings, shot.segments, strict=True))
    composition = struct.pack("<IIiHHfII64x", 92, 0, centre, extra, len(samplings), unit_ns, 0, 0)
    descriptor = composition + b"".join(one.record for one in samplings)
    about = struct.pack("<16sIIq64s", b"PulseWaves_Spec", 200_001, 0, len(descriptor), b"")
    other = struct.pack("<16sIIq64s", b"someone", 4711, 0, 3, b"") + b"abc"
    before = other if appended else other + about + descriptor
    pulses = b"".join(
        struct.pack(
            "<qq6i2hBBBB", shot.time, start + header.get("shift", 0), *shot.anchor, *shot.target, 0, 0, index, 0, 0, 0
        )
        + b"xy"
        for shot, start in zip(shots, starts, strict=True)
    )
    first = 352 + len(before)
    last = struct.pack("<16sIIq64s", b"PulseWaves_Spec", 0xFFFFFFFF, 0, 0, b"")
    heading = b"PulseWavesPulse\0" + bytes(158)
    heading += struct.pack(
        "<HqqIIIIqIi", 352, first, len(shots), 0, 0, 50, header.get("packed", 0), 0, 1 + (not appended), -1
    )
    heading += struct.pack("<dd2q12d", 1e-6, 1000.0, 0, 0, *(1e-3,) * 3, 0.0, 0.0, 100.0, *[0.0] * 6)
    path.write_bytes(heading + before + pulses + last + (descriptor + about if appended else b""))
    path.with_suffix(".wvs").write_bytes(waves)
