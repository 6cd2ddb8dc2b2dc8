"""Sea surface slope from times and strengths of one shot's surface echo, and corrections of a bottom echo for it.

Slopes are rises over runs. A face towards the lidar is positive `along` the lidar's azimuth, and a rise to the left
(+angle_y) is positive `across`. `slopes_on_sea` uses a sea's statistics, `fit_plane` times alone, for any surface. Its
plane is at the distance rho along the receiver's axis, with 1/rho = A + B angle_x + C angle_y.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.analysis.retrieval.surface_echoes import SeaShots, inside_outline
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, finite_array, positive
from mitransient_lidar.physics.lidar.level_sea import cos_in_water, fresnel

BoolArray = npt.NDArray[np.bool_]

_NS = 1e-9 * C0 / 2  # metres of range per nanosecond
_CELLS = 256  # cells per side of the grid for the light in a pixel
_LEAST_ERROR_NS = 0.01  # smallest error of an echo time
_LEAST_LEVER = 1e-4  # smallest standard deviation of the pixels' angles that determines a slope [rad]
_CORRELATION = 0.4  # between the positions of the reflecting facets in two adjacent pixels
_LIKELY = 0.5  # expected fraction of an estimated slope that is not error

# Errors of fitted surface echoes, from 1600 pixels in 200 rendered shots against the rendered sea's energies and times.
# Energy: relative, and in column energies. Time: in echo widths, and for an echo that is lost in the column, in spreads
# of the light over the pixel; and the energy of an echo that is half lost.
_ENERGY_ERROR, _COLUMN_ERROR = 0.25, 0.25
_TIME_ERROR, _LOST_TIME_ERROR, _HALF_LOST = 0.03, 1.5, 0.4


@dataclass(frozen=True)
class PixelLight:
    """Centroid of the beam's irradiance in each pixel, and its standard deviation in angle_x [rad]; shape (pixels,)."""

    angle_x: FloatArray
    angle_y: FloatArray
    spread: FloatArray

    @classmethod
    def of_outlines(cls, outlines: Sequence[Sequence[npt.ArrayLike]], sigma: float) -> PixelLight:
        """Integrate a Gaussian beam with a standard deviation [rad] over the area inside the outlines of each pixel.

        Outlines are closed lines of points (angle_x, angle_y) [rad]; a line inside another one is a hole. Raises
        `UserError` if `sigma` is not positive, a line has fewer than three points, or the beam misses a pixel.
        """
        width = positive("sigma", sigma)
        found = []
        for number, lines in enumerate(outlines):
            loops = [finite_array("outlines", line) for line in lines]
            if not loops or any(loop.ndim != 2 or loop.shape[1] != 2 or len(loop) < 3 for loop in loops):
                raise UserError(f"outlines of pixel {number} must be lines of at least 3 points (angle_x, angle_y)")
            points = np.concatenate(loops)
            x, y = np.meshgrid(*(_midpoints(axis.min(), axis.max()) for axis in points.T))
            weight = inside_outline(loops, x, y) * np.exp(-0.5 * (x**2 + y**2) / width**2)
            total = weight.sum()
            if total <= 0:
                raise UserError(f"outlines of pixel {number} must contain a part of the beam of sigma = {width:g}")
            centre = np.sum(weight * x) / total
            spread = np.sqrt(np.sum(weight * (x - centre) ** 2) / total)
            found.append((centre, np.sum(weight * y) / total, spread))
        return cls(*np.array(found).T)


def _midpoints(low: float, high: float) -> FloatArray:
    return np.asarray(low + (high - low) * (np.arange(_CELLS) + 0.5) / _CELLS)


@dataclass(frozen=True)
class SurfacePlane:
    """Planes through the surface echoes of shots; shape (n,) each, NaN where the pixels do not determine them."""

    #: Slopes along the lidar's azimuth and to its left, and their standard errors [1].
    along: FloatArray
    across: FloatArray
    along_stderr: FloatArray
    across_stderr: FloatArray
    #: Distance to the plane along the receiver's axis and its standard error [m].
    range_m: FloatArray
    range_stderr: FloatArray
    #: Root mean square deviation of the echoes from the plane over the degrees of freedom [ns]; NaN without any.
    misfit_ns: FloatArray


