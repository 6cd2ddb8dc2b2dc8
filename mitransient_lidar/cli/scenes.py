"""Commands about the shipped scenes and the system."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from mitransient_lidar.cli.files import check_suffix, write_page
from mitransient_lidar.cli.generator import Call, Command
from mitransient_lidar.cli.messages import reporting
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.tables.written import aligned_lines

_HEADING = "Scenes and system"

Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of a shipped scene.")]


def _print(rows: Iterable[Sequence[str]], right: Sequence[int] = ()) -> None:
    """Print text rows in columns."""
    typer.echo("\n".join(aligned_lines(rows, right)))


def list_scenes() -> None:
    """List the shipped scenes."""
    from mitransient_lidar.loading import catalogue

    _print((name, catalogue.scene_summary(name)) for name in catalogue.scene_names())


def _show(
    name: Name,
    html: Annotated[
        bool, typer.Option("--html", help="Write a page that shows the scene in three dimensions instead.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="HTML file of the page; NAME.html by default.")
    ] = None,
) -> None:
    """Print the XML of a scene, self-contained, or write its page."""
    if not html:
        if output is not None:
            raise UserError(f"--output {output} needs --html: the XML is printed")
        from mitransient_lidar.loading.catalogue import scene_text

        typer.echo(scene_text(name), nl=False)
        return
    path = output or Path(f"{Path(name).stem}.html")
    check_suffix("--output", path, ".html")
    from mitransient_lidar.plots.viewer import view_scene

    with reporting(quiet=False):
        page = view_scene(name)
    write_page(page, path)


def _copy(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Shipped scene, or file of a guide or flight, e.g. bottoms.toml.")
    ],
    destination: Annotated[Path, typer.Argument(metavar="DEST", help="Folder, or path of the new file.")] = Path("."),
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that exist.")] = False,
) -> None:
    """Copy a scene or an example file to edit, with the data that it names, and print its path."""
    from mitransient_lidar.loading import catalogue

    typer.echo(catalogue.copy_scene(name, destination, overwrite))


def _instruments(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Name of an instrument.")] = None,
    xml: Annotated[
        bool, typer.Option("--xml", help="Print the XML of laser and receiver, to include in a scene.")
    ] = False,
) -> None:
    """List the instruments, or print one instrument's parameters."""
    from mitransient_lidar.loading import instruments as shipped

    if name is None:
        if xml:
            raise UserError("--xml needs the name of an instrument")
        known = [shipped.read_instrument(each) for each in shipped.instrument_names()]
        counts = [f"{len(one.channels)} channel{'s' * (len(one.channels) > 1)}" for one in known]
        _print((one.name, f"{one.title}; {count}") for one, count in zip(known, counts, strict=True))
        return
    if xml:
        typer.echo(shipped.instrument_text(name), nl=False)
        return
    one = shipped.read_instrument(name)
    typer.echo(f"{one.title}\n\n{one.description}\n\nchannels: {', '.join(one.channels)}\n")
    _print(((each.name, each.value, each.source) for each in one.parameters if each.value), right=(1,))
    typer.echo(f"\n{shipped.receiver_text(name)}", nl=False)


def _info(
    file: Annotated[Path | None, typer.Argument(metavar="FILE", help="An EXR or NetCDF result.")] = None,
) -> None:
    """Print versions and paths, or the parameters of a result."""
    if file is None:
        from mitransient_lidar.loading import variants

        facts = variants.describe()
    else:
        from mitransient_lidar.rendering.again import describe_result

        facts = describe_result(file)
    _print((name, str(value)) for name, value in facts.items())


def _bench(
    call: Call,
    images: Annotated[bool, typer.Option("--images", help="Time a gate of 4 to 65536 pixels to 10 % instead.")] = False,
    beams: Annotated[
        bool, typer.Option("--beams", help="Compare beams from 0.1 to 20 mrad in all views instead.")
    ] = False,
) -> None:
    """Run one benchmark."""
    from mitransient_lidar.studies.bench import beams as narrow
    from mitransient_lidar.studies.bench import images as imagers

    if images and beams:
        raise UserError("--images and --beams are alternatives: give one of them")
    if images:
        imagers.run(json=call.arguments["json"])
    elif beams:
        narrow.run(json=call.arguments["json"])
    else:
        with call.named():
            call.function(**call.arguments)


COMMANDS = {
    "info": Command(
        _HEADING,
        "",
        _info,
        """Print versions, the Mitsuba variant and LLVM's path, or a result's parameters.

        A result gives its attributes, then every object in its scene with all parameter values, defaults too. A dash
        marks parameters that are not given and have no default, or are not used.
        """,
    ),
    "bench": Command(_HEADING, "studies.bench.integrators:run", _bench, "Measure the time to a given accuracy."),
}

SCENES = {
    "list": Command("Commands", "", list_scenes, "List the shipped scenes."),
    "show": Command(
        "Commands",
        "",
        _show,
        """Print the XML of a scene, self-contained, or write a page that shows it.

        The page, of --html, has sea, bottom, targets, layers, beam and pixels in three dimensions, to scale, with names
        and numbers; it needs no network. view NAME opens it in the browser.
        """,
    ),
    "copy": Command("Commands", "", _copy, "Copy a scene or an example file to edit."),
    "instruments": Command(
        "Commands",
        "",
        _instruments,
        """List the instruments, or print the parameters of one with their sources.

        Parameters that are not published are assumed, and listed as such; those of the receiver follow, as the TOML
        file that record takes. Use with render SCENE --instrument NAME.
        """,
    ),
}
