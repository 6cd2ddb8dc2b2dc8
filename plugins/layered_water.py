"""Medium plugin ``layered_water``: horizontally stratified water."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.fields import is_green
from mitransient_lidar.core.parameters.water import COEFFICIENTS, LAYERED_WATER, WATER_KINDS
from mitransient_lidar.core.validation import number_list
from mitransient_lidar.physics.water.bubbles import WindBubbles
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.profiles import read_profile
from mitransient_lidar.physics.water.seawater import VISIBLE_RANGE, WAVELENGTH_RANGE, water_absorption
from mitransient_lidar.physics.water.water_types import default_water, near_infrared_column, water_of
from mitransient_lidar.plugins.bases import DeclaredProperties, closed, register
from mitransient_lidar.plugins.phase import TabulatedPhaseFunction
from mitransient_lidar.transport.medium.bubbles import BubbleLayer, BubblePlume
from mitransient_lidar.transport.medium.water import IndexLayers, Water
from mitransient_lidar.transport.medium.water_phases import LayerPhases, ScattererPhases, check_phases, create_object

logger = logging.getLogger(__name__)

_INDICES = ("refractive_index", "group_index")

#: Coefficients given as numbers raise a warning below this share of the absorption by pure water.
_LEAST_ABSORPTION = 0.8

#: Parameters of a ship's bubble plume, in the order of `BubblePlume`.
_PLUME = tuple(f"plume_{end}" for end in ("scattering", "x", "y", "bearing_deg", "length", "width", "depth"))


@register("medium", LAYERED_WATER)
@closed
class LayeredWater(mi.Medium):
    r"""Water in horizontal layers (``layered_water``).

    .. parameters::

    Give the coefficients, one of the six other water descriptions, or ``profile``; an empty text counts as not given. A
    description holds for all layers, or is a list with one value per layer: ``1C, 5C``. `physics.water.water_types`
    states sources and uncertainties, and ``mitransient-lidar scenes water`` prints the coefficients.

    At a ``wavelength_nm`` above 700, a named or default water absorbs like pure water (14.4 1/m at 1064 nm). Its
    particles scatter in proportion to 1/wavelength. Coefficients given as numbers stay unchanged, with a warning where
    they absorb less than pure water. With ``coefficients_nm`` = 532 they are taken there likewise.

    The first layer includes the wave crests above z = 0, the last one is infinitely deep. With ``petzold``, ``hg`` or a
    nested phase function, bb follows from that function and ``backscattering`` is only checked.

    Bubbles below a windy sea are a mean over time, without the plumes of fresh breakers: the Hall-Novarini model
    (Hall 1989, doi:10.1121/1.398102; Novarini et al. 1998, doi:10.1109/48.725236). Their void fraction is
    :math:`9.3 \cdot 10^{-7}\,(U/10)^3\, e^{-z/L}` for a wind U [m/s], with L = 0.4 m up to 7.5 m/s and :math:`0.4 +
    0.115\,(U-7.5)` above. They scatter by :math:`b = 3\beta/(2r)` with their void fraction :math:`\beta` and effective
    radius r = 37 um, twice the light that meets them. Their Fournier-Forand function has the given backscatter at 180
    degrees. The glory and the bubbles' critical angle are left out. Void fractions measured 2 m down reached
    :math:`10^{-4.5}`, and were much the same in all winds below 16 m/s (Czerski et al. 2022,
    doi:10.5194/os-18-565-2022).

    Layers with different refractive indices refract light, or reflect it totally. Their partial reflection (5e-6
    between fresh and sea water at vertical incidence) is left out. At most 16 such layers are allowed, and they must
    begin below the wave troughs.

    The lidar integrators sample free flights and transmittances through all layers in closed form. Mitsuba's own
    volumetric integrators work as well, with null collisions against the largest attenuation. They use the first
    layer's phase function and index in all layers.

    .. example::

        {'type': 'layered_water', 'layer_tops': '0, 3', 'attenuation': '0.9, 0.5', 'scattering': '0.7, 0.35',
         'backscattering': '0.014, 0.007'}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        phases = {name: child for name, child in props.objects() if isinstance(child, mi.PhaseFunction)}
        bubbles = phases.pop("plume_phase", None)
        if bubbles is not None:
            del props["plume_phase"]
        # Mitsuba's media accept one phase function.
        for name in list(phases)[1:]:
            del props[name]
        #: The water (`mitransient_lidar.transport.medium.water.Water`).
        self.water = _read_water(props, phases, bubbles).moved(props.frame_origin)
        if not phases:
            # For Mitsuba's own integrators, whose default is an isotropic function.
            props["phase_0"] = self.water.phases.phases[0]
        super().__init__(props)
        self.m_is_homogeneous = self.water.column.count == 1 and self.water.plume is None
        self.m_has_spectral_extinction = False

    def get_majorant(self, mei: mi.MediumInteraction3f, active: mi.Bool = True) -> mi.UnpolarizedSpectrum:
        """Return the largest attenuation [1/m], for Mitsuba's own integrators."""
        return mi.UnpolarizedSpectrum(self.water.majorant)

    def get_scattering_coefficients(
        self, mei: mi.MediumInteraction3f, active: mi.Bool = True
    ) -> tuple[mi.UnpolarizedSpectrum, ...]:
        """Return scattering, null and total coefficient [1/m], for Mitsuba's own integrators."""
        attenuation, scattering = self.water.coefficients_at(mei.p)
        coefficients = scattering, self.water.majorant - attenuation, attenuation
        return tuple(mi.UnpolarizedSpectrum(coefficient) for coefficient in coefficients)

    def intersect_aabb(self, ray: mi.Ray3f) -> tuple[mi.Bool, mi.Float, mi.Float]:
        """Return an infinite interval: shapes bound the water."""
        return mi.Bool(True), mi.Float(0), mi.Float(dr.inf)


