"""LAS waveforms: sample packets in their own file, and the point fields that refer to them."""

from __future__ import annotations

import struct
from typing import IO, Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, finite, finite_array, integer, positive

_HEADER = struct.Struct("<H16sHQ32s")  #: Reserved, user, record, bytes that follow, description.
_LENGTH_AT = 20  # position of the number of bytes that follow
_DESCRIPTOR = struct.Struct("<BBIIdd")
_BITS = 16
_LAST_COUNT = 2**_BITS - 1
_MOST_SHIFT_PS = 10.0  # 1.5 mm in air


class PacketWriter:
    """Writer of a LAS 1.4 waveform packet file (.wdp): a 60-byte header, then packets of one size.

    Raises UserError if `gain` or `sampling_ns` is not positive, `offset` is not finite, or there is no sample. LAS
    stores the spacing in whole picoseconds; this rounding may shift the last sample by 10 ps at most.

    `file`: file, empty and open for writing, that can seek. `first`: first waveforms, see `append`; they give samples
    per packet, gain, offset and spacing for the file.
    """

    def __init__(self, file: IO[bytes], first: xr.Dataset):
        attributes = first["waveform"].attrs
        self._file = file
        self.samples = integer("samples of a waveform", first.sizes["sample"], 1, 2**31)
        self.gain = positive("gain", attributes["gain"])
        self.offset = finite("offset", attributes["offset"])
        spacing = 1000 * positive("sampling_ns", attributes["sampling_ns"])
        self.spacing_ps = integer("sampling_ns in ps", float(round(spacing)), 1, 2**32 - 1)
        if abs(spacing - self.spacing_ps) * self.samples > _MOST_SHIFT_PS:
            raise UserError(f"sampling_ns = {spacing / 1000:g} must be a whole number of picoseconds for LAS")
        self._given = {name: attributes[name] for name in ("gain", "offset", "sampling_ns")}
        self.packets = 0
        self._file.write(_HEADER.pack(0, b"LASF_Spec", 65535, 0, b"Waveform data packets"))

    @property
    def packet_bytes(self) -> int:
        """Bytes of a packet."""
        return self.samples * _BITS // 8

    @property
    def descriptor(self) -> bytes:
        """Waveform Packet Descriptor: bits, compression (none), samples, spacing [ps], gain and offset [V]."""
        return _DESCRIPTOR.pack(_BITS, 0, self.samples, self.spacing_ps, self.gain, self.offset)

    def append(self, waveforms: xr.Dataset, points: xr.Dataset) -> dict[str, npt.NDArray[Any]]:
        """Write packets, and return the fields of the points that refer to them.

        `waveforms`: ``waveform`` over (packet, sample): integers are counts, 0 to 65535; other numbers are volts, which
        become counts by ``gain`` [V per count] and ``offset`` [V], NaN where a packet is shorter. These and
        ``sampling_ns`` are its attributes, one value for a file. Missing samples become the count nearest to 0 V.
        `points`: over ``point``: ``packet``, packet index in `waveforms` or -1 for none; ``time_in_packet_ns``, time of
        the point after the first sample; ``direction`` over (point, 3), unit vector of the light that arrives at the
        point; optionally ``group_speed`` [m/s], its speed there, that of light in vacuum otherwise.

        Returns `dict`: values by laspy's field name, shape (points,) each. Raises `UserError` if waveforms differ in
        their attributes, are longer than the first ones or out of range, or a point value is not finite or out of
        range.
        """
        counts = self._counts(waveforms["waveform"])
        fields = self._fields(points, counts.shape[0])
        self._file.write(counts.tobytes())
        self.packets += counts.shape[0]
        return fields

    def finish(self) -> None:
        """Write the packets' total byte count into the header."""
        self._file.seek(_LENGTH_AT)
        self._file.write(struct.pack("<Q", self.packets * self.packet_bytes))

    def _counts(self, waveform: xr.DataArray) -> npt.NDArray[np.uint16]:
        """Return little-endian counts, shape (packets, samples in the file)."""
        for name, value in self._given.items():
            if waveform.attrs[name] != value:
                raise UserError(f"{name} = {waveform.attrs[name]} must be that of the first waveforms, {value}")
        values = waveform.transpose("packet", "sample").values
        if values.shape[1] > self.samples:
            raise UserError(f"a waveform of {values.shape[1]} samples is longer than the first ones, {self.samples}")
        if values.dtype.kind == "f":
            values = np.round((values.astype(np.float64) - self.offset) / self.gain)
        known = values[~np.isnan(values)]
        if known.size and not (known.min() >= 0 and known.max() <= _LAST_COUNT):
            low, high = self.offset, self.offset + self.gain * _LAST_COUNT
            volts = self.offset + self.gain * (known.min() if known.min() < 0 else known.max())
            raise UserError(f"a waveform of {volts:g} V must lie between {low:g} and {high:g} V, the range of 16 bits")
        zero = int(np.clip(np.round(-self.offset / self.gain), 0, _LAST_COUNT))
        counts = np.full((values.shape[0], self.samples), zero, "<u2")
        counts[:, : values.shape[1]] = np.where(np.isnan(values), zero, values)
        return counts

    def _fields(self, points: xr.Dataset, packets: int) -> dict[str, npt.NDArray[Any]]:
        packet = points["packet"].values.astype(np.int64)
        if packet.size and not (packet.min() >= -1 and packet.max() < packets):
            bad = packet.min() if packet.min() < -1 else packet.max()
            raise UserError(f"packet = {bad} must lie between -1, for none, and {packets - 1}, the last packet")
        has = packet >= 0
        step = np.zeros((packet.size, 3))
        step[has] = _step(points.isel(point=has))
        location = np.zeros(packet.size)
        location[has] = 1000 * finite_array("time_in_packet_ns", points["time_in_packet_ns"].values[has])
        start = _HEADER.size + (self.packets + packet) * self.packet_bytes
        return {
            "wavepacket_index": has.astype(np.uint8),
            "wavepacket_offset": np.where(has, start, 0).astype(np.uint64),
            "wavepacket_size": np.where(has, self.packet_bytes, 0).astype(np.uint32),
            "return_point_wave_location": location,
            **{f"{axis}_t": step[:, number] for number, axis in enumerate("xyz")},
        }


def _step(points: xr.Dataset) -> FloatArray:
    """Return the vector towards the lidar by which a point moves for 1 ps less of two-way time [m/ps], shape (n, 3).

    LAS 1.4 R15 has the first sample at P + L d, with the point P, its time L after that sample and this vector d.
    """
    direction = finite_array("direction", points["direction"].values)
    length = np.linalg.norm(direction, axis=-1, keepdims=True)
    if np.any(np.abs(length - 1) > 1e-6):
        worst = length[np.argmax(np.abs(length - 1))].item()
        raise UserError(f"direction has the length {worst:g} but must hold unit vectors")
    speed = finite_array("group_speed", points["group_speed"].values) if "group_speed" in points else C0
    if np.any(speed <= 0) or np.any(speed > C0):
        raise UserError(f"group_speed must lie above 0 and at most at {C0:g} m/s")
    step: FloatArray = -direction / length * np.reshape(0.5e-12 * speed, (-1, 1))
    return step