def fit_plane(
    time_ns: npt.ArrayLike, light: PixelLight, off_nadir: float, *, stderr_ns: npt.ArrayLike = 0.0
) -> SurfacePlane:
    """Fit a plane to the surface echoes in each shot's pixels.

    `time_ns`, shape (n, pixels): two-way surface echo times [ns]; NaN for a pixel without an echo. `light`: light
    distribution in the pixels. `off_nadir`: angle of the receiver's axis from the vertical [rad], 0 to below pi/2.
    `stderr_ns`, shape () or (n, pixels): standard errors of the times from noise [ns], at least 0.

    Result: both slopes with three echoes that are not collinear; with two at different angle_x, the slope along,
    assuming that across is 0; otherwise neither.

    With t = tan(off_nadir), B/A = (along - t)/(1 + along t) and C/A = across/(cos(off_nadir) + along sin(off_nadir)),
    hence along = tan(off_nadir + arctan(B/A)). The fit is least squares in 1/rho with weights from the errors of the
    times. Tulldahl (2006), FOI-R-2074-SE, section 3.1, states that times determine the slope, without a formula.

    Assumptions: transmitter and receiver at one location; each pixel's echo comes from the centroid of its light; the
    surface is plane within the footprint. Short waves violate the last two, since few facets anywhere in a pixel face
    the lidar. This error dominates the noise. A centre error d changes the range by the relative amount tan(off_nadir -
    tilt) d. The face's tilt is assumed to be half the estimate, with this uncertainty. Hence faces away from the lidar
    have larger errors. Errors in adjacent pixels, which the same crests cross, have a correlation of 0.4 that falls
    with the distance in angle_x as exp(-dx^2/(2 spread^2)). It raises the error along and lowers the error across. One
    facet per pixel and 0.4 come from 600 rendered shots at 6 m/s along the wind. They look 20 degrees off nadir, with
    views of 15 and 30 mrad. Pixel centres had errors of 0.85 to 1.13 spreads, with correlations of 0.30 to 0.43 between
    adjacent pixels and -0.24 to 0.18 otherwise. The rms ratio of error to stated error is 1.04 to 1.28 along, 0.78 to
    0.91 across, and 0.86 to 1.00 with a prior. In 120 shots across the wind, it is 0.81 to 1.24.

    Pixels narrow in angle_x are best, since it determines the time. Pixels that cut a wide beam have skewed light, and
    a symmetric echo fit lies too near to the axis. A level sea then appears to face the lidar by up to 1.5 degrees.
    """
    x, y, spread = light.angle_x, light.angle_y, light.spread
    time = np.asarray(time_ns, dtype=np.float64)
    known = np.isfinite(time)
    noise = np.broadcast_to(np.asarray(stderr_ns, dtype=np.float64), time.shape)
    safe = np.where(known, time, 1.0)
    inverse = np.sqrt(1 + x**2 + y**2) / (_NS * safe)
    to_inverse = inverse / safe
    alone = to_inverse * np.hypot(np.nan_to_num(noise), _LEAST_ERROR_NS)
    correlation = _correlation(x, spread)
    level = _planes(inverse, alone, inverse * np.tan(off_nadir) * spread, known, light, correlation, off_nadir)
    tilt, unsure = (np.nan_to_num(one)[:, np.newaxis] for one in (level.along, level.along_stderr))
    steepness = np.hypot(np.tan(off_nadir - np.arctan(_LIKELY * tilt)), np.sqrt(_LIKELY) * unsure)
    return _planes(inverse, alone, inverse * steepness * spread, known, light, correlation, off_nadir)


def _correlation(x: FloatArray, spread: FloatArray) -> FloatArray:
    """Return the correlation between the errors of the pixels' centroids."""
    reach = float(np.mean(spread))
    apart = (x[:, np.newaxis] - x) / (reach if reach > 0 else 1.0)
    return np.asarray((1 - _CORRELATION) * np.eye(x.size) + _CORRELATION * np.exp(-0.5 * apart**2))


