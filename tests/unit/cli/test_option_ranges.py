"""Ranges of numeric options: every help names one, and what lies outside is refused."""

import functools
import re
import typing

import pytest
import synthetic_shots
import typer
from command_line import assert_refused, run

from mitransient_lidar import results
from mitransient_lidar.cli.app import app
from mitransient_lidar.results import netcdf

NUMBER = r"-?\d[\d ]*(?:\.\d+)?(?:e-?\d+)?(?:\^\d+)?(?:/\d+)?(?: - 1)?"
RANGE = re.compile(rf"({NUMBER}) to ({NUMBER})")
LEAST = re.compile(rf"at least ({NUMBER})")
ABOVE = re.compile(rf"greater than ({NUMBER})")
BELOW = re.compile(r"below 1\b")
#: Options without fixed limits, and what their help says instead.
OTHERS = {"--start-ns": "any number", "--start-depth": "any number", "--shot": "from 0", "--row": "from 0"}
OTHERS |= {"--wind-direction-deg": "any angle"}
#: Options of numbers as text.
LISTS = {
    "--angles",
    "--depths",
    "--altitudes",
    "--winds",
    "--fov-mrad",
    "--slope-deviation",
    "--gain",
    "--optical-density",
}

#: Arguments that commands need besides the option, the result RESULT included.
NEEDED = {
    "beam-spread": ["table1", "--depths", 2],
    "bench": [],
    "bounds": ["table1", "--free", "attenuation"],
    "depth-bias": ["riegl_vq840g"],
    "detect": ["fig13_2x2"],
    "estimate": ["table1"],
    "figures": [],
    "find-shots": ["table1"],
    "fit": ["RESULT", "--scene", "table1", "--free", "attenuation"],
    "fly": ["palmer"],
    "fov-sweep": ["table1"],
    "gates": ["RESULT", "--start-ns", 1400, "--width-ns", 5],
    "passive": ["passive_sea"],
    "record": ["RESULT", "--receiver", "apd"],
    "render": ["table1"],
    "retrieve": ["RESULT"],
    "scattering-orders": ["table1"],
    "shot-statistics": ["table1"],
    "shots": ["table1"],
    "target-signal": ["fig13_2x2"],
    "tpu": ["riegl_vq840g"],
    "water": ["pure"],
    "waveforms": ["RESULT"],
}
#: Options that only a file of another kind than RESULT checks: a profile, a table of corrections, a sea with waves.
UNTRIED = {("water", "--tolerance"), ("waveforms", "--wind-speed"), ("retrieve", "--wind-speed")}


def commands(group, name=""):
    """Return all commands by their names."""
    found = {}
    for key, one in getattr(group, "commands", {}).items():
        found |= commands(one, f"{name} {key}".strip())
    return found or {name: group}


COMMANDS = commands(typer.main.get_command(app))


def kinds(annotation):
    """Return the types in an annotation."""
    parts = typing.get_args(annotation)
    return set().union(*map(kinds, parts)) if parts else {annotation}


def numeric_options(command):
    """Return names and helps of the options of numbers, those of lists included."""
    return {
        one.opts[0]: one.help
        for one in COMMANDS[command].params
        if kinds(one.type_descriptor.annotation) & {int, float} or one.opts[0] in LISTS
    }


def number(text):
    """Return a number of a help: 10^9, 1/512, 100 000, 2^63 - 1."""
    base, _, power = text.removesuffix(" - 1").replace(" ", "").partition("^")
    if power:
        sign = -1 if base.startswith("-") else 1
        return sign * abs(int(base)) ** int(power) - text.endswith(" - 1")
    above, _, below = base.partition("/")
    return float(above) / float(below) if below else float(above) if re.search(r"[.e]", above) else int(above)


def outside(text):
    """Return values just outside the range that a help names, its first one."""
    found = [number(low) - 1 for low in LEAST.findall(text)] + [number(low) for low in ABOVE.findall(text)]
    for low, high in [match.groups() for match in [RANGE.search(text)] if match]:
        low, high = number(low), number(high)
        whole = isinstance(low, int)
        found += [low - 1 if whole else 0.99 * low, high + 1 if whole else 1.01 * high]
    return found + [1] * len(BELOW.findall(text))


def has_range(option, text):
    """Return whether a help names a range, or what stands for one."""
    return any(kind.search(text) for kind in (RANGE, LEAST, ABOVE, BELOW)) or OTHERS.get(option, "?") in text


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_help_names_the_range_of_every_number(command):
    assert [option for option, text in numeric_options(command).items() if not has_range(option, text)] == []


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """File of a result of four pixels; it and tables of corrections are read once, as that takes half of the time."""
    path = tmp_path_factory.mktemp("result") / "result.nc"
    results.save(synthetic_shots.result(), path)
    once = functools.cache(netcdf.read)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(netcdf, "read", lambda given: (once(given)[0].copy(), once(given)[1]))
        yield path


@pytest.mark.parametrize("command", sorted(NEEDED))
def test_values_outside_the_range_of_the_help_are_refused(command, result, tmp_path, monkeypatch):
    """Help and check of an option agree, and the check is made before anything is rendered."""
    monkeypatch.chdir(tmp_path)
    needed = [result if one == "RESULT" else one for one in NEEDED[command]]
    tried = 0
    for option, text in numeric_options(command).items():
        for value in [] if (command, option) in UNTRIED else outside(text):
            given = f"{value},0.1" if option == "--slope-deviation" else value
            done = run(command, *needed, option, given)
            print(command, option, value, done.exit_code, done.stderr)
            assert_refused(done, "must")
            tried += 1
    assert tried > 0
    assert list(tmp_path.iterdir()) == []
