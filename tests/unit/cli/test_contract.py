"""Every command against the signature of its function: options arrive, bad values are refused, the help is complete."""

import functools
import inspect
import math
import typing

import pytest
import synthetic_shots
from command_line import COMMANDS, MADE, assert_refused, run, stub
from rows import each_row

from mitransient_lidar import results
from mitransient_lidar.cli.app import RENAMED
from mitransient_lidar.cli.generator import function_at
from mitransient_lidar.core.options import declared
from mitransient_lidar.results import files

#: Arguments that commands need besides an option, the result RESULT included.
NEEDED = {
    "bounds": ["table1", "--free", "attenuation"],
    "campaign": ["runs.toml"],
    "depth-bias": ["riegl_vq840g"],
    "detect": ["fig13_2x2"],
    "echoes": ["RESULT", "--no-table", "--csv", "a.csv"],
    "figures": [],
    "fit": ["RESULT", "--scene", "table1", "--free", "attenuation"],
    "fly": ["palmer"],
    "forecast": ["riegl_vq840g", "3:10"],
    "gates": ["RESULT", "--start-ns", 1400, "--width-ns", 5],
    "passive": ["passive_sea"],
    "record": ["RESULT", "--receiver", "apd"],
    "retrieve": ["RESULT"],
    "tpu": ["riegl_vq840g"],
    "scenes water": ["pure"],
}
NEEDED |= {"bench": []}
#: Options that only a file of another kind than RESULT checks: a profile, and a sea with waves.
UNTRIED = {("scenes water", "tolerance"), ("retrieve", "wind_speed")}
#: Options without limits in their declaration, whose functions have them, and values outside.
OTHERS = {
    ("detect", "pd"): [1, 0.001],
    ("detect", "clutter"): [3],
    ("echoes", "contrast"): [-0.1, 1],
    ("forecast", "secchi"): [0, -1],
    ("forecast", "kd"): [0, "nan"],
    ("record", "background_power"): [-1],
}
#: Samples of texts by their forms, and what functions get.
FORMS = {
    "N,N,...": ("2,3.5", [2.0, 3.5]),
    "NAME,NAME,...": ("IB,1C", ["IB", "1C"]),
    "ALONG,ACROSS": ("0.1,0.2", (0.1, 0.2)),
    "NUMBER|auto": ("0.5", 0.5),
    "NUMBER|FILE": ("a.tif", "a.tif"),
    "X,Y": ("3,-4", [(3.0, -4.0)]),
    "NAME": ("peak", ["peak"]),
    "NAME=VALUE": ("attenuation=2", {"attenuation": 2.0}),
    "NAME=LOW:HIGH": ("attenuation=1:2", {"attenuation": (1.0, 2.0)}),
    "NAME=V1,V2,...": ("altitude=1,2", {"altitude": ["1", "2"]}),
    "NAME[=STD]": ("scale=0.05 time_offset", {"scale": 0.05, "time_offset": math.inf}),
}
FROM_FUNCTIONS = sorted(name for name, row in COMMANDS.items() if row.function)


class ReachedError(Exception):
    """Raised by the function that stands for a public one."""


@functools.cache
def options_of(command):
    """Return type, declaration and default of each parameter of a command's function, and its option."""
    function = function_at(COMMANDS[command].function)
    parameters = {one.name: one for one in MADE[command].params}
    defaults = {name: one.default for name, one in inspect.signature(function).parameters.items()}
    return {
        name: (kind, option, {**defaults, **COMMANDS[command].defaults}[name], parameters[name])
        for name, (kind, option) in declared(function).items()
    }


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """File of a result of four pixels, which is read once, as that takes half of the time."""
    path = tmp_path_factory.mktemp("result") / "result.nc"
    made = synthetic_shots.result()
    results.save(made.assign(waveform=made["waveform"].clip(0, keep_attrs=True)), path)
    once = functools.cache(files.read_netcdf)

    def read(given):
        dataset, foreign = once(given)
        return dataset.copy(), foreign

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(files, "read_netcdf", read)
        yield path


