"""Digitised waveforms of a file, in blocks that fit in memory, and the files that hold their samples."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import open_file
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
