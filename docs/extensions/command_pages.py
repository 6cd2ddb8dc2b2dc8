"""Command line reference, from the Typer app: one section a command, under the help's headings."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import typer
from generated import table, write
from sphinx.application import Sphinx

from mitransient_lidar.cli.app import app as command_line

_PROGRAM = "mitransient-lidar"

_INTRODUCTION = """\
# Commands

`mitransient-lidar COMMAND --help` prints what this page says of a command. Wrong input ends a command with one sentence
on stderr and the exit code 2, without any file written; Ctrl-C ends it with 130. Results go to stdout, everything else
to stderr. `python -m mitransient_lidar` is the same program.
"""


def setup(sphinx: Sphinx) -> dict[str, bool]:
    """Write the page when the build starts."""
    sphinx.connect("builder-inited", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _write(sphinx: Sphinx) -> None:
    group = typer.main.get_command(command_line)
    headings: dict[str, list[tuple[str, Any]]] = {}
    for name, command in group.commands.items():
        headings.setdefault(command.rich_help_panel, []).append((name, command))
    parts = [_INTRODUCTION, _overview(headings)]
    for heading, commands in headings.items():
        parts.append(f"## {heading}\n")
        for name, command in commands:
            parts.append(_section(f"{_PROGRAM} {name}", command, level=3))
            for subname, subcommand in getattr(command, "commands", {}).items():
                parts.append(_section(f"{_PROGRAM} {name} {subname}", subcommand, level=4))
    write(Path(sphinx.srcdir) / "reference" / "commands.md", "\n".join(parts))


def _overview(headings: dict[str, list[tuple[str, Any]]]) -> str:
    """Return a table with all commands and their help's first sentence."""
    rows = [
        (heading if not number else "", f"[`{name}`](#command-{name})", command.get_short_help_str(limit=200))
        for heading, commands in headings.items()
        for number, (name, command) in enumerate(commands)
    ]
    return table(("", "command", ""), rows)


def _section(usage: str, command: Any, level: int) -> str:
    """Return a command's section: usage, help, arguments and options."""
    context = command.make_context(usage, [], resilient_parsing=True)
    name = usage.removeprefix(f"{_PROGRAM} ")
    line = " ".join([usage, *command.collect_usage_pieces(context)])
    parts = [f"(command-{name.replace(' ', '-')})=", f"{'#' * level} {name}\n", f"```text\n{line}\n```\n"]
    parts.append(_escaped(inspect.cleandoc(command.help or "")) + "\n")
    for kind in ("argument", "option"):
        found = [one for one in command.get_params(context) if one.param_type_name == kind and one.name != "help"]
        # As the help prints them: names and type, meaning with default and bounds.
        rows = [
            (f"`{names}`", _escaped(" ".join(meaning.split())))
            for names, meaning in filter(None, (one.get_help_record(context) for one in found))
        ]
        if rows:
            parts.append(table((kind, "meaning"), rows, "options"))
    return "\n".join(parts)


def _escaped(text: str) -> str:
    """Return text in which Markdown sees no markup of its own."""
    parts = text.split("`")
    for number in range(0, len(parts), 2):
        parts[number] = parts[number].replace("<", "\\<").replace("*", "\\*").replace("_", "\\_").replace("$", "\\$")
    return "`".join(parts)
