"""Phase functions of water layers: selection, mixture with pure water, and lookup by layer."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Protocol, runtime_checkable

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase_table import DEFAULT_COUNT, DEFAULT_LOG_S0, PowerLawTable
from mitransient_lidar.physics.water.seawater import water_phase_function
from mitransient_lidar.transport.medium.tabulated_phase import NumberedPhase, TabulatedPhase, deflect


@runtime_checkable
class HasTable(Protocol):
    """Phase functions that are tables."""

    tabulated: TabulatedPhase


#: Beyond this number of different mixtures, bb/b and pure water's share are rounded to this step in their logarithms.
_MOST_FUNCTIONS, _STEP = 16, 0.02

_ANY_RATIO = 0.0183  #: bb/b where there are no particles, without effect.
_SMALLEST_SHARE = 1e-4  #: Share of the scattering below which pure water is left out.


class ScattererPhases:
    """Phase functions by the number of the scatterer: layers from the top, then bubbles.

    Functions that are tables with the same nodes are looked up in one large table. Others are called through pointers,
    which is slower. Scatterers may share a function object.
    """

    def __init__(self, phases: Sequence[mi.PhaseFunction]) -> None:
        self.phases = list(phases)
        different = {id(phase): phase for phase in self.phases}
        self._single = self.phases[0] if len(different) == 1 else None
        numbers = {key: number for number, key in enumerate(different)}
        self._of_scatterer = [numbers[id(phase)] for phase in self.phases]
        self._different = list(different.values())
        tables = [phase.tabulated.table for phase in self._different if isinstance(phase, HasTable)]
        alike = len(tables) == len(self._different) and len({(table.count, table.log_s0) for table in tables}) == 1
        self._stack = TabulatedPhase(*tables) if alike and self._single is None else None
        self._numbers: mi.UInt32 | None = None

    def at(self, scatterer: mi.UInt32) -> mi.PhaseFunctionPtr | NumberedPhase:
        """Return the phase function of each lane's scatterer, with Mitsuba's ``eval_pdf`` and ``sample``."""
        if self._single is not None:
            return self._single
        if self._numbers is None:
            found = self._of_scatterer
            if self._stack is None:
                pointers = [dr.reinterpret_array(mi.UInt32, mi.PhaseFunctionPtr(phase))[0] for phase in self._different]
                found = [pointers[number] for number in found]
            self._numbers = mi.UInt32(found)
        number = dr.gather(mi.UInt32, self._numbers, scatterer)
        if self._stack is None:
            return dr.reinterpret_array(mi.PhaseFunctionPtr, number)
        return NumberedPhase(self._stack, number)


@dataclass(frozen=True)
class LayerPhases:
    """Phase functions of layers as they follow from their coefficients."""

    column: WaterColumn  #: The layers.
    #: Phase functions of the particles by name: one for all layers, or ``phase_0``, ``phase_1``, ...; or none.
    nested: dict[str, mi.PhaseFunction]
    kind: str  #: Choice by the parameter ``phase_function``, used where none is nested.
    phase_g: float  #: Mean cosine for ``hg``.
    water_scattering: np.ndarray  #: Scattering by pure water [1/m], shape (layers,), a part of the column's scattering.
    #: bb/(2 pi p(pi) b) of the particles in each layer, shape (layers,), or None for their function's value.
    chi_p: np.ndarray | None
    tabulated: Callable[[PowerLawTable], mi.PhaseFunction]  #: Constructor that makes a phase function from a table.

    def functions(self) -> list[mi.PhaseFunction]:
        """Return one phase function a layer, the same object where layers share it.

        Raises UserError when nested functions are neither one nor one a layer, or `chi_p` makes a function negative.
        """
        column, nested, count = self.column, self.nested, self.column.count
        share = np.divide(self.water_scattering, column.scattering, out=np.zeros(count), where=column.scattering > 0)
        if len(nested) == 1:
            particles = list(nested.values()) * count
        elif nested:
            wanted = [f"phase_{layer}" for layer in range(count)]
            if sorted(nested) != sorted(wanted):
                raise UserError(
                    f"layered_water: nested phase functions are named {', '.join(sorted(nested))}; "
                    f"allowed is one of any name, or one a layer: {', '.join(wanted)}"
                )
            particles = [nested[name] for name in wanted]
        elif self.kind == "petzold":
            particles = [create_object("petzold")] * count
        elif self.kind == "hg":
            particles = [create_object("hg", g=self.phase_g)] * count
        else:
            particles, share = _fournier_forand(column, self.water_scattering, share)
        return _mixed(particles, share, [None] * count if self.chi_p is None else self.chi_p.tolist(), self.tabulated)

    def table(
        self,
        layer: int,
        *,
        scattering: float | None = None,
        backscattering: float | None = None,
        phase_g: float | None = None,
    ) -> PowerLawTable:
        """Return a layer's phase function, with some of its coefficients [1/m] or its mean cosine changed."""
        column = self.column
        b = float(column.scattering[layer]) if scattering is None else scattering
        bb = float(column.backscattering[layer]) if backscattering is None else backscattering
        # The attenuation does not change the function, and must not be less than the scattering.
        values = (np.array([value]) for value in (0.0, max(float(column.attenuation[layer]), b), b, bb))
        molecules = np.broadcast_to(self.water_scattering, (column.count,))[layer : layer + 1]
        nested = {"phase": self.nested.get(f"phase_{layer}", next(iter(self.nested.values())))} if self.nested else {}
        alone = replace(
            self,
            column=WaterColumn(*values),
            nested=nested,
            phase_g=self.phase_g if phase_g is None else phase_g,
            water_scattering=molecules,
            chi_p=None if self.chi_p is None else self.chi_p[layer : layer + 1],
        )
        return table_of(alone.functions()[0])


