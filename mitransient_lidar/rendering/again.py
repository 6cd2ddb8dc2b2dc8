"""Rendering of a result again, from the scene, the parameters and the passes in its attributes."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import integer
from mitransient_lidar.loading import variants
from mitransient_lidar.loading.scene_record import SceneRecord, json_attribute
from mitransient_lidar.rendering.passive import MOST_FRAMES, render_passive
from mitransient_lidar.rendering.render import render
from mitransient_lidar.results import exr, netcdf
from mitransient_lidar.results.formats import input_format

logger = logging.getLogger(__name__)

#: Attributes that are options of a render.
_RENDER_OPTIONS = ("seed", "variant", "passes", "pass_share", "max_memory_gb")
_PASSIVE_OPTIONS = ("seed", "variant", "frame_passes", "frame_step_s")

#: Options that end a render.
_ENDS = ("target_error", "max_time", "passes")


def is_result(scene: Any) -> bool:
    """Return whether a scene is given as a result: a dataset, or the path of a file that ends in .nc or .exr."""
    if isinstance(scene, (str, os.PathLike)):
        return Path(scene).suffix.lower() in (".nc", ".exr")
    return isinstance(scene, xr.Dataset)


def read_attributes(result: xr.Dataset | str | os.PathLike[str]) -> dict[str, Any]:
    """Return the attributes of a result, or of its EXR or NetCDF file; raise UserError if it cannot be read."""
    if isinstance(result, xr.Dataset):
        return dict(result.attrs)
    path = Path(result)
    if input_format(path) == "netcdf":
        return dict(netcdf.read_netcdf(path).attrs)
    return dict(exr.exact_metadata(path, exr.read_parts(path)[0].attributes).get("attributes", {}))


def result_kind(attributes: Mapping[str, Any]) -> str:
    """Return the command that rendered a result: ``render``, ``shots`` or ``passive``; raise UserError for others."""
    for kind, name in (("shots", "series_parameters"), ("passive", "frame_passes"), ("render", "pass_share")):
        if name in attributes:
            return kind
    raise UserError(
        "the dataset is not a result that can be rendered again: it must be of render, shots or passive, and of this "
        "release or a later one"
    )


def render_again(result: xr.Dataset | str | os.PathLike[str], **options: Any) -> xr.Dataset:
    """Render a result again: the same bits on the same machine, unless options change it.

    Parameters
    ----------
    result
        Dataset of `render.render` or `passive.render_passive`, or its file. Of one that was computed from a result, as
        gates or signals of a receiver, that result is rendered.
    options
        Options of the function that rendered the result, by default those of its attributes. `params` are added to the
        parameters of its scene.

    Returns
    -------
    xarray.Dataset
        As of the function that rendered the result.

    Raises
    ------
    UserError
        If the result does not hold its scene, a file of the scene has changed, or an option is invalid.
    """
    attributes = read_attributes(result)
    kind = result_kind(attributes)
    if kind == "shots":
        raise UserError("the result is a series of shots: use mitransient_lidar.render, or the command shots")
    record = SceneRecord.from_attributes(attributes)
    needed = {"passive": _PASSIVE_OPTIONS, "render": _RENDER_OPTIONS}[kind]
    if missing := [name for name in needed if name not in attributes]:
        raise UserError(f"the result has no attribute {missing[0]}, without which it is not rendered again")
    compare_versions(attributes)
    own = {"seed": attributes["seed"], "variant": attributes["variant"], "integrator": _integrator(attributes)}
    given = {name: value for name, value in options.items() if value is not None}
    if kind == "passive":
        passes = attributes["frame_passes"]
        frames = integer("frames", given.get("frames", len(passes)), 1, MOST_FRAMES)
        own |= {"frames": frames, "frame_step_s": attributes["frame_step_s"]}
        own["filter_width_nm"] = attributes.get("filter_width_nm")
        ends: dict[str, Any] = {"passes": [*passes, *[passes[-1]] * frames][:frames]}
    else:
        own["max_memory"] = attributes["max_memory_gb"]
        own["components"] = bool(attributes.get("components", 0))
        ends = {"passes": attributes["passes"], "pass_share": attributes["pass_share"]}
    chosen = {**own, **({} if any(name in given for name in _ENDS) else ends), **given}
    return render_passive(record, **chosen) if kind == "passive" else render(record, **chosen)


def describe_result(path: str | os.PathLike[str]) -> dict[str, str]:
    """Return the attributes of a result, without texts of JSON or XML, and all parameters of its plugins, as texts.

    A parameter is named by its object and itself, as ``surface.interior.attenuation``. Raises UserError if the file
    cannot be read.
    """
    attributes = read_attributes(path)
    plugins = json_attribute(attributes, "plugin_parameters") if "plugin_parameters" in attributes else {}
    attributes.pop("plugin_parameters", None)
    long = [name for name, value in attributes.items() if isinstance(value, str) and re.match(r"\s*[\[{<]", value)]
    plain = {name: value for name, value in attributes.items() if name not in long}
    return {name: _text(value) for name, value in {**plain, **_flat(plugins)}.items()}


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the values of nested objects by their names, joined with points."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


def _text(value: Any) -> str:
    """Return a value in one line."""
    if value is None:
        return "-"
    if isinstance(value, list):
        return ", ".join(map(_text, value))
    return f"{value:.9g}" if isinstance(value, float) else " ".join(str(value).split())


def _integrator(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the integrator of a result as a dict for Mitsuba."""
    values = json_attribute(attributes, "plugin_parameters").get("integrator", {})
    return {name: value for name, value in values.items() if value is not None and name != "used"}


def compare_versions(attributes: Mapping[str, Any]) -> None:
    """Warn of other versions than those of the result."""
    for name, version in variants.versions().items():
        if name != "variant" and attributes.get(name, version) != version:
            logger.warning(
                "the result is of %s = %s, and this is %s: its bits may differ", name, attributes[name], version
            )
