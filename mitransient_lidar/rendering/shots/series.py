"""Shot series over one sea, with the true slope, height and depth at each place."""

from __future__ import annotations

import json
import logging
import math
import os
import time
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import mitsuba as mi
import numpy as np
import xarray as xr

from mitransient_lidar.core.errors import UserError, is_interruption
from mitransient_lidar.core.interruption import DeferredInterrupt
from mitransient_lidar.core.options import Infrared, Instrument, Option, SceneOrResult, Sensor, checked, positive_option
from mitransient_lidar.core.parameters.lidar import LARGEST_COORDINATE
from mitransient_lidar.core.tables.headings import Column
from mitransient_lidar.core.tables.text_tables import read_two_columns
from mitransient_lidar.core.tables.written import table_lines
from mitransient_lidar.core.validation import ArrayLike, FloatArray, IntArray, finite_array, in_range, integer
from mitransient_lidar.loading import variants
from mitransient_lidar.loading.catalogue import with_infrared
from mitransient_lidar.loading.scenes import LoadedScene, open_scene
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.rendering import passes as engine
from mitransient_lidar.rendering.passes import ProgressCallback
from mitransient_lidar.rendering.shots.batches import (
    MOST_PASSES_FOR_ERROR,
    ReceivedShots,
    ShotPoses,
    require_water,
    share_for_error,
    suits_maps,
)
from mitransient_lidar.rendering.shots.scene import AIM, TARGET, ShotScene
from mitransient_lidar.rendering.shots.truth import SeaMap, sea_of, truth_coordinates
from mitransient_lidar.results.attributes import described, join, uninterrupted
from mitransient_lidar.transport.light_maps.suitability import UnsuitedError

_LOG = logging.getLogger(__name__)

#: Farthest place from the middle of a series along x and y [m]: single precision resolves 2 mm between the ends.
FARTHEST = 1e4

_METRES = {"m": 1.0, "cm": 0.01, "km": 1000.0}
_PLACE = Column("x", ("aim x",), _METRES), Column("y", ("aim y",), _METRES)

#: Coordinates in the table of a series, with heading and format.
_LISTED = {
    **dict(zip(AIM, (("x (m)", ">10.2f"), ("y (m)", ">10.2f")), strict=True)),
    "true_slope_along": ("along (deg)", ">13.2f"),
    "true_slope_across": ("across (deg)", ">14.2f"),
    "true_surface_height": ("height (m)", ">12.3f"),
    "true_bottom_depth": ("bottom (m)", ">12.3f"),
    "true_bottom_depth_below_surface": ("depth (m)", ">12.3f"),
}


def read_places(path: str | os.PathLike[str]) -> FloatArray:
    """Read places from a table with columns x and y [m], shape (count, 2); raise `UserError` if it cannot be read."""
    table = read_two_columns(path, *_PLACE)
    return np.column_stack([table.columns[column.name] for column in _PLACE])


def random_places(sea: SeaMap, count: int, seed: int) -> FloatArray:
    """Return random places on a sea [m], shape (count, 2)."""
    low, high = zip(*((lines[0], lines[-1]) for lines in (sea.x, sea.y)), strict=True)
    return np.random.default_rng(seed).uniform(low, high, (count, 2))


