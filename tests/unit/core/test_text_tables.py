"""Tables in text files as instruments write them, line numbers of their errors, and tables that are printed."""

import logging

import numpy as np
import pandas as pd
import pytest
from rows import each_row, must_refuse, refuses

from mitransient_lidar.core.tables import text_tables
from mitransient_lidar.core.tables.headings import TIME, Column
from mitransient_lidar.core.tables.text_tables import read_table, read_time_samples
from mitransient_lidar.core.tables.written import aligned_lines, table_lines, write_csv

POWER = Column("power", ("p", "v", "mv"))
TIMES, VALUES = [0.0, 0.5, 2.0], [0.0, 3e-1, 1.0]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "table.txt"


@each_row(
    "0,0\n0.5,0.3\n2,1\n",
    "time (ns), power\n0, 0\n# gap\n0.5\t3e-1\n 2 1 # tail\n",
    "\ufeff# Laser 7\r\n\r\ntime_ns;power\r\n0;0\r\n0.5;0.3\r\n2;1\r\n",
    "power\tt [ps]\n0\t0\n0.3\t500\n1\t2000\n",
    "t / ps   V\n0 0\n500 0.3\n2000 1\n",
    "TIME [ns]  P [a.u.]\n0 0\n0.5 0.3\n2 1\n",
    "Instrument 4711\nShots;12\nt;power\nµs;mW\n0;0\n5e-4;0,3\n2e-3;1\n",
    "# measured in 2024\n# time_s power\n0 0\n5e-10 0.3\n2e-9 1\n",
    "% a comment\n! another one\n// a third\nns,mV,\n0,0,\n0.5,0.3,\n2,1,\n",
    "time_ns,power\n0,0\n0.3,NaN\n0.5,0.3\n,4\n2,1\n9,--\n9,n/a\n",
    '"Time (s)"\t"Power"\n0\t0\n5e-10\t0,3\n2e-9\t1\n',
)
def test_the_same_samples_in_any_form(text, path):
    path.write_bytes(text.encode())
    times, values = read_time_samples(path, POWER)
    np.testing.assert_allclose(times, TIMES, rtol=1e-15)
    np.testing.assert_array_equal(values, VALUES)


def test_lines_keep_their_numbers_and_missing_rows_are_told(path, caplog):
    path.write_text("\nt,power\n# x\n1,2\n1,nan\n3,4\n5,\n")
    with caplog.at_level(logging.INFO):
        table = read_time_table(path)
    assert table.lines == [4, 6]
    assert caplog.messages == [f"{path}: 2 of 4 rows left out for missing values, the first in line 5"]


def read_time_table(path):
    return read_table(path, (Column("time", ("t",), {"ns": 1.0}), POWER))


def test_fill_values_count_as_missing_only_where_the_column_says_so(path):
    columns = Column("a", fill_values=True), Column("b")
    path.write_text("a,b\n1,-9999\n-9999,1\n-999.0,1\n2,3\n")
    table = read_table(path, columns)
    np.testing.assert_array_equal(table.columns["a"], [1, 2])
    np.testing.assert_array_equal(table.columns["b"], [-9999, 3])


@refuses(
    *((f"0 0\n{line}\n", f"line 2: '{line}' must be two numbers, time in ns and power") for line in ("1 2 3", "1")),
    ("0 0\n1 x\n", "line 2: '1 x' must be two numbers, time in ns and power"),
    ("0 x\n1 2\n3 4\n", "line 1: '0 x' must be two numbers"),
    ("0 0\ntime power\n", "line 2: 'time power' must be two numbers"),
    ("t,power\n0,0\n1,x\n", r"line 3: power = 'x' must be a number$"),
    ("t,power\n0,0\n1,2,3\n4,5\n", r"line 3 has 3 values but must have 2, one for each column$"),
    ("t [fs],power\n0,0\n1,2\n", r"unit in column 't \[fs\]' \(found: t \[fs\], power\): allowed are time \[ns"),
    ("Zeit,Leistung\n0,0\n1,2\n", r"no heading with known columns \(found: Zeit, Leistung\): allowed are time"),
    ("t,power,CH1\n0,0,1\n1,2,1\n", r"unknown column 'CH1' \(found: t, power, CH1\): allowed are time .*, power\."),
    ("t,V,mV\n0,0,1\n1,2,1\n", "has 2 columns V and mV for power: allowed is one"),
    ("t,power\n0,0\n4e-9,1\n", "times from 0 to 4e-09 without a unit, too short for ns: .* such as time_s"),
)
def test_unclear_tables_are_rejected(text, path):
    path.write_text(text)
    read_time_samples(path, POWER)


def test_large_files_are_rejected_at_once(path):
    """Three million rows would take half a minute."""
    path.write_text("time,power\n" + "1,2\n" * 3_000_000)
    must_refuse(r"table.txt has 3000001 lines: a table may have 1000000", read_time_samples, path, POWER)
    path.write_text("time,power\n" + "100,200\n" * 3_000_000)
    must_refuse(r"table.txt is larger than 16 MiB, the most for a file of this kind", read_time_samples, path, POWER)


@pytest.mark.parametrize("text", ["x," * 10**5 + "\n1,2\n", "a b c d\n" * 20_000 + "1 2\n"])
def test_headings_are_looked_for_in_the_first_letters_alone(path, text, monkeypatch):
    path.write_text(text)
    asked = []
    monkeypatch.setattr(text_tables, "parse_heading", lambda text, columns: asked.append(text))
    must_refuse("has no heading with known columns", read_table, path, (TIME, POWER))
    assert len(asked) <= 2**16


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
