"""Gate image frames, in which each gate has its own pulses, over a moving sea from a moving platform."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import xarray as xr

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError, is_interruption, raise_if_out_of_memory
from mitransient_lidar.core.interruption import DeferredInterrupt
from mitransient_lidar.core.options import Instrument, Option, SceneOrResult, Sensor, checked, one_of, positive_option
from mitransient_lidar.core.validation import FloatArray, IntArray, require_memory
from mitransient_lidar.loading import variants
from mitransient_lidar.loading.scenes import LoadedScene, choose_integrator, open_scene
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.physics.lidar.gate_train import GateSequence, GateTrain
from mitransient_lidar.rendering.accumulators import placed_gates
from mitransient_lidar.rendering.accuracy import ErrorWindow, PassStatistics
from mitransient_lidar.rendering.describe import describe_scene, with_lines_of_sight
from mitransient_lidar.rendering.passes import (
    DEFAULT_MAX_MEMORY_GB,
    LIGHT,
    Light,
    PassShare,
    Progress,
    ProgressCallback,
    RenderSeed,
    pass_seed,
    warn_of_edge_loss,
)
from mitransient_lidar.rendering.scene_checks import check_scene
from mitransient_lidar.rendering.shots.batches import ShotBatches, ShotPoses
from mitransient_lidar.results.attributes import label
from mitransient_lidar.results.gate_stack import build_gates
from mitransient_lidar.transport.light_maps.renderer import LightMapRenderer
from mitransient_lidar.transport.paths.histogram import GateWeights
from mitransient_lidar.transport.paths.passes import PassRenderer, PathClasses
from mitransient_lidar.transport.scene_parts import find_lidar_scene

_LOG = logging.getLogger(__name__)

#: Memory per pixel in a frame's gate, and per pixel in a pass's gate [bytes].
_BYTES_PER_VALUE, _BYTES_PER_SUM = 40, 36

#: Sums over pixels and gates in one launch, and locations of a moving platform from which the record contains all
#: light.
_SUMS, _PLACES = 2**22, 9


@checked
@alone
def render_frames(
    scene: SceneOrResult,
    params: Mapping[str, Any] | None = None,
    *,
    pulse_rate_hz: Annotated[
        float, Option("Pulses per second, by default 1000", 0, unit="Hz", above=True, flag="--pulse-rate")
    ] = 1000.0,
    frames: Annotated[int, Option("Number of frames, by default 1", 1, 100_000)] = 1,
    gate_order: Annotated[
        str,
        Option("Order of a frame's gates: in_order (the default), random, or interleaved, pulse by pulse"),
    ] = "in_order",
    readout_s: Annotated[
        float,
        Option("Time without pulses after each image, or after each interleaved frame", 0, unit="s", flag="--readout"),
    ] = 0.0,
    speed: Annotated[float, Option("Platform speed", 0, unit="m/s")] = 0.0,
    heading_deg: Annotated[
        float, Option("Platform heading, from +y clockwise to +x", -360, 360, unit="degree", flag="--heading")
    ] = 0.0,
    passes: Annotated[int, Option("Passes of each image, by default 4", 2, 10_000)] = 4,
    pass_share: PassShare = None,
    max_memory: Annotated[float | None, positive_option("Memory for all frames [GB], by default 2")] = None,
    seed: RenderSeed = None,
    light: Light = None,
    integrator: Any = None,
    instrument: Instrument = None,
    sensor: Sensor = None,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Render frames with a scene's gates, each gate with its own pulses.

    Parameters
    ----------
    scene, params, integrator, instrument, sensor
        As for `render.render`; a scene whose film has gates. An image, one gate in one frame, is the sum of its
        ``pulses``.
    gate_order
        As for `GateSequence`; the random order follows from `seed`.
    passes
        Passes per image, 2 to 10 000. Each renders one pulse, at its own time, drawn from its own part of the image's
        pulses (`GateSequence.sampled_pulse`): the mean over them is unbiased. Standard errors come from the passes'
        spread. For images with many pulses they are at most too large: they include the change in the sea.
    light
        As for `render.render`.

    Returns
    -------
    xarray.Dataset
        A gate stack with the dimension ``frame`` first, also for one frame: ``gate_energy`` and ``gate_energy_stderr``
        [J] over (frame, row, column, gate) or (frame, pixel, gate). ``pulse_time`` [s] over (frame, gate) is an image's
        first pulse time after the very first pulse. The very first pulse meets the sea at the scene's time. With a
        `speed`, ``platform_x`` and ``platform_y`` [m] are the displacement at that time. Gates start at fixed times
        after each pulse. After Ctrl-C the completed frames are returned, and the attribute ``interrupted`` is 1.

    Raises
    ------
    UserError
        If the scene is invalid or has no gates, an option is out of range, or the frames exceed the memory.

    Notes
    -----
    Waves and platform move from pulse to pulse, and stand still during one. Wakes and sea height maps stay.
    """
    variants.leave_the_gpu("frames are rendered")
    session = open_scene(scene, params, instrument, sensor=sensor)
    plan = session.sensor.film().gates
    if plan is None:
        raise UserError(f"scene {session.name} has no gates, of which frames consist: give its film a gate_count")
    seed, share, limit = seed or 0, pass_share or 1.0, max_memory or DEFAULT_MAX_MEMORY_GB
    moving: dict[str, Any] = {"pulse_rate_hz": pulse_rate_hz, "gate_order": gate_order, "readout_s": readout_s}
    moving |= {"speed": speed, "heading_deg": heading_deg}
    sequence = GateSequence(plan.train.count, plan.train.pulses, frames, **moving, seed=seed)
    _check_size(sequence, session.sensor.receiver.pixels.count, limit)
    chosen, by_maps = choose_integrator(session.scene, integrator), one_of("light", light or LIGHT[0], LIGHT) == "maps"
    renderer = _prepare(session, chosen, sequence, by_maps)
    lidar = renderer.scene
    session.tell_axis(lidar.axis, lidar.record_end)
    check_scene(renderer.probe)
    window = ErrorWindow.of_probe(renderer.probe)
    described = describe_scene(renderer.probe, window, renderer.focusing)
    train = placed_gates(lidar, described.get("surface_time_ns"), float(window.start_ns.min()))
    assert train is not None
    began = time.perf_counter()
    images = _Images(renderer, sequence, train, passes, share, seed)
    interrupted = images.render(progress)
    done = images.done // sequence.gates
    warn_of_edge_loss(lost := images.lost / (images.lost + images.received) if images.lost > 0 else 0.0)
    attributes = session.attributes(
        lidar,
        chosen,
        renderer.used_values,
        **{**described, **moving, "frames": frames, "seed": seed, "passes": passes, "pass_share": share},
        **{"max_memory_gb": limit, "interrupted": int(interrupted), "surface_edge_loss": lost},
        **({"light": light} if by_maps else {}),
        elapsed_s=time.perf_counter() - began,
    )
    pixels, shape = lidar.receiver.pixels, (done, sequence.gates, lidar.receiver.pixels.count)
    coords: dict[str, Any] = results.pixel_coordinates(pixels.names, 1e3 * pixels.centres(), pixels.grid)
    energy, stderr = (np.moveaxis(each[: images.done].reshape(shape), 1, 2) for each in (images.mean, images.stderr))
    coords["frame"] = np.arange(done)
    stack = build_gates(energy, stderr, train, coords=coords, attributes=results.provenance(attributes))
    times = sequence.times(*np.indices((done, sequence.gates)))
    known = {"pulse_time": times}
    if speed > 0:
        known |= dict(zip(("platform_x", "platform_y"), np.moveaxis(sequence.displacements(times), -1, 0), strict=True))
    stack = label(stack.assign_coords({name: (("frame", "gate"), values) for name, values in known.items()}))
    return with_lines_of_sight(stack, lidar)


