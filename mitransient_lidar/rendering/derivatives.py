"""Parameters by which waveforms are differentiated, and central differences on common random numbers."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.catalogue import is_quantity, unit_of
from mitransient_lidar.core.parameters.water import COEFFICIENTS
from mitransient_lidar.core.validation import FloatArray, positive, shown
from mitransient_lidar.loading.parameters import parameter_of, value_of, with_value
from mitransient_lidar.loading.scenes import LoadedScene, open_scene
from mitransient_lidar.physics.lidar.gate_train import GateTrain
from mitransient_lidar.rendering.accuracy import LightStatistics, PassStatistics, received_power
from mitransient_lidar.transport.paths.passes import LidarIntegrator, PassRenderer
from mitransient_lidar.transport.paths.water_changes import coefficient_derivative, mean_cosine_derivative
from mitransient_lidar.transport.perturbations import Perturbation
from mitransient_lidar.transport.plugin_types import SeabedShape, SeaShape
from mitransient_lidar.transport.scene import LidarScene

MOST_PARAMETERS = 64  #: Largest number of parameters in a render.
DIFFERENCES = "central differences"  #: Derivative estimate for parameters without path sums.
DIVERGENCE = "divergence_mrad"  #: Laser divergence.

#: Ripple slope variance, and the relative step of its numerical derivative.
RIPPLES, _RIPPLE_STEP = "ripple_variance", 0.005

_NAME = re.compile(r"(?P<stem>\w+?)(\[(?P<layer>\d+)\])?\Z")
_REFLECTANCE = "_reflectance"


@dataclass(frozen=True)
class Parameter:
    """A scene parameter by which light is differentiated."""

    #: Name, with the layer number in brackets where there are several; value and its unit.
    name: str
    value: float
    units: str
    perturbation: Perturbation | None  #: Path sums for the derivative; None for central differences.

    @property
    def method(self) -> str:
        """How the derivative is estimated."""
        return DIFFERENCES if self.perturbation is None else "score"


def path_parameters(
    renderer: PassRenderer, names: Sequence[str] | str, others: Mapping[str, str] | None = None
) -> list[Parameter]:
    """Return the parameters with some names: a coefficient of layered water gives one parameter per layer.

    `others` are the scene parameters, with their values as text, none by default. Those without path sums are left to
    central differences.

    Raises UserError if a name is unknown or given twice, or the light does not depend on the parameter.
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
    """Return the perturbations for the parameters that have one."""
    return [one.perturbation for one in parameters if one.perturbation is not None]


def known_names(scene: LidarScene) -> list[str]:
    """Return the names among a scene's parameters for which paths sum derivatives."""
    names: list[str] = []
    if scene.water is not None:
        layers = scene.water.layers
        for name in COEFFICIENTS:
            count = layers.column.count
            names += [name] if count == 1 else [f"{name}[{layer}]" for layer in range(count)]
        names += ["phase_g"] if layers.kind == "hg" and not layers.nested else []
    # Both widths of a circular Gaussian beam follow from its divergence.
    beam = scene.transmitter
    is_circular = beam.beam_profile == "gaussian" and not beam.parameters.get("divergence_across_mrad")
    names += [DIVERGENCE] if is_circular else []
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


def _rippled(scene: LidarScene) -> list[SeaShape]:
    """Return a scene's sea surfaces whose ripples have a variance."""
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
    """Return a diffuse solid's reflectance, None for others."""
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


#: Echo shift by a depth step, over the pulse's full width at half maximum; layer edges, which change the record little,
#: have a step longer by a factor.
_SHIFT_PER_WIDTH, _LAYER_FACTOR = 0.05, 2.0

_LENGTH_STEP = 0.05  #: Step for other lengths [m].

#: Steps for beams and views, and for all others, over the value; and steps where that is 0.
_VIEW_STEP, _RELATIVE_STEP, _STEP_FROM_ZERO = 0.1, 0.01, 0.01

