"""All figures in the publication, and the table with its statements."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

from matplotlib.figure import Figure

from mitransient_lidar.core.errors import UserError, is_interruption
from mitransient_lidar.core.files import together
from mitransient_lidar.core.options import Option, checked, positive_option
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.plots import drawing
from mitransient_lidar.plots.publication import waveforms
from mitransient_lidar.rendering.passes import ProgressCallback
from mitransient_lidar.studies.cases import Cases
from mitransient_lidar.studies.publication import quantities
from mitransient_lidar.studies.publication.scenes import Renders
from mitransient_lidar.studies.publication.statements import Measured, Statement, statements_of, write_statements

_LOG = logging.getLogger(__name__)

TABLE = "statements.csv"  #: File for the statements.


class _Figure(NamedTuple):
    """How a figure is drawn, and the quantities in the statements that it shows."""

    draw: Callable[[Renders], Figure]
    measure: Callable[[Renders], Mapping[str, Measured]] = lambda _renders: {}


_FIGURES = {
    "fig01b": _Figure(waveforms.example, quantities.backscatter),
    "fig02": _Figure(waveforms.mine, quantities.sphere),
    "fig04": _Figure(waveforms.mast, quantities.mast),
    "fig05": _Figure(waveforms.system, quantities.system),
    "fig06": _Figure(waveforms.mesh),
    "fig08": _Figure(waveforms.pixels, quantities.pixel_shapes),
    "fig09": _Figure(waveforms.pixels_over_bottom, quantities.pixels_over_bottom),
    "fig10": _Figure(waveforms.surface_echoes, quantities.surface_echoes),
    "fig11": _Figure(waveforms.bottom_echoes, quantities.bottom_echoes),
    "fig12": _Figure(waveforms.paths, quantities.paths),
    "fig13": _Figure(waveforms.square_target, quantities.square_target),
    "fig14": _Figure(waveforms.strip_target, quantities.strip_target),
    "fig15": _Figure(waveforms.layered, quantities.layer_delays),
    "fig16": _Figure(waveforms.layer_zoom, quantities.layer_durations),
}

NAMES = tuple(_FIGURES)  #: Figure names.


@dataclass(frozen=True)
class Publication:
    """Files that were written, the figures' statements, and whether an interruption ended the work."""

    files: tuple[Path, ...]
    statements: tuple[Statement, ...]
    interrupted: bool = False


@checked
@alone
def figures(
    names: Annotated[
        Sequence[str] | None, Option("Figures, such as fig09; by default all", form="[NAME]...", is_argument=True)
    ] = None,
    output: str | os.PathLike[str] = "output/figures",
    *,
    target_error: Annotated[float, Option("Relative standard error of the median bin", 0, 1, above=True)] = 0.01,
    max_time: Annotated[float | None, positive_option("Begin no figure after this many seconds")] = None,
    seed: Annotated[int, Option("Random seed", 0, 2**31)] = 0,
    progress: ProgressCallback | None = None,
) -> Publication:
    """Make the figures for FOI's multipixel lidar model (Tulldahl 2006), and the table with its statements.

    Parameters
    ----------
    names
        Figures, of ``fig01b``, ``fig02``, ``fig04`` to ``fig06``, and ``fig08`` to ``fig16``; by default all.
    output
        Folder, made if needed. Each figure becomes a file such as ``fig09.png``, and the table with their statements
        ``statements.csv``. Every file is moved into its place when it is complete.
    target_error
        Relative standard error of the median bin, greater than 0. Figure 4, which converges slowly, may miss it, with a
        warning.

    Returns
    -------
    Publication
        File paths in figure order, the table last; the statements; and whether Ctrl-C ended the work. Files and
        statements then belong to the figures completed by then.

    Raises
    ------
    UserError
        If a name is unknown or a number is out of range.
    WriteError
        If a file cannot be written.
    """
    chosen = check_names(names)
    renders = Renders(target_error, seed, progress)
    folder = Path(output)
    folder.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    found: list[Statement] = []
    interrupted = False
    try:
        cases = Cases(chosen, "figures", max_time=max_time)
        for name in cases:
            _LOG.info("%s, %d of %d", name, cases.begun, len(chosen))
            figure = _FIGURES[name]
            stated = statements_of(name, figure.measure(renders))
            path = folder / f"{name}.png"
            # The table holds the statements of the figures that are there, even if the process is killed.
            with together():
                drawing.save(figure.draw(renders), path)
                write_statements([*found, *stated], folder / TABLE)
            files.append(path)
            cases.kept += 1
            found += stated
    except (KeyboardInterrupt, RuntimeError) as error:
        if not is_interruption(error):
            raise
        interrupted = True
    if files:
        files.append(folder / TABLE)
    return Publication(tuple(files), tuple(found), interrupted)


def check_names(names: Sequence[str] | None) -> list[str]:
    """Return figure names in the publication's order, by default all; raise `UserError` for unknown ones."""
    for name in names or ():
        if name not in NAMES:
            raise UserError(f"figure {name!r} must be one of {', '.join(NAMES)}")
    return [name for name in NAMES if not names or name in names]
