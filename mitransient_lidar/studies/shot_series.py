"""Series of shots over one sea, with the true slope, height and depth at each place."""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.core.errors import UserError, is_interruption
from mitransient_lidar.core.headings import Column
from mitransient_lidar.core.text_tables import read_two_columns
from mitransient_lidar.core.validation import FloatArray, finite_array, integer
from mitransient_lidar.loading.scene_record import SceneRecord, json_attribute
from mitransient_lidar.loading.scenes import check_params
from mitransient_lidar.rendering.interruption import DeferredInterrupt
from mitransient_lidar.rendering.passes import Progress, ProgressCallback
from mitransient_lidar.rendering.render import render
from mitransient_lidar.rendering.session import Session, choose_integrator, open_scene
from mitransient_lidar.studies.find_shots import SeaMap, Shot

if TYPE_CHECKING:
    import mitsuba as mi

    from mitransient_lidar.physics.lidar.time_axis import TimeAxis
    from mitransient_lidar.transport.scene import LidarScene

_LOG = logging.getLogger(__name__)

#: Reach of the mean over the beam's footprint, in its standard deviations, and smallest number of cells in one of them.
_REACH, _FEWEST_CELLS = 4.5, 4

#: Farthest place [m]: single precision resolves a millimetre there.
_FARTHEST = 1e4

_METRES = {"m": 1.0, "cm": 0.01, "km": 1000.0}
_PLACE = Column("x", ("aim x",), _METRES), Column("y", ("aim y",), _METRES)

#: Attributes that differ between shots, of which the series keeps the sum, the least or the greatest.
_MERGED: dict[str, Callable[[list[Any]], Any]] = {
    "elapsed_s": sum,
    "window_start_ns": min,
    "window_end_ns": max,
    "error_p95": max,
}
_MERGED |= {"surface_edge_loss": max, "beam_outside_surface": max}

_TRUTH = {
    "aim_x": ("m", "place where the axis meets the mean sea level, x"),
    "aim_y": ("m", "place where the axis meets the mean sea level, y"),
    "true_slope_along": ("1", "mean slope over the beam's footprint, positive for a face towards the lidar"),
    "true_slope_across": ("1", "mean slope over the beam's footprint, positive for a rise to the left"),
    "true_surface_height": ("m", "mean height over the beam's footprint above the mean sea level"),
    "true_bottom_depth": ("m", "depth of the bottom below the mean sea level where the refracted axis meets it"),
}


def rendered_shots(
    scene: Any,
    params: Mapping[str, Any] | None,
    places: npt.ArrayLike,
    *,
    passes: int,
    target: tuple[float, float] | None = None,
    axis: TimeAxis | None = None,
    progress: ProgressCallback | None = None,
) -> Iterator[xr.Dataset]:
    """Yield the result of a shot at each place [m], shape (shots, 2); shot n is rendered with the seed n.

    A `target` keeps this distance [m] from the aim, by the scene's parameters ``target_x`` and ``target_y``. An `axis`
    replaces automatic time bins, which may differ between the shots.
    """
    pairs = np.asarray(places, dtype=np.float64)
    for number, (x, y) in enumerate(pairs):
        session = open_scene(scene, _at(params, x, y, target))
        if axis is not None:
            session.share_record(axis)
        yield render(session, passes=passes, seed=number)
        if progress is not None:
            progress(Progress(number + 1, len(pairs), "shot"))


def read_places(path: str | os.PathLike[str]) -> FloatArray:
    """Read places from a table with columns x and y [m], shape (count, 2); raise `UserError` if it cannot be read."""
    table = read_two_columns(path, *_PLACE)
    return np.column_stack([table.columns[column.name] for column in _PLACE])


def random_places(sea: SeaMap, count: int, seed: int) -> FloatArray:
    """Return random places on a sea [m], shape (count, 2)."""
    return np.random.default_rng(seed).uniform(sea.x[0], sea.x[-1], (count, 2))


def random_shots(
    scene: Any,
    params: Mapping[str, Any] | None,
    sea: SeaMap,
    *,
    count: int,
    passes: int,
    seed: int,
    progress: ProgressCallback | None,
) -> Iterator[tuple[Shot, xr.Dataset]]:
    """Yield shots at random places of a sea and their results; the parameters are those of `render_shots`."""
    places = random_places(sea, count, seed)
    results = rendered_shots(scene, params, places, passes=passes, progress=progress)
    for (x, y), result in zip(places, results, strict=True):
        yield Shot("random", x, y, *sea.slope_at(x, y)), result


