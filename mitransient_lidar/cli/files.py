"""Output files of the commands: checks before a render, figures with their data, and gate stack files."""

from __future__ import annotations

import contextlib
import glob
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from mitransient_lidar.cli.overwriting import check_kept
from mitransient_lidar.core.errors import UserError, WriteError
from mitransient_lidar.core.files import check_encodable, together

if TYPE_CHECKING:
    import xarray as xr

    from mitransient_lidar.plots.viewer import View


def check_targets(folder: Path, targets: list[Path], source: str = "", option: str = "-o") -> None:
    """Check that files can be written into a folder, without creating it, and that none must be kept.

    None may be the result `source`, which is rendered again; `option` chooses another place.
    """
    for path in (folder, *targets):
        check_encodable(path)
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise UserError(f"cannot write to folder {folder}: {error.strerror}") from error
    for target in targets:
        if target.is_dir():
            raise UserError(f"cannot write {target}: it is a folder")
        if source and target.exists() and Path(source).exists() and target.samefile(source):
            raise UserError(f"{source} would be overwritten with its repetition: choose another place with -o")
    check_kept(targets, option)


def scene_of(scene: str, command: str) -> tuple[str, str, dict[str, Any]]:
    """Return a scene's name and text; for a result its scene's, and its attributes. Refuse another command's result."""
    from mitransient_lidar.loading.catalogue import scene_path, scene_text
    from mitransient_lidar.loading.scene_source import SceneSource
    from mitransient_lidar.rendering import again

    if not again.is_result(scene):
        return scene_path(scene).stem, scene_text(scene), {}
    attributes = again.read_attributes(scene)
    if (kind := again.result_kind(attributes)) != command:
        raise UserError(f"{scene} is a result of the command {kind}: use {kind} to render it again")
    source = SceneSource.from_attributes(attributes)
    return source.name, source.text, attributes


def check_figure(path: Path | None, *suffixes: str, option: str = "-o") -> None:
    """Check that a figure can be written, and its data files beside it, with other suffixes."""
    if path is None:
        return
    from mitransient_lidar.plots.drawing import check_format

    check_format(path)
    check_targets(path.parent, [path, *map(path.with_suffix, suffixes)], option=option)


def check_suffix(option: str, path: Path, suffix: str) -> None:
    """Check that a file can be written and that its name ends with a suffix."""
    if path.suffix.lower() != suffix:
        raise UserError(f"{option} {path} must end in {suffix}")
    check_targets(path.parent, [path], option="-o" if option == "--output" else option)


@contextlib.contextmanager
def announced(*folders: Path | None) -> Iterator[None]:
    """Move all files of this context to their places at its end, in folders that it makes, and print their paths."""
    for folder in filter(None, folders):
        folder.mkdir(parents=True, exist_ok=True)
    with together() as written:
        yield
    for path in written:
        typer.echo(path)


def write_netcdf(dataset: xr.Dataset, path: Path) -> None:
    """Write a dataset to a NetCDF file, and print its path."""
    from mitransient_lidar.results import save

    with announced(path.parent):
        save(dataset, path)


def write_page(page: View, path: Path | None) -> Path:
    """Write a page, by default to a temporary file, print its path and return it."""
    with announced(path and path.parent):
        return page.save(path)


_LARGE = 2**28  #: Gate stacks that are drawn, and written to EXR files, in single precision [bytes].
PAGE_MB = 200.0  #: Largest size of a page [MB].


@dataclass(frozen=True)
class GateFiles:
    """Files of a gate stack in a folder, with the stem of their names.

    Kinds in addition to the EXR stack: ``drawings`` (of gates and depths), ``sequence``, ``tiff``, ``images`` (PNG),
    ``gif``, ``mp4``, ``html``.
    """

    folder: Path
    stem: str
    wanted: frozenset[str]

    @classmethod
    def of(cls, folder: Path, stem: str, **wanted: bool) -> GateFiles:
        """Return a gate stack's files, given the file kind options; refuse a movie without ffmpeg."""
        if wanted.get("mp4"):
            from mitransient_lidar.plots.gates.images import find_ffmpeg

            find_ffmpeg(folder / f"{stem}_gates.mp4")
        return cls(folder, stem, frozenset(kind for kind, on in wanted.items() if on))

    def check(self) -> None:
        """Check that the files can be written."""
        numbered = f"{glob.escape(self.stem)}_gate[0-9]*.exr"
        sequence = sorted(self.folder.glob(numbered)) if "sequence" in self.wanted else []
        if "images" in self.wanted:
            sequence += sorted(self.folder.glob(f"{glob.escape(self.stem)}_*gate[0-9]*.png"))
        check_targets(self.folder, [*self.names(), *sequence])

    def names(self) -> list[Path]:
        """Return the file paths, without sequence files."""
        endings = ["_gates.exr", *(["_gates.png", "_depth.png"] if "drawings" in self.wanted else [])]
        endings += [f"_gates.{kind}" for kind in ("gif", "mp4", "html") if kind in self.wanted]
        endings += ["_gates.tif"] * ("tiff" in self.wanted)
        return [self.folder / f"{self.stem}{ending}" for ending in endings]

    def write(self, stack: xr.Dataset, result: xr.Dataset | None, quiet: bool) -> None:
        """Write the files and print their paths; `result` provides the waveforms for the page."""
        from mitransient_lidar import results
        from mitransient_lidar.plots.gates import images
        from mitransient_lidar.plots.viewer import view
        from mitransient_lidar.results import exr
        from mitransient_lidar.results.gate_stack import as_stack, check_stack, has_frames

        frames = has_frames(stack)
        if not frames and stack.nbytes > _LARGE:
            _make_single(stack)
        drawn = as_stack(stack)
        for path in self.names():
            if path.suffix in (".gif", ".mp4"):
                images.check_animation(drawn, path)
        with announced(self.folder):
            for path in self.names():
                if path.suffix == ".tif" or (path.suffix == ".exr" and frames):
                    results.save(stack, path)
                elif path.suffix == ".exr":
                    results.save(check_stack(stack), path)
                elif path.suffix == ".html":
                    record = result if result is not None and "waveform" in result else None
                    view(stack, record, limit_mb=PAGE_MB).save(path)
                elif path.suffix != ".png":
                    images.animate_gates(stack, path)
                elif path.name.endswith("_gates.png"):
                    images.plot_gates(stack, path)
                else:
                    _draw_depths(stack, path, quiet)
            if "images" in self.wanted:
                results.save(stack, self.folder / f"{self.stem}.png")
            if "sequence" in self.wanted:
                exr.write_sequence(drawn if frames else check_stack(stack), self.folder, self.stem)


def _make_single(stack: xr.Dataset) -> None:
    """Change the energies of a stack to single precision, as EXR files have them, gate by gate in the file's order."""
    import numpy as np

    for name in ("gate_energy", "gate_energy_stderr"):
        dims, values = stack[name].dims, np.moveaxis(stack[name].values, -1, 0)
        images = np.empty(values.shape, np.float32)
        for image, own in zip(images, values, strict=True):
            image[...] = own
        stack[name] = (dims, np.moveaxis(images, 0, -1), stack[name].attrs)


def _draw_depths(stack: xr.Dataset, path: Path, quiet: bool) -> None:
    """Draw the depths of the echoes in the gates, if enough gates are below the surface."""
    from mitransient_lidar.plots.gates.echoes import plot_depths

    try:
        plot_depths(stack, path)
    except WriteError:
        raise
    except UserError as error:
        if not quiet:
            typer.echo(f"no depth drawing: {error}", err=True)
