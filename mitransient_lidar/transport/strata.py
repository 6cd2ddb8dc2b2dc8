"""Strata: runs of layers of one refractive and one group index, between which light is bent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

if TYPE_CHECKING:
    from mitransient_lidar.transport.path import Path
    from mitransient_lidar.transport.system import LidarScene

#: Water of more strata is refused: connections are traced through each of them.
MOST_STRATA = 16


class Strata:
    """The strata of a water column, from the top.

    Light that crosses a plane between two of them is refracted by Snell's law, or reflected totally. The partial
    reflection, of 5e-6 at vertical incidence between fresh and sea water, is left out.

    Parameters
    ----------
    tops
        Depths of the upper edges of the layers [m], shape (layers,).
    refractive_index, group_index
        Indices of the layers, shape (layers,).

    Raises
    ------
    ValueError
        If there are more than 16 strata.
    """

    def __init__(self, tops: np.ndarray, refractive_index: np.ndarray, group_index: np.ndarray) -> None:
        begins = np.append(True, (np.diff(refractive_index) != 0) | (np.diff(group_index) != 0))
        #: Depths of the planes between the strata [m].
        self.edges = tops[begins][1:]
        self.refractive_index, self.group_index = refractive_index[begins], group_index[begins]
        self.count = len(self.refractive_index)
        if self.count > MOST_STRATA:
            raise ValueError(f"refractive_index has {self.count} different strata but must have at most {MOST_STRATA}")
        self._top = mi.Float(np.append(-np.inf, self.edges))
        self._bottom = mi.Float(np.append(self.edges, np.inf))
        self._index = mi.Float(self.refractive_index)
        self._group = mi.Float(self.group_index)

    def at(self, depth: mi.Float) -> mi.UInt32:
        """Return the stratum at a depth [m]."""
        stratum = mi.UInt32(0)
        for edge in self.edges:
            stratum += dr.select(depth >= float(edge), mi.UInt32(1), 0)
        return stratum

    def group(self, stratum: mi.UInt32) -> mi.Float | float:
        """Return the group index of a stratum."""
        return float(self.group_index[0]) if self.count == 1 else dr.gather(mi.Float, self._group, stratum)

    def to_edge(self, path: Path, active: mi.Bool) -> mi.Float:
        """Return how far paths go until they leave their stratum [m]; infinite where they never do."""
        down = path.downward > 0
        edge = dr.select(
            down, dr.gather(mi.Float, self._bottom, path.stratum), dr.gather(mi.Float, self._top, path.stratum)
        )
        leaves = active & dr.isfinite(edge) & (path.downward != 0)
        return dr.select(leaves, dr.maximum((edge - path.depth) / path.downward, 0), dr.inf)

    def bend(self, path: Path, at_edge: mi.Bool, radiance: bool) -> None:
        """Let paths that have come to an edge go on beyond it.

        Radiance is scaled by the square of the index, energy is not.
        """
        down = path.downward > 0
        beyond = dr.select(down, path.stratum + 1, path.stratum - 1)
        direction, ratio, passes = self.refract(path.direction, path.stratum, beyond, at_edge)
        mirrored = mi.Vector3f(path.direction.x, path.direction.y, -path.direction.z)
        path.direction = dr.select(at_edge, dr.select(passes, direction, mirrored), path.direction)
        path.turns += dr.select(at_edge & ~passes, mi.UInt32(1), 0)
        path.stratum = dr.select(at_edge & passes, beyond, path.stratum)
        if radiance:
            path.throughput *= dr.select(at_edge & passes, ratio * ratio, 1)

    def refract(
        self, direction: mi.Vector3f, here: mi.UInt32, there: mi.UInt32, active: mi.Bool | bool = True
    ) -> tuple[mi.Vector3f, mi.Float, mi.Bool]:
        """Return a direction in another stratum, the ratio of the indices, and whether light gets there."""
        ratio = dr.gather(mi.Float, self._index, here, active) / dr.gather(mi.Float, self._index, there, active)
        x, y = direction.x * ratio, direction.y * ratio
        cosine2 = 1 - x * x - y * y
        return mi.Vector3f(x, y, dr.copysign(dr.safe_sqrt(cosine2), direction.z)), ratio, active & (cosine2 > 0)

    def from_first(self, direction: mi.Vector3f, density: mi.Float, stratum: mi.UInt32) -> tuple[mi.Vector3f, mi.Float]:
        """Return a direction of the first stratum and its density [1/sr] as they are in another one."""
        if self.count == 1:
            return direction, density
        there, ratio, passes = self.refract(direction, mi.UInt32(0), stratum)
        return there, dr.select(passes, density * dr.abs(there.z / direction.z) / dr.square(ratio), 0)

    def to_first(self, direction: mi.Vector3f, stratum: mi.UInt32) -> tuple[mi.Vector3f, mi.Float]:
        """Return a direction as it is in the first stratum, and the factor for densities there [1/sr]; 0 for none."""
        if self.count == 1:
            return direction, mi.Float(1)
        there, ratio, passes = self.refract(direction, stratum, mi.UInt32(0))
        return there, dr.select(passes, dr.square(ratio) * dr.abs(direction.z / there.z), 0)


@dataclass
class Ascent:
    """Straight legs from a vertex up to the first stratum.

    Attributes
    ----------
    ray
        The ray as it enters the first stratum, or begins in it.
    optical_length
        Optical length of the legs below [m].
    optical_depth
        Their optical depth [1].
    factor
        What radiance is to be multiplied by: square of the ratio of the indices; 0 where something is in the way.
    """

    ray: mi.Ray3f
    optical_length: mi.Float
    optical_depth: mi.Float
    factor: mi.Float


def ascend(system: LidarScene, ray: mi.Ray3f, stratum: mi.UInt32, active: mi.Bool) -> Ascent:
    """Trace rays from under water up to the first stratum."""
    strata = system.strata
    ascent = Ascent(ray, mi.Float(0), mi.Float(0), mi.Float(1))
    if strata is None:
        return ascent
    water: Any = system.water
    for number in range(strata.count - 1, 0, -1):
        here = active & (stratum == number) & (ascent.ray.d.z > 0)
        leg = mi.Ray3f(ascent.ray.o, ascent.ray.d)
        distance = dr.maximum((-leg.o.z - float(strata.edges[number - 1])) / leg.d.z, 0)
        leg.maxt = distance
        blocked = system.scene.ray_test(leg, here)
        through = water.optical_depth(leg.o, leg.d, distance)
        above = mi.UInt32(number - 1)
        direction, ratio, passes = strata.refract(leg.d, mi.UInt32(number), above)
        ascent.optical_length += dr.select(here, distance * float(strata.group_index[number]), 0)
        ascent.optical_depth += dr.select(here, through, 0)
        ascent.factor *= dr.select(here, dr.select(passes & ~blocked, ratio * ratio, 0), 1)
        origin = dr.select(here, leg.o + leg.d * distance, leg.o)
        ascent.ray = mi.Ray3f(origin, dr.select(here, direction, leg.d))
        stratum = dr.select(here, above, stratum)
    return ascent
