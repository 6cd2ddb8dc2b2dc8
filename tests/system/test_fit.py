"""A fit of a render by renders of the same scene, from wrong starts."""

from functools import partial

import numpy as np
import pytest
from significance import largest_chi2

import mitransient_lidar
from mitransient_lidar.studies import fit as study


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


@pytest.mark.long
@pytest.mark.parametrize(
    ("starts", "truth", "seed"),
    [
        ({"scattering[0]": 0.1, "scattering[1]": 0.18, "bottom_reflectance": 0.15}, [0.15, 0.12, 0.1], 3),
        ({"bottom_depth": 9.0, "attenuation[0]": 0.36, "bottom_reflectance": 0.15}, [8.0, 0.3, 0.1], 4),
    ],
    ids=["scattering", "bottom depth"],
)
def test_scattering_and_depth_of_layered_water_are_found_within_their_errors(starts, truth, seed, monkeypatch):
    """Two layers: scattering of both from their paths, and the bottom's depth by differences, from wrong starts.

    Expectation and tolerance as above, with three degrees of freedom.
    """
    small = partial(mitransient_lidar.render, pass_share=1 / 16, passes=32)
    layers = {"layer_tops": "0, 4", "attenuation": "0.3, 0.2", "scattering": "0.15, 0.12"}
    params = {"layout": "1x1", "spectrum": "flat", "surface_size": 60, **layers, "backscattering": "0.006, 0.004"}
    data = small("table1", params=params, seed=seed, batches=32)
    monkeypatch.setattr(study, "render", lambda scene, **options: small(scene, **options))
    options = {"params": params, "start": starts, "passes": 32, "seed": seed + 100}
    fitted = mitransient_lidar.fit(data, "table1", list(starts), **options)
    assert fitted.attrs["converged"]
    error = fitted["value"].values - truth
    assert error @ np.linalg.solve(fitted["covariance"].values, error) < 2 * largest_chi2(3)
    # Starts are wrong by 12 to 50 %.
    assert np.abs(error / truth).max() < 0.05
