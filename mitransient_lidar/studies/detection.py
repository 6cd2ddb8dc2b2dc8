"""How well a target is detected, and how well its depth is known: one pixel against several, from simulated shots."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.detection import trials
from mitransient_lidar.analysis.detection.trials import COMBINATIONS, Experiment
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import in_range, integer, non_negative
from mitransient_lidar.physics.receiver.detectors import LinearDetector
from mitransient_lidar.physics.receiver.presets import RECEIVERS, ReceiverChain
from mitransient_lidar.rendering.passes import Progress, ProgressCallback, pass_seed
from mitransient_lidar.rendering.session import Session, choose_integrator, open_scene
from mitransient_lidar.results.geometry import LidarGeometry
from mitransient_lidar.studies.target_signal import find_target, target_signal

_LOG = logging.getLogger(__name__)


def detect(
    scene: Any,
    params: Mapping[str, Any] | None = None,
    *,
    receiver: ReceiverChain | str = "apd",
    pfa: float = 1e-3,
    pd: float = 0.9,
    depths: Sequence[float] = (),
    shots: int = 10_000,
    clutter: int = 0,
    renders: int = 4,
    target_id: str = "target",
    background_power_w: float = 0.0,
    passes: int = 16,
    seed: int = 0,
    integrator: Any = None,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Tell how well a target is detected with one pixel, with the sum and with the best weighting of pixels.

    Parameters
    ----------
    scene, params, target_id, integrator
        As for `target_signal.target_signal`, with at most 16 pixels.
    receiver
        The detector and electronics of every pixel, or its name in `physics.receiver.presets.RECEIVERS`.
    pfa, pd
        Probabilities of false alarm and detection that are wanted, each above 0 and below 1, the first the smaller.
    depths
        Depths of the target to render, too [m], increasing: the parameter ``target_depth`` of the scene.
    shots
        Shots to draw without and with the target, 100 to 100 000; with clutter at least as many, alike for each sea.
    clutter
        Number of seas, by the parameter ``surface_seed``, whose differences are noise to the detector as well: 0 for
        none, or 4 to 1000.
    renders
        Independent renders of the scene where there is no clutter, 3 to 1000; their spread gives the intervals.
    background_power_w
        Steady power on each pixel [W], at least 0.
    passes
        Passes of each render, 16 to 100 000.
    seed
        Seed of the random numbers, at least 0.
    progress
        Called with the renders done and planned.

    Returns
    -------
    xarray.Dataset
        Over ``combination`` (`COMBINATIONS`), with ``_low`` and ``_high`` of 95 % confidence intervals:
        ``needed_target`` and ``needed_energy``, the shares of the target's signal and of the pulse's energy that are
        detected as wanted (infinite where none is), ``gain_target`` and ``gain_energy``, those of ``single`` over
        them; ``area``, ``drawn_detection`` and ``drawn_false_alarm`` (over ``false_alarm``, the thresholds' in closed
        form, too, as ``expected_detection``) of drawn shots with the share ``drawn_share`` (attribute) of the target's
        signal; ``depth_bias`` and ``depth_spread`` [m] of drawn shots of the scene as it is, and ``depth_gain``. With
        `depths`: ``needed_at_depth`` over ``depth``, and ``detectable_depth`` [m] where it is 1.
        Without intervals: ``deflection`` of the scene as it is, ``depth_bound`` [m] (Cramer-Rao, without clutter),
        and over ``pixel`` and ``time`` [ns] ``background`` and ``difference`` [W], means over the renders.

    Raises
    ------
    UserError
        When the scene, a parameter or an option is wrong, the target returns no light, or the receiver does not see it.
    UserError
        When a number is out of range.

    Notes
    -----
    ``single`` is one detector that receives the light of all pixels through the same aperture; ``sum`` adds the signals
    of the pixels' detectors, so that each brings its own electronic noise; ``brightest`` is the detector of the pixel
    with the strongest echo alone; ``best`` weights every sample of every pixel. All know the shape and place of the
    echo, use the samples within 1.5 pulse widths about it, and weight them best (`statistics.Cases.statistic`). A
    search among n pixels has up to n times the false alarms. All detectors are the same; where the echo would be out of
    range, their transimpedance is lowered, for ``single`` by itself. With clutter the weights for each sea come from
    the other seas, and the statistic counts as normally distributed. Intervals are Student's from a jackknife over
    renders or seas, at most 10 groups of them, and exact binomial ones of drawn rates, which are those of the light as
    rendered and of these seas.
    """
    chain = _chain(receiver)
    in_range("pfa", pfa, 1e-12, 0.5)
    in_range("pd", pd, 1.01 * pfa, 1 - 1e-9)
    shots = integer("shots", shots, 100, 100_000)
    if clutter != 0 and not 4 <= clutter <= 1000:
        raise UserError(f"clutter = {clutter} must be 0 or lie between 4 and 1000")
    renders = int(clutter) or integer("renders", renders, 3, 1000)
    seed = integer("seed", seed, 0, 2**53)
    sky = non_negative("background_power_w", background_power_w)
    if list(depths) != sorted(set(depths)) or any(not (math.isfinite(d) and d > 0) for d in depths):
        raise UserError(f"depths = {list(depths)} must be above 0 m and increase")
    if not isinstance(scene, (str, bytes)) and not hasattr(scene, "__fspath__") and (depths or clutter):
        raise UserError("depths and clutter need an XML scene, whose parameters they set")
    session = open_scene(scene, params)
    known = session.parameters
    for option, wanted, key in (("depths", depths, "target_depth"), ("clutter", clutter, "surface_seed")):
        if wanted and key not in known:
            raise UserError(f"scene {session.name} has no parameter {key}, which {option} needs")
    if clutter and known.get("spectrum") == "flat":
        raise UserError("clutter needs waves: spectrum = flat makes every sea the same")
    system = _System.of(session, integrator, chain)
    for depth in depths:
        # Before anything is rendered.
        find_target(open_scene(scene, {**(params or {}), "target_depth": depth}).scene, target_id)
    places: list[float | None] = [None, *depths]
    experiments: list[Experiment] = []
    first: list[xr.Dataset] = []
    for place in places:
        moved = {**(params or {}), **({} if place is None else {"target_depth": place})}
        fixed = session.scene if place is None else open_scene(scene, moved).scene if clutter == 0 else None
        found = []
        for i in range(renders):
            options = {"target_id": target_id, "passes": passes, "integrator": integrator}
            one = pass_seed(seed, i)
            if clutter:
                sea = {**moved, "surface_seed": int(float(known["surface_seed"])) + 1 + i}
                found.append(target_signal(scene, sea, seed=one, **options))
            else:
                found.append(target_signal(fixed, seed=one, **options))
            if progress is not None:
                done = len(experiments) * renders + len(found)
                progress(Progress(done, len(places) * renders, "render"))
        first = first or found
        experiments.append(_experiment(found, bool(clutter), chain, system, sky))
    called = receiver if isinstance(receiver, str) else "custom"
    try:
        data = trials.needs(experiments[0], pfa, pd)
    except ValueError as error:
        raise UserError(
            f"receiver {called} does not see the target, as when the surface echo blinds it: lower the pulse's energy"
        ) from error
    share = float(data["needed_target"][1][-1])
    share = share if math.isfinite(share) else 1.0
    data |= trials.drawn(experiments[0], share, pfa, shots, seed)
    data |= trials.depth_errors(experiments[0], shots, seed, system.pulse_fwhm_ns, system.metres_per_ns)
    if depths:
        data |= trials.by_depth(experiments[1:], list(depths), pfa, pd)
    for key in ("background", "difference"):
        data[key] = xr.concat([one[key] for one in first], "render").mean("render").assign_attrs(units="W")
    attributes = session.attributes(
        target=target_id,
        receiver=called,
        pfa=pfa,
        pd=pd,
        shots=shots if clutter == 0 else -(-shots // clutter) * clutter,
        clutter=int(clutter),
        renders=renders,
        passes=passes,
        seed=seed,
        background_power_w=sky,
        confidence=trials.CONFIDENCE,
        drawn_share=share,
        brightest=str(first[0]["pixel"].values[experiments[0].brightest]),
        pulse_fwhm_ns=system.pulse_fwhm_ns,
    )
    return xr.Dataset(data, coords={"combination": list(COMBINATIONS)}, attrs=attributes)


@dataclass(frozen=True)
class _System:
    """What is known of a scene without rendering it.

    Attributes
    ----------
    pulse_fwhm_ns, bin_width_ns
        Widths of pulse and bins [ns].
    metres_per_ns
        Depth that an echo gains when it comes 1 ns later.
    """

    pulse_fwhm_ns: float
    bin_width_ns: float
    metres_per_ns: float

    @classmethod
    def of(cls, session: Session, integrator: Any, chain: ReceiverChain) -> _System:
        """Read the lidar of a scene; warn of a response that counts twice."""
        lidar = choose_integrator(session.scene, integrator).prepare(session.scene, session.sensor).scene
        if lidar.receiver.optics.response_time_ns > 0 and chain.amplifier is not None:
            _LOG.warning("the scene has a response time, and the amplifier's bandwidth smooths its light again")
        pose = lidar.transmitter.pose
        off_nadir = math.atan2(math.hypot(*(float(part) for part in pose.axis[:2])), -float(pose.axis[2]))
        geometry = LidarGeometry.level(float(pose.origin[2]), off_nadir, lidar.refractive_index, lidar.group_index)
        return cls(lidar.transmitter.pulse.fwhm_ns, lidar.axis.bin_width_ns, geometry.depth_per_ns)


def _chain(receiver: ReceiverChain | str) -> ReceiverChain:
    if isinstance(receiver, ReceiverChain):
        return receiver
    if receiver not in RECEIVERS:
        raise UserError(f"receiver = {receiver!r} must be a ReceiverChain or one of {', '.join(RECEIVERS)}")
    return RECEIVERS[receiver]


def _experiment(
    renders: Sequence[xr.Dataset], seas: bool, chain: ReceiverChain, system: _System, sky: float
) -> Experiment:
    """Return the light of renders about the target's echo, on the receiver."""
    bare, own = (np.stack([one[key].values for one in renders]) for key in ("background", "difference"))
    time, width = renders[0]["time"].values, system.bin_width_ns
    stride = chain.stride(width)
    echo = own.mean(axis=0).sum(axis=0)
    gate = np.abs(time - time[np.argmax(echo)]) <= trials.HALF_GATE * system.pulse_fwhm_ns
    chosen = np.flatnonzero(gate[::stride])
    if len(chosen) < 3 or gate[0] or gate[-1]:
        raise UserError(
            f"the record must hold {trials.HALF_GATE:g} pulse widths about the target's echo at "
            f"{time[np.argmax(echo)]:.1f} ns in 3 or more samples: change time_start_ns, bin_count or bin_width_ns"
        )
    # A linear detector forgets what was before its filter's memory; the search for the echo's time shifts it as far.
    start = 0
    if isinstance(chain.detector, LinearDetector):
        memory = chain.amplifier.kernel(width)[1].size if chain.amplifier is not None else 0
        start = max(0, int(chosen[0]) * stride - memory - math.ceil(system.pulse_fwhm_ns / width)) // stride
    kept = slice(start * stride, None)
    return Experiment(
        np.maximum(bare[..., kept], 0),
        own[..., kept],
        seas,
        chain,
        width,
        sky,
        slice(int(chosen[0]) - start, int(chosen[-1]) - start + 1),
        int(np.argmax(own.mean(axis=0)[:, gate].sum(axis=-1))),
    )


def describe_detection(found: xr.Dataset) -> list[str]:
    """Return lines of tables of what `detect` has found.

    Parameters
    ----------
    found
        What `detect` returned.

    Returns
    -------
    list
        What is needed of the target's signal and of the pulse's energy, with the gains over one pixel; rates of drawn
        shots and errors of the depth; and depths, where these were asked for.
    """
    attributes = found.attrs
    noise = f"noise and {attributes['clutter']} seas" if attributes["clutter"] else "noise"
    lines = [
        f"{attributes['scene']}, receiver {attributes['receiver']}, {noise}; intervals of "
        f"{100 * attributes['confidence']:g} %",
        f"needed for P_d = {attributes['pd']:g} at P_fa = {attributes['pfa']:g}, brightest pixel: "
        f"{attributes['brightest']}",
        f"{'':<11}{'target (%)':>26}{'gain':>24}{'pulse energy (%)':>30}{'gain':>24}",
    ]
    for name in COMBINATIONS:
        one = found.sel(combination=name)
        cells = [
            _interval(one, "needed_target", 26, 100),
            _interval(one, "gain_target", 24),
            _interval(one, "needed_energy", 30, 100),
            _interval(one, "gain_energy", 24),
        ]
        lines.append(f"{name:<11}{''.join(cells)}")
    lines.append(
        f"{attributes['shots']} shots with {100 * attributes['drawn_share']:.3g} % of the target's signal, threshold "
        f"for P_fa = {attributes['pfa']:g}; depth of the whole signal"
    )
    lines.append(f"{'':<11}{'P_fa':>30}{'P_d':>24}{'bias (mm)':>32}{'spread (mm)':>24}{'gain':>24}")
    for name in COMBINATIONS:
        one = found.sel(combination=name)
        rates = one.sel(false_alarm=attributes["pfa"])
        cells = [
            _interval(rates, "drawn_false_alarm", 30),
            _interval(rates, "drawn_detection", 24),
            _interval(one, "depth_bias", 32, 1e3),
            _interval(one, "depth_spread", 24, 1e3),
            _interval(one, "depth_gain", 24),
        ]
        lines.append(f"{name:<11}{''.join(cells)}")
    if "depth" in found.dims:
        heads = "".join(f"{f'{depth:g} m (%)':>12}" for depth in found["depth"].values)
        lines.append(f"needed of the target's signal at depths; detectable depth\n{'':<11}{heads}{'depth (m)':>24}")
        for name in COMBINATIONS:
            one = found.sel(combination=name)
            shares = "".join(f"{100 * float(value):>12.3g}" for value in one["needed_at_depth"].values)
            lines.append(f"{name:<11}{shares}{_interval(one, 'detectable_depth', 24)}")
    return lines


def _interval(one: xr.Dataset, name: str, width: int, scale: float = 1.0) -> str:
    """Return a value with its interval, right-aligned."""
    value, low, high = (scale * float(one[name + end]) for end in ("", "_low", "_high"))
    if not math.isfinite(value):
        return f"{'-':>{width}}"
    text = f"{value:.3g}"
    if low != high:
        text += f" ({low:.3g} .. {high:.3g})"
    return f"{text:>{width}}"
