"""Scattered light: by scattering order, in several fields of view, and as the spread of the beam."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.information.errors import jackknife_error
from mitransient_lidar.analysis.retrieval.column_retrieval import BEAM_EDGE, ColumnBins
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import (
    Instrument,
    Numbers,
    Option,
    Scene,
    Seed,
    checked,
    positive_option,
    refuse_unused,
)
from mitransient_lidar.core.tables.written import table_lines
from mitransient_lidar.core.validation import FloatArray, integer, shown
from mitransient_lidar.loading.catalogue import scene_path
from mitransient_lidar.loading.document import read_document
from mitransient_lidar.loading.parameters import plugins_of
from mitransient_lidar.loading.scenes import LoadedScene, choose_integrator, open_scene
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.physics.lidar.axis_limits import system_attenuation
from mitransient_lidar.physics.lidar.level_sea import LidarGeometry
from mitransient_lidar.physics.lidar.pulse import waveform
from mitransient_lidar.physics.water.water_types import InherentProperties
from mitransient_lidar.rendering.accuracy import PassStatistics
from mitransient_lidar.rendering.passes import Goal, PassLog, ProgressCallback, run_passes, warn_of_edge_loss
from mitransient_lidar.results.attributes import label
from mitransient_lidar.studies.beam_spread import beam_spread, describe_spread
from mitransient_lidar.transport.medium.water_phases import table_of
from mitransient_lidar.transport.paths.passes import MOST_ORDERS, PathClasses
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.scene_parts import find_lidar_scene
from mitransient_lidar.transport.sensor.fov_shapes import Sector
from mitransient_lidar.transport.sensor.pixels import ShapedPixels
from mitransient_lidar.transport.sensor.receiver import Receiver

_REVERSALS = ("one", "several")


@checked
@alone
def scattering(
    scene: Scene,
    params: Mapping[str, Any] | None = None,
    *,
    orders: Annotated[
        int | None, Option("Scattering orders to separate, 8 unless depths or views are given", 1, MOST_ORDERS)
    ] = None,
    depths: Annotated[
        Numbers | None,
        Option("Spread of the beam at depths below the mean sea level", 0, unit="m", above=True, form="N,N,..."),
    ] = None,
    fov_mrad: Annotated[
        Numbers | None,
        Option("Attenuation in fields of view, by full angles", 0, unit="mrad", above=True, form="N,N,..."),
    ] = None,
    instrument: Instrument = None,
    min_depth: Annotated[
        float, Option("Depth where the attenuation of a view begins, below the surface echo", 0, unit="m")
    ] = 1.0,
    max_depth: Annotated[
        float, positive_option("Depth where it ends, below --min-depth, above bottom and targets", "m")
    ] = 5.0,
    passes: Annotated[
        int | None,
        Option(
            "Independent passes per render, by default 32 for orders, 8 for depths, and 48, at least 4, for views",
            *(2, 100_000),
        ),
    ] = None,
    photons: Annotated[int, Option("Photons per pass, for depths", 1024, 2**24)] = 2**16,
    max_time: Annotated[
        float | None,
        positive_option("Stop before this many seconds, with fewer passes, or without the widest fields of view"),
    ] = None,
    seed: Seed = 0,
    integrator: Any = None,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Measure scattering: light by its order, spread of the beam with depth, or attenuation in several fields of view.

    Parameters
    ----------
    scene, params, instrument
        As for `rendering.render.render`.
    orders, depths, fov_mrad
        Alternatives; by default the light of 8 orders.

    Returns
    -------
    xarray.Dataset
        As from `scattering_orders`, `beam_spread.beam_spread` or `fov_sweep`.

    Raises
    ------
    UserError
        If the scene is invalid, a number is out of range, or as for these functions.
    """
    wanted = {"orders": orders, "depths": depths, "fov_mrad": fov_mrad}
    named = [f"{name} = {shown(value)}" for name, value in wanted.items() if value is not None]
    if len(named) > 1:
        raise UserError(f"{' and '.join(named)} are alternatives: give one of them")
    if depths is None:
        refuse_unused(scattering, "needs depths", photons=photons)
    if fov_mrad is None:
        refuse_unused(scattering, "needs fov_mrad", min_depth=min_depth, max_depth=max_depth)
    else:
        passes, params = integer("passes", passes or 48, 4, 100_000), _with_widest(scene, params, float(max(fov_mrad)))
    session = open_scene(scene, params, instrument)
    if depths is not None:
        return beam_spread(session, depths, photons, Goal(passes=passes or 8, max_time=max_time), seed, progress)
    goal = Goal(passes=passes or 32, max_time=max_time)
    if fov_mrad is not None:
        return fov_sweep(session, np.unique(fov_mrad), (min_depth, max_depth), goal, seed, progress)
    return scattering_orders(session, orders or 8, goal, seed, integrator, progress)


