"""Derivatives of path contributions by water and solid properties.

A path has lengths L in the layers, n scattering events by the angles theta and m reflections by a solid. It contributes
in proportion to exp(-c L) b^n times the product of p(theta) and reflectance^m. Its logarithm is a sum over the path,
and so is its derivative. It is -L by c (b fixed), n / b by b (c fixed), and so on. The contribution's derivative is
contribution times sum, from the same paths (perturbation Monte Carlo: Hayakawa et al. 2001, doi:10.1364/OL.26.001335).
The weights between techniques that find the same path add up to 1 in any water, and are not differentiated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.water.phase_table import DEFAULT_COUNT, DEFAULT_LOG_S0
from mitransient_lidar.transport.laser import BeamProfile, GaussianBeam
from mitransient_lidar.transport.medium.tabulated_phase import half_angle
from mitransient_lidar.transport.opaque import aligned, opaque

_SMALLEST_SLOPE = 1e-9  #: Smallest vertical component of segments that are divided among layers: others lie in one.

#: Sum of each perturbation along a path, empty without perturbations.
Sums = list[Any]


@dataclass(frozen=True)
class LayerChange:
    """A perturbation's additions per metre and per scattering event between two depths."""

    #: Depths [m], -inf and inf for no limit.
    top: float
    bottom: float
    #: Addition for each metre travelled [1/m], and for each scattering event by water.
    per_metre: float = 0.0
    per_event: float = 0.0
    #: Addition by scattering angle for each of these events, at nodes that are uniform in ln s from `DEFAULT_LOG_S0` to
    #: 0 with s = sin^2(theta/2), shape (DEFAULT_COUNT,); or None.
    by_angle: FloatArray | None = None


@dataclass(frozen=True)
class Perturbation:
    """A change in water and solids by a parameter: the derivative of a path contribution's logarithm."""

    layers: tuple[LayerChange, ...] = ()  #: Additions by water between depths.
    solids: tuple[tuple[mi.Shape, float], ...] = ()  #: Solids with the addition by each reflection.
    focusing: FloatArray | None = None  #: Derivative of `RippleFocusing.factors`; None where they do not change.
    #: Sea ripples with the parameter below and above its value, and the difference between these values; None where
    #: they do not change.
    ripples: tuple[mi.BSDF, mi.BSDF, float] | None = None
    #: Change in a Gaussian beam's logarithmic widths with the parameter; None where they do not change.
    beam: float | None = None


class _Layer:
    """A `LayerChange` as numbers that kernels read from memory."""

    def __init__(self, change: LayerChange) -> None:
        self._limits = change.top, change.bottom
        self._top, self._bottom = (opaque(max(min(depth, 1e9), -1e9)) for depth in self._limits)
        self.travels = change.per_metre != 0
        self.scatters = change.per_event != 0 or change.by_angle is not None
        self._per_metre, self._per_event = opaque(change.per_metre), opaque(change.per_event)
        #: Number of the tables that include this change's, or None.
        self.tables: int | None = None

    def along(self, depth: mi.Float, downward: mi.Float, length: mi.Float) -> mi.Float:
        """Return the addition by segments: depth of the start [m], downward component, length [m]."""
        if self._limits == (-np.inf, np.inf):
            return self._per_metre * length
        # Distances to the edges, which neighbouring layers share: their parts add up to the length exactly.
        level = dr.abs(downward) < _SMALLEST_SLOPE
        slope = dr.select(level, dr.copysign(mi.Float(_SMALLEST_SLOPE), downward), downward)
        first, second = (dr.clip((edge - depth) / slope, 0, length) for edge in (self._top, self._bottom))
        return self._per_metre * dr.abs(second - first)

    def about(self, depth: mi.Float, length: mi.Float) -> mi.Float:
        """Return the addition by lengths [m] about depths [m], negative on the way back, all in one layer."""
        return self._within(depth, self._per_metre * length)

    def at_event(self, depth: mi.Float, by_angle: Sequence[mi.Float]) -> mi.Float:
        """Return the addition by scattering events: depth [m], and table values there."""
        return self._within(depth, self._per_event if self.tables is None else self._per_event + by_angle[self.tables])

    def _within(self, depth: mi.Float, addition: mi.Float) -> mi.Float:
        """Return an addition where depths [m] are in the layer, else 0."""
        if self._limits == (-np.inf, np.inf):
            return addition
        return dr.select(self.contains(depth), addition, 0)

    def contains(self, depth: mi.Float) -> mi.Bool:
        """Return whether depths [m] are in the layer."""
        return (depth >= self._top) & (depth < self._bottom)


class _Tables:
    """Scattering angle tables for changes between different depths, of which one applies at each."""

    def __init__(self) -> None:
        self._changes: list[tuple[LayerChange, _Layer]] = []
        self._values = mi.Float()

    def takes(self, change: LayerChange) -> bool:
        """Return whether a change has other depths than all of these."""
        return all(change.top >= other.bottom or change.bottom <= other.top for other, _ in self._changes)

    def add(self, change: LayerChange, layer: _Layer) -> None:
        """Add a change's table."""
        self._changes.append((change, layer))
        tables = [one.by_angle for one, _ in self._changes if one.by_angle is not None]
        self._values = aligned(mi.Float, np.concatenate(tables).astype(np.float32))

    def at(self, depth: mi.Float, cell: mi.UInt32, fraction: mi.Float) -> mi.Float:
        """Return the values of the tables at depths [m], for a place among the nodes."""
        start = mi.UInt32(0)
        for number, (_, layer) in enumerate(self._changes[1:], 1):
            start = dr.select(layer.contains(depth), mi.UInt32(number * DEFAULT_COUNT), start)
        low, high = (dr.gather(mi.Float, self._values, start + cell + step) for step in (0, 1))
        return dr.lerp(low, high, fraction)