def render_shots(
    scene: Any,
    params: Mapping[str, Any] | None = None,
    *,
    count: int = 200,
    places: Sequence[tuple[float, float]] | npt.ArrayLike | None = None,
    move_target: bool = False,
    passes: int = 8,
    seed: int = 1,
    axis: TimeAxis | None = None,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Render shots at given or random places of one sea.

    Parameters
    ----------
    scene, params
        An XML scene with the parameters ``aim_x`` and ``aim_y``.
    count
        Number of random shots, 2 to 100 000; the scene needs an ``ocean_surface`` with waves. Not used with `places`.
    places
        Places (x, y) where the axis meets the mean sea level [m], shape (shots, 2), up to 10 km from the origin.
    move_target
        Whether the target keeps its place relative to the aim; the scene needs the parameters ``target_x`` and
        ``target_y``.
    passes
        Passes of each shot, 2 to 10 000.
    seed
        Seed of random places, at least 0. Shot n is rendered with the seed n.
    axis
        Time bins instead of automatic ones, which by default hold the light of all shots.
    progress
        Called with a `passes.Progress` after every shot.

    Returns
    -------
    xarray.Dataset
        A result as of `rendering.render.render` with the dimension ``shot`` first. Coordinates over ``shot``:
        ``aim_x``, ``aim_y`` [m]; the means over the beam's footprint ``true_slope_along`` (positive for a face towards
        the lidar), ``true_slope_across`` (positive for a rise to the left) [1] and ``true_surface_height`` [m] above
        the mean sea level; ``true_bottom_depth`` [m] below the mean sea level where the axis, refracted at a level sea,
        meets the largest solid of the scene, NaN where it misses. Attributes that differ between shots: the mean of
        numbers such as ``surface_time_ns``, the sum of ``elapsed_s``, and the limits of the echo window; positions are
        left out. ``series_parameters``: JSON of the scene's parameters that shots replace. ``slope_deviation``:
        standard deviations of the two slopes of a sea with waves. After Ctrl-C the dataset holds the completed shots,
        and the attribute ``interrupted`` is 1.

    Raises
    ------
    UserError
        If the scene is invalid, has no waves for random places, or lacks a parameter, or a number is out of range.
    """
    passes, seed = integer("passes", passes, 2, 10_000), integer("seed", seed, 0, 2**53)
    count = integer("count", count, 2, 100_000)
    given = None if places is None else _checked_places(places)
    session = open_scene(scene, params)
    target = _target_offset(session) if move_target else None
    sea = SeaMap.of_scene(session.scene) if given is None or _has_waves(session.scene) else None
    pairs = given if given is not None or sea is None else random_places(sea, count, seed)
    assert pairs is not None
    x, y = pairs[np.argmax(np.hypot(*pairs.T))]
    open_scene(scene, _at(params, x, y, target))  # before the first render
    lidar: LidarScene = choose_integrator(session.scene, None).prepare(session.scene, session.sensor).scene
    axis = axis or _common_record(session, lidar, pairs)
    truth = _truth(session, lidar, pairs)
    if missed := np.count_nonzero(np.isnan(truth[-1])):
        _LOG.warning("the axis of %d of %d shots misses the bottom: their true depth is unknown", missed, len(pairs))
    found: list[xr.Dataset] = []
    shots = rendered_shots(scene, params, pairs, passes=passes, target=target, axis=axis, progress=progress)
    try:
        with DeferredInterrupt() as interruption:
            for result in shots:
                if result.attrs["interrupted"]:
                    raise KeyboardInterrupt
                found.append(_without_gates(result))
                interruption.check()
    except (KeyboardInterrupt, RuntimeError) as error:
        if not is_interruption(error):
            raise
        if not found:
            raise KeyboardInterrupt from error
    series: xr.Dataset = xr.concat(
        found, "shot", data_vars="all", coords="different", compat="equals", combine_attrs="drop_conflicts"
    )
    series = series.assign_coords(shot=("shot", np.arange(len(found)), {"long_name": "number of the shot"}))
    for (name, (unit, text)), values in zip(_TRUTH.items(), truth, strict=True):
        series = series.assign_coords({name: ("shot", values[: len(found)], {"units": unit, "long_name": text})})
    attributes = merged_attributes([one.attrs for one in found])
    attributes |= {"shots": len(found), "interrupted": int(len(found) < len(pairs)), "moved_target": int(move_target)}
    own = {name: value for name, value in session.parameters.items() if attributes.get(f"scene.{name}") != value}
    attributes["series_parameters"] = json.dumps(own)
    if given is None:
        attributes["places_seed"] = seed
    if sea is not None:
        attributes["slope_deviation"] = [float(np.sqrt(np.mean(slopes**2))) for slopes in (sea.along, sea.across)]
    return series.assign_attrs(attributes)


def render_shots_again(series: xr.Dataset | str | os.PathLike[str], **options: Any) -> xr.Dataset:
    """Render a series of shots of `render_shots`, or its file, again: the same bits on the same machine.

    Parameters
    ----------
    series
        A complete series, or the shots that were completed before Ctrl-C.
    options
        Options of `render_shots` that change it; `params` are added to the parameters of its scene.

    Raises
    ------
    UserError
        If shots were selected or reordered, the series does not hold its scene, a file of the scene has changed, or an
        option is invalid.
    """
    from mitransient_lidar import results
    from mitransient_lidar.rendering.again import compare_versions

    found = series if isinstance(series, xr.Dataset) else results.open(series)
    attributes = found.attrs
    if "shot" not in found.dims or not np.array_equal(found["shot"], np.arange(attributes.get("shots", 0))):
        raise UserError("the dataset holds some shots of a series, which is rendered again as a whole: give all shots")
    compare_versions(attributes)
    given = {name: value for name, value in options.items() if value is not None}
    check_params(given.get("params"))
    # The bins of some shots are those of all of them.
    same = {} if "params" in given or "places" in given else {"axis": results.time_axis(found)}
    params = {**json_attribute(attributes, "series_parameters"), **given.pop("params", {})}
    own = {
        "places": np.column_stack([found["aim_x"], found["aim_y"]]),
        "passes": int(attributes["passes"]),
        "move_target": bool(attributes["moved_target"]),
    }
    return render_shots(SceneRecord.from_attributes(attributes), params, **{**own, **same, **given})


def describe_shots(series: xr.Dataset) -> list[str]:
    """Return the lines of a table of the shots of `render_shots`: places, truth and the highest power of a pixel."""
    peak = series["waveform"].max([dim for dim in series["waveform"].dims if dim != "shot"]).values
    lines = [f"{'shot':>5}{'x (m)':>10}{'y (m)':>10}{'along (deg)':>13}{'across (deg)':>14}{'height (m)':>12}"]
    lines[0] += f"{'bottom (m)':>12}{'peak (W)':>12}"
    columns = zip(series["shot"].values, *(series[name].values for name in _TRUTH), peak, strict=True)
    for shot, x, y, along, across, height, depth, power in columns:
        slopes = (math.degrees(math.atan(slope)) for slope in (along, across))
        line = f"{shot:>5}{x:>10.2f}{y:>10.2f}" + "{:>13.2f}{:>14.2f}".format(*slopes)
        lines.append(f"{line}{height:>12.3f}{depth:>12.3f}{power:>12.4g}")
    return lines


def merged_attributes(attributes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the attributes of a series: equal ones, and the merged ones of numbers that differ between shots.

    Seeds, poses and parameters of the scene that differ are left out.
    """
    merged: dict[str, Any] = {}
    for name, first in attributes[-1].items():
        values = [one.get(name) for one in attributes]
        if all(value == first for value in values) or name == "history":
            merged[name] = first
        elif name in _MERGED:
            merged[name] = float(_MERGED[name](values))
        elif name != "seed" and not name.startswith("scene.") and not name.endswith("_pose"):
            rows = [value if isinstance(value, list) else [value] for value in values]
            numbers = all(isinstance(item, (int, float)) for row in rows for item in row)
            if numbers and len({len(row) for row in rows}) == 1:
                mean = np.array(rows, dtype=np.float64).mean(axis=0).tolist()
                merged[name] = mean if isinstance(first, list) else mean[0]
    return merged