#: Longest angle step, and step for the sea's mean slope, by which surface echoes change fast [degree].
_ANGLE_STEP_DEG, _SEA_STEP_DEG = 0.5, 0.2


class _Side:
    """A scene with a parameter beside its value."""

    def __init__(self, renderer: PassRenderer) -> None:
        self._renderer, self._power_of = renderer, received_power(renderer.scene)
        self._weights: FloatArray | None = None

    def cut(self, train: GateTrain) -> None:
        """From this call on, return the energy in gates, too."""
        scene = self._renderer.scene
        self._weights = train.bin_weights(scene.transmitter.pulse, scene.receiver.optics.response_time_ns, scene.axis)

    def render(self, seed: int, share: float) -> list[FloatArray]:
        """Return one pass's energy [J] and power [W], shape (pixel, time), and energy in gates [J], (pixel, gate)."""
        fitted = self._renderer if share == 1 else self._renderer.scaled(share)
        energy = fitted.render_pass(seed).histogram.energy().reshape(fitted.scene.receiver.pixels.count, -1)
        found = [energy, self._power_of(energy)]
        return found if self._weights is None else [*found, energy @ self._weights]


class Differences:
    """Derivatives by scene parameters for impulse response and waveform, from passes that are added one by one.

    Each pass renders the scene with a parameter above and below its value. Both renders share the random numbers, and
    the unchanged scene's time bins and waves. Most noise cancels in the difference. Cells are wider than in renders of
    waveforms, and follow beam and sea. The session and its scene stay unchanged.

    Standard errors are smaller than with independent random numbers (median over lit bins, default steps). In `table1`
    the factors are 117 (``pulse_fwhm_ns``), 13 (``surface_slope_x_deg``), 7 (``off_nadir_deg``), 3.6
    (``divergence_mrad``) and 3.3 (``field_of_view_mrad``), in `fig15_2x2` 8 (``layer_tops[1]``). Light that does not
    reach a moving bottom or target is the same.

    Raises UserError if the scene is not an XML scene; a parameter is unknown, not a number, or belongs to record, gates
    or seeds; or a step is for another parameter, not positive, or leads to a value that the scene refuses.

    Parameters
    ----------
    session
        LoadedScene from an XML scene.
    integrator
        Lidar integrator.
    names
        Numbers' names among the scene parameters, as for `loading.parameters.value_of`.
    steps
        Distance from the scene's value to the two values, greater than 0, by name; by default `default_step`.
    renderer
        Renderer of the unchanged scene, by default a new one.

    Attributes
    ----------
    names
        Parameter names.
    values, steps
        Values and steps of the parameters, in their units, shape (parameter,).
    light
        Derivatives for bin energy [J per parameter unit] and received power [W per unit], shape (parameter, pixel,
        time). Standard errors leave out the bias by the step; NaN before the second pass.
    gates
        Derivatives for the energy in gates [J per parameter unit], shape (parameter, pixel, gate).
    """

    def __init__(
        self,
        session: LoadedScene,
        integrator: LidarIntegrator,
        names: Sequence[str],
        *,
        steps: Mapping[str, float] | None = None,
        renderer: PassRenderer | None = None,
    ) -> None:
        if session.source is None or not session.source.is_xml:
            raise UserError(f"derivatives by {', '.join(names)} need an XML scene, whose parameters can be changed")
        if others := [name for name in steps or {} if name not in names]:
            raise UserError(f"steps: {others[0]!r} is not among the parameters {', '.join(names)}")
        self._integrator, self._model = integrator, session
        self._base = (renderer or integrator.prepare(session.scene, session.sensor)).for_differences()
        self.names = list(names)
        self.values = np.array([_checked_value(session.parameters, name) for name in names])
        self.steps = np.array(
            [
                positive(f"step of {name}", steps[name])
                if steps and name in steps
                else default_step(name, value, self._base)
                for name, value in zip(self.names, self.values.tolist(), strict=True)
            ]
        )
        self._pairs = [
            (self._side(name, value, step), self._side(name, value, -step))
            for name, value, step in zip(self.names, self.values.tolist(), self.steps.tolist(), strict=True)
        ]
        self.light, self.gates = LightStatistics(), PassStatistics()

    def cut(self, train: GateTrain) -> None:
        """Differentiate the energy in gates, too, before the first pass; the gates stay at their times."""
        for side in itertools.chain(*self._pairs):
            side.cut(train)

    def _side(self, name: str, value: float, step: float) -> _Side:
        """Return the scene with a parameter beside its value."""
        model, known = self._model, parameter_of(name)
        params = {known: with_value(model.parameters, name, value + step)[known]}
        try:
            moved = open_scene(model.source, params, model=model.scene)
            renderer = self._integrator.prepare(moved.scene, moved.sensor, layout_of=self._base)
        except UserError as error:
            raise UserError(
                f"the derivative by {name} = {value:g} needs values {abs(step):.3g} below and above, and {error}"
            ) from error
        return _Side(renderer)

    def add_pass(self, seed: int, share: float = 1.0) -> None:
        """Render and add one pass for every parameter, with a share of a full one's paths."""
        slopes = []
        for pair, step in zip(self._pairs, self.steps, strict=True):
            sides = zip(*(side.render(seed, share) for side in pair), strict=True)
            slopes.append([(high - low) / (2 * step) for high, low in sides])
        energy, power, *gates = (np.array(one) for one in zip(*slopes, strict=True))
        self.light.add(energy, power)
        for one in gates:
            self.gates.add(one)


