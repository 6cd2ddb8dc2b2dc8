"""How the slope of a lidar's column signal goes with the field of view: from c down to a (Gordon 1982)."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar import rendering, resources, variants
from mitransient_lidar.column_slope import BEAM_EDGE, ColumnBins, LidarGeometry
from mitransient_lidar.errors import UserError
from mitransient_lidar.loading import load_scene, readable_errors
from mitransient_lidar.optics.checks import FloatArray, finite_array, whole
from mitransient_lidar.optics.known_waters import InherentProperties
from mitransient_lidar.optics.system_attenuation import system_attenuation

if TYPE_CHECKING:
    import mitsuba as mi

    from mitransient_lidar.transport.system import LidarScene

logger = logging.getLogger(__name__)

#: Share of the energy lost at the border of the surface patch above which a warning is given.
_TOLERATED_LOSS = 1e-3


def views(
    scene: Any,
    fields_of_view_mrad: npt.ArrayLike,
    params: Mapping[str, Any] | None = None,
    *,
    from_depth: float = 1.0,
    to_depth: float = 5.0,
    passes: int = 48,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Measure how the slope of the column signal goes with the field of view.

    Parameters
    ----------
    scene, params
        What `rendering.render` takes. The receiver's pixels are replaced by one circle about the axis, and an XML
        scene's ``field_of_view_mrad``, for which waves are laid out, by the largest of the fields.
    fields_of_view_mrad
        Full angles of the circles [mrad], above 0, in any order.
    from_depth, to_depth
        Between which depths the slope is measured, as in `effective_attenuation` [m]. The water must be the same
        between them, and no bottom or target near.
    passes
        Independent passes for each field of view, 4 to 10 000.
    seed
        Seed of the random numbers, at least 0.
    progress
        Called with the passes done and planned.

    Returns
    -------
    xarray.Dataset
        Over ``field_of_view`` [mrad], increasing: ``effective_attenuation`` K and its standard error
        ``effective_attenuation_stderr`` [1/m], ``spot_radius`` R_s [m] of the circle that the receiver sees across the
        axis where that meets the mean surface, ``scaled_radius`` c R_s [1], ``system_attenuation`` [1/m] of the fit in
        `optics.system_attenuation`. Over ``field_of_view`` and ``time`` [ns]: ``impulse_response`` [J per bin] and its
        standard error. Attributes: ``attenuation`` c, ``absorption`` a, ``a_plus_bb``, ``kd`` [1/m] of the water,
        ``beam_radius`` R_b [m].

    Raises
    ------
    UserError
        When the scene is wrong, has no water, bubbles, or other water between the depths, an echo of a solid can come
        from between them, a number is out of range, or for the reasons of `effective_attenuation`.

    Notes
    -----
    Gordon (1982), Appl. Opt. 21, 2996, doi:10.1364/AO.21.002996: K is c where c R_s is far below 1 and comes down to
    the diffuse attenuation where it is above 5 to 6. His beam is narrow. A beam's own width counts as much as the
    view's: light that enters at x and leaves at x' counts by how often the beam's and the view's profile have the
    distance x' - x, and so K goes with their correlation, whichever of them is the wide one. Of beam and view,
    R = sqrt(R_s^2 + R_b^2) is the radius of a disc with the mean-square radius of their correlation; R_b, twice the
    root-mean-square angle of the beam per axis times the slant range, is that of the beam alone. The fit takes 2 R for
    its diameter. K can come near c only where c R_b, too, is far below 1.

    ``kd`` is Lee's (`optics.known_waters`): daylight's, averaged over depth. bb is that of the phase function in use.
    Between the depths K may itself depend on depth; what is given is the mean of the fit.

    What comes out for the default water and a narrow beam on a level sea: the fall is Gordon's and ends by c R_s = 3,
    but at absorption, 0.149 for a = 0.150 1/m, as Phillips and Koerber (1984), Aust. J. Phys. 37, 75, have it, and 14 %
    below Lee's Kd. The forward peak keeps K below c in any practical view: at c R_s = 0.015 it is 0.91 c. The fit,
    which knows no phase function, is up to 0.06 1/m too high between the limits.

    Each field is rendered for itself but for what lies inside the next smaller one, which is added from there: in a
    narrow beam the rare paths near the middle would make most of the noise. So errors of neighbours go together. They
    are jackknife estimates over the passes, with the correlation of the bins in them.
    """
    with readable_errors():
        passes, seed = whole("passes", passes, 4, 10_000), whole("seed", seed, 0, 2**53)
        fields = np.unique(finite_array("fields_of_view_mrad", fields_of_view_mrad))
    if fields.size == 0 or fields[0] <= 0:
        raise UserError(f"fields_of_view_mrad = {fields.tolist()} must hold at least one angle, each greater than 0")
    variants.set_variant()
    loaded, name, parameters = load_scene(scene, _with_widest(scene, params, float(fields[-1])))
    from mitransient_lidar.transport.system import LidarScene

    sensor = rendering.first_sensor(loaded)
    with readable_errors():
        system = LidarScene.from_scene(loaded, sensor)
    geometry = _geometry(system, 0.5e-3 * float(fields[-1]))
    film = system.film
    time_ns = film.time_start_ns + film.bin_width_ns * (np.arange(film.bin_count) + 0.5)
    column = ColumnBins.between(geometry, time_ns, from_depth, to_depth)
    water = _water(system, float(from_depth), float(to_depth))
    _check_solids(system, geometry, float(to_depth))
    energy = _render(loaded, sensor, fields, passes, seed, progress)

    mean, stderr = energy.mean(axis=1), energy.std(axis=1, ddof=1) / math.sqrt(passes)
    slopes = [slope_and_error(column, energy[field][:, column.inside]) for field in range(fields.size)]
    radius = 0.5e-3 * fields * geometry.slant_range
    beam = 2 * system.transmitter.widest_angular_spread * geometry.slant_range
    per_field = {
        "effective_attenuation": ([slope for slope, _ in slopes], "1/m", "attenuation coefficient of the column"),
        "effective_attenuation_stderr": ([error for _, error in slopes], "1/m", "standard error of the attenuation"),
        "spot_radius": (radius, "m", "radius of the circle that the receiver sees on the surface"),
        "scaled_radius": (water.attenuation * radius, "1", "beam attenuation times spot radius"),
        "system_attenuation": (_fit(water, radius, beam), "1/m", "fit to Gordon's results"),
    }
    data: dict[str, Any] = {
        key: ("field_of_view", np.asarray(values), {"units": units, "long_name": meaning})
        for key, (values, units, meaning) in per_field.items()
    }
    over_time = ("field_of_view", "time")
    data["impulse_response"] = (over_time, mean, {"units": "J", "long_name": "received energy per bin"})
    data["impulse_response_stderr"] = (over_time, stderr, {"units": "J", "long_name": "its standard error"})
    coords = {
        "field_of_view": ("field_of_view", fields, {"units": "mrad", "long_name": "full angle of the field of view"}),
        "time": ("time", time_ns, {"units": "ns"}),
    }
    attributes = {
        "scene": name,
        **variants.versions(),
        "seed": seed,
        "passes": passes,
        "from_depth": float(from_depth),
        "to_depth": float(to_depth),
        "attenuation": water.attenuation,
        "absorption": water.absorption,
        "a_plus_bb": water.absorption + water.backscattering,
        "kd": water.kd,
        "beam_radius": beam,
        **{f"scene.{key}": value for key, value in parameters.items()},
    }
    return xr.Dataset(data, coords, attributes)


