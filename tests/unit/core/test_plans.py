"""Tables of plans: what their declarations allow, state and refuse, a rule for every key."""

from collections.abc import Mapping
from math import inf, nan
from typing import get_args, get_origin

import pytest
from rows import must_refuse

from mitransient_lidar.campaigns.design import Campaign
from mitransient_lidar.core import options
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Plan, parts
from mitransient_lidar.flights.plan import FlightPlan

#: Values that a key without a usual one may have, where its declaration does not tell one.
_GIVEN = {"scene": "table1", "design": {"count": 3}, "scanner": {}, "platform": {}, "dynode_gains": [4.0, 4.0]}


def classes(base=Plan):
    """Return all plans by name: those of flights and campaigns, and what they hold."""
    assert {Campaign, FlightPlan} <= {*Plan.__subclasses__()}
    found = [one for sub in base.__subclasses__() for one in (sub, *classes(sub))]
    plans = [one for one in found if not getattr(one, "__abstractmethods__", ()) and one._kinds]
    return sorted(plans, key=lambda one: one.__qualname__)


def usual(name, kind, option):
    """Return a value that a declaration allows."""
    if name in _GIVEN:
        return _GIVEN[name]
    if get_origin(kind) is tuple:
        return [0.0] * len([one for one in get_args(kind) if one is not Ellipsis])
    if isinstance(kind, type) and issubclass(kind, Plan):
        return table(kind)
    if {int, float} & {*parts(kind)}:
        low, high = (option.low or 0, option.low + 1 if option.high is None else option.high) if option.low else (0, 1)
        return low if int in parts(kind) else (low + high) / 2
    words = [one for one in parts(kind) if isinstance(one, str)]
    return words[-1] if words else "a"


def table(kind):
    """Return the table of the keys that a plan must have."""
    given = kind.__dataclass_fields__.items()
    needed = [name for name, one in given if one.default is one.default_factory and name in kind._kinds]
    found = {name: usual(name, *kind._kinds[name]) for name in needed}
    # What two keys decide together.
    return found | {"Lines": {"length": 3.0}, "Design": {"count": 3}}.get(kind.__name__, {})


def wrong(kind, option):
    """Return values that a declaration does not allow."""
    kinds, numbers = parts(kind), {int, float} & {*parts(kind)}
    if get_origin(kinds[0]) is tuple and get_origin(get_args(kinds[0])[0]) is tuple:
        return []
    if get_origin(kinds[0]) is tuple:
        fixed = Ellipsis not in get_args(kinds[0])
        return ["north", [nan], *([[1.0]] if fixed else [])] if str not in get_args(kinds[0]) else [3, [3]]
    if bool in kinds:
        return [1, "yes"]
    if numbers:
        high = None if option.high is None else option.high + 1
        beyond = [] if option.low is None else [option.low if option.above else option.low - 1]
        return ["wide", True, [1.0], nan, inf, *([1.5] if int in kinds else []), *beyond, *([high] if high else [])]
    if kinds[0] is str or any(isinstance(one, str) for one in kinds):
        return [3, ["a"], *([] if str in kinds else ["none of them"])]
    is_table = get_origin(kinds[0]) is not None and issubclass(get_origin(kinds[0]), Mapping)
    return [3] if is_table or (isinstance(kinds[0], type) and issubclass(kinds[0], Plan)) else []


@pytest.mark.parametrize("plan", classes(), ids=lambda one: one.__name__)
def test_each_key_is_read_refused_and_documented_by_its_declaration(plan):
    usual_table = table(plan)
    plan.of(usual_table, "the table")
    for name, (kind, option) in plan._kinds.items():
        if name in plan.__annotations__:
            assert f" {name} {option.help()}" in " ".join(plan.__doc__.split())
        default = plan.__dataclass_fields__[name].default
        for value in (one for one in wrong(kind, option) if one != default):
            with pytest.raises(UserError, match=rf"^a\.{name}(\.[a-z]+)? (=|holds) .+ (must|is) ") as error:
                plan.of({**usual_table, name: value}, "the table", "a.")
            assert "\n" not in str(error.value)
        if name in usual_table and name not in ("length", "count"):
            with pytest.raises(UserError, match=f"^the table has no {name}: it must have it$"):
                plan.of({key: value for key, value in usual_table.items() if key != name}, "the table")
    must_refuse(r"^'colour' is no key of the table: allowed are .+", plan.of, {**usual_table, "colour": 3}, "the table")
    must_refuse(r"^the table = 3 must be a table$", plan.of, 3, "the table")


def test_options_named_by_their_module_are_checked():
    """And types in modules that checkers alone import are left."""

    def drawn(seed=0, table=None):
        """Draw."""
        return seed

    drawn.__annotations__ = {"seed": "options.Seed", "table": "frames.Table"}
    assert options.checked(drawn)(3, table=4) == 3
    assert "Random seed" in options.checked(drawn).__doc__
    must_refuse("seed = -1 must lie between 0", lambda: options.checked(drawn)(-1))
