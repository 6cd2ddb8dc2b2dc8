"""Slope of the column signal against c, a and Kd.

Gordon (1982), Appl. Opt. 21, 2996: K is c where the receiver sees a spot far smaller than the attenuation length, and
comes down to the diffuse attenuation where it sees 5 to 6 of them across its radius. Phillips and Koerber (1984), Aust.
J. Phys. 37, 75: in a large field of view the decay is that of absorption.
"""

import numpy as np
import pytest
from oracles.column_slope import effective_attenuation
from significance import largest_z

import mitransient_lidar
from mitransient_lidar.studies.light_classes import scattering

pytestmark = pytest.mark.long

#: A vertical lidar 200 m above a level sea. Its ripples, the smoothest there are, spread light by millimetres.
VERTICAL = {"off_nadir_deg": 0, "spectrum": "flat", "slope_variance": 2e-5, "bottom_depth": 30}
VERTICAL |= {"time_start_ns": 1330, "bin_count": 80}


@pytest.mark.parametrize("field_of_view", [4, 30])
def test_single_scattering_falls_with_c(field_of_view):
    """In any field of view, beam and direction. Without its solid angle the signal would fall with c + 1/(n H)."""
    params = {"field_of_view_mrad": field_of_view, "bottom_depth": 30, "bin_width_ns": 2, "bin_count": 60}
    params |= {"spectrum": "flat", "slope_variance": 2e-5}
    single = {"type": "lidar_volpath", "max_scatterings": 1, "paths_per_pass": 2**17}
    result = mitransient_lidar.render("table1", params=params, integrator=single, passes=16, seed=1)
    k, error = effective_attenuation(result, 1.5, 6)
    assert error < 0.001
    # The error takes bins as independent, which share paths.
    assert abs(k - 0.3) < largest_z(16) * error


@pytest.fixture(scope="module")
def ocean():
    """The default water, whose forward peak holds most of the scattering, seen by a narrow beam."""
    return scattering("table1", {**VERTICAL, "divergence_mrad": 1}, fov_mrad=[1, 5, 20, 60, 150], passes=12, seed=3)


def test_slope_falls_from_c_to_absorption(ocean):
    k, error = (ocean[name].values for name in ("effective_attenuation", "effective_attenuation_stderr"))
    c, kd, absorption = (ocean.attrs[name] for name in ("attenuation", "kd", "absorption"))
    assert (c, absorption) == (pytest.approx(0.3), pytest.approx(0.15))
    assert np.all(error < 0.004)
    # From c R = 2 to 4 little is left to fall.
    assert np.all(np.diff(k)[:-1] < -3 * np.hypot(error[1:], error[:-1])[:-1])
    assert k[-1] < k[-2] + error[-1]
    # The forward peak spreads light by less than even the smallest spot: at c R = 0.03 it hides a seventh of c.
    assert 0.83 * c < k[0] < 0.88 * c
    # c R = 4.5: absorption, not the larger Kd.
    assert abs(k[-1] - absorption) < largest_z(12) * error[-1]
    assert k[-1] < kd - 5 * error[-1]
