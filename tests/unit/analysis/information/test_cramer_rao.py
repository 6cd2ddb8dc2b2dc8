"""Bounds from information matrices, and sentences on what they do not determine."""

import numpy as np
import pytest

from mitransient_lidar.analysis.information.cramer_rao import bounds


def test_bounds_of_two_parameters_in_closed_form():
    """1/sqrt(F_aa (1 - r^2)) for a correlation r of the derivatives, and -r for the estimates, in any units."""
    r = 0.6
    matrix = np.array([[4.0, r * 2 * 1e6], [r * 2 * 1e6, 1e12]])
    found = bounds(matrix, ["a", "b"])
    np.testing.assert_allclose(found.bound_known, [0.5, 1e-6])
    np.testing.assert_allclose(found.bound, [0.5 / 0.8, 1e-6 / 0.8])
    np.testing.assert_allclose(found.correlation, [[1, -r], [-r, 1]])
    assert found.smallest == pytest.approx(1 - r)
    assert found.remarks == []


def test_parameters_beside_a_degenerate_pair_keep_their_bounds():
    matrix = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 25.0]])
    found = bounds(matrix, ["a", "b", "c"])
    np.testing.assert_allclose(found.bound, [np.inf, np.inf, 0.2])
    assert np.isnan(found.correlation[0]).all()
    assert found.remarks == ["a and b cannot be told apart by the record: no bounds"]


def test_a_matrix_that_noise_makes_indefinite_is_no_degeneracy():
    found = bounds(np.array([[1.0, 1.1], [1.1, 1.0]]), ["a", "b"])
    assert np.isinf(found.bound).all()
    (remark,) = found.remarks
    assert remark.startswith("the noise of the render hides what the record tells about a and b (eigenvalue -0.1")
    found = bounds(np.zeros((2, 2)), ["a", "b"])
    assert np.isinf(found.bound).all()
    assert found.remarks == [f"{name} has no influence on the record: no bound" for name in "ab"]
