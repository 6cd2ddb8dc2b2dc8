"""How often received light was scattered, and whether it turned once or several times: a scene's signal in parts."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar import rendering, variants
from mitransient_lidar.accuracy import PassStatistics
from mitransient_lidar.interruption import InterruptAfterPass
from mitransient_lidar.loading import load_scene, readable_errors
from mitransient_lidar.optics.checks import whole
from mitransient_lidar.optics.pulse import waveform
from mitransient_lidar.transport.sorting import MOST_ORDERS

_TURNS = ("one", "several")


def scattering_orders(
    scene: Any,
    params: Mapping[str, Any] | None = None,
    *,
    orders: int = 8,
    passes: int = 32,
    seed: int = 0,
    integrator: Any = None,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Render a scene and tell its light apart by the number of scattering events in the water.

    Light that only the sea, the bottom or a target has sent back is of order 0. Every echo changes at least once
    between going down and going up; light that did so three times or more came by several turns: scattered back down
    and up again, by way of the bottom twice, or reflected inside the surface.

    Parameters
    ----------
    scene, params, seed, integrator
        As for `rendering.render`.
    orders
        Orders to tell apart, 1 to 62: 0 to `orders` - 1, and all higher ones together.
    passes
        Number of passes, 2 to 100 000.
    progress
        Called with the passes done and planned.

    Returns
    -------
    xarray.Dataset
        ``impulse_response`` [J per bin] and ``waveform`` [W] with their standard errors, over ``pixel``, ``turns``
        (``one``, ``several``), ``order`` (the last stands for itself and all higher ones) and ``time`` [ns]. Summed
        over ``turns`` and ``order`` they are what `rendering.render` estimates. ``energy`` [J] of all pixels and times
        and its standard error, over ``turns`` and ``order``. After Ctrl-C it holds the passes done
        so far, and the attribute ``interrupted`` is 1.

    Raises
    ------
    UserError
        When the scene, a parameter or an option is wrong.
    ValueError
        When `orders` or `passes` is out of range.
    """
    orders = whole("orders", orders, 1, MOST_ORDERS)
    passes = whole("passes", passes, 2, 100_000)
    variants.set_variant()
    loaded, name, parameters = load_scene(scene, params)
    engine = rendering.choose_integrator(loaded, integrator)
    engine.sort_by_order(orders)
    sensor = rendering.first_sensor(loaded)
    with readable_errors():
        system, _ = engine.prepare(loaded, sensor)
    film, pixels = system.film, system.receiver.pixels
    kernel = system.transmitter.pulse.kernel(film.bin_width_ns, system.receiver.optics.response_time_ns)
    shape = (pixels.count, len(_TURNS), orders + 1, film.bin_count)
    energy, power, whole_record = PassStatistics(), PassStatistics(), PassStatistics()
    interrupted = False
    try:
        with InterruptAfterPass() as interruption:
            for number in range(passes):
                with readable_errors():
                    engine.render(loaded, sensor, seed=rendering.pass_seed(seed, number), develop=False)
                histogram = film.energy()
                energy.add(histogram)
                whole_record.add(histogram.reshape(shape).sum(axis=(0, 3)))
                power.add(waveform(histogram, film.bin_width_ns, kernel))
                if progress is not None:
                    progress(number + 1, passes)
                if energy.count > 1:
                    interruption.check()
    except KeyboardInterrupt:
        if energy.count < 2:
            raise
        interrupted = True
    finally:
        engine.release()
        engine.sort_by_order(0)
    dims = ("pixel", "turns", "order", "time")
    time = film.time_start_ns + film.bin_width_ns * (np.arange(film.bin_count) + 0.5)
    data = {
        "impulse_response": (dims, energy.mean.reshape(shape), {"units": "J", "long_name": "received energy per bin"}),
        "impulse_response_stderr": (dims, energy.stderr.reshape(shape), {"units": "J"}),
        "waveform": (dims, power.mean.reshape(shape), {"units": "W", "long_name": "received power"}),
        "waveform_stderr": (dims, power.stderr.reshape(shape), {"units": "W"}),
        # Bins of a pass share paths: the errors of sums over them come from the passes, not from the bins' errors.
        "energy": (dims[1:3], whole_record.mean, {"units": "J", "long_name": "received energy"}),
        "energy_stderr": (dims[1:3], whole_record.stderr, {"units": "J"}),
    }
    coords = {
        "pixel": list(pixels.names),
        "turns": list(_TURNS),
        "order": ("order", np.arange(orders + 1), {"long_name": "scattering events; the last, and more"}),
        "time": ("time", time, {"units": "ns"}),
    }
    attributes = {
        "scene": name,
        **variants.versions(),
        "integrator": engine.plugin,
        "seed": int(seed),
        "passes": energy.count,
        "interrupted": int(interrupted),
        **{f"scene.{key}": value for key, value in parameters.items()},
    }
    return xr.Dataset(data, coords=coords, attrs=attributes)