@checked
@alone
def render_shots(
    scene: SceneOrResult,
    params: Mapping[str, Any] | None = None,
    *,
    count: Annotated[int, Option("Number of shots at random locations; the command's default is 20", 2, 100_000)] = 200,
    positions: Annotated[
        Any, Option("Location of a shot [m], instead of random ones. Repeatable", form="X,Y", flag="--at")
    ] = None,
    move_target: Annotated[bool, Option("Move the target with the aim of each shot")] = False,
    passes: Annotated[
        int | None, Option("Most passes of each shot, by default 8, or 400 with a target error", 2, 10_000)
    ] = None,
    target_error: Annotated[
        float | None,
        Option("Relative standard error of the median bin at which a shot ends, by default none", 0, 1, above=True),
    ] = None,
    max_time: Annotated[
        float | None,
        positive_option("Stop before this many seconds for all shots, with fewer passes or shots; by default no limit"),
    ] = None,
    pass_share: float | None = None,
    light: engine.LightOption = "merging",
    seed: Annotated[int, Option("Seed of random places, by default 1", 0, 2**53)] = 1,
    first_seed: int = 0,
    axis: TimeAxis | None = None,
    shot_passes: ArrayLike | None = None,
    components: engine.Components = None,
    derivatives: Sequence[str] | str | None = None,
    instrument: Instrument = None,
    infrared: Infrared = False,
    sensor: Sensor = None,
    describe_sea: bool = True,
    merge_unsuited: bool = False,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Render shots at given or random locations on one sea, many at a time.

    Parameters
    ----------
    scene, params
        An XML scene with the parameters ``aim_x`` and ``aim_y``.
    count
        Number of random shots, 2 to 100 000, about the origin or, if it is more than 250 m from there, the scene's aim.
        They need an ``ocean_surface`` with waves. Not used with `positions`.
    positions
        Locations (x, y) where the axis meets the mean sea level [m], shape (shots, 2), -1e7 to 1e7, and at most 20 km
        apart along x and y.
    move_target
        Whether the target keeps its position relative to the aim; the scene needs the parameters ``target_x`` and
        ``target_y``.
    target_error
        Relative standard error, greater than 0, at most 1, that ends a batch's passes, after at least 4 of them. The
        median over lit pixels' bins from the surface echo to the bottom echo's end must have reached it.
    max_time
        Longest time for the passes of all shots [s], greater than 0. It is shared among the batches, which end with
        fewer passes, at least two. Where these take longer, too, the result holds the batches begun by then.
    pass_share
        Share of a full pass's paths in each pass, 1/512 to 1. It is 1 by default, and with a `target_error` one that
        needs few passes. The automatic cells in passes with few paths are up to twice as wide, which changes the
        water's signal by about 0.3 %.
    light
        'merging', the integrator of the scene, or 'maps': the beam's light is looked up in maps at several depths
        (`transport.light_maps.renderer`). Maps serve waves, layers of one index and a bottom, without derivatives. 2
        passes are usual. Mean energies agree with merging to within 1 %, bottom times to within 0.05 ns.
    first_seed
        Seed of the first shot, 0 to 2^53; shot n is rendered with this seed plus n.
    axis
        Time bins instead of automatic ones, which contain all shots' light. They must contain it, too, up to a
        twentieth of the record.
    shot_passes
        Most passes for each shot, shape (shots,), 2 to `passes`, as in the coordinate of a series that is rendered
        again.
    derivatives
        Names of parameters by which the light is differentiated, as for `rendering.render.render`.
    describe_sea
        Whether to add the attribute ``slope_deviation``, which takes 0.2 s.
    merge_unsuited
        Whether to merge light in a scene that maps do not suit, or with a target in a shot's light.

    Returns
    -------
    xarray.Dataset
        A result as from `rendering.render.render`, without gates, with the dimension ``shot`` first. Coordinates over
        ``shot``: ``aim_x``, ``aim_y`` [m]; the means over the beam's footprint ``true_slope_along`` (positive for a
        face towards the lidar), ``true_slope_across`` (positive for a rise to the left) [1] and ``true_surface_height``
        [m] above the mean sea level; ``true_bottom_depth`` [m] below the mean sea level where the axis, refracted at a
        level sea, meets the bottom (`WaterScene.bottoms`), NaN where it misses; ``true_bottom_depth_below_surface`` [m]
        below the mean surface in the footprint, as echo depths are, the sum of depth and surface height. For the water,
        whichever way it is given: ``true_absorption`` a, ``true_scattering`` b, ``true_backscattering`` bb,
        ``true_attenuation`` c and ``true_kd`` [1/m], means over depth from the mean sea level to that bottom, without
        bubbles (`truth.water_means`). Attributes such as ``surface_time_ns`` and the limits of the echo window belong
        to the first shot; positions are left out. ``series_parameters``: JSON of the scene parameters that shots
        replace. ``passes`` is the largest value of the coordinate ``shot_passes``, and ``most_passes`` the option.
        ``slope_deviation``: standard deviations of the two slopes in a sea with waves. After Ctrl-C the dataset
        contains the completed shots, and the attribute ``interrupted`` is 1.

    Raises
    ------
    UserError
        If the scene is invalid, has no waves for random locations, or lacks a parameter, or a number is out of range.
    """
    options_given = {**locals(), "infrared": False}
    if infrared:
        (_, own), (channel, other) = with_infrared(instrument, params)
        green = uninterrupted(render_shots(**options_given | {"params": own}))
        options_given |= {"params": other, "instrument": channel, "axis": None}
        options_given["positions"] = np.column_stack([green[name] for name in AIM])
        return join(green, render_shots(**options_given))
    differentiated = [*derivatives] if derivatives else None
    options = engine.RenderOptions(
        target_error=target_error, max_time=max_time, pass_share=pass_share, derivatives=differentiated, light=light
    )
    wanted = options.target_error
    usual = (8, 1.0) if wanted is None else (MOST_PASSES_FOR_ERROR, share_for_error(wanted))
    if light == "maps":
        usual = 2 if wanted is None else MOST_PASSES_FOR_ERROR, 1.0
    passes = usual[0] if passes is None else passes
    share = options.pass_share or usual[1]
    first_seed = integer("first_seed", first_seed, 0, 2**53)
    given = None if positions is None else _checked_places(positions)
    variants.leave_the_gpu("shots are rendered")
    source: dict[str, Any] = {"instrument": instrument, "sensor": sensor}
    session = open_scene(scene, params, **source) if given is None or move_target else None
    target = _target_offset(session) if session is not None and move_target else None
    places = given
    if places is None:
        assert session is not None
        places = random_places(SeaMap.of_scene(session.scene), count, seed)
    channels: dict[str, Any] = {"components": bool(components), "derivatives": derivatives or (), "light": light}
    try:
        series = ShotScene(scene, params, places, **source, target=target, axis=axis, **channels)
        if light == "maps" and not merge_unsuited:
            require_water(series.lidar, ShotPoses(places))
        suits = light == "merging" or not merge_unsuited or bool(suits_maps(series.lidar, ShotPoses(places)).all())
    except UnsuitedError:
        suits = False
        if not merge_unsuited:
            raise
    if not suits:
        return render_shots(**options_given | {"light": "merging"})
    sea = SeaMap.of_scene(series.session.scene) if describe_sea and _has_waves(series.session.scene) else None
    replaced = (*AIM, *(TARGET if move_target else ()))
    before = (session or series.session).parameters
    own = {name: before[name] for name in replaced if name in before}
    truth = truth_coordinates(sea_of(series.session.scene), series.lidar, ShotPoses(places))
    if missed := np.count_nonzero(np.isnan(truth["true_bottom_depth"][1])):
        _LOG.warning("the axis of %d of %d shots misses the bottom: their true depth is unknown", missed, len(places))
    batches = series.batches(passes, share, wanted)
    most = _checked_passes(shot_passes, len(places), passes)
    found: list[ReceivedShots] = []
    errors: list[FloatArray] = []
    began, done, interrupted = time.perf_counter(), 0, False
    try:
        with DeferredInterrupt() as interruption:
            for part in batches.parts(len(places)):
                left = (options.max_time or math.inf) - (time.perf_counter() - began)
                if found and left <= 0:
                    break
                seconds = left * (part.stop - part.start) / (len(places) - part.start)
                batch = batches.limited(int(most[part].max()), seconds)
                seeds = range(first_seed + part.start, first_seed + part.stop)
                found.append(batch.render(ShotPoses(places[part]), seeds))
                errors.append(found[-1].errors)
                done = part.stop
                if progress is not None:
                    progress(_progress(done, len(places), time.perf_counter() - began, errors[-1], options))
                interruption.check()
    except (KeyboardInterrupt, RuntimeError) as error:
        if not is_interruption(error):
            raise
        if not found:
            raise KeyboardInterrupt from error
        interrupted = True
    _warn_of_the_end(found, done, len(places), options, interrupted)
    median, p95 = np.quantile(np.concatenate(errors), [0.5, 0.95], method="higher")
    lost, energy = sum(one.lost for one in found), sum(one.whole[0].sum() for one in found)
    lost = lost / (lost + energy) if lost > 0 else 0.0
    received = ReceivedShots.joined(found)
    engine.warn_of_edge_loss(lost)
    attributes = series.attributes(
        used=batches.used_values,
        passes=int(received.passes.max()),
        most_passes=passes,
        pass_share=share,
        elapsed_s=time.perf_counter() - began,
        error_median=float(median),
        error_p95=float(p95),
        surface_edge_loss=float(lost),
        shots=done,
        first_seed=first_seed,
        interrupted=int(interrupted),
        moved_target=int(move_target),
        components=int(bool(components)),
        **({"derivatives": [one.name for one in series.parameters]} if series.parameters else {}),
        series_parameters=json.dumps(own),
        **({} if light == "merging" else {"light": light}),
        **({} if wanted is None else {"target_error": wanted}),
        **({"places_seed": seed} if given is None else {}),
    )
    if sea is not None:
        attributes["slope_deviation"] = [float(np.sqrt(np.mean(slopes**2))) for slopes in (sea.along, sea.across)]
    known = {name: (dim, values[:done], about) for name, (dim, values, about) in truth.items()}
    known["shot_passes"] = ("shot", received.passes, described("shot_passes"))
    return series.dataset(received, attributes).assign_coords(known)


def _progress(
    done: int, planned: int, elapsed: float, errors: FloatArray, options: engine.RenderOptions
) -> engine.Progress:
    """Return a series' progress, with the errors in its last batch."""
    median, p95 = np.quantile(errors, [0.5, 0.95], method="higher")
    return engine.Progress(
        done=done,
        planned=planned,
        unit="shot",
        elapsed_s=elapsed,
        remaining_s=max(0.0, min(elapsed * (planned - done) / done, (options.max_time or math.inf) - elapsed)),
        error_median=float(median),
        error_p95=float(p95),
        target_error=options.target_error,
        target_quantile=0.5,
        error=None if options.target_error is None else float(median),
    )


