"""Forecast of a survey: where the bottom of a site is found, how well, and down to which depth."""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import xarray as xr

from mitransient_lidar._version import release
from mitransient_lidar.analysis.depth_uncertainty import (
    LEAST_FOUND,
    SURVEY_ORDERS,
    TrajectoryErrors,
    order_met,
    sounding_uncertainty,
)
from mitransient_lidar.analysis.receiver import SATURATING, detect_waveforms, receiver_of_result, shared_settings
from mitransient_lidar.analysis.waveforms import depth_correction
from mitransient_lidar.analysis.waveforms.echo_detection import has_echo
from mitransient_lidar.analysis.waveforms.echo_table import extract
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import checked_path
from mitransient_lidar.core.formats.array_files import readable_suffix
from mitransient_lidar.core.maps import read_geotiff, write_geotiff
from mitransient_lidar.core.options import Option, checked
from mitransient_lidar.core.parameters.fields import is_green
from mitransient_lidar.core.tables.written import table_lines
from mitransient_lidar.core.validation import FloatArray, positive, shown
from mitransient_lidar.loading.catalogue import read_instrument
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.physics.receiver.receiver_files import ReceiverChannels
from mitransient_lidar.physics.sea.height_maps import HeightMap, read_height_map
from mitransient_lidar.rendering.passes import ProgressCallback
from mitransient_lidar.rendering.shots.batches import ShotPoses
from mitransient_lidar.rendering.shots.scene import PILOTS, ShotScene, pilots_over, rendered
from mitransient_lidar.rendering.shots.series import render_shots
from mitransient_lidar.rendering.shots.truth import sea_of, truth_coordinates
from mitransient_lidar.results.attributes import label, uninterrupted
from mitransient_lidar.results.files import Given
from mitransient_lidar.studies import depth_bias
from mitransient_lidar.studies.cases import Cases
from mitransient_lidar.transport.light_maps.suitability import reach_of_scattering
from mitransient_lidar.transport.scene_parts import find_lidar_scene

#: Largest ratio of neighbouring depths in tables, and where the share of found bottoms falls; that of waters.
_COARSE, _FINE, _WATERS = 1.25, 1.07, 1.4

#: Shallowest bottom of a table, and the deepest of its first part [m]; ratio of the deepest of further parts.
_SHALLOWEST, _FIRST, _FURTHER = 0.5, 15.0, 1.6

#: Largest error of a bottom that is found [m]; shares of found bottoms that count as none and as all.
_RIGHT, _NONE, _ALL = 1.0, 0.05, 0.98

#: Farthest place on the sea from its origin along x and y [m]; estimator of depths, as that of flights.
_FARTHEST, _ESTIMATOR = 200.0, "gaussian"

_WAVELENGTH = 532.0  #: Wavelength of waters by name, which is that of the table of any green instrument [nm].

_LOG = logging.getLogger(__name__)

#: Passes of light maps, as in flights, relative standard error of renders below their reach, and depths of a range.
_PASSES, _ERROR, _IN_RANGE = 2, 0.05, 200

#: Bands of the maps, and the order that stands for land.
_BANDS, _LAND = ("found", "tvu", "thu", "order", "deepest"), -2


