"""Light in other water, and by solids of other reflectance, from the paths of one render."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, finite, in_range
from mitransient_lidar.rendering.derivatives import Parameter, path_parameters
from mitransient_lidar.transport.perturbations import LayerChange, Perturbation
from mitransient_lidar.transport.water_changes import COEFFICIENTS, changed_factors, layer_change

if TYPE_CHECKING:
    import mitsuba as mi

    from mitransient_lidar.transport.passes import PassRenderer

#: Largest number of cases of a render, each of which sums two perturbations.
MOST_CASES = 32

#: Least share of effective paths: below it a few paths carry most of the light.
LEAST_EFFECTIVE = 0.2


@dataclass(frozen=True)
class Case:
    """Other values of parameters: their description, the perturbation of paths, and one of twice its additions."""

    label: str
    perturbation: Perturbation
    squared: Perturbation


def cases(renderer: PassRenderer, given: Sequence[Mapping[str, Any]]) -> list[Case]:
    """Return the cases of other values of parameters, by the names of `derivatives.path_parameters`.

    Raises
    ------
    UserError
        If a name is unknown or stands for several layers, or a value is out of range.
    """
    if len(given) > MOST_CASES:
        raise UserError(f"reweight: {len(given)} cases; allowed are at most {MOST_CASES}")
    return [_case(renderer, dict(values)) for values in given]


def effective_share(energy: FloatArray, reweighted: FloatArray, squared: FloatArray) -> float:
    """Return the share of effective paths of a case, from sums of energies w, of w r and of w r^2 with ratios r.

    That is (sum of w r)^2 / (sum of w times sum of w r^2), 1 for equal ratios (Kong 1992, University of Chicago,
    Dept. of Statistics, technical report 348).
    """
    below = float(np.sum(energy) * np.sum(squared))
    return float(np.sum(reweighted)) ** 2 / below if below > 0 else 0.0


def check_share(label: str, share: float) -> None:
    """Raise UserError if too few paths carry the light of a case."""
    if share < LEAST_EFFECTIVE:
        raise UserError(
            f"reweight: {label} is too far from the rendered scene: a share of {share:.2g} of the paths is effective, "
            f"and at least {LEAST_EFFECTIVE:g} must be; render a scene closer to it"
        )


def _case(renderer: PassRenderer, values: dict[str, Any]) -> Case:
    scene = renderer.scene
    known = {one.name: one for one in path_parameters(renderer, list(values), "reweight")}
    of_case = [name for name, one in known.items() if name.partition("[")[0] in COEFFICIENTS or _solids(one)]
    if other := [name for name in values if name not in of_case]:
        raise UserError(f"reweight: {other[0]} must be a coefficient of one layer, as scattering[0], or a reflectance")
    label = ", ".join(f"{name} = {finite(name, value):g}" for name, value in values.items())
    by_layer: dict[int, dict[str, float]] = {}
    solids = []
    for name, value in values.items():
        stem, _, rest = name.partition("[")
        if stem in COEFFICIENTS:
            by_layer.setdefault(int(rest.rstrip("]") or 0), {})[stem] = float(value)
            continue
        ratio = in_range(name, value, 1e-6, 1.0) / known[name].value
        solids += [(solid, float(np.log(ratio))) for solid in _solids(known[name])]
    layers = tuple(layer_change(scene.required_water, layer, changed) for layer, changed in by_layer.items())
    focusing = renderer.focusing
    factors = None if focusing is None or not by_layer else changed_factors(focusing, scene.required_water, by_layer)
    single = Perturbation(layers, tuple(solids), finite=True, focusing=factors)
    twice = Perturbation(
        tuple(_doubled(layer) for layer in layers),
        tuple((solid, 2 * addition) for solid, addition in solids),
        finite=True,
        focusing=None if focusing is None or factors is None else factors**2 / focusing.factors,
    )
    return Case(label, single, twice)


def _solids(parameter: Parameter) -> list[mi.Shape]:
    """Return the solids whose reflectance a parameter is."""
    return [] if parameter.perturbation is None else [solid for solid, _ in parameter.perturbation.solids]


def _doubled(change: LayerChange) -> LayerChange:
    by_angle = None if change.by_angle is None else 2 * change.by_angle
    return replace(change, per_metre=2 * change.per_metre, per_event=2 * change.per_event, by_angle=by_angle)
