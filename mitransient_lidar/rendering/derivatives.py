"""Parameters by which waveforms are differentiated."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import TYPE_CHECKING

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.catalogue import unit_of
from mitransient_lidar.core.parameters.water import COEFFICIENTS
from mitransient_lidar.core.validation import shown
from mitransient_lidar.loading.parameters import parameter_of, value_of
from mitransient_lidar.transport.paths.water_changes import coefficient_derivative, mean_cosine_derivative
from mitransient_lidar.transport.perturbations import Perturbation

if TYPE_CHECKING:
    import mitsuba as mi

    from mitransient_lidar.transport.paths.passes import PassRenderer
    from mitransient_lidar.transport.plugin_types import SeaShape, Transmitter
    from mitransient_lidar.transport.scene import LidarScene

#: Largest number of parameters in a render.
MOST_PARAMETERS = 64

#: Derivative estimate for parameters without path sums.
DIFFERENCES = "central differences"

#: Laser divergence.
DIVERGENCE = "divergence_mrad"

#: Ripple slope variance, and the relative step of its numerical derivative.
RIPPLES, _RIPPLE_STEP = "ripple_variance", 0.005

_NAME = re.compile(r"(?P<stem>\w+?)(\[(?P<layer>\d+)\])?\Z")
_REFLECTANCE = "_reflectance"


@dataclass(frozen=True)
class Parameter:
    """A scene parameter by which light is differentiated.

    Attributes
    ----------
    name, value, units
        Name, with the layer number in brackets where there are several; value and its unit.
    perturbation
        Path sums for the derivative; None for central differences.
    """

    name: str
    value: float
    units: str
    perturbation: Perturbation | None

    @property
    def method(self) -> str:
        """How the derivative is estimated."""
        return DIFFERENCES if self.perturbation is None else "score"


def path_parameters(
    renderer: PassRenderer, names: Sequence[str] | str, others: Mapping[str, str] | None = None
) -> list[Parameter]:
    """Return the parameters with some names: a coefficient of layered water gives one parameter per layer.

    `others` are the scene parameters, with their values as text; those without path sums are left to central
    differences; none by default.

    Raises
    ------
    UserError
        If a name is unknown or given twice, or the light does not depend on the parameter.
    """
    if not isinstance(names, (str, Sequence)):
        raise UserError(f"derivatives = {shown(names)} must be names of parameters")
    listed = [names] if isinstance(names, str) else list(names)
    found: list[Parameter] = []
    known = known_names(renderer.scene)
    for name in listed:
        of_paths = isinstance(name, str) and (name in known or name in COEFFICIENTS)
        if others and not of_paths and isinstance(name, str) and parameter_of(name) in others:
            found.append(Parameter(name, value_of(others, name), unit_of(parameter_of(name)) or "1", None))
        else:
            found += _parameters(renderer, name, others or {})
    repeated = [one.name for index, one in enumerate(found) if one.name in [other.name for other in found[:index]]]
    if repeated:
        raise UserError(f"derivatives: {repeated[0]} is given twice")
    if len(found) > MOST_PARAMETERS:
        raise UserError(f"derivatives: {len(found)} parameters; allowed are at most {MOST_PARAMETERS}")
    return found


def perturbations(parameters: Sequence[Parameter]) -> list[Perturbation]:
    """Return the perturbations of the parameters that have one."""
    return [one.perturbation for one in parameters if one.perturbation is not None]


def known_names(scene: LidarScene) -> list[str]:
    """Return the names of a scene's parameters for which paths sum derivatives."""
    names: list[str] = []
    if scene.water is not None:
        layers = scene.water.layers
        for name in COEFFICIENTS:
            count = layers.column.count
            names += [name] if count == 1 else [f"{name}[{layer}]" for layer in range(count)]
        names += ["phase_g"] if layers.kind == "hg" and not layers.nested else []
    names += [DIVERGENCE] if _is_gaussian(scene.transmitter) else []
    names += [RIPPLES] if _rippled(scene) else []
    diffuse = [solid for solid in scene.solids if _uniform_reflectance(solid) is not None]
    return [*names, *(f"{solid.id()}{_REFLECTANCE}" for solid in diffuse)]


