"""Interactive views for results, scenes and points: pages for a browser, and below a notebook cell."""

from __future__ import annotations

import contextlib
import html
import os
import shutil
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import checked_path, replacing
from mitransient_lidar.plots.drawing import scene_name
from mitransient_lidar.plots.gate_viewer.page import page_text
from mitransient_lidar.results.files import Given, dataset_of

_NOTEBOOK_MB = 10.0  # per page in a notebook, which is stored with it
_FOLDER, _KEPT_S = "mitransient-lidar-view-", 3600.0  # for temporary pages


class View:
    """Page of `view`, `view_scene` or `view_points`. A notebook shows it below the cell whose last value it is.

    `page`: HTML text, which needs no network. `height`: height below a cell [CSS pixels].
    """

    def __init__(self, page: str, name: str, height: int) -> None:
        self.page: str = page
        self.height: int = height
        self._name = name

    def _repr_html_(self) -> str:
        # A sandbox without the notebook's origin: the page's scripts reach nothing in it; they may offer files to save.
        return (
            f'<iframe sandbox="allow-scripts allow-downloads" srcdoc="{html.escape(self.page)}" '
            f'title="{html.escape(self._name)}" style="width: 100%; height: {self.height}px; border: 0"></iframe>'
        )

    def __repr__(self) -> str:
        return f"<view of {self._name}, {1e-6 * len(self.page):.1f} MB>"

    def save(self, path: str | os.PathLike[str] | None = None) -> Path:
        """Write the page to a file, by default a new one in the folder for temporary files, and return its path.

        The same user's files are removed an hour later by the next call, when their browser has long read them.

        Raises `UserError` if the file name does not end in ``.html``, or the file cannot be written.
        """
        if path is None:
            _remove_former_pages()
            path = Path(tempfile.mkdtemp(prefix=_FOLDER)) / "view.html"
        path = Path(path)
        if path.suffix.lower() != ".html":
            raise UserError(f"cannot write {path}: the file name must end in .html")
        with replacing(path) as temporary:
            temporary.write_text(self.page, encoding="utf-8")
        return path


def _remove_former_pages() -> None:
    """Remove this user's temporary page folders that are an hour old."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_FOLDER}*"):
        with contextlib.suppress(OSError):
            found = folder.lstat()
            if found.st_uid == os.getuid() and time.time() - found.st_mtime > _KEPT_S:
                shutil.rmtree(folder)


def view(result: Given, waveforms: Given | None = None, *, height: int = 640, limit_mb: float = _NOTEBOOK_MB) -> View:
    """Return a page that shows a result, which a notebook shows below the cell.

    Parameters
    ----------
    result : xarray.Dataset
        A result, a receiver's or camera's record, or a gate stack: see `plots.gate_viewer.page.page_text`.
    waveforms : xarray.Dataset, optional
        A render with a gate stack's pixels.
    height : int
        Height in a notebook [CSS pixels].
    limit_mb : float
        Largest page size [MB of 1e6 bytes]; larger pages show means over pixel blocks.

    Raises
    ------
    UserError
        If the result has neither gates nor a record in time, or `limit_mb` is too small for it.
    """
    result = dataset_of("result", result, "waveforms", "signals", "gates", "frames")
    if waveforms is not None:
        waveforms = dataset_of("waveforms", waveforms, "waveforms")
    name = scene_name(result.attrs) or "result"
    return View(page_text(result, waveforms, limit_mb), name, height)


def view_scene(
    scene: Any, params: Mapping[str, Any] | None = None, instrument: str | None = None, *, height: int = 640
) -> View:
    """Return a page that shows a scene in three dimensions to scale, which a notebook shows below the cell.

    It shows the sea and the bottom as the renderer's rays meet them, targets, boundaries between water layers, the
    beam, and each pixel's field of view. All have their names and numbers.

    Parameters
    ----------
    scene, params, instrument
        As in `loading.scenes.open_scene`.
    height : int
        Height in a notebook [CSS pixels].

    Raises
    ------
    UserError
        As `open_scene`, and if the scene has no receiver.
    """
    from mitransient_lidar.loading.scenes import open_scene
    from mitransient_lidar.plots.scene_viewer import page
    from mitransient_lidar.rendering.geometry import scene_geometry

    geometry = scene_geometry(open_scene(scene, params, instrument))
    about = page.scene_views(geometry), page.scene_notes(geometry)
    return View(page.page_text(geometry.name, "scene", [*page.scene_traces(geometry)], *about), geometry.name, height)


def view_points(source: str | os.PathLike[str], *, height: int = 640) -> View:
    """Return a page that shows a flight's points in three dimensions, which a notebook shows below the cell.

    Points have their class's colour, and their heights with errors: against the truth in a flight's store, and as
    stated by the file.

    Parameters
    ----------
    source : path
        A flight's folder or store (``flight.zarr``), or a LAS or LAZ file from any program.
    height : int
        Height in a notebook [CSS pixels].

    Raises
    ------
    UserError
        If it is no such store or file, or has no points.
    """
    from mitransient_lidar.flights.products import read_points
    from mitransient_lidar.plots.scene_viewer import page

    path = checked_path("source", source)
    points = read_points(path)
    name = path.parent.name if path.name == "flight.zarr" else path.stem
    about = page.point_views(points), page.point_notes(points)
    return View(page.page_text(name, "points", [*page.point_traces(points)], *about), name, height)
