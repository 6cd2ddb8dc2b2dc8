"""Target signal: difference between a scene with and without it, from the same random numbers."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from typing import Any

import mitsuba as mi
import numpy as np
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.tables.written import table_lines
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.loading.scenes import LoadedScene, choose_integrator, open_scene
from mitransient_lidar.physics.lidar.pulse import waveform
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.rendering.accumulators import PassAccumulator
from mitransient_lidar.rendering.accuracy import ErrorWindow, PassStatistics
from mitransient_lidar.rendering.describe import describe_scene
from mitransient_lidar.rendering.passes import Goal, ProgressCallback, run_passes, warn_of_edge_loss
from mitransient_lidar.results.attributes import described, label
from mitransient_lidar.results.gate_stack import check_train
from mitransient_lidar.studies.cases import Cases
from mitransient_lidar.transport.paths.passes import LidarIntegrator, PassRenderer
from mitransient_lidar.transport.solids import shape_groups

_HALF_GATE = 1.0  #: Half width of the gate about the target's echo, in the pulse's full widths at half maximum.

_GROUPS = 16  #: Jackknife pass groups.


def target_signal(
    session: LoadedScene,
    target_id: str = "target",
    passes: int = 64,
    max_time: float | None = None,
    seed: int = 0,
    integrator: Any = None,
    axis: TimeAxis | None = None,
    progress: ProgressCallback | None = None,
    *,
    is_lit: bool = False,
) -> xr.Dataset:
    """Render a scene with and without a target, and measure their difference.

    Both renders use the same random numbers: paths that do not meet the target are equal, so that the difference has
    much smaller errors than either record. The difference is the target echo, followed by the shadow in the water and
    on the bottom, which is negative.

    `passes`: independent passes per render, at least 16. `axis`: time bins instead of automatic ones. `is_lit`: whether
    a target that returns no light is refused. Others as of `detection.detect`.

    Result: over ``pixel`` and ``time`` [ns]: ``waveform`` (with the target), ``background`` (without) and
    ``difference`` [W]. Over ``pixel``, in a gate of two pulse widths about the peak of the summed difference: ``echo``
    and ``backscatter`` [J] in difference and background, their ratio ``contrast``, ``shadow`` [J] (negative part of the
    difference after the gate), ``detectability`` and the best ``weight``. Over ``combination`` (``sum`` over all
    pixels, ``best``: their weighted sum): ``combined_echo``, ``combined_contrast`` and ``combined_detectability``. All
    with standard errors (for the gates: jackknife over 16 pass groups). Raises `UserError` if the scene or a parameter
    is invalid, there is no such shape, or it is above the sea or below the bottom. With `is_lit`, if the sum of the
    pixels' echoes is not positive: it returns no light, or too little for these passes.

    Where backscatter limits detection, a pixel's noise variance is proportional to the backscatter energy B. With
    echoes E and weights w, the signal-to-noise ratio is proportional to the ``detectability`` sum(w E) / sqrt(sum(w^2
    B)) [sqrt(J)], which is largest for w = E/B (matched filter): sqrt(sum(E^2/B)). Ratios of detectabilities are ratios
    of signal-to-noise ratios for every detector.
    """
    chosen, with_target, without = _pair(session, target_id, integrator, axis)
    lidar = with_target.scene
    pixels, pulse = lidar.receiver.pixels, lidar.transmitter.pulse
    if pixels.grid is not None:
        raise UserError(f"layout = {pixels.layout!r} is an imager: the target's signal needs at most 16 pixels")
    kernel = pulse.kernel(lidar.axis.bin_width_ns, lidar.receiver.optics.response_time_ns)
    pairs: list[tuple[FloatArray, FloatArray]] = []

    def render_pass(number: int, seed: int) -> float:
        records = [renderer.render_pass(seed) for renderer in (with_target, without)]
        pairs.append((records[0].histogram.energy(), records[1].histogram.energy()))
        return records[0].edge_loss

    goal = Goal(passes=passes, max_time=max_time)
    log = run_passes(render_pass, goal, seed=seed, smallest=_GROUPS, progress=progress)
    result = _measure(np.array(pairs), lidar.axis, kernel, pulse.fwhm_ns)
    if is_lit and not result["combined_echo"].sel(combination="sum") > 0:
        raise UserError("target: it returns no light within the record; check its place, and the start of the record")
    warn_of_edge_loss(log.edge_loss_share(float(np.sum(np.array(pairs)[:, 0]))))
    attributes = session.attributes(lidar, chosen, target=target_id, **log.attributes(seed), **result.attrs)
    return result.assign_coords(pixel=list(pixels.names)).assign_attrs(attributes)


def target_map(
    scene: Any,
    params: Mapping[str, Any] | None,
    x: Sequence[float],
    y: Sequence[float],
    *,
    instrument: str | None = None,
    max_time: float | None = None,
    progress: ProgressCallback | None = None,
    **options: Any,
) -> xr.Dataset:
    """Measure a target's signal at offsets [m] from its position in an XML scene, with `options` of `target_signal`.

    The time [s] is shared equally among the remaining positions; each has at least 16 passes. Returns the quantities of
    `target_signal` without time, in addition over ``target_x`` and ``target_y`` [m], and the number of ``place_passes``
    over these alone. Raises `UserError` if the scene lacks the parameters ``target_x`` and ``target_y``, and
    KeyboardInterrupt if a render was interrupted.
    """
    known = open_scene(scene, params, instrument).parameters
    for name in ("target_x", "target_y"):
        if name not in known:
            raise UserError(f"scene {scene!r} has no parameter {name}: the map moves the target by it")
    places = [float(known["target_x"]) + np.asarray(x, float), float(known["target_y"]) + np.asarray(y, float)]
    cells: list[xr.Dataset] = []
    cases = Cases(list(itertools.product(*places)), "places", unit="place", progress=progress)
    end = time.perf_counter() + (max_time or 0)
    for place_x, place_y in cases:
        moved = {**(params or {}), "target_x": place_x, "target_y": place_y}
        if max_time is not None:
            options["max_time"] = max(end - time.perf_counter(), 1e-3) / (1 + cases.left_out)
        cell = cases.keep(target_signal(open_scene(scene, moved, instrument), **options)).drop_dims("time")
        cells.append(cell.assign(place_passes=((), cell.attrs["passes"], described("place_passes"))))
        cases.step()
    rows = [cells[start : start + len(places[1])] for start in range(0, len(cells), len(places[1]))]
    lines = [xr.concat(row, "target_y", combine_attrs="drop_conflicts") for row in rows]
    maps = xr.concat(lines, "target_x", combine_attrs="drop_conflicts")
    return maps.assign_coords(target_x=places[0], target_y=places[1])


def target_gates(
    session: LoadedScene,
    *,
    target_id: str = "target",
    passes: int = 64,
    seed: int = 0,
    integrator: Any = None,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Render a scene's gates with and without a target, on the same random numbers, for any number of pixels.

    Returns a gate stack from the first half of the passes, with the target, and ``gate_light`` [J] over ``kind`` (with,
    without), ``half`` (of the passes), and its dimensions. Raises `UserError` if the scene has no gates, or as for
    `target_signal`.
    """
    chosen, *renderers = _pair(session, target_id, integrator, None)
    lidar = renderers[0].scene
    if lidar.gates is None:
        raise UserError(
            f"scene {session.name} has no gates, which a camera needs: give its film gate_width_ns and gate_start_depth"
        )
    train, window = lidar.gate_train(lidar.gates), ErrorWindow.of_probe(renderers[0].probe)
    check_train(train, {}, lidar.axis)
    halves = [[PassAccumulator(lidar, window, train, kept="direct") for _ in renderers] for _ in range(2)]

    def render_pass(number: int, seed: int) -> float:
        for gates, renderer in zip(halves[number % 2], renderers, strict=True):
            received = renderer.render_pass(seed, gates=gates.gate_weights)
            gates.add(received.histogram)
        return received.edge_loss

    log = run_passes(render_pass, Goal(passes=passes), seed=seed, smallest=_GROUPS, progress=progress)
    warn_of_edge_loss(log.edge_loss_share(sum(one[1].received for one in halves)))
    geometry = describe_scene(renderers[0].probe, window, renderers[0].focusing)
    stack = halves[0][0].dataset(
        session.attributes(lidar, chosen, target=target_id, **log.attributes(seed), **geometry)
    )
    energy = stack["gate_energy"]
    light = [[half[kind].gates.mean.reshape(energy.shape) for half in halves] for kind in (0, 1)]
    return stack.assign(gate_light=(("kind", "half", *energy.dims), np.array(light, np.float32)))


