"""The command line ``mitransient-lidar``.

Invalid input ends a command with one sentence on stderr and exit code 2, Ctrl-C with exit code 130. Results go to
stdout, everything else to stderr. Commands import what they need when they run, so that help appears at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from mitransient_lidar._version import __version__
from mitransient_lidar.cli import gates, render, results, retrieve, scenes, studies, waveforms
from mitransient_lidar.cli.messages import exit_on_error

#: Commands by the headings of the help.
_COMMANDS: dict[str, tuple[Callable[..., None], ...]] = {
    "Render": (render.render, studies.shots, render.passive),
    "Study": (
        studies.find_shots,
        studies.shot_statistics,
        studies.target_signal,
        studies.detect,
        studies.beam_spread,
        studies.fov_sweep,
        studies.scattering_orders,
        studies.water,
    ),
    "Analyse results": (
        results.plot,
        results.compare,
        results.record,
        gates.gates,
        waveforms.waveforms,
        retrieve.retrieve,
    ),
    "Scenes and system": (scenes.info, scenes.bench),
}


class _GroupedCommands(TyperGroup):
    """A command whose help lists the subcommands under headings."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one section a heading."""
        sections: dict[Any, list[tuple[str, str]]] = {}
        for name, command in self.commands.items():
            heading = getattr(command, "rich_help_panel", "Commands")
            sections.setdefault(heading, []).append((name, command.get_short_help_str(limit=120)))
        for heading, rows in sections.items():
            with formatter.section(heading):
                formatter.write_dl(rows)


app = typer.Typer(
    cls=_GroupedCommands,
    help="Simulate multipixel depth-sounding lidar.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
_scenes_app = typer.Typer(rich_markup_mode=None)


def main() -> None:
    """Run the command line."""
    app(prog_name="mitransient-lidar")


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


@_scenes_app.callback(invoke_without_command=True)
def _scenes(context: typer.Context) -> None:
    """List, show or copy the shipped scenes."""
    if context.invoked_subcommand is None:
        exit_on_error()(scenes.list_scenes)()


for _heading, _functions in _COMMANDS.items():
    for _function in _functions:
        app.command(rich_help_panel=_heading)(exit_on_error()(_function))
for _name, _function in (("list", scenes.list_scenes), ("show", scenes.show_scene), ("copy", scenes.copy_scene)):
    _scenes_app.command(_name)(exit_on_error()(_function))
app.add_typer(_scenes_app, name="scenes", rich_help_panel="Scenes and system")
