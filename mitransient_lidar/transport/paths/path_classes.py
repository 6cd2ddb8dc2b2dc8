"""Classes of received light: by scattering order and vertical reversals, or by origin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.errors import UserError

if TYPE_CHECKING:
    from mitransient_lidar.transport.paths.path import PathPoint

#: Label bits for the pixel, and for the number of scattering events; the others are for reversals.
_PIXEL_BITS, _ORDER_BITS = 20, 6

#: Label bits for the pixel where only scattering events are counted, and their largest number.
_MANY_PIXEL_BITS, _MOST_COUNTED = 28, 15

_MOST = (1 << _ORDER_BITS) - 1

#: Largest number of orders that can be separated.
MOST_ORDERS = _MOST - 1

#: Origins without a solid: light that has met the sea surface alone, and light that the water has scattered.
ORIGINS = ("surface", "water")

#: Largest number of solids whose light can be separated: each takes as much memory as all light.
_MOST_SOLIDS = 30


def check_solids(number: int) -> None:
    """Raise `UserError` if there are too many solids to separate their light."""
    if number > _MOST_SOLIDS:
        raise UserError(f"components: the scene has {number} solids; allowed are at most {_MOST_SOLIDS}")


@dataclass(frozen=True)
class PathClasses:
    """Classes into which each pixel's light is separated.

    Either scattering orders below `orders`, and all higher ones together; or the light's origin: the last of the
    `solids` that it has met, else the water if that has scattered it, else the surface. With `orders` = 0 and without
    `solids` each pixel is one class. Labels have the number of scattering events, up to 15, if they are `counted`.
    """

    orders: int = 0
    solids: tuple[mi.Shape, ...] | None = None
    counted: bool = False

    @classmethod
    def by_origin(cls, solids: list[mi.Shape]) -> PathClasses:
        """Return the classes of light by origin; raise UserError for too many solids."""
        check_solids(len(solids))
        return cls(solids=tuple(solids))

    @property
    def by_order(self) -> bool:
        """Whether there are classes by scattering order."""
        return self.orders > 0

    @property
    def labels_orders(self) -> bool:
        """Whether labels have the numbers of scattering events."""
        return self.by_order or self.counted

    @property
    def separate(self) -> bool:
        """Whether there are several classes."""
        return self.by_order or self.solids is not None

    @property
    def names(self) -> list[str]:
        """Origin names."""
        return [*ORIGINS, *(str(solid.id()) for solid in self.solids or ())]

    @property
    def count(self) -> int:
        """Classes per pixel: origins; or orders, for one reversal and then for several."""
        if self.by_order:
            return 2 * (self.orders + 1)
        return 1 if self.solids is None else len(ORIGINS) + len(self.solids)

    def pack(self, point: PathPoint) -> mi.UInt32:
        """Return point labels: their pixels, with their numbers of scattering events and reversals."""
        if not self.labels_orders:
            return point.pixel
        if not self.by_order:
            return point.pixel | (dr.minimum(point.scatterings, _MOST_COUNTED) << _MANY_PIXEL_BITS)
        events, reversals = (dr.minimum(each, _MOST) for each in (point.scatterings, point.reversals))
        return point.pixel | (events << _PIXEL_BITS) | (reversals << (_PIXEL_BITS + _ORDER_BITS))

    def unpack(self, label: mi.UInt32) -> dict[str, mi.UInt32]:
        """Return ``pixel``, ``scatterings`` and ``reversals`` of a label, where they are counted."""
        if not self.labels_orders:
            return {"pixel": label}
        if not self.by_order:
            return {"pixel": label & ((1 << _MANY_PIXEL_BITS) - 1), "scatterings": label >> _MANY_PIXEL_BITS}
        events, reversals = label >> _PIXEL_BITS, label >> (_PIXEL_BITS + _ORDER_BITS)
        return {"pixel": label & ((1 << _PIXEL_BITS) - 1), "scatterings": events & _MOST, "reversals": reversals}

    def solid(self, shape: mi.ShapePtr) -> mi.UInt32:
        """Return the numbers of solids among those that are separated, from 1 on; 0 for other shapes."""
        number = mi.UInt32(0)
        for index, solid in enumerate(self.solids or (), 1):
            number = dr.select(shape == mi.ShapePtr(solid), mi.UInt32(index), number)
        return number

    def index(self, pixel: mi.UInt32, order: mi.UInt32, reversals: mi.UInt32, solid: mi.UInt32) -> mi.UInt32:
        """Return the index of a pixel's class; `solid` is the number of the last solid that the light has met."""
        if self.solids is not None:
            scattered = dr.select(order > 0, mi.UInt32(1), 0)
            return pixel * self.count + dr.select(solid > 0, solid + (len(ORIGINS) - 1), scattered)
        if not self.by_order:
            return pixel
        several = dr.select(reversals > 1, mi.UInt32(self.orders + 1), 0)
        return pixel * self.count + several + dr.minimum(order, self.orders)
