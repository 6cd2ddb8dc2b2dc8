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
    import xarray

__all__ = ["__version__", "open", "render", "render_shots", "sweep"]


def render(scene: Any, **options: Any) -> xarray.Dataset:
    """Render a lidar scene to an accuracy, or a result (a dataset, or its file) again.

    See :func:`mitransient_lidar.rendering.render.render`, :func:`mitransient_lidar.rendering.again.render_again` and,
    for series of shots, :func:`mitransient_lidar.studies.shot_series.render_shots_again`.
    """
    from mitransient_lidar.rendering import again
    from mitransient_lidar.rendering.render import render as render_scene

    if not again.is_result(scene):
        return render_scene(scene, **options)
    if again.result_kind(again.read_attributes(scene)) != "shots":
        return again.render_again(scene, **options)
    from mitransient_lidar.studies.shot_series import render_shots_again

    return render_shots_again(scene, **options)


def render_shots(scene: Any, params: Any = None, **options: Any) -> xarray.Dataset:
    """Render shots at given or random places of one sea, many at a time, with the truth of each place.

    See :func:`mitransient_lidar.studies.shot_series.render_shots`.
    """
    from mitransient_lidar.studies.shot_series import render_shots as render_series

    return render_series(scene, params, **options)


def sweep(campaign: Any, store: str | Path, **options: Any) -> xarray.Dataset:
    """Render a campaign of many runs into a Zarr store; see :func:`mitransient_lidar.campaigns.sweep.sweep`."""
    from mitransient_lidar.campaigns.sweep import sweep as render_campaign

    return render_campaign(campaign, store, **options)


def open(path: str | Path) -> xarray.Dataset:  # the name that xarray and this project's users expect
    """Read a result from an EXR stack or a NetCDF file, or the store of a campaign.

    See :func:`mitransient_lidar.results.dataset.open` and :func:`mitransient_lidar.campaigns.store.open_campaign`.
    """
    if Path(path).is_dir():
        from mitransient_lidar.campaigns.store import open_campaign

        return open_campaign(path)
    from mitransient_lidar.results.dataset import open as open_result

    return open_result(path)