def _pair(
    session: LoadedScene, target_id: str, integrator: Any, axis: TimeAxis | None
) -> tuple[LidarIntegrator, PassRenderer, PassRenderer]:
    """Return the integrator, and renderers with the same layout for the scene with and without the target."""
    bare, chosen = _without(session.scene, target_id), choose_integrator(session.scene, integrator)
    with_target = chosen.prepare(session.scene, session.sensor, connections=False, axis=axis)
    return chosen, with_target, chosen.prepare(bare, session.sensor, layout_of=with_target, connections=False)


def find_target(scene: mi.Scene, target_id: str) -> mi.Shape:
    """Return the target's shape.

    Raises `UserError` if there is no such shape, or it is the sea, or completely above the sea or below the bottom.
    """
    shapes = list(scene.shapes())
    names = [shape.id() for shape in shapes]
    if target_id not in names:
        raise UserError(f"target_id = {target_id!r} must be the id of a shape of the scene: {', '.join(names)}")
    target = shapes[names.index(target_id)]
    if target.is_medium_transition():
        raise UserError(f"target_id = {target_id!r} must not be the sea surface")
    low, high = float(target.bbox().min.z), float(target.bbox().max.z)
    others = [shape for shape in shapes if shape is not target]
    seas = [float(shape.bbox().max.z) for shape in others if shape.is_medium_transition()]
    bottoms = [float(shape.bbox().min.z) for shape in others if not shape.is_medium_transition()]
    if seas and low >= max(seas):
        raise UserError(f"target {target_id!r} lies above the sea, from z = {low:.3g} m: it must lie in the water")
    if bottoms and high <= (bottom := min(bottoms)):
        raise UserError(
            f"target {target_id!r} lies below the bottom, up to z = {high:.3g} m: it must lie above {bottom:.3g} m"
        )
    return target


