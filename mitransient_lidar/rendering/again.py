"""Options that render a result again, from the scene, the parameters and the passes in its attributes."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import integer
from mitransient_lidar.loading import variants
from mitransient_lidar.loading.parameters import check_params
from mitransient_lidar.loading.scene_source import SceneSource, json_attribute
from mitransient_lidar.rendering.passes import KEPT, LIGHT
from mitransient_lidar.rendering.passive import MOST_FRAMES

logger = logging.getLogger(__name__)

#: Options that a result holds, by the command that rendered it.
_HELD = {
    "render": ("seed", "variant", "max_memory", "passes", "pass_share"),
    "passive": ("seed", "variant"),
    "shots": ("passes", "pass_share"),
    "frames": ("seed", "max_memory", "passes", "pass_share"),
}

#: Attributes that only results of a command have, the last one after the others.
_KINDS = {"shots": "series_parameters", "passive": "frame_passes", "frames": "gate_order", "render": "pass_share"}

#: Frame options that are attributes with the same name.
_OF_FRAMES = ("frames", "pulse_rate_hz", "gate_order", "readout_s", "speed", "heading_deg")

#: Options that end a render; with another end the recorded ones do not count.
_ENDS = ("target_error", "max_time", "passes")


def is_result(scene: Any) -> bool:
    """Return whether a scene is given as a result: a dataset, or a file path that ends in .nc or .exr."""
    if isinstance(scene, (str, os.PathLike)):
        return Path(scene).suffix.lower() in (".nc", ".exr")
    return isinstance(scene, xr.Dataset)


def read_attributes(result: xr.Dataset | str | os.PathLike[str]) -> dict[str, Any]:
    """Return the attributes in a result, or in its EXR or NetCDF file; raise UserError if it cannot be read."""
    return dict((result if isinstance(result, xr.Dataset) else results.open(result)).attrs)


def result_kind(attributes: Mapping[str, Any]) -> str:
    """Return the command that rendered a result, one of `_KINDS`; raise UserError for others."""
    for kind, name in _KINDS.items():
        if name in attributes:
            return kind
    raise UserError(
        "the dataset is not a result that can be rendered again: it must be of render, shots, frames or passive, "
        "and of this release or a later one"
    )


def recall(result: xr.Dataset | str | os.PathLike[str], options: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the command that rendered a result, and the options that render it again, with `scene`.

    Raises UserError if the result does not contain its scene or an option, or contains only some shots of a series.

    `result`: dataset from `render.render`, `passive.render_passive` or `shots.series.render_shots`, or its file.
    `options`: that function's options that replace the result's, unless they are None; its parameters are added to the
    scene's.
    """
    attributes = read_attributes(result)
    kind = result_kind(attributes)
    given = {name: value for name, value in options.items() if value is not None}
    folder = None if isinstance(result, xr.Dataset) else Path(result).parent
    scene = SceneSource.from_attributes(attributes, folder)
    own = {name: _held(attributes, KEPT[name]) for name in _HELD[kind]}
    compare_versions(attributes)
    if kind == "shots":
        own |= _series_options(result, attributes, given)
        given["params"] = {**json_attribute(attributes, "series_parameters"), **given.get("params", {})}
    else:
        own["integrator"] = _integrator(attributes)
    if kind == "passive":
        own |= _frame_options(attributes, given)
    elif kind == "frames":
        own |= {name: _held(attributes, name) for name in _OF_FRAMES}
    else:
        if kind == "render" and "batches" in attributes:
            own["batches"] = attributes["batches"]
        own["components"] = bool(attributes.get("components", 0))
        if "derivatives" in attributes:
            own["derivatives"] = np.atleast_1d(attributes["derivatives"]).tolist()
    if kind in ("render", "frames") and "light" in attributes:
        own["light"] = attributes["light"]
    if "smooth_pixels" in attributes:
        own["smooth"] = attributes["smooth_pixels"]
    if any(name in given for name in _ENDS):
        own = {name: value for name, value in own.items() if name not in (*_ENDS, "pass_share")}
    return kind, {"scene": scene, **own, **given}


def _held(attributes: Mapping[str, Any], name: str) -> Any:
    """Return an attribute of a result; raise UserError if it has none."""
    if name not in attributes:
        raise UserError(f"the result has no attribute {name}, without which it is not rendered again")
    return attributes[name]


def _frame_options(attributes: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options for daylight images alone."""
    passes, step = _held(attributes, "frame_passes"), _held(attributes, "frame_step_s")
    frames = integer("frames", given.get("frames", len(passes)), 1, MOST_FRAMES)
    return {
        "frames": frames,
        "frame_step_s": step,
        "filter_width_nm": attributes.get("filter_width_nm"),
        "passes": [*passes, *[passes[-1]] * frames][:frames],
    }


def _series_options(result: Any, attributes: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options for shot series alone, for a complete series or for the shots before Ctrl-C."""
    series = result if isinstance(result, xr.Dataset) else results.open(result)
    if "shot" not in series.dims or not np.array_equal(series["shot"], np.arange(attributes.get("shots", 0))):
        raise UserError("the dataset holds some shots of a series, which is rendered again as a whole: give all shots")
    check_params(given.get("params"))
    # The bins of some shots equal the bins of all shots.
    same: dict[str, Any] = {} if "params" in given or "positions" in given else {"axis": results.time_axis(series)}
    if same and "shot_passes" in series.coords and not any(name in given for name in _ENDS):
        same |= {"passes": int(_held(attributes, "most_passes")), "shot_passes": series["shot_passes"].values}
    elif "target_error" in attributes:
        same["passes"] = None
    return {
        "positions": np.column_stack([series["aim_x"], series["aim_y"]]),
        # Batches end with their error, or after their passes.
        "target_error": attributes.get("target_error"),
        "move_target": bool(attributes["moved_target"]),
        "first_seed": int(attributes.get("first_seed", 0)),
        "light": str(attributes.get("light", LIGHT[0])),
        **same,
    }


def describe_result(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return a result's attributes, without JSON or XML texts, and all its plugin parameters.

    A parameter is named by its object and itself, as ``surface.interior.attenuation``. Raises UserError if the file
    cannot be read.
    """
    attributes = read_attributes(path)
    plugins = json_attribute(attributes, "plugin_parameters") if "plugin_parameters" in attributes else {}
    attributes.pop("plugin_parameters", None)
    long = [name for name, value in attributes.items() if isinstance(value, str) and re.match(r"\s*[\[{<]", value)]
    plain = {name: value for name, value in attributes.items() if name not in long}
    return {**plain, **_flat(plugins)}


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested objects' values by their names, joined with points."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


def _integrator(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result's integrator as a dict for Mitsuba."""
    values = json_attribute(attributes, "plugin_parameters").get("integrator", {})
    return {name: value for name, value in values.items() if value is not None and name != "used"}


def compare_versions(attributes: Mapping[str, Any]) -> None:
    """Warn about versions that differ from the result's."""
    for name, version in variants.versions().items():
        if name != "variant" and attributes.get(name, version) != version:
            logger.warning(
                "the result is of %s = %s, and this is %s: its bits may differ", name, attributes[name], version
            )
