"""Seas of different cells: the same waves, the same slope variance, and the same surface echo."""

import numpy as np
import pytest

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.sea import OCEAN_SURFACE
from mitransient_lidar.physics.sea.cox_munk import cox_munk
from mitransient_lidar.physics.sea.realization import Band, Motion, realise_heights
from mitransient_lidar.physics.sea.sea_surface import SeaSurface
from mitransient_lidar.physics.sea.wave_spectrum import MatchedSpectrum
from mitransient_lidar.physics.sea.wind_spectra import ElfouhailySpectrum


def read(**parameters):
    return SeaSurface.read(OCEAN_SURFACE.reader(parameters.get))


def variance_of_long_waves(wind, shortest):
    """Return the slope variances along and across the wind of waves of at least a length [m], from the integral."""
    spectrum = MatchedSpectrum(ElfouhailySpectrum(wind), *cox_munk(wind))
    k, weight = spectrum.quadrature()
    is_long = (k > 2 * np.pi / 512.0) & (k < 2 * np.pi / shortest)
    curvature = (spectrum.omnidirectional(k) * k**2 * weight)[is_long]
    spreading = spectrum.spreading(k)[is_long] / 4
    return np.sum(curvature * (0.5 + spreading)), np.sum(curvature * (0.5 - spreading))


@pytest.mark.parametrize("wind", [3.0, 6.0, 12.0])
@pytest.mark.parametrize("shortest", [4.0, 1.5])
def test_facets_have_the_slope_variance_of_the_waves_that_they_hold(wind, shortest):
    """From the integral of the spectrum; a facet of size d loses k^2 d^2/12 to the ripples, and less if halved."""
    expected = np.array(variance_of_long_waves(wind, shortest))
    lost = []
    for cells_per_wave in (12, 24):
        cells = {"cell_size": shortest / cells_per_wave, "shortest_wave": shortest, "refined_size": 9.0}
        sea = read(wind_speed=wind, period=512.0, **cells)
        np.testing.assert_allclose(np.add(sea.resolved_variance, sea.ripple_variance), cox_munk(wind), rtol=1e-9)
        lost.append(1 - np.array(sea.resolved_variance) / expected)
    # The sum over waves of whole numbers per period equals the integral to 0.4 %.
    assert np.all(np.abs(lost) < 0.012)
    assert np.all((lost[0] > lost[1]) & (lost[0] - lost[1] < (2 * np.pi / 12) ** 2 / 12 / 2))


def test_a_breath_of_wind_makes_no_waves():
    """The wavenumber of its peak overflows."""
    for wind in (1e-300, 1e-150, 1e-30, 0):
        sea = read(spectrum="elfouhaily", wind_speed=wind)
        assert np.all(sea.heights(np.arange(5.0), np.arange(4.0)) == 0)


def test_finer_cells_show_the_same_waves():
    """Points of both grids: the same heights, whether in one grid or, too fine for one, as a sum of waves."""
    spectrum = MatchedSpectrum(ElfouhailySpectrum(6.0), *cox_munk(6.0))
    still = Motion(3.0, 1e4, (0.5, 0.0))
    coarse, fine, finest = (
        realise_heights(spectrum, 64.0, cell, 4, still, 0.0, 1.0)[0] for cell in (0.25, 0.0625, 0.015625)
    )
    assert isinstance(finest.parts[0], Band)
    lines = 0.25 * np.arange(-20, 20)
    expected = coarse.sample(lines, lines)
    assert expected.std() > 0.03
    for waves in (fine, finest):
        np.testing.assert_allclose(waves.sample(lines, lines), expected, atol=1e-6)
    other = realise_heights(spectrum, 64.0, 0.25, 4, still, 0.0, 0.6)[0].sample(lines, lines)
    assert 1e-4 < np.std(other - expected) < 0.1 * expected.std()


def test_a_mean_slope_turns_the_sea_about_its_centre_and_each_place():
    """The plane is added to the waves, ends at the patch, and leaves the variance of slopes as it is."""
    options = {"wind_speed": 6.0, "refined_size": 8.0, "cell_size": 0.25, "centre_x": 5.0, "centre_y": -3.0}
    options |= {"size": 50.0}
    level, inclined = read(**options), read(**options, slope_x_deg=2.0, slope_y_deg=-1.0)
    added = inclined.mesh().vertices - level.mesh().vertices
    slopes = np.tan(np.radians([2.0, -1.0]))
    offsets = np.clip(level.mesh().vertices[:, :2] - inclined.centre, -4.0, 4.0)
    np.testing.assert_allclose(added, np.stack([0 * added[:, 0], 0 * added[:, 0], offsets @ slopes], axis=1), atol=1e-9)
    assert inclined.slope_variance == level.slope_variance
    places = np.array([[10.0, 0.0], [-20.0, 7.0]])
    (mesh, positions), (plain, _) = (sea.patches(places, 8.0, [sea] * len(places)) for sea in (inclined, level))
    for half, position in zip(np.split(np.arange(len(mesh.vertices)), 2), positions, strict=True):
        offsets = np.clip(plain.vertices[half, :2] - position, -4.0, 4.0)
        np.testing.assert_allclose((mesh.vertices - plain.vertices)[half, 2], offsets @ slopes, atol=1e-9)


def test_a_flat_sea_with_a_mean_slope_is_a_plane_and_slopes_are_limited():
    mesh = read(spectrum="flat", slope_x_deg=3.0, refined_size=6.0, cell_size=0.5, size=20.0).mesh()
    inside = np.abs(mesh.vertices[:, 0]) <= 3.0
    np.testing.assert_allclose(mesh.vertices[inside, 2], np.tan(np.radians(3.0)) * mesh.vertices[inside, 0], atol=1e-12)
    assert len(read(spectrum="flat", size=20.0).mesh().faces) == 4
    with pytest.raises(UserError, match="slope_y_deg = 16 must lie between -15 and 15"):
        read(slope_y_deg=16.0)
