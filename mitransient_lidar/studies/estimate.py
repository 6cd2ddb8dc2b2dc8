"""Fast estimate of the waveforms of a scene over a level sea."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import xarray as xr

from mitransient_lidar.core.options import Instrument, Option, Scene, Seed, checked
from mitransient_lidar.core.tables.written import table_lines
from mitransient_lidar.loading.exclusive import alone
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.rendering.accumulators import PassAccumulator
from mitransient_lidar.rendering.accuracy import ErrorWindow

#: Independent passes, for standard errors.
_PASSES = 8

#: Largest number of paths.
_MOST_PATHS = 2**22


@checked
@alone
def estimate(
    scene: Scene,
    params: Mapping[str, Any] | None = None,
    *,
    instrument: Instrument = None,
    paths: Annotated[int, Option("Number of paths of the light", 64, _MOST_PATHS)] = 2**13,
    seed: Seed = 0,
) -> xr.Dataset:
    """Estimate the waveforms of a scene in about a second, as a first look and a second opinion.

    Parameters
    ----------
    scene, params
        As for `rendering.render.render`.

    Returns
    -------
    xarray.Dataset
        As of `rendering.render.render` with ``components``.

    Raises
    ------
    UserError
        If the scene is invalid, or not one that light maps are for (`transport.light_maps.renderer.unsuited`); if a
        number is out of range.

    Notes
    -----
    Light is looked up in maps of the beam (`transport.light_maps.renderer`). The sea is level, with all of its slopes
    as ripples, so that the result is a mean over seas, enhanced by the focusing of all waves
    (`physics.sea.double_passage`). Light that turns more than once between down and up is missing, as are the sides
    and shadows of solids.
    """
    session = open_scene(scene, params, instrument=instrument)
    from mitransient_lidar.rendering.describe import describe_scene, with_lines_of_sight
    from mitransient_lidar.transport.light_maps.renderer import LightMapRenderer
    from mitransient_lidar.transport.paths.path_classes import PathClasses
    from mitransient_lidar.transport.scene_parts import find_lidar_scene

    lidar = find_lidar_scene(session.scene, session.sensor)
    renderer = LightMapRenderer(lidar, PathClasses(), level=True).by_origin()
    session.tell_axis(lidar.axis, lidar.record_end)
    window = ErrorWindow.of_probe(renderer.probe)
    accumulator = PassAccumulator(lidar, window, origins=renderer.classes.names)
    for number in np.random.SeedSequence(seed).generate_state(_PASSES):
        accumulator.add(renderer.render_pass(int(number), paths=paths // _PASSES).histogram)
    accumulator.require_light(_PASSES)
    described = describe_scene(renderer.probe, window, renderer.focusing)
    attributes = session.attributes(lidar, model="estimate", paths=paths, seed=seed, **described)
    return with_lines_of_sight(accumulator.dataset(attributes), lidar)


def describe_estimate(found: xr.Dataset) -> list[str]:
    """Return the lines of a table of a result of `estimate`: energy, and peak power with its time, by origin."""
    energy, power = found["impulse_response_by_origin"], found["waveform_by_origin"]
    over = [dim for dim in power.dims if dim not in ("origin", "time")]
    columns = (("all pixels", "<12"), ("energy (J)", ">12.3e"), ("peak (W)", ">12.3e"), ("at (ns)", ">10.1f"))
    rows = []
    for name in found["origin"].values:
        received, curve = float(energy.sel(origin=name).sum()), power.sel(origin=name).sum(over)
        peak = (float(curve.max()), float(curve["time"][int(np.argmax(curve.values))]))
        rows.append((str(name), received, *(peak if received > 0 else ())))
    return table_lines(columns, rows)
