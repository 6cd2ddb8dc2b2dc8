"""Campaigns: tables of their runs, expressions of parameters, and what is refused."""

import tracemalloc

import numpy as np
import pytest
from rows import each_row, must_refuse, refuses

from mitransient_lidar.campaigns.design import Campaign, Expression, Range
from mitransient_lidar.campaigns.sweep import render_row
from mitransient_lidar.core.errors import UserError

CAMPAIGN = {
    "scene": "table1",
    "fixed": {"layout": "2x2", "ratio": 0.8},
    "parameters": {
        "bottom_depth": {"low": 2.0, "high": 20.0},
        "attenuation": {"low": 0.15, "high": 1.5, "scale": "log"},
        "scattering": "ratio * attenuation",
        "wind_speed": [3.0, 6.0, 10.0],
    },
    "design": {"kind": "sobol", "count": 64, "seed": 1},
}
TWO = {"scene": "table1", "design": {"kind": "random", "count": 2}}
RANGE = {"low": 1.0, "high": 2.0, "steps": 10**6}


def changed(**sections):
    """Return the campaign with other keys; None leaves one out."""
    given = {**CAMPAIGN, **sections}
    return {name: value for name, value in given.items() if value is not None}


def test_columns_in_the_order_of_the_file_within_their_ranges():
    table = Campaign.of_file(CAMPAIGN).table()
    assert list(table) == ["bottom_depth", "attenuation", "scattering", "wind_speed"]
    assert {len(column) for column in table.values()} == {64}
    assert table["bottom_depth"].min() >= 2
    assert table["bottom_depth"].max() <= 20
    np.testing.assert_allclose(table["scattering"], 0.8 * table["attenuation"], rtol=1e-12)
    # A balanced sequence: 32 of 64 values of a logarithmic range below its geometric mean, and a third of each list.
    assert np.count_nonzero(table["attenuation"] < np.sqrt(0.15 * 1.5)) == 32
    assert min(np.unique(table["wind_speed"], return_counts=True)[1]) >= 20


def test_same_seed_same_runs_and_a_latin_hypercube_has_one_in_each_part_of_a_range():
    first, again, other = (
        Campaign.of_file(changed(design={"kind": "sobol", "count": 37, "seed": seed})).table() for seed in (1, 1, 2)
    )
    for name in first:
        np.testing.assert_array_equal(first[name], again[name])
    assert not np.array_equal(first["bottom_depth"], other["bottom_depth"])
    table = Campaign.of_file(changed(design={"kind": "latin_hypercube", "count": 36})).table()
    parts = np.floor((table["bottom_depth"] - 2) / 18 * 36).astype(int)
    assert sorted(parts) == list(range(36))


def test_grid_has_all_combinations():
    ranges = {"bottom_depth": {"low": 2, "high": 20}, "attenuation": {"low": 0.1, "high": 1, "scale": "log"}}
    parameters = {name: {**one, "steps": 3} for name, one in ranges.items()} | {"layout": ["1x1", "2x2"]}
    table = Campaign.of_file(changed(parameters=parameters, fixed=None, design={"kind": "grid"})).table()
    assert len(table["layout"]) == 18
    assert len(set(zip(*(column.tolist() for column in table.values()), strict=True))) == 18
    np.testing.assert_allclose(np.unique(table["bottom_depth"]), [2, 11, 20])
    np.testing.assert_allclose(np.unique(table["attenuation"]), [0.1, 10**-0.5, 1])


def test_table_of_a_file(tmp_path):
    (tmp_path / "runs.csv").write_text("bottom_depth, petzold\n5, clear\n7.5, coastal\n")
    given = {"scene": "table1", "parameters": {"altitude": "20 * bottom_depth"}, "design": {"file": "runs.csv"}}
    table = Campaign.of_file(given, tmp_path).table()
    assert table["bottom_depth"].tolist() == [5, 7.5]
    assert table["petzold"].tolist() == ["clear", "coastal"]
    assert table["altitude"].tolist() == [100, 150]


@refuses(
    ("bottom_depth\n", "a row for each run"),
    ("bottom_depth,layout\n5\n", "run 1: it must have 2 values"),
    ("bottom_depth,bottom_depth\n5,6\n", "name each column once"),
    ("altitude\n5\n", "is a column of"),
)
def test_invalid_tables(text, tmp_path):
    (tmp_path / "runs.csv").write_text(text)
    given = {"scene": "table1", "fixed": {"altitude": 100}, "design": {"kind": "table", "file": "runs.csv"}}
    Campaign.of_file(given, tmp_path).table()


def test_read(tmp_path):
    lines = ["scene = 'table1'", "target_error = 0.1", "keep = ['truth', 'waveform']", "[parameters]"]
    lines += ["bottom_depth = { low = 2.0, high = 20.0 }", "[design]", "kind = 'random'", "count = 3"]
    (tmp_path / "campaign.toml").write_text("\n".join(lines))
    campaign = Campaign.read(tmp_path / "campaign.toml")
    assert campaign.parameters == {"bottom_depth": Range(2, 20)}
    assert (campaign.keep, campaign.target_error) == (("waveform", "truth"), 0.1)
    assert len(campaign.table()["bottom_depth"]) == 3
    again = Campaign.from_json(campaign.text)
    np.testing.assert_array_equal(again.table()["bottom_depth"], campaign.table()["bottom_depth"])


def test_scene_beside_the_file(tmp_path):
    (tmp_path / "mine.xml").write_text("<scene version='3.0.0'/>")
    assert Campaign.of_file({**TWO, "scene": "mine.xml"}, tmp_path).scene == str(tmp_path / "mine.xml")
    (tmp_path / "table1").write_text("another file")
    assert Campaign.of_file(TWO, tmp_path).scene == "table1"


