"""Target detection and depth errors with one and with several pixels, from simulated shots."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.detection import images, trials
from mitransient_lidar.analysis.detection.images import ImageTrial
from mitransient_lidar.analysis.detection.trials import COMBINATIONS, Experiment
from mitransient_lidar.analysis.gates.recording import jittered_beside
from mitransient_lidar.analysis.receiver import receiver_of
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import (
    RECEIVERS_OR_CAMERAS,
    BackgroundPower,
    Instrument,
    Numbers,
    Option,
    Scene,
    Seed,
    TargetId,
    checked,
    positive_option,
    refuse_unused,
)
from mitransient_lidar.core.validation import in_range, require_memory, shown
from mitransient_lidar.loading.scenes import choose_integrator, open_scene
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.physics.lidar.level_sea import LidarGeometry
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.receiver.camera import Camera
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.receiver_files import CAMERAS
from mitransient_lidar.rendering.passes import ProgressCallback, render_seed
from mitransient_lidar.results.attributes import label
from mitransient_lidar.studies.cases import Cases
from mitransient_lidar.studies.target_signal import (
    describe_target,
    find_target,
    target_gates,
    target_map,
    target_signal,
)
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.scene_parts import find_lidar_scene

_LOG = logging.getLogger(__name__)

#: Numbers of frames for which the detection is given, and those that are printed.
_FRAMES, _SHOWN_FRAMES = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000), 8

_MOST_ADJOINING = 6  # gates that are tried as one wide gate
_BYTES_PER_GATE = 48  # memory for a pixel's light in a render's gate, with and without the target


@checked
@alone
def detect(
    scene: Scene,
    params: Mapping[str, Any] | None = None,
    *,
    instrument: Instrument = None,
    receiver: Annotated[
        ReceiverChain | Camera | str, Option(f"{RECEIVERS_OR_CAMERAS}. With none: the target's signal alone")
    ] = "apd",
    grid: Annotated[int, Option("Target positions along each axis, to map the signal without a receiver", 1, 15)] = 1,
    max_offset: Annotated[float, positive_option("Largest offset of these positions along each axis", "m")] = 2.0,
    pfa: Annotated[float, Option("False alarm probability", 1e-12, 0.5)] = 1e-3,
    pd: Annotated[
        float, Option("Required probability of detection (above the probability of false alarm, below 1)")
    ] = 0.9,
    depths: Annotated[
        Numbers, Option("Further values of target_depth", 0, unit="m", above=True, ascending=True, form="N,N,...")
    ] = (),
    shots: Annotated[
        int, Option("Number of simulated shots with and without the target, none for a camera", 100, 100_000)
    ] = 10_000,
    clutter: Annotated[
        int, Option("Seas, by surface_seed, whose differences count as noise, at least 4, or 0 for one known", 0, 1000)
    ] = 0,
    renders: Annotated[int, Option("Renders of one sea, whose spread gives the intervals", 3, 1000)] = 4,
    target_id: TargetId = "target",
    background_power_w: BackgroundPower = 0.0,
    frames: Annotated[int, Option("Averaged camera frames per gate, of one sea", 1, 1_000_000)] = 1,
    passes: Annotated[
        int | None, Option("Number of independent passes per render, by default 16, without a receiver 64", 16, 100_000)
    ] = None,
    max_time: Annotated[
        float | None,
        positive_option(
            "Begin no further depth of --depths after this many seconds, and leave it out; the scene's own depth is "
            "always rendered. Without a receiver, stop before them, with fewer passes, at least 16 per position"
        ),
    ] = None,
    seed: Seed = 0,
    integrator: Any = None,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Simulate target detection with one pixel, and with sums and the best weighting of pixels.

    With a camera as the receiver: simulate it in images of the scene's gates, with any number of pixels, also by the
    target's shadow. With ``none``: measure the signal in each pixel alone, or map it (`target_signal.target_signal`).

    Parameters
    ----------
    scene, params, instrument, integrator
        As for `rendering.render.render`, with at most 16 pixels, or gates for a camera.
    shots
        Random shots without and with the target, 100 to 100 000; with clutter rounded up to a multiple of it. A camera
        needs none.

    Returns
    -------
    xarray.Dataset
        Over ``combination`` (`COMBINATIONS`), with ``_low`` and ``_high`` as 95 % confidence limits: ``detection``, the
        probability of detecting the unchanged target at `pfa`, and in closed form over ``pixel`` ``pixel_detection``,
        the same for each pixel alone; ``needed_target`` and ``needed_energy``, the fractions of the target's signal and
        of the pulse energy with the required detection (infinite if there is none), ``gain_target`` and
        ``gain_energy``, the fractions for ``single`` over them; for random shots with the fraction ``drawn_share``
        (attribute) of the target's signal, the ``area`` under the ROC curve, and ``drawn_detection`` and
        ``drawn_false_alarm`` over ``false_alarm``; ``depth_bias`` and ``depth_spread`` [m] in random shots with the
        full signal, and ``depth_gain``. With `depths`: ``needed_at_depth`` over ``depth``, and ``detectable_depth`` [m]
        where it is 1. Without intervals: ``expected_detection`` and ``expected_area`` in closed form, ``deflection`` by
        the full signal, ``depth_bound`` [m] (Cramer-Rao, without clutter), and over ``pixel`` and ``time`` [ns] the
        means of ``background`` and ``difference`` [W] over the renders. Attributes ``gain_pixels`` and ``gain_single``:
        transimpedance factors that keep the echo in range, and ``depths_left_out``: as text the depths without time.

        With a camera: over (row, column, gate) or (pixel, gate) the maps in `images.ImageTrial.maps`; ``detection``
        over ``frames`` (averaged numbers) and ``frames_needed``, and with `depths` ``detection_at_depth`` and
        ``frames_needed_at_depth``, all with limits; ``gate_detection`` and ``gate_deflection`` for a single gate as
        wide as some that adjoin, over ``adjoining`` (their number) and ``gate`` (`images.single_gates`). Digital
        numbers x are filtered as sum(``filter_weight`` (x - ``background``)), which is 1 on average with the target,
        and with `frames` exceeds the attribute ``threshold`` by chance with the probability `pfa`.

        Without a receiver: as from `target_signal.target_signal`, or `target_signal.target_map` with a grid.

    Raises
    ------
    UserError
        If the scene or a parameter is invalid or out of range, the target returns no light, or the receiver does not
        detect it at any level.
    KeyboardInterrupt
        If a render was interrupted.

    Notes
    -----
    ``single`` is one detector that receives the light of all pixels through the same aperture; ``sum`` adds the signals
    of the pixels' detectors, each with its own electronic noise; ``brightest`` is the detector of the pixel with the
    strongest echo; ``best`` weights every sample in every pixel. All use the known echo shape and time, take the
    samples within 1.5 pulse widths of it, and weight them for the best detection (`statistics.Cases.statistic`). A
    search among n pixels has up to n times the false alarms. All detectors are equal; the transimpedance is lowered
    where the echo would saturate it, for ``single`` independently. With clutter, the weights for each sea are estimated
    from the other seas, and the statistic is assumed to be normally distributed. Intervals are Student's from a
    jackknife over at most 10 groups of renders or seas, and exact binomial ones for random shot rates, given the
    rendered light and seas.

    Images: all pixels and gates are weighted by difference over variance, after the covariance of pixels that share an
    intensifier's noise, and of the images of seas. The level without the target, or its mean over the seas, is known.
    Each render is filtered with the weights from the others, so that render errors lower the probability and never
    raise it. The sum has the mean, variance and skewness of rare events (`statistics.Statistic`).
    """
    if isinstance(receiver, str) and receiver == "none":
        unused = {"pfa": pfa, "pd": pd, "depths": depths, "shots": shots, "clutter": clutter, "renders": renders}
        unused |= {"background_power_w": background_power_w, "frames": frames}
        if grid == 1:
            unused["max_offset"] = max_offset
        refuse_unused(detect, "is ignored: receiver = 'none' measures the target's signal alone", **unused)
        given: dict[str, Any] = {"target_id": target_id, "passes": passes or 64, "max_time": max_time, "seed": seed}
        given |= {"integrator": integrator, "progress": progress}
        if grid == 1:
            return target_signal(open_scene(scene, params, instrument), is_lit=True, **given)
        offsets = np.linspace(-max_offset, max_offset, grid).tolist()
        return target_map(scene, params, offsets, offsets, instrument=instrument, **given)
    refuse_unused(detect, "needs receiver = 'none', which maps the target's signal", grid=grid, max_offset=max_offset)
    passes = passes or 16
    device = receiver_of("receiver", receiver)
    camera, chain = (device, None) if isinstance(device, Camera) else (None, device.default.chain)
    if camera is None:
        refuse_unused(detect, f"is of cameras, and receiver = {shown(receiver)} records waveforms", frames=frames)
    else:
        refuse_unused(detect, f"is of waveforms: receiver = {shown(receiver)} is a camera", shots=shots)
    in_range("pd", pd, 1.01 * pfa, 1 - 1e-9)
    if clutter != 0 and not 4 <= clutter <= 1000:
        raise UserError(f"clutter = {clutter} must be 0 or lie between 4 and 1000")
    renders, depths, sky = clutter or renders, list(depths), background_power_w
    if not isinstance(scene, (str, os.PathLike)) and (depths or clutter):
        raise UserError("depths and clutter need an XML scene, whose parameters they set")
    session = open_scene(scene, params, instrument)
    for option, wanted, key in (("depths", depths, "target_depth"), ("clutter", clutter, "surface_seed")):
        if wanted and key not in session.parameters:
            raise UserError(f"scene {session.name} has no parameter {key}, which {option} needs")
    if clutter and session.parameters.get("spectrum") == "flat":
        raise UserError("clutter needs waves: spectrum = flat makes every sea the same")
    lidar = choose_integrator(session.scene, integrator).prepare(session.scene, session.sensor).scene
    lidar.transmitter.pose.require_above_sea()
    if camera is None and (shape := lidar.receiver.pixels.grid) is not None:
        raise UserError(
            f"receiver = {shown(receiver)} records waveforms of at most 16 pixels, and the scene is an image of "
            f"{shape[0]}x{shape[1]}: it needs gates and a camera ({', '.join(CAMERAS)}, or a TOML file)"
        )
    if lidar.receiver.optics.response_time_ns > 0 and chain is not None and chain.amplifier is not None:
        _LOG.warning("the scene has a response time, and the amplifier's bandwidth smooths its light again")
    for depth in depths:  # before the first render
        find_target(open_scene(scene, {**(params or {}), "target_depth": depth}, instrument).scene, target_id)
    experiments: list[Any] = []
    first: list[xr.Dataset] = []
    cases = Cases((None, *depths), "depths", steps=renders, max_time=max_time, progress=progress)
    for place in cases:
        moved = {**(params or {}), **({} if place is None else {"target_depth": place})}
        sea = open_scene(scene, moved, instrument) if place is not None and clutter == 0 else session
        found: list[xr.Dataset] = []
        axis: TimeAxis | None = None
        for i in range(renders):
            if clutter:
                number = int(float(session.parameters["surface_seed"])) + 1 + i
                sea = open_scene(scene, {**moved, "surface_seed": number}, instrument)
                # The records of all seas have the first one's bins.
                axis = axis or find_lidar_scene(sea.scene, sea.sensor).axis
            options: dict[str, Any] = {"target_id": target_id, "passes": passes, "integrator": integrator}
            options["seed"] = render_seed(seed, i)
            if camera is not None:
                one = target_gates(sea, **options)
            else:
                one = target_signal(sea, axis=axis, is_lit=place is None, **options)  # deep ones may be lost
            found.append(cases.keep(one))
            cases.step()
        first = first or found
        build: Any = _image_trial if chain is None else _experiment
        experiments.append(build(found, bool(clutter), camera or chain, lidar, sky))
    left_out = ", ".join(f"{depth:g}" for depth in depths[cases.begun - 1 :])
    depths = depths[: cases.begun - 1]
    called = receiver if isinstance(receiver, str) else "custom"
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
        depths_left_out=left_out,
        pulse_fwhm_ns=lidar.transmitter.pulse.fwhm_ns,
    )
    if camera is not None:
        return _in_images(experiments, first[0], depths, frames, lidar, attributes)
    data = _in_waveforms(experiments, depths, lidar, attributes)
    for key in ("background", "difference"):
        data[key] = xr.concat([one[key] for one in first], "render").mean("render").assign_attrs(units="W")
    attributes["brightest"] = str(first[0]["pixel"].values[experiments[0].brightest])
    return label(xr.Dataset(data, coords={"combination": list(COMBINATIONS)}, attrs=attributes), "detection")


