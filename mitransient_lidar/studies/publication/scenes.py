"""Scenes of the publication's figures, their geometry and their renders."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar.core.validation import FloatArray, integer, relative_error
from mitransient_lidar.loading import variants
from mitransient_lidar.loading.catalogue import scene_parameters
from mitransient_lidar.loading.scenes import LoadedScene, open_scene
from mitransient_lidar.loading.variants import alone, alone_with_scene
from mitransient_lidar.physics.lidar.level_sea import LidarGeometry
from mitransient_lidar.rendering.passes import ProgressCallback
from mitransient_lidar.rendering.shots.series import random_places, render_shots
from mitransient_lidar.rendering.shots.truth import SeaMap, Shot
from mitransient_lidar.results.attributes import uninterrupted
from mitransient_lidar.results.geometry import lidar_geometry
from mitransient_lidar.studies.publication.statements import Series
from mitransient_lidar.transport.sensor.outlines import pixel_outlines

_LOG = logging.getLogger(__name__)

REPEATS = 8  #: Renders of a place with independent random numbers, from whose spread standard errors come.
SEAS = (1, 2, 3)  #: Seas for the other locations, as values of ``surface_seed``.
RANDOM_PLACES, PLACES_OF_SLOPE = 12, 5  #: Locations on each sea: random ones, and those with each shot's slopes.

RANDOM = f"{RANDOM_PLACES * len(SEAS)} random places on {len(SEAS)} seas"  #: Random places in words.

#: Share of a full pass's paths, passes per location, and most passes for the requested error.
_SHARE, _PASSES, _MOST_PASSES = 0.25, 4, 256

#: Most passes of scenes that converge slowly: the mast's would take as long as all the others together.
_FEWER_PASSES = {"fig04_mast": 12}

#: Smallest distance between locations with given slopes, and least distance between render seeds.
_APART_M, _SEED_STEP = 6.0, 1000


@dataclass
class Renders:
    """Results for the publication's scenes.

    Raises `UserError` if a number is out of range.
    """

    #: Relative standard error of a figure's median bin, greater than 0. The mast in figure 4 may miss it.
    target_error: float = 0.01
    seed: int = 0  #: Seed of all random numbers, 0 to 2^31.
    progress: ProgressCallback | None = None  #: Called with a `passes.Progress` after every batch of shots.
    _results: dict[tuple[Any, ...], xr.Dataset] = field(default_factory=dict)
    _sessions: dict[tuple[str, int], LoadedScene] = field(default_factory=dict)
    _seas: dict[tuple[str, int], SeaMap] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.target_error = relative_error("target_error", self.target_error)
        self.seed = integer("seed", self.seed, 0, 2**31)

    def shot(self, scene: str, **params: float) -> xr.Dataset:
        """Return `REPEATS` independent renders of a scene's shot, with the light by its origin if there is a target."""
        values = scene_parameters(scene)
        aim = [float(values[name]) for name in ("aim_x", "aim_y")]
        wanted, most = self.target_error * math.sqrt(REPEATS), _FEWER_PASSES.get(scene, _MOST_PASSES)
        goal = {"target_error": wanted, "passes": most, "components": "target_depth" in values}
        return self._rendered(scene, params, [(aim[0], aim[1])] * REPEATS, goal)

    def random(self, scene: str, *, move_target: bool = False) -> Series:
        """Return renders at random places of each sea, to which a target may move with the beam."""
        goal = {"passes": _PASSES, "components": move_target, "move_target": move_target}
        found = []
        for sea in SEAS:
            places = random_places(self.sea(scene, sea), RANDOM_PLACES, self.seed + sea)
            found.append(as_series(self._rendered(scene, {"surface_seed": sea}, places.tolist(), goal)))
        return joined(found)

    def of_slopes(self, scene: str, slopes: Sequence[tuple[float, float]]) -> list[Series]:
        """Return renders at locations on all seas with about the slopes of each pair (along, across) [1]."""
        found: list[list[Series]] = [[] for _ in slopes]
        for sea in SEAS:
            chart = self.sea(scene, sea)
            kinds = [chart.near(pair, PLACES_OF_SLOPE, _APART_M) for pair in slopes]
            places = [(shot.x, shot.y) for shots in kinds for shot in shots]
            goal = {"passes": _PASSES}
            result = self._rendered(scene, {"surface_seed": sea}, places, goal)
            edges = np.cumsum([0, *(len(shots) for shots in kinds)])
            for number in range(len(slopes)):
                found[number].append(as_series(result.isel(shot=slice(edges[number], edges[number + 1]))))
        return [joined(parts) for parts in found]

    @alone_with_scene
    def session(self, scene: str, sea: int = 0) -> LoadedScene:
        """Return a loaded scene, on its own sea (0) or on another one."""
        key = (scene, sea)
        # Its shot series are rendered later.
        variants.leave_the_gpu("figures are rendered")
        if key not in self._sessions:
            self._sessions[key] = open_scene(scene, {"surface_seed": sea} if sea else None)
        return self._sessions[key]

    @alone
    def sea(self, scene: str, sea: int = 0) -> SeaMap:
        """Return the map of a scene's sea, on its own sea (0) or on another one."""
        key = (scene, sea)
        if key not in self._seas:
            self._seas[key] = SeaMap.of_scene(self.session(scene, sea).scene)
        return self._seas[key]

    def _rendered(
        self, scene: str, params: Mapping[str, float], places: Sequence[Any], goal: Mapping[str, Any]
    ) -> xr.Dataset:
        """Return a result, rendered at its first use; raise KeyboardInterrupt where the render was interrupted."""
        key = (scene, *sorted(params.items()), tuple(map(tuple, places)), *sorted(goal.items()))
        if key not in self._results:
            _LOG.info("%s: %d renders", ", ".join([scene, *(f"{k}={v:g}" for k, v in params.items())]), len(places))
            options: dict[str, Any] = {"pass_share": _SHARE, "first_seed": _SEED_STEP * self.seed, **goal}
            self._results[key] = uninterrupted(
                render_shots(scene, params, positions=places, progress=self.progress, **options)
            )
        return self._results[key]