def _prepare(session: LoadedScene, integrator: Any, sequence: GateSequence, by_maps: bool) -> PassRenderer:
    """Return the scene's renderer, whose record contains the light at all platform locations."""
    loaded = session.scene, session.sensor
    ends = np.array([sequence.frames - 1]), np.arange(sequence.gates), sequence.pulses - 1
    last = sequence.displacements(sequence.times(*ends).max())
    shifts = [(float(x), float(y)) for x, y in np.linspace(0, 1, _PLACES)[:, None] * last] if last.any() else [(0, 0)]
    axis = find_lidar_scene(*loaded, shifts=shifts).axis
    if by_maps:
        return LightMapRenderer(find_lidar_scene(*loaded, axis=axis), PathClasses(), image=True)
    renderer: PassRenderer = integrator.prepare(*loaded, axis=axis)
    return renderer


def _check_size(sequence: GateSequence, pixels: int, max_memory: float) -> None:
    """Log the memory for all frames; refuse more than `max_memory` [GB], or than the machine's memory."""
    images, sums = sequence.frames * sequence.gates, pixels * sequence.gates
    size = _BYTES_PER_VALUE * pixels * images + _BYTES_PER_SUM * max(sums, min(sums * images, _SUMS))
    what = f"{sequence.frames} frames of {sequence.gates} gates of {pixels} pixels"
    if size > 1e9 * max_memory:
        raise UserError(
            f"max_memory = {max_memory:g} GB is less than {what} take, {1e-9 * size:.3g} GB: allow that much, or take "
            "fewer frames, gates or pixels"
        )
    require_memory(what, size, "take fewer of them")
    _LOG.info("%s take %.2g GB of memory", what, 1e-9 * size)


