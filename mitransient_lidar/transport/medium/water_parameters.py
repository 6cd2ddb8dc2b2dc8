"""Read the water of a ``layered_water`` from its parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import in_range, number_list, positive
from mitransient_lidar.physics.water.bubbles import CLEAN_BACKSCATTER, STRONGEST_WIND, WindBubbles
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.physics.water.profiles import read_profile
from mitransient_lidar.physics.water.water_types import WATER_KINDS, water_of
from mitransient_lidar.transport.medium.bubble_layer import BubbleLayer
from mitransient_lidar.transport.medium.bubble_plume import BubblePlume
from mitransient_lidar.transport.medium.index_layers import IndexLayers
from mitransient_lidar.transport.medium.water import Water
from mitransient_lidar.transport.medium.water_phases import PHASE_FUNCTIONS, LayerPhases, ScattererPhases, check_phases
from mitransient_lidar.transport.nested_objects import create_object

#: Attenuation, scattering and backscattering [1/m] unless they are given.
_DEFAULTS = {"attenuation": 0.3, "scattering": 0.15, "backscattering": 0.006}

#: Parameters for which an empty text counts as not given.
MAY_BE_EMPTY = (
    *("layer_tops", *_DEFAULTS, "water_scattering", "chi_p", *WATER_KINDS, "profile"),
    *("bubble_void_fraction", "bubble_depth"),
)


def read_water(
    props: mi.Properties,
    nested: dict[str, mi.PhaseFunction],
    bubbles: mi.PhaseFunction | None,
    tabulated: Callable[[PowerLawTable], mi.PhaseFunction],
) -> Water:
    """Return the water of parameters.

    Parameters
    ----------
    props
        Parameters of the plugin ``layered_water``, whose manual page describes them.
    nested
        Phase functions by name, one for all layers or one for each; may be empty.
    bubbles
        Phase function of the bubbles; None for that of ``plume_backscatter_ratio`` or ``bubble_backscatter``.
    tabulated
        Makes a phase function of a table.

    Raises
    ------
    UserError
        When a value is not allowed, or two parameters describe the same.
    """
    check_phases(nested if bubbles is None else {**nested, "plume_phase": bubbles})
    kind = props.get("phase_function", "fournier_forand")
    column, molecules, wavelength = _column(props, bool(nested) or kind != "fournier_forand")
    indices = []
    for name, default, low in (("refractive_index", 1.34, 1.0001), ("group_index", 1.364, 1.0)):
        indices.append(_per_layer(name, props.get(name, default), column.count))
        for value in indices[-1]:
            in_range(name, value, low, 2.0)
    phase_g = in_range("phase_g", props.get("phase_g", 0.924), -0.999, 0.999)
    if kind not in PHASE_FUNCTIONS:
        raise UserError(f"phase_function = {kind!r} must be one of {', '.join(PHASE_FUNCTIONS)}")
    plume, ratio = _bubbles(props)
    if not _is_given(props, "pure") and (nested or kind != "fournier_forand"):
        molecules = np.zeros(1)
    own = ", ".join(map(repr, molecules.tolist()))
    molecules = _per_layer("water_scattering", props.get("water_scattering", own), column.count)
    _check_water_scattering(molecules, column)
    chi_p = _per_layer("chi_p", props["chi_p"], column.count) if "chi_p" in props else None
    for value in () if chi_p is None else chi_p:
        in_range("chi_p", value, 0.1, 10)
    layers = LayerPhases(column, nested, kind, phase_g, molecules, chi_p, tabulated)
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
    )


def _column(props: mi.Properties, is_of_phase: bool) -> tuple[WaterColumn, np.ndarray, float | None]:
    """Return the layers of the parameters, of a water by name, or of a profile, and what belongs to them.

    That is the scattering by molecules [1/m], one value a layer or one for all, 0 where it is not known; and the
    wavelength [nm], None of coefficients as numbers. `is_of_phase` says that backscattering follows from a phase
    function: the parameter then counts up to the scattering.
    """
    tolerance = props.get("profile_tolerance", 0.01)
    wavelength = positive("wavelength_nm", props["wavelength_nm"]) if "wavelength_nm" in props else None
    ways = [name for name in (*WATER_KINDS, "profile") if _is_given(props, name)]
    own = [name for name in ("layer_tops", *_DEFAULTS) if name in props]
    if not ways:
        values = {name: props.get(name, default) for name, default in _DEFAULTS.items()}
        if is_of_phase:
            back = number_list("backscattering", values["backscattering"])
            scattering = number_list("scattering", values["scattering"])
            values["backscattering"] = np.minimum(back, scattering) if 1 in (back.size, scattering.size) else back
        return WaterColumn.from_text(props.get("layer_tops", "0"), **values), np.zeros(1), None
    way = ways[0]
    excluded = [*ways[1:], *(name for name in own if name != "layer_tops" or way == "profile")]
    if excluded:
        raise UserError(f"{way} = {props[way]!r} describes the same as {', '.join(excluded)}: give one of them")
    if way == "profile":
        return read_profile(props[way], wavelength).layers(tolerance), np.zeros(1), wavelength
    tops = number_list("layer_tops", props.get("layer_tops", "0"))
    wavelength = wavelength or props.get("wavelength_nm", 532.0)
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


def _bubbles(props: mi.Properties) -> tuple[BubblePlume | BubbleLayer | None, float]:
    """Return the bubbles, behind a ship or below a windy sea, and their bb/b."""
    plume = BubblePlume.from_properties(props)
    ratio = in_range("plume_backscatter_ratio", props.get("plume_backscatter_ratio", 0.02), 1e-4, 0.4)
    wind = in_range("bubble_wind_speed", props.get("bubble_wind_speed", 0.0), 0.0, STRONGEST_WIND)
    backscatter = in_range("bubble_backscatter", props.get("bubble_backscatter", CLEAN_BACKSCATTER), 100.0, 1445.0)
    bubbles = WindBubbles.of_wind(wind)
    if "bubble_void_fraction" in props:
        fraction = in_range("bubble_void_fraction", props["bubble_void_fraction"], 0.0, 1e-3)
        bubbles = replace(bubbles, void_fraction=fraction)
    if "bubble_depth" in props:
        bubbles = replace(bubbles, depth=in_range("bubble_depth", props["bubble_depth"], 0.05, 20.0))
    if bubbles.void_fraction == 0:
        return plume, ratio
    if plume is not None:
        raise UserError(
            f"plume_scattering = {plume.scattering:g} must be 0 with bubbles of bubble_wind_speed or "
            "bubble_void_fraction: water has one kind of bubbles"
        )
    return BubbleLayer(bubbles.scattering, bubbles.depth), bubbles.backscatter_ratio(backscatter)


def _is_given(props: mi.Properties, name: str) -> bool:
    """Return whether a parameter has a value; ``false`` counts as not given for ``pure``."""
    if name == "pure":
        value = props.get(name, "false")
        if str(value).lower() not in ("true", "false"):
            raise UserError(f"pure = {value!r} must be true or false")
        return str(value).lower() == "true"
    return name in props


def _joined(column: WaterColumn, others: list[np.ndarray]) -> tuple[WaterColumn, np.ndarray]:
    """Return the column with neighbouring layers of equal properties joined, and the first layer of each."""
    rows = np.array([column.attenuation, column.scattering, column.backscattering, *others])
    kept = np.append(0, 1 + np.flatnonzero(np.any(np.diff(rows, axis=1) != 0, axis=0)))
    return WaterColumn(column.layer_tops[kept], *rows[:3, kept]), kept


def _per_layer(name: str, given: float | str, count: int) -> np.ndarray:
    """Return one value a layer of a parameter given for all layers or for each."""
    values = number_list(name, given)
    if values.size not in (1, count):
        raise UserError(f"{name} has {values.size} values but must have 1 or {count}, one a layer")
    return np.broadcast_to(values, count)


def _check_water_scattering(molecules: np.ndarray, column: WaterColumn) -> None:
    """Raise `UserError` unless the scattering by molecules [1/m] is a part of that of each layer."""
    for layer in np.flatnonzero((molecules < 0) | (molecules > column.scattering))[:1]:
        raise UserError(
            f"water_scattering = {molecules[layer]:g} must be at least 0 and at most scattering = "
            f"{column.scattering[layer]:g}, in layer {layer}"
        )
