"""From a few numbers to a sea: which waves it has, where they are resolved, and what is left to ripples."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from mitransient_lidar.height_maps import HeightMap, read_height_map
from mitransient_lidar.optics.checks import FloatArray, finite, in_range, non_negative, positive, whole
from mitransient_lidar.optics.sea import MAX_WIND_SPEED, cox_munk
from mitransient_lidar.optics.sea_mesh import SeaMesh, surround_ticks, triangulate
from mitransient_lidar.optics.spectra import (
    CosineSpectrum,
    ElfouhailySpectrum,
    JonswapSpectrum,
    MatchedSpectrum,
    PiersonMoskowitzSpectrum,
    SeaState,
    SwellSpectrum,
    TabulatedSpectrum,
    WaveSpectrum,
    inverse_wave_age,
)
from mitransient_lidar.optics.wake import kelvin_wake
from mitransient_lidar.optics.wave_spectrum import variances_along
from mitransient_lidar.optics.waves import mesh_slope_variance, realise

logger = logging.getLogger(__name__)

#: Smallest slope variance of the ripples along one axis: a perfectly smooth facet has no connection to a point laser.
SMALLEST_RIPPLE_VARIANCE = 1e-5

#: The period of the sea is a multiple of this [m], at least so many peak wavelengths, and at most so long [m]; it does
#: not depend on the resolution, so that a seed means one sea.
_PERIOD_STEP, _PERIOD_WAVELENGTHS, _LONGEST_PERIOD = 32.0, 3.0, 512.0

#: Most cells a side of a period, and of the fine patch.
_MOST_CELLS = 4096

#: Side of a cell and of the patch where nothing is known of the footprint [m].
_DEFAULT_CELL, _DEFAULT_SIZE = 0.25, 32.0

#: Cells in a beam's standard deviation, and limits of the cells that it leads to [m].
_CELLS_PER_SPREAD, _SMALLEST_CELL, _LARGEST_CELL = 4.0, 0.02, 0.5

#: The patch is so much wider than the footprint; and by so much more [m], for light that scattering has spread.
_SIZE_PER_FOOTPRINT, _SIZE_MARGIN = 1.25, 8.0

_SPECTRA = ("elfouhaily", "jonswap", "pierson_moskowitz", "table", "height_map", "flat")

Get = Callable[[str, Any], Any]


class Heights(Protocol):
    """Elevation of a sea surface."""

    def sample(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return elevations [m] on grid lines x and y [m], shape (len(y), len(x))."""
        ...


