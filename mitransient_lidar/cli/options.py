"""Arguments and options that commands share, and their conversion."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import finite, number_list

Define = Annotated[
    list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="Set a scene parameter. Repeatable.")
]
DrawingOnly = Annotated[Path | None, typer.Option("-o", "--output", help="PNG, PDF or SVG file to write.")]
#: Default folder for rendered files.
OUTPUT = Path("output")
#: Options of commands that read full-waveform files of lidars (`waveform_selection`).
Waveforms = Annotated[
    str | None,
    typer.Option(
        metavar="FIRST:END",
        help="Waveforms of a LAS or LAZ file, pulses of a PulseWaves file: from number FIRST, from 0, to before END.",
    ),
]
Channel = Annotated[
    str | None,
    typer.Option(
        metavar="[FIELD=]N", help="Channel of such a file: a scanner channel, or the value of a FIELD of its points."
    ),
]
Lidar = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=VALUE",
        help="What such a file does not state: pulse_fwhm_ns, altitude above the sea [m], sea_level in the file's "
        "heights [m], refractive_index, ... Repeatable.",
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only results and errors.")]


def parameters(definitions: list[str] | None) -> dict[str, str]:
    """Return scene parameters given as ``name=value``."""
    params = {}
    for definition in definitions or []:
        name, equals, value = definition.partition("=")
        if not (name.strip() and equals):
            raise UserError(f"-D {definition} is not of the form name=value")
        params[name.strip()] = value.strip()
    return params


def waveform_selection(
    file: Path, waveforms: str | None, channel: str | None, lidar: list[str] | None
) -> dict[str, Any]:
    """Return the arguments of `results.waveform_files.waveform_chunks`; empty for files of other kinds."""
    given = {"--waveforms": waveforms, "--channel": channel, "--lidar": lidar}
    if file.suffix.lower() not in (".las", ".laz", ".pls", ".wvs"):
        if named := [name for name, value in given.items() if value]:
            raise UserError(f"{named[0]} is for LAS, LAZ and PulseWaves files, and {file} is none.")
        return {}
    limits = None
    if waveforms is not None:
        ends = [end.strip() for end in waveforms.split(":")]
        if len(ends) != 2 or not all(end.isdecimal() or not end for end in ends):
            raise UserError(f"--waveforms {waveforms} is not of the form FIRST:END.")
        limits = int(ends[0] or 0), int(ends[1]) if ends[1] else None
    known = dict(name_and_value("--lidar", text) for text in lidar or [])
    return {"waveforms": limits, "channel": channel, "lidar": known}


def numbers(option: str, text: str) -> list[float]:
    """Return finite numbers separated by commas."""
    return [float(number) for number in number_list(option, text)]


def pair(option: str, text: str) -> tuple[float, float]:
    """Return two finite numbers separated by a comma."""
    values = numbers(option, text)
    if len(values) != 2:
        raise UserError(f"{option} = {text!r} must be two numbers, as in 2,5")
    return values[0], values[1]


def names(option: str, text: str) -> list[str]:
    """Return names separated by commas."""
    found = [name.strip() for name in text.split(",")]
    if not all(found):
        raise UserError(f"{option} = {text!r} has an empty entry: it must be names separated by commas")
    return found


def number_or_auto(option: str, text: str) -> float | str:
    """Return a finite number, or the word auto."""
    try:
        return text if text == "auto" else finite(option, text)
    except UserError:
        raise UserError(f"{option} {text} must be a number or auto") from None


def name_and_value(option: str, text: str) -> tuple[str, float]:
    """Return a name and a finite number from ``name=value``."""
    name, value = _parted(option, text, "name=value")
    return name, finite(f"{option} {name}", value)


def limits(option: str, text: str) -> tuple[str, tuple[float, float]]:
    """Return a name and two finite numbers from ``name=low:high``."""
    name, value = _parted(option, text, "name=low:high")
    ends = value.split(":")
    if len(ends) != 2:
        raise UserError(f"{option} {text} is not of the form name=low:high")
    return name, (finite(f"{option} {name}", ends[0]), finite(f"{option} {name}", ends[1]))


def name_and_values(option: str, text: str) -> tuple[str, list[str]]:
    """Return a name and texts, which semicolons separate where they hold commas."""
    name, value = _parted(option, text, "name=value,value,...")
    values = [one.strip() for one in value.split(";" if ";" in value else ",")]
    if not all(values):
        raise UserError(f"{option} {text} is not of the form name=value,value,...")
    return name, values


def name_and_deviation(option: str, text: str) -> tuple[str, float]:
    """Return a name and a finite number, infinite where there is none."""
    name, equals, known = text.partition("=")
    return name.strip(), finite(f"{option} {name.strip()}", known) if equals else math.inf


def _parted(option: str, text: str, form: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name.strip() and equals and value.strip()):
        raise UserError(f"{option} {text} is not of the form {form}")
    return name.strip(), value.strip()
