"""Options of a render: one list for functions, commands and results."""

import inspect
import re
from dataclasses import fields

import mitransient_lidar
from mitransient_lidar.core.options import declared
from mitransient_lidar.rendering.passes import RenderOptions

NAMES = [one.name for one in fields(RenderOptions)]


def test_render_has_all_options_and_documents_their_ranges():
    parameters = inspect.signature(mitransient_lidar.render).parameters
    assert set(NAMES) < set(parameters)
    parts = re.split(r"^(\w[\w, ]*)\n(?=    )", inspect.getdoc(mitransient_lidar.render), flags=re.MULTILINE)
    described = {name: text for names, text in zip(parts[1::2], parts[2::2], strict=True) for name in names.split(", ")}
    for name, (_, option) in declared(RenderOptions).items():
        assert option.range() in " ".join(described[name].split()), name


def test_values_at_the_ends_are_accepted_and_texts_are_numbers():
    for name, (_, option) in declared(RenderOptions).items():
        for value in () if option.low is None else {option.high if option.above else option.low, option.high} - {None}:
            error = {"target_error": 1.0} if name == "target_quantile" else {}
            assert getattr(RenderOptions(**{name: value}, **error), name) == value
    assert RenderOptions(max_time="5").max_time == 5.0
