"""A fit of a render by renders of the same scene, from wrong starts."""

import numpy as np
import pytest
from significance import largest_chi2

import mitransient_lidar


@pytest.mark.slow
def test_attenuation_and_reflectance_of_a_render_are_found_within_their_errors():
    """Rationale: data and model share the scene but no random numbers. The estimates differ from the truth by the
    stated covariance of both; its errors are estimated from 16 passes, which widens the limit to twice the chi-squared.
    """  # fmt: skip
    params = {"layout": "1x1", "spectrum": "flat", "surface_size": 60}
    data = mitransient_lidar.render("table1", params=params, passes=16, seed=1)
    names, starts = ["attenuation", "bottom_reflectance"], {"attenuation": 0.24, "bottom_reflectance": 0.15}
    fitted = mitransient_lidar.fit(data, "table1", names, params=params, start=starts, passes=32, seed=2)
    assert fitted.attrs["converged"]
    error = fitted["value"].values - [0.3, 0.1]
    assert error @ np.linalg.solve(fitted["covariance"].values, error) < 2 * largest_chi2(2)
    assert fitted["stderr"].sel(parameter="attenuation") < 0.01
    assert fitted.attrs["renders"] <= 20
