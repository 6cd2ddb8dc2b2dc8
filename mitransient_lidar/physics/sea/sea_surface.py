"""A scene's sea surface from its parameters: waves, mesh resolution, and slope variance left to ripples."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.fields import AUTO, Read
from mitransient_lidar.core.validation import FloatArray, IntArray, in_range
from mitransient_lidar.physics.sea.cox_munk import (
    GramCharlierSeries,
    cox_munk,
    crest_heights,
    foam_cover,
    foam_on_crests,
    read_foam_map,
)
from mitransient_lidar.physics.sea.height_maps import HeightMap, map_origin, read_height_map
from mitransient_lidar.physics.sea.kelvin_wake import kelvin_wake
from mitransient_lidar.physics.sea.realization import Motion, PeriodicHeights, realise_heights
from mitransient_lidar.physics.sea.sea_mesh import Footprint, Resolution, SeaMesh, grid_indices, joined, triangulate
from mitransient_lidar.physics.sea.shoaling import (
    BottomDepths,
    DepthResponse,
    ShoalingHeights,
    band_wavenumbers,
    is_limited,
    limited_wake,
    waves_of_time,
)
from mitransient_lidar.physics.sea.wave_spectrum import (
    CosineSpectrum,
    MatchedSpectrum,
    SeaState,
    WaveSpectrum,
    variances_along,
)
from mitransient_lidar.physics.sea.wind_spectra import (
    ElfouhailySpectrum,
    JonswapSpectrum,
    PiersonMoskowitzSpectrum,
    ShallowSpectrum,
    SwellSpectrum,
    inverse_wave_age,
)

logger = logging.getLogger(__name__)

#: Most heights of patches that are computed together: they share.
_TOGETHER = 2**20

#: Smallest slope variance of the ripples along one axis: a perfectly smooth facet has no connection to a point laser.
_LEAST_VARIANCE = 1e-5

#: Unit of the sea period [m], its least length in peak wavelengths, and its largest length [m]. The period does not
#: depend on the resolution, so that a seed defines one sea.
_PERIOD_STEP, _PERIOD_WAVELENGTHS, _LONGEST_PERIOD = 32.0, 3.0, 512.0

DEEP = 1e4  #: Water depth [m] from which no wave notices the bottom.
_CALM = 1e-6  #: Wind speed [m/s] below which there are no waves.

#: Largest number of cells per side in the fine patch, and smallest number per period for waves to be resolved.
_MOST_CELLS, _FEWEST_CELLS = 4096, 16

#: Side of each of several patches with the cells around it [m], and growth of these.
_SIZE_OF_PATCH, _GROWTH_OF_PATCH = 200.0, 2.0

_LEVEL_LINES = (-0.5, 0.25, 0.5), (-0.5, 0.5)  #: Grid lines along x and y of a level sea, over its size.
_CREST_SAMPLES = 512  #: Places on each side of a period by which the highest crests are found.
_MOST_HEIGHTS = 2**24  #: Most heights of seas at other times that are kept.

Wake = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True)
class SeaSurface:
    """A sea surface with its resolution. Pairs of slope variances are along and across the wind [1]."""

    spectrum: str  #: Name of the wave source.
    wind_speed: float  #: Wind at 10 m [m/s].
    wind_direction: float  #: Direction that the wind blows towards [rad], counter-clockwise from +x.
    waves: PeriodicHeights | ShoalingHeights | HeightMap | None  #: Elevations, None for a flat sea.
    cell_size: float  #: Cell side in the fine patch [m], infinite for a flat sea.
    centre: tuple[float, float]  #: Patch position [m].
    refined_size: float  #: Patch side [m].
    size: float  #: Side of the whole surface [m].
    resolved_variance: tuple[float, float]  #: Facet slope variances.
    ripple_variance: tuple[float, float]  #: Ripple slope variances.
    wake: Wake | None  #: Heights of a ship's wake [m] on grid lines x and y [m], None without a ship.
    shortest_wave: float  #: Shortest wavelength [m], two cells in coarse ones.
    beam_wave: float  #: Shortest wavelength that the beam alone needs [m], at least the sea's.
    slope_series: GramCharlierSeries | None = None  #: Slope series of the ripples, None for Gaussian slopes.
    #: Spectrum of waves and ripples that focus light; None without a spectrum that has both, or if they shall not.
    focusing_spectrum: SeaState | None = None
    #: Elevations of the same waves at a time [s]; None for waves that do not move.
    waves_at: Callable[[float], PeriodicHeights | ShoalingHeights] | None = None
    slope: tuple[float, float] = (0.0, 0.0)  #: Mean slopes along x and y within the patch [1].
    foam: float = 0.0  #: Share of the sea with foam [1].
    surf_foam: float = 0.0  #: Share with surf foam, where the depth limits the waves [1].
    foam_map: HeightMap | None = None  #: Map of more foam [1].

    @classmethod
    def read(
        cls,
        read: Read,
        footprints: Sequence[Footprint] = (),
        is_placeholder: bool = False,
        depths: BottomDepths | None = None,
    ) -> SeaSurface:
        """Build a sea from the parameters of the plugin ``ocean_surface``.

        Raises UserError if a parameter is out of range, or a file cannot be read.

        `read`: parameter reader. `footprints`: footprints of the lasers and receivers above the sea, for its automatic
        values. `is_placeholder`: whether to check the parameters only, and return a sea without waves. `depths`: depths
        that waves shall follow (see `followed_depths`), None for deep water.
        """
        spectrum, wind_speed = read("spectrum"), read("wind_speed")
        wind_speed = wind_speed if wind_speed >= _CALM else 0.0
        wind_direction, current_direction = (
            math.radians(read(name)) for name in ("wind_direction_deg", "current_direction_deg")
        )
        state = _read_waves(read, spectrum, wind_speed, wind_direction)
        foam, surf_foam = read("foam"), read("surf_foam")
        if read("shoaling") == "bottom" and spectrum in ("flat", "height_map"):
            raise UserError(f"shoaling = 'bottom' needs a spectrum of waves, not {spectrum!r}")
        if surf_foam > 0 and foam == "none":
            raise UserError(f"surf_foam = {surf_foam:g} needs foam: give its cover of the open sea, 0 or more")
        slope_variance, seed, time, current = map(read, ("slope_variance", "surface_seed", "time", "current_speed"))
        wake = _read_wake(read)
        slope = tuple(math.tan(math.radians(read(name))) for name in ("slope_x_deg", "slope_y_deg"))
        resolution = Resolution.read(read, footprints)
        period, map_size = (None if value == AUTO else value for value in map(read, ("period", "map_size")))
        depth, path, focuses = read("water_depth"), read("filename", ""), read("ripple_focusing")
        origin, foam_path = map_origin(read), read("foam_map", "")
        series = _read_series(read("slope_distribution"), slope_variance, wind_speed)

        state, total = _with_total_variance(state, slope_variance, wind_speed, wind_direction)
        waves: PeriodicHeights | ShoalingHeights | HeightMap | None = None
        waves_at, resolved = None, (0.0, 0.0)
        centre, cell, refined_size = resolution.centre, resolution.cell_size, resolution.refined_size
        if wake is not None and depths is not None:
            wake = limited_wake(wake, depths)
        if is_placeholder:
            cell, wake, slope = math.inf, None, (0.0, 0.0)
        elif state is not None:
            longest = max(2 * math.pi / component.peak_wavenumber for component in state.components)
            automatic = _PERIOD_STEP * math.ceil(_PERIOD_WAVELENGTHS * longest / _PERIOD_STEP)
            period = period or min(_LONGEST_PERIOD, automatic)
            if cell <= period / _FEWEST_CELLS or read("cell_size") != AUTO:
                drift = current * math.cos(current_direction), current * math.sin(current_direction)
                motion = Motion(time, depth, drift)
                _check_number_of_cells(refined_size, cell)
                bands = None if depths is None else band_wavenumbers(state, resolution.shortest_wave)
                given, rest = (state, period, cell, seed), (resolution.shortest_wave, bands)
                waves, cell, resolved = realise_heights(*given, motion, wind_direction, *rest)
                bottom = None
                if depths is not None and bands is not None:
                    bottom = DepthResponse.of_state(state, bands), depths
                    waves = ShoalingHeights(waves, *bottom)
                waves_at = partial(waves_of_time, given, motion, rest, bottom)
            elif wake is None and not any(slope):
                cell = math.inf
        elif spectrum == "height_map":
            if not path:
                raise UserError("filename is missing: the spectrum 'height_map' is read from it")
            waves = terrain = read_height_map(path, map_size, origin)
            cell = float(terrain.x[1] - terrain.x[0])
            refined_size = float(terrain.x[-1] - terrain.x[0])
            middle = tuple(0.5 * float(lines[0] + lines[-1]) for lines in (terrain.x, terrain.y))
            is_free = [read(name) == AUTO for name in ("centre_x", "centre_y")]
            centre = (middle[0] if is_free[0] else centre[0], middle[1] if is_free[1] else centre[1])
            _check_number_of_cells(refined_size, cell)
            resolved = terrain.facet_variance(wind_direction)
        elif wake is None and not any(slope):
            cell = math.inf
        else:
            _check_number_of_cells(refined_size, cell)
        ripples = (max(_LEAST_VARIANCE, total[0] - resolved[0]), max(_LEAST_VARIANCE, total[1] - resolved[1]))
        lengths = (0.0, 0.0) if spectrum == "height_map" else (resolution.shortest_wave, resolution.beam_wave)
        shortest, beam_wave = (max(wave, 2 * cell) for wave in lengths)
        # Swell has no ripples of its own.
        is_whole = state is not None and isinstance(state.components[0], CosineSpectrum)
        if series is not None:
            series = series.of_part(cox_munk(wind_speed), ripples)
        if series is not None and not is_placeholder:
            shares = (f"{100 * one / both:.0f}" for one, both in zip(ripples, total, strict=True))
            series.require_positive(
                f"they have {' and '.join(shares)} % of the slope variances along and across the wind: give a longer "
                f"shortest_wave than {shortest:.3g} m"
            )
        patch, size = min(refined_size, resolution.size), resolution.size
        return cls(
            *(spectrum if waves is not None else "flat", wind_speed, wind_direction, waves, cell, centre, patch, size),
            *(resolved, ripples, wake, shortest, beam_wave, series, state if focuses and is_whole else None),
            waves_at,
            (slope[0], slope[1]),
            foam_cover(foam, wind_speed),
            surf_foam,
            read_foam_map(foam_path, map_size, origin) if foam_path else None,
        )

    def at(self, time: float) -> SeaSurface:
        """Return the sea at a time [s]; a wake, a height map and a sea without waves stay."""
        if self.waves_at is None:
            return self
        if time not in self._later:
            waves = self._crested
            each = waves.size if isinstance(waves, PeriodicHeights) else _MOST_HEIGHTS
            if self._later and (len(self._later) + 1) * each > _MOST_HEIGHTS:
                del self._later[next(iter(self._later))]
            self._later[time] = replace(self, waves=self.waves_at(time))
        return self._later[time]

    @cached_property
    def _later(self) -> dict[float, SeaSurface]:
        """Seas at the times that were asked for last."""
        return {}

    @property
    def slope_variance(self) -> float:
        """Total slope variance of waves and ripples, both axes [1]."""
        return sum(self.resolved_variance) + sum(self.ripple_variance)

    def mesh(self, origin: Sequence[float] | FloatArray = (0.0, 0.0)) -> SeaMesh:
        """Return the triangle mesh relative to a place [m]: the fine patch, and cells that grow out to the size."""
        at_x, at_y = origin[:2]
        if not math.isfinite(self.cell_size):
            # No edge is near the centre: rays pass between triangles of a kilometre in a gap of micrometres.
            x, y = (np.array(ends) * self.size + at for ends, at in zip(_LEVEL_LINES, self.centre, strict=True))
            mesh = triangulate(np.zeros((len(y), len(x))), x - at_x, y - at_y, self.wind_direction)
            return self._with_foam(mesh, x, y)
        cells = max(2, 2 * math.ceil(0.5 * self.refined_size / self.cell_size))
        indices = grid_indices(cells, math.ceil(self.size / self.cell_size))
        return self._patch(self.centre, indices, (at_x, at_y), (0.0, 0.0))

    def _patch(
        self, centre: Sequence[float] | FloatArray, indices: IntArray, away: Sequence[float], moved: Sequence[float]
    ) -> SeaMesh:
        """Return the mesh about a centre on cells of the sea, from the place `away` moved to another one [m]."""
        # Integer cells: the sea does not depend on the position of the patch.
        x, y = (np.asarray((indices + round(at / self.cell_size)) * self.cell_size, np.float64) for at in centre)
        lines = (x - away[0] + moved[0], y - away[1] + moved[1])
        return self._with_foam(triangulate(self.heights_about(centre, x, y), *lines, self.wind_direction), x, y)

    def patches(
        self, places: FloatArray, refined_size: float, seas: Iterable[SeaSurface]
    ) -> tuple[SeaMesh, FloatArray]:
        """Return the mesh with fine patches about locations, and the position of each location in it.

        The patches lie side by side on a square lattice about the origin, each surrounded by cells that grow out to
        `_SIZE_OF_PATCH` or the sea's size.

        `places`: sea locations (x, y) [m], shape (n, 2). `refined_size`: side of each fine patch [m]. `seas`: the sea
        at each location's time.

        Returns `mesh`: all patches. `positions`: positions (x, y) of the locations in it [m], shape (n, 2).
        """
        cells = max(2, 2 * math.ceil(0.5 * refined_size / self.cell_size))
        size = max(refined_size, min(self.size, max(_SIZE_OF_PATCH, 2 * refined_size)))
        indices = grid_indices(cells, math.ceil(size / self.cell_size), _GROWTH_OF_PATCH, len(places))
        side = math.ceil(math.sqrt(len(places)))
        stride = (indices[-1] - indices[0] + 2) * self.cell_size
        number = np.arange(len(places))
        positions = stride * (np.stack([number % side, number // side], axis=-1) - 0.5 * (side - 1))
        each = zip(places, positions, seas, strict=True)
        return joined([sea._patch(place, indices, place, moved) for place, moved, sea in each]), positions

    @property
    def line_distance(self) -> float:
        """Distance of grid lines [m]: the side of a cell, 1 m for a level sea."""
        return self.cell_size if np.isfinite(self.cell_size) else 1.0

    def height_patches(
        self, places: FloatArray, refined_size: float, seas: Iterable[SeaSurface]
    ) -> tuple[FloatArray, FloatArray]:
        """Return elevations [m] on grid lines about places, shape (n, along y, along x), and first x, y of each [m].

        The fine patches of `patches`, of the same arguments.
        """
        cell = self.line_distance
        half = max(1, math.ceil(0.5 * refined_size / cell))
        lines = (np.round(places / cell)[..., None] + np.arange(-half, half + 1)) * cell
        each = list(seas)
        heights = np.zeros((len(places), 2 * half + 1, 2 * half + 1))
        together = max(_TOGETHER // heights[0].size, 1) if np.isfinite(self.cell_size) else 0
        # Patches at one time of the sea together.
        for _, of_sea in itertools.groupby(range(len(places) if together else 0), lambda row: id(each[row])):
            rows = list(of_sea)
            for first in range(0, len(rows), together):
                some = slice(rows[first], rows[0] + min(first + together, len(rows)))
                heights[some] = each[rows[0]].heights_about(places[some], lines[some, 0], lines[some, 1])
        return heights, np.asarray(lines[..., 0], np.float64)

    def heights(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return elevations [m] on grid lines x and y [m], integer multiples of the cells, shape (len(y), len(x)).

        Lines of several patches, shapes (n, len(x)) and (n, len(y)), give theirs, shape (n, len(y), len(x)).
        """
        if x.ndim > 1 and (self.wake is not None or isinstance(self.waves, HeightMap)):
            return np.array([self.heights(*lines) for lines in zip(x, y, strict=True)])
        heights = np.zeros((*y.shape, x.shape[-1])) if self.waves is None else self.waves.sample(x, y)
        return heights if self.wake is None else heights + self.wake(x, y)

    @property
    def has_foam(self) -> bool:
        """Whether faces may have foam."""
        return self.foam > 0 or self.surf_foam > 0 or self.foam_map is not None

    @property
    def _crested(self) -> PeriodicHeights | HeightMap | None:
        """Waves whose crests have foam: the waves over deep water, with the same crests."""
        return self.waves.waves if isinstance(self.waves, ShoalingHeights) else self.waves

    @cached_property
    def _all_crests(self) -> FloatArray:
        """Crests of places on a period or a height map [m], shape (n,)."""
        waves = self._crested
        if waves is None:
            return np.zeros(1)
        if isinstance(waves, HeightMap):
            lines = waves.x, waves.y
        else:
            ticks = np.unique(np.rint(np.linspace(0, waves.cells, _CREST_SAMPLES, endpoint=False))) * waves.cell_size
            lines = ticks, ticks
        return crest_heights(waves.sample, *lines).ravel()

    def _with_foam(self, mesh: SeaMesh, x: FloatArray, y: FloatArray) -> SeaMesh:
        """Return a mesh on the sea's grid lines [m] with the foam on its faces, the mean over their corners."""
        if not self.has_foam:
            return mesh
        shape, waves = (len(y), len(x)), self._crested
        crests = np.zeros(shape) if waves is None else crest_heights(waves.sample, x, y)
        cover = np.full(shape, self.foam)
        if isinstance(self.waves, ShoalingHeights):
            cover += (max(self.surf_foam, self.foam) - self.foam) * self.waves.broken(x, y)
        share = foam_on_crests(crests, self._all_crests, cover)
        if self.foam_map is not None:
            inside = self.foam_map.covers(*np.meshgrid(x, y))
            share = np.maximum(share, np.where(inside, self.foam_map.sample(x, y), 0.0))
        return replace(mesh, foam=share.ravel()[mesh.faces].mean(axis=1))

    def heights_about(self, place: Sequence[float] | FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return `heights` under a lidar that is aimed at a place (x, y) [m], or each patch's place (n, 2), inclined.

        The plane of the mean slope turns about the place and is as wide as the patch; beyond it the sea is level.
        """
        heights = self.heights(x, y)
        if not any(self.slope):
            return heights
        reach, middle = 0.5 * self.refined_size, np.asarray(place)
        dx, dy = (np.clip(lines - middle[..., axis, None], -reach, reach) for axis, lines in enumerate((x, y)))
        return np.asarray(heights + self.slope[0] * dx[..., None, :] + self.slope[1] * dy[..., :, None])


def _read_waves(read: Read, spectrum: str, wind_speed: float, wind_direction: float) -> SeaState | None:
    """Return the sea state of the parameters, None for a flat sea or a height map."""
    fetch, age, peak_enhancement = map(read, ("fetch", "inverse_wave_age", "peak_enhancement"))
    swell_height, swell_wavelength = read("swell_height"), read("swell_wavelength")
    swell_direction = math.radians(read("swell_direction_deg"))
    components: list[WaveSpectrum] = []
    if spectrum in ("elfouhaily", "jonswap", "pierson_moskowitz"):
        if wind_speed == 0:
            logger.info("wind_speed = 0: the sea has no wind waves, only ripples")
        else:
            deep: CosineSpectrum
            if spectrum == "elfouhaily":
                omega = 0.84 if age is None else float(age)
                omega = omega if fetch is None else inverse_wave_age(wind_speed, fetch)
                deep = ElfouhailySpectrum(wind_speed, omega, wind_direction)
            elif spectrum == "jonswap":
                if fetch is None:
                    raise UserError("fetch is missing: the spectrum 'jonswap' needs it, in metres")
                deep = JonswapSpectrum(wind_speed, fetch, peak_enhancement, wind_direction)
            else:
                deep = PiersonMoskowitzSpectrum(wind_speed, wind_direction)
            # Waves that follow the bottom have the water's depth for dispersion alone.
            depth = DEEP if read("shoaling") == "bottom" else read("water_depth")
            components.append(deep if depth >= DEEP else ShallowSpectrum(deep, depth))
    if swell_height > 0:
        if spectrum in ("flat", "height_map"):
            raise UserError(f"swell_height = {swell_height:g} needs a spectrum of waves, not {spectrum!r}")
        components.append(SwellSpectrum(swell_height, swell_wavelength, swell_direction))
    return SeaState(tuple(components)) if components else None


def followed_depths(read: Read, depths: BottomDepths | None) -> BottomDepths | None:
    """Return the bottom depths that the waves of an ``ocean_surface`` follow, None if they need not.

    Waves follow them with the parameter ``shoaling``, and with ``auto`` if the significant height over deep water would
    exceed half the least depth.
    """
    shoaling, spectrum = read("shoaling"), read("spectrum")
    if depths is None or shoaling == "none" or spectrum in ("flat", "height_map"):
        return None
    if shoaling == "bottom":
        return depths
    if read("water_depth") < DEEP:
        return None
    wind = read("wind_speed")
    state = _read_waves(read, spectrum, wind if wind >= _CALM else 0.0, 0.0)
    if state is None or not is_limited(state, depths):
        return None
    logger.info("the waves follow the depth of the bottom, which rises to z = %.3g m (shoaling)", -depths.least)
    return depths


def _read_series(distribution: str, slope_variance: Any, wind_speed: float) -> GramCharlierSeries | None:
    """Return the series for all sea slopes, None for Gaussian ones."""
    if distribution == "gaussian":
        return None
    if slope_variance != "cox_munk":
        raise UserError(
            f"slope_distribution = 'gram_charlier' needs the slope_variance 'cox_munk', not {slope_variance!r}"
        )
    return GramCharlierSeries.of_clean_sea(wind_speed)


def _with_total_variance(
    state: SeaState | None, slope_variance: Any, wind_speed: float, wind_direction: float
) -> tuple[SeaState | None, tuple[float, float]]:
    """Return the sea state for a parameter ``slope_variance``, and its total slope variances along and across."""
    if slope_variance == "cox_munk":
        return _matched(state, wind_direction, *cox_munk(wind_speed))
    if slope_variance == "spectrum":
        waves = state or ElfouhailySpectrum(wind_speed)
        return state, variances_along(waves.slope_covariance(), wind_direction)
    try:
        number = float(slope_variance)
    except ValueError:
        raise UserError(f"slope_variance = {slope_variance!r} must be 'cox_munk', 'spectrum' or a number") from None
    half = 0.5 * in_range("slope_variance", number, 2 * _LEAST_VARIANCE, 1.0)
    return state, (half, half)


def _matched(
    state: SeaState | None, wind_direction: float, along: float, across: float
) -> tuple[SeaState | None, tuple[float, float]]:
    """Return a sea state whose wind waves have the slope variances, and the total with swell."""
    if state is None:
        return None, (along, across)
    components = list(state.components)
    if isinstance(components[0], CosineSpectrum):
        components[0] = MatchedSpectrum(components[0], along, across)
    for swell in components:
        if isinstance(swell, SwellSpectrum):
            more = variances_along(swell.slope_covariance(), wind_direction)
            along, across = along + more[0], across + more[1]
    return SeaState(tuple(components)), (along, across)


def _check_number_of_cells(refined_size: float, cell: float) -> None:
    """Refuse a patch with too many cells."""
    if refined_size / cell > _MOST_CELLS:
        raise UserError(
            f"refined_size = {refined_size:g} with cell_size = {cell:g} needs {refined_size / cell:.0f} cells per "
            f"side but at most {_MOST_CELLS} are allowed"
        )


def _read_wake(read: Read) -> Wake | None:
    """Return a ship's wake as a function of grid lines, None without a ship."""
    speed, length, x, y = map(read, ("wake_speed", "wake_length", "wake_x", "wake_y"))
    bearing = math.radians(read("wake_bearing_deg"))
    wake = partial(kelvin_wake, speed=speed, bearing=bearing, length=length, ship_x=x, ship_y=y)
    return wake if speed else None
