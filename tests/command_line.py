"""Run commands in the process of the tests, and check how they refuse invalid input."""

from __future__ import annotations

import functools

import typer.testing

from mitransient_lidar.cli import app as command_line
from mitransient_lidar.cli import scenes
from mitransient_lidar.cli.app import app

# Typer builds its command anew for every call, which takes longer than most commands of the tests.
typer.testing._get_command = functools.cache(typer.testing._get_command)

#: Rows of all commands, and what Typer makes of them, by their words.
COMMANDS = {**command_line.COMMANDS, **{f"scenes {name}": row for name, row in scenes.SCENES.items()}}
GROUP = typer.testing._get_command(app)
MADE = {**GROUP.commands, **{f"scenes {name}": one for name, one in GROUP.commands["scenes"].commands.items()}}


def run(*arguments):
    """Return the result of a command, whose arguments may be of any type; the first one may be several words."""
    words = [*str(arguments[0]).split(" "), *map(str, arguments[1:])] if arguments else []
    return typer.testing.CliRunner().invoke(app, words)


def stub(monkeypatch, command, function):
    MADE[command].params  # noqa: B018 (reads the signature)
    place, _, name = COMMANDS[command].function.partition(":")
    monkeypatch.setattr(f"mitransient_lidar.{place}.{name}", function)


def assert_refused(result, *parts):
    """Check for one sentence on stderr that contains `parts`, nothing on stdout, and exit code 2."""
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1, result.stderr
    assert "Traceback" not in result.stderr
    for part in parts:
        assert part in result.stderr