class Perturbations:
    """Perturbation sums along paths; without perturbations all are empty."""

    def __init__(self, perturbations: Sequence[Perturbation] = ()) -> None:
        self.perturbations = tuple(perturbations)
        self._layers = [[_Layer(change) for change in one.layers] for one in self.perturbations]
        self._travelled = [[layer for layer in layers if layer.travels] for layers in self._layers]
        self._scattered = [[layer for layer in layers if layer.scatters] for layers in self._layers]
        self._solids = [[(solid, opaque(addition)) for solid, addition in one.solids] for one in self.perturbations]
        self._tables: list[_Tables] = []
        for one, layers in zip(self.perturbations, self._layers, strict=True):
            for change, layer in zip(one.layers, layers, strict=True):
                if change.by_angle is not None:
                    layer.tables = self._group(change)
                    self._tables[layer.tables].add(change, layer)

    def _group(self, change: LayerChange) -> int:
        """Return the number of the first tables that can include a change, or of new tables."""
        for number, tables in enumerate(self._tables):
            if tables.takes(change):
                return number
        self._tables.append(_Tables())
        return len(self._tables) - 1

    @staticmethod
    def _with(sums: Sums, parts: Sequence[Sequence[Any]], addition: Callable[[Any], mi.Float]) -> Sums:
        """Return sums with the additions of each perturbation's parts."""
        return [sum(map(addition, some), total) for total, some in zip(sums, parts, strict=True)]

    @property
    def count(self) -> int:
        """Number of perturbations."""
        return len(self.perturbations)

    def start(self) -> Sums:
        """Return the sums for paths that start."""
        return [mi.Float(0) for _ in self.perturbations]

    def along(
        self, sums: Sums, depth: mi.Float, downward: mi.Float, length: mi.Float, active: mi.Bool | bool = True
    ) -> Sums:
        """Return sums beyond segments in water: depth of their start [m], downward component, length [m]."""
        return self._with(
            sums, self._travelled, lambda one: dr.select(mi.Bool(active), one.along(depth, downward, length), 0)
        )

    def about(self, sums: Sums, depth: mi.Float, length: mi.Float) -> Sums:
        """Return sums of light that is carried on about depths [m] by small lengths [m], negative on the way back."""
        return self._with(sums, self._travelled, lambda one: one.about(depth, length))

    def at_event(
        self,
        sums: Sums,
        depth: mi.Float,
        before: mi.Vector3f,
        after: mi.Vector3f,
        share: mi.Float | None = None,
        active: mi.Bool | bool = True,
    ) -> Sums:
        """Return sums beyond scattering events by water, from one direction to another.

        `share` is the water's share among the scatterers that may have scattered, 1 by default.
        """
        if not sums:
            return sums
        by_angle: list[mi.Float] = []
        if self._tables:
            s = dr.maximum(half_angle(before, after), np.exp(DEFAULT_LOG_S0))
            place = (dr.log(s) - DEFAULT_LOG_S0) * ((DEFAULT_COUNT - 1) / -DEFAULT_LOG_S0)
            cell = dr.minimum(mi.UInt32(dr.maximum(place, 0)), DEFAULT_COUNT - 2)
            fraction = place - mi.Float(cell)
            by_angle = [tables.at(depth, cell, fraction) for tables in self._tables]

        def addition(layer: _Layer) -> mi.Float:
            own = layer.at_event(depth, by_angle)
            return dr.select(mi.Bool(active), own if share is None else own * share, 0)

        return self._with(sums, self._scattered, addition)

    def at_solid(self, sums: Sums, shape: mi.ShapePtr, active: mi.Bool | bool = True) -> Sums:
        """Return sums beyond reflections by solids."""
        return self._with(
            sums, self._solids, lambda one: dr.select(mi.Bool(active) & (shape == mi.ShapePtr(one[0])), one[1], 0)
        )

    def at_laser(self, sums: Sums, profile: BeamProfile, angle_x: mi.Float, angle_y: mi.Float) -> Sums:
        """Return the sums for paths that leave the laser, with a beam profile, at tangent-plane angles [rad]."""
        if not isinstance(profile, GaussianBeam):
            return sums
        return [
            total if one.beam is None else total + profile.width_slope(angle_x, angle_y) * opaque(one.beam)
            for total, one in zip(sums, self.perturbations, strict=True)
        ]

    def at_sea(self, sums: Sums, si: mi.SurfaceInteraction3f, outgoing: mi.Vector3f, active: mi.Bool) -> Sums:
        """Return the sums beyond the sea surface, in a direction in the interaction's frame."""
        found = []
        for total, one in zip(sums, self.perturbations, strict=True):
            if one.ripples is not None:
                below, above, width = one.ripples
                low, high = (bsdf.eval(mi.BSDFContext(), si, outgoing, active)[0] for bsdf in (below, above))
                lit = active & (low > 0) & (high > 0)
                total = total + dr.select(lit, dr.log(high / low) * opaque(1 / width), 0)
            found.append(total)
        return found

    def channels(self, energy: mi.Float, sums: Sums) -> list[mi.Float]:
        """Return the energy derivatives of complete paths."""
        return [energy * total for total in sums]


def joined(first: Sums, second: Sums) -> Sums:
    """Return the sums for paths with two parts."""
    return [one + other for one, other in zip(first, second, strict=True)]