#: TOML of 480 brackets is read, and ended in a traceback behind the reader.
NESTED = [f'scene = "table1"\n[fixed]\nlayout = {depth * "["}{depth * "]"}\n' for depth in (120, 300, 480)]


@refuses(
    ("scene = ", r"campaign\.toml is not a TOML file: "),
    ("\x00", r"campaign\.toml is not a TOML file: "),
    *((text, "is nested more than 100 deep") for text in NESTED),
)
def test_files_that_are_no_campaign(text, tmp_path):
    (tmp_path / "campaign.toml").write_text(text)
    Campaign.read(tmp_path / "campaign.toml")


@refuses(
    ({"keep": ["waveform", "light"]}, "keep holds 'light'"),
    ({"keep": []}, r"keep = \[\] must be a list"),
    ({"gain": "auto"}, "gain = 'auto' needs a receiver"),
    ({"fixed": {"bottom_depth": 3}}, r"'bottom_depth' is in \[fixed\] and in \[parameters\]"),
    ({"parameters": {"altitude": {"low": 3, "high": 3}}}, "altitude has the empty range 3 to 3"),
    ({"parameters": {"altitude": {"low": 0, "high": 2, "scale": "log"}}}, r"altitude\.low = 0 must be positive"),
    ({"parameters": {"altitude": 3}}, r"altitude = 3 must be a range .* belongs to \[fixed\]"),
    ({"parameters": {"altitude": [1, "a"]}}, "altitude = .* must be a range"),
    ({"parameters": {"altitude": [1, float("nan")]}}, "altitude = nan"),
    ({"design": {"kind": "sobol"}}, "design.count = None: a design of kind 'sobol' needs a number of runs"),
    ({"design": {"kind": "grid", "count": 3}}, "design.count = 3"),
    ({"design": {"kind": "sobol", "count": 2, "file": "a.csv"}}, "design.file = 'a.csv'"),
    ({"design": {"kind": "table"}}, "design.file = None"),
    ({"parameters": {}}, "no parameters to vary"),
    ({"parameters": {"a": "b", "b": "a", "c": [1, 2]}}, "a, b depend on each other in a circle"),
    ({"parameters": {"a": "z + 1", "c": [1, 2]}}, "needs z, which is neither"),
    ({"parameters": {"a": "1 / c", "c": [0, 0.0]}}, "not finite"),
    ({"parameters": {"a": "2 * c", "c": ["x", "y"]}}, "needs c, whose values are texts"),
    ({"parameters": {"a": {"low": 0, "high": 1}}, "design": {"kind": "grid"}}, r"a\.steps is missing: the range"),
)
def test_invalid_campaigns(sections):
    Campaign.of_file(changed(**sections)).table()


@each_row(
    (94, {"count": 10**7}, "has 10000000 runs of 94 parameters: it may have 100000000 values"),
    (11, {"kind": "random", "count": 10**7}, "has 10000000 runs of 11 parameters"),
    (2, {"kind": "grid"}, "has 1000000000000 runs"),
    (500, {"kind": "grid"}, "it must have 1 to 10000000"),
)
def test_tables_are_refused_before_they_take_memory(parameters, design, message):
    campaign = Campaign.of_file(
        {"scene": "table1", "parameters": {f"p{i}": RANGE for i in range(parameters)}, "design": design}
    )
    tracemalloc.start()
    must_refuse(message, campaign.table)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


def test_unknown_parameters_are_refused_before_the_table_is_made(monkeypatch):
    campaign = Campaign.of_file(changed(parameters={"nothing": RANGE}, fixed=None, design={"count": 10**6}))
    monkeypatch.setattr(Campaign, "table", lambda self: pytest.fail("the table was made"))
    must_refuse("parameter 'nothing' is not one of scene table1", render_row, campaign, 0)


@each_row(
    ("0.8 * attenuation", 0.4),
    ("-attenuation + 2", 1.5),
    ("(attenuation + depth) / 2 ** 3", 0.5625),
    ("sqrt(depth) - exp(log(attenuation))", 1.5),
    ("min(depth, 3) + max(attenuation, 0.75)", 3.75),
    ("sin(0) + cos(0) + tan(0)", 1.0),
    ("7", 7.0),
)
def test_values(text, expected):
    found = Expression("x", text).evaluate({"attenuation": np.array([0.5]), "depth": np.array([4.0])})
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_names_are_those_of_parameters():
    assert Expression("x", "max(a, 2 * b) / sqrt(c)").names == {"a", "b", "c"}
    assert Expression("x", "min + 1").names == {"min"}


@each_row(
    *((text, "may hold") for text in ("__import__('os')", "a if b else c", "[1, 2]", "sqrt(1, 2)", "min(1)", "'text'")),
    *((text, "may hold") for text in ("True", "a < b", "a // b", "a @ b", "~a", "sqrt(x=2)", "round(2)")),
    *((text, "no expression") for text in ("a = 2", "2 *", "", "(" * 240 + "1" + ")" * 240)),
    ("a.b", "'a.b'"),
    ("a" + ".b" * 240, "may hold"),
    ("+".join(["a"] * 300), "has 599 characters: it may have 500"),
)
def test_anything_else_is_refused(text, part):
    with pytest.raises(UserError, match=r"^x = ") as error:
        Expression("x", text)
    assert part in str(error.value)


@each_row("1 / (a - 1)", "log(a - 1)", "10 ** 400", "sqrt(-a)")
def test_values_must_be_finite(text):
    must_refuse("not finite", lambda: Expression("x", text).evaluate({"a": np.array([1.0, 2.0])}))