def _without(scene: mi.Scene, target_id: str) -> mi.Scene:
    """Return a scene without the target, which shares all other objects."""
    shapes, gone = list(scene.shapes()), find_target(scene, target_id)
    parts: dict[str, Any] = {"type": "scene", "integrator": scene.integrator()}
    parts |= {f"sensor_{i}": sensor for i, sensor in enumerate(scene.sensors())}
    parts |= {f"group_{i}": group for i, group in enumerate(shape_groups(scene))}
    parts |= {f"emitter_{i}": emitter for i, emitter in enumerate(scene.emitters())}
    parts |= {f"shape_{i}": shape for i, shape in enumerate(shapes) if shape is not gone}
    return mi.load_dict(parts, parallel=False)


def _quantities(own: FloatArray, backscatter: FloatArray, shadow: FloatArray) -> dict[str, FloatArray]:
    """Return the quantities for pixels and their combinations, from energies of echo, water and shadow [J]."""
    echo = np.maximum(own, 0)
    quality = np.divide(echo, backscatter, out=np.zeros_like(echo), where=backscatter > 0)
    weight = quality / max(float(np.max(quality)), 1e-300)
    combined = [(np.sum(w * own), np.sum(w * backscatter), np.sum(w**2 * backscatter)) for w in (1, weight)]
    return {
        "echo": own,
        "backscatter": backscatter,
        "shadow": shadow,
        "contrast": _ratio(own, backscatter),
        "weight": weight,
        "detectability": _ratio(own, np.sqrt(backscatter)),
        "combined_echo": np.array([e for e, _, _ in combined]),
        "combined_contrast": np.array([_ratio(e, b) for e, b, _ in combined]),
        "combined_detectability": np.array([_ratio(e, np.sqrt(v)) for e, _, v in combined]),
    }


def _ratio(part: Any, total: Any) -> FloatArray:
    return np.asarray(np.divide(part, total, out=np.full(np.shape(part), np.nan), where=np.asarray(total) > 0))


