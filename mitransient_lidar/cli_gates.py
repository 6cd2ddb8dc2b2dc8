"""The command that cuts gates from a result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mitransient_lidar.cli_studies import Quiet
from mitransient_lidar.cli_support import reporting, require, require_writable, sentences
from mitransient_lidar.errors import UserError

if TYPE_CHECKING:
    import xarray as xr


def gates(
    stack: Annotated[Path, typer.Argument(metavar="STACK", help="An EXR or NetCDF result that kept its histogram.")],
    start_ns: Annotated[float | None, typer.Option(help="Half height of the first gate's rising edge [ns].")] = None,
    start_depth: Annotated[float | None, typer.Option(help="The same as a depth [m] instead of a time.")] = None,
    width_ns: Annotated[float | None, typer.Option(help="Width of a gate between half heights [ns].")] = None,
    step_ns: Annotated[float | None, typer.Option(help="Time from gate to gate [ns]; by default the width.")] = None,
    count: Annotated[int, typer.Option(help="Number of gates.")] = 1,
    rise_ns: Annotated[float, typer.Option(help="10-90 % time of the rising edge [ns].")] = 0.0,
    fall_ns: Annotated[float, typer.Option(help="90-10 % time of the falling edge [ns].")] = 0.0,
    profile: Annotated[
        Path | None, typer.Option(help="Measured gate instead of width and edges: columns time [ns], transmission.")
    ] = None,
    pulses: Annotated[int, typer.Option(help="Pulses that a gate adds up.")] = 1,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", "--out", help="Folder for the files; by default that of STACK.")
    ] = None,
    plot: Annotated[bool, typer.Option("--plot/--no-plot", help="Draw all gates, and the depth they see.")] = True,
    sequence: Annotated[bool, typer.Option("--sequence", help="Write numbered EXR files, one a gate, too.")] = False,
    gif: Annotated[bool, typer.Option("--gif", help="Write an animation, too.")] = False,
    mp4: Annotated[bool, typer.Option("--mp4", help="Write a movie, too; needs ffmpeg.")] = False,
    html: Annotated[bool, typer.Option("--html", help="Write a page to look at in a browser, too.")] = False,
    quiet: Quiet = False,
) -> None:
    """Cut gates from STACK: DIR/<stack>_gates.exr, _gates.png (all gates) and _depth.png; print their paths.

    Without a start the gates that STACK already has are drawn and written as they are.
    """
    with sentences():
        require(1 <= count <= 100_000, "--count", count, "1 to 100000")
        require(pulses >= 1, "--pulses", pulses, "1 or above")
        folder = output or stack.parent
        wanted = {"drawings": plot, "sequence": sequence, "gif": gif, "mp4": mp4, "html": html}
        files = GateFiles(
            folder, stack.stem.removesuffix("_gates"), frozenset(name for name, on in wanted.items() if on)
        )
        require_writable(folder, files.names())

        from mitransient_lidar import gating

        with reporting(quiet):
            result = _open(stack)
            if "gate_energy" in result and start_ns is None and start_depth is None:
                files.write(result, result, quiet)
                return
            train = gating.train_from_options(
                result.attrs,
                start_ns=start_ns,
                start_depth_m=start_depth,
                width_ns=width_ns,
                step_ns=step_ns,
                count=count,
                rise_ns=rise_ns,
                fall_ns=fall_ns,
                profile_file=profile,
                pulses=pulses,
            )
            cut = gating.cut_gates(result, train)
            files.write(cut, result, quiet)


@dataclass(frozen=True)
class GateFiles:
    """Files of a gate stack, and which of them are wanted.

    Parameters
    ----------
    folder, stem
        Where they go, and what their names begin with.
    wanted
        Of ``drawings`` (all gates, and the depths they see), ``sequence``, ``gif``, ``mp4`` and ``html``.
    """

    folder: Path
    stem: str
    wanted: frozenset[str]

    def names(self) -> list[Path]:
        """Return the files, without those of a sequence."""
        endings = ["_gates.exr", *(["_gates.png", "_depth.png"] if "drawings" in self.wanted else [])]
        endings += [f"_gates.{kind}" for kind in ("gif", "mp4", "html") if kind in self.wanted]
        return [self.folder / f"{self.stem}{ending}" for ending in endings]

    def write(self, stack: xr.Dataset, result: xr.Dataset | None, quiet: bool) -> None:
        """Write the files and print their paths; `result` has the waveforms for the page, if there are any."""
        from mitransient_lidar import gate_files, gate_page, gate_plots

        for path in self.names():
            if path.suffix in (".gif", ".mp4"):
                # Before anything is written.
                gate_plots.check_movie(stack, path)
        self.folder.mkdir(parents=True, exist_ok=True)
        for path in self.names():
            if path.suffix == ".exr":
                gate_files.save_stack(stack, path)
            elif path.suffix == ".html":
                gate_page.write_page(stack, path, result if result is not None and "waveform" in result else None)
            elif path.suffix != ".png":
                gate_plots.animation(stack, path)
            elif path.name.endswith("_gates.png"):
                gate_plots.contact_sheet(stack, path)
            elif not _draw_depths(stack, path, quiet):
                continue
            typer.echo(path)
        if "sequence" in self.wanted:
            for path in gate_files.save_sequence(stack, self.folder, self.stem):
                typer.echo(path)


def _open(path: Path) -> xr.Dataset:
    """Open a result, or a gate stack, which says better why no gates can be cut from it."""
    from mitransient_lidar import gate_files, results

    try:
        return results.open(path)
    except UserError as error:
        try:
            return gate_files.open_stack(path)
        except UserError:
            raise error from None


def _draw_depths(stack: xr.Dataset, path: Path, quiet: bool) -> bool:
    """Draw the depths that the gates see; return False where there are too few gates below the surface to tell them."""
    from mitransient_lidar import gate_plots

    try:
        gate_plots.depth_map(stack, path)
    except UserError as error:
        if not quiet:
            typer.echo(f"no drawing of depths: {error}", err=True)
        return False
    return True


#: In the order in which the help lists them.
COMMANDS = (gates,)
