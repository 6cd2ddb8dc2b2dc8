"""Free flight and transmittance through horizontal layers of water, in closed form."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.transport.opaque import aligned, opaque

#: Least optical depth left in the last layer of a flight: in clear water even this is never crossed.
_SMALLEST_OPTICAL_DEPTH = 1e-30


class LayeredFlight:
    """Free flights, optical depths and coefficients in a `WaterColumn`.

    Optical depths are exact in every direction. Within the layer where a segment starts or ends they are attenuation
    times length (no division by the vertical component). Between layers they are the difference between tabulated
    vertical optical depths.
    """

    def __init__(self, column: WaterColumn) -> None:
        self.column = column
        self.count = column.count
        self._attenuation = self._table(column.attenuation)
        self._albedo = self._table(column.albedo)
        self._top = mi.Float(column.layer_tops)
        self._edge = mi.Float(column.edge_optical_depth)

    def layer_at(self, depth: mi.Float) -> mi.UInt32:
        """Return the layer at a depth [m]; the first one includes everything above z = 0."""
        if self.count == 1:
            return mi.UInt32(0)
        # The layer whose upper edge is the last one at or above the depth.
        return dr.binary_search(0, self.count - 1, lambda i: dr.gather(mi.Float, self._top, i + 1) <= depth)

    def coefficient(self, layer: mi.UInt32) -> mi.Float:
        """Return the coefficient of a layer [1/m]: attenuation, or scattering or absorption alone, as in the column."""
        return self._look_up(self._attenuation, layer)

    def albedo(self, layer: mi.UInt32) -> mi.Float:
        """Return a layer's single-scattering albedo b/c."""
        return self._look_up(self._albedo, layer)

    def _table(self, values: FloatArray) -> mi.Float:
        return opaque(values[0]) if self.count == 1 else aligned(mi.Float, values)

    def _look_up(self, table: mi.Float, layer: mi.UInt32) -> mi.Float:
        return table if self.count == 1 else dr.gather(mi.Float, table, layer)

    def distance(self, depth: mi.Float, downward: mi.Float, optical_depth: mi.Float) -> mi.Float:
        """Return the distance at which light has crossed an optical depth [m], infinite if it never does.

        It starts at a depth [m], negative in a wave crest, in a unit direction of the component `downward`.
        """
        layer = self.layer_at(depth)
        here = self.coefficient(layer)
        within = optical_depth / here  # infinite in clear water
        if self.count == 1:
            return within
        to_edge, edge = self._way_out(layer, depth, downward)
        beyond = optical_depth - here * to_edge
        # The remaining optical depth, as a vertical one counted from z = 0, is looked up in the table of edges. An edge
        # met exactly on the way up is still to be crossed, with the clear layers that have the same optical depth.
        from_edge = dr.gather(mi.Float, self._edge, edge)
        target = from_edge + beyond * downward

        def passed(i: mi.UInt32) -> mi.Bool:
            following = dr.gather(mi.Float, self._edge, i + 1)
            return dr.select(downward > 0, following <= target, following < target)

        last = dr.binary_search(0, self.count - 1, passed)
        # Counted from the edge through which it enters the last layer, so that nearly level flights keep their length.
        enter = dr.select(downward > 0, last, dr.minimum(last + 1, self.count - 1))
        between = (dr.gather(mi.Float, self._edge, enter) - from_edge) / downward
        last_part = dr.maximum(beyond - between, _SMALLEST_OPTICAL_DEPTH) / self.coefficient(last)
        to_last = (dr.gather(mi.Float, self._top, enter) - dr.gather(mi.Float, self._top, edge)) / downward
        through = to_edge + to_last + last_part
        return dr.select((beyond > 0) & (to_edge < dr.inf), through, within)

    def _way_out(self, layer: mi.UInt32, depth: mi.Float, downward: mi.Float) -> tuple[mi.Float, mi.UInt32]:
        """Return the distance to the edge through which a ray leaves its layer, and the layer below that edge."""
        edge = dr.select(downward > 0, layer + 1, layer)
        # Upwards from the first layer and downwards from the last there is no edge.
        leaves = dr.select(downward > 0, layer + 1 < self.count, (layer > 0) & (downward < 0))
        edge = dr.minimum(edge, self.count - 1)
        to_edge = (dr.gather(mi.Float, self._top, edge) - depth) / downward
        return dr.select(leaves, dr.maximum(to_edge, 0), dr.inf), edge

    def optical_depth(self, depth: mi.Float, downward: mi.Float, length: mi.Float) -> mi.Float:
        """Return a segment's optical depth from its starting depth [m], downward component, and length [m]."""
        layer = self.layer_at(depth)
        here = self.coefficient(layer)
        if self.count == 1:
            return here * length
        to_edge, edge = self._way_out(layer, depth, downward)
        end_depth = depth + downward * length
        end = self.layer_at(end_depth)
        # The last part is counted from the edge through which the segment enters the layer where it ends.
        enter = dr.select(downward > 0, end, dr.minimum(end + 1, self.count - 1))
        between = (dr.gather(mi.Float, self._edge, enter) - dr.gather(mi.Float, self._edge, edge)) / downward
        last_part = (end_depth - dr.gather(mi.Float, self._top, enter)) / downward * self.coefficient(end)
        # To rounding, a nearly horizontal segment may pass an edge without leaving the layer.
        within = (length <= to_edge) | (end == layer)
        return dr.select(within, here * length, here * to_edge + between + last_part)
