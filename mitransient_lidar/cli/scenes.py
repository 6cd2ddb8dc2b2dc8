"""Commands about the shipped scenes and the system."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from mitransient_lidar.cli.files import write_page
from mitransient_lidar.cli.generator import Call, Command
from mitransient_lidar.cli.messages import reporting
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.tables.written import aligned_lines

_HEADING = "Scenes and system"


def _print(rows: Iterable[Sequence[str]], right: Sequence[int] = ()) -> None:
    """Print text rows in columns."""
    typer.echo("\n".join(aligned_lines(rows, right)))


def list_scenes() -> None:
    """List the shipped scenes."""
    from mitransient_lidar.loading import catalogue

    _print((name, catalogue.scene_summary(name)) for name in catalogue.scene_names())


def _show(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a shipped scene.")],
    html: Annotated[bool, typer.Option("--html", help="Write NAME.html, a page of the scene, instead.")] = False,
) -> None:
    """Print the XML of a scene, self-contained, or write its page."""
    if html:
        from mitransient_lidar.plots.viewer import view_scene

        with reporting(quiet=False):
            page = view_scene(name)
        write_page(page, Path(f"{Path(name).stem}.html"))
        return
    from mitransient_lidar.loading.catalogue import scene_text

    typer.echo(scene_text(name), nl=False)


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
        known = [(one := shipped.read_instrument(each), len(one.channels)) for each in shipped.instrument_names()]
        _print((one.name, f"{one.title}; {count} channel{'s' * (count > 1)}") for one, count in known)
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


def _bench(call: Call) -> None:
    """Run one benchmark."""
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
    "bench": Command(_HEADING, "studies.bench:run", _bench, "Measure the time to a given accuracy."),
}

SCENES = {
    "list": Command("Commands", "", list_scenes, "List the shipped scenes."),
    "show": Command(
        "Commands",
        "",
        _show,
        "Print the XML of a scene, self-contained, or write a page that shows it, as view NAME does.",
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
