"""Medium plugin ``layered_water``: horizontally stratified water."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.optics.checks import in_range
from mitransient_lidar.optics.water import WaterColumn
from mitransient_lidar.transport.flight import LayeredFlight

_PHASES = ("fournier_forand", "petzold", "hg")


class LayeredWater(mi.Medium):
    r"""Water in horizontal layers (``layered_water``).

    ===================  ======  =======================================================================================
    Parameter            Type    Meaning
    ===================  ======  =======================================================================================
    tops                 string  Depth of each layer's upper edge [m], first 0, increasing: ``0, 3``. Default: ``0``
    attenuation          string  Beam attenuation c of each layer [1/m], or one value for all. Default: 0.3
    scattering           string  Scattering b [1/m], at most c. Default: 0.15
    backscattering       string  Backscattering bb [1/m], at most b. Default: 0.006
    phase_function       string  ``fournier_forand`` (each layer's from its bb/b), ``petzold`` or ``hg``.
                                 Default: ``fournier_forand``
    phase_g              float   hg: mean cosine, -0.999 to 0.999. Default: 0.924
    (nested)             phase   Any phase function, used in all layers instead; or one a layer, named ``phase_0``,
                                 ``phase_1``, ... from the top
    refractive_index     float   Phase index, bends rays, 1.0001 to 2. Default: 1.34
    group_index          float   Group index, times them, 1 to 2. Default: 1.364 (sea water at 532 nm)
    ===================  ======  =======================================================================================

    The first layer also fills the wave crests above z = 0, the last goes down without end. With ``petzold``, ``hg`` or
    a nested phase function, bb follows from that function and ``backscattering`` is only checked.

    The lidar integrators sample free flights and transmittances through all layers in closed form. Mitsuba's own
    volumetric integrators work as well, with null collisions against the largest attenuation and the first layer's
    phase function in all layers.

    .. code-block:: xml

        <medium type="layered_water" name="interior">
            <string name="tops" value="0, 3"/>
            <string name="attenuation" value="0.9, 0.5"/>
            <string name="scattering" value="0.7, 0.35"/>
            <string name="backscattering" value="0.014, 0.007"/>
        </medium>

    .. code-block:: python

        {'type': 'layered_water', 'attenuation': 0.3, 'scattering': 0.15, 'backscattering': 0.006}
    """

    def __init__(self, props: mi.Properties) -> None:
        phases = {name: child for name, child in props.objects() if isinstance(child, mi.PhaseFunction)}
        self.column = WaterColumn.from_text(
            props.get("tops", "0"),
            props.get("attenuation", 0.3),
            props.get("scattering", 0.15),
            props.get("backscattering", 0.006),
        )
        self.refractive_index = in_range("refractive_index", props.get("refractive_index", 1.34), 1.0001, 2.0)
        self.group_index = in_range("group_index", props.get("group_index", 1.364), 1.0, 2.0)
        kind = props.get("phase_function", "fournier_forand")
        phase_g = in_range("phase_g", props.get("phase_g", 0.924), -0.999, 0.999)
        if kind not in _PHASES:
            raise ValueError(f"phase_function = {kind!r} must be one of {', '.join(_PHASES)}")
        # Mitsuba's own media hold one phase function; the others are this plugin's.
        for name in list(phases)[1:]:
            del props[name]
        self.phases = _phases_of_layers(self.column, phases, kind, phase_g)
        if not phases:
            # For Mitsuba's own integrators, which would take an isotropic function where none is nested.
            props["phase_0"] = self.phases[0]
        super().__init__(props)
        # One pointer a layer; layers that share a function share the pointer, and the call.
        self._same_phase = all(phase is self.phases[0] for phase in self.phases)
        self.flight = LayeredFlight(self.column)
        self.scattering_flight = LayeredFlight(replace(self.column, attenuation=self.column.scattering))
        none = np.zeros(self.column.count)
        self.absorption_flight = LayeredFlight(WaterColumn(self.column.tops, self.column.absorption, none, none))
        self._majorant = float(np.max(self.column.attenuation))
        self.m_is_homogeneous = self.column.count == 1
        self.m_has_spectral_extinction = False

    def phase_at(self, layer: mi.UInt32) -> mi.PhaseFunction | mi.PhaseFunctionPtr:
        """Return the phase function of a layer: the object itself when all layers have the same, else pointers."""
        if self._same_phase:
            return self.phases[0]
        pointers = mi.PhaseFunctionPtr(self.phases[0])
        for index, phase in enumerate(self.phases[1:], start=1):
            pointers = dr.select(layer == index, mi.PhaseFunctionPtr(phase), pointers)
        return pointers

    def get_majorant(self, mei: mi.MediumInteraction3f, active: mi.Bool = True) -> mi.UnpolarizedSpectrum:
        """Return the largest attenuation [1/m], for Mitsuba's own integrators."""
        return mi.UnpolarizedSpectrum(self._majorant)

    def get_scattering_coefficients(
        self, mei: mi.MediumInteraction3f, active: mi.Bool = True
    ) -> tuple[mi.UnpolarizedSpectrum, mi.UnpolarizedSpectrum, mi.UnpolarizedSpectrum]:
        """Return scattering, null and total coefficient [1/m], for Mitsuba's own integrators."""
        layer = self.flight.layer_at(-mei.p.z)
        attenuation = self.flight.attenuation(layer)
        return (
            mi.UnpolarizedSpectrum(self.flight.albedo(layer) * attenuation),
            mi.UnpolarizedSpectrum(self._majorant - attenuation),
            mi.UnpolarizedSpectrum(attenuation),
        )

    def intersect_aabb(self, ray: mi.Ray3f) -> tuple[mi.Bool, mi.Float, mi.Float]:
        """Return that the water has no bounds of its own: shapes bound it."""
        return mi.Bool(True), mi.Float(0), mi.Float(dr.inf)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose no parameters: changed water is loaded anew."""

    def to_string(self) -> str:
        """Return a description."""
        return (
            f"LayeredWater[{self.column}, refractive_index={self.refractive_index:g}, group_index={self.group_index:g}]"
        )


def _phases_of_layers(
    column: WaterColumn, nested: dict[str, mi.PhaseFunction], kind: str, phase_g: float
) -> list[mi.PhaseFunction]:
    """Return one phase function for each layer, the same object where layers share it."""
    if len(nested) == 1:
        return list(nested.values()) * column.count
    if nested:
        wanted = [f"phase_{layer}" for layer in range(column.count)]
        if sorted(nested) != sorted(wanted):
            raise ValueError(
                f"layered_water: nested phase functions are named {', '.join(sorted(nested))}; "
                f"allowed is one of any name, or one a layer: {', '.join(wanted)}"
            )
        return [nested[name] for name in wanted]
    if kind == "petzold":
        return [mi.load_dict({"type": "petzold"})] * column.count
    if kind == "hg":
        return [mi.load_dict({"type": "hg", "g": phase_g})] * column.count
    made: dict[float, mi.PhaseFunction] = {}
    for ratio in column.backscatter_ratio:
        # Rounded so that layers whose bb/b differ by rounding share a function; without scattering any will do.
        key = round(float(ratio), 12) or 0.0183
        if key not in made:
            made[key] = mi.load_dict({"type": "fournier_forand", "backscatter_ratio": key})
    return [made[round(float(ratio), 12) or 0.0183] for ratio in column.backscatter_ratio]


mi.register_medium("layered_water", lambda props: LayeredWater(props))
