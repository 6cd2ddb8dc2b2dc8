"""Surface echoes of random seas in closed form: facets with ripples in a Gaussian beam."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import reduce

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, in_range
from mitransient_lidar.physics.lidar.level_sea import LidarGeometry, fresnel
from mitransient_lidar.physics.piecewise_linear import inside_polygon
from mitransient_lidar.physics.sea.cox_munk import MAX_WIND_SPEED, cox_munk
from mitransient_lidar.physics.sea.realization import heights_of, wave_coefficients
from mitransient_lidar.physics.sea.wave_spectrum import MatchedSpectrum, variances_along
from mitransient_lidar.physics.sea.wind_spectra import ElfouhailySpectrum

BoolArray = npt.NDArray[np.bool_]

LEAST_WIND_SPEED = 1.0  #: Least wind speed [m/s] that Cox and Munk measured.

_SEAS, _SHOTS = 4, 150  # realisations, and shots on each
_CELLS = 512  # per side of a realisation
_CELLS_PER_SPREAD, _LARGEST_CELL = 4.0, 0.5  # resolution, as for `sea_surface` [1, m]
_POINTS = 2  # of light per cell side
_BEAM_EDGE = 3.5  # beam radius in standard deviations
_CHUNK, _CHUNK_POINTS = 32, 2**22  # shots, and points of light, in memory at a time
_MOST_POINTS = 2**20  # of light in a shot, which take three minutes
_SMALLEST_RIPPLE_VARIANCE = 1e-5
_PIXEL_CELLS = 128  # per side of the pixel map


@dataclass(frozen=True)
class PixelMap:
    """Pixels of a receiver in tangent-plane angles (angle_x, angle_y) about its axis."""

    reach: float  #: Half side of the square about the axis that contains all pixels [rad].
    #: Whether each pixel contains the centres of the square's cells, shape (pixels, n, n) with rows along angle_y.
    inside: BoolArray

    @classmethod
    def of_outlines(cls, outlines: list[list[FloatArray]]) -> PixelMap:
        """Return the pixel map from outlines: closed lines of points [rad]; a line in another one is a hole."""
        reach = max(float(np.abs(line).max()) for lines in outlines for line in lines)
        centres = reach * ((2 * np.arange(_PIXEL_CELLS) + 1) / _PIXEL_CELLS - 1)
        x, y = np.meshgrid(centres, centres)
        return cls(reach, np.stack([inside_outline(lines, x, y) for lines in outlines]))

    @property
    def radius(self) -> float:
        """Largest angle of a pixel from the axis [rad]."""
        row, column = np.nonzero(self.inside.any(axis=0))
        centre: float = 0.5 * (self.inside.shape[-1] - 1)
        farthest = float(np.hypot(row - centre, column - centre).max())
        return self.reach * (farthest + 1) / (centre + 0.5)

    def at(self, angle_x: FloatArray, angle_y: FloatArray) -> BoolArray:
        """Return whether each pixel contains directions [rad], shape (pixels, ...)."""
        count = self.inside.shape[-1]
        column, row = (((angle / self.reach + 1) * (0.5 * count)).astype(np.intp) for angle in (angle_x, angle_y))
        # Conversion to integers rounds towards 0.
        known = (np.abs(angle_x) < self.reach) & (np.abs(angle_y) < self.reach)
        index = np.where(known, row * count + column, 0)
        return np.asarray(self.inside.reshape(len(self.inside), -1)[:, index] & known)


def inside_outline(lines: list[FloatArray], x: FloatArray, y: FloatArray) -> BoolArray:
    """Return whether an odd number of closed lines, with points (x, y) each, surround each point."""
    return np.asarray(reduce(np.logical_xor, (inside_polygon(line, x, y) for line in lines)))


@dataclass(frozen=True, kw_only=True)
class SeaLidar(LidarGeometry):
    """Lidar above a sea, with receiver and transmitter at one place and on one axis."""

    beam: float  #: Standard deviation of the Gaussian beam [rad], positive.
    pixels: PixelMap  #: Receiver pixels.

    @property
    def half_angle(self) -> float:
        """Half angle of the light that pixels can receive from the surface [rad]."""
        return min(self.pixels.radius, _BEAM_EDGE * self.beam)

    def echoes(
        self,
        x: FloatArray,
        y: FloatArray,
        z: FloatArray,
        slopes: tuple[FloatArray, FloatArray],
        area: float,
        ripples: tuple[float, float],
        wind_direction: float,
    ) -> tuple[FloatArray, FloatArray]:
        """Return energy and mean time of the pixels' surface echoes, shape (shots, pixels); see `SeaShots`.

        Surface points, shape (shots, points) each, have a position x, y, z [m] from the point where the axis meets the
        mean sea level, x along the azimuth. Slopes are in x and y [1], and a point has a horizontal `area` [m^2]. The
        ripples' slope variances are along and across the wind [1].
        """
        sin, cos = math.sin(self.off_nadir), math.cos(self.off_nadir)
        away_x, away_z = x + self.height * sin / cos, z - self.height
        along_axis = away_x * sin - away_z * cos
        angle_x, angle_y = (away_x * cos + away_z * sin) / along_axis, y / along_axis
        distance = np.sqrt(away_x**2 + y**2 + away_z**2)
        # From the surface to the lidar
        to_x, to_y, to_z = -away_x / distance, -y / distance, -away_z / distance

        east, north = math.cos(wind_direction), math.sin(wind_direction)
        length = np.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2)
        incidence = np.maximum((to_z - slopes[0] * to_x - slopes[1] * to_y) / length, 1e-6)
        # Axes of the ripples in the facet: the first above the wind's direction, the second perpendicular to it
        rise = east * slopes[0] + north * slopes[1]
        first = (east * to_x + north * to_y + rise * to_z) / np.sqrt(1 + rise**2)
        second = np.sqrt(np.maximum(1 - incidence**2 - first**2, 0))
        exponent = -0.5 * ((first / incidence) ** 2 / ripples[0] + (second / incidence) ** 2 / ripples[1])
        normals = np.exp(exponent) / (2 * math.pi * math.sqrt(ripples[0] * ripples[1]) * incidence**4)
        light = np.exp(-0.5 * (angle_x**2 + angle_y**2) / self.beam**2) / (2 * math.pi * self.beam**2)
        reflectance = float(fresnel(0.0, self.refractive_index)[0])
        echo = light * normals * (0.25 * reflectance * area) * length / distance**4

        received = self.pixels.at(angle_x, angle_y)
        energy = np.sum(echo * received, axis=-1)
        time = np.sum(echo * distance * received, axis=-1) / np.where(energy > 0, energy, 1.0)
        return energy.T, np.where(energy > 0, 2e9 / C0 * time, np.nan).T


@dataclass(frozen=True)
class SeaShots:
    """Surface echoes of shots at random sea locations, without noise."""

    #: Received energy over pulse energy, efficiencies and aperture area [1/m^2], shape (shots, pixels).
    energy: FloatArray
    time_ns: FloatArray  #: Mean two-way time of the echo's energy [ns], NaN without energy, shape (shots, pixels).
    #: Mean sea slopes over the beam's footprint [1] and mean height above the mean sea level [m], shape (shots,).
    #: Slopes are positive along for a face towards the lidar and across for a rise to its left.
    along: FloatArray
    across: FloatArray
    height: FloatArray


def sea_shots(lidar: SeaLidar, wind_speed: float, wind_direction: float, *, seed: int = 2**40) -> SeaShots:
    """Return the surface echoes of 600 shots at random locations on four seas.

    The wind, 1 to 30 m/s, blows towards a direction that is counter-clockwise from the lidar's azimuth [rad]. Raises
    `UserError` if its speed is out of range, or waves move the light by too many beam widths.

    Seas have the Elfouhaily et al. spectrum (1997, doi:10.1029/97JC00467). Its short waves are scaled to the Cox and
    Munk slope variances (1954, doi:10.1364/JOSA.44.000838). A cell side is a quarter of the beam's standard deviation
    on the sea, at most 0.5 m. Ripples have the slope variance that cells do not resolve; waves longer than the 512
    cells of a realisation add planes with random height and slopes.

    A horizontal area dA sends the energy Q A p F(0) D dA/(4 n_z R^4) back to the aperture A. Here Q p is the beam's
    energy per solid angle, R the distance, n_z the vertical component of the facet normal, and F the Fresnel
    reflectance. Ripple normals have the distribution D = exp(-s_u^2/(2 v_u) - s_c^2/(2 v_c)) / (2 pi sqrt(v_u v_c)
    cos^4) about the facet's. Here s are ray slopes against the facet, and v ripple slope variances. See Walter,
    Marschner, Li and Torrance 2007, doi:10.2312/EGWR/EGSR07/195-206, eq. 20 and 25, without masking.
    """
    wind = in_range("wind_speed", wind_speed, LEAST_WIND_SPEED, MAX_WIND_SPEED)
    spectrum = MatchedSpectrum(ElfouhailySpectrum(wind, direction=wind_direction), *cox_munk(wind))
    footprint = lidar.slant_range * min(lidar.beam, lidar.half_angle)
    cell = min(footprint / _CELLS_PER_SPREAD, _LARGEST_CELL)
    rng = np.random.default_rng(seed)
    parts = [_shots_of_one_sea(lidar, spectrum, cell, seed + number, rng) for number in range(_SEAS)]
    return SeaShots(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _shots_of_one_sea(
    lidar: SeaLidar, spectrum: MatchedSpectrum, cell: float, seed: int, rng: np.random.Generator
) -> tuple[FloatArray, ...]:
    """Return the arrays of `SeaShots` for one realisation."""
    from scipy.ndimage import gaussian_filter

    sea = heights_of(wave_coefficients(spectrum, _CELLS * cell, _CELLS, seed))
    # A circle of the same area replaces the elliptical footprint.
    smooth = gaussian_filter(
        sea, lidar.slant_range * lidar.beam / math.sqrt(math.cos(lidar.off_nadir)) / cell, mode="wrap"
    )
    mean_slopes = [(np.roll(smooth, -1, axis) - np.roll(smooth, 1, axis)) / (2 * cell) for axis in (1, 0)]
    facets, covariance = _cell_slopes(sea, cell)
    resolved = variances_along(covariance, spectrum.direction)
    elevation, long_slopes = _long_waves(spectrum, math.pi / (_CELLS * cell))
    wanted = spectrum.upwind, spectrum.crosswind
    ripples = [max(_SMALLEST_RIPPLE_VARIANCE, total - one) for total, one in zip(wanted, resolved, strict=True)]

    row, column = rng.integers(0, _CELLS, (2, _SHOTS))
    planes = rng.multivariate_normal(np.zeros(2), long_slopes, _SHOTS)
    raised = math.sqrt(elevation) * rng.standard_normal(_SHOTS)
    truth = [one[row, column] + plane for one, plane in zip(mean_slopes, planes.T, strict=True)]

    # Crests move light towards the lidar by height times tan(off_nadir).
    margin = 3 * math.sqrt(elevation + float(np.var(sea))) * math.tan(lidar.off_nadir)
    reach = (lidar.slant_range * lidar.half_angle / math.cos(lidar.off_nadir) + margin) / cell
    # Waves move the light of a lidar close above them by many footprints.
    count = math.ceil(math.pi * (reach + 1) ** 2) * _POINTS**2
    if count > _MOST_POINTS:
        raise UserError(
            f"altitude = {lidar.height:g}: the light of a shot meets these waves at up to {count} places, and at most "
            f"{_MOST_POINTS} are followed: give a slope_deviation of the sea"
        )
    chunk = min(max(_CHUNK_POINTS // count, 1), _CHUNK)
    steps = np.arange(-math.ceil(reach), math.ceil(reach))
    rows, columns = (one.ravel() for one in np.meshgrid(steps, steps, indexing="ij"))
    inside = np.hypot(rows + 0.5, columns + 0.5) < reach + 1
    rows, columns = rows[inside], columns[inside]
    within = (np.arange(_POINTS) + 0.5) / _POINTS
    dy, dx = (one.ravel() for one in np.meshgrid(within, within, indexing="ij"))
    y, x = (cell * (one[:, np.newaxis] + part).ravel() for one, part in ((rows, dy), (columns, dx)))
    area = (cell / _POINTS) ** 2
    found = []
    for start in range(0, _SHOTS, chunk):
        some = slice(start, start + chunk)
        i = (row[some, np.newaxis] + rows) % _CELLS, (column[some, np.newaxis] + columns) % _CELLS
        right, up = (one[i] for one in facets)
        z = _cell_heights(sea, i)[..., np.newaxis] + cell * (
            right[..., np.newaxis] * (dx - 0.5) + up[..., np.newaxis] * (dy - 0.5)
        )
        z = z.reshape(len(right), -1) + raised[some, np.newaxis] + planes[some, :1] * x + planes[some, 1:] * y
        slopes = (np.repeat(right, dx.size, 1) + planes[some, :1], np.repeat(up, dx.size, 1) + planes[some, 1:])
        found.append(lidar.echoes(x, y, z, slopes, area, (ripples[0], ripples[1]), spectrum.direction))
    energy, time = (np.concatenate(one) for one in zip(*found, strict=True))
    return energy, time, truth[0], truth[1], smooth[row, column] + raised


def _cell_slopes(sea: FloatArray, cell: float) -> tuple[tuple[FloatArray, FloatArray], FloatArray]:
    """Return the mean cell slopes in x and y on a periodic grid [1], and their covariance, shape (2, 2)."""
    right, up = (np.roll(sea, -1, axis) - sea for axis in (1, 0))
    right, up = (0.5 / cell * (one + np.roll(one, -1, axis)) for one, axis in ((right, 0), (up, 1)))
    return (right, up), np.cov(right.ravel(), up.ravel())


def _cell_heights(sea: FloatArray, index: tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]) -> FloatArray:
    """Return the mean height of the four cell corners [m]."""
    row, column = index
    below, right = (row + 1) % len(sea), (column + 1) % len(sea)
    return np.asarray(0.25 * (sea[row, column] + sea[below, column] + sea[row, right] + sea[below, right]))


def _long_waves(spectrum: MatchedSpectrum, largest: float) -> tuple[float, FloatArray]:
    """Return elevation variance [m^2] and slope covariance in x and y [1] of waves below a wavenumber [rad/m]."""
    k, weight = spectrum.quadrature()
    density = spectrum.omnidirectional(k) * weight * (k < largest)
    curvature, spreading = density * k**2, spectrum.spreading(k) / 4
    along, across = (float(np.sum(curvature * (0.5 + sign * spreading))) for sign in (1, -1))
    cos, sin = math.cos(spectrum.direction), math.sin(spectrum.direction)
    rotation = np.array([[cos, -sin], [sin, cos]])
    return float(density.sum()), np.asarray(rotation @ np.diag([along, across]) @ rotation.T)
