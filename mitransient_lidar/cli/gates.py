"""The command that cuts gates from a result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitransient_lidar.cli.files import GateFiles
from mitransient_lidar.cli.generator import Call, Command
from mitransient_lidar.cli.messages import name_subject, reporting
from mitransient_lidar.cli.options import Quiet
from mitransient_lidar.cli.overwriting import draws_again
from mitransient_lidar.core.errors import UserError


def _gates(
    call: Call,
    stack: Annotated[
        Path, typer.Argument(metavar="STACK", help="An EXR or NetCDF result, a gate stack or frames of a camera.")
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for the files, by default the folder of STACK.")
    ] = None,
    plot: Annotated[bool, typer.Option("--plot/--no-plot", help="Draw all gates, and the depths seen in them.")] = True,
    sequence: Annotated[
        bool, typer.Option("--sequence", help="Also write numbered EXR files, one for each gate.")
    ] = False,
    tiff: Annotated[
        bool, typer.Option("--tiff", help="Also write a 16-bit TIFF file, one page per frame and gate.")
    ] = False,
    images: Annotated[
        bool, typer.Option("--images", help="Also write numbered 16-bit PNG files, one per frame and gate.")
    ] = False,
    gif: Annotated[bool, typer.Option("--gif", help="Also write an animation.")] = False,
    mp4: Annotated[bool, typer.Option("--mp4", help="Also write a movie, by ffmpeg.")] = False,
    html: Annotated[bool, typer.Option("--html", help="Also write a page that shows the gates in a browser.")] = False,
    quiet: Quiet = False,
) -> None:
    """Cut the gates of a train, or take those that are there, and write and draw them."""
    from mitransient_lidar import results
    from mitransient_lidar.analysis.gates import cut as gating
    from mitransient_lidar.results.gate_stack import has_frames

    count = call.arguments["count"]
    starts = [call.arguments[name] for name in ("start_ns", "start_depth_m", "start_range_m")]
    given = {"--width-ns": call.arguments["width_ns"], "--step-ns": call.arguments["step_ns"]}
    given["--count"] = None if count == 1 else count
    with reporting(quiet):
        result = results.dataset_of("FILE", stack, "result", "gates", "frames")
        is_record = has_frames(result)
        has_gates = is_record or "gate_energy" in result
        is_cut = not has_gates or any(one is not None for one in starts)
        stem = stack.stem.removesuffix("_gates") + ("_cut" if has_gates and is_cut else "")
        wanted = {"drawings": plot, "sequence": sequence, "tiff": tiff, "images": images}
        files = GateFiles.of(output or stack.parent, stem, **wanted, gif=gif, mp4=mp4, html=html)
        if not is_cut:
            draws_again(stack)
        files.check()
        if is_record and is_cut:
            raise UserError(f"{stack} holds frames of a camera: cut the gates of the result, and record these")
        named = [f"{option} {value:g}" for option, value in given.items() if value is not None]
        if named and not is_cut:
            raise UserError(f"{named[0]} needs --start-ns, --start-depth or --start-range, where the first gate begins")
        cut = result
        if is_cut:
            with call.named():
                train = call.function(result.attrs, **call.arguments)
            cut = gating.cut_gates(result, train)
    name_subject(stack, result.attrs, quiet)
    with reporting(quiet):
        files.write(cut, result, quiet)


COMMANDS = {
    "gates": Command(
        "Analyse results",
        "results.gate_stack:train_from_options",
        _gates,
        """Cut gates from a result.

        Writes DIR/<stack>_gates.exr, _gates.png and _depth.png, and prints the paths. A STACK with gates gives
        <stack>_cut_gates.exr and so on. Without a start, its own gates or camera frames are written and drawn. TIFF
        and PNG images contain the digital numbers of frames, or energies from 0 to 65535.
        """,
    ),
}
