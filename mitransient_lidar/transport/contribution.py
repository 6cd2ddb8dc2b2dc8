"""What parts of paths carry to the complete paths that are made of them."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.perturbations import Sums

#: Sign bit of a number, and all others.
_SIGN, _MAGNITUDE = 1 << 31, (1 << 31) - 1


@dataclass
class Contribution:
    """What a part of a path carries, from the laser or from the receiver up to a point.

    Attributes
    ----------
    throughput
        Product of the factors of the part, 0 or more: energy of light from the laser [J]; of paths from the receiver,
        received energy per radiance at their end [m^2 sr]. Of points along segments, times track length [m].
    lost
        Whether the part has entered the water outside the surface mesh, as if the sea were level there: its complete
        paths measure the loss, and are not received.
    sums
        Sums of the `Perturbations` along the part.
    """

    throughput: mi.Float
    lost: mi.Bool
    sums: Sums

    def scaled(self, factor: mi.Float) -> Contribution:
        """Return the contribution with its throughput times a factor."""
        return Contribution(self.throughput * factor, self.lost, self.sums)

    def packed(self) -> mi.Float:
        """Return throughput and `lost` as one number, to be stored; the sums are stored in a `SumStore`."""
        return with_flag(self.throughput, self.lost)

    @classmethod
    def unpacked(cls, stored: mi.Float, sums: Sums) -> Contribution:
        """Return the contribution of a `packed` number and its sums."""
        return cls(*split_flag(stored), sums)


def with_flag(number: mi.Float, flag: mi.Bool) -> mi.Float:
    """Return numbers that are not negative with flags in their sign bits, to be stored in one packet with others."""
    # NaN may have a sign of its own.
    bits = dr.reinterpret_array(mi.UInt32, number) & _MAGNITUDE
    return dr.reinterpret_array(mi.Float, bits | dr.select(flag, mi.UInt32(_SIGN), 0))


def split_flag(stored: mi.Float) -> tuple[mi.Float, mi.Bool]:
    """Return numbers and flags that `with_flag` has put together."""
    return dr.abs(stored), (dr.reinterpret_array(mi.UInt32, stored) & _SIGN) != 0
