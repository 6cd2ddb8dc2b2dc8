"""Shots at random places of one sea, kept whole, with the slopes and heights that each has met."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar import rendering, variants
from mitransient_lidar.loading import load_scene, readable_errors
from mitransient_lidar.optics.checks import whole
from mitransient_lidar.shots import SeaMap


def render_shots(
    scene: Any,
    params: Mapping[str, Any] | None = None,
    *,
    count: int = 200,
    passes: int = 8,
    seed: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Render shots at random places of one sea.

    Parameters
    ----------
    scene, params
        An XML scene with the parameters ``shot_x`` and ``shot_y``, and an ``ocean_surface`` with waves.
    count
        Number of shots, 2 to 100 000.
    passes
        Passes of each, 2 to 10 000.
    seed
        Seed of the places, at least 0; the same places for the same sea.
    progress
        Called with the shots done and planned.

    Returns
    -------
    xarray.Dataset
        Over ``shot``, pixel and ``time``: ``waveform`` and ``waveform_stderr`` [W]. Over ``shot``: ``shot_x``,
        ``shot_y`` [m], ``true_slope_along`` (positive for a face towards the lidar) and ``true_slope_across``, means
        over the beam's footprint [1]. Attributes: those of the last render; ``slope_deviation``, the standard
        deviations of the two slopes over the whole sea.

    Raises
    ------
    UserError
        When the scene is wrong or has no waves, or a number is out of range.
    """
    with readable_errors():
        count, passes = whole("count", count, 2, 100_000), whole("passes", passes, 2, 10_000)
        rng = np.random.default_rng(whole("seed", seed, 0, 2**53))
    variants.set_variant()
    sea = SeaMap.of_scene(load_scene(scene, params)[0])
    places = rng.uniform(sea.x[0], sea.x[-1], (count, 2))
    shots = []
    for number, (x, y) in enumerate(places):
        place = {**(params or {}), "shot_x": x, "shot_y": y}
        shots.append(rendering.render(scene, params=place, passes=passes, seed=number))
        if progress is not None:
            progress(number + 1, count)
    series = xr.concat([shot[["waveform", "waveform_stderr"]] for shot in shots], "shot", combine_attrs="override")
    along, across = np.array([sea.slope_at(x, y) for x, y in places]).T
    for name, values, unit in (
        ("shot_x", places[:, 0], "m"),
        ("shot_y", places[:, 1], "m"),
        ("true_slope_along", along, "1"),
        ("true_slope_across", across, "1"),
    ):
        series[name] = ("shot", values, {"units": unit})
    deviation = [float(np.sqrt(np.mean(slopes**2))) for slopes in (sea.along, sea.across)]
    return series.assign_coords(shot=np.arange(count)).assign_attrs({**shots[-1].attrs, "slope_deviation": deviation})