def describe_views(found: xr.Dataset) -> list[str]:
    """Return the lines of a table of what `views` returned."""
    columns = ("effective_attenuation", "effective_attenuation_stderr", "system_attenuation")
    lines = [f"{'field of view':>13}{'R_s':>9}{'c R_s':>8}{'K':>9}{'+-':>9}{'fit':>9}"]
    lines.append(f"{'(mrad)':>13}{'(m)':>9}{'':>8}{'(1/m)':>9}{'(1/m)':>9}{'(1/m)':>9}")
    for row in (found.isel(field_of_view=number) for number in range(found.sizes["field_of_view"])):
        view, radius, scaled = (float(row[name]) for name in ("field_of_view", "spot_radius", "scaled_radius"))
        values = "".join(f"{float(row[name]):>9.4f}" for name in columns)
        lines.append(f"{view:>13g}{radius:>9.3g}{scaled:>8.3f}{values}")
    names = {"c": "attenuation", "Kd": "kd", "a + bb": "a_plus_bb", "a": "absorption"}
    limits = ", ".join(f"{symbol} = {found.attrs[name]:.4f}" for symbol, name in names.items())
    lines.append(f"{limits} 1/m; radius of the beam {found.attrs['beam_radius']:.3g} m")
    return lines


def plot_views(found: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Draw attenuation against the radius of the spot that the receiver sees.

    Parameters
    ----------
    found
        What `views` returned.
    path
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.

    Raises
    ------
    UserError
        When the file cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter

    from mitransient_lidar.results import replacing

    attributes = found.attrs
    c, beam = float(attributes["attenuation"]), float(attributes["beam_radius"])
    water = InherentProperties(
        float(attributes["absorption"]),
        c - float(attributes["absorption"]),
        float(attributes["a_plus_bb"]) - float(attributes["absorption"]),
    )
    seen = found["scaled_radius"].values
    low, high = 0.6 * seen.min(), 1.7 * seen.max()
    figure = Figure(figsize=(7.2, 4.8), layout="constrained")
    ax = figure.subplots()
    limits = {
        "c": (c, "#111111", "-"),
        "Kd": (water.kd, "#d81e1e", "-"),
        "a + bb": (float(attributes["a_plus_bb"]), "#17963f", "-"),
        "a": (water.absorption, "#17963f", ":"),
    }
    for label, (value, colour, style) in limits.items():
        ax.axhline(value, color=colour, linestyle=style, linewidth=1.2, label=f"{label} = {value:.3f} /m")
    line = np.geomspace(low, high, 200)
    ax.plot(line, _fit(water, line / c, beam), "--", color="0.45", linewidth=1.3, label="Kd + (c - Kd) exp(-0.85 c D)")
    ax.errorbar(
        seen,
        found["effective_attenuation"].values,
        found["effective_attenuation_stderr"].values,
        fmt="o-",
        color="#1f5fd6",
        markersize=5,
        linewidth=1.3,
        capsize=3,
        label="K of the column, ±1 standard error",
    )
    ax.set_xscale("log")
    ax.set_xlim(low, high)
    if low < c * beam < high:
        ax.axvline(c * beam, color="0.7", linestyle=":", linewidth=1.2)
        ax.text(c * beam, 0.02 * c, "  c R$_b$ of the beam", color="0.4", fontsize="small")
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.set_ylim(0, None)
    ax.set_xlabel("c R$_s$: beam attenuation times radius of the spot that the receiver sees")
    ax.set_ylabel("attenuation coefficient (1/m)")
    widths = ax.secondary_xaxis("top", functions=_between(found["field_of_view"].values[0] / seen[0]))
    widths.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    widths.set_xlabel("field of view (mrad)")
    ax.grid(True, color="0.9", linewidth=0.7)
    ax.legend(frameon=False, fontsize="small")
    depths = f"{attributes['from_depth']:g} to {attributes['to_depth']:g} m"
    figure.suptitle(f"{attributes['scene']}: slope of the column signal from {depths}, b/c = {water.albedo:.2g}")
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=130)