def _read_water(
    props: DeclaredProperties, nested: dict[str, mi.PhaseFunction], bubbles: mi.PhaseFunction | None
) -> Water:
    """Return the water that parameters describe.

    Raises UserError when a value is not allowed, or two parameters describe one thing.

    `props`: plugin parameters, as the manual page describes them. `nested`: phase functions by name, one for all layers
    or one for each; may be empty. `bubbles`: phase function of the bubbles; None for the one by
    ``plume_backscatter_ratio`` or ``bubble_backscatter``.
    """
    check_phases(nested if bubbles is None else {**nested, "plume_phase": bubbles})
    read = props.read
    kind, phase_g = read("phase_function"), read("phase_g")
    column, molecules, wavelength = _column(props, bool(nested) or kind != "fournier_forand")
    is_given = {name: name in props for name in (*_INDICES, *COEFFICIENTS)}
    is_numbers = any(map(is_given.get, COEFFICIENTS)) or _is_given(props, "profile")
    if wavelength is None and not (is_numbers and all(map(is_given.get, _INDICES))):
        wavelength = 532.0
    indices = [LAYERED_WATER[name].per_layer(_chosen(props, name, wavelength), column.count) for name in _INDICES]
    plume, ratio = _bubbles(props)
    if not _is_given(props, "pure") and (nested or kind != "fournier_forand"):
        molecules = np.zeros(1)
    own = ", ".join(map(repr, molecules.tolist()))
    molecules = LAYERED_WATER["water_scattering"].per_layer(read("water_scattering", own), column.count)
    _check_water_scattering(molecules, column)
    chi_p = LAYERED_WATER["chi_p"].per_layer(props["chi_p"], column.count) if "chi_p" in props else None
    layers = LayerPhases(
        column, nested, kind, phase_g, molecules, chi_p, partial(TabulatedPhaseFunction, mi.Properties())
    )
    of_layers = layers.functions()
    column, kept = _joined(column, [*indices, np.array([id(phase) for phase in of_layers])])
    phases = [of_layers[layer] for layer in kept]
    if plume is not None:
        phases.append(bubbles or create_object("fournier_forand", backscatter_ratio=ratio))
    return Water(
        column,
        layers,
        ScattererPhases(phases),
        IndexLayers(column.layer_tops, *(values[kept] for values in indices)),
        molecules[kept],
        plume,
        _is_given(props, "profile"),
        wavelength,
        any(_is_given(props, name) for name in WATER_KINDS),
    )


def _column(props: DeclaredProperties, is_of_phase: bool) -> tuple[WaterColumn, np.ndarray, float | None]:
    """Return the layers by coefficients, named water or profile, their scattering by molecules and the wavelength.

    The scattering by molecules [1/m] has one value per layer or one for all, 0 where unknown. The wavelength [nm] is
    None where none is given. With `is_of_phase`, backscattering follows from a phase function: the parameter then may
    reach the scattering.
    """
    read = props.read
    tolerance, wavelength, layer_tops = map(read, ("profile_tolerance", "wavelength_nm", "layer_tops"))
    way = next((name for name in (*WATER_KINDS, "profile") if _is_given(props, name)), None)
    at = read("coefficients_nm")
    if wavelength is None or wavelength <= VISIBLE_RANGE[1]:
        at = None
    if way is None:
        values = {name: _chosen(props, name, at or wavelength) for name in COEFFICIENTS}
        if is_of_phase:
            back = number_list("backscattering", values["backscattering"])
            scattering = number_list("scattering", values["scattering"])
            values["backscattering"] = np.minimum(back, scattering) if 1 in (back.size, scattering.size) else back
        column = WaterColumn.from_text(layer_tops, **values)
        column = column if at is None else near_infrared_column(column, wavelength)
        _warn_of_absorption(column, wavelength)
        return column, np.zeros(1), wavelength
    if way == "profile":
        column = read_profile(props[way], at or wavelength).layers(tolerance)
        return column if at is None else near_infrared_column(column, wavelength), np.zeros(1), wavelength
    tops = number_list("layer_tops", layer_tops)
    wavelength = wavelength or read("wavelength_nm", 532.0)
    texts = str(props[way]).replace(",", " ").split()
    if len(texts) not in (1, tops.size):
        raise UserError(f"{way} has {len(texts)} values but must have 1 or {tops.size}, one a layer")
    try:
        found = [water_of(way, None if way == "pure" else text, wavelength) for text in texts]
    except UserError as error:
        raise UserError(f"{way} = {props[way]!r}: {error}") from error
    rows = [[water.attenuation, water.scattering, water.backscattering, water.water_scattering] for water in found]
    *coefficients, molecules = np.transpose(rows)
    return WaterColumn(tops, *np.broadcast_to(coefficients, (3, tops.size))), molecules, wavelength


