"""Waveforms of PulseWaves files (version 0.3 revision 11): pulses in .pls, and their samples in .wvs beside it."""

from __future__ import annotations

import os
import struct
from collections import defaultdict
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import open_file
from mitransient_lidar.core.formats import waveform_blocks
from mitransient_lidar.core.formats.array_files import damaged_file
from mitransient_lidar.core.formats.waveform_blocks import PacketFile, WaveformBlock

_PULSES, _WAVES = b"PulseWavesPulse\0", b"PulseWavesWaves\0"
# Header size, offset to the pulses, number of pulses, format, attributes, size, compression, reserved, numbers of
# records before and after the pulses; scale, offset, minimum and maximum of times; scales and offsets of places.
_HEADER_AT, _HEADER = 174, struct.Struct("<HqqIIIIqIi dd2q 6d")
_RECORD, _LAST_RECORD = struct.Struct("<16sIIq64s"), 0xFFFFFFFF
_FIRST_DESCRIPTOR = 200_001
_COMPOSITION, _SAMPLING = struct.Struct("<I4xiHHfI"), struct.Struct("<I4xBBxBffBBHIHHfI")
_NO_CENTRE = -0x70000001  # 0x8FFFFFFF: no constant time lies between optical centre and anchor
_RETURNING, _UNITS = 2, 1000  # type of a sampling, and sampling units from anchor to target
_PULSE = [("time", "<i8"), ("offset", "<i8"), ("anchor", "<i4", 3), ("target", "<i4", 3), ("ends", "<i2", 2)]
_NUMBER = {8: struct.Struct("<B"), 16: struct.Struct("<H"), 32: struct.Struct("<I")}


class _Sampling(NamedTuple):
    """One digitiser: what it samples, bits of the numbers before its samples, or the numbers, and spacing [ns]."""

    size: int
    kind: int
    channel: int
    duration_bits: int
    duration_scale: float
    duration_offset: float
    segments_bits: int
    samples_bits: int
    segments: int
    samples: int
    bits: int
    table: int
    spacing_ns: float
    compression: int


class _Descriptor(NamedTuple):
    """How waveforms are stored: units from optical centre to anchor, bytes before them, and a sampling unit [ns]."""

    centre: float
    extra: int
    unit_ns: float
    samplings: list[_Sampling]


def pulse_blocks(path: Path, first: int, end: int | None, size: int) -> Iterator[WaveformBlock]:
    """Yield the returning waveforms of the pulses from `first` to before `end` of a file .pls, one for each segment.

    At most `size` pulses are in memory. The channel is that of the sampling. Raises `UserError` if a file is missing,
    damaged, cut or compressed, an offset is outside the samples, a descriptor is missing, or samples are of other than
    8, 16 or 32 bits.
    """
    with open_file(path) as file:
        with damaged_file(f"{path} is damaged, or is not a PulseWaves file"):
            if not (start := file.read(_HEADER_AT)).startswith(_PULSES):
                raise ValueError(start)
            after, start, count, _, _, length, packed, _, *records = _HEADER.unpack(file.read(_HEADER.size))
            waveform_blocks.refuse_compressed(str(path), packed)
            if start + count * length > os.fstat(file.fileno()).st_size:
                raise UserError(f"{path} is cut: it ends before the last of its {count} pulses")
            descriptors = _descriptors(path, file, after, *records[:2])
            kind = np.dtype([*_PULSE, ("descriptor", "u1"), ("others", f"V{length - 45}")])
        last = count if end is None else min(end, count)
        with PacketFile(waveform_blocks.samples_beside(path, ".wvs", ".wvz")) as packets:
            heading = packets.take(0, waveform_blocks.HEADER, "the header")
            if not heading.startswith(_WAVES):
                raise UserError(f"{packets.path} is damaged, or is not a PulseWaves file")
            waveform_blocks.refuse_compressed(str(packets.path), heading[len(_WAVES)])
            for begin in range(first, last, size):
                file.seek(start + begin * length)
                pulses = np.frombuffer(file.read(min(size, last - begin) * length), kind)
                yield from _blocks(path, pulses, begin, packets, descriptors, records[2:])


