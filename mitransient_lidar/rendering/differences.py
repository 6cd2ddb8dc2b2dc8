"""Derivatives of waveforms by parameters of a scene: central differences on common random numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.ranges import unit_of
from mitransient_lidar.core.validation import FloatArray, integer, positive
from mitransient_lidar.loading.exclusive import alone
from mitransient_lidar.loading.parameters import parameter_of, value_of, with_value
from mitransient_lidar.loading.scenes import LoadedScene, open_scene
from mitransient_lidar.physics.lidar.gate_train import GateTrain
from mitransient_lidar.physics.lidar.pulse import waveform
from mitransient_lidar.rendering.accuracy import PassStatistics
from mitransient_lidar.rendering.passes import Goal, ProgressCallback, run_passes

if TYPE_CHECKING:
    from mitransient_lidar.transport.passes import LidarIntegrator, PassRenderer

#: Shift of an echo by a step of a depth, over the pulse's full width at half maximum; of the edges of layers, which
#: change the record little, the step is longer by a factor.
_SHIFT_PER_WIDTH, _LAYER_FACTOR = 0.05, 2.0

#: Step of other lengths [m].
_LENGTH_STEP = 0.05

#: Steps of beams and views, and of all others, over the value; and steps where that is 0.
_VIEW_STEP, _RELATIVE_STEP, _STEP_FROM_ZERO = 0.1, 0.01, 0.01

#: Longest step of angles, and step of the mean slope of the sea, by which surface echoes change fast [degree].
_ANGLE_STEP_DEG, _SEA_STEP_DEG = 0.5, 0.2

#: Parameters that choose bins, gates and random numbers instead of what is measured.
_NO_QUANTITIES = ("time_start_ns", "bin_width_ns", "bin_count", "pulses")
_NO_QUANTITY_STARTS, _NO_QUANTITY_ENDS = ("gate_",), ("_seed", "_count")


@dataclass(frozen=True)
class _Side:
    """A scene with a parameter beside its value: renderer, kernel of pulse and response, weights of bins in gates."""

    renderer: PassRenderer
    kernel: tuple[int, FloatArray]
    weights: FloatArray | None = None

    def with_gates(self, train: GateTrain) -> _Side:
        """Return the scene with the weights of its bins in gates."""
        scene = self.renderer.scene
        pulse, response = scene.transmitter.pulse, scene.receiver.optics.response_time_ns
        return replace(self, weights=train.bin_weights(pulse, response, scene.axis))

    def render(self, seed: int, share: float) -> list[FloatArray]:
        """Return energy [J] and power [W] of one pass, shape (pixel, time), and that in gates [J], (pixel, gate)."""
        scene = self.renderer.scene
        fitted = self.renderer if share == 1 else self.renderer.scaled(share)
        energy = fitted.render_pass(seed).histogram.energy().reshape(scene.receiver.pixels.count, -1)
        found = [energy, waveform(energy, scene.axis.bin_width_ns, self.kernel)]
        return found if self.weights is None else [*found, energy @ self.weights]


class Differences:
    """Derivatives of impulse response and waveform by parameters of a scene, from passes that are added one by one.

    Each pass renders the scene with a parameter above and below its value, from the same random numbers, with time
    bins and waves of the unchanged scene: most of the noise cancels in the difference. Cells are wider than in renders
    of waveforms, and go with beam and sea. The session and its scene remain as they are.

    Standard errors are smaller than those from independent random numbers (median over lit bins, default steps), in
    `table1` by factors of 117 (``pulse_fwhm_ns``), 13 (``surface_slope_x_deg``), 7 (``off_nadir_deg``), 3.6
    (``divergence_mrad``) and 3.3 (``field_of_view_mrad``), and in `fig15_2x2` by 8 (``layer_tops[1]``). Light that does
    not reach a bottom or target that moves is the same.

    Parameters
    ----------
    session
        LoadedScene of an XML scene.
    integrator
        Lidar integrator.
    names
        Names of numbers among the parameters of the scene, as for `loading.parameters.value_of`.
    steps
        Distance of the two values from that of the scene, greater than 0, by name; by default `default_step`.
    renderer
        Renderer of the unchanged scene, by default a new one.

    Attributes
    ----------
    names
        Names of the parameters.
    values, steps
        Values and steps of the parameters, in their units, shape (parameter,).

    Raises
    ------
    UserError
        If the scene is not an XML scene, a parameter is unknown, not a number, or one of record, gates or seeds, or a
        step is for another parameter, not positive, or leads to a value that the scene refuses.
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
        if session.record is None or not session.record.is_xml:
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
        self._energy, self._power, self._gates = PassStatistics(), PassStatistics(), PassStatistics()

    def cut(self, train: GateTrain) -> None:
        """Differentiate the energy in gates, too, before the first pass; the gates stay at their times."""
        self._pairs = [(above.with_gates(train), below.with_gates(train)) for above, below in self._pairs]

    def _side(self, name: str, value: float, step: float) -> _Side:
        """Return the scene with a parameter beside its value."""
        model, known = self._model, parameter_of(name)
        params = {known: with_value(model.parameters, name, value + step)[known]}
        try:
            moved = open_scene(model.record, params, model=model.scene)
            renderer = self._integrator.prepare(moved.scene, moved.sensor, layout_of=self._base)
        except UserError as error:
            raise UserError(
                f"the derivative by {name} = {value:g} needs values {abs(step):.3g} below and above, and {error}"
            ) from error
        scene = renderer.scene
        kernel = scene.transmitter.pulse.kernel(scene.axis.bin_width_ns, scene.receiver.optics.response_time_ns)
        return _Side(renderer, kernel)

    def add_pass(self, seed: int, share: float = 1.0) -> None:
        """Render and add one pass of every parameter, with a share of the paths of a full one."""
        slopes = []
        for (above, below), step in zip(self._pairs, self.steps, strict=True):
            sides = zip(*(side.render(seed, share) for side in (above, below)), strict=True)
            slopes.append([(high - low) / (2 * step) for high, low in sides])
        kept = [self._energy, self._power, self._gates][: len(slopes[0])]
        for statistics, one in zip(kept, zip(*slopes, strict=True), strict=True):
            statistics.add(np.array(one))

    @property
    def passes(self) -> int:
        """Number of passes."""
        return self._energy.count

    @property
    def impulse_response(self) -> FloatArray:
        """Derivatives of the energy of bins [J per unit of the parameter], shape (parameter, pixel, time)."""
        return self._energy.mean

    @property
    def impulse_response_stderr(self) -> FloatArray:
        """Their standard errors, without the bias by the step; NaN before the second pass."""
        return self._energy.stderr

    @property
    def waveform(self) -> FloatArray:
        """Derivatives of the received power [W per unit of the parameter], shape (parameter, pixel, time)."""
        return self._power.mean

    @property
    def waveform_stderr(self) -> FloatArray:
        """Their standard errors, without the bias by the step; NaN before the second pass."""
        return self._power.stderr

    @property
    def gates(self) -> FloatArray:
        """Derivatives of the energy in gates [J per unit of the parameter], shape (parameter, pixel, gate)."""
        return self._gates.mean

    @property
    def gates_stderr(self) -> FloatArray:
        """Their standard errors, without the bias by the step; NaN before the second pass."""
        return self._gates.stderr