def describe_scattering(found: xr.Dataset) -> list[str]:
    """Return table lines for a result of `scattering`."""
    if "depth" in found.dims:
        return describe_spread(found)
    return describe_fov_sweep(found) if "field_of_view" in found.dims else describe_orders(found)


def scattering_orders(
    session: LoadedScene, orders: int, goal: Goal, seed: int, integrator: Any, progress: ProgressCallback | None
) -> xr.Dataset:
    """Render a scene and separate its light by the number of scattering events in the water.

    Light reflected only by the sea, the bottom or a target is of order 0. The vertical direction of every echo is
    reversed at least once, and three times or more by scattering, a second reflection, or reflection inside the
    surface. Arguments as of `scattering`.

    Result: ``impulse_response`` [J per bin] and ``waveform`` [W] with their standard errors, over ``pixel``,
    ``reversals`` (``one``, ``several``), ``order`` (the last includes all higher ones) and ``time`` [ns]; their sums
    over ``reversals`` and ``order`` equal `rendering.render.render`. ``energy`` [J] over all pixels and times and its
    standard error, over ``reversals`` and ``order``. After Ctrl-C it includes the completed passes, and the attribute
    ``interrupted`` is 1. Raises `UserError` if the scene or a parameter is invalid or out of range.
    """
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

    log = run_passes(render_pass, goal, seed=seed, progress=progress)
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


logger = logging.getLogger(__name__)