def check_phases(phases: Mapping[str, mi.PhaseFunction]) -> None:
    """Raise `UserError` if a phase function depends on more than the scattering angle."""
    for name, phase in phases.items():
        if int(phase.flags()) & mi.PhaseFunctionFlags.Microflake.value:
            raise UserError(
                f"layered_water: its phase function {name!r}, {phase.class_name()}, depends on the orientation of "
                "particles; allowed are those that depend on the scattering angle alone, such as hg or tabphase"
            )


def _fournier_forand(
    column: WaterColumn, water_scattering: np.ndarray, share: np.ndarray
) -> tuple[list[mi.PhaseFunction], np.ndarray]:
    """Return the particles' phase functions by their bb/b, and pure water's scattering share; both one per layer."""
    particles = column.scattering - water_scattering
    back = column.backscattering - water_scattering / 2
    for layer in np.flatnonzero((back < 0) & (particles > 0))[:1]:
        raise UserError(
            f"backscattering = {column.backscattering[layer]:g} must be at least half of water_scattering = "
            f"{water_scattering[layer]:g}, in layer {layer}"
        )
    ratios = np.divide(back, particles, out=np.full(column.count, _ANY_RATIO), where=particles > 0)
    # Rounded so that layers whose bb/b differ by rounding share a function.
    kinds = [(round(float(ratio), 12), float(part)) for ratio, part in zip(ratios, share, strict=True)]
    if len(set(kinds)) > _MOST_FUNCTIONS:
        kinds = [(_rounded(ratio), _rounded(part) if _SMALLEST_SHARE < part < 1 else part) for ratio, part in kinds]
    made = {ratio: create_object("fournier_forand", backscatter_ratio=ratio) for ratio, _ in dict.fromkeys(kinds)}
    return [made[ratio] for ratio, _ in kinds], np.array([part for _, part in kinds])


def _rounded(value: float) -> float:
    """Return the value rounded in its logarithm; values that are not positive are refused later."""
    return math.exp(_STEP * round(math.log(value) / _STEP)) if value > 0 else value


def _mixed(
    particles: list[mi.PhaseFunction],
    share: np.ndarray,
    chi_p: list[float | None],
    tabulated: Callable[[PowerLawTable], mi.PhaseFunction],
) -> list[mi.PhaseFunction]:
    """Return the particles' phase functions mixed with pure water's, by its share of the scattering."""

    @cache
    def mixed(number: int, part: float, chi: float | None) -> mi.PhaseFunction:
        phase = different[number]
        if part <= _SMALLEST_SHARE and chi is None:
            return phase
        table = table_of(phase) if chi is None else table_of(phase).with_chi(chi)
        water = PowerLawTable.from_function(water_phase_function)
        return tabulated(PowerLawTable.mixture([table, water], [1 - part, part]))

    different = {id(phase): phase for phase in particles}
    return [mixed(id(phase), part, chi) for phase, part, chi in zip(particles, share.tolist(), chi_p, strict=True)]


def table_of(phase: mi.PhaseFunction) -> PowerLawTable:
    """Return a phase function as a table: its own, or one of its values."""
    if isinstance(phase, HasTable):
        return phase.tabulated.table
    s = np.exp(DEFAULT_LOG_S0 * np.linspace(1, 0, DEFAULT_COUNT))
    mei = dr.zeros(mi.MediumInteraction3f, len(s))
    mei.wi = mi.Vector3f(0, 0, -1)
    value, _ = phase.eval_pdf(mi.PhaseFunctionContext(), mei, deflect(mi.Frame3f(-mei.wi), mi.Float(s), mi.Float(0)))
    # An isotropic function's value is one number.
    return PowerLawTable.from_values(np.broadcast_to(np.array(value[0], dtype=np.float64), s.shape))


def create_object(kind: str, **values: Any) -> Any:
    """Return a Mitsuba object of a plugin type with given parameters, nested objects among them.

    Constructors must not call ``mitsuba.load_dict``. It replaces Mitsuba's file resolver while it works;
    ``mitsuba.load_file`` makes objects in several threads. One may just use the resolver to find a plugin's library: 5
    to 15 % of processes then failed in their first load, as with "basic_string::_M_create".
    """
    properties = mi.Properties(kind)
    for name, value in values.items():
        properties[name] = value
    return mi.PluginManager.instance().create_object(properties)