def _planes(
    inverse: FloatArray,
    alone: FloatArray,
    shared: FloatArray,
    known: BoolArray,
    light: PixelLight,
    correlation: FloatArray,
    angle: float,
) -> SurfacePlane:
    """Return the planes by weighted fits of A, B and C in sequence, so that B and C may be undetermined.

    The errors of 1/rho, (n, pixels), are `alone` independent and `shared` correlated between pixels.
    """
    x, y = light.angle_x, light.angle_y
    weight = np.where(known, 1 / (alone**2 + shared**2), 0.0)
    weight /= np.where(known.any(axis=1), weight.sum(axis=1), 1.0)[:, np.newaxis]

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.sum(weight * values, axis=1))

    def error(shares: FloatArray) -> FloatArray:
        part = shares * shared
        return np.asarray(np.sqrt(np.sum((shares * alone) ** 2 + part * (part @ correlation), axis=1)))

    u, v = x - mean(x)[:, np.newaxis], y - mean(y)[:, np.newaxis]
    uu = mean(u * u)
    has_u = np.asarray(uu > _LEAST_LEVER**2)
    tilt = np.where(has_u, mean(u * v) / np.where(has_u, uu, 1.0), 0.0)
    rest = v - tilt[:, np.newaxis] * u
    vv = mean(rest * rest)
    count = np.asarray(known.sum(axis=1))
    has_v: BoolArray = has_u & (vv > _LEAST_LEVER**2) & (count > 2)
    # Weights of the pixels' 1/rho in A, B and C.
    of_c = weight * rest * np.where(has_v, 1 / np.where(has_v, vv, 1.0), 0.0)[:, np.newaxis]
    of_b = weight * u * np.where(has_u, 1 / np.where(has_u, uu, 1.0), 0.0)[:, np.newaxis] - of_c * tilt[:, np.newaxis]
    of_a = weight - of_b * mean(x)[:, np.newaxis] - of_c * mean(y)[:, np.newaxis]
    a, b, c = (np.sum(shares * inverse, axis=1) for shares in (of_a, of_b, of_c))

    some = np.asarray(known.any(axis=1))
    a = np.where(some, a, 1.0)
    along = np.tan(angle + np.arctan(b / a))
    forward = np.cos(angle) + along * np.sin(angle)
    free = np.asarray(count - 1 - has_u - has_v)
    residual = np.where(known, inverse - a[:, np.newaxis] - b[:, np.newaxis] * x - c[:, np.newaxis] * y, 0.0)
    # A deviation in 1/rho equals a time deviation times t rho.
    misfit = np.sqrt(np.sum(residual**2, axis=1) / np.maximum(free, 1)) / (_NS * a**2)

    return SurfacePlane(
        np.where(has_u, along, np.nan),
        np.where(has_v, c / a * forward, np.nan),
        np.where(has_u, (1 + along**2) / (1 + (b / a) ** 2) * error(of_b) / a, np.nan),
        np.where(has_v, np.abs(forward) * error(of_c) / a, np.nan),
        np.where(some, 1 / a, np.nan),
        np.where(some, error(of_a) / a**2, np.nan),
        np.where(free > 0, misfit, np.nan),
    )


@dataclass(frozen=True)
class PixelEchoes:
    """Surface echoes in the pixels of shots; shape (n, pixels) each."""

    #: Two-way times and their standard errors from noise [ns]; NaN for a pixel without an echo.
    time_ns: FloatArray
    time_stderr_ns: FloatArray
    #: Echo energy and its standard error from noise [J], or [V s] for a signal; NaN for a pixel without an echo.
    energy: FloatArray
    energy_stderr: FloatArray
    #: Water column energy during an echo, which hides fainter ones, in the same unit, shape (pixels,).
    column_energy: FloatArray
    #: Standard deviation of the light's arrival over the pixel from a level sea [ns], shape (pixels,).
    time_spread_ns: FloatArray
    echo_fwhm_ns: float  #: Full echo width at half maximum [ns].


