"""Surface echoes of seas: planes in closed form, and random seas against their spectrum and the two-scale model."""

import math

import numpy as np
import pytest

from mitransient_lidar.analysis.retrieval.surface_echoes import PixelMap, SeaLidar, sea_shots
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError

THETA, HEIGHT, BEAM, N = math.radians(20), 200.0, 2e-3, 1.34
SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 10e-3
LEFT, RIGHT = (SQUARE * np.array([1, 0.5]) + np.array([0, side * 5e-3]) for side in (-1, 1))
REFLECTANCE = ((N - 1) / (N + 1)) ** 2


def lidar(*outlines, beam=BEAM, height=HEIGHT):
    return SeaLidar(height, THETA, N, N, beam=beam, pixels=PixelMap.of_outlines([list(one) for one in outlines]))


@pytest.mark.parametrize(("along", "across", "wind"), [(0, 0, 0), (0.15, 0, 0), (-0.1, 0.2, 0), (0.1, -0.1, 0.7)])
def test_plane(along, across, wind):
    """E = Q A F(0) D/(4 cos R^2) for a beam within the pixel, at the time of the plane on the axis."""
    lines = np.linspace(-4, 4, 401)
    x, y = (one.ravel()[np.newaxis] for one in np.meshgrid(lines, lines))
    variances = (0.02, 0.03)
    slopes = tuple(np.full_like(x, one) for one in (along, across))
    energy, time = lidar([SQUARE], beam=1e-3).echoes(x, y, along * x + across * y, slopes, 0.02**2, variances, wind)
    normal = np.array([-along, -across, 1]) / math.sqrt(1 + along**2 + across**2)
    ray = np.array([-math.sin(THETA), 0, math.cos(THETA)])
    cosine = normal @ ray
    up = np.array([math.cos(wind), math.sin(wind), along * math.cos(wind) + across * math.sin(wind)])
    first = up / np.linalg.norm(up)
    s = np.array([ray @ first, ray @ np.cross(normal, first)]) / cosine
    density = math.exp(-0.5 * np.sum(s**2 / variances)) / (2 * math.pi * math.sqrt(0.02 * 0.03) * cosine**4)
    distance = HEIGHT / math.cos(THETA)
    # The beam of 1 mrad averages the density, which falls with the angle: 2e-3 of the energy, and 0.02 ns.
    assert energy[0, 0] == pytest.approx(REFLECTANCE * density / (4 * cosine * distance**2), rel=4e-3)
    assert time[0, 0] == pytest.approx(2e9 * distance / C0, abs=0.03)


def test_lidars_just_above_waves_are_refused():
    """The places at which waves may reflect the light of a narrow beam are millions for each shot."""
    with pytest.raises(UserError, match=r"altitude = 0.1: the light of a shot meets these waves at up to \d+ places"):
        sea_shots(lidar([SQUARE], height=0.1), 3.0, 0.0)


def test_pixels_share_the_light():
    """A level sea in two halves: equal energies that sum to that of both, and nothing in a pixel off the beam."""
    lines = np.linspace(-4, 4, 200)
    x, y = (one.ravel()[np.newaxis] for one in np.meshgrid(lines, lines))
    points = (x, y, np.zeros_like(x), (np.zeros_like(x), np.zeros_like(x)), 1e-3, (0.02, 0.02), 0.0)
    energy, _ = lidar([LEFT], [RIGHT], [SQUARE], [SQUARE + 0.1]).echoes(*points)
    assert energy[0, 0] == pytest.approx(energy[0, 1], rel=1e-9)
    assert energy[0, :2].sum() == pytest.approx(energy[0, 2], rel=1e-9)
    assert energy[0, 3] == 0
    # A hole takes its light away: that beyond 3 mrad in either angle remains.
    hole, whole = lidar([SQUARE, 0.3 * SQUARE], [SQUARE]).echoes(*points)[0][0]
    assert hole / whole == pytest.approx(1 - math.erf(1.5 / math.sqrt(2)) ** 2, rel=0.05)
