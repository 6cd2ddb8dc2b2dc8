"""Options of a render: one list for functions, commands and results."""

import inspect
import re
from dataclasses import fields

import pytest
from command_line import assert_refused, run
from rows import each_row

import mitransient_lidar
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import declared
from mitransient_lidar.rendering.options import MOST_PASSES, SMALLEST_SHARE, RenderOptions

NAMES = [one.name for one in fields(RenderOptions)]


def test_render_has_all_options_and_documents_their_ranges():
    parameters = inspect.signature(mitransient_lidar.render).parameters
    assert set(NAMES) < set(parameters)
    parts = re.split(r"^(\w[\w, ]*)\n(?=    )", inspect.getdoc(mitransient_lidar.render), flags=re.MULTILINE)
    described = {name: text for names, text in zip(parts[1::2], parts[2::2], strict=True) for name in names.split(", ")}
    for name, (_, option) in declared(RenderOptions).items():
        assert option.range() in " ".join(described[name].split()), name


@each_row(
    ("name", "value", "sentence"),
    [
        ("target_error", 0, "target_error = 0 must be greater than 0"),
        (
            "target_error",
            3,
            "target_error = 3 is an error of 300 % but must be at most 1: did you mean 0.03, which is 3 %?",
        ),
        ("target_quantile", 2, "target_quantile = 2 must lie between 0.01 and 1"),
        ("max_time", -1, "max_time = -1 must be greater than 0"),
        ("passes", 1, f"passes = 1 must lie between 2 and {MOST_PASSES}"),
        ("passes", [2, 3], f"passes = [2, 3] must be an integer between 2 and {MOST_PASSES}"),
        ("seed", 2**63, f"seed = {2**63} must lie between {-(2**63)} and {2**63 - 1}"),
        ("pass_share", 0.001, f"pass_share = 0.001 must lie between {SMALLEST_SHARE:g} and 1"),
        ("max_memory", "much", "max_memory = 'much' must be a number"),
    ],
)
def test_values_out_of_range_are_refused(name, value, sentence):
    with pytest.raises(UserError, match=f"^{re.escape(sentence)}$"):
        RenderOptions(**{name: value})
    with pytest.raises(UserError, match=f"^{re.escape(sentence)}$"):
        mitransient_lidar.render("table1", **{name: value})
    if name != "pass_share" and not isinstance(value, (list, str)):
        flag = f"--{name.replace('_', '-')}"
        assert_refused(run("render", "table1", flag, value), sentence.replace(name, flag, 1))


def test_values_at_the_ends_are_accepted_and_texts_are_numbers():
    for name, (_, option) in declared(RenderOptions).items():
        for value in () if option.low is None else {option.high if option.above else option.low, option.high} - {None}:
            error = {"target_error": 1.0} if name == "target_quantile" else {}
            assert getattr(RenderOptions(**{name: value}, **error), name) == value
    assert RenderOptions(max_time="5").max_time == 5.0