def fov_sweep(
    session: LoadedScene,
    fields: FloatArray,
    limits: tuple[float, float],
    goal: Goal,
    seed: int,
    progress: ProgressCallback | None,
) -> xr.Dataset:
    """Measure the column signal's attenuation as a function of the field of view.

    One circle about the axis replaces the pixels. The largest circle replaces an XML scene's parameter
    ``field_of_view_mrad``, which determines the size of the surface. `fields` are full angles [mrad], increasing; the
    fit's two `limits` [m] lie in homogeneous water and far from bottom and targets.

    Result: over ``field_of_view`` [mrad], increasing: ``effective_attenuation`` K and its standard error
    ``effective_attenuation_stderr`` [1/m], ``spot_radius`` R_s [m] of the circle that the receiver sees across the axis
    where that meets the mean surface, ``scaled_radius`` c R_s [1], ``system_attenuation`` [1/m] by the fit in
    `system_attenuation`. Over ``field_of_view`` and ``time`` [ns]: ``impulse_response`` [J per bin] and its standard
    error. Attributes: ``attenuation`` c, ``absorption`` a, ``a_plus_bb``, ``kd`` [1/m] of the water, ``beam_radius``
    R_b [m], and ``left_out_mrad``, as text the fields of view that time or Ctrl-C has left out. Raises `UserError` if
    the scene is invalid, has no water, bubbles, or several layers between the depths, a solid's echo can overlap with
    them, a number is out of range, or as for `ColumnBins`.

    Gordon (1982), Appl. Opt. 21, 2996, doi:10.1364/AO.21.002996: for a narrow beam, K is c for c R_s far below 1, and
    falls to the diffuse attenuation at c R_s above 5 to 6. The signal depends on the correlation between the profiles
    of beam and field of view, so that both widths have the same effect. R = sqrt(R_s^2 + R_b^2) is the radius of a disc
    with the correlation's mean-square radius; R_b is twice the beam's root-mean-square angle per axis times the slant
    range. The diameter in the fit is 2 R. K approaches c only if c R_b is also far below 1.

    ``kd`` is the depth-averaged Kd for daylight (`water_types`), and bb belongs to the phase function in use.

    For the default water and a narrow beam on a level sea, K falls like Gordon's until c R_s = 3. But it falls to the
    absorption coefficient (0.149 for a = 0.150 1/m), as found by Phillips and Koerber (1984), Aust. J. Phys. 37, 75, 12
    % below Kd. Because of the forward peak, K stays below c in any practical view: 0.91 c at c R_s = 0.015. The fit,
    which is independent of the phase function, is up to 0.06 1/m too high between the limits.

    Rings between neighbouring circles are rendered and added up, since rare paths near the middle would cause most of
    the noise. Errors in neighbouring circles are therefore correlated. They are jackknife estimates over the passes,
    which include the correlation between bins.
    """
    assert goal.passes is not None
    (min_depth, max_depth), passes = limits, goal.passes
    lidar = find_lidar_scene(session.scene, session.sensor)
    geometry, edge = _geometry(lidar, 0.5e-3 * float(fields[-1]))
    column = ColumnBins.between(geometry, edge, lidar.axis, min_depth, max_depth)
    water = _water(lidar, min_depth, max_depth)
    _check_solids(lidar, geometry, edge, max_depth)
    energy, log = _render(session, fields, goal, seed, progress)
    left_out = ", ".join(f"{field:g}" for field in fields[len(energy) :])
    if left_out:
        logger.warning("fields of view of %s mrad are left out: their passes are not complete", left_out)
    fields = fields[: len(energy)]

    mean, stderr = energy.mean(axis=1), energy.std(axis=1, ddof=1) / math.sqrt(passes)
    slopes = [slope_and_error(column, energy[field][:, column.inside]) for field in range(fields.size)]
    radius = 0.5e-3 * fields * geometry.slant_range
    beam = 2 * lidar.transmitter.widest_angular_spread * geometry.slant_range
    # Kd is above c for nearly isotropic scattering, where the fit is not defined.
    fit = system_attenuation(water.attenuation, min(water.kd, water.attenuation), 2 * np.hypot(radius, beam))
    per_field = {
        "effective_attenuation": [slope for slope, _ in slopes],
        "effective_attenuation_stderr": [error for _, error in slopes],
        "spot_radius": radius,
        "scaled_radius": water.attenuation * radius,
        "system_attenuation": fit,
    }
    data: dict[str, Any] = {key: ("field_of_view", np.asarray(values)) for key, values in per_field.items()}
    over_time = ("field_of_view", "time")
    data |= {"impulse_response": (over_time, mean), "impulse_response_stderr": (over_time, stderr)}
    coords = {"field_of_view": fields, "time": lidar.axis.centres_ns}
    attributes = session.attributes(
        lidar,
        seed=seed,
        passes=passes,
        interrupted=int(log.interrupted),
        min_depth=min_depth,
        max_depth=max_depth,
        attenuation=water.attenuation,
        absorption=water.absorption,
        a_plus_bb=water.absorption + water.backscattering,
        kd=water.kd,
        beam_radius=beam,
        left_out_mrad=left_out,
    )
    return label(xr.Dataset(data, coords, attributes))


def describe_fov_sweep(found: xr.Dataset) -> list[str]:
    """Return table lines for a result of `fov_sweep`."""
    columns = {
        "field_of_view": ("field of view", ">13g"),
        "spot_radius": ("R_s", ">9.3g"),
        "scaled_radius": ("c R_s", ">8.3f"),
        "effective_attenuation": ("K", ">9.4f"),
        "effective_attenuation_stderr": ("+-", ">9.4f"),
        "system_attenuation": ("fit", ">9.4f"),
    }
    units = ("(mrad)", "(m)", "", "(1/m)", "(1/m)", "(1/m)")
    rows = zip(*(found[name].values for name in columns), strict=True)
    lines = table_lines([*columns.values()], [units, *rows])
    names = {"c": "attenuation", "Kd": "kd", "a + bb": "a_plus_bb", "a": "absorption"}
    limits = ", ".join(f"{symbol} = {found.attrs[name]:.4f}" for symbol, name in names.items())
    lines.append(f"{limits} 1/m; radius of the beam {found.attrs['beam_radius']:.3g} m")
    return lines


def _with_widest(scene: Any, params: Mapping[str, Any] | None, widest: float) -> Mapping[str, Any] | None:
    """Return the parameters with the widest field of view, if it is a scene parameter."""
    if not isinstance(scene, (str, os.PathLike)) or not isinstance(params or {}, Mapping):
        return params
    document, name = read_document(scene_path(scene)), "field_of_view_mrad"
    # Pixels within a receiver have their own views, in place of the receiver's.
    own = [
        one
        for one in plugins_of(document)
        if one.element.tagName == "sensor" and one.element.parentNode is document.root
    ]
    return {**(params or {}), name: widest} if any(one.value(one.declared[name]) for one in own) else params