@dataclass(frozen=True)
class SeaEstimate:
    """Sea slopes along and across [1] and height [m] under shots, averaged over the beam's footprint."""

    #: Estimates in this order, shape (n, 3), and the covariance of their errors, shape (n, 3, 3).
    mean: FloatArray
    covariance: FloatArray
    prior: FloatArray  #: Covariance of the three on the sea, shape (3, 3).


def slopes_on_sea(echoes: PixelEchoes, shots: SeaShots, scale: float | None) -> SeaEstimate:
    """Estimate slopes and height of the sea from echo times and strengths, given the sea's statistics.

    `shots` are echoes of the same lidar at random locations on a sea with the same statistics. `scale` is pulse energy
    times efficiencies and aperture area [J m^2], positive; if None, strengths are not used.

    The estimate is linear in the observations y: E[a] + Cov(a, y) (Cov(y, y) + N)^-1 (y - E[y]), with the error
    covariance Cov(a, a) - Cov(a, y) (Cov(y, y) + N)^-1 Cov(y, a). It has the least mean square error among linear
    estimates and is the posterior mean for Gaussian a and y (Rodgers 2000, Inverse Methods for Atmospheric Sounding,
    eq. 2.44; Kay 1993, Fundamentals of Statistical Signal Processing I, section 12.5). Means and covariances come from
    `shots`; thus the prior of a is the sea's. Errors include waves within the footprint: an uneven echo has another
    centre than its pixel, and reflects few facets' slopes. N is the measurement covariance.

    Observations are each pixel's time, which measures the mean plane by its distance, and its strength as the deviation
    u = sqrt(2 ln(E_0/(E + e))). The echo energy E is proportional to the density of specular slopes. It is
    exp(-(tan(theta) - along)^2/(2 v)) for Gaussian slopes with the variance v within the footprint (Cox and Munk 1954,
    doi:10.1364/JOSA.44.000838). Thus u is linear in the slope along. E_0 is 2.7 times the largest energy in `shots`,
    and e a quarter of the column's energy, where echo fits become uncertain. A pixel without an echo has the strength 0
    +- e.

    Fit errors are 0.25 of the energy and e. In time they are 0.03 echo widths, and 1.5 spreads of the light over the
    pixel for echoes far fainter than 0.4 column energies. These were measured on one sea (6 m/s, 5 ns pulses, column
    with c = 0.3 1/m). In other waters, e scales with the column.

    Stated errors hold over all shots on a sea. In 200 others each at 3, 6 and 10 m/s, 20 degrees off nadir, the rms
    ratio of error to stated error was 0.88 to 1.06 along and 0.89 to 1.04 across. The correlation with the true slope
    along was 0.63, 0.88 to 0.92 and 0.96 for 2x2 pixels. For 1x4 pixels it was 0.71, 0.92 to 0.94 and 0.97. They do not
    hold for each slope. At 6 m/s, the column hides the echoes of faces away by more than 5 degrees. They are estimated
    as about 4 degrees, with 1.6 to 1.9 times the stated errors.
    """
    truth = np.stack([shots.along, shots.across, shots.height], axis=1)
    energy = np.maximum(np.nan_to_num(echoes.energy), 0)
    known, lit = np.isfinite(echoes.time_ns), np.isfinite(shots.time_ns)
    typical = np.sum(np.where(lit, shots.time_ns, 0), axis=0) / np.maximum(lit.sum(axis=0), 1)
    observed, measured = [np.where(lit, shots.time_ns, typical)], [np.where(known, echoes.time_ns, typical)]
    half_lost = _HALF_LOST * echoes.column_energy
    lost = _LOST_TIME_ERROR * echoes.time_spread_ns * half_lost / (energy + half_lost)
    error = _norm(echoes.time_stderr_ns, _TIME_ERROR * echoes.echo_fwhm_ns, lost)
    # An unknown time has an error that leaves it no weight.
    noise = [np.where(known, error, 1e3 * float(observed[0].std()))]
    if scale is not None:
        hidden = _COLUMN_ERROR * echoes.column_energy
        strongest = 1 + np.log(scale * shots.energy.max(axis=0) + hidden)
        modelled, deviation = (
            np.sqrt(2 * np.maximum(strongest - np.log(one + hidden), 0.1)) for one in (scale * shots.energy, energy)
        )
        observed.append(modelled)
        measured.append(deviation)
        noise.append(_norm(echoes.energy_stderr, hidden, _ENERGY_ERROR * energy) / (energy + hidden) / deviation)
    model, data, errors = (np.concatenate(part, axis=1) for part in (observed, measured, noise))
    joint = np.cov(np.concatenate([truth, model], axis=1).T)
    prior, cross, spread = joint[:3, :3], joint[:3, 3:], joint[3:, 3:]
    total = spread + errors[:, :, np.newaxis] ** 2 * np.eye(spread.shape[0])
    gain = np.linalg.solve(total, np.broadcast_to(cross.T, (len(total), *cross.T.shape)))
    mean = truth.mean(axis=0) + np.einsum("spq,sp->sq", gain, data - model.mean(axis=0))
    return SeaEstimate(mean, prior - cross @ gain, prior)


