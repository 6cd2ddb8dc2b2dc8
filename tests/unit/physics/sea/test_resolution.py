"""Automatic values of a sea from the lidar above it, over all lidars and winds that are meant to work."""

import math

import numpy as np
import pytest

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.sea.cox_munk import cox_munk
from mitransient_lidar.physics.sea.resolution import Instrument, Resolution
from mitransient_lidar.physics.sea.sea_surface import SeaSurface

TILT = math.radians(20)


def lidar(altitude=200.0, divergence=10e-3, field_of_view=30e-3, pixel=13e-3, aim=(0.0, 0.0), off_nadir=TILT):
    """Return a laser and a receiver of one pose."""
    pose = aim, altitude, off_nadir
    return [
        Instrument.laser(*pose, (0.5 * divergence, 0.5 * divergence)),
        Instrument.receiver(*pose, field_of_view, pixel),
    ]


def choose(instruments, **parameters):
    return Resolution.read(lambda name, default: parameters.get(name, default), instruments)


@pytest.mark.parametrize("altitude", [5.0, 200.0, 3000.0, 5e5])
@pytest.mark.parametrize("divergence", [1e-4, 5e-4, 1e-3, 5e-3, 2e-2])
@pytest.mark.parametrize("field_of_view", [1e-3, 3e-2, 0.2])
@pytest.mark.parametrize("off_nadir", [0.0, 20.0, 84.6])
def test_every_lidar_has_cells_within_their_limits(altitude, divergence, field_of_view, off_nadir):
    angle = math.radians(off_nadir)
    found = choose(lidar(altitude, divergence, field_of_view, field_of_view / 128, off_nadir=angle))
    footprint = divergence * altitude / math.cos(angle)
    assert found.cell_size <= footprint
    assert found.refined_size <= 1024 * found.cell_size * (1 + 1e-9)
    assert found.size >= max(1000.0, 2 * found.refined_size)


@pytest.mark.slow
@pytest.mark.parametrize("wind", [0.0, 0.5, 2.0, 6.0, 20.0])
@pytest.mark.parametrize(("divergence", "altitude"), [(5e-4, 200.0), (1e-3, 200.0), (2e-2, 5.0), (2e-2, 5e5)])
def test_total_slope_variance_is_that_of_cox_and_munk(wind, divergence, altitude):
    parameters = {"wind_speed": wind}
    sea = SeaSurface.read(lambda name, default: parameters.get(name, default), lidar(altitude, divergence))
    # The ripples' least variance of 1e-5 stands above 0 along calm water.
    assert sea.slope_variance == pytest.approx(sum(cox_munk(wind)), abs=2e-5 if wind < 1 else 1e-9)
    assert min(sea.ripple_variance) >= 1e-5


def test_cells_follow_the_beam_or_the_pixels():
    """A quarter of 1.064 m; half of a pixel of 0.156 mrad at 213 m; never finer than 2 cm for pixels."""
    slant = 200.0 / math.cos(TILT)
    assert choose(lidar()).cell_size == pytest.approx(0.25 * 5e-3 * slant)
    assert choose(lidar(field_of_view=0.01, pixel=4e-4)).cell_size == pytest.approx(0.5 * 4e-4 * slant)
    assert choose(lidar(field_of_view=0.01, pixel=1e-5)).cell_size == 0.02
    assert choose(lidar(5000.0)).cell_size == 0.5


def test_cells_for_pixels_count_as_those_for_the_beam():
    """Cells of merging follow the beam: at 0.02 m they would be 13 times finer than needed, and as noisy."""
    fine = choose(lidar(field_of_view=0.01, pixel=1e-5))
    assert fine.cells_per_beam_cell * fine.cell_size == pytest.approx(choose(lidar()).cell_size)
    for same in (choose(lidar()), choose(lidar(), cell_size=0.02), choose(lidar(5e5, 1e-4)), choose([])):
        assert same.cells_per_beam_cell == 1.0


def test_narrow_beams_have_a_patch_of_many_fine_cells_and_wide_views_fewer():
    """0.1 mrad in 200 mrad: the patch gives up the view, not the cells that resolve the beam."""
    narrow = choose(lidar(divergence=1e-4, field_of_view=0.2))
    assert narrow.cell_size == pytest.approx(0.5e-4 * 200 / math.cos(TILT))
    assert narrow.refined_size == pytest.approx(1024 * narrow.cell_size)


def test_patch_holds_beam_and_view_of_separate_instruments():
    laser, _ = lidar(aim=(0.0, 0.0))
    _, receiver = lidar(aim=(10.0, 4.0))
    together = choose([laser, receiver])
    for instrument in (laser, receiver):
        for axis in (0, 1):
            offset = abs(instrument.aim[axis] - together.centre[axis])
            assert offset + instrument.half_side <= 0.5 * together.refined_size
    assert together.centre == pytest.approx((5.0, 2.0), abs=1.0)


def test_own_values_of_the_sea_win():
    own = {"altitude": 100.0, "off_nadir_deg": 0.0, "divergence_1e2_mrad": 8.0, "field_of_view_mrad": 50.0}
    expected = choose(lidar(100.0, 4e-3, 50e-3, off_nadir=0.0))
    assert choose(lidar(aim=(0.0, 0.0)), **own) == expected
    # Without a lidar in the scene the same values describe one.
    assert choose([], **own) == expected
    explicit = {"cell_size": 0.3, "refined_size": 20.0, "centre_x": 3.0, "centre_y": -2.0, "size": 400.0}
    assert choose(lidar(), **explicit) == Resolution((3.0, -2.0), 0.3, 20.0, 400.0)
    assert choose([]) == Resolution((0.0, 0.0), 0.25, 32.0, 1000.0)


def test_one_definition_of_the_divergence_may_be_given():
    with pytest.raises(UserError, match="divergence_mrad = 5 and divergence_fwhm_mrad = 6 describe one width"):
        choose(lidar(), divergence_mrad=5, divergence_fwhm_mrad=6)


def test_waves_that_no_cell_resolves_become_ripples():
    """From 500 km a beam of 20 mrad lights 10 km: cells would be longer than the waves."""
    sea = SeaSurface.read(lambda _, default: default, lidar(5e5, 2e-2))
    assert sea.cell_size == math.inf
    np.testing.assert_allclose(sea.ripple_variance, cox_munk(3.0))
