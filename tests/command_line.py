"""Run commands in the process of the tests, and check how they refuse invalid input."""

from __future__ import annotations

import functools

import typer.testing

from mitransient_lidar.cli.app import COMMANDS, app

# Typer builds its command anew for every call, which takes longer than most commands of the tests.
typer.testing._get_command = functools.cache(typer.testing._get_command)

GROUP = typer.testing._get_command(app)


def run(*arguments):
    """Return the result of a command, whose arguments may be of any type."""
    return typer.testing.CliRunner().invoke(app, [str(argument) for argument in arguments])


def stub(monkeypatch, command, function):
    """Replace the function that a command calls, and keep its options."""
    GROUP.commands[command].params  # noqa: B018 (reads the signature)
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
