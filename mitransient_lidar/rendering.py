"""Rendering a lidar scene to an accuracy."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mitransient_lidar import variants
from mitransient_lidar.accuracy import ErrorWindow
from mitransient_lidar.errors import UserError
from mitransient_lidar.interruption import InterruptAfterPass
from mitransient_lidar.loading import load_scene, readable_errors
from mitransient_lidar.recording import recording_of

if TYPE_CHECKING:
    import mitsuba as mi
    import xarray

    from mitransient_lidar.transport.probe import EchoProbe
    from mitransient_lidar.transport.system import LidarScene

logger = logging.getLogger(__name__)

#: Accuracy and longest time when the caller asks for none.
DEFAULT_TARGET_ERROR = 0.03
DEFAULT_MAX_TIME = 300.0

#: Accuracy of gates, for each pixel, and longest time when the caller asks for none; memory [GB].
DEFAULT_GATE_ERROR = 0.1
DEFAULT_GATE_TIME = 60.0
DEFAULT_MAX_MEMORY = 2.0

#: With fewer passes the standard error itself is too uncertain to stop by (8 passes: 27 %).
SMALLEST_PASS_COUNT = 8

#: Share of the energy lost at the border of the surface patch above which a warning is given.
_TOLERATED_LOSS = 1e-3


@dataclass(frozen=True)
class Progress:
    """How far a render has come.

    Attributes
    ----------
    passes_done, passes_planned
        Passes so far, and in all when a number was asked for.
    elapsed_s, remaining_s
        Time since the start and estimate of the time left [s].
    error_median, error_p95
        Median and 95th percentile of the relative standard error of the waveform's bins between surface and bottom, or
        of gates, each with the median over its lit pixels.
    target_error
        The error asked for.
    """

    passes_done: int
    passes_planned: int | None
    elapsed_s: float
    error_median: float | None
    error_p95: float | None
    target_error: float | None
    remaining_s: float | None


@dataclass(frozen=True)
class Goal:
    """When to stop: after a number of passes, at an accuracy, or after a time, whichever comes first."""

    target_error: float | None
    max_time: float | None
    passes: int | None

    @classmethod
    def from_options(
        cls,
        target_error: float | None,
        max_time: float | None,
        passes: int | None,
        gates: bool = False,
    ) -> Goal:
        """Check the options of `render`; without any, aim for 3 % within five minutes, or gates of 10 % in one."""
        for name, value in (("target_error", target_error), ("max_time", max_time)):
            if value is not None and not (np.isfinite(value) and value > 0):
                raise UserError(f"{name} = {value} must be a number greater than 0")
        if passes is not None and passes < 2:
            raise UserError(f"passes = {passes} must be at least 2: their spread gives the standard error")
        if target_error is None and max_time is None and passes is None:
            return (
                cls(DEFAULT_GATE_ERROR, DEFAULT_GATE_TIME, None)
                if gates
                else cls(DEFAULT_TARGET_ERROR, DEFAULT_MAX_TIME, None)
            )
        return cls(target_error, max_time, passes)

    def reached(self, done: int, elapsed: float, error: float | None) -> bool:
        """Return whether to stop after `done` passes."""
        if done < 2:
            return False
        if self.passes is not None and done >= self.passes:
            return True
        if self.max_time is not None and elapsed >= self.max_time:
            return True
        return self.target_error is not None and done >= SMALLEST_PASS_COUNT and (error or np.inf) <= self.target_error

    def remaining(self, done: int, elapsed: float, error: float | None) -> float | None:
        """Estimate the time left [s] from the time so far; errors fall with the square root of the passes."""
        estimates = []
        if self.passes is not None:
            estimates.append(elapsed * (self.passes / done - 1))
        if self.max_time is not None:
            estimates.append(self.max_time - elapsed)
        if self.target_error is not None and error is not None and np.isfinite(error):
            needed = max(done * (error / self.target_error) ** 2, SMALLEST_PASS_COUNT)
            estimates.append(elapsed * (needed / done - 1))
        return max(0.0, min(estimates)) if estimates else None


def render(
    scene: str | Path | Mapping[str, Any] | mi.Scene,
    *,
    params: Mapping[str, Any] | None = None,
    integrator: str | Mapping[str, Any] | mi.Integrator | None = None,
    target_error: float | None = None,
    max_time: float | None = None,
    passes: int | None = None,
    seed: int = 0,
    max_memory: float | None = None,
    variant: str | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> xarray.Dataset:
    """Render a lidar scene in independent passes until it is accurate enough.

    Parameters
    ----------
    scene
        Name of a shipped scene, path of a Mitsuba XML file, dict for ``mitsuba.load_dict``, or a loaded scene.
    params
        Values for the ``<default>`` parameters of an XML scene.
    integrator
        Name or dict of an integrator plugin, or an integrator, instead of the scene's.
    target_error
        Relative standard error, greater than 0: passes end when 95 % of the waveform's bins, of every lit pixel from
        the surface echo to the end of the bottom echo, have reached it (after at least 8 passes). In a scene
        with gates: when 95 % of the gates have, in the median over the pixels that are lit in them.
    max_time
        Longest time for the passes [s], greater than 0.
    passes
        Number of passes, at least 2. Without any of the three the target is 0.03 within 300 s, or 0.1 within
        60 s in a scene with gates.
    seed
        Any integer; the same seed gives the same result on the same machine.
    max_memory
        Memory for histograms, means and errors [GB], greater than 0; 2 by default. When those of a
        scene with gates take more, gates alone are kept, which is told in a warning.
    variant
        ``llvm_ad_mono`` or ``cuda_ad_mono``; by default the active one, or the fastest that works here.
    progress
        Called with a :class:`Progress` after every pass.

    Returns
    -------
    xarray.Dataset
        ``impulse_response`` [J per bin], ``waveform`` [W] (after the pulse and the receiver's response) and their
        standard errors, with dimensions (pixel, time) or (row, column, time); see :mod:`mitransient_lidar.results`.
        With gates in the scene's film also, or instead, ``gate_energy`` [J]; see :mod:`mitransient_lidar.gating`.
        After Ctrl-C it holds the passes done so far, and the attribute ``interrupted`` is 1.

    Raises
    ------
    UserError
        When the scene, a parameter or an option is wrong; the message is one sentence.
    """
    Goal.from_options(target_error, max_time, passes)
    max_memory = DEFAULT_MAX_MEMORY if max_memory is None else max_memory
    if not (np.isfinite(max_memory) and max_memory > 0):
        raise UserError(f"max_memory = {max_memory} must be a number greater than 0")
    variants.set_variant(variant)
    loaded, name, parameters = load_scene(scene, params)
    engine = choose_integrator(loaded, integrator)
    sensor = first_sensor(loaded)
    with readable_errors():
        system, view = engine.prepare(loaded, sensor)
    from mitransient_lidar.transport.probe import probe_echoes

    probe = probe_echoes(system, view)
    window = _error_window(system, probe)
    _check_record(system, probe)
    _check_solids(system, probe)
    seen = probe.surface_ns[:, 1]
    surface_time = float(np.nanmean(seen)) if np.isfinite(seen).any() else None
    recording = recording_of(system, window, surface_time, max_memory)
    goal = Goal.from_options(target_error, max_time, passes, recording.train is not None)
    lost_energy = 0.0
    start = time.perf_counter()
    interrupted = False
    median = p95 = None
    try:
        with InterruptAfterPass() as interruption:
            while not goal.reached(recording.count, time.perf_counter() - start, p95):
                with readable_errors():
                    engine.render(loaded, sensor, seed=pass_seed(seed, recording.count), develop=False)
                recording.add_pass()
                lost_energy += float(np.array(engine.lost).item())
                if recording.count > 1:
                    median, p95 = _percentiles(recording.errors())
                if progress is not None:
                    elapsed = time.perf_counter() - start
                    left = goal.remaining(recording.count, elapsed, p95)
                    progress(Progress(recording.count, goal.passes, elapsed, median, p95, goal.target_error, left))
                if recording.count > 1:
                    interruption.check()
    except KeyboardInterrupt:
        if recording.count < 2:
            raise
        interrupted = True
    finally:
        engine.release()
        system.film.sum_bins()
    elapsed = time.perf_counter() - start
    received = recording.received
    lost = lost_energy / (lost_energy + received) if lost_energy > 0 else 0.0
    _warn_of_losses(system, probe, lost)
    attributes = {
        "scene": name,
        **variants.versions(),
        "integrator": engine.plugin,
        "seed": int(seed),
        "passes": recording.count,
        "elapsed_s": elapsed,
        "interrupted": int(interrupted),
        "error_median": float("nan") if median is None else median,
        "error_p95": float("nan") if p95 is None else p95,
        "lost_at_surface_border": lost,
        "beam_beside_surface": probe.missed_beam,
        **_describe(system, probe, window),
        **{f"scene.{key}": value for key, value in parameters.items()},
    }
    return recording.dataset(attributes)


def choose_integrator(scene: mi.Scene, wanted: Any) -> Any:
    """Return the integrator to use: the caller's choice or the scene's own."""
    import mitsuba as mi

    if wanted is None:
        engine = scene.integrator()
    elif isinstance(wanted, mi.Integrator):
        engine = wanted
    else:
        with readable_errors(loading=True):
            engine = mi.load_dict({"type": wanted} if isinstance(wanted, str) else dict(wanted))
    if not hasattr(engine, "plugin"):
        raise UserError("integrator: the scene has no lidar integrator; add <integrator type='lidar_merging'/>")
    return engine


def first_sensor(scene: mi.Scene) -> mi.Sensor:
    """Return the scene's first sensor."""
    sensors = scene.sensors()
    if not sensors:
        raise UserError("sensor: the scene has none; add a multipixel_receiver or pixel_fov")
    return sensors[0]


def pass_seed(seed: int, number: int) -> int:
    """Return a seed for one pass, unlike that of any other pass of any other seed."""
    sequence = np.random.SeedSequence([int(seed) & 0xFFFFFFFFFFFFFFFF, number])
    return int(sequence.generate_state(1, np.uint64)[0])


def _percentiles(errors: np.ndarray) -> tuple[float | None, float | None]:
    """Return median and 95th percentile, None when no bin counts."""
    if errors.size == 0:
        return None, None
    # 'higher' keeps bins without any light, whose error is infinite, from turning into NaN.
    median, p95 = np.quantile(errors, [0.5, 0.95], method="higher")
    return float(median), float(p95)


def _error_window(system: LidarScene, probe: EchoProbe) -> ErrorWindow:
    """Return the bins from each pixel's surface echo to the end of its bottom echo, the pulse's half width included."""
    film = system.film
    time_ns = film.time_start_ns + film.bin_width_ns * (np.arange(film.bin_count) + 0.5)
    start, end = probe.surface_ns[:, 0], probe.bottom_ns[:, 1] + 0.5 * system.transmitter.pulse.fwhm_ns
    # A pixel that sees no surface (a plate in the air) or no bottom is judged from the record's start or to its end.
    start = np.where(np.isnan(start), time_ns[0], start)
    return ErrorWindow(start, np.where(np.isnan(end), time_ns[-1], end), time_ns)


def _check_record(system: LidarScene, probe: EchoProbe) -> None:
    """Refuse a record that ends before the surface echo; warn of a beam that passes beside the surface."""
    film = system.film
    end = film.time_start_ns + film.bin_width_ns * film.bin_count
    arrivals = probe.surface_ns[:, 0]
    if not np.isfinite(arrivals).any():
        return
    first = float(np.nanmin(arrivals))
    if end <= first:
        raise UserError(
            f"time_start_ns = {film.time_start_ns:g} and bin_count = {film.bin_count} bins of {film.bin_width_ns:g} ns "
            f"end the record at {end:g} ns: it must end after the surface echo, which comes at {first:.1f} ns"
        )


def _check_solids(system: LidarScene, probe: EchoProbe) -> None:
    """Refuse a bottom that rises through the sea where the receiver looks, and a target below the bottom.

    Tell of a target that rises through the sea, or lies above it.
    """
    bottom: Any = max(system.solids, key=lambda solid: float(solid.bbox().max.x - solid.bbox().min.x), default=None)
    highest = max((float(surface.bbox().max.z) for surface in system.surfaces), default=np.inf)
    for solid in system.solids:
        low, high = float(solid.bbox().min.z), float(solid.bbox().max.z)
        if solid is not bottom and high < float(bottom.bbox().min.z):
            raise UserError(
                f"shape {solid.id()!r} lies below the bottom {bottom.id()!r}, up to z = {high:.3g} m: "
                f"it must lie above {float(bottom.bbox().min.z):.3g} m"
            )
        if low > highest:
            logger.warning("shape %r lies above the sea, from z = %.3g m", solid.id(), low)
    for solid, is_bottom in probe.pierced:
        if is_bottom:
            raise UserError(
                f"shape {solid.id()!r} up to z = {solid.bbox().max.z:.3g} m rises through the sea surface where the "
                "receiver looks: a bottom must lie below the waves"
            )
        logger.warning("shape %r rises through the sea surface: part of it is seen in the air", solid.id())


def _warn_of_losses(system: LidarScene, probe: EchoProbe, lost: float) -> None:
    """Warn when the surface patch is smaller than the footprint or than the spread of the light in the water."""
    if not system.surfaces:
        return
    if probe.missed_beam > _TOLERATED_LOSS:
        logger.warning(
            "the surface patch is smaller than the footprint: %.2g %% of the beam in the field of view "
            "passes beside it; enlarge the surface's extent",
            100 * probe.missed_beam,
        )
    if lost > _TOLERATED_LOSS:
        logger.warning(
            "the surface patch is smaller than the spread of the light in the water: about %.2g %% of the received "
            "energy is lost at its border; enlarge the surface's extent",
            100 * lost,
        )


def _describe(system: LidarScene, probe: EchoProbe, window: ErrorWindow) -> dict[str, Any]:
    """Return the attributes of the result that readers and plots need."""
    from mitransient_lidar.layout_plot import describe_layout

    transmitter, receiver = system.transmitter, system.receiver
    axis = transmitter.pose.axis
    described = {
        "layout": receiver.pixels.layout,
        "field_of_view_mrad": 1e3 * receiver.pixels.field_of_view,
        "field_of_view_sides_mrad": [1e3 * side for side in getattr(receiver.pixels, "sides", [])],
        "field_of_view_shape": receiver.pixels.field_of_view_shape,
        "aperture_area": receiver.optics.aperture_area,
        "obscuration": receiver.optics.obscuration,
        "response_time_ns": receiver.optics.response_time_ns,
        "pulse_energy_mj": 1e3 * transmitter.pulse_energy,
        "pulse_fwhm_ns": transmitter.pulse.fwhm_ns,
        "beam_profile": transmitter.beam_profile,
        "divergence_mrad": 1e3 * transmitter.profile.divergence[0],
        "divergence_across_mrad": 1e3 * transmitter.profile.divergence[1],
        "ellipse_deg": float(np.degrees(transmitter.profile.turn)),
        "wavelength_nm": transmitter.wavelength_nm,
        "altitude": float(transmitter.pose.origin[2]),
        "off_nadir_deg": float(np.degrees(np.arccos(np.clip(-axis[2], -1, 1)))),
        "refractive_index": float(system.refractive_index),
        "group_index": float(system.group_index),
        "surface_slope_variance": float(system.slope_variance),
        "window_start_ns": float(window.start_ns.min()),
        "window_end_ns": float(window.end_ns.max()),
        **describe_layout(system),
    }
    # The mean arrival over all pixels is the zero of the depth axis.
    surface = probe.surface_ns[:, 1]
    if np.isfinite(surface).any():
        described["surface_time_ns"] = float(np.nanmean(surface))
    return described
