"""Tables in text files, and line numbers of their errors."""

import numpy as np
import pytest

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.text_tables import read_lines, read_two_columns


@pytest.fixture
def path(tmp_path):
    return tmp_path / "table.txt"


def test_lines_keep_their_numbers(path):
    path.write_text("# comment\n\n a, b # units\n1,2\n", encoding="utf-8-sig")
    assert read_lines(path) == [(3, "a, b"), (4, "1,2")]


@pytest.mark.parametrize("heading", ["", "time (ns), power\n"])
def test_two_columns(path, heading):
    path.write_text(heading + "0, 1\n# gap\n2 3e-1\n")
    table, lines = read_two_columns(path, "time and power")
    np.testing.assert_array_equal(table, [[0, 1], [2, 0.3]])
    assert lines == [1 + bool(heading), 3 + bool(heading)]


def test_empty_files_have_no_rows(path):
    path.write_text("# only a comment\n")
    assert read_two_columns(path, "time and power")[0].shape == (0, 2)


@pytest.mark.parametrize("line", ["1 2 3", "1", "1 x", "time power"])
def test_lines_without_two_numbers_are_rejected(path, line):
    path.write_text(f"0 0\n{line}\n")
    with pytest.raises(UserError, match=f"table.txt, line 2: '{line}' must be two numbers, time and power"):
        read_two_columns(path, "time and power")


def test_unreadable_files_are_rejected(path):
    with pytest.raises(UserError, match=r"cannot read .*table.txt: No such file or directory"):
        read_lines(path)
    path.write_bytes(b"\xff")
    with pytest.raises(UserError, match=r"table.txt is not a text file in UTF-8"):
        read_lines(path)
