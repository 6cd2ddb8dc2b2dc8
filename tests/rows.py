"""Rows of a table in one test: for checks that cost less than the set-up of a test of their own."""

import functools
import inspect
import re

import pytest

from mitransient_lidar.core.errors import UserError


def each_row(names, rows, ids=None):
    """Return a decorator like `pytest.mark.parametrize`, which makes one test of all rows; a failure names its row.

    Skipped rows leave the others. Each row has a folder of its own as `tmp_path`; what `monkeypatch` has replaced and
    what `capsys` and `caplog` have seen ends with the row.
    """
    names = [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
    labels = list(ids) if isinstance(ids, (list, tuple)) else None

    def decorate(test):
        signature = inspect.signature(test)

        @functools.wraps(test)
        def all_rows(**fixtures):
            for number, row in enumerate(rows):
                # Rows may be those of `pytest.param`.
                values = row.values if hasattr(row, "marks") else row if len(names) > 1 else (row,)
                own = dict(zip(names, values, strict=True))
                if "tmp_path" in fixtures:
                    own["tmp_path"] = fixtures["tmp_path"] / f"row{number}"
                    own["tmp_path"].mkdir()
                try:
                    test(**{**fixtures, **own})
                except pytest.skip.Exception:
                    continue
                except BaseException as error:
                    error.add_note(f"in row {number}: {labels[number] if labels else row!r}")
                    raise
                for fixture, end in (("monkeypatch", "undo"), ("capsys", "readouterr"), ("caplog", "clear")):
                    if fixture in fixtures:
                        getattr(fixtures[fixture], end)()

        own_fixtures = [value for name, value in signature.parameters.items() if name not in names]
        all_rows.__signature__ = signature.replace(parameters=own_fixtures)
        return all_rows

    return decorate


def refuses(*rows):
    """Return a decorator: each row is refused in one line that contains its last entry, or matches that pattern.

    The first parameters of the test get the other entries of a row.
    """

    def decorate(test):
        parameters = list(inspect.signature(test).parameters.values())
        row = inspect.Parameter("message", inspect.Parameter.KEYWORD_ONLY)

        @functools.wraps(test)
        def refused(*, message, **given):
            with pytest.raises(UserError) as caught:
                test(**given)
            sentence = str(caught.value)
            assert message in sentence or re.search(message, sentence), f"{message!r} is not in: {sentence}"
            assert "\n" not in sentence

        refused.__signature__ = inspect.Signature([*parameters, row])
        names = [one.name for one in parameters[: len(rows[0]) - 1]]
        return each_row([*names, "message"], rows)(refused)

    return decorate
