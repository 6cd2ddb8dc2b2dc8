"""Text files of two columns of numbers."""

from __future__ import annotations

from os import PathLike

import numpy as np
from numpy.typing import NDArray


def read_two_columns(path: str | PathLike[str], what: str, columns: str) -> NDArray[np.float64]:
    """Read two columns separated by commas or spaces; # starts a comment.

    Parameters
    ----------
    path : path-like
        Text file.
    what, columns : str
        What the file is and what its columns hold, for the message.

    Returns
    -------
    ndarray, shape (N, 2)

    Raises
    ------
    ValueError
        If the file does not hold two columns of numbers.
    """
    with open(path, encoding="utf-8") as file:
        try:
            rows = [row for line in file if (row := line.split("#")[0].replace(",", " ").split())]
            return np.array(rows, dtype=np.float64).reshape(len(rows), 2)
        except ValueError:
            raise ValueError(f"{what} {path} must hold two columns of numbers: {columns}") from None
