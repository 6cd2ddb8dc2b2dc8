"""Kelvin wake against stationary phase and direct quadrature of Havelock's sources."""

import numpy as np
import pytest

from mitransient_lidar.physics.sea.kelvin_wake import kelvin_wake

GRAVITY = 9.81


def at_points(x, y, *ship, **more):
    """Heights at pairs (x, y), from the grids of 2 x 2 points that begin there."""
    side = np.array([0.0, 1e-3])
    return np.array([kelvin_wake(a + side, b + side, *ship, **more)[0, 0] for a, b in zip(x, y, strict=True)])


def source_amplitude(theta, speed, length, beam, draught):
    """A(theta) [m] of Havelock's sources -2 U dY/dx on the centre plane, integrated numerically."""
    k0 = GRAVITY / speed**2
    nodes, weights = np.polynomial.legendre.leggauss(96)
    x, z = nodes * length / 2, (nodes - 1) * draught / 2
    slope = -4 * beam * x[:, None] / length**2 * (1 - (z / draught) ** 2)
    sources = slope * np.outer(weights * length / 2, weights * draught / 2)
    sec = 1 / np.cos(theta)
    along, down = np.exp(-1j * k0 * np.outer(sec, x)), np.exp(k0 * np.outer(sec**2, z))
    return -2 * k0 / np.pi * sec**3 * np.einsum("tz,tz->t", along @ sources, down)


def test_track_shows_transverse_waves_of_closed_form():
    speed, length, beam, draught = 10.0, 2.0, 0.3, 0.05
    k0 = GRAVITY / speed**2
    wavelength = 2 * np.pi / k0
    x = -np.linspace(90, 60, 1001) * wavelength
    # Only waves of k < 5 k0 are left: the divergent ones on the track are all shorter.
    heights = kelvin_wake(x, [-1, 0, 1], speed, 0.0, length, beam, draught, smallest_wavelength=wavelength / 5)[1]
    # A ship much shorter than its waves is a dipole of its volume; stationary phase at theta = 0.
    volume = 4 / 9 * length * beam * draught
    closed = -(k0**2) * volume / np.pi * np.sqrt(2 * np.pi / (k0 * -x)) * np.sin(k0 * -x + np.pi / 4)
    # Far and near end: a decay with 1/r, or r^(-1/3), would be 20 % or 7 % off at one of them.
    for window in (slice(0, 200), slice(-200, None)):
        assert np.abs(heights - closed)[window].max() < 0.015 * closed[window].max()
    crossings = x[:-1][np.diff(np.sign(heights)) > 0]
    assert np.diff(crossings).mean() == pytest.approx(wavelength, rel=2e-3)


def test_heights_agree_with_direct_quadrature():
    speed, length, beam, draught = 4.0, 12.0, 1.5, 0.6
    k0 = GRAVITY / speed**2
    # The first is next to the hull, halfway from amidships to the stern.
    x, y = np.array([-3.0, -9, -15, -30, -30, -47]), np.array([4, 3, -5, 7.5, -9.5, 16])
    share = np.array([0.5, 1, 1, 1, 1, 1])
    theta = (np.arange(20000) + 0.5) / 20000 * np.pi - np.pi / 2
    k = k0 / np.cos(theta) ** 2
    amplitude = np.zeros(theta.size, dtype=complex)
    kept = k < 60
    amplitude[kept] = source_amplitude(theta[kept], speed, length, beam, draught)
    amplitude *= np.exp(-((k / 20) ** 4))  # off the track, short waves do not matter
    phase = k * (np.outer(x, np.cos(theta)) + np.outer(y, np.sin(theta)))
    direct = (amplitude * np.exp(1j * phase)).real.sum(axis=1) * np.pi / theta.size
    assert at_points(x, y, speed, 0.0, length, beam, draught) == pytest.approx(direct * share, abs=1e-4)


@pytest.mark.parametrize("bearing", [0.7, np.pi / 2, -2.5])
def test_wake_turns_and_moves_with_the_ship(bearing):
    x, y = np.linspace(-20, 25, 46), np.linspace(-30, 12, 43)
    ship = {"length": 9.0, "smallest_wavelength": 3.0}
    heights = kelvin_wake(x, y, 4.0, bearing, ship_x=5.0, ship_y=-7.0, **ship)
    pick = np.random.default_rng(1).integers(0, [[46], [43]], size=(2, 200))
    east, north = x[pick[0]] - 5, y[pick[1]] + 7
    ahead = np.cos(bearing) * east + np.sin(bearing) * north
    port = np.cos(bearing) * north - np.sin(bearing) * east
    # In the frame of the ship; only the periodic images of the wake differ.
    expected = at_points(ahead, port, 4.0, 0.0, **ship)
    assert np.abs(expected).max() > 0.05
    assert heights[pick[1], pick[0]] == pytest.approx(expected, abs=1e-5)


def test_waves_grow_from_amidships_to_the_stern():
    length, x, y = 20.0, np.linspace(-40, 40, 161), np.linspace(-10, 10, 41)
    heights = kelvin_wake(x, y, 6.0, 0.0, length)
    assert np.all(heights[:, x >= 0] == 0)
    # Usual beams are an eighth of the length, draughts a twentieth, and heights grow as the beam.
    assert heights == pytest.approx(kelvin_wake(x, y, 6.0, 0.0, length, 2.5, 1.0), rel=1e-12)
    assert 2 * heights == pytest.approx(kelvin_wake(x, y, 6.0, 0.0, length, beam=5.0), rel=1e-12)
    # The wake is symmetric about its track.
    assert heights == pytest.approx(heights[::-1], abs=1e-12)
    # A step in the heights amidships would be a wall of water; at a fifth of the way there are 6 % of them.
    assert np.abs(heights[:, (x < 0) & (x >= -2)]).max() < 0.06 * np.abs(heights).max()


def test_coarse_lines_show_no_waves_that_they_cannot_resolve():
    fine = np.linspace(-30, 10, 161)
    coarse = np.concatenate([[-160, -130, -100, -70, -50, -40], fine])
    speed = 3.0  # waves of 5.8 m at most
    uneven = kelvin_wake(coarse, fine, speed, 0.0, 8.0)
    even = kelvin_wake(fine, fine, speed, 0.0, 8.0)
    # The first fine line counts its coarse neighbour.
    assert uneven[:, 7:] == pytest.approx(even[:, 1:], abs=1e-5 * np.abs(even).max())
    assert np.all(uneven[:, :7] == 0)
    assert np.abs(even[:, 0]).max() > 0.1 * np.abs(even).max()


def test_short_waves_fade_and_slow_ships_leave_nothing():
    x, y = np.linspace(-20, -10, 401), np.linspace(-3, 3, 241)
    heights = kelvin_wake(x, y, 4.0, 0.0, 6.0, smallest_wavelength=1.0)
    window = np.hanning(x.size) * np.hanning(y.size)[:, None]
    kx, ky = (2 * np.pi * np.fft.fftfreq(lines.size, 0.025) for lines in (x, y))
    power = np.abs(np.fft.fft2(heights * window)) ** 2
    short = np.hypot(kx, ky[:, None]) > 2 * np.pi / 1.0 + 3
    assert power[short].sum() < 1e-4 * power.sum()
    # 2 pi U^2/g = 0.16 m
    assert np.all(kelvin_wake(x, y, 0.5, 0.0, 6.0, smallest_wavelength=0.17) == 0)
