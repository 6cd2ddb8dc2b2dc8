"""Names, units and wavelengths in headings."""

import time

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