def describe_shots(series: xr.Dataset) -> list[str]:
    """Return table lines for shots from `render_shots`: locations, truth and the highest power in a pixel.

    The bottom is below the mean sea level, the depth below the mean surface in the beam.
    """
    peak = series["waveform"].max([dim for dim in series["waveform"].dims if dim != "shot"]).values
    values = {name: series[name].values for name in _LISTED}
    for name in ("true_slope_along", "true_slope_across"):
        values[name] = np.degrees(np.arctan(values[name]))
    columns = ("shot", ">5"), *_LISTED.values(), ("peak (W)", ">12.4g")
    return table_lines(columns, zip(series["shot"].values, *values.values(), peak, strict=True))


def _checked_places(places: ArrayLike) -> FloatArray:
    """Return places [m], shape (shots, 2)."""
    pairs = finite_array("positions", places)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not 1 <= len(pairs) <= 100_000:
        raise UserError(f"positions of shape {pairs.shape} must be 1 to 100000 pairs (x, y)")
    in_range("positions", float(pairs.flat[np.abs(pairs).argmax()]), -LARGEST_COORDINATE, LARGEST_COORDINATE)
    if (apart := float(np.ptp(pairs, axis=0).max())) > 2 * FARTHEST:
        raise UserError(f"positions are {apart:g} m apart along x or y: at most {2 * FARTHEST:g} m may be")
    return pairs