def _norm(*errors: FloatArray | float) -> FloatArray:
    """Return the root sum square of independent errors; NaN counts as 0."""
    return np.asarray(np.sqrt(sum(np.nan_to_num(error) ** 2 for error in errors)))


def with_prior(slope: npt.ArrayLike, stderr: npt.ArrayLike, deviation: float) -> tuple[FloatArray, FloatArray]:
    """Return a slope's mean and standard deviation [1] with a Gaussian prior for the sea's slopes.

    The prior has the mean 0 and the standard deviation of the slopes averaged over a footprint [1]. It is the result
    where `slope` or its standard error are NaN.
    """
    measured, error = np.asarray(slope, dtype=np.float64), np.asarray(stderr, dtype=np.float64)
    variance = deviation**2
    known = np.isfinite(measured) & np.isfinite(error)
    weight = np.where(known, variance / (variance + np.where(known, error, 1.0) ** 2), 0.0)
    return np.where(known, measured, 0.0) * weight, np.sqrt(variance * (1 - weight))


def steepest(along: npt.ArrayLike, across: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return a slope's angle from the horizontal, and the direction of its rise from the azimuth [rad]."""
    x, y = np.asarray(along, dtype=np.float64), np.asarray(across, dtype=np.float64)
    return np.asarray(np.arctan(np.hypot(x, y))), np.asarray(np.arctan2(y, x))


@dataclass(frozen=True)
class SlopeRefraction:
    """Ray refracted into the water by a sloping surface; arrays of one shape."""

    #: Cosines of the ray's angles from the facet's normal in air and water.
    cos_air: FloatArray
    cos_water: FloatArray
    cos_vertical: FloatArray  #: Cosine of the ray's angle from the vertical in the water.

    @classmethod
    def of(cls, along: npt.ArrayLike, across: npt.ArrayLike, off_nadir: float, n: float) -> SlopeRefraction:
        """Refract a ray at a facet, by Snell's law w = d/n + (cos_air/n - cos_water) m with the normal m.

        The facet's slopes [1] broadcast; NaN, and a ray that meets the facet from below, give NaN. The ray's angle in
        air from the vertical [rad] is 0 to below pi/2, and the water's refractive index at least 1.
        """
        a, b = np.broadcast_arrays(np.asarray(along, dtype=np.float64), np.asarray(across, dtype=np.float64))
        length = np.sqrt(1 + a**2 + b**2)
        cos_air = (a * np.sin(off_nadir) + np.cos(off_nadir)) / length
        cos_air = np.where(cos_air > 0, cos_air, np.nan)
        cos_water = cos_in_water(cos_air, n)
        return cls(cos_air, cos_water, np.cos(off_nadir) / n + (cos_water - cos_air / n) / length)


def bottom_depth(
    surface_range: npt.ArrayLike, path: npt.ArrayLike, height: float, off_nadir: float, ray: SlopeRefraction
) -> FloatArray:
    """Return a bottom point's depth below the mean sea level [m], corrected for the surface's height and slope.

    It is D = R cos(theta) - H + s cos(alpha), with the paths along the ray in air, R, and in the water, s [m]. H is the
    lidar's height above the mean sea level [m], and theta the ray's angle from the vertical in air [rad].

    A face away from the lidar refracts the ray towards the vertical. The path to the bottom is shorter (Tulldahl 2006,
    FOI-R-2074-SE, figure 12), and a depth with a level sea's angle is too small. Assumptions: the beam follows the axis
    through a plane, and scattering does not change the echo time.
    """
    distance, length = np.asarray(surface_range, dtype=np.float64), np.asarray(path, dtype=np.float64)
    return np.asarray(distance * np.cos(off_nadir) - height + length * ray.cos_vertical)


def bottom_gain(surface_range: npt.ArrayLike, path: npt.ArrayLike, n: float, ray: SlopeRefraction) -> FloatArray:
    """Return a Lambertian bottom's gain under a sloping surface [1/m^2], without attenuation in the water.

    It is T^2 cos(alpha)/(S_s S_t), for an echo with the energy E A (rho/pi) gain exp(-2 K s); for a level sea it equals
    `lidar_geometry`'s. Paths are as for `bottom_depth`, n is the water's refractive index.

    T is the facet's Fresnel transmittance. By Snell's law, a narrow pencil from the bottom point spreads through a
    plane with S_s = n R + s across the plane of incidence, and S_t = n R cos_water/cos_air + s cos_air/cos_water in it.
    """
    distance, length = np.asarray(surface_range, dtype=np.float64), np.asarray(path, dtype=np.float64)
    known = np.isfinite(ray.cos_air)
    _, transmittance = fresnel(np.arccos(np.clip(np.where(known, ray.cos_air, 1.0), 0, 1)), n)
    sagittal = n * distance + length
    tangential = n * distance * ray.cos_water / ray.cos_air + length * ray.cos_air / ray.cos_water
    return np.asarray(transmittance**2 * ray.cos_vertical / (sagittal * tangential))


#: Steps of the slopes along and across [1] and of the range [m] in which errors are propagated.
_STEPS = (0.01, 0.01, 0.01)


def variances(
    quantity: Callable[[FloatArray, FloatArray, FloatArray], FloatArray],
    surface_range: float,
    before: Sequence[npt.ArrayLike],
    after: Sequence[npt.ArrayLike],
) -> tuple[FloatArray, FloatArray]:
    """Return a quantity's variances without and with the correction for slope and range.

    Without the correction the variance is the true correction's variance over the sea, with it the variance of its
    error. Both are to first order about the level sea, for independent slopes and range. NaN quantities are not
    corrected.

    `quantity`: corrected quantity as a function of the slopes along and across [1] and the surface range [m].
    `surface_range`: range of a level sea at its mean height [m]. `before`, `after`: standard deviations of slopes and
    range on the sea, infinite where unknown; standard errors of their estimates. They broadcast. A NaN error, for a
    slope that is not estimated, counts in neither.
    """
    level = np.array([0.0, 0.0, surface_range])
    without, corrected = np.zeros(1), np.zeros(1)
    for axis, step in enumerate(_STEPS):
        upper, lower = (quantity(*(level + sign * step * np.eye(3)[axis])) for sign in (1, -1))
        gradient = (upper - lower) / (2 * step)
        deviation, error = np.broadcast_arrays(*(np.asarray(one[axis], dtype=np.float64) for one in (before, after)))
        counts = ~np.isnan(error) & (gradient != 0)
        without, corrected = (
            variance + np.where(counts, gradient * np.where(counts, one, 0.0), 0.0) ** 2
            for variance, one in ((without, deviation), (corrected, error))
        )
    return without, corrected