def shares(result: xr.Dataset) -> list[tuple[str, float, float, float, float]]:
    """Return order, energy and its standard error [J], share of the whole, and of that order by several turns.

    Parameters
    ----------
    result
        What `scattering_orders` returned.

    Returns
    -------
    list
        One row an order and a last one for all; NaN where there is no light. Errors of sums are taken as if those of
        the parts were of one sign, the largest that they can be.
    """
    energy, stderr = result["energy"].values, result["energy_stderr"].values
    total = energy.sum()
    last = int(result["order"][-1])
    names = [*(str(order) for order in range(last)), f">={last}", "all"]
    columns = np.column_stack([energy, energy.sum(axis=1)])
    errors = np.append(stderr.sum(axis=0), stderr.sum())
    rows = []
    for name, (one, several), error in zip(names, columns.T, errors, strict=True):
        both = one + several
        rows.append((name, float(both), float(error), _share(both, total), _share(several, both)))
    return rows


def _share(part: float, whole_: float) -> float:
    return float(part / whole_) if whole_ > 0 else float("nan")


def plot_orders(result: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Draw power against time by order of scattering, and the share of several turns, both over all pixels.

    Parameters
    ----------
    result
        What `scattering_orders` returned.
    path
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.

    Raises
    ------
    UserError
        When the file cannot be written.
    """
    import matplotlib
    from matplotlib.figure import Figure

    from mitransient_lidar.plotting import check_format
    from mitransient_lidar.results import replacing

    check_format(Path(path))
    time = result["time"].values
    by_order = result["waveform"].sum(("pixel", "turns")).values
    total = by_order.sum(axis=0)
    several = result["waveform"].sel(turns="several").sum(("pixel", "order")).values
    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    colours = matplotlib.colormaps["viridis"](np.linspace(0, 0.92, len(by_order)))
    upper.plot(time, total, color="black", linewidth=1.6, label="all")
    for name, power, colour in zip((row[0] for row in shares(result)), by_order, colours, strict=False):
        upper.plot(time, power, color=colour, linewidth=1.1, label=name.replace(">=", "\u2265 "))
    upper.set_yscale("log")
    upper.set_ylim(1e-5 * total.max(), 2 * total.max())
    upper.set_ylabel("power (W)")
    upper.legend(title="scattering events", frameon=False, ncols=2, fontsize="small")
    lit = total > 1e-5 * total.max()
    lower.plot(time[lit], 100 * several[lit] / total[lit], color="#b3421f", linewidth=1.2)
    lower.set_ylabel("by several turns (%)")
    lower.set_xlabel("time (ns)")
    lower.set_ylim(bottom=0)
    for ax in (upper, lower):
        ax.grid(True, color="0.9", linewidth=0.7)
    upper.set_title(str(result.attrs.get("scene", "")))
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=160)
