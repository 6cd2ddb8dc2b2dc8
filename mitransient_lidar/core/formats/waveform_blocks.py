"""Digitised waveforms of a file in blocks that fit in memory, the files that hold their samples, and those of LAS.

LAS and LAZ files (LAS 1.4 R15) have packets of samples in the file, or in a file beside it (.wdp).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import open_file
from mitransient_lidar.core.formats.array_files import damaged_file
from mitransient_lidar.core.validation import FloatArray

_SAMPLES: dict[int, np.dtype[Any]] = {8: np.dtype("u1"), 16: np.dtype("<u2"), 32: np.dtype("<u4")}
HEADER = 60  #: Bytes before the first packet of samples, in both formats.
_WINDOW = 2**22  # bytes that are read at a time where waveforms follow each other


@dataclass(frozen=True)
class WaveformBlock:
    """Waveforms of one length, spacing and digitiser."""

    #: Number in the file, from 0, channel and time of the pulse [s], shape (waveforms,).
    number: npt.NDArray[np.int64]
    channel: npt.NDArray[np.int64]
    gps_time: FloatArray
    counts: npt.NDArray[Any]  #: Samples as digitised, unsigned integers of shape (waveforms, samples).
    #: Time between samples [ns]; a sample is offset + gain x count [V], or a count where the gain is 0.
    spacing_ns: float
    gain: float
    offset: float
    #: Time of the first sample after the pulse left the scanner [ns]; NaN where the file does not state it.
    first_ns: FloatArray
    return_ns: FloatArray  #: Time of the first return after the first sample [ns]; NaN where there is none.
    #: Place of the first sample [m], and the way along the pulse, away from the scanner, in 1 ns of the record [m/ns]:
    #: half the speed of light. Shape (waveforms, 3).
    place: FloatArray
    step: FloatArray


class PacketFile:
    """Samples in a file, from its byte `base` on, `size` bytes or all."""

    def __init__(self, path: Path, base: int = 0, size: int | None = None):
        self.path = path
        self._file, self._base = open_file(path), base
        whole = self._file.seek(0, 2) - base
        self._size = whole if size is None else min(size, whole)
        self._start, self._bytes = 0, b""

    def __enter__(self) -> PacketFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def take(self, start: int, count: int, whose: str, *, begins: bool = False) -> bytes:
        """Return bytes of `whose` from a position on, where its samples begin or go on.

        Raises `UserError` if the samples begin outside the file, or it ends before the last byte.
        """
        if begins and not HEADER <= start < max(self._size, HEADER + 1):
            raise UserError(
                f"{whose} has its samples at byte {start} of {self.path}: the offset must lie between {HEADER} and "
                f"{self._size - 1}, the last byte"
            )
        if (missing := start + count - self._size) > 0:
            raise UserError(f"{self.path} is cut: the samples of {whose} end {missing} bytes after it")
        if not self._start <= start <= start + count <= self._start + len(self._bytes):
            self._file.seek(self._base + start)
            self._start, self._bytes = start, self._file.read(max(min(_WINDOW, self._size - start), count))
        return self._bytes[start - self._start : start - self._start + count]


def sample_type(bits: int, whose: str) -> np.dtype[Any]:
    """Return the type of samples; raise `UserError` for bits per sample that are not read."""
    if bits not in _SAMPLES:
        raise UserError(f"{whose} has {bits} bits per sample: 8, 16 and 32 are read")
    return _SAMPLES[bits]


def refuse_compressed(whose: str, kind: int = 0) -> None:
    """Raise `UserError` for a type of compression other than 0."""
    if kind:
        raise UserError(f"{whose} has compressed waveforms (type {kind}), which are not read")


def samples_beside(path: Path, suffix: str, compressed: str) -> Path:
    """Return the file of samples beside a file; raise `UserError` if there is none, or only a compressed one."""
    for name in (suffix, suffix.upper()):
        if (found := path.with_suffix(name)).exists():
            return found
    if (packed := path.with_suffix(compressed)).exists():
        raise UserError(f"{packed} has compressed waveforms, which are not read: {path} needs them in {suffix}")
    raise UserError(f"{path} has its waveforms in {path.with_suffix(suffix).name}, which must lie beside it")


_DESCRIPTOR = struct.Struct("<BBIIdd")
_FIRST_RECORD, _LAST_RECORD = 100, 354  # of descriptors 1 to 255
#: Field of the points that tells channels apart by default, by point format.
_CHANNELS = {4: "user_data", 5: "user_data", 9: "scanner_channel", 10: "scanner_channel"}
_INDEX = "wavepacket_index"


class _Descriptor(NamedTuple):
    """Waveform Packet Descriptor: spacing [ps], gain and offset [V]."""

    bits: int
    compression: int
    samples: int
    spacing_ps: int
    gain: float
    offset: float


def las_blocks(path: Path, first: int, end: int | None, field: str | None, size: int) -> Iterator[WaveformBlock]:
    """Yield the waveforms from `first` to before `end` of a file, each once, in the order of its points.

    At most `size` points are in memory. The channel is a `field` of the points; ``descriptor`` is the index of the wave
    packet descriptor. Raises `UserError` if the file is damaged or has no waveforms, its packets are missing, cut or
    compressed, an offset is outside their file, a descriptor is missing, or samples are of other than 8, 16 or 32 bits.
    """
    import laspy

    damaged = f"{path} is damaged, or is not a LAS or LAZ file."
    with open_file(path) as file:
        with damaged_file(damaged):
            # The packets are an extended record, which would be read as a whole.
            reader = laspy.LasReader(file, closefd=False, read_evlrs=False)
        kind = reader.header.point_format
        if kind.id not in _CHANNELS:
            raise UserError(f"{path} has point format {kind.id}, without waveforms: it must be 4, 5, 9 or 10")
        field = _INDEX if field == "descriptor" else field or _CHANNELS[kind.id]
        if field not in (names := [*kind.dimension_names]):
            raise UserError(f"{path} has no field {field!r}: its points have {', '.join(names)}")
        with damaged_file(damaged):
            descriptors = {
                record.record_id - _FIRST_RECORD + 1: _Descriptor(*_DESCRIPTOR.unpack_from(record.record_data_bytes()))
                for record in reader.header.vlrs
                if record.user_id.rstrip("\0") == "LASF_Spec" and _FIRST_RECORD <= record.record_id <= _LAST_RECORD
            }
        seen, count, chunks = [np.empty(0, np.uint64)], 0, reader.chunk_iterator(size)
        left = reader.header.point_count
        with _packets(path, reader.header) as packets:
            while end is None or count < end:
                with damaged_file(damaged):
                    points = next(chunks, None)
                if (0 if points is None else len(points)) < min(size, left):
                    raise UserError(f"{path} is cut: it ends before the last of its {reader.header.point_count} points")
                if points is None:
                    break
                left -= len(points)
                rows = _first_returns(points, seen)
                numbers = count + np.arange(rows.size)
                count += rows.size
                wanted = (numbers >= first) & (numbers < (count if end is None else end))
                rows, numbers = rows[wanted], numbers[wanted]
                index = np.asarray(points[_INDEX])[rows]
                for one in np.unique(index):
                    own, about = index == one, descriptors.get(int(one))
                    if about is None:
                        raise UserError(f"{path} has no descriptor {one}, which waveform {numbers[own][0]} needs")
                    returns = points[rows[own]]
                    counts = _counts(path, returns, numbers[own], packets, about)
                    yield _block(returns, numbers[own], field, counts, about)


def _first_returns(points: Any, seen: list[npt.NDArray[np.uint64]]) -> npt.NDArray[np.intp]:
    """Return the rows of the earliest return in each packet that is not `seen`, 8 bytes each, which grows by them."""
    has = np.flatnonzero(np.asarray(points[_INDEX]) > 0)
    offset, location = (np.asarray(points[name])[has] for name in ("wavepacket_offset", "return_point_wave_location"))
    by_offset = np.lexsort((location, offset))
    unique, start = np.unique(offset[by_offset], return_index=True)
    fresh = np.ones(unique.size, dtype=bool)
    # In most files, packets have the order of their points.
    if unique.size and seen[-1].size and unique[0] <= max(part[-1] for part in seen[1:]):
        fresh = ~np.isin(unique, np.concatenate(seen))
    if fresh.any():
        seen.append(unique[fresh])
    appears = np.minimum.reduceat(by_offset, start) if start.size else start
    order = np.argsort(appears[fresh])
    return np.asarray(has[by_offset[start[fresh]][order]])


def _counts(
    path: Path, points: Any, numbers: npt.NDArray[np.int64], packets: PacketFile, about: _Descriptor
) -> npt.NDArray[Any]:
    """Return the samples of the packets of points that have one descriptor, shape (waveforms, samples)."""
    offsets, sizes, index = (np.asarray(points[f"wavepacket_{name}"]).tolist() for name in ("offset", "size", "index"))
    whose, data = f"descriptor {index[0]} of {path}", []
    refuse_compressed(whose, about.compression)
    kind = sample_type(about.bits, whose)
    length = about.samples * kind.itemsize
    if not length or not about.spacing_ps:
        raise UserError(f"{whose} has {about.samples} samples, {about.spacing_ps} ps apart: both must be above 0")
    for number, offset, size in zip(numbers.tolist(), offsets, sizes, strict=True):
        if size != length:
            raise UserError(f"waveform {number} of {path} has {size} bytes, but its descriptor {index[0]} has {length}")
        data.append(packets.take(offset, length, f"waveform {number} of {path}", begins=True))
    return np.frombuffer(b"".join(data), kind).reshape(numbers.size, about.samples)


def _block(
    points: Any, numbers: npt.NDArray[np.int64], field: str, counts: npt.NDArray[Any], about: _Descriptor
) -> WaveformBlock:
    """Return the waveforms of points that are the first return of each."""
    step, place = (
        np.stack([np.asarray(points[f"{axis}{end}"], dtype=np.float64) for axis in "xyz"], axis=-1)
        for end in ("_t", "")
    )
    # R15 has the vector point to the scanner; files of the other sign have their samples on the same line.
    step = 1000 * np.where(step[:, 2:] > 0, -step, step)
    location = 1e-3 * np.asarray(points["return_point_wave_location"], dtype=np.float64)
    return WaveformBlock(
        number=numbers,
        channel=np.asarray(points[field]).astype(np.int64),
        gps_time=np.asarray(points["gps_time"], dtype=np.float64),
        counts=counts,
        spacing_ns=1e-3 * about.spacing_ps,
        gain=about.gain,
        offset=about.offset,
        first_ns=np.full(numbers.size, np.nan),
        return_ns=location,
        place=place - location[:, np.newaxis] * step,
        step=step,
    )


def _packets(path: Path, header: Any) -> PacketFile:
    """Open the packets of a file, in itself or beside it."""
    if not header.global_encoding.waveform_data_packets_internal:
        return PacketFile(samples_beside(path, ".wdp", ".wdz"))
    start = int(header.start_of_waveform_data_packet_record)
    with open_file(path) as file:
        if not 0 < start <= (size := file.seek(0, 2)) - HEADER:
            raise UserError(f"{path} has its waveforms at byte {start}: they must lie in its {size} bytes")
        file.seek(start + 20)
        (length,) = struct.unpack("<Q", file.read(8))
    return PacketFile(path, start, HEADER + length)
