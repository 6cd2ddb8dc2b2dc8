"""Commands about the shipped scenes and the system."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from mitransient_lidar.cli.files import announced, check_figure, check_targets, write_page
from mitransient_lidar.cli.generator import OUTPUT, Call, Commands, DrawingOnly, Json, Quiet, function_at, print_json
from mitransient_lidar.cli.messages import reporting
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option
from mitransient_lidar.core.tables.written import aligned_lines

COMMANDS = Commands()
SCENES = Commands()

_HEADING = "Scenes and system"


def _print(rows: Iterable[Sequence[str]], right: Sequence[int] = ()) -> None:
    """Print text rows in columns."""
    typer.echo("\n".join(aligned_lines(rows, right)))


@SCENES.add("Commands", name="list")
def list_scenes() -> None:
    """List the shipped scenes."""
    from mitransient_lidar.loading import catalogue

    _print((name, catalogue.scene_summary(name)) for name in catalogue.scene_names())


@SCENES.add("Commands", example="table1 --html")
def _show(
    name: Annotated[str, Option("Name of a shipped scene", form="NAME", is_argument=True)],
    html: Annotated[bool, Option("Write NAME.html, a page of the scene, instead")] = False,
) -> None:
    """Print the XML of a scene, self-contained, or write a page that shows it, as view NAME does."""
    if html:
        from mitransient_lidar.plots.viewer import view_scene

        with reporting(quiet=False):
            page = view_scene(name)
        write_page(page, Path(f"{Path(name).stem}.html"))
        return
    from mitransient_lidar.loading.catalogue import scene_text

    typer.echo(scene_text(name), nl=False)


@SCENES.add("Commands", example="table1 my_scene.xml")
def _copy(
    name: Annotated[
        str, Option("Shipped scene, or file of a guide or flight, e.g. bottoms.toml", form="NAME", is_argument=True)
    ],
    destination: Annotated[Path, Option("Folder, or path of the new file", form="DEST", is_argument=True)] = Path("."),
    overwrite: Annotated[bool, Option("Replace files that exist")] = False,
) -> None:
    """Copy a scene or an example file to edit."""
    from mitransient_lidar.loading import catalogue

    typer.echo(catalogue.copy_scene(name, destination, overwrite))


@SCENES.add("Commands", example="teledyne_czmil")
def _instruments(
    name: Annotated[str | None, Option("Name of an instrument", form="NAME", is_argument=True)] = None,
    xml: Annotated[bool, Option("Print the XML of laser and receiver, to include in a scene")] = False,
    as_json: Json = False,
) -> None:
    """List the instruments, or print the parameters of one with their sources.

    Parameters that are not published are assumed, and listed as such; those of the receiver follow, as the TOML
    file that record takes. Use with render SCENE --instrument NAME.
    """
    from mitransient_lidar.loading import catalogue as shipped

    if xml and as_json:
        raise UserError("--xml and --json are alternatives: give one of them")
    if name is None:
        if xml:
            raise UserError("--xml needs the name of an instrument")
        known = [(one := shipped.read_instrument(each), len(one.channels)) for each in shipped.instrument_names()]
        if as_json:
            print_json({one.name: one.title for one, _ in known})
            return
        _print((one.name, f"{one.title}; {count} channel{'s' * (count > 1)}") for one, count in known)
        return
    if xml:
        typer.echo(shipped.instrument_text(name), nl=False)
        return
    one = shipped.read_instrument(name)
    if as_json:
        listed = {each.name: {"value": each.value, "source": each.source} for each in one.parameters if each.value}
        print_json({"title": one.title, "channels": one.channels, "parameters": listed})
        return
    typer.echo(f"{one.title}\n\n{one.description}\n\nchannels: {', '.join(one.channels)}\n")
    _print(((each.name, each.value, each.source) for each in one.parameters if each.value), right=(1,))
    typer.echo(f"\n{shipped.receiver_text(name)}", nl=False)


@SCENES.add("Commands", "studies.water_report:describe_water", "jerlov 3C")
def _water(call: Call, output: DrawingOnly = None) -> None:
    """Print the optical properties of a water and its parameters."""
    check_figure(output)
    with announced():
        lines = call()
        if output is not None:
            function_at("plots.water:plot_water")(**call.arguments, path=output)
        typer.echo("\n".join(lines))


@COMMANDS.add(_HEADING, "plots.publication.figures:figures", "fig09 fig13")
def _figures(
    call: Call,
    output: Annotated[Path, Option("Folder for figures and table")] = OUTPUT / "figures",
    quiet: Quiet = False,
) -> None:
    """Make the figures of the published model again.

    Writes a PNG file for each figure, and a table of the publication's statements with computed numbers, their
    errors, and whether they hold.
    """
    from mitransient_lidar.plots.publication import figures as publication
    from mitransient_lidar.studies.publication.statements import describe_statements

    chosen = publication.check_names(call.arguments["names"])
    check_targets(output, [output / f"{name}.png" for name in chosen] + [output / publication.TABLE])
    made = call(names=chosen, output=output)
    for path in made.files:
        typer.echo(path)
    for line in describe_statements(made.statements):
        typer.echo(line)
    if made.interrupted:
        done = max(len(made.files) - 1, 0)
        raise KeyboardInterrupt(f"interrupted after {done} of {len(chosen)} figures, which are kept")


@COMMANDS.add(_HEADING, "", "output/table1.nc")
def _info(
    file: Annotated[Path | None, Option("An EXR or NetCDF result", form="FILE", is_argument=True)] = None,
    as_json: Json = False,
) -> None:
    """Print versions, the Mitsuba variant and LLVM's path, or a result's parameters.

    A result gives its attributes, then every object in its scene with all parameter values, defaults too. A dash
    marks parameters that are not given and have no default, or are not used.
    """
    if file is None:
        from mitransient_lidar.loading import variants

        facts: dict[str, Any] = {**variants.describe()}
    else:
        from mitransient_lidar.rendering.again import describe_result

        facts = describe_result(file)
    if as_json:
        print_json(facts)
    else:
        _print((name, _text(value)) for name, value in facts.items())


def _text(value: Any) -> str:
    """Return a value in one line."""
    if value is None:
        return "-"
    if isinstance(value, list):
        return ", ".join(map(_text, value))
    return f"{value:.9g}" if isinstance(value, float) else " ".join(str(value).split())


@COMMANDS.add(_HEADING, "studies.bench:run", "--quick")
def _bench(call: Call) -> None:
    """Measure the time to a given accuracy."""
    with call.named():
        call.function(**call.arguments)
