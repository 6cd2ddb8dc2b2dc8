"""Cramer-Rao bounds of parameters from a receiver's records, for one lidar design or several."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.information.errors import jackknife_error
from mitransient_lidar.analysis.information.fisher import fisher_information, priors
from mitransient_lidar.analysis.receiver import Gain, OpticalDensity, chain_of
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import (
    RECEIVERS,
    BackgroundPower,
    Instrument,
    Option,
    Scene,
    Seed,
    checked,
    positive_option,
)
from mitransient_lidar.core.tables.written import table_lines, write_csv
from mitransient_lidar.core.validation import shown
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.physics.receiver.receiver_files import ReceiverChannels
from mitransient_lidar.rendering.passes import ProgressCallback, render_seed
from mitransient_lidar.rendering.render import render
from mitransient_lidar.results.attributes import label
from mitransient_lidar.studies.cases import Cases

MOST_DESIGNS = 1000  #: Most designs in a comparison.

_JOINED = ("bound", "bound_stderr", "bound_known", "variance_share", "monte_carlo_share", "correlation")


@checked
@alone
def bounds(
    scene: Scene,
    params: Mapping[str, Any] | None = None,
    *,
    instrument: Instrument = None,
    free: Annotated[
        Sequence[str], Option("Unknown parameters, e.g. attenuation,bottom_reflectance", form="NAME,NAME,...")
    ],
    over: Annotated[
        Mapping[str, Sequence[Any]] | None,
        Option(
            "Values of a scene parameter to compare, separated by semicolons where they hold commas. Repeatable: all "
            "combinations count",
            form="NAME=V1,V2,...",
        ),
    ] = None,
    receiver: Annotated[
        Any,
        Option(
            f"{RECEIVERS}. Several, separated by commas, are compared. By default the instrument's, or apd",
            form="NAME,NAME,...",
        ),
    ] = None,
    gain: Gain = None,
    optical_density: OpticalDensity = None,
    background_power_w: BackgroundPower = 0.0,
    nuisances: Annotated[
        Mapping[str, float] | None,
        Option(
            "Nuisance parameter: time_offset [ns] or scale [1], optionally with its standard deviation. Repeatable",
            form="NAME[=STD]",
            flag="--nuisance",
        ),
    ] = None,
    renders: Annotated[int, Option("Independent renders of each design; 3 or more give errors", 2, 1000)] = 4,
    passes: Annotated[int, Option("Number of independent passes per render", 2, 100_000)] = 16,
    max_time: Annotated[
        float | None, positive_option("Begin no further design after this many seconds, and leave it out")
    ] = None,
    seed: Seed = 0,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Compute the Cramer-Rao bounds of scene parameters from one shot's record, and compare designs.

    Parameters
    ----------
    free
        Names of the unknown parameters, as for the `derivatives` of `rendering.render.render`; at least one.
    over
        Values of scene parameters, by name; designs are all their combinations, the last one changing first, at most
        1000. None for the unchanged scene.
    receiver, gain, optical_density
        As `chain`, `gain` and `optical_density` of `analysis.receiver.detect_waveforms`; several receivers in a list
        are compared on the same renders, and ``receiver`` is then the last design parameter.
    nuisances
        As for `analysis.information.fisher.fisher_information`.
    renders
        Independent renders of each design, 2 to 1000, whose noise is kept out of the information; from three on their
        spread gives standard errors.
    max_time
        Time after which no design is begun [s], above 0; the first one always is. The attribute ``designs_left_out``
        has the number of omitted designs, with a warning.

    Returns
    -------
    xarray.Dataset
        Over ``design`` (its parameters as text) and ``parameter``: ``bound``, ``bound_stderr``, ``bound_known``,
        ``variance_share`` and ``monte_carlo_share`` from `fisher_information`, and ``ratio``, the bound over the first
        design's, with ``ratio_stderr`` by the spread of the renders. Over ``design``, ``parameter`` and
        ``other_parameter``: ``correlation``. Over ``design``: ``lost_samples``, the share of samples in all pixels that
        saturate, and ``remarks``, sentences on undetermined parameters, one per line. Coordinates come from
        `fisher_information`, ``parameter_value`` over design and parameter, and ``design_NAME`` for each parameter in
        `over`, as text.

    Raises
    ------
    UserError
        If the scene, a parameter or an option is invalid, or a design's records contain no information.
    KeyboardInterrupt
        If a render was interrupted.
    """
    if isinstance(free, str) or len(free) == 0 or len(set(free)) != len(free):
        raise UserError(f"free = {free!r} must be a list of different names of parameters")
    sky = background_power_w
    receivers = _receivers(receiver, gain)
    known, designs = priors(nuisances or {}), _designs(over or {})
    for design in designs:  # before the first render
        session = open_scene(scene, {**(params or {}), **design}, instrument)
    found: list[xr.Dataset] = []
    cases = Cases(designs, "designs", steps=renders, max_time=max_time, progress=progress)
    for design in cases:
        results = []
        for i in range(renders):
            options: dict[str, Any] = {"derivatives": list(free), "passes": passes, "seed": render_seed(seed, i)}
            options["instrument"] = instrument
            results.append(cases.keep(render(scene, params={**(params or {}), **design}, **options)))
            cases.step()
        for chain in receivers.values():
            settings: dict[str, Any] = {"gain": gain, "optical_density": optical_density, "nuisances": known}
            found.append(fisher_information(results, chain, sky, **settings))
        if found[-1]["parameter"].values.tolist() != (names := found[0]["parameter"].values.tolist()):
            raise UserError(f"over: the design {design} has other parameters than the first, {', '.join(names)}")
    attributes = {
        "scene": session.name,
        "receiver": ", ".join(name or str(found[0].attrs.get("instrument", "apd")) for name in receivers),
        "renders": renders,
        "passes": passes,
        "seed": seed,
        "designs_left_out": cases.left_out,
        "background_power_w": sky,
        **{f"scene.{name}": str(value) for name, value in (params or {}).items()},
    }
    designs = designs[: cases.begun]
    if len(receivers) > 1:
        designs = [{**design, "receiver": name} for design in designs for name in receivers]
    return _compared(found, designs, attributes)