def _geometry(lidar: LidarScene, half_view: float) -> tuple[LidarGeometry, float]:
    """Return the geometry, and the beam's edge within a half angle [rad]; reject a view of the horizon."""
    geometry = LidarGeometry.of_pose(lidar.receiver.pose, lidar.refractive_index, lidar.group_index)
    widest = 2e3 * math.tan(0.5 * math.pi - geometry.off_nadir)
    if 2e3 * half_view >= widest:
        raise UserError(f"fov_mrad = {2e3 * half_view:g} must be less than {widest:.4g}: it would reach the horizon")
    edge = min(BEAM_EDGE * lidar.transmitter.widest_angular_spread, half_view)
    return geometry, edge


def _water(lidar: LidarScene, min_depth: float, max_depth: float) -> InherentProperties:
    """Return the water between two depths [m]; reject several layers."""
    water = lidar.required_water
    if water.plume is not None:
        raise UserError(
            "the scene has bubbles: the slope needs the same water everywhere, plume_scattering = 0 and "
            "bubble_wind_speed = 0"
        )
    layer, last = (int(number) for number in water.column.layer_at([min_depth, max_depth]))
    if layer != last:
        raise UserError(
            f"the water has {last - layer + 1} layers from min_depth = {min_depth:g} m to max_depth = {max_depth:g} m: "
            "it must be the same between them"
        )
    scattering = float(water.column.scattering[layer])
    ratio = table_of(water.phases.phases[layer]).backscatter_ratio
    return InherentProperties(float(water.column.absorption[layer]), scattering, ratio * scattering)


def _check_solids(lidar: LidarScene, geometry: LidarGeometry, edge: float, max_depth: float) -> None:
    """Reject a bottom or target whose echo can begin above a depth [m]."""
    # The shortest path to a level bottom is shorter by cos^2 than that along the axis.
    for solid in lidar.solids:
        begin = -float(solid.bbox().max.z) * geometry.cos_water**2 - geometry.surface_depth(edge)
        if max_depth > begin:
            raise UserError(
                f"max_depth = {max_depth:g} m must be at most {begin:.3g} m, where the echo of {solid.id()!r} can begin"
            )


def _render(
    session: LoadedScene, fields: FloatArray, of_field: Goal, seed: int, progress: ProgressCallback | None
) -> tuple[FloatArray, PassLog]:
    """Return the energy [J] in circles with full angles [mrad], shape (fields, passes, bins), and the log.

    `of_field` has the passes for a field of view, and the time for all.
    """
    assert of_field.passes is not None
    passes, chosen = of_field.passes, choose_integrator(session.scene, None)
    receiver: Receiver = session.sensor.receiver
    edges = np.append(0.0, 0.5e-3 * fields)
    rings: list[FloatArray] = []
    renderer: Any = None

    def render_pass(number: int, seed: int) -> float:
        nonlocal renderer
        if number % passes == 0:
            inner, outer = edges[number // passes : number // passes + 2]
            ring = replace(receiver, pixels=ShapedPixels([Sector(outer, inner)], ["ring"]))
            renderer = chosen.prepare(session.scene, session.sensor, receiver=ring)
        record = renderer.render_pass(seed)
        rings.append(record.histogram.energy()[0])
        return float(record.edge_loss)

    goal = replace(of_field, passes=fields.size * passes)
    log = run_passes(render_pass, goal, seed=seed, smallest=passes, progress=progress)
    complete = log.count // passes
    energy = np.array(rings[: complete * passes]).reshape(complete, passes, -1)
    warn_of_edge_loss(log.edge_loss_share(float(energy.sum())))
    return np.cumsum(energy, axis=0), log


def slope_and_error(column: ColumnBins, energy: FloatArray) -> tuple[float, float]:
    """Return K and its standard error over the passes [1/m], from energies of shape (passes, bins)."""
    passes, total = len(energy), energy.sum(axis=0)
    weights, _ = column.weights(total / passes, energy.std(axis=0, ddof=1) / math.sqrt(passes))
    left_out = total - energy
    if np.any(left_out <= 0):
        raise UserError(f"the signal of a bin is that of a single one of {passes} passes: render more passes")
    slopes = np.log(left_out / column.gain) @ weights
    return float(weights @ np.log(total / column.gain)), jackknife_error(slopes)
