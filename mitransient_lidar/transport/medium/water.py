"""The water that paths meet: index layers with the refraction between them and at the sea, bubbles, and scatterers."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.transport.medium.bubbles import BubbleLayer, BubblePlume
from mitransient_lidar.transport.medium.free_flight import LayeredFlight
from mitransient_lidar.transport.medium.water_phases import LayerPhases, ScattererPhases
from mitransient_lidar.transport.opaque import aligned, opaque

MOST_INDEX_LAYERS = 16  #: Largest number of index layers: connections are traced through each.

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

    `direction`: unit direction from the facet to the light source, on the side of the normal. `normal`: unit normal of
    the facet. `eta`: refractive index on the side of the normal over the index beyond, at most 1.
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


@dataclass(frozen=True, eq=False)
class Water:
    """Water in horizontal layers, with or without bubbles behind a ship or below a windy sea."""

    column: WaterColumn  #: Layer coefficients; equal neighbours are joined.
    layers: LayerPhases  #: The layers as given, and their phase functions for changed coefficients.
    phases: ScattererPhases  #: Phase functions of the layers, and last of the bubbles.
    index_layers: IndexLayers  #: Runs of layers with one refractive and one group index.
    #: Scattering by water molecules in each layer, a part of b [1/m]; 0 where it is not known.
    water_scattering: np.ndarray
    plume: BubblePlume | BubbleLayer | None = None  #: Bubbles, or None.
    from_profile: bool = False  #: Whether the layers approximate a profile from a file.
    #: Wavelength of the water [nm]; None where its coefficients and indices are given as numbers without one.
    wavelength_nm: float | None = None
    #: Whether the water is computed at this wavelength; a water by numbers at a green wavelength represents green
    #: lasers.
    by_name: bool = False
    #: Free flights by attenuation, scattering and absorption.
    flight: LayeredFlight = field(init=False)
    scattering_flight: LayeredFlight = field(init=False)
    absorption_flight: LayeredFlight = field(init=False)

    def __post_init__(self) -> None:
        column, none = self.column, np.zeros(self.column.count)
        flights = {
            "flight": column,
            "scattering_flight": replace(column, attenuation=column.scattering),
            "absorption_flight": WaterColumn(column.layer_tops, column.absorption, none, none),
        }
        for name, of in flights.items():
            object.__setattr__(self, name, LayeredFlight(of))

    def moved(self, place: FloatArray) -> Water:
        """Return the water relative to a place (x, y, z) [m]: a plume of bubbles has one."""
        if not (isinstance(self.plume, BubblePlume) and place[:2].any()):
            return self
        return replace(self, plume=self.plume.displaced(place[:2], np.zeros(2), 1 + 0j))

    @property
    def refractive_index(self) -> float:
        """Refractive index below the sea surface."""
        return float(self.index_layers.refractive_index[0])

    @property
    def group_index(self) -> float:
        """Group index below the sea surface."""
        return float(self.index_layers.group_index[0])

    @property
    def majorant(self) -> float:
        """Largest attenuation anywhere [1/m]."""
        return float(np.max(self.column.attenuation)) + (self.plume.scattering if self.plume else 0)

    @property
    def plume_phase(self) -> mi.PhaseFunction | None:
        """Phase function of the bubbles."""
        return None if self.plume is None else self.phases.phases[-1]

    def free_flight(self, flight: LayeredFlight, point: mi.Point3f, direction: mi.Vector3f, rng: mi.PCG32) -> mi.Float:
        """Draw the distance to the next event in `flight`, or by bubbles [m]."""
        distance = flight.distance(-point.z, -direction.z, -dr.log(1 - rng.next_float32()))
        if self.plume is None:
            return distance
        return dr.minimum(distance, self.plume.distance(point, direction, -dr.log(1 - rng.next_float32())))

    def optical_depth(self, point: mi.Point3f, direction: mi.Vector3f, length: mi.Float) -> mi.Float:
        """Return the optical depth of a segment [1], bubbles included."""
        through = self.flight.optical_depth(-point.z, -direction.z, length)
        return through if self.plume is None else through + self.plume.optical_depth(point, direction, length)

    def scatterer_at(self, flight: LayeredFlight, point: mi.Point3f, rng: mi.PCG32) -> mi.UInt32:
        """Draw the scatterer at a flight's end: the layer number, or for a bubble the number of layers."""
        layer = flight.layer_at(-point.z)
        if self.plume is None:
            return layer
        bubbles = self.plume.scattering_at(point)
        is_bubble = rng.next_float32() * (bubbles + flight.coefficient(layer)) < bubbles
        return dr.select(is_bubble, mi.UInt32(self.column.count), layer)

    def is_water(self, scatterer: mi.UInt32) -> mi.Bool:
        """Return whether scatterers are water layers, not bubbles."""
        return scatterer < self.column.count

    def coefficient(self, flight: LayeredFlight, scatterer: mi.UInt32, point: mi.Point3f) -> mi.Float:
        """Return the coefficient in `flight` of an event's scatterer at a point [1/m]."""
        if self.plume is None:
            return flight.coefficient(scatterer)
        layer = dr.minimum(scatterer, self.column.count - 1)
        bubbles = self.plume.scattering_of_event(point)
        return dr.select(scatterer == self.column.count, bubbles, flight.coefficient(layer))

    def albedo(self, scatterer: mi.UInt32) -> mi.Float:
        """Return the single-scattering albedo of a scatterer; bubbles absorb nothing."""
        if self.plume is None:
            return self.flight.albedo(scatterer)
        layer = dr.minimum(scatterer, self.column.count - 1)
        return dr.select(scatterer == self.column.count, mi.Float(1), self.flight.albedo(layer))

    def coefficients_at(self, point: mi.Point3f) -> tuple[mi.Float, mi.Float]:
        """Return attenuation and scattering at points [1/m], bubbles included."""
        layer = self.flight.layer_at(-point.z)
        attenuation = self.flight.coefficient(layer)
        scattering = self.flight.albedo(layer) * attenuation
        if self.plume is None:
            return attenuation, scattering
        bubbles = self.plume.scattering_at(point)
        return attenuation + bubbles, scattering + bubbles