def _checked_passes(given: ArrayLike | None, shots: int, passes: int) -> IntArray:
    """Return each shot's most passes."""
    if given is None:
        return np.full(shots, passes)
    if (counts := finite_array("shot_passes", given)).shape != (shots,):
        raise UserError(f"shot_passes of shape {counts.shape} must be one number for each of {shots} shots")
    return np.array([integer("shot_passes", count, 2, passes) for count in counts])


def _warn_of_the_end(
    found: Sequence[ReceivedShots], done: int, planned: int, options: engine.RenderOptions, interrupted: bool
) -> None:
    """Warn about shots that are missing, or have not reached the requested error, unless Ctrl-C has ended them."""
    if done < planned and not interrupted:
        _LOG.warning("max_time = %g s ended after %d of %d shots", options.max_time, done, planned)
    if missed := sum(one.missed for one in found):
        _LOG.warning("%d of %d shots ended before target_error = %g", missed, done, options.target_error)


def _target_offset(session: LoadedScene) -> tuple[float, float]:
    """Return the distance [m] from the aim to the target."""
    for name in ("target_x", "target_y", "aim_x", "aim_y"):
        if name not in session.parameters:
            raise UserError(f"scene {session.name} has no parameter {name}, which move_target needs")
    x, y = (float(session.parameters[f"target_{axis}"]) - float(session.parameters[f"aim_{axis}"]) for axis in "xy")
    return x, y


def _has_waves(scene: mi.Scene) -> bool:
    sea = sea_of(scene)
    return sea is not None and math.isfinite(sea.cell_size)
