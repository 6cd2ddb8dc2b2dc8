"""Wave spectra: Elfouhaily, Pierson-Moskowitz and JONSWAP, TMA in shallow water, and swell from a distant storm.

Wind speeds are at 10 m height. Wind waves share the directional spreading of Elfouhaily et al. (1997).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import ArrayLike, FloatArray, IntArray, finite, in_range, non_negative, positive
from mitransient_lidar.physics.sea.cox_munk import MAX_WIND_SPEED
from mitransient_lidar.physics.sea.wave_spectrum import (
    GRAVITY,
    SLOWEST_WAVENUMBER,
    CosineSpectrum,
    WaveSpectrum,
    phase_speed,
)

_DRAG_COEFFICIENT = 0.00144
_SLOWEST_SPEED = 0.23  # phase speed of the slowest wave, rounded as in Elfouhaily et al., m/s
_OLDEST, _YOUNGEST = 0.84, 5.0  # inverse wave age range
_PIERSON_MOSKOWITZ_BETA = 0.74


def inverse_wave_age(wind_speed: float, fetch: float) -> float:
    """Inverse wave age of a fetch-limited sea.

    Returns omega = U/c_p: 0.84 for a long fetch, 5 at most.

    Raises UserError if the fetch is so short that Omega exceeds 5.

    `wind_speed`: wind speed at 10 m [m/s], 0 to 30. `fetch`: distance from the upwind shore [m], positive.

    Elfouhaily et al. (1997), doi:10.1029/97JC00467, eq. 37: 0.84 tanh((X/2.2e4)^0.4)^-0.75 with X = g fetch/U^2.
    """
    wind, distance = in_range("wind_speed", wind_speed, 0, MAX_WIND_SPEED), positive("fetch", fetch)
    if wind == 0:
        return _OLDEST
    relative = GRAVITY * distance / wind**2 / 2.2e4
    age = float(_OLDEST * np.tanh(relative**0.4) ** -0.75)
    if age > _YOUNGEST:
        shortest = 2.2e4 * wind**2 / GRAVITY * np.arctanh((_OLDEST / _YOUNGEST) ** (4 / 3)) ** 2.5
        raise UserError(f"fetch = {distance:g} must be at least {shortest:.3g} m at a wind speed of {wind:g} m/s")
    return age


class WindSpectrum(CosineSpectrum):
    """Wind wave spectrum with the directional spreading of Elfouhaily et al. (1997) about its own peak."""

    wind_speed: float

    def __post_init__(self) -> None:
        in_range("wind_speed", self.wind_speed, 0, MAX_WIND_SPEED)
        finite("direction", self.direction)

    def spreading(self, k: ArrayLike) -> FloatArray:
        """Upwind-crosswind ratio Delta(k) [1], 0 to 1 (eq. 57); see `WaveSpectrum.spreading`."""
        if self.wind_speed == 0:
            return np.zeros(np.shape(k))
        c = phase_speed(k)
        friction = np.sqrt(_DRAG_COEFFICIENT) * self.wind_speed
        long_waves = 4 * (c / phase_speed(self.peak_wavenumber)) ** 2.5
        short_waves = 0.13 * friction / _SLOWEST_SPEED * (_SLOWEST_SPEED / c) ** 2.5
        return np.asarray(np.tanh(np.log(2) / 4 + long_waves + short_waves))


@dataclass(frozen=True)
class ElfouhailySpectrum(WindSpectrum):
    """Unified spectrum of wind-driven gravity and capillary waves.

    Elfouhaily, Chapron, Katsaros and Vandemark (1997), J. Geophys. Res. 102, 15781, doi:10.1029/97JC00467, with the
    drag coefficient 0.00144. The low-frequency roll-off L_PM J_p also acts on the capillary branch; without it waves in
    light winds would be tens of metres high. A negative capillary amplitude in eq. 44 (below 2.2 m/s) is replaced by 0.
    """

    wind_speed: float  #: Wind speed at 10 m [m/s], 0 to 30. 0 gives a flat sea.
    #: Omega: 0.84 for a fully developed sea, up to 5 for a young one; see `inverse_wave_age` for a fetch.
    inverse_wave_age: float = _OLDEST
    direction: float = 0.0  #: Direction the wind blows towards [rad], counter-clockwise from +x.

    def __post_init__(self) -> None:
        super().__post_init__()
        in_range("inverse_wave_age", self.inverse_wave_age, _OLDEST, _YOUNGEST)

    @property
    def peak_wavenumber(self) -> float:
        """Wavenumber at the spectral peak [rad/m]; infinite without wind."""
        if self.wind_speed == 0:
            return np.inf
        return GRAVITY * (self.inverse_wave_age / self.wind_speed) ** 2

    @property
    def smooth_ranges(self) -> tuple[float, ...]:
        """First and last wavenumber [rad/m] with waves: the capillary peak has fallen to e^-90 at the last."""
        return self.peak_wavenumber / 10, 20 * SLOWEST_WAVENUMBER

    def omnidirectional(self, k: ArrayLike) -> FloatArray:
        """Omnidirectional elevation spectrum S(k) [m^3]; see `WaveSpectrum.omnidirectional`."""
        wavenumber = np.asarray(k, dtype=np.float64)
        valid = wavenumber > 0
        if self.wind_speed == 0:
            return np.zeros_like(wavenumber)
        k = np.where(valid, wavenumber, 1.0)
        omega, peak = self.inverse_wave_age, self.peak_wavenumber
        speed = phase_speed(k)
        root = np.sqrt(k / peak)

        # Roll-off below the peak and its enhancement, common to both branches
        gamma = 1.7 + 6 * max(np.log10(omega), 0.0)
        sigma = 0.08 * (1 + 4 * omega**-3)
        exponent = np.log(gamma) * np.exp(-((root - 1) ** 2) / (2 * sigma**2)) - 1.25 * (peak / k) ** 2

        # Long waves: B_l = alpha_p/2 (c_p/c) F_p
        long_waves = 0.5 * 0.006 * np.sqrt(omega) * phase_speed(peak) / speed
        long_waves = long_waves * np.exp(-omega / np.sqrt(10) * (root - 1))

        # Short waves: B_h = alpha_m/2 (c_m/c) F_m
        ratio = np.log(np.sqrt(_DRAG_COEFFICIENT) * self.wind_speed / _SLOWEST_SPEED)
        amplitude = max(0.01 * (1 + (ratio if ratio <= 0 else 3 * ratio)), 0.0)
        short_waves = 0.5 * amplitude * _SLOWEST_SPEED / speed * np.exp(-0.25 * (k / SLOWEST_WAVENUMBER - 1) ** 2)
        return np.asarray(np.where(valid, np.exp(exponent) * (long_waves + short_waves) / k**3, 0))


class SaturatedSpectrum(WindSpectrum):
    """Wavenumber form of a frequency spectrum with the tail alpha g^2 omega^-5, up to the slowest wave.

    S(omega) d omega = S(k) dk with omega^2 = g k gives the tail (alpha/2) k^-3. Its slope variance grows by alpha/2
    with every factor e in k. These spectra do not include capillary waves; they end at `CUT_OFF`, the limit of gravity
    waves.
    """

    CUT_OFF: ClassVar[float] = SLOWEST_WAVENUMBER

    @property
    def smooth_ranges(self) -> tuple[float, ...]:
        """First wavenumber with waves, the peak and the cut-off [rad/m]; the JONSWAP peak has a kink."""
        if self.peak_wavenumber >= self.CUT_OFF:
            return ()
        return self.peak_wavenumber / 10, self.peak_wavenumber, self.CUT_OFF

    def _saturated(self, k: ArrayLike, alpha: float, enhancement: float) -> FloatArray:
        """S(k) [m^3] with the Phillips constant `alpha` and the JONSWAP peak enhancement."""
        wavenumber, peak = np.asarray(k, dtype=np.float64), self.peak_wavenumber
        valid = (wavenumber > 0) & (wavenumber <= self.CUT_OFF)
        if not peak < self.CUT_OFF:
            return np.zeros_like(wavenumber)
        k = np.where(valid, wavenumber, 1.0)
        root = np.sqrt(k / peak)  # omega/omega_p
        width = np.where(root <= 1, 0.07, 0.09)
        exponent = np.log(enhancement) * np.exp(-((root - 1) ** 2) / (2 * width**2)) - 1.25 * (peak / k) ** 2
        return np.asarray(np.where(valid, 0.5 * alpha / k**3 * np.exp(exponent), 0))


@dataclass(frozen=True)
class PiersonMoskowitzSpectrum(SaturatedSpectrum):
    """Gravity wave spectrum of a fully developed sea.

    Pierson and Moskowitz (1964), J. Geophys. Res. 69, 5181, doi:10.1029/JZ069i024p05181: alpha = 8.1e-3, beta = 0.74
    and the wind at 19.5 m, here 1.026 times that at 10 m. Measured at 10 to 20 m/s.
    """

    #: As for `ElfouhailySpectrum`. Below 0.14 m/s there are no gravity waves and the sea is flat.
    wind_speed: float
    direction: float = 0.0

    @property
    def peak_wavenumber(self) -> float:
        """Wavenumber of the frequency spectrum's peak [rad/m]; infinite without wind."""
        if self.wind_speed == 0:
            return np.inf
        return GRAVITY * math.sqrt(0.8 * _PIERSON_MOSKOWITZ_BETA) / (1.026 * self.wind_speed) ** 2

    def omnidirectional(self, k: ArrayLike) -> FloatArray:
        """Omnidirectional elevation spectrum S(k) [m^3]; see `WaveSpectrum.omnidirectional`."""
        return self._saturated(k, 8.1e-3, 1.0)