@pytest.fixture
def needed(result, tmp_path, monkeypatch):
    """Return the arguments that a command needs, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda command: [result if one == "RESULT" else one for one in NEEDED.get(command, ["table1"])]


def sample(kind, option, default):
    """Return the words of an option, and the value that the function gets."""
    flags = option[0].opts
    kinds = {kind, *typing.get_args(kind)}
    if option[1].form in FORMS:
        text, value = FORMS[option[1].form]
        return [one for part in text.split() for one in (flags[0], part)], value
    if bool in kinds:
        return [option[0].secondary_opts[0] if default is True else flags[0]], default is not True
    low, high = option[1].low, option[1].high
    if int in kinds:
        value = low + 1 if default in (None, low) else default + 1
        return [flags[0], value], value
    if float in kinds:
        value = 1.25 if low is None else (low + 1.25 if high is None else low + 0.375 * (high - low))
        return [flags[0], value], value
    return [flags[0], "fig09_2x2"], "fig09_2x2"


@pytest.mark.parametrize("command", FROM_FUNCTIONS)
def test_each_option_reaches_its_function(command, needed, monkeypatch):
    """One option at a time: the function gets its value, and all else as without it."""
    seen = []

    def reached(*_, **given):
        seen.append(given)
        raise ReachedError

    options = options_of(command)
    stub(monkeypatch, command, reached)

    def given(*words):
        done = run(command, *needed(command), *words)
        assert isinstance(done.exception, ReachedError), (words, done.output)
        return {name: value for name, value in seen.pop().items() if name != "progress"}

    usual = given()
    for name, (kind, option, default, parameter) in options.items():
        if not option.is_argument:
            words, value = sample(kind, (parameter, option), default)
            assert given(*words) == {**usual, name: value}, name
    if "params" in usual:
        assert given("-D", "a=b=1", "-D", "c = 2") == {**usual, "params": {"a": "b=1", "c": "2"}}


def outside(kind, option):
    """Return values just outside a range, and what is no number."""
    low, high = option.low, option.high
    whole = int in {kind, *typing.get_args(kind)}
    found = [] if low is None else [low if option.above else low - 1 if whole else low - 0.01 * max(abs(low), 1e-9)]
    found += [] if high is None else [high + 1 if whole else 1.01 * high]
    if option.form == "N,N,..." and option.ascending:
        found.append("3,2")
    return found + ([] if low is None else ["nan", ""])


@pytest.mark.parametrize("command", FROM_FUNCTIONS)
def test_bad_values_are_refused_by_name(command, needed, tmp_path):
    for name, (kind, option, _, parameter) in options_of(command).items():
        for value in [] if (command, name) in UNTRIED else [*outside(kind, option), *OTHERS.get((command, name), [])]:
            pair = option.form == "ALONG,ACROSS"
            done = run(command, *needed(command), parameter.opts[0], f"{value},0.1" if pair else value)
            print(command, name, value, done.exit_code, done.stderr)
            assert_refused(done, parameter.opts[0] if value != "" else "", "must" if value != "" else "")
    assert list(tmp_path.iterdir()) == []


@each_row(*FROM_FUNCTIONS)
def test_help_shows_ranges_and_defaults(command):
    text = " ".join(run(command, "--help").stdout.split())
    for name, (_, option, default, parameter) in options_of(command).items():
        if option.is_argument:
            continue
        assert parameter.opts[0] in text
        assert option.range() in text, name
        if default not in (None, (), False, inspect.Parameter.empty):
            shown = ",".join(map("{:g}".format, default)) if option.form == "N,N,..." else default
            shown = ",".join(default) if option.form == "NAME,NAME,..." else shown
            assert f"[default: {shown}]" in text or default is True, name


def test_every_help_has_an_example_that_can_be_typed():
    for name, row in COMMANDS.items():
        if name == "scenes list":  # takes no arguments
            continue
        assert row.example
        assert f"Example: mitransient-lidar {name} {row.example}" in MADE[name].help
        MADE[name].make_context(name, row.example.split())


def test_a_store_is_completed_with_its_options(tmp_path, monkeypatch):
    """The one function that a command calls instead of its own."""
    seen = []
    MADE["campaign"].params  # noqa: B018 (of the function itself)

    def resume(*given, **options):
        seen.append((given, options))
        raise ReachedError

    monkeypatch.setattr("mitransient_lidar.campaigns.sweep.resume", resume)
    for words, value in (([], False), (["--retry-failed"], True)):
        run("campaign", tmp_path, "--workers", 2, "-q", *words)
        given, options = seen.pop()
        assert given == (tmp_path,)
        assert options == {"workers": 2, "scheduler": None, "retry_failed": value, "progress": None}
    assert_refused(run("campaign", tmp_path, "--shard-size", 4), "--shard-size is fixed in the store")


@each_row(*list(RENAMED.items()))
def test_former_names_are_refused_with_the_new_one(old, new):
    assert_refused(run(old, "a.nc"), f"the command {old} is now {new}")
