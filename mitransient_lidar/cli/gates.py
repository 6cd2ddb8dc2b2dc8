"""The command that cuts gates from a result."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mitransient_lidar.cli.files import GateFiles
from mitransient_lidar.cli.messages import name_subject, reporting
from mitransient_lidar.cli.options import Quiet
from mitransient_lidar.cli.overwriting import draws_again
from mitransient_lidar.core.errors import UserError

if TYPE_CHECKING:
    import xarray as xr


def gates(
    stack: Annotated[Path, typer.Argument(metavar="STACK", help="An EXR or NetCDF result that kept its histogram.")],
    start_ns: Annotated[
        float | None, typer.Option(help="Start of the first gate, at half height [ns], any number.")
    ] = None,
    start_depth: Annotated[
        float | None, typer.Option(help="Depth of its start on the axis [m], any number, instead of a time.")
    ] = None,
    width_ns: Annotated[
        float | None, typer.Option(help="Width of a gate between half heights [ns], greater than 0.")
    ] = None,
    step_ns: Annotated[
        float | None, typer.Option(help="Time from gate to gate [ns], greater than 0; by default the width.")
    ] = None,
    count: Annotated[int, typer.Option(help="Number of gates, 1 to 100 000.")] = 1,
    rise_ns: Annotated[
        float, typer.Option(help="10-90 % time of the rising edge [ns], at least 0; both edges at most 1.18 widths.")
    ] = 0.0,
    fall_ns: Annotated[float, typer.Option(help="90-10 % time of the falling edge [ns], at least 0.")] = 0.0,
    profile: Annotated[
        Path | None, typer.Option(help="Measured gate instead of width and edges: columns time [ns], transmission.")
    ] = None,
    pulses: Annotated[int, typer.Option(help="Pulses accumulated in a gate, 1 to 10^9.")] = 1,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for the files; by default that of STACK.")
    ] = None,
    plot: Annotated[bool, typer.Option("--plot/--no-plot", help="Draw all gates, and the depths seen in them.")] = True,
    sequence: Annotated[
        bool, typer.Option("--sequence", help="Also write numbered EXR files, one for each gate.")
    ] = False,
    gif: Annotated[bool, typer.Option("--gif", help="Also write an animation.")] = False,
    mp4: Annotated[bool, typer.Option("--mp4", help="Also write a movie, by ffmpeg.")] = False,
    html: Annotated[bool, typer.Option("--html", help="Also write a page that shows the gates in a browser.")] = False,
    quiet: Quiet = False,
) -> None:
    """Cut gates from a result.

    Writes DIR/<stack>_gates.exr, _gates.png and _depth.png, and prints the paths; <stack>_cut_gates.exr and so on of a
    STACK that has gates already. Without a start, the gates that it has are written and drawn.
    """
    from mitransient_lidar.analysis.gates import cut as gating
    from mitransient_lidar.results import gate_stack

    given = {"--width-ns": width_ns, "--step-ns": step_ns, "--count": None if count == 1 else count}
    with reporting(quiet):
        result = _open(stack)
        has_gates = "gate_energy" in result
        is_cut = not has_gates or start_ns is not None or start_depth is not None
        stem = stack.stem.removesuffix("_gates") + ("_cut" if has_gates and is_cut else "")
        files = GateFiles.of(
            output or stack.parent, stem, drawings=plot, sequence=sequence, gif=gif, mp4=mp4, html=html
        )
        if not is_cut:
            draws_again(stack)
        files.check()
        if not is_cut:
            if named := [f"{option} {value:g}" for option, value in given.items() if value is not None]:
                raise UserError(f"{named[0]} needs --start-ns or --start-depth, where the first gate begins.")
            cut = result
        else:
            train = gate_stack.train_from_options(
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
    name_subject(stack, result.attrs, quiet)
    with reporting(quiet):
        files.write(cut, result, quiet)


def _open(path: Path) -> xr.Dataset:
    """Open a result or a gate stack."""
    from mitransient_lidar import results

    return results.dataset_of("FILE", path, "result", "gates")
