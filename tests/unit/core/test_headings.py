"""Names, units and wavelengths in headings, and validators of parameters."""

import time

import numpy as np
import pytest
from rows import each_row, refuses

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.tables.headings import (
    METRES,
    PER_METRE,
    TIME,
    UNITLESS,
    Column,
    parse_heading,
    read_headings,
)
from mitransient_lidar.core.validation import (
    finite,
    finite_array,
    in_range,
    increasing_array,
    integer,
    non_negative,
    non_negative_array,
    number_within,
    positive,
    time_samples,
)

DEPTH, Z = Column("depth", (), METRES), Column("z", (), METRES)
A, C = Column("a", (), PER_METRE, spectral=True), Column("c", ("beam attenuation",), PER_METRE, spectral=True)
BB, RATIO = Column("bb", (), PER_METRE, spectral=True), Column("bb_ratio", ("bb/b",), UNITLESS, spectral=True)
COLUMNS = (TIME, DEPTH, Z, A, C, BB, RATIO)


@each_row(
    ("depth", DEPTH, 1, 0),
    ("depth_m", DEPTH, 1, 0),
    ("Depth [m]", DEPTH, 1, 0),
    ("depth/cm", DEPTH, 0.01, 0),
    ("depth in feet", DEPTH, 0.3048, 0),
    ("z", Z, 1, 0),
    ("a532", A, 1, 532),
    ("A_532nm", A, 1, 532),
    ("a(532 nm) [m-1]", A, 1, 532),
    ("c(532) 1/m", C, 1, 532),
    ("c / (1/km)", C, 1e-3, 0),
    ("Beam attenuation 532 [m⁻¹]", C, 1, 532),
    ("c_m^-1", C, 1, 0),
    ("bb", BB, 1, 0),
    ("bb532/m-1", BB, 1, 532),
    ("bb/b", RATIO, 1, 0),
    ("bb_ratio (%)", RATIO, 0.01, 0),
    ("t_ns", None, 1, 0),
    ("time_ns", TIME, 1, 0),
    ("time (µs)", TIME, 1e3, 0),
    ("ps", TIME, 1e-3, 0),
    ("temperature", None, 1, 0),
    ("1/m", None, 1, 0),
    ("m", None, 1, 0),
    ("", None, 1, 0),
)
def test_headings_are_understood(text, column, factor, wavelength):
    columns = COLUMNS if text != "t_ns" else COLUMNS[1:]
    heading = parse_heading(text, columns)
    assert (heading.column if heading else None) is column
    if heading:
        assert heading.known_unit
        assert heading.factor == pytest.approx(factor)
        assert heading.wavelength_nm == wavelength


@refuses(
    (["depth", "Tiefe"], r"^x.csv has an unknown column 'Tiefe' \(found: depth, Tiefe\): allowed are time \[ns, "),
    (["depth [hPa]", "a"], r"unit in column 'depth \[hPa\]' \(found: .*depth, z \[m, cm, mm, km, dm, ft, ftus"),
    (["a_nw", "depth"], "unknown unit in column 'a_nw'"),
    (["a532", "a_532"], "has 2 columns a532 and a_532 for a: allowed is one"),
    (["a412", "a532"], "has columns for 412, 532 nm: the wavelength must be chosen, .* by wavelength_nm"),
    (["a412.5", "c532"], "has columns for 412.5, 532 nm"),
)
def test_unclear_headings_are_rejected(names):
    read_headings("x.csv", names, COLUMNS)


@pytest.mark.parametrize("text", ["depth" + 2 * 10**5 * " " + "x", "depth" + 10**5 * " x"])
def test_long_headings_take_no_longer_than_their_length(text):
    began = time.process_time()
    with pytest.raises(UserError, match="depth") as caught:
        read_headings("a.csv", [text], COLUMNS)
    assert time.process_time() - began < 10
    assert len(str(caught.value)) < 2001


def test_clean_values():
    assert positive("x", 1) == 1.0
    assert integer("x", 3.0, 1, 5) == 3
    assert in_range("x", "7", 1, np.inf) == 7.0
    assert integer("x", np.array(2.0), 0, 9) == integer("x", np.array(2), 0, 9) == 2
    values = np.arange(3)
    assert not np.shares_memory(finite_array("x", values), values)
    assert increasing_array("x", values).dtype == np.float64
    assert [v.tolist() for v in time_samples([0, 1], "power", [2, 3])] == [[0, 1], [2, 3]]


@refuses(
    *((lambda bad=bad: finite("x", bad), "^x ") for bad in (np.nan, np.inf, "deep", None)),
    (lambda: positive("x", 0), "x = 0 must be greater than 0"),
    (lambda: non_negative("x", -1), "x = -1 must not be negative"),
    (lambda: in_range("x", 2, 0, 1), "x = 2 must lie between 0 and 1"),
    (lambda: in_range("x", 0.5, 1, np.inf), r"x = 0\.5 must be at least 1$"),
    (lambda: number_within("x", 0, 0, 1, above=True), "x = 0 must be greater than 0 and at most 1$"),
    (lambda: number_within("x", 1.5, 0, 1, above=True), r"x = 1\.5 must be greater than 0 and at most 1$"),
    (lambda: number_within("x", 1, 1, above=True), "x = 1 must be greater than 1$"),
    (lambda: number_within("x", -1, 0), "x = -1 must not be negative$"),
    (lambda: integer("x", 1.5, 0, 9), r"x = 1\.5 must be an integer"),
    (lambda: integer("x", np.array(2.5), 0, 9), r"x = 2\.5 must be an integer"),
    (lambda: integer("x", np.array([2.0]), 0, 9), r"x = array\(\[2.\]\) must be an integer"),
    (lambda: integer("x", "2", 0, 9), r"x = '2' must be an integer"),
    (lambda: finite_array("x", [10**400]), "must hold numbers only"),
    (lambda: finite_array("x", [1, np.nan]), "x holds nan but every value must be finite"),
    (lambda: finite_array("x", ["a"]), "must hold numbers only"),
    (lambda: non_negative_array("x", [1, -2, -3]), "x = -3 must not be negative"),
    (lambda: non_negative_array("x", [1, -1e-9]), "x = -1e-09 must not be negative"),
    (lambda: increasing_array("x", [1]), r"x of shape \(1,\) must be a list of at least 2 numbers"),
    (lambda: increasing_array("x", [[1, 2]]), r"x of shape \(1, 2\) must be a list"),
    (lambda: increasing_array("x", [0, 2, 2]), "x must increase strictly, but 2 is followed by 2"),
    (lambda: time_samples([0, 1], "power", [1]), r"power of shape \(1,\) must have equal lengths"),
)
def test_invalid_values_are_rejected(call):
    call()
