"""Renders daylight images, still or animated."""

from __future__ import annotations

import copy
import logging
import os
import time
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
import xarray as xr

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, SceneOrResult, Sensor, checked, positive_option
from mitransient_lidar.core.validation import FloatArray, require_memory, shown
from mitransient_lidar.loading import catalogue
from mitransient_lidar.loading.scene_source import SceneSource
from mitransient_lidar.loading.scenes import choose_integrator, open_scene
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.physics.lidar.clear_sky import background_power
from mitransient_lidar.rendering import passes as engine
from mitransient_lidar.rendering.accuracy import PassStatistics, RatioStatistics, smoothing_bias
from mitransient_lidar.rendering.passes import ProgressCallback
from mitransient_lidar.results.attributes import label, titled
from mitransient_lidar.transport.daylight.renderer import DaylightRenderer, pixel_solid_angles, share_outside_surface
from mitransient_lidar.transport.sensor.pixels import PixelArray

logger = logging.getLogger(__name__)

DEFAULT_GOAL = engine.Goal(target_error=0.05, max_time=120.0)  #: Default end of a frame.
MOST_FRAMES = 10_000  #: Largest number of frames.

#: Memory per pixel in a frame's passes, and per pixel of an image that is kept, and labelled at the end [bytes].
_BYTES_PER_PIXEL, _BYTES_PER_FRAME = 150, 60

_TIMES = ("surface_time", "time")  # names of the sea's time in an XML scene [s]


