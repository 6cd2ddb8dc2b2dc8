"""The command line ``mitransient-lidar``.

Invalid input ends a command with one sentence on stderr and exit code 2. Ctrl-C gives exit code 130, SIGTERM 143 and
SIGHUP 129; 1 means a comparison that finds a difference, or failed runs. Results go to stdout, everything else to
stderr. Commands import modules when they run, so that help appears at once.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import sys
import warnings
from collections.abc import Iterator
from types import FrameType, ModuleType
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from mitransient_lidar._version import __version__
from mitransient_lidar.cli import analysis, campaigns, render, results, scenes, studies
from mitransient_lidar.cli.generator import Command, LazyCommand
from mitransient_lidar.cli.messages import exit_on_error, printable_streams
from mitransient_lidar.core.errors import UserError

#: Former names of commands, and those that have taken their place.
RENAMED = {
    "beam-spread": "scattering --depths",
    "fov-sweep": "scattering --fov-mrad",
    "scattering-orders": "scattering --orders",
    "sweep": "campaign",
    "target-signal": "detect --receiver none",
    "waveforms": "echoes",
    "estimate": "render --light level --components",
    "plot": "view --plot",
    "shot-statistics": "shots --figure",
    "instruments": "scenes instruments",
    "water": "scenes water",
}

#: All commands but ``scenes``, in the order of the help.
COMMANDS: dict[str, Command] = {
    **render.COMMANDS,
    **campaigns.COMMANDS,
    **studies.COMMANDS,
    **results.COMMANDS,
    **analysis.COMMANDS,
    **scenes.COMMANDS,
}


#: Error of the option parser in Typer's release of Click.
_UsageError: Any = typer.BadParameter.__base__


class _GroupedCommands(TyperGroup):
    """A command whose help lists the subcommands under headings, and whose usage errors are one sentence."""

    def get_command(self, ctx: Any, name: str) -> Any:
        """Return a command; refuse a former name."""
        if name in self.former:
            raise UserError(f"the command {name} is now {self.former[name]}")
        return super().get_command(ctx, name)

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run the command line, whose output holds no control characters."""
        with printable_streams():
            return super().main(*args, **kwargs)

    commands_of, former, before = COMMANDS, RENAMED, ""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        made = {name: LazyCommand(name, row, self.before) for name, row in self.commands_of.items()}
        self.commands = {**made, **self.commands}

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        """Parse the options before the subcommand."""
        with _short_usage_errors():
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: Any) -> Any:
        """Parse the subcommand's options, and run it."""
        # One context alone: the exit code of a signal is known to the one that handles it.
        with _short_usage_errors():
            return super().invoke(ctx)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one section a heading."""
        sections: dict[Any, list[tuple[str, str]]] = {}
        for name, command in self.commands.items():
            heading = getattr(command, "rich_help_panel", "Commands")
            sections.setdefault(heading, []).append((name, command.get_short_help_str(limit=120)))
        for heading, rows in sections.items():
            with formatter.section(heading):
                formatter.write_dl(rows)


class _SceneCommands(_GroupedCommands):
    """The scene commands."""

    commands_of, former, before = scenes.SCENES, {}, "scenes "


@contextlib.contextmanager
def _short_usage_errors() -> Iterator[None]:
    """Convert an error of the options to a `UserError`; a command without arguments still prints its help."""
    with exit_on_error():
        try:
            yield
        except _UsageError as error:
            if type(error).__name__ == "NoArgsIsHelpError":
                raise
            raise UserError(_usage_sentence(error)) from error


def _usage_sentence(error: Any) -> str:
    """Return one sentence with the option, its value and the allowed values."""
    details = getattr(error.__cause__, "errors", None)  # by Pydantic, which leaves out the value
    command = getattr(error.ctx, "command_path", "mitransient-lidar")
    if details is None or error.param is None:
        return f"{' '.join(error.format_message().split()).rstrip('.')}; see {command} --help."
    problem = details()[0]
    allowed = problem["msg"].removeprefix("Input should be ").partition(",")[0]
    return f"{error.param.opts[0]} = {problem['input']!r} must be {allowed}"


app = typer.Typer(
    cls=_GroupedCommands,
    help="Simulate multipixel depth-sounding lidar.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
_scenes_app = typer.Typer(cls=_SceneCommands, rich_markup_mode=None)


def main() -> None:
    """Run the command line."""
    _open_standard_streams()
    try:
        _run()
    finally:
        # Between the command and the end of the process, a signal has nothing to interrupt.
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, _end_at_once)


def _run() -> None:
    """Run the command that the arguments name."""
    # Commands draw to files only: Matplotlib refuses to be imported with an unknown backend.
    os.environ["MPLBACKEND"] = "agg"
    # Rasterio warns about a GeoTIFF that is then refused.
    warnings.filterwarnings("ignore", "Dataset has no geotransform")
    if sys.argv[1:2] not in (["campaign"], ["fly"]) and not {"dask", "xarray"} & sys.modules.keys():
        # xarray imports Dask wherever it is installed, which takes a third of a second. Campaigns alone need it. An
        # xarray that a script has imported before remembers where Dask is, and goes on with it.
        sys.modules["dask"] = None  # type: ignore[assignment]
    if {"-h", "--help"} & {*sys.argv} and "xarray" not in sys.modules:
        sys.modules["xarray"] = _Late("xarray")
    app(prog_name="mitransient-lidar")


class _Late(ModuleType):
    """A module that is imported when something of it is needed: help needs signatures alone."""

    def __getattr__(self, name: str) -> Any:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        return getattr(importlib.import_module(self.__name__), name)


def _end_at_once(number: int, _frame: FrameType | None) -> None:
    """End the process with the exit code of a signal."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(128 + number)


def _open_standard_streams() -> None:
    """Open standard input, output and errors that are closed, as by ``2>&-``, to nothing.

    Files would take their numbers, and messages of libraries would be written into them.
    """
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(descriptor)
        except OSError:
            # The lowest free number is this one.
            os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, os.fdopen(descriptor, "w" if descriptor else "r", encoding="utf-8", closefd=False))


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
    """List, show or copy the shipped scenes, list instruments, or print the properties of a water."""
    if context.invoked_subcommand is None:
        scenes.list_scenes()


app.add_typer(_scenes_app, name="scenes", rich_help_panel="Scenes and system")
