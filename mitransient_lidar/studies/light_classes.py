"""Light of a scene by its origin, estimated over a level sea, and rendered by its order of scattering."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import xarray as xr

from mitransient_lidar.core.options import FewerPasses, Instrument, Option, Scene, Seed, checked
from mitransient_lidar.core.tables.written import table_lines
from mitransient_lidar.loading.scenes import choose_integrator, open_scene
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.physics.lidar.pulse import waveform
from mitransient_lidar.rendering.accumulators import PassAccumulator
from mitransient_lidar.rendering.accuracy import ErrorWindow, PassStatistics
from mitransient_lidar.rendering.describe import describe_scene, with_lines_of_sight
from mitransient_lidar.rendering.passes import Goal, ProgressCallback, run_passes, warn_of_edge_loss
from mitransient_lidar.results.attributes import label
from mitransient_lidar.transport.light_maps.renderer import LightMapRenderer
from mitransient_lidar.transport.paths.passes import MOST_ORDERS, PathClasses
from mitransient_lidar.transport.scene_parts import find_lidar_scene

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


_REVERSALS = ("one", "several")


@checked
@alone
def scattering_orders(
    scene: Scene,
    params: Mapping[str, Any] | None = None,
    *,
    instrument: Instrument = None,
    orders: Annotated[int, Option("Number of orders to separate", 1, MOST_ORDERS)] = 8,
    passes: Annotated[int, Option("Number of independent passes per render", 2, 100_000)] = 32,
    max_time: FewerPasses = None,
    seed: Seed = 0,
    integrator: Any = None,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Render a scene and separate its light by the number of scattering events in the water.

    Light reflected only by the sea, the bottom or a target is of order 0. The vertical direction of every echo is
    reversed at least once, and three times or more by scattering, a second reflection, or reflection inside the
    surface.

    Returns
    -------
    xarray.Dataset
        ``impulse_response`` [J per bin] and ``waveform`` [W] with their standard errors, over ``pixel``, ``reversals``
        (``one``, ``several``), ``order`` (the last includes all higher ones) and ``time`` [ns]; their sums over
        ``reversals`` and ``order`` equal `rendering.render.render`. ``energy`` [J] over all pixels and times and its
        standard error, over ``reversals`` and ``order``. After Ctrl-C it includes the completed passes, and the
        attribute ``interrupted`` is 1.

    Raises
    ------
    UserError
        If the scene or a parameter is invalid or out of range.
    """
    session = open_scene(scene, params, instrument)
    chosen = choose_integrator(session.scene, integrator)
    renderer = chosen.prepare(session.scene, session.sensor, classes=PathClasses(orders))
    lidar = renderer.scene
    axis, pixels = lidar.axis, lidar.receiver.pixels
    kernel = lidar.transmitter.pulse.kernel(axis.bin_width_ns, lidar.receiver.optics.response_time_ns)
    shape = (pixels.count, len(_REVERSALS), orders + 1, axis.bin_count)
    energy, power, totals = PassStatistics(), PassStatistics(), PassStatistics()

    def render_pass(number: int, seed: int) -> float:
        record = renderer.render_pass(seed)
        histogram = record.histogram.energy()
        energy.add(histogram)
        totals.add(histogram.reshape(shape).sum(axis=(0, 3)))
        power.add(waveform(histogram, axis.bin_width_ns, kernel))
        return record.edge_loss

    log = run_passes(render_pass, Goal(passes=passes, max_time=max_time), seed=seed, progress=progress)
    warn_of_edge_loss(log.edge_loss_share(float(np.nansum(totals.mean)) * log.count))
    dims = ("pixel", "reversals", "order", "time")
    data = {
        "impulse_response": (dims, energy.mean.reshape(shape)),
        "impulse_response_stderr": (dims, energy.stderr.reshape(shape)),
        "waveform": (dims, power.mean.reshape(shape)),
        "waveform_stderr": (dims, power.stderr.reshape(shape)),
        # Errors of sums are estimated from the passes, since bins in a pass share paths.
        "energy": (dims[1:3], totals.mean),
        "energy_stderr": (dims[1:3], totals.stderr),
    }
    coords = {
        "pixel": list(pixels.names),
        "reversals": list(_REVERSALS),
        "order": np.arange(orders + 1),
        "time": axis.centres_ns,
    }
    attributes = session.attributes(lidar, chosen, **log.attributes(seed))
    return label(xr.Dataset(data, coords=coords, attrs=attributes), "orders")


def describe_orders(result: xr.Dataset) -> list[str]:
    """Return table lines for a result of `scattering_orders`: one for each order, and one for all.

    Energy and its standard error [J], share of all light, and share with several reversals, NaN without light. The
    error of a sum is the sum of the errors, its upper bound.
    """
    energy, stderr = result["energy"].values, result["energy_stderr"].values
    last = int(result["order"][-1])
    names = [*(str(order) for order in range(last)), f">={last}", "all"]
    one, several = np.column_stack([energy, energy.sum(axis=1)])
    errors = np.append(stderr.sum(axis=0), stderr.sum())
    both = one + several
    with np.errstate(invalid="ignore"):
        shares = 100 * both / both[-1], 100 * several / both
    known = [f"{value:.3e} +- {error:.0e}" for value, error in zip(both, errors, strict=True)]
    columns = (("order", "<8"), ("energy (J)", ">22"), ("share (%)", ">12.3f"), ("several reversals (%)", ">24.3f"))
    return table_lines(columns, zip(names, known, *shares, strict=True))
