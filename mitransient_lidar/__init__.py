"""Simulator of multipixel depth-sounding lidar, built on Mitsuba 3 and Dr.Jit.

Importing the package finds LLVM, chooses a Mitsuba variant when none is set, and registers the plugins, so
that plain Mitsuba loads and renders lidar scenes::

    import mitransient_lidar  # before mitsuba: it finds LLVM for Dr.Jit
    import mitsuba as mi

    scene = mi.load_file("scene.xml")
    energy = mi.render(scene)  # received energy in J, (pixel, time)

:func:`render` renders to an accuracy instead and returns waveforms with standard errors as an
``xarray.Dataset``; :func:`open` reads such a result back from an EXR stack or a NetCDF file.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitransient_lidar._version import __version__

if importlib.util.find_spec("mitransient_lidar.plugins") is None:
    # Run from the repository root, this folder shadows the installed package; plugins/ and scenes/ lie beside it.
    __path__.append(str(Path(__file__).resolve().parent.parent))

from mitransient_lidar.core.errors import UserError as _UserError
from mitransient_lidar.core.renamed import FUNCTIONS as _FORMER
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
    import xarray

    from mitransient_lidar.analysis.gates.cut import cut_gates
    from mitransient_lidar.analysis.receiver import detect_waveforms as record
    from mitransient_lidar.analysis.retrieval.retrieve import retrieve
    from mitransient_lidar.analysis.waveforms.depth_correction import correct_depths
    from mitransient_lidar.analysis.waveforms.echo_table import extract as echoes
    from mitransient_lidar.campaigns.sweep import campaign
    from mitransient_lidar.flights.fly import fly
    from mitransient_lidar.loading.catalogue import scene_names, scene_parameters
    from mitransient_lidar.loading.instruments import instrument_names, read_instrument
    from mitransient_lidar.plots.publication.figures import figures
    from mitransient_lidar.plots.viewer import view
    from mitransient_lidar.rendering.render import render
    from mitransient_lidar.rendering.shots.series import render_shots
    from mitransient_lidar.studies.bounds import bounds
    from mitransient_lidar.studies.depth_bias import depth_bias
    from mitransient_lidar.studies.detection import detect
    from mitransient_lidar.studies.estimate import estimate
    from mitransient_lidar.studies.fit import fit
    from mitransient_lidar.studies.tpu import tpu

#: Functions by the modules that are imported when they are first used.
_FUNCTIONS = {
    "bounds": ("studies.bounds", "bounds"),
    "campaign": ("campaigns.sweep", "campaign"),
    "correct_depths": ("analysis.waveforms.depth_correction", "correct_depths"),
    "cut_gates": ("analysis.gates.cut", "cut_gates"),
    "depth_bias": ("studies.depth_bias", "depth_bias"),
    "detect": ("studies.detection", "detect"),
    "echoes": ("analysis.waveforms.echo_table", "extract"),
    "estimate": ("studies.estimate", "estimate"),
    "figures": ("plots.publication.figures", "figures"),
    "fit": ("studies.fit", "fit"),
    "fly": ("flights.fly", "fly"),
    "instrument_names": ("loading.instruments", "instrument_names"),
    "read_instrument": ("loading.instruments", "read_instrument"),
    "record": ("analysis.receiver", "detect_waveforms"),
    "render": ("rendering.render", "render"),
    "render_shots": ("rendering.shots.series", "render_shots"),
    "retrieve": ("analysis.retrieval.retrieve", "retrieve"),
    "scene_names": ("loading.catalogue", "scene_names"),
    "scene_parameters": ("loading.catalogue", "scene_parameters"),
    "tpu": ("studies.tpu", "tpu"),
    "view": ("plots.viewer", "view"),
}

__all__ = [
    "__version__",
    "bounds",
    "campaign",
    "correct_depths",
    "cut_gates",
    "depth_bias",
    "detect",
    "echoes",
    "estimate",
    "figures",
    "fit",
    "fly",
    "instrument_names",
    "open",
    "read_instrument",
    "record",
    "render",
    "render_shots",
    "retrieve",
    "scene_names",
    "scene_parameters",
    "tpu",
    "view",
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


def open(path: str | Path) -> xarray.Dataset:  # the name that xarray and this project's users expect
    """Read a result from an EXR stack or a NetCDF file, signals of a receiver, or the store of a campaign.

    See :func:`mitransient_lidar.results.dataset.open` and :func:`mitransient_lidar.campaigns.store.open_campaign`.
    """
    if Path(path).is_dir():
        from mitransient_lidar.campaigns.store import open_campaign

        return open_campaign(path)
    from mitransient_lidar.results.dataset import open as open_result

    return open_result(path, signals=True)
