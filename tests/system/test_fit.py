"""A fit of a render by renders of the same scene, from wrong starts."""

import numpy as np
import pytest
from significance import largest_chi2

import mitransient_lidar


@pytest.mark.long
def test_attenuation_and_reflectance_of_a_render_are_found_within_their_errors():
    """Data and model share the scene but no random numbers, so that estimates differ by the errors of both.

    Expectation: the squared distance from the truth by the stated covariance is one of chi-squared with two degrees of
    freedom. Tolerance: twice its limit, since the errors are estimated from 8 and 16 passes.
    """
    params = {"layout": "1x1", "spectrum": "flat", "surface_size": 60}
    data = mitransient_lidar.render("table1", params=params, passes=8, seed=1)
    names, starts = ["attenuation", "bottom_reflectance"], {"attenuation": 0.24, "bottom_reflectance": 0.15}
    fitted = mitransient_lidar.fit(data, "table1", names, params=params, start=starts, passes=16, seed=2)
    assert fitted.attrs["converged"]
    error = fitted["value"].values - [0.3, 0.1]
    assert error @ np.linalg.solve(fitted["covariance"].values, error) < 2 * largest_chi2(2)
    # A start that is wrong by a fifth is left a hundred errors behind.
    assert fitted["stderr"].sel(parameter="attenuation") < 0.0006
    assert fitted.attrs["renders"] <= 15
