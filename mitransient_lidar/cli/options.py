"""Arguments and options of several commands, and their conversion."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, get_type_hints

import typer

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import finite, number_list
from mitransient_lidar.rendering.options import RenderOptions

Instrument = Annotated[
    str | None, typer.Option(help="Instrument instead of the scene's lidar, from the list of instruments.")
]
Sensor = Annotated[
    str | None, typer.Option(metavar="ID", help="Receiver of a scene that has several, instead of the first one.")
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
Seed = Annotated[int, typer.Option(help="Seed of the random numbers, 0 to 2^53.")]
MaxTime = Annotated[
    float | None, typer.Option(help="Stop before this many seconds, with fewer passes (greater than 0).")
]
DrawingOnly = Annotated[Path | None, typer.Option("-o", "--output", help="PNG, PDF or SVG file to write.")]
#: Default folder of the files that a command renders.
OUTPUT = Path("output")
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only results and errors.")]

#: Help of an option for the receiver.
RECEIVERS = (
    "Receiver: ideal, photodiode, pmt, pmt_log, apd, sipm, spad or spad_array, the name of an instrument, or a TOML "
    "file."
)


def render_options(*names: str, **helps: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Add options of `RenderOptions` to a command, by their names, some with a help of the command's own.

    The command takes them as keywords, None for those that are not given. They follow the scene and its parameters.
    """
    types = get_type_hints(RenderOptions)

    def add(command: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(command, eval_str=True)
        added = []
        for name in (*names, *helps):
            flags = [f"--{name.replace('_', '-')}"] if types[name] == bool | None else []
            option = typer.Option(*flags, help=helps.get(name) or RenderOptions.help(name))
            kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
            added.append(inspect.Parameter(name, kind, default=None, annotation=Annotated[types[name], option]))

        plain = [one for one in own.parameters.values() if one.kind is not one.VAR_KEYWORD]
        # Typer reads the signature, and calls the command with all options as keywords.
        command.__signature__ = own.replace(parameters=[*plain[:2], *added, *plain[2:]])  # type: ignore[attr-defined]
        return command

    return add


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