@alone
def differences(
    session: LoadedScene,
    integrator: LidarIntegrator,
    names: Sequence[str],
    *,
    steps: Mapping[str, float] | None = None,
    passes: int = 32,
    seed: int = 0,
    share: float = 1.0,
    progress: ProgressCallback | None = None,
) -> Differences:
    """Return derivatives from a number of passes (2 to 10^6); other arguments and errors as for `Differences`."""
    found = Differences(session, integrator, names, steps=steps)

    def render_pass(number: int, seed: int) -> float:
        found.add_pass(seed, share)
        return 0.0

    run_passes(render_pass, Goal(passes=integer("passes", passes, 2, 10**6)), seed=seed, progress=progress)
    return found


def default_step(name: str, value: float, renderer: PassRenderer) -> float:
    """Return the step of a parameter for central differences, from measured noise and bias.

    The noise of the derivative falls with the square root of the step or faster, and the bias grows with its square.
    Depths, the altitude and the angle off nadir shift echoes by a twentieth of the pulse's width at half maximum, which
    changes derivatives by 0.5 % of the largest one. Other lengths have steps of 5 cm, beams and views of 10 % of their
    width, other angles of 0.5 degrees, and all others of 1 %. Steps of the mean slope of the sea are 0.2 degrees: at 3
    m/s and 20 degrees off nadir they change the surface echo of Gaussian slopes by 15 %, and derivatives by 0.4 %.
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
    if known.startswith("surface_slope_"):
        return _SEA_STEP_DEG
    fixed = {"m": _LENGTH_STEP, "degree": _ANGLE_STEP_DEG}.get(unit or "")
    relative = _VIEW_STEP if unit == "mrad" else _RELATIVE_STEP
    return fixed or relative * abs(value) or _STEP_FROM_ZERO


def _checked_value(parameters: Mapping[str, str], name: str) -> float:
    """Return the value of a parameter of what is measured."""
    value, known = value_of(parameters, name), parameter_of(name)
    if known in _NO_QUANTITIES or known.startswith(_NO_QUANTITY_STARTS) or known.endswith(_NO_QUANTITY_ENDS):
        raise UserError(
            f"parameter {name} = {value:g} belongs to the record, its gates or its random numbers: there are "
            "derivatives by quantities of lidar, sea, water, bottom and targets"
        )
    return value
