"""Pictures by daylight: what the receiver sees of a scene that sun and sky light, as still or moving pictures.

A picture is an `xarray.Dataset` with ``radiance`` and ``radiance_stderr`` [W m^-2 sr^-1 nm^-1] over (row, column) or
(pixel,), with a leading dimension ``frame`` and its coordinate ``time_s`` [s] for moving pictures. With the width of a
filter it holds ``background_power`` [W], which the receiver detects in each pixel while its laser is dark.
"""

from __future__ import annotations

import copy
import logging
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from mitransient_lidar import dataset_files, exr, resources, results, variants
from mitransient_lidar.errors import UserError
from mitransient_lidar.interruption import InterruptAfterPass
from mitransient_lidar.loading import load_scene, readable_errors
from mitransient_lidar.optics.checks import FloatArray, positive, whole
from mitransient_lidar.optics.daylight import background_power
from mitransient_lidar.rendering import Goal, Progress, first_sensor, pass_seed

if TYPE_CHECKING:
    import mitsuba as mi

logger = logging.getLogger(__name__)

#: Accuracy and longest time of a frame when the caller asks for none.
DEFAULT_TARGET_ERROR = 0.05
DEFAULT_MAX_TIME = 120.0

#: Parameter of an XML scene that moves its sea on [s].
TIME_PARAMETER = "surface_time"

_MOST_FRAMES = 10_000

#: Share of the view, or of the light, lost beside the surface patch above which a warning is given.
_TOLERATED_LOSS = 1e-3

#: Pixels darker than this share of the median do not count in the errors.
_DARK = 1e-2

_UNIT = "W m-2 sr-1 nm-1"


class RatioStatistics:
    """Ratio of two sums over passes, and its standard error.

    Each pass gives for each pixel what its paths have found and how much of the pixel they have sampled. The ratio of
    the totals is the mean radiance; a pass without a path in a pixel does no harm. The standard error is that of the
    ratio of means to first order (Cochran 1977, Sampling Techniques, section 2.11).
    """

    def __init__(self, count: int) -> None:
        self.count = 0
        self._sums = np.zeros((5, count))

    def add(self, found: FloatArray, sampled: FloatArray) -> None:
        """Add the result of one pass, shape (pixels,)."""
        self.count += 1
        self._sums += [found, sampled, found * found, found * sampled, sampled * sampled]

    @property
    def ratio(self) -> FloatArray:
        """Mean of the ratio; NaN where nothing was sampled."""
        found, sampled = self._sums[:2]
        return np.asarray(np.divide(found, sampled, out=np.full_like(found, np.nan), where=sampled > 0))

    @property
    def stderr(self) -> FloatArray:
        """Standard error of the mean, NaN before the second pass."""
        if self.count < 2:
            return np.full(self._sums.shape[1], np.nan)
        _, sampled, found2, product, sampled2 = self._sums
        ratio = self.ratio
        residual = np.maximum(found2 - 2 * ratio * product + ratio**2 * sampled2, 0)
        variance = residual * self.count / (self.count - 1)
        unknown = np.full_like(sampled, np.nan)
        return np.asarray(np.divide(np.sqrt(variance), sampled, out=unknown, where=sampled > 0))

    @property
    def invalid(self) -> int:
        """Number of pixels that were sampled and whose mean is not finite."""
        return int(np.count_nonzero((self._sums[1] > 0) & ~np.isfinite(self.ratio)))

    def relative_errors(self) -> FloatArray:
        """Return the relative standard errors of the pixels that are not dark."""
        ratio, stderr = self.ratio, self.stderr
        known = np.isfinite(ratio) & (ratio > 0)
        if not known.any():
            return np.zeros(0)
        lit = known & (np.where(known, ratio, 0) > _DARK * np.median(ratio[known]))
        return np.asarray(stderr[lit] / ratio[lit])


