"""Mean enhancement of echoes by ripples that the sea mesh lacks."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.level_sea import snell
from mitransient_lidar.physics.sea.double_passage import LEAST_DEPTH, EnhancementTable, slope_spread, slope_structures
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.physics.water.two_way_spread import displacements
from mitransient_lidar.transport.medium.water_phases import table_of
from mitransient_lidar.transport.opaque import aligned, opaque
from mitransient_lidar.transport.perturbations import Perturbation, Sums
from mitransient_lidar.transport.scene import LidarScene

_DEEPEST, _DEPTHS = 60.0, 20  #: Largest depth in the table [m], and its number of depths.
_MOST_EVENTS = 7  #: Largest number of forward scattering events that is distinguished.
_SAMPLES = 1000  #: Displacement samples.


@dataclass(frozen=True)
class Echo:
    """Where paths have turned."""

    #: Relative optical length by the point of the sea that the path has crossed [m], `Path.surface_length`.
    surface_length: mi.Float
    on_solid: mi.Bool | bool  #: Whether they have met a solid.


class RippleFocusing:
    """Energy factors for paths that cross a sea with ripples twice.

    Ripples are drawn anew on each way, so that they neither focus light nor return it through themselves. The factor is
    the ratio of the enhancements with and without correlated ripples. It depends on the echo's depth and the number of
    forward scattering events, which move one way against the other (`physics.sea.double_passage`).

    `depths`, `factors`: depths [m], and factors, of shape (`_MOST_EVENTS` + 1, `_DEPTHS`). `depth_per_length`: echo
    depth over its path's optical length beyond the surface path. `enhancement`: enhancement by all waves, in the shape
    of `factors`. `events`: mean number of scattering events on both ways to each depth. `enhancements`: returns the
    enhancements in other water by all waves and by the drawn waves, in the shape of `factors` transposed.
    """

    def __init__(
        self,
        depths: FloatArray,
        factors: FloatArray,
        depth_per_length: float,
        enhancement: FloatArray,
        events: FloatArray,
        enhancements: Callable[[WaterColumn, Sequence[PowerLawTable]], tuple[FloatArray, FloatArray]],
    ) -> None:
        self.depths, self.factors, self.enhancement, self.events = depths, factors, enhancement, events
        self._table, self._depth_per_length = aligned(mi.Float, factors.astype(np.float32)), opaque(depth_per_length)
        self._enhancements = enhancements
        self._changes: list[mi.Float | None] = []

    @classmethod
    def of_scene(
        cls, scene: LidarScene, cells: Callable[[FloatArray], FloatArray] | None = None
    ) -> RippleFocusing | None:
        """Return the factors of a lidar above a sea whose spectrum is known; None for others.

        `cells` returns, for depths [m], the side of the cells within which light and view are at random places. Waves
        in the mesh then enhance their product less; None where they meet at points.
        """
        seas = scene.seas
        transmitter, receiver = scene.transmitter.pose, scene.receiver.pose
        if scene.water is None or scene.submerged or len(seas) != 1 or receiver.axis[2] >= 0:
            return None
        sea = seas[0].sea
        if sea.focusing_spectrum is None:
            return None
        structures = slope_structures(sea.focusing_spectrum, sum(sea.resolved_variance), sum(sea.ripple_variance))
        theta = np.radians(receiver.off_nadir_deg)
        cos_water = float(np.cos(snell(theta, scene.refractive_index)))
        depths = np.geomspace(LEAST_DEPTH, _DEEPEST, _DEPTHS)
        spread = slope_spread(theta, scene.refractive_index)
        tables = [EnhancementTable.of(structure, depths, spread) for structure in structures]
        offset = transmitter.origin - receiver.origin
        apart = complex(*(float(offset @ side) for side in (receiver.far, receiver.left)))
        radius = np.sqrt(scene.receiver.optics.aperture_area / np.pi)
        index = scene.refractive_index

        def enhancements(column: WaterColumn, phases: Sequence[PowerLawTable]) -> tuple[FloatArray, FloatArray]:
            # The same random numbers for all water.
            rng = np.random.default_rng(0)
            disc = radius * np.sqrt(rng.random(_SAMPLES)) * np.exp(2j * np.pi * rng.random(_SAMPLES))
            between = (apart + disc) / (index * receiver.ground_range) * depths[:, None, None]
            moves = displacements(column, phases, depths, _MOST_EVENTS, _SAMPLES, rng)
            moved = np.abs(between + moves) / cos_water
            of_drawn = moved
            if cells is not None:
                # The difference of two places in a cell.
                x, y = rng.random((2, _SAMPLES)) - rng.random((2, _SAMPLES))
                of_drawn = np.abs(between + moves + cells(depths)[:, None, None] * (x + 1j * y)) / cos_water
            true, drawn = (
                table.at(depths[:, None, None], by).mean(axis=-1)
                for table, by in zip(tables, (moved, of_drawn), strict=True)
            )
            return true, drawn

        column = scene.water.column
        true, drawn = enhancements(column, [table_of(phase) for phase in scene.water.phases.phases[: column.count]])
        events = 2 * column.optical_depth_of_scattering(depths) / cos_water
        return cls(depths, (true / drawn).T, 0.5 * cos_water / scene.group_index, true.T, events, enhancements)

    def factors_of(self, column: WaterColumn, phases: Sequence[PowerLawTable]) -> FloatArray:
        """Return the factors in other water, in the shape of `factors`: its layers and their phase functions."""
        true, drawn = self._enhancements(column, phases)
        return np.asarray((true / drawn).T)

    def perturbed(self, perturbations: Sequence[Perturbation]) -> RippleFocusing:
        """Return these factors with their changes by perturbations."""
        changed = copy.copy(self)
        tables = [one.focusing for one in perturbations]
        changed._changes = [None if one is None else aligned(mi.Float, one.astype(np.float32)) for one in tables]
        return changed

    def describe(self) -> dict[str, list[float]]:
        """Return attributes of a result: mean enhancement by all waves by depth [m], linear and to 1 at 0 m.

        The numbers of scattering events are Poisson-distributed, as for light without loss.
        """
        number = np.arange(_MOST_EVENTS)
        log = number[:, None] * np.log(np.maximum(self.events, 1e-30)) - self.events
        share = np.exp(log - np.cumsum(np.log(np.maximum(number, 1)))[:, None])
        mean = (share * self.enhancement[:-1]).sum(axis=0) + (1 - share.sum(axis=0)) * self.enhancement[-1]
        return {"wave_focusing_depths": self.depths.tolist(), "wave_focusing": mean.tolist()}

    def of(self, echo: Echo, order: mi.UInt32, length: mi.Float) -> mi.Float:
        """Return path factors by number of scattering events and relative length [m].

        One event turns light in the water. Light that the surface alone has reflected has the factor 1.
        """
        return self._look_up(self._table, 1.0, echo, order, length)

    def perturb(self, sums: Sums, factor: mi.Float, echo: Echo, order: mi.UInt32, length: mi.Float) -> Sums:
        """Return the perturbation sums with the factors' derivatives."""
        found = []
        for total, table in zip(sums, self._changes, strict=True):
            if table is not None:
                total = total + self._look_up(table, 0.0, echo, order, length) / factor
            found.append(total)
        return found

    def _look_up(self, table: mi.Float, at_surface: float, echo: Echo, order: mi.UInt32, length: mi.Float) -> mi.Float:
        """Return the values of a table, which are `at_surface` at the surface and for light that it has reflected."""
        turned = dr.select(mi.Bool(echo.on_solid), mi.UInt32(0), 1)
        events = dr.minimum(dr.select(order > turned, order - turned, 0), _MOST_EVENTS)
        depth = (length - echo.surface_length) * self._depth_per_length
        step = np.log(_DEEPEST / LEAST_DEPTH) / (_DEPTHS - 1)
        place = dr.clip(dr.log(dr.maximum(depth, 1e-6) / LEAST_DEPTH) / step, 0, _DEPTHS - 1)
        low = dr.minimum(mi.UInt32(place), _DEPTHS - 2)
        first, second = (dr.gather(mi.Float, table, events * _DEPTHS + low + more) for more in (0, 1))
        factor = dr.lerp(first, second, place - mi.Float(low))
        factor = dr.lerp(at_surface, factor, dr.clip(depth / LEAST_DEPTH, 0, 1))
        return dr.select(order >= turned, factor, at_surface)