def _checked_places(places: npt.ArrayLike) -> FloatArray:
    """Return places [m], shape (shots, 2)."""
    pairs = finite_array("places", places)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not 1 <= len(pairs) <= 100_000:
        raise UserError(f"places of shape {pairs.shape} must be 1 to 100000 pairs (x, y)")
    if np.abs(pairs).max() > _FARTHEST:
        raise UserError(f"places holds {pairs.flat[np.abs(pairs).argmax()]:g} m; it must lie within {_FARTHEST:g} m")
    return pairs


def _target_offset(session: Session) -> tuple[float, float]:
    """Return the distance [m] from the aim to the target."""
    for name in ("target_x", "target_y", "aim_x", "aim_y"):
        if name not in session.parameters:
            raise UserError(f"scene {session.name} has no parameter {name}, which move_target needs")
    x, y = (float(session.parameters[f"target_{axis}"]) - float(session.parameters[f"aim_{axis}"]) for axis in "xy")
    return x, y


def _at(params: Mapping[str, Any] | None, x: float, y: float, target: tuple[float, float] | None) -> dict[str, Any]:
    """Return the parameters of a shot at a place [m]."""
    moved = {} if target is None else {"target_x": x + target[0], "target_y": y + target[1]}
    return {**(params or {}), "aim_x": x, "aim_y": y, **moved}


