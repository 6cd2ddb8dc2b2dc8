"""Validators of numeric parameters."""

import numpy as np
from rows import refuses

from mitransient_lidar.core.validation import (
    finite,
    finite_array,
    in_range,
    increasing_array,
    integer,
    non_negative,
    non_negative_array,
    number_within,
    positive,
    time_samples,
)


def test_clean_values():
    assert positive("x", 1) == 1.0
    assert integer("x", 3.0, 1, 5) == 3
    assert in_range("x", "7", 1, np.inf) == 7.0
    assert integer("x", np.array(2.0), 0, 9) == integer("x", np.array(2), 0, 9) == 2
    values = np.arange(3)
    assert not np.shares_memory(finite_array("x", values), values)
    assert increasing_array("x", values).dtype == np.float64
    assert [v.tolist() for v in time_samples([0, 1], "power", [2, 3])] == [[0, 1], [2, 3]]


@refuses(
    *((lambda bad=bad: finite("x", bad), "^x ") for bad in (np.nan, np.inf, "deep", None)),
    (lambda: positive("x", 0), "x = 0 must be greater than 0"),
    (lambda: non_negative("x", -1), "x = -1 must not be negative"),
    (lambda: in_range("x", 2, 0, 1), "x = 2 must lie between 0 and 1"),
    (lambda: in_range("x", 0.5, 1, np.inf), r"x = 0\.5 must be at least 1$"),
    (lambda: number_within("x", 0, 0, 1, above=True), "x = 0 must be greater than 0 and at most 1$"),
    (lambda: number_within("x", 1.5, 0, 1, above=True), r"x = 1\.5 must be greater than 0 and at most 1$"),
    (lambda: number_within("x", 1, 1, above=True), "x = 1 must be greater than 1$"),
    (lambda: number_within("x", -1, 0), "x = -1 must not be negative$"),
    (lambda: integer("x", 1.5, 0, 9), r"x = 1\.5 must be an integer"),
    (lambda: integer("x", np.array(2.5), 0, 9), r"x = 2\.5 must be an integer"),
    (lambda: integer("x", np.array([2.0]), 0, 9), r"x = array\(\[2.\]\) must be an integer"),
    (lambda: integer("x", "2", 0, 9), r"x = '2' must be an integer"),
    (lambda: finite_array("x", [10**400]), "must hold numbers only"),
    (lambda: finite_array("x", [1, np.nan]), "x holds nan but every value must be finite"),
    (lambda: finite_array("x", ["a"]), "must hold numbers only"),
    (lambda: non_negative_array("x", [1, -2, -3]), "x = -3 must not be negative"),
    (lambda: non_negative_array("x", [1, -1e-9]), "x = -1e-09 must not be negative"),
    (lambda: increasing_array("x", [1]), r"x of shape \(1,\) must be a list of at least 2 numbers"),
    (lambda: increasing_array("x", [[1, 2]]), r"x of shape \(1, 2\) must be a list"),
    (lambda: increasing_array("x", [0, 2, 2]), "x must increase strictly, but 2 is followed by 2"),
    (lambda: time_samples([0, 1], "power", [1]), r"power of shape \(1,\) must have equal lengths"),
)
def test_invalid_values_are_rejected(call):
    call()