def render_passive(
    scene: str | Path | Mapping[str, Any] | mi.Scene,
    params: Mapping[str, Any] | None = None,
    *,
    integrator: str | Mapping[str, Any] | None = None,
    target_error: float | None = None,
    max_time: float | None = None,
    passes: int | None = None,
    seed: int = 0,
    frames: int = 1,
    frame_step_s: float = 0.1,
    filter_width_nm: float | None = None,
    variant: str | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> xr.Dataset:
    """Render what the receiver sees by daylight.

    Parameters
    ----------
    scene
        Name of a shipped scene, path of a Mitsuba XML file, dict for ``mitsuba.load_dict``, or a loaded scene, with a
        ``sun``, a ``sky``, or both. A laser in it stays dark.
    params
        Values for the ``<default>`` parameters of an XML scene.
    integrator
        Name or dict of a passive integrator; by default the scene's own, or ``passive_volpath``.
    target_error
        Relative standard error, greater than 0: the passes of a frame end when 95 % of the pixels have reached it
        (after at least 8 passes).
    max_time
        Longest time for the passes of a frame [s], greater than 0.
    passes
        Number of passes of a frame, at least 2. Without any of the three the target is 0.05 within 120 s.
    seed
        Any integer; frames and passes have random numbers of their own.
    frames
        Number of frames, 1 to 10 000.
    frame_step_s
        Time between frames [s], greater than 0. The sea moves on by it: through ``surface_time`` of an XML scene, or
        ``time`` of the ``ocean_surface`` of a dict.
    filter_width_nm
        Width of the receiver's filter [nm], greater than 0, for ``background_power``.
    variant
        ``llvm_ad_mono`` or ``cuda_ad_mono``; by default the active one, or the fastest that works here.
    progress
        Called with a :class:`rendering.Progress` of the frame after every pass.

    Returns
    -------
    xarray.Dataset
        As described at the head of this module. ``etendue`` [m^2 sr] is open area times solid angle of each pixel times
        the transmittance of optics and (one way) air; power is radiance times etendue times width of the filter. The
        attribute ``background_radiance`` is the mean over the field of view. After Ctrl-C it holds the frames begun,
        and the attribute ``interrupted`` is 1.

    Raises
    ------
    UserError
        When the scene, a parameter or an option is wrong; the message is one sentence.
    """
    with readable_errors():
        frames, step = whole("frames", frames, 1, _MOST_FRAMES), positive("frame_step_s", frame_step_s)
        width = None if filter_width_nm is None else positive("filter_width_nm", filter_width_nm)
    if target_error is None and max_time is None and passes is None:
        target_error, max_time = DEFAULT_TARGET_ERROR, DEFAULT_MAX_TIME
    goal = Goal.from_options(target_error, max_time, passes)
    variants.set_variant(variant)
    pictures: list[tuple[FloatArray, FloatArray]] = []
    attributes: dict[str, Any] = {}
    start = time.perf_counter()
    done, lost, interrupted = 0, 0.0, False
    for frame in range(frames):
        moved = _moved(scene, params, frame * step) if frames > 1 else (scene, params)
        loaded, name, parameters = load_scene(*moved)
        engine = _choose_integrator(loaded, integrator)
        sensor = first_sensor(loaded)
        with readable_errors():
            system, view = engine.prepare_view(loaded, sensor)
        if frame == 0:
            attributes, pixels, etendue = _describe(system, view), system.receiver.pixels, _etendue(system)
            attributes |= {f"scene.{key}": value for key, value in parameters.items()}
            attributes |= {"scene": name, "integrator": engine.plugin, "seed": int(seed), **variants.versions()}
            if attributes["view_beside_surface"] > _TOLERATED_LOSS:
                share = 100 * attributes["view_beside_surface"]
                logger.warning("%.2g %% of the view passes beside the surface; enlarge the surface's extent", share)
        try:
            statistics, lost_here, interrupted = _render_frame(loaded, sensor, engine, goal, (seed, frame), progress)
        finally:
            engine.release()
        if statistics.count < 2:
            break
        pictures.append((statistics.ratio, statistics.stderr))
        if statistics.invalid:
            logger.warning("%d of %d pixels hold no finite radiance", statistics.invalid, len(statistics.ratio))
        errors = statistics.relative_errors()
        done, lost = statistics.count, max(lost, lost_here)
        if interrupted:
            break
    if not pictures:
        raise KeyboardInterrupt
    if lost > _TOLERATED_LOSS:
        logger.warning("about %.2g %% of the light is lost beside the surface; enlarge its extent", 100 * lost)
    attributes |= {
        "passes": done,
        "elapsed_s": time.perf_counter() - start,
        "interrupted": int(interrupted),
        "error_median": float(np.median(errors)) if errors.size else float("nan"),
        "error_p95": float(np.quantile(errors, 0.95)) if errors.size else float("nan"),
        "lost_at_surface_border": lost,
    }
    coordinates = results.pixel_coordinates(pixels.names, 1e3 * pixels.centres(), pixels.grid)
    times = step * np.arange(len(pictures), dtype=np.float64) if frames > 1 else None
    return _dataset(pictures, times, coordinates, pixels.grid, etendue, width, attributes)


def _render_frame(
    loaded: mi.Scene,
    sensor: mi.Sensor,
    engine: Any,
    goal: Goal,
    seeds: tuple[int, int],
    progress: Callable[[Progress], None] | None,
) -> tuple[RatioStatistics, float, bool]:
    """Render passes of one frame; return them, the share of light lost, and whether Ctrl-C has ended them."""
    seed, frame = seeds
    start = time.perf_counter()
    statistics: RatioStatistics | None = None
    lost = found = 0.0
    median = p95 = None
    try:
        with InterruptAfterPass() as interruption:
            while statistics is None or not goal.reached(statistics.count, time.perf_counter() - start, p95):
                number = 0 if statistics is None else statistics.count
                with readable_errors():
                    engine.render(loaded, sensor, seed=pass_seed(pass_seed(seed, frame), number), develop=False)
                statistics = statistics or RatioStatistics(len(engine.found))
                statistics.add(np.array(engine.found), np.array(engine.sampled))
                lost, found = lost + float(engine.lost[0]), found + float(np.sum(np.array(engine.found)))
                elapsed = time.perf_counter() - start
                if statistics.count > 1 and (errors := statistics.relative_errors()).size:
                    median, p95 = float(np.median(errors)), float(np.quantile(errors, 0.95))
                if progress is not None:
                    left = goal.remaining(statistics.count, elapsed, p95)
                    state = (statistics.count, goal.passes, elapsed, median, p95, goal.target_error, left)
                    progress(Progress(*state))
                if statistics.count > 1:
                    interruption.check()
    except KeyboardInterrupt:
        if statistics is None:
            raise
        return statistics, lost / (lost + found) if lost > 0 else 0.0, True
    return statistics, lost / (lost + found) if lost > 0 else 0.0, False


def _choose_integrator(scene: mi.Scene, wanted: str | Mapping[str, Any] | None) -> Any:
    """Return the caller's choice, the scene's own integrator if it is passive, or the default one."""
    import mitsuba as mi

    own = scene.integrator()
    if wanted is None and hasattr(own, "prepare_view"):
        return own
    chosen = "passive_volpath" if wanted is None else wanted
    with readable_errors(loading=True):
        engine = mi.load_dict({"type": chosen} if isinstance(chosen, str) else dict(chosen))
    if not hasattr(engine, "prepare_view"):
        raise UserError(f"integrator = {chosen!r} makes no pictures by daylight: use 'passive_volpath'")
    return engine


def _moved(scene: Any, params: Mapping[str, Any] | None, later: float) -> tuple[Any, Mapping[str, Any] | None]:
    """Return scene and parameters with the sea moved on [s]."""
    if isinstance(scene, Mapping):
        moved = {name: copy.copy(part) if isinstance(part, dict) else part for name, part in scene.items()}
        seas = [part for part in moved.values() if isinstance(part, dict) and part.get("type") == "ocean_surface"]
        for sea in seas:
            sea["time"] = sea.get("time", 0.0) + later
        if not seas:
            raise UserError("frames need an ocean_surface in the scene: nothing else moves")
        return moved, params
    if not isinstance(scene, (str, os.PathLike)):
        raise UserError("frames need a scene by its name, path or dict: a loaded one cannot be moved on")
    defaults = resources.scene_parameters(resources.scene_path(scene))
    if TIME_PARAMETER not in defaults:
        raise UserError(
            f"frames need a parameter {TIME_PARAMETER} of the scene, which is the time of its ocean_surface"
        )
    given = {**(params or {})}
    try:
        begin = float(given.get(TIME_PARAMETER, defaults[TIME_PARAMETER]))
    except ValueError:
        raise UserError(f"{TIME_PARAMETER} = {given.get(TIME_PARAMETER)!r} must be a number") from None
    return scene, {**given, TIME_PARAMETER: begin + later}


def _etendue(system: Any) -> FloatArray:
    """Return open area times solid angle times transmittance of optics and air, one way [m^2 sr], shape (pixels,)."""
    from mitransient_lidar.transport.daylight import pixel_solid_angles

    optics = system.receiver.optics
    one_way = float(np.sqrt(optics.two_way_atmospheric_transmittance))
    area = optics.aperture_area * (1 - optics.obscuration) * optics.optical_efficiency * one_way
    return np.asarray(area * pixel_solid_angles(system.receiver.pixels))


def _describe(system: Any, view: Any) -> dict[str, Any]:
    """Return the attributes of a picture that tell of the receiver and of the daylight."""
    from mitransient_lidar.transport.daylight import share_beside_surface

    receiver = system.receiver
    described = {
        "layout": receiver.pixels.layout,
        "field_of_view_mrad": 1e3 * receiver.pixels.field_of_view,
        "field_of_view_shape": receiver.pixels.field_of_view_shape,
        "aperture_area": receiver.optics.aperture_area,
        "altitude": float(receiver.pose.origin[2]),
        "off_nadir_deg": float(np.degrees(np.arccos(np.clip(-receiver.pose.axis[2], -1, 1)))),
        "refractive_index": float(system.refractive_index),
        "surface_slope_variance": float(system.slope_variance),
        "view_beside_surface": share_beside_surface(system, view),
    }
    if system.sun is not None:
        described |= {"sun_zenith_deg": system.sun.zenith_deg, "sun_irradiance": system.sun.irradiance}
    if system.sky is not None:
        described |= {"sky_distribution": system.sky.distribution, "sky_irradiance": system.sky.irradiance}
    return described


def _dataset(
    pictures: list[tuple[FloatArray, FloatArray]],
    times: FloatArray | None,
    coordinates: dict[str, Any],
    grid: tuple[int, int] | None,
    etendue: FloatArray,
    width: float | None,
    attributes: dict[str, Any],
) -> xr.Dataset:
    """Return the pictures with their coordinates and attributes."""
    inner: tuple[str, ...] = ("pixel",) if grid is None else ("row", "column")
    shape = (len(etendue),) if grid is None else grid
    dims = inner if times is None else ("frame", *inner)
    outer = () if times is None else (len(pictures),)
    radiance, stderr = (np.reshape([picture[i] for picture in pictures], (*outer, *shape)) for i in (0, 1))
    if times is not None:
        coordinates |= {
            "frame": ("frame", np.arange(len(times)), {"long_name": "number of the frame"}),
            "time_s": ("frame", times, {"units": "s", "long_name": "time since the first frame"}),
        }
    area = {"units": "m2 sr", "long_name": "open area times solid angle times transmittance"}
    variables: dict[str, Any] = {
        "radiance": (dims, radiance, {"units": _UNIT, "long_name": "spectral radiance, mean over the pixel"}),
        "radiance_stderr": (dims, stderr, {"units": _UNIT, "long_name": "standard error of the radiance"}),
        "etendue": (inner, etendue.reshape(shape), area),
    }
    weight = np.where(np.isfinite(radiance), etendue.reshape(shape), 0)
    mean = float(np.sum(np.nan_to_num(radiance) * weight) / np.sum(weight))
    attributes = {**attributes, "background_radiance": mean}
    if width is not None:
        power = background_power(np.nan_to_num(radiance), etendue.reshape(shape), width)
        variables["background_power"] = (dims, power, {"units": "W", "long_name": "detected power of the daylight"})
        attributes["filter_width_nm"] = width
    title = f"Radiance by daylight, scene {attributes['scene']}"
    return xr.Dataset(variables, coordinates, {**results.provenance(attributes), "title": title})


def save(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a picture to a NetCDF file, or to an EXR file with the channels Y and Y.stderr and a part for each frame.

    Parameters
    ----------
    dataset
        What `render_passive` returned.
    path
        File name that ends in ``.nc`` or ``.exr``. An existing file is replaced. Pixels that form no grid are an image
        one row high.

    Raises
    ------
    UserError
        If the suffix is another one, or the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".exr", ".nc"):
        raise UserError(f"cannot write {path}: the file name must end in .exr or .nc.")
    with results.replacing(path) as temporary:
        if suffix == ".nc":
            dataset_files.write_netcdf(dataset, temporary, ("radiance", "radiance_stderr"))
        else:
            exr.write_parts(temporary, _parts(dataset))


def _parts(dataset: xr.Dataset) -> list[exr.Part]:
    """Return the frames as images; the attributes are in the first one."""
    readable = {f"lidar.{name}": value for name, value in dataset.attrs.items()}
    columns = dataset.sizes.get("column", dataset.sizes.get("pixel", 1))
    parts = []
    for index in range(dataset.sizes.get("frame", 1)):
        frame = dataset.isel(frame=index) if "frame" in dataset.dims else dataset
        channels = {
            channel: np.ascontiguousarray(frame[name].values.reshape(-1, columns), dtype=np.float32)
            for channel, name in (("Y", "radiance"), ("Y.stderr", "radiance_stderr"))
        }
        own = {"timeS": float(frame["time_s"])} if "frame" in dataset.dims else {}
        name = f"frame{index:04d}" if "frame" in dataset.dims else ""
        parts.append(exr.Part(name, exr.header({**(readable if index == 0 else {}), **own}), channels))
    return parts