def default_step(name: str, value: float, renderer: PassRenderer) -> float:
    """Return a parameter's step for central differences, from measured noise and bias.

    The derivative's noise falls with the step's square root or faster, and the bias grows with its square. Depths, the
    altitude and the angle off nadir shift echoes by a twentieth of the pulse's width at half maximum. This changes
    derivatives by 0.5 % of the largest one. Steps are 5 cm for other lengths, 10 % of their width for beams and views,
    0.5 degrees for other angles, 1 % for all others. The sea's mean slope has 0.2 degree steps. At 3 m/s and 20 degrees
    off nadir they change the surface echo from Gaussian slopes by 15 %, and derivatives by 0.4 %.
    """
    known, scene = parameter_of(name), renderer.scene
    unit = unit_of(known)
    shift = 0.5 * C0 * 1e-9 * _SHIFT_PER_WIDTH * scene.transmitter.pulse.fwhm_ns
    if known == "off_nadir_deg":
        pose = scene.receiver.pose
        slope = scene.relative(pose).range * np.tan(np.deg2rad(min(abs(value), 80.0)))
        return float(min(np.rad2deg(shift / max(slope, 1e-9)), _ANGLE_STEP_DEG))
    if known == "altitude":
        return float(shift)
    if "depth" in known or known == "layer_tops":
        return float(shift / scene.group_index) * (_LAYER_FACTOR if known == "layer_tops" else 1.0)
    if known.removeprefix("surface_") in ("slope_x_deg", "slope_y_deg"):
        return _SEA_STEP_DEG
    fixed = {"m": _LENGTH_STEP, "degree": _ANGLE_STEP_DEG}.get(unit or "")
    relative = _VIEW_STEP if unit == "mrad" else _RELATIVE_STEP
    return fixed or relative * abs(value) or _STEP_FROM_ZERO


def _checked_value(parameters: Mapping[str, str], name: str) -> float:
    """Return a measured parameter's value."""
    value, known = value_of(parameters, name), parameter_of(name)
    if not is_quantity(known):
        raise UserError(
            f"parameter {name} = {value:g} belongs to the record, its gates or its random numbers: there are "
            "derivatives by quantities of lidar, sea, water, bottom and targets"
        )
    return value
