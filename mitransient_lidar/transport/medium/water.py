"""The water that paths meet: layers, bubbles, and scatterers."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.transport.medium.bubbles import BubbleLayer, BubblePlume
from mitransient_lidar.transport.medium.free_flight import LayeredFlight
from mitransient_lidar.transport.medium.index_layers import IndexLayers
from mitransient_lidar.transport.medium.water_phases import LayerPhases, ScattererPhases


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
        """Draw the scatterer at the end of a flight: the layer number, or the number of layers for a bubble."""
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