@checked
@alone
def render_passive(
    scene: SceneOrResult,
    params: Mapping[str, Any] | None = None,
    *,
    sensor: Sensor = None,
    integrator: str | Mapping[str, Any] | None = None,
    target_error: engine.TargetError = None,
    target_quantile: engine.TargetQuantile = None,
    max_time: engine.MaxTime = None,
    passes: Annotated[
        int | Sequence[int] | None,
        Option("Stop after this many passes, by default at the target error", 2, engine.MOST_PASSES),
    ] = None,
    seed: engine.RenderSeed = None,
    frames: Annotated[int, Option("Number of animation frames, by default 1", 1, MOST_FRAMES)] = 1,
    frame_step_s: Annotated[
        float, Option("Time between frames, by default 0.1", 0, unit="s", above=True, flag="--frame-step")
    ] = 0.1,
    filter_width_nm: Annotated[
        float | None, positive_option("Width of the receiver's filter, for the daylight power", "nm")
    ] = None,
    smooth: Annotated[
        float | None,
        Option(
            "Smooth the light that the water scatters towards the receiver by a Gaussian with this standard deviation "
            "[pixels]: less noise, and a bias, which results state",
            *(0.2, 20),
        ),
    ] = None,
    variant: engine.Variant = None,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Render the radiance that the receiver sees by daylight.

    Parameters
    ----------
    scene
        As for `render.render`, with a ``sun``, a ``sky``, or both. A laser in it is ignored.
    integrator
        Name or dict of a passive integrator; by default the scene's, or ``passive_volpath``.
    target_error, target_quantile, max_time, passes
        A frame's end, as for `render.render` with pixels instead of bins; by default 0.05 within 120 s. `passes` may be
        a list with one number per frame.
    seed
        Integer from 0 to 2^53, 0 by default; frames and passes have independent random numbers.
    frame_step_s
        Time between frames [s], greater than 0, added to the parameter ``surface_time`` of an XML scene, or to a dict's
        ``ocean_surface`` parameter ``time``.
    smooth
        Standard deviation of a Gaussian, 0.2 to 20 pixels; none by default. In each pass it smooths the radiance of
        paths that the water has scattered on their way to the receiver. Reflections, and what is seen without
        scattering, stay sharp. The attribute ``smoothing_bias`` estimates the relative change, rms over the pixels.

    Returns
    -------
    xarray.Dataset
        ``radiance`` and ``radiance_stderr`` [W m^-2 sr^-1 nm^-1] over (row, column) or (pixel,). Several frames come
        first, over ``frame`` with its coordinate ``time_s`` [s]. A filter adds ``background_power`` [W], which the
        receiver detects without its laser. ``etendue`` [m^2 sr] is open area times pixel solid angle times the
        transmittance of optics and (one way) air. Power is radiance times etendue times filter width. The attribute
        ``background_radiance`` is the mean over the field of view. After Ctrl-C it includes the frames that were begun,
        and the attribute ``interrupted`` is 1.

    Raises
    ------
    UserError
        If the scene, a parameter or an option is invalid.
    """
    step, width, seed = frame_step_s, filter_width_nm, seed or 0
    counts: list[Any] = list(passes) if isinstance(passes, (list, tuple)) else [passes] * frames
    if len(counts) != frames:
        raise UserError(f"passes = {shown(passes)} must be one number, or {frames}, one a frame")
    goals = [engine.Goal.from_options(target_error, max_time, count, DEFAULT_GOAL, target_quantile) for count in counts]
    rendered: list[int] = []
    biases: list[float] = []
    images: list[tuple[FloatArray, FloatArray]] = []
    start, lost = time.perf_counter(), 0.0
    for frame in range(frames):
        moved = _moved(scene, params, frame * step) if frames > 1 else (scene, params)
        session = open_scene(*moved, variant=variant, sensor=sensor)
        chosen = choose_integrator(session.scene, integrator, passive=True)
        renderer = chosen.prepare(session.scene, session.sensor)
        if frame == 0:
            pixels = renderer.scene.receiver.pixels
            size = (_BYTES_PER_PIXEL + _BYTES_PER_FRAME * frames) * pixels.count
            require_memory(f"{frames} frames of {pixels.count} pixels", size, "take fewer of them")
            if smooth and pixels.grid is None:
                raise UserError(f"smooth = {smooth:g} pixels needs a layout of rows and columns")
            described, first, etendue = _describe(renderer), session, _etendue(renderer)
        try:
            statistics, log, share, bias = _render_frame(
                renderer, goals[frame], engine.pass_seed(seed, frame), progress, smooth
            )
        except KeyboardInterrupt:
            if not images:
                raise
            interrupted = True
            break
        images.append((statistics.ratio, statistics.stderr))
        rendered.append(log.count)
        biases.append(bias)
        if statistics.invalid:
            logger.warning("%d of %d pixels have non-finite radiance", statistics.invalid, len(statistics.ratio))
        last, lost, interrupted = log, max(lost, share), log.interrupted
        if interrupted:
            break
    engine.warn_of_edge_loss(lost)
    attributes = first.attributes(
        integrator=chosen,
        **{**last.attributes(seed), "interrupted": int(interrupted)},
        **described,
        elapsed_s=time.perf_counter() - start,
        error_median=last.error_median,
        error_p95=last.error_p95,
        surface_edge_loss=lost,
        frame_passes=rendered,
        frame_step_s=step,
    )
    if smooth:
        attributes |= {"smooth_pixels": smooth, "smoothing_bias": max(biases)}
    times = step * np.arange(len(images), dtype=np.float64) if frames > 1 else None
    return _labelled(images, times, pixels, etendue, width, attributes)


def _labelled(
    images: Sequence[tuple[FloatArray, FloatArray]],
    times: FloatArray | None,
    pixels: PixelArray,
    etendue: FloatArray,
    filter_width_nm: float | None,
    attributes: Mapping[str, Any],
) -> xr.Dataset:
    """Return radiances and their errors, shape (pixels,), at frame times [s], as a dataset."""
    coords = results.pixel_coordinates(pixels.names, 1e3 * pixels.centres(), pixels.grid)
    inner, shape = coords["angle_x"][0], coords["angle_x"][1].shape
    dims, counts = (inner, shape) if times is None else (("frame", *inner), (len(images), *shape))
    if times is not None:
        coords |= {"frame": np.arange(len(times)), "time_s": ("frame", times)}
    radiance, stderr = (np.reshape([image[i] for image in images], counts) for i in (0, 1))
    area = etendue.reshape(shape)
    variables: dict[str, Any] = {
        "radiance": (dims, radiance),
        "radiance_stderr": (dims, stderr),
        "etendue": (inner, area),
    }
    weight, known = np.where(np.isfinite(radiance), area, 0), np.nan_to_num(radiance)
    attributes = {**attributes, "background_radiance": float(np.sum(known * weight) / np.sum(weight))}
    if filter_width_nm is not None:
        variables["background_power"] = (dims, background_power(known, area, filter_width_nm))
        attributes["filter_width_nm"] = filter_width_nm
    title = titled("Radiance by daylight", attributes)
    return label(xr.Dataset(variables, coords, {**results.provenance(attributes), "title": title}))


def _render_frame(
    renderer: DaylightRenderer,
    goal: engine.Goal,
    seed: int,
    progress: ProgressCallback | None,
    smooth: float | None,
) -> tuple[RatioStatistics, engine.PassLog, float, float]:
    """Render one frame's passes; return statistics, log, light share lost at the surface's edge, and bias.

    The bias is the smoothed images' bias, else NaN.
    """
    pixels = renderer.scene.receiver.pixels
    statistics, scattered, received = RatioStatistics(pixels.count), PassStatistics(), 0.0

    def render_pass(number: int, seed: int) -> float:
        nonlocal received
        daylight = renderer.render_pass(seed)
        found, sampled = np.array(daylight.found), np.array(daylight.sampled)
        if smooth:
            assert pixels.grid is not None
            diffuse = np.array(daylight.scattered)
            radiance = _smoothed(diffuse, sampled, pixels.grid, smooth)
            scattered.add(radiance)
            found += radiance * sampled - diffuse
        statistics.add(found, sampled)
        received += float(np.sum(found))
        return float(daylight.edge_loss[0])

    def require_light(passes: int) -> None:
        # A sum that is not finite is reported with the image.
        if received == 0:
            raise UserError(
                f"no daylight reached the receiver in {passes} passes: its field of view must see sea or sky"
            )

    log = engine.run_passes(
        render_pass,
        goal,
        seed=seed,
        errors=statistics.relative_errors,
        errors_of="pixels",
        verify=require_light,
        progress=progress,
    )
    bias = np.nan
    if smooth:
        assert pixels.grid is not None
        known = np.isfinite(statistics.ratio) & (statistics.ratio > 0)
        mean = np.where(known, scattered.mean, 0)
        change = _smoothed(mean, known.astype(np.float64), pixels.grid, smooth) - mean
        bias = float(smoothing_bias(change, scattered.stderr, statistics.ratio, known))
    return statistics, log, log.edge_loss_share(received), bias


def _smoothed(found: FloatArray, sampled: FloatArray, grid: tuple[int, int], smooth: float) -> FloatArray:
    """Return the smoothed ratio between an image and its samples, shape (pixels,); 0 far from all samples."""
    from scipy.ndimage import gaussian_filter

    light, samples = (gaussian_filter(one.reshape(grid), smooth).ravel() for one in (found, sampled))
    return np.asarray(np.divide(light, samples, out=np.zeros_like(light), where=samples > 0))


def _moved(scene: Any, params: Mapping[str, Any] | None, later: float) -> tuple[Any, Mapping[str, Any] | None]:
    """Return scene and parameters with the sea at a later time [s]."""
    if isinstance(scene, SceneSource) and not scene.is_xml:
        scene = scene.scene_dict()
    if isinstance(scene, Mapping):
        moved = {name: copy.copy(part) if isinstance(part, dict) else part for name, part in scene.items()}
        seas = [part for part in moved.values() if isinstance(part, dict) and part.get("type") == "ocean_surface"]
        for sea in seas:
            sea["time"] = sea.get("time", 0.0) + later
        if not seas:
            raise UserError("frames need an ocean_surface in the scene: nothing else changes with time")
        return moved, params
    if isinstance(scene, SceneSource):
        defaults = scene.values
    elif isinstance(scene, (str, os.PathLike)):
        defaults = catalogue.scene_parameters(scene, by_id=True)
    else:
        raise UserError("frames need a scene by its name, path or dict: the time of a loaded one cannot be changed")
    name = next((one for known in (params or {}, defaults) for one in _TIMES if one in known), None)
    if name is None:
        raise UserError(f"frames need the parameter {_TIMES[0]} of the scene, the time of its ocean_surface")
    start = {**defaults, **(params or {})}[name]
    try:
        return scene, {**(params or {}), name: float(start) + later}
    except ValueError:
        raise UserError(f"{name} = {start!r} must be a number") from None


def _etendue(renderer: DaylightRenderer) -> FloatArray:
    """Return open area times solid angle times transmittance of optics and air, one way [m^2 sr], shape (pixels,)."""
    receiver = renderer.scene.receiver
    optics = receiver.optics
    one_way = float(np.sqrt(optics.two_way_atmospheric_transmittance))
    area = optics.aperture_area * (1 - optics.obscuration) * optics.optical_efficiency * one_way
    return np.asarray(area * pixel_solid_angles(receiver.pixels))


def _describe(renderer: DaylightRenderer) -> dict[str, Any]:
    """Return receiver and daylight attributes; warn about a field of view beyond the surface."""
    scene, receiver = renderer.scene, renderer.scene.receiver
    outside = share_outside_surface(scene, renderer.sampler)
    if outside > engine.TOLERATED_LOSS:
        logger.warning("%.2g %% of the view passes outside the surface; enlarge the surface's size", 100 * outside)
    described = {
        "layout": receiver.pixels.layout,
        "field_of_view_mrad": 1e3 * receiver.pixels.field_of_view,
        "field_of_view_shape": receiver.pixels.field_of_view_shape,
        "aperture_area": receiver.optics.aperture_area,
        "altitude": float(receiver.pose.origin[2]),
        "off_nadir_deg": receiver.pose.off_nadir_deg,
        "refractive_index": scene.refractive_index,
        "surface_slope_variance": scene.slope_variance,
        "view_outside_surface": outside,
    }
    if scene.sun is not None:
        described |= {"sun_zenith_deg": scene.sun.zenith_deg, "sun_irradiance": scene.sun.irradiance}
    if scene.sky is not None:
        described |= {"sky_distribution": scene.sky.distribution, "sky_irradiance": scene.sky.irradiance}
    return described
