"""Tables as printed lines and as CSV files."""

import numpy as np
import pandas as pd

from mitransient_lidar.core.tables.written import aligned_lines, table_lines, write_csv


def test_cells_stand_below_their_headings():
    columns = (("name", "<6"), ("x (m)", ">8.2f"), ("share", ">9.1%"))
    rows = [("a", np.float64(-1.236), 0.5), ("bb", "unknown", 0.25), ("none",)]
    assert table_lines(columns, rows) == [
        "name     x (m)    share",
        "a        -1.24    50.0%",
        "bb     unknown    25.0%",
        "none  ",
    ]
    assert aligned_lines([("a", "10", "text"), ("long", "5", "")], right=(1,)) == ["a     10  text", "long   5"]
    assert aligned_lines([]) == []


def test_a_file_has_digits_and_words_for_what_is_unknown(tmp_path):
    frame = pd.DataFrame({"name": ["a,b", "c"], "x": [1 / 3, np.nan], "n": [1, 2]})
    write_csv(frame, tmp_path / "a.csv", digits=9)
    assert (tmp_path / "a.csv").read_bytes() == b'name,x,n\n"a,b",0.333333333,1\nc,,2\n'
    write_csv(frame, tmp_path / "a.csv", unknown="nan")
    assert (tmp_path / "a.csv").read_text().splitlines()[1:] == ['"a,b",0.3333333333333333,1', "c,nan,2"]