def _in_waveforms(
    experiments: Sequence[Experiment], depths: Sequence[float], lidar: LidarScene, attributes: dict[str, Any]
) -> trials.Variables:
    """Return the variables of a waveform result, and add its attributes."""
    own, pfa, pd, shots, seed = experiments[0], *(attributes[name] for name in ("pfa", "pd", "shots", "seed"))
    try:
        data = trials.needs(own, pfa, pd)
    except ValueError as error:
        raise UserError(
            f"receiver {attributes['receiver']} does not see the target, for example because of the dead time after "
            "the surface echo: reduce the pulse energy"
        ) from error
    data |= trials.detected(own, pfa)
    share = float(data["needed_target"][1][-1])
    share = share if math.isfinite(share) else 1.0
    data |= trials.drawn(own, share, pfa, shots, seed)
    geometry = LidarGeometry.of_pose(lidar.transmitter.pose, lidar.refractive_index, lidar.group_index)
    data |= trials.depth_errors(own, shots, seed, attributes["pulse_fwhm_ns"], geometry.depth_per_ns)
    if depths:
        data |= trials.by_depth(experiments[1:], list(depths), pfa, pd)
    attributes |= {"drawn_share": share, "gain_pixels": own.gain(False), "gain_single": own.gain(True)}
    return data


