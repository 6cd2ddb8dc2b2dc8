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

    from mitransient_lidar.analysis.depth_uncertainty import SURVEY_ORDERS as SURVEY_ORDERS
    from mitransient_lidar.analysis.gates.cut import cut_gates as cut_gates
    from mitransient_lidar.analysis.gates.range_images import depth_image as depth_image
    from mitransient_lidar.analysis.receiver import record as record
    from mitransient_lidar.analysis.retrieval.retrieve import retrieve as retrieve
    from mitransient_lidar.analysis.waveforms.depth_correction import correct_depths as correct_depths
    from mitransient_lidar.analysis.waveforms.echo_table import echoes as echoes
    from mitransient_lidar.campaigns.sweep import campaign as campaign
    from mitransient_lidar.flights.fly import fly as fly
    from mitransient_lidar.loading.catalogue import instrument_names as instrument_names
    from mitransient_lidar.loading.catalogue import read_instrument as read_instrument
    from mitransient_lidar.loading.catalogue import scene_names as scene_names
    from mitransient_lidar.loading.catalogue import scene_parameters as scene_parameters
    from mitransient_lidar.loading.scenes import open_scene as open_scene
    from mitransient_lidar.physics.lidar.gate_train import GateTrain as GateTrain
    from mitransient_lidar.physics.sea.kelvin_wake import kelvin_wake as kelvin_wake
    from mitransient_lidar.physics.water.profiles import read_profile as read_profile
    from mitransient_lidar.physics.water.water_types import water_of as water_of
    from mitransient_lidar.plots.publication.figures import figures as figures
    from mitransient_lidar.plots.viewer import view as view
    from mitransient_lidar.plots.viewer import view_points as view_points
    from mitransient_lidar.plots.viewer import view_scene as view_scene
    from mitransient_lidar.rendering.passive import render_passive as render_passive
    from mitransient_lidar.rendering.render import render as render
    from mitransient_lidar.rendering.shots.frames import render_frames as render_frames
    from mitransient_lidar.rendering.shots.series import render_shots as render_shots
    from mitransient_lidar.results.waveform_files import waveform_chunks as waveform_chunks
    from mitransient_lidar.studies.bounds import bounds as bounds
    from mitransient_lidar.studies.depth_bias import depth_bias as depth_bias
    from mitransient_lidar.studies.depth_bias import tpu as tpu
    from mitransient_lidar.studies.detection import detect as detect
    from mitransient_lidar.studies.fit import fit as fit
    from mitransient_lidar.studies.forecast import forecast as forecast
    from mitransient_lidar.studies.light_classes import scattering as scattering

#: Public names by the modules that are imported when they are first used.
_NAMES = {
    "analysis.depth_uncertainty": "SURVEY_ORDERS",
    "analysis.gates.cut": "cut_gates",
    "analysis.gates.range_images": "depth_image",
    "analysis.receiver": "record",
    "analysis.retrieval.retrieve": "retrieve",
    "analysis.waveforms.depth_correction": "correct_depths",
    "analysis.waveforms.echo_table": "echoes",
    "campaigns.sweep": "campaign",
    "flights.fly": "fly",
    "loading.catalogue": "instrument_names read_instrument scene_names scene_parameters",
    "loading.scenes": "open_scene",
    "physics.lidar.gate_train": "GateTrain",
    "physics.sea.kelvin_wake": "kelvin_wake",
    "physics.water.profiles": "read_profile",
    "physics.water.water_types": "water_of",
    "plots.publication.figures": "figures",
    "plots.viewer": "view view_points view_scene",
    "rendering.passive": "render_passive",
    "rendering.render": "render",
    "rendering.shots.frames": "render_frames",
    "rendering.shots.series": "render_shots",
    "results.waveform_files": "waveform_chunks",
    "studies.bounds": "bounds",
    "studies.depth_bias": "depth_bias tpu",
    "studies.detection": "detect",
    "studies.fit": "fit",
    "studies.forecast": "forecast",
    "studies.light_classes": "scattering",
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}

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
__all__ = [*_MODULES, "__version__", "save"]


def __getattr__(name: str) -> Any:
    """Import a function when it is first used."""
    if name in _FORMER:
        raise AttributeError(f"{__name__}.{name} is now {_FORMER[name]}")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """Return the names of the functions that are imported later, too."""
    return sorted({*globals(), *_MODULES})


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
