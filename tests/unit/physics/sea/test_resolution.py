"""Automatic values of a sea from the lidar above it, over all lidars and winds that are meant to work."""

import math
from itertools import product

import numpy as np
import pytest

from mitransient_lidar.core.parameters.sea import OCEAN_SURFACE
from mitransient_lidar.physics.sea.cox_munk import cox_munk
from mitransient_lidar.physics.sea.sea_mesh import Footprint, Resolution
from mitransient_lidar.physics.sea.sea_surface import SeaSurface

TILT = math.radians(20)


def lidar(altitude=200.0, divergence=10e-3, field_of_view=30e-3, pixel=13e-3, aim=(0.0, 0.0), off_nadir=TILT):
    pose = aim, altitude, off_nadir
    return [
        Footprint.laser(*pose, (0.5 * divergence, 0.5 * divergence)),
        Footprint.receiver(*pose, field_of_view, pixel),
    ]


def choose(footprints, **parameters):
    return Resolution.read(OCEAN_SURFACE.reader(parameters.get), footprints)


def test_every_lidar_has_cells_within_their_limits():
    altitudes, divergences = (5.0, 200.0, 3000.0, 5e5), (1e-4, 5e-4, 1e-3, 5e-3, 2e-2)
    angles = [math.radians(degrees) for degrees in (0.0, 20.0, 84.6)]
    for altitude, divergence, view, angle in product(altitudes, divergences, (1e-3, 3e-2, 0.2), angles):
        found = choose(lidar(altitude, divergence, view, view / 128, off_nadir=angle))
        assert found.cell_size <= divergence * altitude / math.cos(angle)
        assert found.refined_size <= 1024 * found.cell_size * (1 + 1e-9)
        assert found.size >= max(1000.0, 2 * found.refined_size)


def test_waves_and_cells_follow_the_beam_or_the_pixels():
    """Waves from 1.064 m or four pixels of 0.085 m at 213 m; never finer than 8 cm and 2 cm, nor for wide beams."""
    slant = 200.0 / math.cos(TILT)
    beam = choose(lidar())
    assert (beam.shortest_wave, beam.cell_size) == pytest.approx((5e-3 * slant, 5e-3 * slant / 12))
    image = choose(lidar(field_of_view=0.01, pixel=2e-4))
    assert (image.shortest_wave, image.cell_size) == pytest.approx((8e-4 * slant, 1e-4 * slant))
    finest, coarsest = choose(lidar(field_of_view=0.01, pixel=1e-5)), choose(lidar(5000.0))
    assert (finest.shortest_wave, finest.cell_size) == (0.08, 0.02)
    assert (coarsest.shortest_wave, coarsest.cell_size) == (2.0, 0.25)
    assert choose(lidar(), shortest_wave=0.48).cell_size == pytest.approx(0.04)


def test_large_patches_have_fewer_cells_in_a_wave():
    """42 m from a mast of 15 m at grazing angles: 512 cells a side instead of 1280."""
    mast = choose(lidar(15.0, 5e-3, 10e-3, off_nadir=math.radians(84.6)))
    assert mast.refined_size / mast.cell_size == pytest.approx(512)
    assert 4 * mast.cell_size < mast.shortest_wave == pytest.approx(2.5e-3 * 15 / math.cos(math.radians(84.6)))


def test_the_waves_do_not_depend_on_the_cells():
    footprints = lidar(field_of_view=0.01, pixel=1e-4)
    automatic = choose(footprints)
    for cell in (0.01, 0.3):
        other = choose(footprints, cell_size=cell)
        assert (other.shortest_wave, other.beam_wave) == (automatic.shortest_wave, automatic.beam_wave)


def test_waves_for_pixels_count_as_those_for_the_beam():
    """Cells of merging follow the beam: for waves of 8 cm they would be 13 times finer than needed, and as noisy."""
    assert choose(lidar(field_of_view=0.01, pixel=1e-5)).beam_wave == choose(lidar()).shortest_wave
    for same in (choose(lidar()), choose(lidar(), shortest_wave=0.3), choose(lidar(5e5, 1e-4)), choose([])):
        assert same.beam_wave == same.shortest_wave


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
    side = 1.25 * 2 * max(each.half_side for each in lidar())
    found = choose(lidar(), shortest_wave=0.5, **explicit)
    assert found == Resolution((3.0, -2.0), 0.3, 20.0, 400.0, 0.5, 0.5, side)
    assert choose([]) == Resolution((0.0, 0.0), 0.125, 32.0, 1000.0, 1.0, 1.0, 24.0)


def test_waves_that_no_cell_resolves_become_ripples():
    """From 500 km a beam of 20 mrad lights 10 km: cells would be longer than the waves."""
    sea = SeaSurface.read(OCEAN_SURFACE.reader({}.get), lidar(5e5, 2e-2))
    assert sea.cell_size == math.inf
    np.testing.assert_allclose(sea.ripple_variance, cox_munk(3.0))