@dataclass(frozen=True)
class _Site:
    """Depths of a site [m], 0 or less on land, NaN without data, over dimensions with coordinates [m].

    `terrain` is its map; None for a range of depths.
    """

    depth: FloatArray
    coords: Mapping[str, FloatArray]
    terrain: HeightMap | None = None

    @classmethod
    def of(cls, given: str | os.PathLike[str], values: str | None) -> _Site:
        """Read a map, or a range of depths such as ``1:20``."""
        low, colon, high = str(given).partition(":")
        if colon and not Path(given).exists():
            try:
                first, last = positive("site", float(low)), positive("site", float(high))
            except ValueError:
                raise UserError(f"site = {given!r} must be a map, or a range of depths such as 1:20") from None
            if values is not None:
                raise UserError(f"values = {shown(values)} needs a map: site = {given!r} is a range of depths")
            depths = np.linspace(min(first, last), max(first, last), _IN_RANGE)
            return cls(depths, {"depth": depths})
        terrain = read_height_map(checked_path("site", given), values=values, holes="keep")
        return cls(-terrain.heights, {"y": terrain.y, "x": terrain.x}, terrain)

    def water(self, name: str, given: Any) -> FloatArray:
        """Return a number, or a GeoTIFF of it by its path, in the cells of the site; NaN outside that map."""
        with contextlib.suppress(TypeError, ValueError):
            given = float(given)
        if isinstance(given, float):
            return np.where(np.isfinite(self.depth), positive(name, given), np.nan)
        terrain = self.terrain
        if terrain is None or terrain.origin is None:
            raise UserError(f"{name} = {given!r} must be a number, unless the site is a map in map coordinates")
        path = checked_path(name, given)
        readable_suffix(path, (".tif", ".tiff"), f"map of {name}")
        grid = read_geotiff(path)
        assert grid.centre is not None
        system, other = terrain.system, grid.stated.system
        if system is not None and other is not None and not system.distance_from(other, *terrain.origin) < 1:
            raise UserError(f"{name} = {given!r} has coordinates in {other.name}, but the site in {system.name}")
        from scipy.interpolate import RegularGridInterpolator

        lines = [grid.positions[axis] + grid.centre[number] for number, axis in ((1, "y"), (0, "x"))]
        of_map = RegularGridInterpolator(lines, grid.values, "nearest", bounds_error=False, fill_value=np.nan)
        y, x = np.meshgrid(terrain.y + terrain.origin[1], terrain.x + terrain.origin[0], indexing="ij")
        return np.where(np.isfinite(self.depth), of_map((y, x)), np.nan)