@dataclass(frozen=True)
class JonswapSpectrum(SaturatedSpectrum):
    """Gravity wave spectrum of a fetch-limited sea.

    `wind_speed`, `direction`: as for `ElfouhailySpectrum`, but with a wind speed above 0. `fetch`: distance from the
    upwind shore [m], such that g fetch/U^2 is 0.1 to 17 000. The measurements start at 0.1; at 17 000 the peak reaches
    the fully developed sea's peak and the growth ends. `peak_enhancement`: gamma, 1 to 7; the mean over the
    measurements is 3.3.

    Hasselmann et al. (1973), Dtsch. Hydrogr. Z. Suppl. A8 (12), with X = g fetch/U^2: alpha = 0.076 X^-0.22,
    omega_p = 22 (g/U) X^(-1/3), widths 0.07 below and 0.09 above the peak.
    """

    wind_speed: float
    fetch: float
    peak_enhancement: float = 3.3
    direction: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        wind, distance = positive("wind_speed", self.wind_speed), positive("fetch", self.fetch)
        unit = wind**2 / GRAVITY
        shortest = 0.1 * unit
        # The fetch at which omega_p reaches Pierson and Moskowitz's
        longest = (22 * 1.026 / (0.8 * _PIERSON_MOSKOWITZ_BETA) ** 0.25) ** 3 * unit
        if distance > longest:
            raise UserError(
                f"fetch = {distance:g} must not exceed {longest:.3g} m at a wind speed of {wind:g} m/s, "
                "where the sea is fully developed"
            )
        if distance < shortest:
            raise UserError(f"fetch = {distance:g} must be at least {shortest:.3g} m at a wind speed of {wind:g} m/s")
        in_range("peak_enhancement", self.peak_enhancement, 1, 7)

    @property
    def peak_wavenumber(self) -> float:
        """Wavenumber at the frequency spectrum's peak [rad/m]."""
        return GRAVITY * (22 / self.wind_speed) ** 2 / math.pow(self._relative_fetch, 2 / 3)

    def omnidirectional(self, k: ArrayLike) -> FloatArray:
        """Omnidirectional elevation spectrum S(k) [m^3]; see `WaveSpectrum.omnidirectional`."""
        return self._saturated(k, 0.076 * self._relative_fetch**-0.22, self.peak_enhancement)

    @property
    def _relative_fetch(self) -> float:
        """Fetch over U^2/g [1]."""
        return GRAVITY * self.fetch / self.wind_speed**2