def _without_gates(result: xr.Dataset) -> xr.Dataset:
    """Return the waveforms of a result."""
    if "waveform" not in result:
        raise UserError("the scene needs too much memory for waveforms: reduce its pixels or bin_count")
    return result.drop_dims("gate", errors="ignore")


def _sea(scene: mi.Scene) -> Any:
    """Return the sea of an ``ocean_surface``, None without one."""
    return next((shape.sea for shape in scene.shapes() if hasattr(shape, "sea")), None)


def _has_waves(scene: mi.Scene) -> bool:
    sea = _sea(scene)
    return sea is not None and math.isfinite(sea.cell_size)


def _common_record(session: Session, lidar: LidarScene, places: FloatArray) -> TimeAxis | None:
    """Return time bins for the light of shots at places [m], None where the film has its own; log them."""
    from mitransient_lidar.transport.sensor.records import fitted_record

    film = session.sensor.film()
    if not film.used_values:
        return None
    aim = np.array([float(session.parameters[name]) for name in ("aim_x", "aim_y")])
    # Also at the scene's own place, where a target that moves with the shots is.
    shifts = [(0.0, 0.0), *map(tuple, places - aim)]
    axis, _ = fitted_record(lidar, lidar.transmitter, film, shifts)
    session.tell_record(axis)
    return axis


def _truth(session: Session, lidar: LidarScene, places: FloatArray) -> tuple[FloatArray, ...]:
    """Return the values of `_TRUTH` at places [m], shape (shots, 2)."""
    sea = np.array([footprint_means(_sea(session.scene), lidar.transmitter, x, y) for x, y in places])
    return *places.T, *sea.T, _bottom_depth(lidar, places)


def footprint_means(sea: Any, transmitter: Any, x: float, y: float) -> tuple[float, float, float]:
    """Return the slopes along the lidar's azimuth and to its left [1] and the height [m] at a place [m] of a sea.

    They are means over the beam's footprint on the mean sea level, an elliptic Gaussian, and 0 without waves.
    """
    if sea is None or not math.isfinite(sea.cell_size):
        return 0.0, 0.0, 0.0
    pose = transmitter.pose
    across = transmitter.widest_angular_spread * float(np.linalg.norm(pose.ground_point() - pose.origin))
    along = across / max(-float(pose.axis[2]), 1e-3)
    azimuth = math.atan2(pose.axis[1], pose.axis[0]) if math.hypot(*pose.axis[:2]) > 1e-9 else 0.0
    reach = max(math.ceil(_REACH * along / sea.cell_size), _FEWEST_CELLS)
    steps = np.arange(-reach, reach + 1)
    lines_x, lines_y = ((round(place / sea.cell_size) + steps) * sea.cell_size for place in (x, y))
    heights = sea.heights(lines_x, lines_y)
    up, right = np.gradient(heights, sea.cell_size)
    cos, sin = math.cos(azimuth), math.sin(azimuth)
    dx, dy = np.meshgrid(lines_x - x, lines_y - y)
    weight = np.exp(-0.5 * (((cos * dx + sin * dy) / along) ** 2 + ((cos * dy - sin * dx) / across) ** 2))
    weight /= weight.sum()
    values = (cos * right + sin * up, cos * up - sin * right, heights)
    slope_along, slope_across, height = (float(np.sum(weight * value)) for value in values)
    return slope_along, slope_across, height


def _bottom_depth(lidar: LidarScene, places: FloatArray) -> FloatArray:
    """Return the depth [m] of the largest solid where the axis of a shot at each place, refracted, meets it."""
    import mitsuba as mi

    solids: list[Any] = lidar.solids
    if not solids:
        return np.full(len(places), np.nan)
    bottom = max(solids, key=lambda solid: float(solid.bbox().max.x - solid.bbox().min.x))
    axis = lidar.receiver.pose.axis
    x, y = (float(part) / lidar.refractive_index for part in axis[:2])
    down = mi.Vector3f(x, y, -math.sqrt(1 - x * x - y * y))
    count = len(places)
    origin = mi.Point3f(*(mi.Float(column.astype(np.float32)) for column in places.T), mi.Float(np.zeros(count)))
    met = mi.load_dict({"type": "scene", "bottom": bottom}).ray_intersect(mi.Ray3f(origin, down))
    depth = -np.array(met.p.z, dtype=np.float64)
    # Rays in single precision are known to a tenth of a millimetre.
    return np.where(np.array(met.is_valid()), np.round(depth, 4), np.nan).astype(np.float64)