def _receivers(given: Any, gain: Any) -> dict[str, ReceiverChannels | None]:
    """Return receivers by name, None with an empty name for the receiver of the scene's instrument."""
    listed = list(given) if isinstance(given, (list, tuple)) else [given]
    found = [None if one is None else chain_of("receiver", one) for one in listed]
    named = {"" if one is None else one.name: one for one in found}
    if len(named) < len(listed) or not named:
        raise UserError(f"receiver = {shown(given)} must be one receiver, or several with different names")
    for name, one in named.items():
        if gain is not None and one is not None and one.default.chain.amplifier is None:
            raise UserError(f"gain = {gain} needs a receiver with an amplifier, which {name} lacks")
    return named


def _designs(over: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Return each design's parameters."""
    for name, values in over.items():
        if isinstance(values, str) or len(values) == 0 or len({str(value) for value in values}) != len(values):
            raise UserError(f"over: {name} = {values!r} must be a list of different values")
    if (count := math.prod(len(values) for values in over.values())) > MOST_DESIGNS:
        raise UserError(f"over gives {count} designs: at most {MOST_DESIGNS} can be compared")
    return [dict(zip(over, values, strict=True)) for values in itertools.product(*over.values())]


def _compared(
    found: Sequence[xr.Dataset], designs: Sequence[Mapping[str, Any]], attributes: Mapping[str, Any]
) -> xr.Dataset:
    """Return the bounds of all designs, with their ratios to the first."""
    labels = [", ".join(f"{name}={value}" for name, value in one.items()) or "scene" for one in designs]
    joined = xr.concat([one[list(_JOINED)].drop_vars("parameter_value") for one in found], "design")
    joined = joined.drop_vars([name for name in ("pixel", "angle_x", "angle_y") if name in joined.coords])
    first = found[0]["bound"].values
    with np.errstate(invalid="ignore"):
        # Nothing is compared with a first design that has no bound.
        ratio = joined["bound"].values / np.where(np.isfinite(first), first, np.nan)
        errors = [_ratio_errors(one, found[0]) for one in found]
    joined = joined.assign(
        ratio=(("design", "parameter"), ratio),
        ratio_stderr=(("design", "parameter"), errors),
        lost_samples=("design", [float(one["lost_samples"].mean()) for one in found]),
        remarks=("design", [one.attrs["remarks"] for one in found]),
    )
    values = np.stack([one["parameter_value"].values for one in found])
    coords: dict[str, Any] = {"design": labels, "parameter_value": (("design", "parameter"), values)}
    coords |= {f"design_{name}": ("design", [str(one[name]) for one in designs]) for name in designs[0]}
    joined = joined.assign_coords(coords)
    return label(joined.assign_attrs(attributes))


def _ratio_errors(one: xr.Dataset, first: xr.Dataset) -> list[float]:
    """Return standard errors of bound ratios; renders with the same random numbers are left out together."""
    if "bound_left_out" not in one:
        return [math.nan] * one.sizes["parameter"]
    ratios = (one["bound_left_out"] / first["bound_left_out"].values).values
    return [jackknife_error(column) if np.isfinite(column).all() else math.nan for column in ratios.T]


def write_table(found: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a result of `bounds` as a CSV file, one row per design and parameter.

    Columns are the design parameters, the free parameter with its value and unit, and bound, bound_stderr, bound_known,
    ratio and ratio_stderr; a bound that does not exist is inf, an unknown error nan.
    """
    names = {str(name): str(name).removeprefix("design_") for name in found.coords if str(name).startswith("design_")}
    names |= {"parameter": "parameter", "parameter_value": "value", "parameter_units": "units"}
    numbers = ("bound", "bound_stderr", "bound_known", "ratio", "ratio_stderr")
    frame = found.reset_coords()[[*numbers, *(set(names) - {"parameter"})]].to_dataframe(["design", "parameter"])
    frame = frame.reset_index()[[*names, *numbers]].rename(columns=names)
    write_csv(frame.assign(value=frame["value"].map("{:.9g}".format)), path, digits=6, unknown="nan")


def describe_bounds(found: xr.Dataset) -> list[str]:
    """Return table lines for a result of `bounds`, and its remarks.

    One block per parameter, with the designs from the best to the worst: bound, its standard error, bound with the
    other parameters known, and ratio to the first design.
    """
    lines = []
    width = max(12, *(len(str(name)) for name in found["design"].values))
    columns = [("  design", f"<{width + 2}"), ("bound", ">11.4g"), ("+-", ">10.2g"), ("others known", ">14.4g")]
    columns += [("ratio", ">9.4g"), ("+-", ">8.2g")]
    for name in found["parameter"].values:
        one = found.sel(parameter=name)
        first = one.isel(design=0)
        prior = float(first["prior"])
        known = f", known to {prior:g}" if math.isfinite(prior) else ""
        unit = first["parameter_units"].item()
        lines.append(f"{name} = {float(first['parameter_value']):g} {unit}{known}")
        order = np.argsort(one["bound"].values, kind="stable")
        names = ("bound", "bound_stderr", "bound_known", "ratio", "ratio_stderr")
        numbers = np.stack([one[key].values[order] for key in names], axis=1)
        texts = [[value if math.isfinite(value) else "-" for value in row] for row in numbers]
        designs = [f"  {design}" for design in one["design"].values[order]]
        lines += table_lines(columns, ((design, *row) for design, row in zip(designs, texts, strict=True)))
    for design in found["design"].values:
        one = found.sel(design=design)
        said = one["remarks"].item().splitlines()
        if (lost := float(one["lost_samples"])) > 0:
            said.append(f"{100 * lost:.2g} % of the samples saturate and count as lost")
        lines += [f"{design}: {sentence}" for sentence in said]
    return lines
