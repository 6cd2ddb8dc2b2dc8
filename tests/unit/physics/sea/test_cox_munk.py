"""Measured slopes of the sea, and the part of them that a mesh does not resolve."""

import numpy as np
import pytest

from mitransient_lidar.physics.sea.cox_munk import cox_munk
from mitransient_lidar.physics.sea.realization import mesh_slope_variance
from mitransient_lidar.physics.sea.sea_state import MatchedSpectrum
from mitransient_lidar.physics.sea.wind_spectra import ElfouhailySpectrum, PiersonMoskowitzSpectrum


@pytest.mark.parametrize(("wind", "total"), [(3, 0.01836), (6, 0.03372), (7.23, 0.0400), (10, 0.0542)])
def test_cox_munk_totals(wind, total):
    up, cross = cox_munk(wind)
    assert up == pytest.approx(3.16e-3 * wind)
    assert cross == pytest.approx(0.003 + 1.92e-3 * wind)
    # The published total has its own regression, 0.003 + 5.12e-3 W.
    assert up + cross == pytest.approx(total, rel=0.01)


@pytest.mark.parametrize("wind", [1, 3, 10])
@pytest.mark.parametrize("kind", [ElfouhailySpectrum, PiersonMoskowitzSpectrum])
def test_matched_waves_leave_ripples_to_every_mesh(kind, wind):
    """Refining the mesh moves variance from the ripples to the facets; nothing is counted twice."""
    matched = MatchedSpectrum(kind(wind, direction=0.5), *cox_munk(wind))
    before = cox_munk(wind)
    for cells in (32, 128, 512):
        resolved = mesh_slope_variance(matched, 10.0, cells)
        ripples = np.subtract(cox_munk(wind), resolved)
        assert min(resolved) > 0
        assert 0 < ripples[0] < before[0]
        assert 0 < ripples[1] < before[1]
        before = ripples


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: cox_munk(-1), "wind_speed = -1 must lie between 0 and 30"),
        (lambda: cox_munk(np.inf), "wind_speed = inf must be finite"),
        (lambda: mesh_slope_variance(ElfouhailySpectrum(5), 10, 15), "cells = 15 must be an even"),
    ],
)
def test_bad_parameters_are_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call()
