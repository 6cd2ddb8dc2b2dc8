import numpy as np
import pytest
from rows import each_row

from mitransient_lidar.campaigns.design import Expression
from mitransient_lidar.core.errors import UserError


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
    with pytest.raises(UserError, match="not finite"):
        Expression("x", text).evaluate({"a": np.array([1.0, 2.0])})