def _measure(records: FloatArray, axis: TimeAxis, kernel: tuple[int, FloatArray], pulse_width: float) -> xr.Dataset:
    """Return the result for energies [J] of shape (passes, 2, pixels, time), with and without the target."""
    time, bin_width = axis.centres_ns, axis.bin_width_ns
    power = waveform(records, bin_width, kernel)
    curves = {"waveform": power[:, 0], "background": power[:, 1], "difference": power[:, 0] - power[:, 1]}
    data: dict[str, Any] = {}
    for name, values in curves.items():
        statistics = PassStatistics()
        for one in values:
            statistics.add(one)
        data[name] = (("pixel", "time"), statistics.mean)
        data[f"{name}_stderr"] = (("pixel", "time"), statistics.stderr)
    summed = data["difference"][1].sum(axis=0)
    peak = float(time[np.argmax(summed)])
    start, end = peak - _HALF_GATE * pulse_width, peak + _HALF_GATE * pulse_width
    gate = (time >= start) & (time <= end)

    def gated(mean_power: FloatArray) -> dict[str, FloatArray]:
        """Return the quantities of mean powers, shape (2, pixels, time)."""
        difference, background = mean_power[0] - mean_power[1], mean_power[1]
        after = np.where(time > end, np.minimum(difference, 0), 0)
        parts = (difference[:, gate], background[:, gate], after)
        return _quantities(*(part.sum(axis=-1) * (bin_width * 1e-9) for part in parts))

    groups = np.array_split(np.arange(len(power)), _GROUPS)
    total = power.sum(axis=0)
    means = gated(total / len(power))
    left_out = [gated((total - power[group].sum(axis=0)) / (len(power) - len(group))) for group in groups]
    for name, value in means.items():
        error = np.sqrt((_GROUPS - 1) * np.mean([(other[name] - value) ** 2 for other in left_out], axis=0))
        dims = "combination" if name.startswith("combined") else "pixel"
        data |= {name: (dims, value), f"{name}_stderr": (dims, error)}
    coords = {"time": time, "combination": ["sum", "best"]}
    attributes = {"gate_start_ns": start, "gate_end_ns": end, "peak_ns": peak}
    return label(xr.Dataset(data, coords=coords, attrs=attributes), "target")


def describe_target(result: xr.Dataset) -> list[str]:
    """Return table lines for a result of `target_signal`: gate, heading, pixels, and pixel combinations.

    The relative SNR is the detectability over the sum's. For a map: shares, contrasts and gain by position.
    """
    if "target_x" in result.dims:
        return _describe_map(result)
    attributes = result.attrs
    sum_echo, sum_snr = (float(result[f"combined_{name}"][0]) for name in ("echo", "detectability"))
    columns = (("pixel", "<12"), ("echo (J)", ">22"), ("of all (%)", ">12.1f"), ("contrast", ">18"))
    rows = []
    parts = [(str(name), result.isel(pixel=i), "") for i, name in enumerate(result["pixel"].values)]
    parts += [(name, result.isel(combination=i), "combined_") for i, name in enumerate(("sum", "best"))]
    for name, one, kind in parts:
        names = [f"{kind}{quantity}" for quantity in ("echo", "contrast", "detectability")]
        echo, contrast, snr = ((float(one[each]), float(one[f"{each}_stderr"])) for each in names)
        share = "" if name == "best" else 100 * echo[0] / sum_echo
        row = (name, f"{echo[0]:.3e} +- {echo[1]:.0e}", share, f"{contrast[0]:.3f} +- {contrast[1]:.3f}")
        weight = "" if kind else float(one["weight"])
        rows.append((*row, weight, f"{snr[0] / sum_snr:.3f} +- {snr[1] / sum_snr:.3f}"))
    return [
        f"target's echo at {attributes['peak_ns']:.1f} ns, gate {attributes['gate_start_ns']:.1f} to "
        f"{attributes['gate_end_ns']:.1f} ns",
        *table_lines((*columns, ("weight", ">8.2f"), ("relative SNR", ">18")), rows),
    ]


def _describe_map(maps: xr.Dataset) -> list[str]:
    names = [str(name) for name in maps["pixel"].values]
    share = 100 * maps["echo"] / maps["combined_echo"].sel(combination="sum")
    snr = maps["combined_detectability"]
    gain = snr.sel(combination="best") / snr.sel(combination="sum")
    columns = [("target_x", ">9.2f"), ("target_y", ">10.2f"), *((f"{name} (%)", ">12.1f") for name in names)]
    columns += [*((f"{name} contrast", ">16.3f") for name in names), ("best SNR/sum", ">16.3f")]
    rows = []
    for x, y in itertools.product(maps["target_x"].values, maps["target_y"].values):
        place = {"target_x": x, "target_y": y}
        rows.append((x, y, *share.sel(place).values, *maps["contrast"].sel(place).values, float(gain.sel(place))))
    return table_lines(columns, rows)
