"""Arguments and options that several commands take, and how their text is read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitransient_lidar.core.errors import UserError

Scene = Annotated[str, typer.Argument(metavar="SCENE", help="Name of a shipped scene, or path of a Mitsuba XML file.")]
Define = Annotated[
    list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="Set a parameter of the scene. Repeatable.")
]
TargetId = Annotated[str, typer.Option(help="Id of the shape that is the target.")]
Passes = Annotated[int, typer.Option(help="Number of independent passes of each render.")]
Seed = Annotated[int, typer.Option(help="Seed of the random numbers.")]
TargetError = Annotated[float | None, typer.Option(help="Stop at this relative standard error, e.g. 0.01.")]
MaxTime = Annotated[float | None, typer.Option(help="Stop after this many seconds.")]
GoalPasses = Annotated[int | None, typer.Option("--passes", help="Stop after this many independent passes.")]
Variant = Annotated[str | None, typer.Option(help="Mitsuba variant, e.g. llvm_ad_mono.")]
Folder = Annotated[Path, typer.Option("-o", "--output", help="Folder for the files; created if missing.")]
Figure = Annotated[Path, typer.Option("-o", "--output", help="PNG, PDF or SVG file; the data go to .nc beside it.")]
OptionalFigure = Annotated[
    Path | None, typer.Option("-o", "--output", help="PNG, PDF or SVG file to write; the data go to .nc beside it.")
]
DrawingOnly = Annotated[Path | None, typer.Option("-o", "--output", help="PNG, PDF or SVG file to write.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only results and errors.")]


def parameters(definitions: list[str] | None) -> dict[str, str]:
    """Return scene parameters given as ``name=value``."""
    params = {}
    for definition in definitions or []:
        name, equals, value = definition.partition("=")
        if not (name.strip() and equals):
            raise UserError(f"-D {definition} is not of the form name=value.")
        params[name.strip()] = value.strip()
    return params


def numbers(option: str, text: str) -> list[float]:
    """Return numbers separated by commas."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise UserError(f"{option} {text} is not of the form 2,5,8.") from None


def pair(option: str, text: str) -> tuple[float, float]:
    """Return two numbers separated by a comma."""
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        raise UserError(f"{option} {text} is not of the form 2,5.") from None
    return first, second