def _parameters(renderer: PassRenderer, name: str, others: Mapping[str, str]) -> list[Parameter]:
    """Return the parameters with a name."""
    scene, focusing = renderer.scene, renderer.focusing
    match = _NAME.match(name) if isinstance(name, str) else None
    known = known_names(scene)
    stem = match["stem"] if match else ""
    of_water = scene.water is not None and (stem in COEFFICIENTS or name == "phase_g")
    solid = next((one for one in scene.solids if f"{one.id()}{_REFLECTANCE}" == name), None)
    if match is None or not (of_water or solid is not None or name in known):
        close = get_close_matches(str(name), [*known, *others], 1)
        hint = f"; did you mean {close[0]}?" if close else ""
        more = ", or a number among the scene's parameters" if others else ""
        raise UserError(f"derivatives = {shown(name)} must be one of {', '.join(known)}{more}{hint}")
    if solid is not None:
        return [_reflectance(name, solid)]
    if name == DIVERGENCE and name in known:
        value = 1e3 * scene.transmitter.divergence
        return [Parameter(name, value, "mrad", Perturbation(beam=1 / value))]
    if name == RIPPLES and name in known:
        return [_ripples(scene)]
    water = scene.required_water
    if name == "phase_g":
        return [Parameter(name, water.layers.phase_g, "1", mean_cosine_derivative(water, focusing))]
    column = water.layers.column
    layers = range(column.count) if match["layer"] is None else [int(match["layer"])]
    if layers[-1] >= column.count:
        raise UserError(f"derivatives: {name} must have the number of a layer, 0 to {column.count - 1}")
    return [
        Parameter(
            stem if column.count == 1 else f"{stem}[{layer}]",
            float(getattr(column, stem)[layer]),
            "1/m",
            coefficient_derivative(water, stem, layer, focusing),
        )
        for layer in layers
    ]


def _is_gaussian(transmitter: Transmitter) -> bool:
    """Return whether both widths of a Gaussian beam follow from its divergence."""
    return transmitter.beam_profile == "gaussian" and not transmitter.parameters.get("divergence_across_mrad")


def _rippled(scene: LidarScene) -> list[SeaShape]:
    """Return the sea surfaces of a scene whose ripples have a variance."""
    return [sea for sea in scene.seas if sea.has_ripples and sum(sea.sea.ripple_variance) > 0]


def _ripples(scene: LidarScene) -> Parameter:
    """Return the parameter for the ripple slope variance, along and across the wind in proportion."""
    seas = _rippled(scene)
    if len(seas) > 1:
        raise UserError(f"derivatives: {RIPPLES} must be of one sea; the scene has {len(seas)}")
    value = float(sum(seas[0].sea.ripple_variance))
    below, above = (seas[0].scaled_ripples(scene.refractive_index, 1 + sign * _RIPPLE_STEP) for sign in (-1, 1))
    return Parameter(RIPPLES, value, "1", Perturbation(ripples=(below, above, 2 * _RIPPLE_STEP * value)))


def _reflectance(name: str, solid: mi.Shape) -> Parameter:
    """Return the parameter for a solid's reflectance."""
    value = _uniform_reflectance(solid)
    if value is None:
        raise UserError(f"derivatives: {name} must be of a solid that is diffuse, with one reflectance everywhere")
    if value == 0:
        raise UserError(f"derivatives: {name} = 0 must be greater than 0: the solid returns no light")
    return Parameter(name, value, "1", Perturbation(solids=((solid, 1 / value),)))


def _uniform_reflectance(solid: mi.Shape) -> float | None:
    """Return the reflectance of a diffuse solid, None for others."""
    import mitsuba as mi

    from mitransient_lidar.transport.plugin_types import SeabedShape

    if solid.class_name() == "Instance":
        return None
    kept = mi.traverse(solid.bsdf())
    if isinstance(solid, SeabedShape) and "reflectance.scale" in kept:
        return solid.uniform_reflectance
    names = list(kept.keys())
    # A diffuse BSDF shows its reflectance alone, also within one for two sides.
    if names not in (["reflectance.value"], ["brdf_0.reflectance.value"]):
        return None
    return float(np.array(kept[names[0]]).ravel()[0])
