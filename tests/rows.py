"""Rows of a table in one test: for checks that cost less than the set-up of a test of their own."""

import functools
import inspect
import re

import pytest

from mitransient_lidar.core.errors import UserError


def names_of(test, rows):
    """Return the first parameters of a test, one for each entry of a row; what is no tuple is one entry."""
    first = getattr(rows[0], "values", rows[0])
    return list(inspect.signature(test).parameters)[: len(first) if isinstance(first, tuple) else 1]


def each_row(*rows):
    """Return a decorator that makes one test of all rows, whose entries are its first parameters.

    A failure names its row, and skipped rows leave the others. Each row has a folder of its own as `tmp_path`; what
    `monkeypatch` has replaced and what `capsys` and `caplog` have seen ends with the row.
    """

    def decorate(test):
        names = names_of(test, rows)
        signature = inspect.signature(test)

        @functools.wraps(test)
        def all_rows(**fixtures):
            for number, row in enumerate(rows):
                # Rows may be those of `pytest.param`.
                values = row.values if hasattr(row, "marks") else row if isinstance(row, tuple) else (row,)
                own = dict(zip(names, values, strict=True))
                if "tmp_path" in fixtures:
                    own["tmp_path"] = fixtures["tmp_path"] / f"row{number}"
                    own["tmp_path"].mkdir()
                try:
                    test(**{**fixtures, **own})
                except pytest.skip.Exception:
                    continue
                except BaseException as error:
                    error.add_note(f"in row {number}: {row!r}")
                    raise
                for fixture, end in (("monkeypatch", "undo"), ("capsys", "readouterr"), ("caplog", "clear")):
                    if fixture in fixtures:
                        getattr(fixtures[fixture], end)()

        own_fixtures = [value for name, value in signature.parameters.items() if name not in names]
        all_rows.__signature__ = signature.replace(parameters=own_fixtures)
        return all_rows

    return decorate


def each_case(*rows):
    """Return a decorator as `each_row`, which makes a test of each row: for what takes long or has other fixtures."""

    def decorate(test):
        names = names_of(test, rows)
        single = [row[0] if isinstance(row, tuple) and not hasattr(row, "marks") else row for row in rows]
        return pytest.mark.parametrize(",".join(names), rows if len(names) > 1 else single)(test)

    return decorate


def must_refuse(message, function, /, *arguments, **options):
    """Check that a call is refused in one line that contains the message, or matches it as a pattern."""
    with pytest.raises(UserError) as caught:
        function(*arguments, **options)
    sentence = str(caught.value)
    assert message in sentence or re.search(message, sentence), f"{message!r} is not in: {sentence}"
    assert "\n" not in sentence


def refuses(*rows):
    """Return a decorator as `each_row`: a call with each row is refused by what its last entry says."""

    def decorate(test):
        parameters = list(inspect.signature(test).parameters.values())
        message = inspect.Parameter("message", inspect.Parameter.POSITIONAL_OR_KEYWORD)

        @functools.wraps(test)
        def refused(*, message, **given):
            must_refuse(message, test, **given)

        count = len(rows[0]) - 1
        refused.__signature__ = inspect.Signature([*parameters[:count], message, *parameters[count:]])
        return each_row(*rows)(refused)

    return decorate