class _Images:
    """A sequence's images, frame by frame: mean energy and standard error [J], shape (image, pixel)."""

    def __init__(
        self, renderer: PassRenderer, sequence: GateSequence, train: GateTrain, passes: int, share: float, seed: int
    ) -> None:
        lidar = renderer.scene
        self._sequence, self._passes, self._seed = sequence, passes, seed
        pulse, response = lidar.transmitter.pulse, lidar.receiver.optics.response_time_ns
        weights = train.response_weights(pulse, response)
        self._gates: GateWeights = GateWeights(train, weights, lidar.reference_length)
        seas = lidar.seas
        # The middle of the scene's fine waves.
        self._middle = np.array(seas[0].sea.centre if seas else lidar.frame_origin[:2])
        self._time_s = seas[0].time_s if seas else 0.0
        aim = float(self._middle[0]), float(self._middle[1])
        self._batches = ShotBatches(renderer, aim, 1, share, None, None, ())
        self._pixels = lidar.receiver.pixels.count
        self._size = int(np.clip(_SUMS // (self._pixels * sequence.gates), 1, self._batches.size))
        shape = sequence.frames * sequence.gates, self._pixels
        self.mean, self.stderr = np.zeros(shape), np.zeros(shape)
        #: Number of rendered images; energy in all gates, and lost at the surface mesh's edge [J].
        self.done, self.received, self.lost = 0, 0.0, 0.0

    def render(self, progress: ProgressCallback | None) -> bool:
        """Render all images; return whether Ctrl-C has ended them, after the first frame."""
        began, gates = time.perf_counter(), self._sequence.gates
        try:
            with DeferredInterrupt() as interruption:
                while self.done < len(self.mean):
                    # One frame first, then as many images as there are: an interruption keeps about half of the work.
                    size = min(max(gates, self.done), self._size)
                    rows = np.arange(self.done, min(self.done + size, len(self.mean)))
                    found = self._render(rows)
                    self.mean[rows], self.stderr[rows] = found.mean, found.stderr
                    self.done = int(rows[-1]) + 1
                    if progress is not None:
                        elapsed, left = time.perf_counter() - began, len(self.mean) - self.done
                        seconds = elapsed / self.done * left
                        progress(Progress(self.done, len(self.mean), "image", elapsed, seconds))
                    interruption.check()
        except (KeyboardInterrupt, RuntimeError, MemoryError) as error:
            if not is_interruption(error):
                raise_if_out_of_memory(error)
                raise
            if self.done < gates:
                raise KeyboardInterrupt from error
            self.done -= self.done % gates
            return True
        return False

    def _render(self, rows: IntArray) -> PassStatistics:
        """Return some images' energies [J], shape (image, pixel)."""
        frame, gate = np.divmod(rows, self._sequence.gates)
        found, at, before = PassStatistics(), None, np.full(rows.size, np.nan)
        for number in range(self._passes):
            seeds = [pass_seed(pass_seed(self._seed, int(row)), number) for row in rows]
            uniform = np.array([np.random.default_rng(seed).random() for seed in seeds])
            pulse = self._sequence.sampled_pulse(number, self._passes, uniform)
            times_s = self._sequence.times(frame, gate, pulse)
            if at is None or not np.array_equal(times_s, before):
                places = self._middle + self._sequence.displacements(times_s)
                at, before = self._batches.at(ShotPoses(places, times_s=self._time_s + times_s))(1), times_s
            received = at.render_pass(seeds, gates=self._gates)
            energy: FloatArray = received.histogram.energy().reshape(rows.size, self._pixels, -1)
            self.received += float(np.nansum(energy))
            self.lost += received.edge_loss
            found.add(energy[np.arange(rows.size), :, gate])
            if number + 1 < self._passes:
                DeferredInterrupt.check()
        return found
