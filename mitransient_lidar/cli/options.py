"""Arguments and options of several commands, and their conversion."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitransient_lidar.core.errors import UserError

Scene = Annotated[str, typer.Argument(metavar="SCENE", help="Name of a shipped scene, or path of a Mitsuba XML file.")]
Define = Annotated[
    list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="Set a parameter of the scene. Repeatable.")
]
Seed = Annotated[int, typer.Option(help="Seed of the random numbers.")]
DrawingOnly = Annotated[Path | None, typer.Option("-o", "--output", help="PNG, PDF or SVG file to write.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only results and errors.")]

#: Help of an option for the receiver.
RECEIVERS = "Receiver of every pixel: ideal, photodiode, pmt, pmt_log, apd, sipm or spad."


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


def number_or_auto(option: str, text: str) -> float | str:
    """Return a number, or the word auto."""
    if text == "auto":
        return text
    try:
        return float(text)
    except ValueError:
        raise UserError(f"{option} {text} must be a number or auto.") from None