@dataclass(frozen=True)
class ShallowSpectrum(CosineSpectrum):
    """Wind waves in water of finite depth, which limits the long ones.

    TMA spectrum by Bouws, Guenther, Rosenthal and Vincent (1985), J. Geophys. Res. 90, 975,
    doi:10.1029/JC090iC01p00975: k^3 S(k) and the spreading equal their deep-water values at the same frequency, thus at
    the wavenumber k tanh(k depth). In frequencies it is the deep spectrum times Kitaigorodskii's factor, from (depth
    omega^2/g)/2 for long waves to 1.
    """

    deep: CosineSpectrum  #: Spectrum for the same wind over deep water.
    depth: float  #: Water depth [m], positive.
    direction: float = field(init=False)

    def __post_init__(self) -> None:
        positive("depth", self.depth)
        object.__setattr__(self, "direction", self.deep.direction)

    @property
    def peak_wavenumber(self) -> float:
        """Wavenumber [rad/m] at the deep peak's frequency."""
        return self._shallow(self.deep.peak_wavenumber)

    @property
    def smooth_ranges(self) -> tuple[float, ...]:
        """See `WaveSpectrum.smooth_ranges`."""
        return tuple(self._shallow(edge) for edge in self.deep.smooth_ranges)

    def omnidirectional(self, k: ArrayLike) -> FloatArray:
        """Omnidirectional elevation spectrum S(k) [m^3]; see `WaveSpectrum.omnidirectional`."""
        wavenumber = np.asarray(k, dtype=np.float64)
        ratio = np.tanh(np.maximum(wavenumber, 0) * self.depth)
        return np.asarray(ratio**3 * self.deep.omnidirectional(wavenumber * ratio))

    def spreading(self, k: ArrayLike) -> FloatArray:
        """Anisotropy Delta(k) [1]; see `WaveSpectrum.spreading`."""
        wavenumber = np.asarray(k, dtype=np.float64)
        return self.deep.spreading(wavenumber * np.tanh(wavenumber * self.depth))

    def _shallow(self, deep: float) -> float:
        """Return the wavenumber [rad/m] at the frequency of a wave over deep water: a root of k tanh(k depth)."""
        from scipy.optimize import brentq

        if not math.isfinite(deep):
            return deep
        # tanh(x) is at least x/(1 + x).
        highest = 0.5 * (deep + math.sqrt(deep**2 + 4 * deep / self.depth))
        return float(brentq(lambda k: k * math.tanh(k * self.depth) - deep, deep, highest * (1 + 1e-9), xtol=1e-12))


