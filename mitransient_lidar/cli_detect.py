"""The command that tells how well a target is detected."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitransient_lidar.cli_studies import Define, Drawing, Quiet, Scene, Seed
from mitransient_lidar.cli_support import (
    counting,
    keep_drawing,
    numbers,
    parameters,
    prepare_drawing,
    require,
    sentences,
)


def detect(
    scene: Scene,
    define: Define = None,
    receiver: Annotated[
        str, typer.Option(help="Receiver of every pixel: ideal, photodiode, pmt, pmt_log, apd, sipm or spad.")
    ] = "apd",
    pfa: Annotated[float, typer.Option(help="Probability of false alarm.")] = 1e-3,
    pd: Annotated[float, typer.Option(help="Probability of detection that is wanted.")] = 0.9,
    depths: Annotated[
        str | None, typer.Option(metavar="D1,D2,...", help="Depths of the target to try, too [m], increasing.")
    ] = None,
    shots: Annotated[int, typer.Option(help="Shots to draw with and without the target.")] = 10_000,
    clutter: Annotated[int, typer.Option(help="Seas whose differences are noise, too; 0: one known sea.")] = 0,
    renders: Annotated[int, typer.Option(help="Renders of one sea, whose spread gives the intervals.")] = 4,
    shape: Annotated[str, typer.Option("--id", help="The id of the shape that is the target.")] = "target",
    background: Annotated[float, typer.Option(help="Steady power on each pixel, as by daylight [W].")] = 0.0,
    passes: Annotated[int, typer.Option(help="Number of passes of each render.")] = 16,
    seed: Seed = 0,
    output: Drawing = Path("detection.png"),
    quiet: Quiet = False,
) -> None:
    """Tell how well a target is detected with one pixel, the sum and the best weighting of pixels, and draw it."""
    with sentences():
        require(1e-12 <= pfa <= 0.5, "--pfa", pfa, "1e-12 to 0.5")
        require(1.01 * pfa < pd <= 1 - 1e-9, "--pd", pd, "above --pfa and below 1")
        require(100 <= shots <= 100_000, "--shots", shots, "100 to 100000")
        require(clutter == 0 or 4 <= clutter <= 1000, "--clutter", clutter, "0, or 4 to 1000")
        require(3 <= renders <= 1000, "--renders", renders, "3 to 1000")
        require(0 <= background < float("inf"), "--background", background, "0 or above")
        require(16 <= passes <= 100_000, "--passes", passes, "16 to 100000")
        require(seed >= 0, "--seed", seed, "0 or above")
        params = parameters(define or [])
        places = numbers("--depths", depths) if depths else []
        prepare_drawing(output)

        from mitransient_lidar import detection
        from mitransient_lidar.detection_plots import plot_detection

        with counting(quiet, "render") as progress:
            found = detection.detect(
                scene,
                params,
                receiver=receiver,
                pfa=pfa,
                pd=pd,
                depths=places,
                shots=shots,
                clutter=clutter,
                renders=renders,
                target=shape,
                background_power=background,
                passes=passes,
                seed=seed,
                progress=progress,
            )
        keep_drawing(found, output, plot_detection)
        for line in detection.describe_detection(found):
            typer.echo(line)


#: In the order in which the help lists them.
COMMANDS = (detect,)
