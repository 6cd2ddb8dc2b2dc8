"""Simulator of multipixel depth-sounding lidar, built on Mitsuba 3 and Dr.Jit.

Importing the package finds LLVM, chooses a Mitsuba variant when none is set, and registers the plugins. Plain Mitsuba
then loads and renders lidar scenes::

    import mitransient_lidar  # before mitsuba: it finds LLVM for Dr.Jit
    import mitsuba as mi

    scene = mi.load_file("scene.xml")
    energy = mi.render(scene)  # received energy in J, (pixel, time)

:func:`render` renders to an accuracy instead and returns waveforms with standard errors as an ``xarray.Dataset``.
:func:`open` reads such a result back from an EXR stack or a NetCDF file.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitransient_lidar._version import __version__

if importlib.util.find_spec("mitransient_lidar.plugins") is None:
    # Run from the repository root, this folder shadows the installed package; plugins/ and scenes/ lie beside it.
    __path__.append(str(Path(__file__).resolve().parent.parent))

from mitransient_lidar.core.errors import UserError as _UserError
from mitransient_lidar.loading import variants as _variants

_variants.prepare_llvm()

import mitsuba as _mi  # noqa: E402  (Dr.Jit looks for LLVM when it is first imported)

_mi.detail.add_variant_callback(_variants.register_plugins)
try:
    if _mi.variant() is None:
        _mi.set_variant(_variants.choose_variant())
    else:
        if _mi.variant().startswith("llvm"):
            _variants.check_llvm()
        _variants.register_plugins(None, _mi.variant())
except _UserError as _error:
    if _variants.is_command_line():
        sys.stderr.write(f"{_error}\n")
        raise SystemExit(2) from None
    raise ImportError(str(_error)) from None
_variants.limit_threads()

if TYPE_CHECKING:
    from collections.abc import Mapping

    import xarray

    from mitransient_lidar.analysis.depth_uncertainty import SURVEY_ORDERS
    from mitransient_lidar.analysis.gates.cut import cut_gates
    from mitransient_lidar.analysis.gates.range_images import depth_image
    from mitransient_lidar.analysis.receiver import detect_waveforms as record
    from mitransient_lidar.analysis.retrieval.retrieve import retrieve
    from mitransient_lidar.analysis.waveforms.depth_correction import correct_depths
    from mitransient_lidar.analysis.waveforms.echo_table import extract as echoes
    from mitransient_lidar.campaigns.sweep import campaign
    from mitransient_lidar.flights.fly import fly
    from mitransient_lidar.loading.catalogue import instrument_names, read_instrument, scene_names, scene_parameters
    from mitransient_lidar.loading.scenes import open_scene
    from mitransient_lidar.physics.lidar.gate_train import GateTrain
    from mitransient_lidar.physics.sea.kelvin_wake import kelvin_wake
    from mitransient_lidar.physics.water.profiles import read_profile
    from mitransient_lidar.physics.water.water_types import water_of
    from mitransient_lidar.plots.publication.figures import figures
    from mitransient_lidar.plots.viewer import view, view_points, view_scene
    from mitransient_lidar.rendering.passive import render_passive
    from mitransient_lidar.rendering.render import render
    from mitransient_lidar.rendering.shots.frames import render_frames
    from mitransient_lidar.rendering.shots.series import render_shots
    from mitransient_lidar.results.waveform_files import waveform_chunks
    from mitransient_lidar.studies.bounds import bounds
    from mitransient_lidar.studies.depth_bias import depth_bias, tpu
    from mitransient_lidar.studies.detection import detect
    from mitransient_lidar.studies.fit import fit
    from mitransient_lidar.studies.forecast import forecast
    from mitransient_lidar.studies.light_classes import scattering

#: Functions by the modules that are imported when they are first used.
_FUNCTIONS = {
    "GateTrain": ("physics.lidar.gate_train", "GateTrain"),
    "SURVEY_ORDERS": ("analysis.depth_uncertainty", "SURVEY_ORDERS"),
    "bounds": ("studies.bounds", "bounds"),
    "campaign": ("campaigns.sweep", "campaign"),
    "correct_depths": ("analysis.waveforms.depth_correction", "correct_depths"),
    "cut_gates": ("analysis.gates.cut", "cut_gates"),
    "depth_bias": ("studies.depth_bias", "depth_bias"),
    "depth_image": ("analysis.gates.range_images", "depth_image"),
    "detect": ("studies.detection", "detect"),
    "echoes": ("analysis.waveforms.echo_table", "extract"),
    "figures": ("plots.publication.figures", "figures"),
    "fit": ("studies.fit", "fit"),
    "fly": ("flights.fly", "fly"),
    "forecast": ("studies.forecast", "forecast"),
    "instrument_names": ("loading.catalogue", "instrument_names"),
    "kelvin_wake": ("physics.sea.kelvin_wake", "kelvin_wake"),
    "open_scene": ("loading.scenes", "open_scene"),
    "read_instrument": ("loading.catalogue", "read_instrument"),
    "read_profile": ("physics.water.profiles", "read_profile"),
    "record": ("analysis.receiver", "detect_waveforms"),
    "render": ("rendering.render", "render"),
    "render_frames": ("rendering.shots.frames", "render_frames"),
    "render_passive": ("rendering.passive", "render_passive"),
    "render_shots": ("rendering.shots.series", "render_shots"),
    "retrieve": ("analysis.retrieval.retrieve", "retrieve"),
    "scattering": ("studies.light_classes", "scattering"),
    "scene_names": ("loading.catalogue", "scene_names"),
    "scene_parameters": ("loading.catalogue", "scene_parameters"),
    "tpu": ("studies.depth_bias", "tpu"),
    "view": ("plots.viewer", "view"),
    "view_points": ("plots.viewer", "view_points"),
    "view_scene": ("plots.viewer", "view_scene"),
    "water_of": ("physics.water.water_types", "water_of"),
    "waveform_chunks": ("results.waveform_files", "waveform_chunks"),
}

#: Former names of functions, and those that have taken their place.
_FORMER = {
    "depth_uncertainty": "tpu",
    "estimate": "render with light='level' and components=True",
    "fov_sweep": "scattering with fov_mrad",
    "scattering_orders": "scattering with orders",
    "sweep": "campaign",
    "waveforms": "echoes",
}

#: Without `open`, so that ``from mitransient_lidar import *`` leaves the one of Python alone.
__all__ = [
    "SURVEY_ORDERS",
    "GateTrain",
    "__version__",
    "bounds",
    "campaign",
    "correct_depths",
    "cut_gates",
    "depth_bias",
    "depth_image",
    "detect",
    "echoes",
    "figures",
    "fit",
    "fly",
    "forecast",
    "instrument_names",
    "kelvin_wake",
    "open_scene",
    "read_instrument",
    "read_profile",
    "record",
    "render",
    "render_frames",
    "render_passive",
    "render_shots",
    "retrieve",
    "save",
    "scattering",
    "scene_names",
    "scene_parameters",
    "tpu",
    "view",
    "view_points",
    "view_scene",
    "water_of",
    "waveform_chunks",
]


def __getattr__(name: str) -> Any:
    """Import a function when it is first used."""
    if name in _FORMER:
        raise AttributeError(f"{__name__}.{name} is now {_FORMER[name]}")
    if name not in _FUNCTIONS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, function = _FUNCTIONS[name]
    found = getattr(importlib.import_module(f"{__name__}.{module}"), function)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """Return the names of the functions that are imported later, too."""
    return sorted({*globals(), *_FUNCTIONS})


def open(
    path: str | os.PathLike[str],
    *,
    waveforms: tuple[int, int | None] | None = None,
    channel: int | str | None = None,
    lidar: Mapping[str, float] | None = None,
) -> xarray.Dataset:
    """Read any file or folder that this package writes, or waveforms that a lidar has recorded.

    Parameters
    ----------
    path : path
        An EXR or NetCDF file: waveforms of a render, gates, images by daylight, signals of a receiver, or a table of a
        study. Or a folder: the store of a campaign, whose arrays are read when they are needed, a flight, or a sequence
        of gates. Or a full-waveform LAS, LAZ or PulseWaves file.
    waveforms, channel, lidar : optional
        Of such a file, as of :func:`waveform_chunks`, which reads a file that is larger than the memory.

    Returns
    -------
    xarray.Dataset
        The written data; values from EXR files have 32 bits. See :func:`mitransient_lidar.results.files.open` and
        :func:`mitransient_lidar.campaigns.store.open_campaign`.

    Raises
    ------
    UserError
        If nothing of this package is there, or it is damaged.
    """
    from mitransient_lidar.core.files import checked_path
    from mitransient_lidar.results.files import open as open_file

    place = checked_path("path", path)
    for store in (place, place / "flight.zarr"):
        if (store / "zarr.json").exists():
            from mitransient_lidar.campaigns.store import open_campaign

            return open_campaign(store)
    return open_file(place, waveforms=waveforms, channel=channel, lidar=lidar)


def save(dataset: xarray.Dataset, path: str | os.PathLike[str]) -> None:
    """Write any dataset of this package to a file, whose suffix is its format; an existing file is replaced.

    Parameters
    ----------
    dataset : xarray.Dataset
        The dataset.
    path : path
        ``.nc`` is NetCDF-4, for any dataset; ``.exr`` OpenEXR, for waveforms, gates or daylight images; ``.csv`` a text
        table with echoes or bounds. Without a suffix, gates become a sequence of EXR files, one per gate. See
        :func:`mitransient_lidar.results.files.save`.

    Raises
    ------
    UserError
        If the suffix is another one, the format cannot store the dataset, or the file cannot be written.
    """
    from mitransient_lidar.core.files import checked_path
    from mitransient_lidar.results.files import dataset_of
    from mitransient_lidar.results.files import save as save_file

    if checked_path("path", path).suffix.lower() != ".csv":
        save_file(dataset, path)
    elif "bound" in dataset_of("dataset", dataset, "echoes", "bounds"):
        from mitransient_lidar.studies.bounds import write_table

        write_table(dataset, path)
    else:
        from mitransient_lidar.analysis.waveforms.csv_tables import save_csv

        save_csv(dataset, path)
