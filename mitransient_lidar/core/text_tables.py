"""Reading of tables from text files, with line numbers in error messages."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray


def read_lines(path: str | PathLike[str]) -> list[tuple[int, str]]:
    """Read the non-empty lines of a UTF-8 text file without their comments, which start with #.

    Returns
    -------
    list of (int, str)
        Number of the line, counted from 1, and its text.

    Raises
    ------
    UserError
        If the file cannot be read or is not text.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not a text file in UTF-8.") from error
    lines = [(number, line.split("#")[0].strip()) for number, line in enumerate(text.splitlines(), start=1)]
    return [(number, line) for number, line in lines if line]


def read_two_columns(path: str | PathLike[str], columns: str) -> tuple[FloatArray, list[int]]:
    """Read two columns of numbers separated by commas or spaces, below an optional heading without numbers.

    Parameters
    ----------
    path : path-like
        Text file; # starts a comment.
    columns : str
        Contents of the two columns, for the message.

    Returns
    -------
    table : ndarray, shape (N, 2)
    lines : list of int
        Number of the line of each row.

    Raises
    ------
    UserError
        If the file cannot be read, or a line does not hold two numbers.
    """
    lines = [(number, line.replace(",", " ").split()) for number, line in read_lines(path)]
    if lines and all(_number(word) is None for word in lines[0][1]):
        del lines[0]
    rows = []
    for number, words in lines:
        numbers = [_number(word) for word in words]
        if len(numbers) != 2 or None in numbers:
            raise UserError(f"{path}, line {number}: {' '.join(words)!r} must be two numbers, {columns}")
        rows.append(numbers)
    return np.array(rows, dtype=np.float64).reshape(len(rows), 2), [number for number, _ in lines]


def _number(word: str) -> float | None:
    """Return a word as a number, or None."""
    try:
        return float(word)
    except ValueError:
        return None