def as_series(result: xr.Dataset) -> Series:
    """Return the waveforms of a shot series, with those by origin where they are known."""
    parts = {}
    if "waveform_by_origin" in result:
        by_origin = result["waveform_by_origin"]
        parts = {str(name): by_origin.sel(origin=name).values for name in result["origin"].values}
    return Series(result["time"].values, result["waveform"].values, parts)


def joined(series: Sequence[Series]) -> Series:
    """Return the shots of several series, on their common time bins."""
    start, end = max(one.time[0] for one in series), min(one.time[-1] for one in series)
    cut = [(one, (one.time >= start - 1e-6) & (one.time <= end + 1e-6)) for one in series]
    parts = {name: np.concatenate([one.parts[name][..., kept] for one, kept in cut]) for name in series[0].parts}
    return Series(cut[0][0].time[cut[0][1]], np.concatenate([one.power[..., kept] for one, kept in cut]), parts)


def geometry_of(result: xr.Dataset) -> LidarGeometry:
    """Return the geometry on the axis over a level sea, whose surface is the zero of the depth axis."""
    return lidar_geometry(result.attrs, surface="level")


def echo_gate(result: xr.Dataset, depth: float, half_ns: float = 11.0) -> tuple[float, float]:
    """Return a gate [ns] about the echo from a depth [m] on the axis of a level sea."""
    middle = float(geometry_of(result).time_of_depth(depth))
    return middle - half_ns, middle + half_ns


def described(result: xr.Dataset) -> str:
    """Return a shot's location, mesh and number of renders as text."""
    surface = json.loads(result.attrs["plugin_parameters"])["surface"]
    used = {**surface, **surface.get("used", {})}
    scene, seed, cell = result.attrs["scene"], int(used["surface_seed"]), float(used["cell_size"])
    aim = f"({float(result['aim_x'][0]):g}, {float(result['aim_y'][0]):g}) m"
    passes = int(result["shot_passes"].max())
    return (
        f"scene {scene}, sea {seed} at {aim}, cells of {100 * cell:.1f} cm, {result.sizes['shot']} renders of {passes} "
        f"passes"
    )


#: One pixel and four over a flat bottom, a sphere, and a target below a mast.
SINGLE, FOUR, MINE, MAST = "fig09_1x1", "fig09_2x2", "fig02_mine", "fig04_mast"

#: A square target in 2x2 and in 1x4 pixels, and four pixels and one over water in two layers.
SQUARE, STRIPS, LAYERED_FOUR, LAYERED_SINGLE = "fig13_2x2", "fig14_1x4", "fig15_2x2", "fig15_1x1"

#: Scenes of the pixel layouts that figure 8 shows, and of the three shots on waves, whose bins are narrower [ns].
LAYOUTS = (SINGLE, FOUR, STRIPS)
SHOTS, _BIN_WIDTH_NS = ("fig11_shot1", "fig11_shot2", "fig11_shot3"), 0.25

_LAYER_DEPTH = 3.0  #: Depth of the water's change [m].


@dataclass(frozen=True, kw_only=True)
class System(LidarGeometry):
    """Lidar in a scene: divergence and field of view [rad], and bottom depth [m]."""

    divergence: float
    field_of_view: float
    bottom_depth: float

    @classmethod
    def of(cls, scene: str) -> System:
        """Read a scene's parameters."""
        values = scene_parameters(scene)
        return cls(
            float(values["altitude"]),
            math.radians(float(values["off_nadir_deg"])),
            *(float(values[name]) for name in ("refractive_index", "group_index")),
            divergence=1e-3 * float(values["divergence_mrad"]),
            field_of_view=1e-3 * float(values["field_of_view_mrad"]),
            bottom_depth=float(values["bottom_depth"]),
        )


def outlines(renders: Renders, scene: str) -> list[list[FloatArray]]:
    """Return the outlines (angle_x, angle_y) [rad] of each pixel in a scene."""
    return [list(lines) for lines in pixel_outlines(renders.session(scene).sensor.receiver.pixels)]


def shot_places(renders: Renders) -> list[Shot]:
    """Return locations and mean slopes over the beam's footprint for the three shots, which share one sea."""
    sea, found = renders.sea(SHOTS[0]), []
    for number, scene in enumerate(SHOTS, start=1):
        values = scene_parameters(scene)
        x, y = float(values["aim_x"]), float(values["aim_y"])
        found.append(Shot(f"shot {number}", x, y, *sea.slope_at(x, y)))
    return found


def shot_slopes(renders: Renders) -> list[tuple[float, float]]:
    """Return the mean slopes (along, across) [1] of the three shots."""
    return [(shot.along, shot.across) for shot in shot_places(renders)]


def three_shots(renders: Renders) -> list[xr.Dataset]:
    """Return the renders of the three shots, which figures 10 and 11 share."""
    return [renders.shot(scene, bin_width_ns=_BIN_WIDTH_NS) for scene in SHOTS]


def layer_times(result: xr.Dataset) -> FloatArray:
    """Return when light from the change of the water is expected in each pixel [ns]."""
    return np.asarray(result["surface_time"].values + _LAYER_DEPTH / result["depth_per_ns"].values)
