"""Derivatives by water coefficients and phase functions, as path perturbations."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.water import COEFFICIENTS
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase_table import DEFAULT_COUNT, DEFAULT_LOG_S0, PowerLawTable
from mitransient_lidar.transport.medium.water import Water
from mitransient_lidar.transport.medium.water_phases import LayerPhases
from mitransient_lidar.transport.paths.ripple_focusing import RippleFocusing
from mitransient_lidar.transport.perturbations import LayerChange, Perturbation

#: Relative step for numerical derivatives of phase functions by their parameters; by a mean cosine g it is absolute.
_STEP = 1e-4

_FOCUSING_STEP = 0.02  #: Step for the ripple factors, which are sample means.
_COSINE_SHARE = 0.25  #: Longest step of a mean cosine g over 1 - |g|.
_NEGLIGIBLE = 1e-6  #: Largest derivative of ln p by a logarithmic parameter that counts as none: table rounding.


def coefficient_derivative(water: Water, name: str, layer: int, focusing: RippleFocusing | None = None) -> Perturbation:
    """Return the derivative by a layer's coefficient, with the other coefficients held fixed.

    With lengths L and n scattering events in the layer, a contribution's logarithmic derivative is -L by c. By b it is
    n / b, as absorption falls where scattering grows, and by bb it is 0. To the latter two every scattering event adds
    the phase function's logarithmic derivative, which follows from b and bb. So does the derivative of the ripple
    factors.

    Raises UserError if the light does not depend on the coefficient, or the derivative at its value cannot be
    estimated.
    """
    column = water.layers.column
    top, bottom = _limits(column.layer_tops, layer)
    if name == "attenuation":
        return Perturbation((LayerChange(top, bottom, per_metre=-1.0),))
    b = float(column.scattering[layer])
    label = name if column.count == 1 else f"{name}[{layer}]"
    if b == 0:
        raise UserError(
            f"{label}: the layer has scattering = 0, where no light is scattered by which the derivative could be "
            "estimated; give it a small scattering, such as 1e-4"
        )
    value = float(getattr(column, name)[layer])
    by_angle = _log_derivative(water.layers, layer, name, value)
    by_ripples = _focusing_derivative(focusing, water.layers, layer, name, value)
    if name == "scattering":
        return Perturbation((LayerChange(top, bottom, per_event=1 / b, by_angle=by_angle),), focusing=by_ripples)
    if by_angle is None:
        raise UserError(
            f"{label}: the light does not depend on it, as the phase function does not follow from it; allowed are "
            "fournier_forand functions"
        )
    return Perturbation((LayerChange(top, bottom, by_angle=by_angle),), focusing=by_ripples)


def mean_cosine_derivative(water: Water, focusing: RippleFocusing | None = None) -> Perturbation:
    """Return the derivative by the mean cosine of the function ``hg`` in all layers; raise UserError for others."""
    layers = water.layers
    if layers.kind != "hg" or layers.nested:
        raise UserError("phase_g: the water has no phase function hg, the only one that depends on it")
    count, value = layers.column.count, layers.phase_g
    changes = []
    for layer in range(count):
        top, bottom = _limits(layers.column.layer_tops, layer)
        changes.append(LayerChange(top, bottom, by_angle=_log_derivative(layers, layer, "phase_g", value)))
    if focusing is None:
        return Perturbation(tuple(changes))
    step = min(_FOCUSING_STEP, _COSINE_SHARE * (1 - abs(value)))
    low, high = (
        focusing.factors_of(
            *_changed_water(layers, {layer: {"phase_g": value + sign * step} for layer in range(count)})
        )
        for sign in (-1, 1)
    )
    return Perturbation(tuple(changes), focusing=(high - low) / (2 * step))


def _limits(tops: FloatArray, layer: int) -> tuple[float, float]:
    """Return the depths between which light is in a layer [m]: the first includes wave crests, the last is infinite."""
    top = -np.inf if layer == 0 else float(tops[layer])
    return top, float(tops[layer + 1]) if layer + 1 < len(tops) else np.inf


def _log_derivative(layers: LayerPhases, layer: int, name: str, value: float) -> FloatArray | None:
    """Return ln p's derivative by a parameter at the nodes of `LayerChange`; None where it is 0."""
    scale = 1.0 if name == "phase_g" else abs(value)
    step = min(_STEP, _COSINE_SHARE * (1 - abs(value))) if name == "phase_g" else _STEP * scale
    if step == 0:
        return None
    low, high = (_logarithm(layers.table(layer, **{name: value + sign * step})) for sign in (-1, 1))
    found = np.asarray((high - low) / (2 * step))
    return found if np.abs(found).max() * scale > _NEGLIGIBLE else None


def _changed_water(
    layers: LayerPhases, changed: Mapping[int, Mapping[str, float]]
) -> tuple[WaterColumn, list[PowerLawTable]]:
    """Return layers and their phase functions with other values of some."""
    column = layers.column
    values = {name: np.array(getattr(column, name)) for name in COEFFICIENTS}
    for layer, given in changed.items():
        for name, value in given.items():
            if name in values:
                values[name][layer] = value
    # The factors do not depend on the attenuation, which must not be less than the scattering.
    values["attenuation"] = np.maximum(values["attenuation"], values["scattering"])
    tables = [layers.table(layer, **_of_phase(changed.get(layer, {}))) for layer in range(column.count)]
    return WaterColumn(column.layer_tops, **values), tables


def _of_phase(given: Mapping[str, float]) -> dict[str, float]:
    """Return the values on which phase functions depend."""
    return {name: value for name, value in given.items() if name != "attenuation"}


def _focusing_derivative(
    focusing: RippleFocusing | None, layers: LayerPhases, layer: int, name: str, value: float
) -> FloatArray | None:
    """Return the derivative of the ripple factors by a coefficient; None where there are none."""
    if focusing is None or value == 0:
        return None
    step = _FOCUSING_STEP * value
    low, high = (focusing.factors_of(*_changed_water(layers, {layer: {name: value + sign * step}})) for sign in (-1, 1))
    return np.asarray((high - low) / (2 * step))


def _logarithm(table: PowerLawTable) -> FloatArray:
    """Return a phase function's logarithm at the nodes of `LayerChange`."""
    return np.asarray(np.log(table.eval_s(np.exp(DEFAULT_LOG_S0 * np.linspace(1, 0, DEFAULT_COUNT)))))