def _blocks(
    path: Path,
    pulses: np.ndarray[Any, Any],
    begin: int,
    packets: PacketFile,
    descriptors: dict[int, _Descriptor],
    scales: list[float],
) -> Iterator[WaveformBlock]:
    """Yield the segments of some pulses, those of one type, length and spacing together."""
    found: dict[tuple[Any, ...], list[tuple[int, int, float, float, bytes]]] = defaultdict(list)
    for row, (offset, index) in enumerate(zip(pulses["offset"].tolist(), pulses["descriptor"].tolist(), strict=True)):
        whose = f"pulse {begin + row} of {path}"
        if (about := descriptors.get(index)) is None:
            raise UserError(f"{path} has no descriptor {index}, which pulse {begin + row} needs")
        for sampling, duration, data in _segments(packets, offset, about, whose):
            kind = waveform_blocks.sample_type(sampling.bits, f"descriptor {index} of {path}")
            times = duration * about.unit_ns, (duration + about.centre) * about.unit_ns
            found[kind, sampling.spacing_ns, about.unit_ns, len(data)].append((row, sampling.channel, *times, data))
    anchor, target = (pulses[name] * scales[4:7] + np.array(scales[7:]) for name in ("anchor", "target"))
    for (kind, spacing, unit, _), listed in found.items():
        rows, channels, ways, times, data_of = zip(*listed, strict=True)
        which = np.array(rows)
        step = (target[which] - anchor[which]) / (_UNITS * unit)
        yield WaveformBlock(
            number=begin + which,
            channel=np.array(channels, dtype=np.int64),
            gps_time=pulses["time"][which] * scales[0] + scales[1],
            counts=np.frombuffer(b"".join(data_of), kind).reshape(which.size, -1),
            spacing_ns=round(spacing, 6),  # a number of 32 bits
            gain=0.0,
            offset=0.0,
            first_ns=np.array(times),
            return_ns=np.full(which.size, np.nan),
            place=anchor[which] + np.array(ways)[:, np.newaxis] * step,
            step=step,
        )


def _segments(
    packets: PacketFile, offset: int, about: _Descriptor, whose: str
) -> Iterator[tuple[_Sampling, float, bytes]]:
    """Yield sampling, time from the anchor [sampling units] and bytes of the returning segments of a pulse."""
    packets.take(offset, about.extra, whose, begins=True)
    at = offset + about.extra

    def number(bits: int, fixed: int) -> int:
        nonlocal at
        if not bits:
            return fixed
        at += bits // 8
        found: int = _NUMBER[bits].unpack(packets.take(at - bits // 8, bits // 8, whose))[0]
        return found

    for one in about.samplings:
        for _ in range(number(one.segments_bits, one.segments)):
            scale, constant = (one.duration_scale, one.duration_offset) if one.duration_bits else (0.0, 0.0)
            duration = scale * number(one.duration_bits, 0) + constant
            length = number(one.samples_bits, one.samples) * one.bits // 8
            if one.kind == _RETURNING and length:
                yield one, duration, packets.take(at, length, whose)
            at += length


def _descriptors(path: Path, file: BufferedReader, after: int, count: int, appended: int) -> dict[int, _Descriptor]:
    """Return the pulse descriptors of a file by their index, from the records before and after the pulses."""
    records, size = [], file.seek(0, os.SEEK_END)
    end = size

    def heading(at: int) -> tuple[bytes, int, int]:
        file.seek(at)
        user, kind, _, length, _ = _RECORD.unpack(file.read(_RECORD.size))
        if not 0 <= length <= size:
            raise ValueError(length)
        return user, kind, length

    for _ in range(count):
        user, kind, length = heading(after)
        records.append((user, kind, file.read(length)))
        after = file.tell()
    while appended:  # each behind its contents; a negative number is unknown
        user, kind, length = heading(end - _RECORD.size)
        if kind == _LAST_RECORD:
            break
        end = file.seek(end - _RECORD.size - length)
        records.append((user, kind, file.read(length)))
        appended -= 1
    return {
        kind - _FIRST_DESCRIPTOR + 1: _descriptor(f"descriptor {kind - _FIRST_DESCRIPTOR + 1} of {path}", data)
        for user, kind, data in records
        if user.rstrip(b"\0") == b"PulseWaves_Spec" and 0 <= kind - _FIRST_DESCRIPTOR < 255
    }


def _descriptor(whose: str, data: bytes) -> _Descriptor:
    """Return the descriptor of a record: a composition, then samplings, each of the size that it states."""
    at, centre, extra, count, unit, packed = _COMPOSITION.unpack_from(data)
    samplings = []
    for _ in range(count):
        one = _Sampling._make(_SAMPLING.unpack_from(data, at))
        at += one.size
        waveform_blocks.refuse_compressed(whose, packed or one.compression)
        if not (
            {one.duration_bits, one.segments_bits, one.samples_bits} <= {0, *_NUMBER} and one.spacing_ns > 0 < unit
        ):
            raise UserError(f"{whose} is damaged: times must be above 0, and numbers have 8, 16 or 32 bits")
        samplings.append(one)
    return _Descriptor(float("nan") if centre == _NO_CENTRE else centre, extra, unit, samplings)