def _between(factor: float) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    return lambda value: value * factor, lambda value: value / factor


def _with_widest(scene: Any, params: Mapping[str, Any] | None, widest: float) -> Mapping[str, Any] | None:
    """Return the parameters of an XML scene with its field of view as wide as the widest, where it has one."""
    if isinstance(scene, (str, os.PathLike)):
        known = resources.scene_parameters(resources.scene_path(scene))
        if "field_of_view_mrad" in known:
            return {**(params or {}), "field_of_view_mrad": widest}
    return params


def _geometry(system: LidarScene, half_view: float) -> LidarGeometry:
    """Return the geometry of a scene seen in a half angle [rad]; refuse a view that reaches the horizon."""
    pose = system.receiver.pose
    off_nadir = math.acos(min(1.0, -float(pose.axis[2])))
    widest = 2e3 * math.tan(0.5 * math.pi - off_nadir)
    if 2e3 * half_view >= widest:
        raise UserError(
            f"fields_of_view_mrad = {2e3 * half_view:g} must be less than {widest:.4g}: it would reach the horizon"
        )
    edge = min(BEAM_EDGE * system.transmitter.widest_angular_spread, half_view)
    return LidarGeometry(float(pose.origin[2]), off_nadir, system.refractive_index, system.group_index, edge)


