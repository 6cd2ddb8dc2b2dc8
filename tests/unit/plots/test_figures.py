"""Every figure draws what it drew when its reference was looked at: data, signs, units, colours and labels."""

import json

import pytest
import references
from drawn_figures import described, differences
from figure_inputs import FIGURES

EXPECTED = references.read(references.FIGURES)


@pytest.mark.parametrize("name", FIGURES)
def test_figure_is_that_of_the_reference(name):
    assert differences(json.loads(json.dumps(described(FIGURES[name]()))), EXPECTED[name]) == []


def test_every_reference_has_a_figure():
    assert EXPECTED.keys() == FIGURES.keys()
