"""Numbers for many path points, stored in packets that kernels read together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi

#: Numbers in a packet.
_PACKET = 4

#: Sign bit of a number, and all other bits.
_SIGN, _MAGNITUDE = 1 << 31, (1 << 31) - 1


class PackedStore:
    """Stored numbers for points, one entry per point.

    Parameters
    ----------
    size
        Number of entries.
    fields
        Stored fields, in the order of their packets with four numbers: by name a Mitsuba type, or the length of a list
        of numbers. ``number|flag`` are a number, 0 or more, and a flag in its sign bit.
    """

    def __init__(self, size: int, fields: Mapping[str, str | int]) -> None:
        self._fields = [(name.partition("|")[0], name.partition("|")[2], kind) for name, kind in fields.items()]
        rest = sum(map(_count, fields.values()))
        # An array for each packet: a second write to the same one would compute all that is stored again.
        self._packets = []
        while rest > 0:
            width = _PACKET if rest > 2 else rest
            self._packets.append((dr.empty(mi.Float, width * size), width))
            rest -= width

    def write(self, values: Mapping[str, Any], place: mi.UInt32, active: mi.Bool) -> None:
        """Store the values of all fields and flags, by name."""
        numbers = []
        for name, flag, kind in self._fields:
            stored = [*values[name]] if _count(kind) > 1 or isinstance(kind, int) else [values[name]]
            if flag:
                # NaN may have its own sign.
                bits = dr.reinterpret_array(mi.UInt32, stored[0]) & _MAGNITUDE
                stored = [bits | dr.select(values[flag], mi.UInt32(_SIGN), 0)]
            numbers += [dr.reinterpret_array(mi.Float, number) for number in stored]
        numbers += [mi.Float(0)] * (-len(numbers) % _PACKET)
        for index, (packet, width) in enumerate(self._packets):
            first = _PACKET * index
            dr.scatter(packet, _packet_type(width)(*numbers[first : first + width]), place, active)

    def read(self, place: mi.UInt32, active: mi.Bool | bool = True) -> dict[str, Any]:
        """Return values by the names of fields and flags; 0 where inactive."""
        numbers: list[mi.Float] = []
        for packet, width in self._packets:
            found = dr.gather(_packet_type(width), packet, place, active)
            numbers += [found] if width == 1 else [*found]
        values: dict[str, Any] = {}
        for name, flag, kind in self._fields:
            count = _count(kind)
            stored, numbers = numbers[:count], numbers[count:]
            if flag:
                bits = dr.reinterpret_array(mi.UInt32, stored[0])
                values[flag] = (bits & _SIGN) != 0
                stored = [dr.reinterpret_array(mi.Float, bits & _MAGNITUDE)]
            if kind == "UInt32":
                values[name] = dr.reinterpret_array(mi.UInt32, stored[0])
            else:
                values[name] = stored if isinstance(kind, int) else getattr(mi, kind)(*stored)
        return values

    def evaluate(self) -> None:
        """Compute the stored values."""
        dr.eval([packet for packet, _ in self._packets])


def _count(kind: str | int) -> int:
    """Return how many numbers a field has."""
    return kind if isinstance(kind, int) else {"Float": 1, "UInt32": 1}.get(kind, 3)


def _packet_type(width: int) -> Any:
    return {1: mi.Float, 2: mi.Vector2f, _PACKET: mi.Vector4f}[width]