def _water(system: LidarScene, from_depth: float, to_depth: float) -> InherentProperties:
    """Return the water between two depths [m]; refuse several."""
    from mitransient_lidar.transport.water_phases import table_of

    water = system.water
    if water is None:
        raise UserError("the scene has no water: give its surface a layered_water as interior medium")
    if water.plume is not None:
        raise UserError("the scene has bubbles: the slope needs the same water everywhere, plume_scattering = 0")
    layer, last = (int(number) for number in water.column.layer_at([from_depth, to_depth]))
    if layer != last:
        raise UserError(
            f"the water has {last - layer + 1} layers from from_depth = {from_depth:g} m to to_depth = {to_depth:g} m: "
            "it must be the same between them"
        )
    scattering = float(water.column.scattering[layer])
    ratio = table_of(water.phases.phases[layer]).backscatter_ratio
    return InherentProperties(float(water.column.absorption[layer]), scattering, ratio * scattering)


def _check_solids(system: LidarScene, geometry: LidarGeometry, to_depth: float) -> None:
    """Refuse a bottom or target whose echo can come from above a depth [m]."""
    # Scattered light takes the shortest way to a level bottom, which is shorter by cos^2 than that along the axis.
    for solid in system.solids:
        begin = -float(solid.bbox().max.z) * geometry.cos_water**2 - geometry.surface_depth
        if to_depth > begin:
            raise UserError(
                f"to_depth = {to_depth:g} m must be at most {begin:.3g} m, where the echo of {solid.id()!r} can begin"
            )


def _render(
    scene: mi.Scene,
    sensor: mi.Sensor,
    fields: FloatArray,
    passes: int,
    seed: int,
    progress: Callable[[int, int], None] | None,
) -> FloatArray:
    """Return the energy [J] in circles of full angles [mrad], shape (fields, passes, bins)."""
    from mitransient_lidar.transport.fields import Sector
    from mitransient_lidar.transport.pixels import ShapedPixels

    engine = rendering.choose_integrator(scene, None)
    receiver, film = sensor.receiver, sensor.film()
    rings = np.empty((fields.size, passes, film.bin_count))
    lost, inner = 0.0, 0.0
    try:
        for ring, outer in enumerate(0.5e-3 * fields):
            sensor.receiver = replace(receiver, pixels=ShapedPixels([Sector(outer, inner)], ["ring"]))
            engine.release()
            for number in range(passes):
                with readable_errors():
                    pass_seed = rendering.pass_seed(seed, ring * passes + number)
                    engine.render(scene, sensor, seed=pass_seed, develop=False)
                rings[ring, number] = film.energy()[0]
                lost += float(np.array(engine.lost).item())
                if progress is not None:
                    progress(ring * passes + number + 1, rings.shape[0] * passes)
            inner = outer
    finally:
        engine.release()
        sensor.receiver = receiver
    share = lost / (lost + rings.sum()) if lost > 0 else 0.0
    if share > _TOLERATED_LOSS:
        logger.warning(
            "the surface patch is smaller than the spread of the light in the water: about %.2g %% of the received "
            "energy is lost at its border; enlarge the surface's extent",
            100 * share,
        )
    return np.cumsum(rings, axis=0)


def slope_and_error(column: ColumnBins, energy: FloatArray) -> tuple[float, float]:
    """Return K and its standard error over the passes [1/m], from energies of shape (passes, bins)."""
    passes = len(energy)
    total = energy.sum(axis=0)
    weights, _ = column.weights(total / passes, energy.std(axis=0, ddof=1) / math.sqrt(passes))
    without = total - energy
    if np.any(without <= 0):
        raise UserError(f"the signal of a bin is that of a single one of {passes} passes: render more passes")
    slopes = np.log(without / column.gain) @ weights
    spread = (passes - 1) / passes * np.sum((slopes - slopes.mean()) ** 2)
    return float(weights @ np.log(total / column.gain)), float(np.sqrt(spread))


def _fit(water: InherentProperties, radius: FloatArray, beam_radius: float) -> FloatArray:
    """Return the fit to Gordon's results [1/m] for radii of view and beam [m]."""
    # Nearly isotropic scattering makes a Kd above c, where the fit has no meaning.
    kd = min(water.kd, water.attenuation)
    return system_attenuation(water.attenuation, kd, 2 * np.hypot(radius, beam_radius))