_REACH = 6.0  # half width of the hump in standard deviations, which neglects 2e-9 of it


@dataclass(frozen=True)
class SwellSpectrum(WaveSpectrum):
    """Swell as a Gaussian hump in wavenumber and in direction."""

    #: Significant wave height [m], 0 to a fifteenth of the wavelength: steeper seas break (DNV-RP-C205; a single wave
    #: breaks at a seventh).
    height: float
    #: Mean wavelength [m], positive. In a realisation it is rounded to a fraction of the period, and swell more than
    #: twice as long as the period is missing.
    wavelength: float
    direction: float = 0.0  #: Mean travel direction [rad], counter-clockwise from +x.
    relative_bandwidth: float = 0.1  #: Standard deviation of the wavenumber over its mean [1], above 0 up to 0.3.
    directional_spread: float = 0.15  #: Standard deviation of the direction [rad], above 0 up to 0.6.

    def __post_init__(self) -> None:
        wavelength = positive("wavelength", self.wavelength)
        height = non_negative("height", self.height)
        if height > wavelength / 15:
            raise UserError(
                f"height = {height:g} must not exceed {wavelength / 15:.3g} m, a fifteenth of the wavelength (breaking)"
            )
        finite("direction", self.direction)
        in_range("relative_bandwidth", positive("relative_bandwidth", self.relative_bandwidth), 0, 0.3)
        in_range("directional_spread", positive("directional_spread", self.directional_spread), 0, 0.6)

    @property
    def peak_wavenumber(self) -> float:
        """Mean wavenumber [rad/m]."""
        return 2 * np.pi / self.wavelength

    @property
    def smooth_ranges(self) -> tuple[float, ...]:
        """First and last wavenumber [rad/m] in the hump."""
        reach = _REACH * self.relative_bandwidth
        return self.peak_wavenumber * max(1 - reach, 1e-6), self.peak_wavenumber * (1 + reach)

    def omnidirectional(self, k: ArrayLike) -> FloatArray:
        """Omnidirectional elevation spectrum S(k) [m^3]; see `WaveSpectrum.omnidirectional`."""
        wavenumber = np.asarray(k, dtype=np.float64)
        low, high = self.smooth_ranges
        width = self.relative_bandwidth * self.peak_wavenumber
        # Normalised over k > 0 only
        positive_part = 0.5 * (1 + math.erf(1 / (self.relative_bandwidth * math.sqrt(2))))
        scale = (self.height / 4) ** 2 / (positive_part * math.sqrt(2 * math.pi) * width)
        hump = scale * np.exp(-(((wavenumber - self.peak_wavenumber) / width) ** 2) / 2)
        return np.asarray(np.where((wavenumber > low) & (wavenumber < high), hump, 0))

    def spreading(self, k: ArrayLike) -> FloatArray:
        """Anisotropy Delta [1], the same for all waves; see `WaveSpectrum.spreading`."""
        angle, weight = self._angles(2000)
        return np.full(np.shape(k), 2 * float(np.sum(weight * np.cos(2 * angle))))

    def directional(self, kx: ArrayLike, ky: ArrayLike) -> FloatArray:
        """Directional spectrum Psi [m^4] at wavenumber components [rad/m] that broadcast, equal for opposite waves."""
        cos, sin = np.cos(self.direction), np.sin(self.direction)
        along = cos * np.asarray(kx) + sin * np.asarray(ky)
        across = cos * np.asarray(ky) - sin * np.asarray(kx)
        k = np.hypot(along, across)
        # On a frozen surface waves against the direction are the same.
        angle = np.arctan2(across, np.abs(along))
        sigma = self.directional_spread
        norm = math.sqrt(2 * math.pi) * sigma * math.erf(math.pi / (2 * math.sqrt(2) * sigma))
        density = 0.5 * np.exp(-((angle / sigma) ** 2) / 2) / norm
        return np.asarray(self.omnidirectional(k) * density / np.where(k > 0, k, 1.0))

    def mode_variances(self, ix: IntArray, iy: IntArray, dk: float) -> FloatArray:
        """Elevation variances [m^2] as of `WaveSpectrum.mode_variances`, integrated over cells for a narrow hump."""
        peak = self.peak_wavenumber
        width = self.relative_bandwidth * peak
        if dk <= min(width, self.directional_spread * peak):
            return np.asarray(self.directional(ix * dk, iy[:, None] * dk) * dk**2)
        # Each point of the hump is assigned to the nearest wave, which conserves the variance.
        angle, angle_weight = self._angles(self._count(self.directional_spread * peak, dk))
        count = self._count(width, dk)
        low, high = self.smooth_ranges
        k = low + (high - low) * (np.arange(count) + 0.5) / count
        hump = self.omnidirectional(k)
        hump *= (self.height / 4) ** 2 / hump.sum() if self.height > 0 else 0
        nearest_x = np.rint(k[:, None] * np.cos(angle + self.direction) / dk).astype(np.int64)
        nearest_y = np.rint(k[:, None] * np.sin(angle + self.direction) / dk).astype(np.int64)
        reach = int(max(np.abs(nearest_x).max(), np.abs(nearest_y).max()))
        side = 2 * reach + 1
        cell = (nearest_y + reach) * side + nearest_x + reach
        sums = np.bincount(cell.ravel(), np.outer(hump, angle_weight).ravel(), side**2).reshape(side, side)
        frozen = 0.5 * (sums + sums[::-1, ::-1])
        variances = frozen[np.clip(iy, -reach, reach)[:, None] + reach, np.clip(ix, -reach, reach) + reach]
        return np.where((np.abs(iy)[:, None] <= reach) & (np.abs(ix) <= reach), variances, 0)

    def _angles(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Angles from the direction [rad] and midpoint rule weights with unit sum."""
        reach = min(_REACH * self.directional_spread, np.pi / 2)
        angle = reach * ((2 * np.arange(count) + 1) / count - 1)
        weight = np.exp(-((angle / self.directional_spread) ** 2) / 2)
        return angle, weight / weight.sum()

    @staticmethod
    def _count(width: float, dk: float) -> int:
        """Points across a hump: at least 4 per standard deviation `width` [rad/m] and 32 per cell."""
        return math.ceil(2 * _REACH * max(4.0, 32 * width / dk))
