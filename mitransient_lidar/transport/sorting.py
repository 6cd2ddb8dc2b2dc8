"""Received light sorted by how it came: by order of scattering, and by one turn or several."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

if TYPE_CHECKING:
    from mitransient_lidar.transport.path import Path
    from mitransient_lidar.transport.system import LidarScene

#: Bits of a label for the pixel, and for the number of scattering events; the rest is for turns.
_PIXEL_BITS, _ORDER_BITS = 20, 6

#: Orders that can be told apart.
MOST_ORDERS = (1 << _ORDER_BITS) - 2


@dataclass(frozen=True)
class Sorting:
    """Classes into which the film's pixels are split.

    Parameters
    ----------
    orders
        Orders of scattering that are told apart, 0 (none) to this number less 1; the last class holds all higher ones.
    """

    orders: int

    @property
    def classes(self) -> int:
        """Number of classes of a pixel: orders, for one turn and then for several."""
        return 2 * (self.orders + 1)

    def pack(self, label: mi.UInt32, path: Path) -> mi.UInt32:
        """Return a label that also tells a path's events and turns so far."""
        return label | _packed(path.scatterings, _PIXEL_BITS) | _packed(path.turns, _PIXEL_BITS + _ORDER_BITS)

    def unpack(self, label: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """Return what was labelled, and the events and turns."""
        most = (1 << _ORDER_BITS) - 1
        return (
            label & ((1 << _PIXEL_BITS) - 1),
            (label >> _PIXEL_BITS) & most,
            label >> (_PIXEL_BITS + _ORDER_BITS),
        )

    def place(self, pixel: mi.UInt32, order: mi.UInt32, turns: mi.UInt32) -> mi.UInt32:
        """Return the number of a pixel's class."""
        several = dr.select(turns > 1, mi.UInt32(self.orders + 1), 0)
        return pixel * self.classes + several + dr.minimum(order, self.orders)


def _packed(number: mi.UInt32, bit: int) -> mi.UInt32:
    return dr.minimum(number, (1 << _ORDER_BITS) - 1) << bit


def receive(
    system: LidarScene,
    pixel: mi.UInt32,
    order: mi.UInt32,
    turns: mi.UInt32,
    length: mi.Float,
    energy: mi.Float,
    active: mi.Bool,
) -> None:
    """Add a path's energy [J] to the film, in the class of its order and turns where the film has classes."""
    if system.sorting is not None:
        pixel = system.sorting.place(pixel, order, turns)
    system.film.add_transient(pixel, length, energy, active)