def _chosen(props: DeclaredProperties, name: str, wavelength: float | None) -> Any:
    """Return a coefficient or index as given, or the default at a wavelength [nm], None for 532 nm."""
    if name in props or is_green(wavelength):
        return props.read(name)
    assert wavelength is not None
    if (default := default_water(wavelength).get(name)) is None:
        known = LAYERED_WATER[name].default
        raise UserError(
            f"wavelength_nm = {wavelength:g} needs {name}, or chlorophyll: the default {known:g} 1/m is that at 532 nm"
        )
    return props.read(name, f"{default:.6g}")


def _warn_of_absorption(column: WaterColumn, wavelength: float | None) -> None:
    """Warn of a water by numbers that absorbs less than pure water at its wavelength [nm], which is not green."""
    if wavelength is None or is_green(wavelength) or not WAVELENGTH_RANGE[0] <= wavelength <= WAVELENGTH_RANGE[1]:
        return
    least, pure = float(column.absorption.min()), float(water_absorption(wavelength))
    if least < _LEAST_ABSORPTION * pure:
        text = "attenuation - scattering = %.3g 1/m is less than pure water absorbs at wavelength_nm = %g, %.3g 1/m: "
        logger.warning(text + "the coefficients are kept as given", least, wavelength, pure)


def _bubbles(props: DeclaredProperties) -> tuple[BubblePlume | BubbleLayer | None, float]:
    """Return the bubbles, behind a ship or below a windy sea, and their bb/b."""
    read = props.read
    scattering, x, y, bearing, *extent = map(read, _PLUME)
    plume = BubblePlume(scattering, x, y, np.deg2rad(bearing), *extent) if scattering > 0 else None
    ratio, backscatter = read("plume_backscatter_ratio"), read("bubble_backscatter")
    bubbles = WindBubbles.of_wind(read("bubble_wind_speed"))
    if (fraction := read("bubble_void_fraction")) is not None:
        bubbles = replace(bubbles, void_fraction=fraction)
    if (depth := read("bubble_depth")) is not None:
        bubbles = replace(bubbles, depth=depth)
    if bubbles.void_fraction == 0:
        return plume, ratio
    if plume is not None:
        raise UserError(
            f"plume_scattering = {plume.scattering:g} must be 0 with bubbles by bubble_wind_speed or "
            "bubble_void_fraction: a water has one kind of bubbles"
        )
    return BubbleLayer(bubbles.scattering, bubbles.depth), bubbles.backscatter_ratio(backscatter)


def _is_given(props: DeclaredProperties, name: str) -> bool:
    """Return whether a parameter has a value; ``false`` counts as not given for ``pure``."""
    if name == "pure":
        value = props.get(name, "false")
        if str(value).lower() not in ("true", "false"):
            raise UserError(f"pure = {value!r} must be true or false")
        return str(value).lower() == "true"
    return name in props


def _joined(column: WaterColumn, others: list[np.ndarray]) -> tuple[WaterColumn, np.ndarray]:
    """Return the column with equal neighbouring layers joined, and the first layer of each."""
    rows = np.array([column.attenuation, column.scattering, column.backscattering, *others])
    kept = np.append(0, 1 + np.flatnonzero(np.any(np.diff(rows, axis=1) != 0, axis=0)))
    return WaterColumn(column.layer_tops[kept], *rows[:3, kept]), kept


def _check_water_scattering(molecules: np.ndarray, column: WaterColumn) -> None:
    """Raise `UserError` unless the scattering by molecules [1/m] is part of each layer's scattering."""
    for layer in np.flatnonzero((molecules < 0) | (molecules > column.scattering))[:1]:
        raise UserError(
            f"water_scattering = {molecules[layer]:g} must be at least 0 and at most scattering = "
            f"{column.scattering[layer]:g}, in layer {layer}"
        )
