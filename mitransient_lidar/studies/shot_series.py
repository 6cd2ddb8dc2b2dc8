"""Shots at random places of one sea, with the slopes of the surface there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar.core.validation import integer
from mitransient_lidar.rendering.passes import Progress, ProgressCallback
from mitransient_lidar.rendering.render import render
from mitransient_lidar.rendering.session import open_scene
from mitransient_lidar.studies.find_shots import SeaMap, Shot


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
    places = np.random.default_rng(seed).uniform(sea.x[0], sea.x[-1], (count, 2))
    for number, (x, y) in enumerate(places):
        result = render(scene, params={**(params or {}), "aim_x": x, "aim_y": y}, passes=passes, seed=number)
        if progress is not None:
            progress(Progress(number + 1, count, "shot"))
        yield Shot("random", x, y, *sea.slope_at(x, y)), result


def render_shots(
    scene: Any,
    params: Mapping[str, Any] | None = None,
    *,
    count: int = 200,
    passes: int = 8,
    seed: int = 1,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Render shots at random places of one sea.

    Parameters
    ----------
    scene, params
        An XML scene with the parameters ``aim_x`` and ``aim_y``, and an ``ocean_surface`` with waves.
    count
        Number of shots, 2 to 100 000.
    passes
        Passes of each shot, 2 to 10 000.
    seed
        Seed of the places, at least 0.
    progress
        Called with a `passes.Progress` after every shot.

    Returns
    -------
    xarray.Dataset
        Over ``shot``, pixel and ``time``: ``waveform`` and ``waveform_stderr`` [W]. Over ``shot``: ``aim_x``,
        ``aim_y`` [m], ``true_slope_along`` (positive for a face towards the lidar) and ``true_slope_across``, means
        over the beam's footprint [1]. Attributes: those of the last render; ``slope_deviation``, the standard
        deviations of the two slopes of the sea.

    Raises
    ------
    UserError
        If the scene is invalid or has no waves, or a number is out of range.
    """
    count, passes = integer("count", count, 2, 100_000), integer("passes", passes, 2, 10_000)
    seed = integer("seed", seed, 0, 2**53)
    sea = SeaMap.of_scene(open_scene(scene, params).scene)
    drawn = random_shots(scene, params, sea, count=count, passes=passes, seed=seed, progress=progress)
    shots, rendered = zip(*drawn, strict=True)
    kept = [result[["waveform", "waveform_stderr"]] for result in rendered]
    series: xr.Dataset = xr.concat(kept, "shot", combine_attrs="override")
    numbers = np.array([(shot.x, shot.y, shot.along, shot.across) for shot in shots]).T
    names = ("aim_x", "aim_y", "true_slope_along", "true_slope_across")
    for name, values, unit in zip(names, numbers, ("m", "m", "1", "1"), strict=True):
        series[name] = ("shot", values, {"units": unit})
    deviation = [float(np.sqrt(np.mean(slopes**2))) for slopes in (sea.along, sea.across)]
    attributes = {**rendered[-1].attrs, "slope_deviation": deviation}
    return series.assign_coords(shot=np.arange(count)).assign_attrs(attributes)
