"""Arguments and options of several commands, and their conversion."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import finite, number_list

Instrument = Annotated[
    str | None, typer.Option(help="Instrument instead of the scene's lidar, from the list of instruments.")
]
Scene = Annotated[str, typer.Argument(metavar="SCENE", help="Name of a shipped scene, or path of a Mitsuba XML file.")]
SceneOrResult = Annotated[
    str,
    typer.Argument(
        metavar="SCENE",
        help="Name of a shipped scene, path of a Mitsuba XML file, or a result (.nc, .exr) to render again, with its "
        "own options unless others are given.",
    ),
]
Define = Annotated[
    list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="Set a parameter of the scene. Repeatable.")
]
OptionalSeed = Annotated[int | None, typer.Option(help="Seed of the random numbers, 0 by default.")]
Seed = Annotated[int, typer.Option(help="Seed of the random numbers.")]
DrawingOnly = Annotated[Path | None, typer.Option("-o", "--output", help="PNG, PDF or SVG file to write.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only results and errors.")]

#: Help of an option for the receiver.
RECEIVERS = (
    "Receiver: ideal, photodiode, pmt, pmt_log, apd, sipm, spad or spad_array, the name of an instrument, or a TOML "
    "file."
)


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
    """Return finite numbers separated by commas."""
    return [float(number) for number in number_list(option, text)]


def pair(option: str, text: str) -> tuple[float, float]:
    """Return two finite numbers separated by a comma."""
    values = numbers(option, text)
    if len(values) != 2:
        raise UserError(f"{option} = {text!r} must be two numbers, as in 2,5")
    return values[0], values[1]


def number_or_auto(option: str, text: str) -> float | str:
    """Return a finite number, or the word auto."""
    try:
        return text if text == "auto" else finite(option, text)
    except UserError:
        raise UserError(f"{option} {text} must be a number or auto.") from None