def _image_trial(
    renders: Sequence[xr.Dataset], seas: bool, camera: Camera, lidar: LidarScene, sky: float
) -> ImageTrial:
    """Return the renders' light in a camera's gates."""
    assert lidar.gates is not None
    shape, size = lidar.gates.train.shape, renders[0]["gate_light"].size
    require_memory(
        f"gates of {len(renders)} renders", _BYTES_PER_GATE * len(renders) * size, "take fewer or smaller ones"
    )
    light, train = np.moveaxis(np.stack([one["gate_light"].values for one in renders]), 1, 0), lidar.gates.train
    jitter = math.hypot(camera.gate_jitter_ns, shape.jitter_ns)
    longest = max(lidar.transmitter.pulse.fwhm_ns, shape.rise_ns, shape.fall_ns)
    mean, slope = jittered_beside(light, jitter, shape.jitter_ns, train.step_ns, longest)
    opened = float(shape.open_time(shape.span_ns[1]))
    return ImageTrial(mean, seas, replace(camera, gate_jitter_ns=jitter), opened, train.pulses, sky, slope)


def _in_images(
    experiments: Sequence[ImageTrial],
    stack: xr.Dataset,
    depths: Sequence[float],
    frames: int,
    lidar: LidarScene,
    attributes: dict[str, Any],
) -> xr.Dataset:
    """Return the result for a camera's gates."""
    pfa, pd, numbers = attributes["pfa"], attributes["pd"], sorted({*_FRAMES, frames})
    experiments = [one.tuned(frames, pfa) for one in experiments]
    trial, dims = experiments[0], stack["gate_energy"].dims
    if not trial.products.products.any():
        raise UserError("target: it changes no light in the gates; check its place, and the start of the gates")
    data: trials.Variables = {name: (dims, values) for name, values in trial.maps(frames).items()}
    data |= images.detected(trial.products, numbers, pfa, pd)
    assert lidar.gates is not None
    train = lidar.gates.train
    apart, most = round(train.width_ns / train.step_ns), 1
    # Edges of adjoining gates add up to 1 where they are alike.
    if math.isclose(apart * train.step_ns, train.width_ns) and train.rise_ns == train.fall_ns and train.profile is None:
        most = min(_MOST_ADJOINING, 1 + (train.count - 1) // apart)
    data |= images.single_gates(trial, range(1, most + 1), apart, frames, pfa)
    for key in ("detection", "frames_needed") if depths else ():
        dims = ("depth", "frames") if key == "detection" else ("depth",)
        found = [images.detected(one.products, numbers, pfa, pd) for one in experiments[1:]]
        for end in ("", "_low", "_high"):
            data[f"{key}_at_depth{end}"] = dims, [one[f"{key}{end}"][1] for one in found]
    data |= {"depth": ("depth", list(depths))} if depths else {}
    built = stack.drop_vars(["gate_energy", "gate_energy_stderr", "gate_light"]).assign(data)
    for name, units in (("background", "count"), ("difference", "count")):
        built[name].attrs["units"] = units
    statistic = trial.products.statistic(frames)
    attributes |= {"frames": frames, "threshold": math.inf if statistic is None else float(statistic.threshold(pfa))}
    return label(built.assign_attrs({**stack.attrs, **attributes}), "detection")


def _experiment(
    renders: Sequence[xr.Dataset], seas: bool, chain: ReceiverChain, lidar: LidarScene, sky: float
) -> Experiment:
    """Return the light of the renders with the samples about the target's echo."""
    bare, own = (np.stack([one[key].values for one in renders]) for key in ("background", "difference"))
    time, width, pulse = renders[0]["time"].values, lidar.axis.bin_width_ns, lidar.transmitter.pulse.fwhm_ns
    stride = chain.stride(width)
    echo = own.mean(axis=0).sum(axis=0)
    gate = np.abs(time - time[np.argmax(echo)]) <= trials.HALF_GATE * pulse
    chosen = np.flatnonzero(gate[::stride])
    if len(chosen) < 3 or gate[0] or gate[-1]:
        raise UserError(
            f"the record must hold {trials.HALF_GATE:g} pulse widths about the target's echo at "
            f"{time[np.argmax(echo)]:.1f} ns in 3 or more samples: change time_start_ns, bin_count or bin_width_ns"
        )
    # Earlier light than the memory of the filter may not matter.
    start = 0
    if chain.forgets_light:
        start = max(0, int(chosen[0]) * stride - chain.low_pass(width).before - math.ceil(pulse / width)) // stride
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


def describe_detected(found: xr.Dataset) -> str:
    """Return a sentence on whether the scene's target is detected, from a result of `detect`."""
    attributes = found.attrs
    best = found.sel(combination="best")
    others = {"one pixel for all light": "single", "the sum of the pixels": "sum"}
    parts = [f"{text} {_rate(float(found['detection'].sel(combination=name)))}" for text, name in others.items()]
    alone = [f"{name} {_rate(float(found['pixel_detection'].sel(pixel=name)))}" for name in found["pixel"].values]
    return (
        f"{_verdict(best, attributes, ' with the best weighting of the pixels')}; {', '.join(parts)}; "
        f"single pixels: {', '.join(alone)}"
    )


def _verdict(one: xr.Dataset, attributes: Mapping[str, Any], how: str) -> str:
    """Return whether the target is detected, from one probability with its interval."""
    value, low, high = (float(one[f"detection{end}"]) for end in ("", "_low", "_high"))
    verdict = "detected" if low >= attributes["pd"] else "not detected" if high < attributes["pd"] else "undecided"
    return (
        f"{verdict}: P_d = {_rate(value)} ({_rate(low)} .. {_rate(high)}){how} at "
        f"P_fa = {attributes['pfa']:g}, P_d = {attributes['pd']:g} is required"
    )


def _noise(attributes: Mapping[str, Any]) -> str:
    """Return what hides the target."""
    return f"noise and {attributes['clutter']} seas" if attributes["clutter"] else "noise"


def _rate(probability: float) -> str:
    """Return a detection probability with three digits."""
    return ">0.999" if probability > 0.999 else f"{probability:.3g}"


def describe_detection(found: xr.Dataset) -> list[str]:
    """Return the lines on a result of `detect`: whether the target is detected, and tables.

    The tables show required levels, random shots, and depths if any.
    """
    if "detection" not in found:
        return describe_target(found)
    if "gate" in found.dims:
        return _describe_images(found)
    attributes = found.attrs
    needed = (("needed_target", 26, 100), ("gain_target", 24), ("needed_energy", 30, 100), ("gain_energy", 24))
    errors = (("depth_bias", 32, 1e3), ("depth_spread", 24, 1e3), ("depth_gain", 24))
    lines = [
        describe_detected(found),
        f"{attributes['scene']}, receiver {attributes['receiver']}, {_noise(attributes)}; intervals of "
        f"{100 * attributes['confidence']:g} %; gain {attributes['gain_pixels']:.3g} of the pixels, "
        f"{attributes['gain_single']:.3g} of one pixel for all light",
        f"needed for P_d = {attributes['pd']:g} at P_fa = {attributes['pfa']:g}, brightest pixel: "
        f"{attributes['brightest']}",
        f"{'':<11}{'target (%)':>26}{'gain':>24}{'pulse energy (%)':>30}{'gain':>24}",
        *_rows(found, *needed),
        f"{attributes['shots']} shots with {100 * attributes['drawn_share']:.3g} % of the target's signal, threshold "
        f"for P_fa = {attributes['pfa']:g}; depth of the full signal",
        f"{'':<11}{'P_fa':>30}{'P_d':>24}{'bias (mm)':>32}{'spread (mm)':>24}{'gain':>24}",
        *_rows(found.sel(false_alarm=attributes["pfa"]), ("drawn_false_alarm", 30), ("drawn_detection", 24), *errors),
    ]
    if "depth" in found.dims:
        heads = "".join(f"{f'{depth:g} m (%)':>12}" for depth in found["depth"].values)
        lines.append(f"needed of the target's signal at depths; detectable depth\n{'':<11}{heads}{'depth (m)':>24}")
        for row in _rows(found, ("detectable_depth", 24)):
            needs = found["needed_at_depth"].sel(combination=row.split()[0]).values
            lines.append(f"{row[:11]}{''.join(f'{100 * float(value):>12.3g}' for value in needs)}{row[11:]}")
    return lines


def _describe_images(found: xr.Dataset) -> list[str]:
    """Return the lines on a result of gates: the verdict, the strongest pixels, the best gates, frames, and depths."""
    attributes, frames = found.attrs, found.attrs["frames"]
    own, pixels = found.sel(frames=frames), [str(found.sizes[dim]) for dim in found["snr"].dims if dim != "gate"]
    each = f"{frames} frame{'s' * (frames > 1)} of each of {found.sizes['gate']} gates"
    lines = [
        f"{_verdict(own, attributes, f' with the best weighting of pixels and gates, {each},')}; frames needed: "
        f"{_interval(found, 'frames_needed', 0)}",
        f"{attributes['scene']}, receiver {attributes['receiver']}, {_noise(attributes)}; intervals of "
        f"{100 * attributes['confidence']:g} %; {'x'.join(pixels)} pixels",
    ]
    ratio = found["contrast_to_noise"]
    for name, places in (("brighter", ratio.argmax(ratio.dims)), ("darker", ratio.argmin(ratio.dims))):
        one = found.isel(places)
        where = ", ".join(f"{dim} {one[dim].item()}" for dim in ratio.dims)
        lines.append(
            f"{name} by the target, most clearly in {where} ({float(one['gate_depth']):.2f} m): contrast "
            f"{float(one['contrast']):.3g}, contrast-to-noise ratio of a frame {float(one['contrast_to_noise']):.3g} "
            f"+- {float(one['contrast_to_noise_stderr']):.1g}"
        )
    lines.append(f"{'best single gate':<18}{'width (ns)':>12}{'from (ns)':>12}{'middle (m)':>12}{'P_d':>9}")
    start, width, depth = (found[f"gate_{name}"].values for name in ("start", "width", "depth"))
    for row, count in enumerate(found["adjoining"].values):
        best = int(np.nanargmax(found["gate_deflection"].values[row]))
        last = best + (count - 1) * round(width[0] / attributes["gate_step_ns"])
        detected = _rate(float(found["gate_detection"].values[row, best]))
        middle = 0.5 * (depth[best] + depth[last])
        lines.append(f"{'':<18}{count * width[0]:>12.3g}{start[best]:>12.1f}{middle:>12.2f}{detected:>9}")
    counts = found["frames"].values[:_SHOWN_FRAMES]
    lines.append(f"{'P_d with frames':<18}{''.join(f'{count:>9}' for count in counts)}{'frames needed':>24}")
    at_depths = found["depth"].values.tolist() if "depth" in found.dims else []
    rows = [(f"{place:g} m", found.sel(depth=place), "_at_depth") for place in at_depths]
    for name, one, end in [("", found, ""), *rows]:
        rates = "".join(f"{_rate(float(one[f'detection{end}'].sel(frames=count))):>9}" for count in counts)
        lines.append(f"{name:<18}{rates}{_interval(one, f'frames_needed{end}', 24)}")
    return lines


def _rows(found: xr.Dataset, *columns: tuple[Any, ...]) -> list[str]:
    """Return a line for each combination; a column is a variable, its width and its factor."""
    combinations = [found.sel(combination=name) for name in COMBINATIONS]
    return [
        f"{name:<11}" + "".join(_interval(one, *column) for column in columns)
        for name, one in zip(COMBINATIONS, combinations, strict=True)
    ]


def _interval(one: xr.Dataset, name: str, width: int, scale: float = 1.0) -> str:
    """Return a value with its interval, right-aligned."""
    value, low, high = (scale * float(one[name + end]) for end in ("", "_low", "_high"))
    if not math.isfinite(value):
        return f"{'-':>{width}}"
    text = f"{value:.3g}"
    if low != high:
        text += f" ({low:.3g} .. {high:.3g})"
    return f"{text:>{width}}"