@dataclass(frozen=True)
class PeriodicHeights:
    """Realised waves on a periodic grid.

    Attributes
    ----------
    heights
        Elevations [m] as of `optics.waves.realise`, shape (cells, cells).
    cell_size
        Spacing of the grid [m].
    """

    heights: FloatArray
    cell_size: float

    def sample(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return elevations [m] at the grid points next to the grid lines x and y [m], shape (len(y), len(x))."""
        count = len(self.heights)
        i, j = ((np.rint(np.asarray(lines) / self.cell_size).astype(int) + count // 2) % count for lines in (x, y))
        return np.asarray(self.heights[np.ix_(j, i)])


@dataclass(frozen=True)
class Ship:
    """A ship whose Kelvin wake lies on the sea: speed [m/s], bearing [rad], length [m] and position [m]."""

    speed: float
    bearing: float
    length: float
    x: float
    y: float


@dataclass(frozen=True)
class SeaSurface:
    """A sea surface, ready to be triangulated.

    Attributes
    ----------
    spectrum
        Name of what the waves come from.
    wind_speed, wind_direction
        Wind at 10 m [m/s], and where it blows to [rad], counter-clockwise from +x.
    waves
        Elevations, None for a flat sea.
    cell_size
        Side of the cells of the fine patch [m], infinite for a flat sea.
    centre
        Where the patch lies [m].
    size, extent
        Side of the patch, and of the whole surface [m].
    resolved_variance, ripple_variance
        Slope variances along and across the wind of the facets, and of what is left to the ripples [1].
    ship
        What leaves a wake, if anything does.
    """

    spectrum: str
    wind_speed: float
    wind_direction: float
    waves: Heights | None
    cell_size: float
    centre: tuple[float, float]
    size: float
    extent: float
    resolved_variance: tuple[float, float]
    ripple_variance: tuple[float, float]
    ship: Ship | None

    @classmethod
    def read(cls, get: Get) -> SeaSurface:
        """Build a sea from parameters; their names and meanings are those of the plugin ``ocean_surface``.

        Parameters
        ----------
        get
            Function (name, default) -> value.

        Raises
        ------
        ValueError
            When a parameter is out of range, or parameters contradict each other.
        """
        spectrum = get("spectrum", "elfouhaily")
        if spectrum not in _SPECTRA:
            raise ValueError(f"spectrum = {spectrum!r} must be one of {', '.join(_SPECTRA)}")
        wind_speed = in_range("wind_speed", get("wind_speed", 3.0), 0.0, MAX_WIND_SPEED)
        wind_direction = math.radians(finite("wind_direction_deg", get("wind_direction_deg", 0.0)))
        centre = finite("centre_x", get("centre_x", 0.0)), finite("centre_y", get("centre_y", 0.0))
        state = _read_waves(get, spectrum, wind_speed, wind_direction)
        wanted_total = get("slope_variance", "cox_munk")
        seed = whole("surface_seed", get("surface_seed", 1), 0, 2**53)
        ship = _read_ship(get)
        spread, footprint = _read_footprint(get)
        cell = _read_length(get, "cell_size") or min(max(spread / _CELLS_PER_SPREAD, _SMALLEST_CELL), _LARGEST_CELL)
        size = _read_length(get, "size") or _SIZE_PER_FOOTPRINT * footprint + _SIZE_MARGIN
        extent = positive("extent", get("extent", 1000.0))
        period = _read_length(get, "period")
        time = finite("time", get("time", 0.0))
        depth = positive("water_depth", get("water_depth", 1e4))
        current = in_range("current_speed", get("current_speed", 0.0), 0.0, 10.0)
        current_direction = math.radians(finite("current_direction_deg", get("current_direction_deg", 0.0)))
        map_size = _read_length(get, "map_size")
        path = get("filename", "")

        state, total = _total(state, wanted_total, wind_speed, wind_direction)
        waves: Heights | None = None
        resolved = (0.0, 0.0)
        if state is not None:
            period = period or _period(state)
            cells = _cells("cell_size", cell, period)
            cell = period / cells
            drift = current * math.cos(current_direction), current * math.sin(current_direction)
            waves = PeriodicHeights(realise(state, period, cells, seed, time, depth, drift), cell)
            resolved = mesh_slope_variance(state, period, cells, wind_direction)
        elif spectrum == "height_map":
            terrain = read_height_map(_existing(path, spectrum), map_size)
            waves = terrain
            cell = float(terrain.x[1] - terrain.x[0])
            size = float(terrain.x[-1] - terrain.x[0])
            resolved = _facet_variance(terrain, wind_direction)
        elif ship is None:
            cell = math.inf
        ripples = tuple(
            max(SMALLEST_RIPPLE_VARIANCE, whole_sea - part) for whole_sea, part in zip(total, resolved, strict=True)
        )
        if math.isfinite(cell) and size / cell > _MOST_CELLS:
            raise ValueError(
                f"size = {size:g} with cell_size = {cell:g} needs {size / cell:.0f} cells a side: "
                f"allowed are {_MOST_CELLS}"
            )
        return cls(
            spectrum if waves is not None else "flat",
            wind_speed,
            wind_direction,
            waves,
            cell,
            centre,
            min(size, extent),
            extent,
            resolved,
            (ripples[0], ripples[1]),
            ship,
        )

    @property
    def slope_variance(self) -> float:
        """Total slope variance of waves and ripples, both axes [1]."""
        return sum(self.resolved_variance) + sum(self.ripple_variance)

    def mesh(self) -> SeaMesh:
        """Return the triangles: the fine patch, and around it cells that grow out to the extent."""
        if not math.isfinite(self.cell_size):
            edges = np.array([-0.5, 0.5]) * self.extent
            x, y = edges + self.centre[0], edges + self.centre[1]
            return triangulate(np.zeros((2, 2)), x, y, self.wind_direction)
        cells = max(2, 2 * math.ceil(0.5 * self.size / self.cell_size))
        ticks = surround_ticks(cells, math.ceil(self.extent / self.cell_size))
        # Whole cells: wherever the patch lies, it shows the same sea.
        first = [round(centre / self.cell_size) for centre in self.centre]
        x, y = (np.asarray((ticks + start) * self.cell_size, dtype=np.float64) for start in first)
        return triangulate(self.heights(x, y), x, y, self.wind_direction)

    def heights(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return elevations [m] on grid lines x and y [m], whole multiples of the cells, shape (len(y), len(x))."""
        heights = np.zeros((len(y), len(x))) if self.waves is None else self.waves.sample(x, y)
        if self.ship is None:
            return heights
        ship = self.ship
        wake = kelvin_wake(x, y, ship.speed, ship.bearing, ship.length, ship_x=ship.x, ship_y=ship.y)
        return np.asarray(heights + wake, dtype=np.float64)


def _read_waves(get: Get, spectrum: str, wind_speed: float, wind_direction: float) -> WaveSpectrum | None:
    """Return the sea state that the parameters describe, None for a flat sea or a height map."""
    fetch = get("fetch", None)
    age = get("inverse_wave_age", None)
    peak_enhancement = positive("peak_enhancement", get("peak_enhancement", 3.3))
    swell_height = non_negative("swell_height", get("swell_height", 0.0))
    swell_wavelength = positive("swell_wavelength", get("swell_wavelength", 60.0))
    swell_direction = math.radians(finite("swell_direction_deg", get("swell_direction_deg", 0.0)))
    path = get("filename", "")
    if fetch is not None and age is not None:
        raise ValueError(f"fetch = {fetch:g} and inverse_wave_age = {age:g} say the same thing: give one of them")
    components: list[WaveSpectrum] = []
    if spectrum == "table":
        components.append(_read_table(_existing(path, spectrum)))
    elif spectrum in ("elfouhaily", "jonswap", "pierson_moskowitz"):
        if wind_speed == 0:
            logger.info("wind_speed = 0: the sea has no wind waves, only ripples")
        elif spectrum == "elfouhaily":
            omega = 0.84 if age is None else float(age)
            omega = omega if fetch is None else inverse_wave_age(wind_speed, fetch)
            components.append(ElfouhailySpectrum(wind_speed, omega, wind_direction))
        elif spectrum == "jonswap":
            if fetch is None:
                raise ValueError("fetch is missing: the spectrum 'jonswap' needs it, in metres")
            components.append(JonswapSpectrum(wind_speed, fetch, peak_enhancement, wind_direction))
        else:
            components.append(PiersonMoskowitzSpectrum(wind_speed, wind_direction))
    if swell_height > 0:
        if spectrum in ("flat", "height_map"):
            raise ValueError(f"swell_height = {swell_height:g} needs a spectrum of waves, not {spectrum!r}")
        components.append(SwellSpectrum(swell_height, swell_wavelength, swell_direction))
    if not components:
        return None
    return components[0] if len(components) == 1 else SeaState(tuple(components))


def _total(
    state: WaveSpectrum | None, wanted: Any, wind_speed: float, wind_direction: float
) -> tuple[WaveSpectrum | None, tuple[float, float]]:
    """Return the sea state with the slope variances that ``slope_variance`` asks for, and these (along, across)."""
    if wanted == "cox_munk":
        return _matched(state, wind_direction, *cox_munk(wind_speed))
    if wanted == "spectrum":
        waves = state or ElfouhailySpectrum(wind_speed)
        return state, variances_along(waves.slope_covariance(), wind_direction)
    try:
        number = float(wanted)
    except ValueError:
        raise ValueError(f"slope_variance = {wanted!r} must be 'cox_munk', 'spectrum' or a number") from None
    half = 0.5 * in_range("slope_variance", number, 2 * SMALLEST_RIPPLE_VARIANCE, 1.0)
    return state, (half, half)


def _matched(
    state: WaveSpectrum | None, wind_direction: float, along: float, across: float
) -> tuple[WaveSpectrum | None, tuple[float, float]]:
    """Return a sea state whose wind waves have the given slope variances, whatever a mesh resolves, and the total.

    Swell adds to what was measured for the wind; a table is the user's word and is left alone.
    """
    if state is None:
        return None, (along, across)
    components = list(state.components) if isinstance(state, SeaState) else [state]
    if isinstance(components[0], CosineSpectrum):
        components[0] = MatchedSpectrum(components[0], along, across)
    for swell in components:
        if isinstance(swell, SwellSpectrum):
            more = variances_along(swell.slope_covariance(), wind_direction)
            along, across = along + more[0], across + more[1]
    return components[0] if len(components) == 1 else SeaState(tuple(components)), (along, across)


def _period(state: WaveSpectrum) -> float:
    """Return after how many metres the sea repeats itself, unless the user says it."""
    components = state.components if isinstance(state, SeaState) else (state,)
    longest = max(2 * math.pi / component.peak_wavenumber for component in components)
    return min(_LONGEST_PERIOD, _PERIOD_STEP * math.ceil(_PERIOD_WAVELENGTHS * longest / _PERIOD_STEP))


def _cells(name: str, cell: float, period: float) -> int:
    """Return the even number of cells a period that are at most as long as asked."""
    from scipy.fft import next_fast_len

    cells = 2 * int(next_fast_len(max(2, math.ceil(0.5 * period / cell - 1e-9)), real=True))
    if cells > _MOST_CELLS:
        raise ValueError(
            f"{name} = {cell:g} with period = {period:g} needs {cells} cells a side: allowed are {_MOST_CELLS}"
        )
    return cells


def _facet_variance(terrain: HeightMap, wind_direction: float) -> tuple[float, float]:
    """Return the mean-square slopes of a height map's facets along and across the wind."""
    right = np.diff(terrain.heights, axis=1) / (terrain.x[1] - terrain.x[0])
    up = np.diff(terrain.heights, axis=0) / (terrain.y[1] - terrain.y[0])
    cos, sin = math.cos(wind_direction), math.sin(wind_direction)
    # The two triangles of a cell, split from its lower right to its upper left corner.
    pairs = ((right[:-1], up[:, :-1]), (right[1:], up[:, 1:]))
    along = float(np.mean([np.mean((cos * x + sin * y) ** 2) for x, y in pairs]))
    across = float(np.mean([np.mean((cos * y - sin * x) ** 2) for x, y in pairs]))
    return along, across


def _read_ship(get: Get) -> Ship | None:
    """Return the ship whose wake is asked for."""
    speed = in_range("wake_speed", get("wake_speed", 0.0), 0.0, 40.0)
    bearing = math.radians(finite("wake_bearing_deg", get("wake_bearing_deg", 0.0)))
    length = in_range("wake_length", get("wake_length", 20.0), 1.0, 500.0)
    x, y = finite("wake_x", get("wake_x", 0.0)), finite("wake_y", get("wake_y", 0.0))
    return Ship(speed, bearing, length, x, y) if speed > 0 else None


def _read_footprint(get: Get) -> tuple[float, float]:
    """Return the beam's spread across range and the side of the square that beam and field of view need [m]."""
    altitude, divergence = get("altitude", None), get("divergence_mrad", 10.0)
    off_nadir = math.radians(in_range("off_nadir_deg", get("off_nadir_deg", 20.0), 0.0, 89.9))
    field = 1e-3 * positive("field_of_view_mrad", get("field_of_view_mrad", 30.0))
    sigma = 0.5e-3 * positive("divergence_mrad", divergence)
    if altitude is None:
        return _CELLS_PER_SPREAD * _DEFAULT_CELL, (_DEFAULT_SIZE - _SIZE_MARGIN) / _SIZE_PER_FOOTPRINT
    altitude = positive("altitude", altitude)
    slant = altitude / math.cos(off_nadir)
    half = min(max(field / 2, 3 * sigma), math.pi / 4)
    # Towards the horizon a footprint has no end; a patch that ends at four times the range must do.
    far = min(math.tan(min(off_nadir + half, math.radians(89.9))), 4 * math.tan(off_nadir) + 1)
    along = altitude * max(far - math.tan(off_nadir), math.tan(off_nadir) - math.tan(off_nadir - half))
    return slant * sigma, 2 * max(along, slant * math.tan(half))


def _read_length(get: Get, name: str) -> float | None:
    """Return a positive length [m], or None where it is ``auto``."""
    value = get(name, "auto")
    return None if value == "auto" else positive(name, value)


def _read_table(path: str) -> TabulatedSpectrum:
    """Return a user's spectrum from an ``.npz`` file with arrays ``kx``, ``ky`` and ``density``."""
    try:
        with np.load(path) as arrays:
            kx, ky, density = (arrays[name] for name in ("kx", "ky", "density"))
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"filename = {path!r} must be an .npz file with arrays kx, ky and density: {error}") from None
    return TabulatedSpectrum(kx, ky, density)


def _existing(path: str, spectrum: str) -> str:
    if not path:
        raise ValueError(f"filename is missing: the spectrum {spectrum!r} is read from it")
    return path
