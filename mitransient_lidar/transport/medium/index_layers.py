"""Index layers: runs of water layers with the same indices, and refraction between them and at the sea."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.transport.opaque import aligned, opaque

#: Largest number of index layers: connections are traced through each.
MOST_INDEX_LAYERS = 16

#: Vertical distance within which solids and boundaries coincide: absolute [m], and over the length of a ray.
_SAME, _SAME_PER_LENGTH = 2e-5, 2.0**-20


class IndexLayers:
    """Index layers of a water column, numbered from the top.

    Light at the boundary of two index layers is refracted by Snell's law, or reflected totally. The partial reflection
    (5e-6 at vertical incidence between fresh and sea water) is neglected.

    Raises UserError if there are more than 16 index layers.

    `layer_tops`: upper edge depths of the water layers [m], shape (layers,). `refractive_index`, `group_index`: indices
    of the water layers, shape (layers,).
    """

    def __init__(self, layer_tops: np.ndarray, refractive_index: np.ndarray, group_index: np.ndarray) -> None:
        begins = np.append(True, (np.diff(refractive_index) != 0) | (np.diff(group_index) != 0))
        #: Boundary depths [m].
        self.boundaries = layer_tops[begins][1:]
        self.refractive_index, self.group_index = refractive_index[begins], group_index[begins]
        self.count = len(self.refractive_index)
        if self.count > MOST_INDEX_LAYERS:
            raise UserError(
                f"refractive_index has {self.count} different index layers but must have at most {MOST_INDEX_LAYERS}"
            )
        edges = np.append(-np.inf, self.boundaries), np.append(self.boundaries, np.inf)
        self._top, self._bottom, self._index, self._group = (
            aligned(mi.Float, values) for values in (*edges, self.refractive_index, self.group_index)
        )

    def at(self, depth: mi.Float) -> mi.UInt32:
        """Return the number of the index layer at a depth [m]."""
        layer = mi.UInt32(0)
        for boundary in self.boundaries:
            layer += dr.select(depth >= opaque(boundary), mi.UInt32(1), 0)
        return layer

    def group(self, layer: mi.UInt32) -> mi.Float:
        """Return an index layer's group index."""
        return opaque(self.group_index[0]) if self.count == 1 else dr.gather(mi.Float, self._group, layer)

    def to_boundary(self, depth: mi.Float, downward: mi.Float, layer: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Return the distance to the boundary at which rays leave their index layer [m], infinite if they never do."""
        down = downward > 0
        boundary = dr.select(down, dr.gather(mi.Float, self._bottom, layer), dr.gather(mi.Float, self._top, layer))
        leaves = active & dr.isfinite(boundary) & (downward != 0)
        return dr.select(leaves, dr.maximum((boundary - depth) / downward, 0), dr.inf)

    def refract(
        self, direction: mi.Vector3f, here: mi.UInt32, there: mi.UInt32, active: mi.Bool | bool = True
    ) -> tuple[mi.Vector3f, mi.Float, mi.Bool]:
        """Return a direction in another index layer, the ratio of the refractive indices, and whether light passes."""
        ratio = dr.gather(mi.Float, self._index, here, active) / dr.gather(mi.Float, self._index, there, active)
        refracted, passes = refract_level(direction, ratio)
        return refracted, ratio, active & passes

    def from_top(self, direction: mi.Vector3f, density: mi.Float, layer: mi.UInt32) -> tuple[mi.Vector3f, mi.Float]:
        """Transform a direction of the top index layer and its density [1/sr] to another index layer."""
        if self.count == 1:
            return direction, density
        there, ratio, passes = self.refract(direction, mi.UInt32(0), layer)
        return there, dr.select(passes, density * dr.abs(there.z / direction.z) / dr.square(ratio), 0)

    def to_top(self, direction: mi.Vector3f, layer: mi.UInt32) -> tuple[mi.Vector3f, mi.Float]:
        """Transform a direction to the top index layer; return it and the factor for densities there, 0 for none."""
        if self.count == 1:
            return direction, mi.Float(1)
        there, ratio, passes = self.refract(direction, layer, mi.UInt32(0))
        return there, dr.select(passes, dr.square(ratio) * dr.abs(direction.z / there.z), 0)


def coinciding(length: mi.Float) -> mi.Float:
    """Return the vertical distance [m] within which a solid lies in a boundary plane, for rays with a length."""
    return dr.fma(length, _SAME_PER_LENGTH, _SAME)


def refract(direction: mi.Vector3f, normal: mi.Normal3f, eta: mi.Float | float) -> mi.Vector3f:
    """Refract at a facet: return the unit direction, beyond the facet, from which light arrives at it.

    Parameters
    ----------
    direction
        Unit direction from the facet to the light source, on the side of the normal.
    normal
        Unit normal of the facet.
    eta
        Refractive index on the side of the normal over the index beyond, at most 1.
    """
    cosine = dr.dot(direction, normal)
    root = dr.safe_sqrt(1 - eta * eta * (1 - cosine * cosine))
    return eta * direction + (root - eta * cosine) * mi.Vector3f(normal)


def refract_level(direction: mi.Vector3f, eta: mi.Float | float) -> tuple[mi.Vector3f, mi.Bool]:
    """Return a propagation direction beyond a horizontal plane, and whether light passes it.

    `direction`: unit propagation direction. `eta`: refractive index before the plane over the index behind it. Where it
    exceeds 1, light may be totally reflected.
    """
    x, y = direction.x * eta, direction.y * eta
    cosine2 = 1 - x * x - y * y
    return mi.Vector3f(x, y, dr.copysign(dr.safe_sqrt(cosine2), direction.z)), cosine2 > 0