@checked
@alone
def forecast(
    instrument: depth_bias.InstrumentName,
    site: Annotated[
        str | os.PathLike[str],
        Option(
            "Map of heights or depths, such as a GeoTIFF, or a range of depths LOW:HIGH", form="SITE", is_argument=True
        ),
    ],
    params: Mapping[str, Any] | None = None,
    *,
    secchi: Annotated[
        Any, Option("Secchi depth of the water, or a GeoTIFF of it", unit="m", form="NUMBER|FILE")
    ] = None,
    kd: Annotated[Any, Option("Diffuse attenuation, or a GeoTIFF of it", unit="1/m", form="NUMBER|FILE")] = None,
    values: Annotated[str | None, Option("Whether the map has heights or depths, by default as it states")] = None,
    scene: depth_bias.SeaScene = "table1",
    receiver: depth_bias.OwnReceiver = None,
    corrections: Annotated[
        Given | None, Option("Table from depth-bias that corrects the depths, auto for the shipped one", form="FILE")
    ] = None,
    shots: depth_bias.Places = 24,
    records: depth_bias.Records = 2,
    pointing_mrad: depth_bias.Pointing = 0.1,
    position_m: depth_bias.PositionError = 0.05,
    height_m: depth_bias.HeightError = 0.05,
    seed: depth_bias.SeaSeed = 1,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Forecast where an instrument finds the bottom of a site, how well, and down to which depth.

    Parameters
    ----------
    site
        A map as of `physics.sea.height_maps.read_height_map`, whose cells without data stay so; or a range of depths.
    params, scene
        A scene with a flat bottom and the parameters ``bottom_depth`` and, unless the sea is level, ``wind_speed``;
        waters are all of ``layered_water``. Altitude and angle from nadir are the instrument's unless they are given.
    secchi, kd
        Secchi depth [m] or Kd [1/m] instead of the water of `params`, at most one of them. Of a map, the table has
        waters at ratios of at most 1.4.
    corrections
        As of `depth_correction.correct_depths`.
    pointing_mrad, position_m, height_m
        As for `depth_bias.tpu`.

    Returns
    -------
    xarray.Dataset
        Over ``y`` and ``x`` of the map [m], or ``depth`` of the range: ``depth`` [m], negative on land; ``found``, the
        probability that a pulse's best channel finds the bottom to within 1 m; ``tvu`` and ``thu`` [m] at 95 % with the
        ``order`` that they meet, where at least half of the bottoms are found; and ``deepest``, the depth to which
        these are found in the water of the cell [m], NaN if it lies below the table. All are NaN without data, above
        0.5 m, and on land, where the order is -2; it is -1 where the bottom is lost. The table is in ``table_depth``,
        ``table_found`` and ``table_tvu``, over ``water`` and ``node``; the receiver's gain in the attribute ``gain``,
        and ``saturating_share``, the share of pulses that may saturate if it is automatic.

    Raises
    ------
    UserError
        If the instrument, site, water or a parameter is invalid, both waters are given, or no cell is deep enough.

    Notes
    -----
    Bottoms at depths of at most 1.25 times each other, 1.07 times where they get lost, lie under the same places of one
    sea. Their light is looked up in maps (`transport.light_maps.renderer`), or below the reach of these merged, and
    recorded and searched for echoes as in flights. Automatic gains are chosen as those of flights, for 128 pilot pulses
    over the depths of the site. Depths go on until no bottom is found, or to the deepest cell. Between waters, numbers
    are interpolated at the same product of depth and Kd, or ratio of depth to Secchi depth.
    """
    laser = next(float(one.value) for one in read_instrument(instrument).parameters if one.name == "wavelength_nm")
    if not is_green(laser):
        raise UserError(f"instrument = {instrument!r} has wavelength_nm = {laser:g}: forecasts are of green light")
    if "bottom_depth" in (params or {}):
        raise UserError("parameter bottom_depth follows from the site: leave it out")
    if secchi is not None and kd is not None:
        raise UserError(f"secchi = {secchi} and kd = {kd} are alternatives: give one of them")
    given, name = (kd, "kd") if secchi is None else (secchi, "secchi")
    deep = (place := _Site.of(site, values)).depth >= _SHALLOWEST
    if not deep.any():
        highest = float(np.nanmax(place.depth, initial=-np.inf))
        raise UserError(
            f"site = {str(site)!r} must be deeper than {_SHALLOWEST} m somewhere, but is {highest:.3g} m deep"
        )
    water = np.where(deep, 1.0, np.nan) if given is None else place.water(name, given)
    deep &= np.isfinite(water)
    if not deep.any():
        raise UserError(f"{name} = {given!r} must cover cells of the site that are deeper than {_SHALLOWEST} m")
    waters = _nodes(float(water[deep].min()), float(water[deep].max()), _WATERS)
    table = None if corrections is None else depth_correction.corrections_for(instrument, corrections)
    tables: list[xr.Dataset] = []
    cases = Cases(waters.tolist(), "waters", unit="water", progress=progress)
    for one in cases:
        own = {"wavelength_nm": _WAVELENGTH, **(params or {}), **({} if given is None else {name: one})}
        bottoms = _Bottoms(instrument, scene, own, receiver, shots, records, seed)
        found = bottoms.table(place.depth[deep], _WATERS if len(waters) > 1 else 1.0, table)
        tables.append(cases.keep(sounding_uncertainty(found, TrajectoryErrors(pointing_mrad, position_m, height_m))))
        cases.step()
    dims = tuple(place.coords)
    maps = {key: (dims, values) for key, values in _maps(place.depth, water, deep, waters, tables, name).items()}
    count = max(one.sizes["depth"] for one in tables)
    for key in ("depth", "found", "tvu"):
        rows = [np.pad(_row(one, key), (0, count - one.sizes["depth"]), constant_values=np.nan) for one in tables]
        maps[f"table_{key}"] = ("water", "node"), np.array(rows)
    if "depth" not in place.coords:
        maps["depth"] = dims, place.depth
    of_table = ("instrument", "altitude", "off_nadir_deg", "wind_speed", "gain")
    attributes = {key: tables[0].attrs[key] for key in of_table} | {
        **{"pointing_mrad": pointing_mrad, "position_m": position_m, "height_m": height_m, "seed": seed},
        **{"title": f"Forecast of {instrument}", "source": release(), "site": str(site)},
        **{"shots": shots, "records": records, "saturating_share": SATURATING},
        "water": "" if given is None else f"{name} {given}",
    }
    if place.terrain is not None and place.terrain.origin is not None:
        attributes["map_origin"] = place.terrain.origin
        attributes["map_system"] = getattr(place.terrain.system, "wkt", None) or ""
    result = label(xr.Dataset(maps, {**place.coords, "water": waters}, attributes), "forecast")
    flags = np.array([_LAND, -1, *range(len(SURVEY_ORDERS) + 1)], float)
    meanings = " ".join(["land", "lost", *(one.name for one in SURVEY_ORDERS), "none"])
    return result.assign(order=result["order"].assign_attrs(flag_values=flags, flag_meanings=meanings))


def write_maps(found: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write the maps of a result of `forecast` as bands of a GeoTIFF; none of a range of depths."""
    if "map_origin" in found.attrs:
        bands = {name: found[name].values for name in _BANDS}
        x, y = (found[axis].values + start for axis, start in zip("xy", found.attrs["map_origin"], strict=True))
        write_geotiff(path, bands, x, y, found.attrs["map_system"])


def describe_forecast(found: xr.Dataset) -> list[str]:
    """Return table lines for a result of `forecast`: shares of cells by the order that they meet, and a sentence.

    Shares are of cells with data and water that are deeper than 0.5 m.
    """
    order, chance = found["order"].values, found["found"].values
    depth, wet = found["depth"].values, np.isfinite(chance)
    names = [*(one.name for one in SURVEY_ORDERS), "none"]
    rows = [(f"order {name}", np.mean(order[wet] == number)) for number, name in enumerate(names)]
    rows.append(("bottom lost", np.mean(order[wet] < 0)))
    lines = table_lines([("cells", "<18"), ("share", ">7.1%")], rows)
    dry, shallow = depth <= 0, (depth > 0) & (depth < _SHALLOWEST)
    unknown = ~wet & ~dry & ~shallow
    for text, cells in (("are land", dry), (f"are shallower than {_SHALLOWEST} m", shallow), ("have no data", unknown)):
        if cells.any():
            lines.append(f"{np.count_nonzero(cells)} of {depth.size} cells {text}")
    return [*lines, _sentence(found)]


def _sentence(found: xr.Dataset) -> str:
    """Return what a forecast says in one sentence."""
    order, chance, depth = (found[name].values for name in ("order", "found", "depth"))
    what = "site" if "y" in found.dims else "range of depths"
    seen = (wet := np.isfinite(chance)) & (chance >= LEAST_FOUND)
    if not seen.any():
        return f"the bottom is found nowhere in the {what}"
    lost = found["deepest"].values[wet & np.isfinite(found["deepest"].values)]
    names = [one.name for one in SURVEY_ORDERS]
    known = [np.mean((order[wet] >= 0) & (order[wet] <= number)) for number in range(len(names))]
    usual = names.index("1a/1b")
    if known[usual]:
        text = f"{100 * known[usual]:.0f} % of the {what} meets order {names[usual]}"
    elif known[-1]:
        text = f"no part of the {what} meets order {names[usual]}, and {100 * known[-1]:.0f} % order {names[-1]}"
    else:
        text = f"no part of the {what} meets any order"
    deepest = float(depth[seen].max())
    if not (wet & ~seen).any():
        return f"{text}; the bottom is found down to the deepest place, {deepest:.1f} m"
    if not lost.size:
        return f"{text}; the bottom is lost at some places, the deepest that is found is {deepest:.1f} m"
    low, high = float(lost.min()), float(lost.max())
    return f"{text}; beyond {low:.1f}{f' to {high:.1f}' if high - low > 0.1 else ''} m the bottom is lost"


@dataclass
class _Bottoms:
    """Bottoms under the same places of a sea, recorded and measured; parameters as of `forecast`."""

    instrument: str
    scene: str
    params: Mapping[str, Any]
    receiver: str | None
    shots: int
    records: int
    seed: int

    def __post_init__(self) -> None:
        self._places = np.random.default_rng(self.seed).uniform(-_FARTHEST, _FARTHEST, (self.shots, 2))
        session = open_scene(self.scene, self.params, self.instrument)
        self._reach = reach_of_scattering(find_lidar_scene(session.scene, session.sensor))
        own = xr.Dataset(attrs={"instrument": self.instrument})
        self._receiver: ReceiverChannels = receiver_of_result(own, self.receiver)
        self._scenes: dict[tuple[float, str], ShotScene] = {}
        self._sea: dict[float, Any] = {}
        self._attributes: dict[str, Any] = {}
        self._pixels: list[str] = []

    def table(self, site: FloatArray, further: float, corrections: xr.Dataset | None) -> xr.Dataset:
        """Return a table as of `depth_bias.depth_bias` with the depths that a site needs [m], to a factor further."""
        cells: dict[float, dict[str, Any]] = {}
        low, high = float(site.min()), further * float(site.max())
        top, deepest = low, min(high, _FIRST, max(self._reach, low))
        if high > self._reach:
            text = "light maps reach %.3g m in this water: deeper bottoms are merged, one by one"
            _LOG.info(text, self._reach)
        self._choose_settings(site, deepest)
        while True:
            nodes = [one for one in _nodes(top, deepest, _COARSE).tolist() if one not in cells]
            cells |= self._measured(nodes, deepest, corrections)
            if deepest >= high or (cells and _found(cells[max(cells)]) < _NONE):
                break
            top, deepest = deepest, min(high, _FURTHER * deepest)
        if not cells:
            raise UserError(f"site must be deeper than its waves, which uncover the bottom at {high:.3g} m")
        depths = sorted(cells)
        for above, below in itertools.pairwise(depths):
            first, last = _found(cells[above]), _found(cells[below])
            if first > _NONE and last < min(_ALL, first):
                between = _nodes(above, below, _FINE)[1:-1].tolist()
                sea = next(sea for sea in sorted([*self._sea, math.inf]) if sea >= below)
                cells |= self._measured(between, sea, corrections)
        return self._labelled(dict(sorted(cells.items())))

    def _measured(
        self, depths: Sequence[float], deepest: float, corrections: xr.Dataset | None
    ) -> dict[float, dict[str, Any]]:
        """Return the numbers of wet bottoms at depths, in the sea of the deepest one of them [m]."""
        cells, near = {}, [one for one in depths if one <= self._reach]
        for some in ([near] if near else []) + [[one] for one in depths if one > self._reach]:
            series = self._by_maps(near, min(deepest, self._reach)) if some is near else self._merged(*some)
            series = series.isel(shot=np.isfinite(series["true_bottom_depth_below_surface"].values))
            recorded = detect_waveforms(series, self._receiver, self.records, self.seed, advice=False)
            self._attributes, self._pixels = dict(recorded.attrs), [str(one) for one in recorded["pixel"].values]
            of_depth = recorded["true_bottom_depth"].values
            for depth in some:
                if (own := np.flatnonzero(np.isclose(of_depth, depth))).size:
                    cells[depth] = _numbers(recorded.isel(shot=own), corrections)
        return cells

    def _choose_settings(self, depths: FloatArray, deepest: float) -> None:
        """Choose automatic gains and filters as flights do, by pilot shots over depths of the site [m].

        Those beyond the reach of maps, or below their scene [m], stand there.
        """
        lying = np.quantile(depths, (np.arange(PILOTS) + 0.5) / PILOTS)
        by_maps = bool(lying[0] <= self._reach)
        bottom = min(deepest, self._reach) if by_maps else float(lying[0])
        loaded = self._scene_of(bottom, "maps" if by_maps else "merging")
        pilots = pilots_over(loaded, np.minimum(lying, bottom), bottom, self.seed * 2**20)
        self._receiver = self._receiver.with_channel_settings(shared_settings(pilots, self._receiver))

    def _scene_of(self, bottom: float, light: str) -> ShotScene:
        """Return the scene with a bottom at a depth [m]."""
        if (bottom, light) not in self._scenes:
            params = {**self.params, "bottom_depth": bottom}
            options: dict[str, Any] = {"instrument": self.instrument, "light": light, "check": not self._scenes}
            self._scenes[bottom, light] = ShotScene(self.scene, params, self._places, **options)
        return self._scenes[bottom, light]

    def _by_maps(self, depths: Sequence[float], deepest: float) -> xr.Dataset:
        """Return the light of bottoms at depths up to that of their scene [m], by light maps."""
        places, loaded = self._places, self._scene_of(deepest, "maps")
        if deepest not in self._sea:
            truth = truth_coordinates(sea_of(loaded.session.scene), loaded.lidar, ShotPoses(places))
            self._sea[deepest] = loaded.batches(_PASSES, 1.0, None), truth
        batches, truth = self._sea[deepest]
        count = len(depths)
        lying = np.tile(depths, len(places))
        poses = ShotPoses(np.repeat(places, count, axis=0), raised=deepest - lying)
        known = {name: np.repeat(values, count) for name, (_, values, _) in truth.items()}
        below = lying + known["true_surface_height"]
        known |= {"true_bottom_depth": lying, "true_bottom_depth_below_surface": np.where(below > 0, below, np.nan)}
        series = rendered(loaded, batches, poses, self.seed * 2**20)
        return series.assign_coords({name: ("shot", values) for name, values in known.items()})

    def _merged(self, depth: float) -> xr.Dataset:
        """Return the light of a bottom at a depth [m], merged; raise KeyboardInterrupt if it was interrupted."""
        params, seed = {**self.params, "bottom_depth": depth}, self.seed * 2**20
        options: dict[str, Any] = {"instrument": self.instrument, "target_error": _ERROR, "first_seed": seed}
        return uninterrupted(render_shots(self.scene, params, positions=self._places, describe_sea=False, **options))

    def _labelled(self, cells: Mapping[float, Mapping[str, Any]]) -> xr.Dataset:
        """Return a table as of `depth_bias.depth_bias`."""
        data: dict[str, Any] = {}
        for name, value in next(iter(cells.values())).items():
            dims = (*depth_correction.AXES, "estimator", "pixel") if np.ndim(value) else depth_correction.AXES
            data[name] = dims, np.array([cell[name] for cell in cells.values()])[np.newaxis, np.newaxis, np.newaxis]
        wind = float(self._attributes.get("scene.wind_speed") or 0)
        numbers = {"off_nadir_deg": float(self._attributes["off_nadir_deg"]), "wind_speed": wind}
        coords: dict[str, Any] = {key: [value] for key, value in numbers.items()}
        coords |= {"water": [0], "depth": list(cells), "estimator": [_ESTIMATOR], "pixel": self._pixels}
        return xr.Dataset(data, coords, {**self._attributes, **numbers, "instrument": self.instrument})


def _numbers(recorded: xr.Dataset, corrections: xr.Dataset | None) -> dict[str, Any]:
    """Return numbers as of `depth_bias.depth_bias`, with bottoms alone that are right as found."""
    truth = recorded["true_bottom_depth_below_surface"].values
    echoes = extract(recorded, [_ESTIMATOR], targets=1)
    if corrections is not None:
        echoes = depth_correction.correct_depths(echoes, corrections)
    numbers: dict[str, Any] = dict(depth_correction.summarize_depths(echoes, truth))
    bottom = echoes.sel(echo="bottom").transpose("shot", "pixel", "estimator")
    right = np.abs(bottom["depth_m"].values - truth[:, np.newaxis, np.newaxis]) < _RIGHT
    numbers["found"] = np.mean(right & has_echo(bottom["flags"].values), axis=0).T
    return numbers | depth_bias.rms_slopes(recorded)


def _found(cell: Mapping[str, Any]) -> float:
    """Return the share of found bottoms in the best channel."""
    return float(np.max(cell["found"]))


def _nodes(low: float, high: float, ratio: float) -> FloatArray:
    """Return numbers from a low to a high one, at equal ratios of at most `ratio`."""
    count = math.ceil(math.log(high / low) / math.log(ratio) - 1e-9) if high > low else 0
    return np.geomspace(low, high, count + 1) if count else np.array([low])


def _row(table: xr.Dataset, name: str) -> FloatArray:
    """Return the numbers of a table over depth, corrected if they are."""
    one = table[name].isel({dim: -1 for dim in table[name].dims if dim != "depth"})
    return np.asarray(one.values, np.float64)


def _deepest(depth: FloatArray, found: FloatArray) -> float:
    """Return the depth [m] where the share of found bottoms falls for good below the least, NaN if it never does."""
    seen = np.flatnonzero(found >= LEAST_FOUND)
    if not seen.size or (last := seen[-1]) == depth.size - 1:
        return math.nan
    return float(np.interp(-LEAST_FOUND, -found[last : last + 2], depth[last : last + 2]))


def _maps(
    depth: FloatArray, water: FloatArray, deep: Any, waters: FloatArray, tables: Sequence[xr.Dataset], name: str
) -> dict[str, FloatArray]:
    """Return the numbers of tables in the cells of a site that are deep enough, and the deepest depths."""
    maps = {key: np.where(deep, 0.0, np.nan) for key in ("found", "tvu", "thu", "deepest")}
    place = np.interp(np.log(np.where(deep, water, 1)), np.log(waters), np.arange(len(waters)))
    for number, (one, table) in enumerate(zip(waters, tables, strict=True)):
        share = np.maximum(1 - np.abs(place - number), 0)
        used = deep & (share > 0)
        d, w, share, nodes = depth[used], water[used], share[used], table["depth"].values
        ratio = {"kd": w / one, "secchi": one / w}.get(name, np.ones(w.shape))
        for key in ("found", "tvu", "thu"):
            known = np.isfinite(row := _row(table, key))
            values = np.interp(d * ratio, nodes[known], row[known]) if known.any() else np.full(d.shape, np.nan)
            maps[key][used] += share * values
        maps["deepest"][used] += share * _deepest(nodes, _row(table, "found")) / ratio
    for key in ("tvu", "thu"):
        maps[key][~(maps["found"] >= LEAST_FOUND)] = np.nan
    order = order_met(depth, maps["tvu"], maps["thu"])
    maps["order"] = np.where(deep, order, np.where(depth <= 0, _LAND, np.nan))
    return maps
