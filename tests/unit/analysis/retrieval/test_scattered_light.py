"""Scattered light of column and bottom, against renders of known waters over a level sea."""

import math

import numpy as np
import pytest

from mitransient_lidar.analysis.retrieval import scattered_light
from mitransient_lidar.analysis.retrieval.scattered_light import View, light_of
from mitransient_lidar.physics.lidar.level_sea import LidarSystem

SYSTEM = LidarSystem(200, math.radians(20), 1.34, 1.364, energy=1.0, aperture_area=1.0)
# 30 mrad around a beam of 10 mrad, ripples of 3 m/s, and echoes of 8.3 ns.
VIEW = View(SYSTEM, radius=15e-3, centre=0.0, beam=5e-3, slope_variance=0.0183, echo_width=0.92)

# Renders of `table1` over a level sea with components, 8 passes, seed 1: absorption and backscattering of Jerlov's type
# [1/m]; the window of the column's fit and the path of the bottom's echo [m], decay [1/m] and level [1/(m sr)] of the
# column's exponential, and the optical depth of both ways to the bottom less that of this exponential.
RENDERED = {
    "1C at 8 m": (0.09757, 0.008851, (2.15, 7.10), 8.413, 0.1361, 0.001741, 0.102),
    "5C at 8 m": (0.22715, 0.023088, (2.15, 7.32), 8.570, 0.3187, 0.005945, 0.394),
}


@pytest.mark.parametrize("name", RENDERED)
def test_light_of_rendered_columns(name, monkeypatch):
    """Water and loss of the bottom; with the same decay of both, reflectances were 11 to 33 % too low."""
    absorption, backscattering, window, deepest, decay, level, loss = RENDERED[name]
    monkeypatch.setattr(scattered_light, "_PATHS", (512, 1024, 1024, 2048))
    path = np.arange(*window, 0.11)
    weights = np.linspace(1.0, 0.57, path.size)
    found = light_of(VIEW, decay, level, path, weights, deepest, 0.0193)
    assert decay - found.excess == pytest.approx(absorption, rel=0.04)
    assert 2 * np.pi * level / found.level == pytest.approx(backscattering, rel=0.08)
    # Noise of the estimate, and of the water that is found.
    assert float(found.bottom_loss(np.array(deepest))) == pytest.approx(loss, abs=0.03 + 0.15 * loss)
    # Light that comes late is left behind the bottom's echo.
    late = found.column_ratio(np.array([deepest + 0.2, deepest + 2.0, deepest + 5.0]))
    assert 0.25 < late[0] < 0.9
    assert late[0] > 3 * late[1] > 0
    assert late[2] < 0.1


def test_a_narrow_beam_is_all_in_view_and_a_wide_one_moves_out():
    narrow, wide = (View(SYSTEM, 15e-3, 0.0, beam, 0.0, 1.0) for beam in (1e-6, 5e-3))
    np.testing.assert_allclose(narrow.share(np.array([0.0, 0.0149, 0.0151])), [1, 1, 0], atol=0.02)
    rng = np.random.default_rng(1)
    x, y = 5e-3 * rng.standard_normal((2, 200_000))
    inside = [np.mean(np.hypot(x + shift, y) < 15e-3) for shift in (0.0, 8e-3, 15e-3)]
    np.testing.assert_allclose(wide.share(np.array([0.0, 8e-3, 15e-3])), np.divide(inside, inside[0]), atol=0.005)
    # About a view whose middle is 6 mrad away, a shift in any direction.
    away, turn = View(SYSTEM, 8e-3, 6e-3, 5e-3, 0.0, 1.0), 2 * np.pi * rng.random(x.size)
    inside = [
        np.mean(np.hypot(x + shift * np.cos(turn) - 6e-3, y + shift * np.sin(turn)) < 8e-3) for shift in (0, 8e-3)
    ]
    assert float(away.share(np.array(8e-3))) == pytest.approx(inside[1] / inside[0], rel=0.02)
