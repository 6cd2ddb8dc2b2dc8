"""Classes of received light: order of scattering, and one or several vertical reversals."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

#: Bits of a label for the pixel, and for the number of scattering events; the others are for reversals.
_PIXEL_BITS, _ORDER_BITS = 20, 6

_MOST = (1 << _ORDER_BITS) - 1

#: Largest number of orders that can be separated.
MOST_ORDERS = _MOST - 1


@dataclass(frozen=True)
class PathClasses:
    """Classes into which the light of each pixel is separated.

    Orders of scattering below `orders`, and all higher ones together; with `orders` = 0 each pixel is one class.
    """

    orders: int = 0

    @property
    def separate(self) -> bool:
        """Whether there are several classes."""
        return self.orders > 0

    @property
    def count(self) -> int:
        """Number of classes of a pixel: orders, for one reversal and then for several."""
        return 2 * (self.orders + 1) if self.separate else 1

    def pack(self, label: mi.UInt32, scatterings: mi.UInt32, reversals: mi.UInt32) -> mi.UInt32:
        """Return a label packed with numbers of scattering events and reversals."""
        if not self.separate:
            return label
        return label | _packed(scatterings, _PIXEL_BITS) | _packed(reversals, _PIXEL_BITS + _ORDER_BITS)

    def unpack(self, label: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """Return a label without the numbers of scattering events and reversals, and these (0 without classes)."""
        if not self.separate:
            return label, mi.UInt32(0), mi.UInt32(0)
        return (label & ((1 << _PIXEL_BITS) - 1), (label >> _PIXEL_BITS) & _MOST, label >> (_PIXEL_BITS + _ORDER_BITS))

    def index(self, pixel: mi.UInt32, order: mi.UInt32, reversals: mi.UInt32) -> mi.UInt32:
        """Return the index of a pixel's class."""
        if not self.separate:
            return pixel
        several = dr.select(reversals > 1, mi.UInt32(self.orders + 1), 0)
        return pixel * self.count + several + dr.minimum(order, self.orders)


def _packed(number: mi.UInt32, bit: int) -> mi.UInt32:
    return dr.minimum(number, _MOST) << bit
