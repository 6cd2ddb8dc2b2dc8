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

if TYPE_CHECKING:
    from collections.abc import Mapping

    import xarray

    from mitransient_lidar.analysis.gates.cut import cut_gates
    from mitransient_lidar.analysis.receiver import detect_waveforms as record
    from mitransient_lidar.analysis.retrieval.retrieve import retrieve
    from mitransient_lidar.analysis.waveforms.depth_correction import correct_depths
    from mitransient_lidar.analysis.waveforms.echo_table import extract as waveforms
    from mitransient_lidar.campaigns.sweep import sweep
    from mitransient_lidar.loading.catalogue import scene_names, scene_parameters
    from mitransient_lidar.loading.instruments import instrument_names, read_instrument
    from mitransient_lidar.rendering.passes import ProgressCallback
    from mitransient_lidar.rendering.shot_series import render_shots
    from mitransient_lidar.studies.depth_bias import depth_bias
    from mitransient_lidar.studies.detection import detect
    from mitransient_lidar.studies.estimate import estimate

#: Functions by the modules that are imported when they are first used.
_FUNCTIONS = {
    "correct_depths": ("analysis.waveforms.depth_correction", "correct_depths"),
    "cut_gates": ("analysis.gates.cut", "cut_gates"),
    "depth_bias": ("studies.depth_bias", "depth_bias"),
    "detect": ("studies.detection", "detect"),
    "estimate": ("studies.estimate", "estimate"),
    "instrument_names": ("loading.instruments", "instrument_names"),
    "read_instrument": ("loading.instruments", "read_instrument"),
    "record": ("analysis.receiver", "detect_waveforms"),
    "render_shots": ("rendering.shot_series", "render_shots"),
    "retrieve": ("analysis.retrieval.retrieve", "retrieve"),
    "scene_names": ("loading.catalogue", "scene_names"),
    "scene_parameters": ("loading.catalogue", "scene_parameters"),
    "sweep": ("campaigns.sweep", "sweep"),
    "waveforms": ("analysis.waveforms.echo_table", "extract"),
}

__all__ = [
    "__version__",
    "correct_depths",
    "cut_gates",
    "depth_bias",
    "detect",
    "estimate",
    "instrument_names",
    "open",
    "read_instrument",
    "record",
    "render",
    "render_shots",
    "retrieve",
    "scene_names",
    "scene_parameters",
    "sweep",
    "waveforms",
]


def __getattr__(name: str) -> Any:
    """Import a function when it is first used."""
    if name not in _FUNCTIONS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, function = _FUNCTIONS[name]
    found = getattr(importlib.import_module(f"{__name__}.{module}"), function)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """Return the names of the functions that are imported later, too."""
    return sorted({*globals(), *_FUNCTIONS})


def render(
    scene: str | Path | Mapping[str, Any] | _mi.Scene | xarray.Dataset,
    *,
    params: Mapping[str, Any] | None = None,
    instrument: str | None = None,
    integrator: str | Mapping[str, Any] | _mi.Integrator | None = None,
    target_error: float | None = None,
    target_quantile: float | None = None,
    max_time: float | None = None,
    passes: int | None = None,
    seed: int | None = None,
    max_memory: float | None = None,
    pass_share: float | None = None,
    components: bool | None = None,
    variant: str | None = None,
    progress: ProgressCallback | None = None,
    **others: Any,
) -> xarray.Dataset:
    """Render a lidar scene to an accuracy, or a result again.

    Parameters
    ----------
    scene
        Name of a shipped scene, path of a Mitsuba XML file, dict for ``mitsuba.load_dict``, or a loaded scene; or a
        result (a dataset, or its EXR or NetCDF file), which is rendered again with its own options unless others are
        given.
    params
        Values for the ``<default>`` parameters of an XML scene.
    instrument
        Name of the instrument whose laser and receiver replace those of the scene; see `instrument_names`.
    integrator
        Name or dict of an integrator plugin, or an integrator; by default that of the scene.
    target_error, target_quantile
        Relative standard error, greater than 0, that ends the render, and the share of the bins or gates that must have
        reached it, 0.01 to 1; 0.03 and 0.95 by default.
    max_time
        Longest time for the passes [s], greater than 0; 300 by default.
    passes
        Number of passes, 2 to 10^9, instead of an error.
    seed
        Integer from -2^63 to 2^63 - 1, 0 by default; the same seed gives the same result on the same machine.
    max_memory
        Memory for histograms, means and errors [GB], greater than 0; 2 by default.
    pass_share
        Share of the paths of a full pass in each pass, 1/512 to 1.
    components
        Whether to separate the light by its origin.
    variant
        ``llvm_ad_mono`` or ``cuda_ad_mono``.
    progress
        Called with a `rendering.passes.Progress` after every pass.
    others
        Options of `render_shots` or of daylight images, for results of these.

    Returns
    -------
    xarray.Dataset
        Impulse response [J per bin] and waveform [W] with standard errors, or gates; as of `rendering.render.render`,
        `rendering.again.render_again` and `rendering.shot_series.render_shots_again`.

    Raises
    ------
    UserError
        If the scene, the result, a parameter or an option is invalid, or no light returns.
    """
    options = {name: value for name, value in locals().items() if name not in ("scene", "others") and value is not None}
    from mitransient_lidar.rendering import again
    from mitransient_lidar.rendering.render import render as render_scene

    if not again.is_result(scene):
        return render_scene(scene, **options, **others)
    result: Any = scene
    if again.result_kind(again.read_attributes(result)) != "shots":
        return again.render_again(result, **options, **others)
    from mitransient_lidar.rendering.shot_series import render_shots_again

    return render_shots_again(result, **options, **others)


def open(path: str | Path) -> xarray.Dataset:  # the name that xarray and this project's users expect
    """Read a result from an EXR stack or a NetCDF file, signals of a receiver, or the store of a campaign.

    See :func:`mitransient_lidar.results.dataset.open` and :func:`mitransient_lidar.campaigns.store.open_campaign`.
    """
    if Path(path).is_dir():
        from mitransient_lidar.campaigns.store import open_campaign

        return open_campaign(path)
    from mitransient_lidar.results.dataset import open as open_result

    return open_result(path, signals=True)
