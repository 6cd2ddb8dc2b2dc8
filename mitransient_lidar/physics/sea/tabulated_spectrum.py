"""Wave spectrum given as a table over both wavenumber components."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, IntArray, finite, increasing_array, non_negative_array
from mitransient_lidar.physics.sea.wave_spectrum import TravellingWaves, WaveSpectrum


@dataclass(frozen=True, eq=False)
class TabulatedSpectrum(WaveSpectrum):
    """Tabulated spectrum: bilinear between its nodes, 0 outside.

    Parameters
    ----------
    kx, ky : array_like, shapes (I,) and (J,)
        Wavenumber components [rad/m], strictly increasing, at least 2 each.
    density : array_like, shape (J, I)
        Variance density [m^4] of waves that travel along (kx[i], ky[j]), not negative, greater than 0 somewhere. Its
        integral over the table is the elevation variance.
    direction : float
        Direction [rad] of the axes of slope variances, counter-clockwise from +x.
    """

    kx: FloatArray
    ky: FloatArray
    density: FloatArray
    direction: float = 0.0

    def __post_init__(self) -> None:
        for name in ("kx", "ky"):
            object.__setattr__(self, name, increasing_array(name, getattr(self, name)))
        density = non_negative_array("density", self.density)
        if density.shape != (self.ky.size, self.kx.size):
            raise UserError(f"density of shape {density.shape} must have shape (ky, kx) = {self.ky.size, self.kx.size}")
        if not np.any(density > 0):
            raise UserError("density must be greater than 0 somewhere")
        object.__setattr__(self, "density", density)
        finite("direction", self.direction)

    @property
    def peak_wavenumber(self) -> float:
        """Wavenumber of the table's largest value [rad/m]."""
        j, i = np.unravel_index(np.argmax(self.density), self.density.shape)
        return float(np.hypot(self.kx[i], self.ky[j]))

    def omnidirectional(self, k: npt.ArrayLike) -> FloatArray:
        """Omnidirectional elevation spectrum S(k) [m^3]; see `WaveSpectrum.omnidirectional`."""
        wavenumber = np.maximum(np.asarray(k, dtype=np.float64), 0)[..., None]
        angle = 2 * np.pi * (np.arange(720) + 0.5) / 720
        ring = self._running(wavenumber * np.cos(angle), wavenumber * np.sin(angle))
        return np.asarray(2 * np.pi * wavenumber[..., 0] * ring.mean(axis=-1))

    def directional(self, kx: npt.ArrayLike, ky: npt.ArrayLike) -> FloatArray:
        """Directional spectrum Psi [m^4]; see `WaveSpectrum.directional`."""
        x, y = np.asarray(kx, dtype=np.float64), np.asarray(ky, dtype=np.float64)
        return 0.5 * (self._running(x, y) + self._running(-x, -y))

    def elevation_variance(self) -> float:
        """Variance of the elevation [m^2]."""
        (x, x_weight), (y, y_weight) = _gauss_rule(self.kx), _gauss_rule(self.ky)
        return float(y_weight @ self._running(x, y[:, None]) @ x_weight)

    def slope_covariance(self) -> FloatArray:
        """Covariance matrix [1] of the slopes in x and y, shape (2, 2)."""
        (x, x_weight), (y, y_weight) = _gauss_rule(self.kx), _gauss_rule(self.ky)
        y, y_weight = y[:, None], y_weight[:, None]
        variance = self._running(x, y) * x_weight * y_weight
        xx, xy, yy = np.sum(variance * x**2), np.sum(variance * x * y), np.sum(variance * y**2)
        return np.array([[xx, xy], [xy, yy]])

    def mode_variances(self, ix: IntArray, iy: IntArray, dk: float) -> FloatArray:
        """Elevation variances [m^2]: the integrals of Psi over the cells of `WaveSpectrum.mode_variances`."""
        return 0.5 * (self.running_variances(ix, iy, dk) + self.running_variances(-ix, -iy, dk))

    def running_variances(self, ix: IntArray, iy: IntArray, dk: float) -> FloatArray:
        """Integrals of the table [m^2] over the cells about (ix, iy) dk, shape (J, I); see `mode_variances`."""
        x_weight, y_weight = _cell_weights(self.kx, ix, dk), _cell_weights(self.ky, iy, dk)
        return np.asarray(np.maximum(y_weight @ self.density @ x_weight.T, 0))

    def travelling_parts(self) -> tuple[TravellingWaves, ...]:
        """Return the waves that travel with and those that travel against `direction`."""
        return _TableHalf(self, self.direction), _TableHalf(self, self.direction + np.pi)

    def _running(self, kx: FloatArray, ky: FloatArray) -> FloatArray:
        """Table's density [m^4] at (kx, ky), which broadcast."""
        i, right = _bracket(self.kx, kx)
        j, upper = _bracket(self.ky, ky)
        low = (1 - right) * self.density[j, i] + right * self.density[j, i + 1]
        high = (1 - right) * self.density[j + 1, i] + right * self.density[j + 1, i + 1]
        inside = (right >= 0) & (right <= 1) & (upper >= 0) & (upper <= 1)
        return np.asarray(np.where(inside, (1 - upper) * low + upper * high, 0))


@dataclass(frozen=True, eq=False)
class _TableHalf:
    """Waves of a table that travel towards the half plane of one direction."""

    table: TabulatedSpectrum
    direction: float

    def mode_variances(self, ix: IntArray, iy: IntArray, dk: float) -> FloatArray:
        """Elevation variances [m^2] of these waves alone; see `WaveSpectrum.mode_variances`."""
        along = np.cos(self.direction) * ix + np.sin(self.direction) * iy[:, None]
        # A wave exactly across the direction belongs to both halves.
        forward = np.where(np.abs(along) < 1e-9, 0.5, along > 0)
        return np.asarray(
            0.5 * forward * self.table.running_variances(ix, iy, dk)
            + 0.5 * (1 - forward) * self.table.running_variances(-ix, -iy, dk)
        )


def _bracket(axis: FloatArray, k: FloatArray) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Interval of a table's axis that contains k, and the relative position in it: 0 to 1 inside the table."""
    i = np.clip(np.searchsorted(axis, k, side="right") - 1, 0, axis.size - 2)
    return i, np.asarray((k - axis[i]) / (axis[i + 1] - axis[i]))


def _gauss_rule(axis: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights [rad/m] of the two-point Gauss rule in each interval, which is exact for cubic polynomials."""
    middle, half = (axis[1:] + axis[:-1]) / 2, np.diff(axis) / 2
    nodes = middle[:, None] + half[:, None] * np.array([-1, 1]) / np.sqrt(3)
    return nodes.ravel(), np.repeat(half, 2)


def _cell_weights(axis: FloatArray, index: IntArray, dk: float) -> FloatArray:
    """Integrals [rad/m] of a table's linear basis functions over the cells about index dk, shape (cells, nodes)."""
    edges = (index[:, None] + np.array([-0.5, 0.5])).ravel()[:, None] * dk
    step = np.diff(axis)
    along = np.clip((edges - axis[:-1]) / step, 0, 1)
    # Integrals from the left end of the table to each edge: of the falling flanks, then of the rising ones
    upto = np.zeros((edges.size, axis.size))
    upto[:, :-1] += step * (along - along**2 / 2)
    upto[:, 1:] += step * along**2 / 2
    return np.asarray(upto[1::2] - upto[::2])
