"""Options of a render: one list for functions, commands and results."""

import importlib
import inspect
import pkgutil
import re
from dataclasses import fields

import pytest
import typer
from command_line import assert_refused, run

import mitransient_lidar
from mitransient_lidar import campaigns, rendering, studies
from mitransient_lidar.campaigns.design import Campaign
from mitransient_lidar.cli.app import app
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import declared
from mitransient_lidar.rendering.options import MOST_PASSES, SMALLEST_SHARE, RenderOptions

NAMES = [one.name for one in fields(RenderOptions)]
COMMANDS = typer.main.get_command(app).commands


def test_render_has_all_options_and_documents_their_ranges():
    parameters = inspect.signature(mitransient_lidar.render).parameters
    assert set(NAMES) < set(parameters)
    parts = re.split(r"^(\w[\w, ]*)\n(?=    )", inspect.getdoc(mitransient_lidar.render), flags=re.MULTILINE)
    described = {name: text for names, text in zip(parts[1::2], parts[2::2], strict=True) for name in names.split(", ")}
    for name, (_, option) in declared(RenderOptions).items():
        assert option.range() in " ".join(described[name].split()), name


def test_commands_show_meaning_and_range():
    (option,) = [one for one in COMMANDS["render"].params if one.name == "max_time"]
    assert option.help == "Stop before this many seconds, after at least two passes (greater than 0)."
    assert [one.name for one in COMMANDS["render"].params[:3]] == ["scene", "define", "instrument"]


@pytest.mark.parametrize(
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


def test_unknown_options_of_a_scene_are_errors():
    with pytest.raises(TypeError, match="unexpected keyword argument 'frames'"):
        mitransient_lidar.render("table1", frames=2)


def public_functions():
    """Return the functions and methods of rendering, studies, campaigns and the top of the package, by their names."""
    found = {name: getattr(mitransient_lidar, name) for name in mitransient_lidar.__all__}
    for package in (rendering, studies, campaigns):
        for about in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
            module = importlib.import_module(about.name)
            for name, one in vars(module).items():
                if name.startswith("_") or getattr(one, "__module__", None) != about.name:
                    continue
                members = vars(one).items() if inspect.isclass(one) else [("", one)]
                found |= {f"{about.name}.{name}.{part}": each for part, each in members if not part.startswith("_")}
    found = {name: getattr(one, "__func__", one) for name, one in found.items()}
    return {name: set(inspect.signature(one).parameters) for name, one in found.items() if inspect.isfunction(one)}


def test_what_takes_an_error_takes_a_time():
    functions = public_functions()
    with_error = {name for name, parameters in functions.items() if "target_error" in parameters}
    assert with_error <= {name for name, parameters in functions.items() if "max_time" in parameters}
    assert {"render", "render_shots", "mitransient_lidar.rendering.passes.Goal.from_options"} < with_error
    commands = {name: {one.name for one in command.params} for name, command in COMMANDS.items()}
    with_error = {name for name, options in commands.items() if "target_error" in options}
    assert with_error <= {name for name, options in commands.items() if "max_time" in options}
    assert with_error == {"render", "passive", "shots", "bench", "figures", "depth-bias"}
    assert {"target_error", "max_time"} <= {one.name for one in fields(Campaign)}
