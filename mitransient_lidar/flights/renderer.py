"""Rendering a flight's pulses: shots with similar poses together, recorded by the receiver, with their echoes."""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.analysis.receiver import SATURATING
from mitransient_lidar.analysis.waveforms.depth_correction import corrections_for
from mitransient_lidar.analysis.waveforms.echo_detection import EchoClass
from mitransient_lidar.analysis.waveforms.echo_table import ECHOES, extract
from mitransient_lidar.analysis.waveforms.surface_times import check_surface
from mitransient_lidar.campaigns.design import Column
from mitransient_lidar.campaigns.runs import Array, Renderer, plain
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, IntArray
from mitransient_lidar.flights.plan import POSE_PARAMETERS, FlightPlan
from mitransient_lidar.flights.poses.mounting import pixel_turns, poses_of
from mitransient_lidar.flights.poses.records import tell_time_system
from mitransient_lidar.flights.preparation import (
    axis_of,
    input_columns,
    lidar_of,
    pilot_rows,
    shot_poses,
    tell_forecast,
    telling_errors_alone,
    warn_of_angles,
    warn_of_maps,
)
from mitransient_lidar.flights.recording import (
    SETTINGS,
    chosen_settings,
    record,
    saturated_pulses,
)
from mitransient_lidar.loading import variants
from mitransient_lidar.loading.scene_source import SceneSource
from mitransient_lidar.loading.scenes import read_source
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.rendering.passes import Progress, ProgressCallback
from mitransient_lidar.results.attributes import described, join
from mitransient_lidar.results.geometry import LinesOfSight
from mitransient_lidar.results.sum_errors import pooled_errors

if TYPE_CHECKING:
    from mitransient_lidar.rendering.shots.batches import ShotBatches
    from mitransient_lidar.rendering.shots.scene import ShotScene

#: Most pulses that are rendered and measured together, and time in which waves stand still [s].
_BATCH, _STILL_S = 256, 0.05

#: Inputs of pulses: start of the record of the infrared channel [ns], and its time bins.
_OF_INFRARED = ("infrared_start_ns", "infrared_bins")

#: Rounding of times over the time in which waves stand still.
_ROUNDING = 1e-6

#: Pilot pulses that are rendered together.
_PILOTS_TOGETHER = 64

#: Passes of pulses whose light is looked up in maps.
_MAP_PASSES = 2


@dataclass(frozen=True, eq=False)
class FlightRenderer(Renderer):
    """Renders a flight's pulses; records begin at their groups' times, all with as many time bins."""

    plan: FlightPlan
    plan_type, unit, kind = FlightPlan, "shot", "flight"

    @classmethod
    @alone
    def of(cls, plan: FlightPlan, progress: ProgressCallback | None = None) -> tuple[FlightRenderer, dict[str, Column]]:
        """Return a new flight's renderer and its pulses' inputs, in groups; report what is known before it.

        That is what poses are beyond the corrections, and by a sample of pulses the time that the flight takes and how
        many pulses saturate. `progress` is called with a `Progress` for groups and sample.

        Raises UserError if the flight, its scene or its corrections are invalid, the bottom does not cover it, or its
        echo is outside the record.
        """
        poses = plan.poses()
        tell_time_system(plan.time_system(poses.time_s), poses.time_s)
        scene = scene_of(plan)
        columns = input_columns(poses)
        other = plan.of_infrared() if plan.infrared else None
        if plan.corrections != "none":
            table = corrections_for(scene.instrument or "", plan.corrections)
            check_surface(table, plan.infrared)
            warn_of_angles(columns["group_angle_deg"], table)
        longest, start, beyond = None, np.empty(len(poses.time_s)), 0
        infrared = np.empty((2, start.size))
        groups = np.unique(columns["group"])
        with contextlib.ExitStack() as quiet:
            for number, group in enumerate(groups):
                rows = np.flatnonzero(columns["group"] == group)
                pulses = {name: column[rows] for name, column in columns.items()}
                own, missed = axis_of(plan, scene, pulses)
                beyond += missed
                start[rows] = own.start_ns
                if other is not None:
                    beside, _ = axis_of(other, scene_of(other), pulses)
                    infrared[0, rows], infrared[1, rows] = beside.start_ns, beside.bin_count
                if longest is None or own.bin_count > longest.bin_count:
                    longest = own
                if number == 0:
                    quiet.enter_context(telling_errors_alone())
                if progress is not None:
                    progress(Progress(done=number + 1, planned=len(groups), unit="preparing group"))
        warn_of_maps(beyond, start.size)
        with telling_errors_alone():
            renderer = cls(plan, scene, longest)
            columns["record_start_ns"] = start
            if other is not None:
                columns |= dict(zip(_OF_INFRARED, (infrared[0], np.full(start.size, infrared[1].max())), strict=True))
            pilots, seconds = renderer._pilots(columns, progress)
            settings = chosen_settings(pilots, plan)
            saturated = saturated_pulses(pilots, plan, settings)
            if other is not None:
                own_start, bins = (columns[name] for name in _OF_INFRARED)
                found, _ = _infrared(renderer, int(bins[0]))._pilots({**columns, "record_start_ns": own_start}, None)
                settings = settings | {f"infrared_{name}": one for name, one in chosen_settings(found, other).items()}
        columns |= {name: np.full(start.shape, value) for name, value in settings.items()}
        tell_forecast(saturated, pilots.sizes["shot"], bool(settings), start.size, seconds)
        return renderer, columns

    def describe_input(self, name: str, column: Column) -> dict[str, Any]:
        """Return a pulse input's attributes."""
        for setting, text in SETTINGS.items():
            whose, found, number = name.partition(setting)
            if found:
                return {
                    "units": "1",
                    "long_name": f"{text} of channel {number} of the {whose.replace('_', ' ')}receiver, "
                    "chosen for the flight",
                    "saturating_share": SATURATING,
                }
        return described(name, "flight")

    def batches(self, inputs: Mapping[str, Column]) -> Iterator[list[int]]:
        """Return the rows of pulses rendered together: successive ones in a group."""
        group, first = inputs["group"], 0
        for row in range(1, group.size + 1):
            if row == group.size or row - first == _BATCH or group[row] != group[first]:
                yield list(range(first, row))
                first = row

    @alone
    def stacked(self, numbers: npt.NDArray[np.int64], inputs: Mapping[str, Column]) -> dict[str, Array]:
        """Return arrays for one group's pulses rendered together; raise `UserError` if that fails."""
        return self._stacked(inputs)[0]

    @alone
    def sample(self, inputs: Mapping[str, Column]) -> tuple[dict[str, Array], dict[str, Array], dict[str, Any]]:
        """Return pulse arrays, their dimensions' coordinates, and the echoes' attributes."""
        arrays, echoes = self._stacked(inputs, turned=False)
        names = ("pixel", "angle_x", "angle_y", "sight_x", "sight_y", "beam_share")
        found = {name: Array.of(echoes[name]) for name in names if name in echoes.coords}
        samples = arrays["signal"].values.shape[-1]
        width = float(echoes.attrs["bin_width_ns"])
        found["time"] = Array(("time",), (np.arange(samples) + 0.5) * width, described("time", "flight"))
        found["echo"] = Array(("echo",), np.array(ECHOES), described("echo"))
        stacked = {name: array._replace(values=array.values[0]) for name, array in arrays.items()}
        return stacked, found, {"echo_attributes": plain(echoes.attrs)}

    def _stacked(self, inputs: Mapping[str, Column], *, turned: bool = True) -> tuple[dict[str, Array], xr.Dataset]:
        """Return the arrays of pulses, stacked, and their echoes, whose pixels may be turned about the axis."""
        series, later, _ = self._render(inputs, self._passes(until_error=True))
        series["waveform_stderr"] = pooled_errors(series, few=False)
        recorded = record(series, self.plan, inputs)
        measured = self._with_turned_pixels(recorded, inputs) if turned else recorded
        infrared = self._infrared_record(inputs, later) if self.plan.infrared else None
        if infrared is not None:
            measured = join(measured, infrared)
        echoes = extract(measured, self.plan.estimator, targets=1)
        pixels = recorded.sizes["pixel"]
        start = float(recorded.attrs["time_start_ns"]) + later
        found = {
            "signal": _single(recorded["signal"]),
            "sample_start_ns": Array((), start, described("sample_start_ns")),
            "time_offset_ns": Array((), later, described("time_offset_ns")),
            "gain": _per_pixel(recorded.attrs["gain"], len(later), pixels),
            "sensitivity": Array(
                ("pixel",),
                np.tile(recorded["receiver_sensitivity"].values, (len(later), 1)),
                described("receiver_sensitivity"),
            ),
        }
        if infrared is not None:
            seen = (extract(infrared)["class"].sel(echo="surface") == EchoClass.SURFACE).any("pixel")
            found["infrared_surface"] = Array((), seen.values, described("infrared_surface"))
        for name, values in series.coords.items():
            if str(name).startswith("true_"):
                found[str(name)] = _single(values)
        for name, values in echoes.data_vars.items():
            of_time = np.float64 if str(name).endswith("time_ns") else np.float32
            dtype = np.int16 if name in ("flags", "class") else of_time
            found[f"echo_{name}"] = _single(values, dtype)
        return found, echoes

    def _infrared_record(self, inputs: Mapping[str, Column], later: FloatArray) -> xr.Dataset:
        """Return infrared pulse records, with level-sea times in place of the green pulses'.

        `later` is how much later than its times each green shot is [ns].
        """
        start, bins = (inputs[name] for name in _OF_INFRARED)
        own = {name: column for name, column in inputs.items() if not name.startswith(tuple(SETTINGS))}
        own = {name.removeprefix("infrared_"): column for name, column in own.items()}
        renderer = _infrared(self, int(bins[0]))
        series, own_later, _ = renderer._render({**own, "record_start_ns": start}, self._passes(until_error=True))
        series["waveform_stderr"] = pooled_errors(series, few=False)
        recorded = record(series, renderer.plan, own)
        apart = xr.DataArray(later - own_later, dims="shot")
        return recorded.assign_coords(surface_time=recorded["surface_time"] + apart)

    def _passes(self, *, until_error: bool) -> tuple[int, float, float | None]:
        """Return the pulses' most passes, their share of a full pass's paths, and the error that ends them."""
        from mitransient_lidar.rendering.shots.batches import MOST_PASSES_FOR_ERROR, share_for_error
        from mitransient_lidar.rendering.shots.scene import MERGED_PASSES

        error = self.plan.target_error
        share = share_for_error(error)
        return (MOST_PASSES_FOR_ERROR, share, error) if until_error else (MERGED_PASSES, share, None)

    def _pilots(self, columns: Mapping[str, Column], progress: ProgressCallback | None) -> tuple[xr.Dataset, float]:
        """Return the pilot pulses' waveforms: `pilot_rows`, at the same sea places in all flights.

        Beside them is the processor time per flight pulse, with as many passes as its error needs [s].
        """
        from mitransient_lidar.rendering.shots.scene import PILOTS

        rows = pilot_rows(columns, PILOTS)
        group = columns["group"][rows]
        found: list[tuple[xr.Dataset, float]] = []
        for one in np.unique(group):
            own = np.flatnonzero(group == one)
            for part in np.array_split(own, -(-own.size // _PILOTS_TOGETHER)):
                inputs = {name: column[rows[part]] for name, column in columns.items()}
                inputs |= {"pulse": part, "time_s": np.zeros(part.size)}
                self._scene_of(inputs)
                began = time.process_time()
                series, _, errors = self._render(inputs, self._passes(until_error=False), part)
                took = (time.process_time() - began) / part.size
                error = float(np.median(errors))
                found.append((series, took * max((error / self.plan.target_error) ** 2, 1.0)))
                if progress is not None:
                    done = sum(one.sizes["shot"] for one, _ in found)
                    progress(Progress(done=done, planned=rows.size, unit="sampling pulse"))
        # The first part compiles kernels.
        seconds = float(np.quantile([seconds for _, seconds in found], 0.5, method="lower"))
        return xr.concat([one for one, _ in found], "shot", coords="minimal", compat="override"), seconds

    def _scene_of(self, inputs: Mapping[str, Column], light: str | None = None) -> ShotScene:
        """Return the loaded scene with one group's lidar, by default for the flight's light."""
        # That of a scene which was loaded before.
        variants.leave_the_gpu("shots are rendered")
        return _shot_scene(self, *self._lidar_and_record(inputs), light or self.plan.light)

    def _lidar_and_record(self, inputs: Mapping[str, Column]) -> tuple[float, float, float, float, TimeAxis]:
        """Return one group's lidar, as from `lidar_of`, and its time bins."""
        assert self.axis is not None
        return *lidar_of(inputs), replace(self.axis, start_ns=float(inputs["record_start_ns"][0]))

    def _with_turned_pixels(self, recorded: xr.Dataset, inputs: Mapping[str, Column]) -> xr.Dataset:
        """Return one group's record, with lines of sight for pixels turned about the axis."""
        turns = pixel_turns(poses_of(inputs.__getitem__))
        if not turns.any():
            return recorded
        lines = [_turned_lines(self, *self._lidar_and_record(inputs), turn) for turn in turns.tolist()]
        arrays = {name: np.stack([vars(one)[name] for one in lines]) for name in vars(lines[0])}
        return recorded.assign_coords(LinesOfSight(**arrays).coordinates(("shot", "pixel"), arrays["off_nadir"].shape))

    def _render(
        self,
        inputs: Mapping[str, Column],
        passes: tuple[int, float, float | None],
        pilots: IntArray | None = None,
    ) -> tuple[xr.Dataset, FloatArray, FloatArray]:
        """Return pulse waveforms as a series, and how much later than its times each shot is [ns].

        The last array are the relative errors of the bins that count. `pilots`: numbers of pilot pulses.
        """
        from mitransient_lidar.rendering.shots.batches import ReceivedShots, suits_maps
        from mitransient_lidar.rendering.shots.scene import PILOTS, pilot_sea
        from mitransient_lidar.rendering.shots.truth import sea_of, truth_coordinates

        plan = self.plan
        scene = self._scene_of(inputs)
        poses = shot_poses(scene.lidar, inputs)
        # Records start at whole bins after the pulse, as the clock of a digitizer that the pulse starts.
        further, width = poses.extra_range(scene.lidar), C0 * 1e-9 * scene.lidar.axis.bin_width_ns
        poses = poses.delayed(further % width)
        sea = sea_of(scene.session.scene)
        if not plan.still_sea:
            poses = replace(poses, times_s=_STILL_S * (np.floor(inputs["time_s"] / _STILL_S + _ROUNDING) + 0.5))
        if pilots is not None and (at_sea := pilot_sea(sea, PILOTS)) is not None:
            poses = replace(poses, other_sea=(at_sea[0][pilots], at_sea[1][pilots]))
        pulses = inputs["pulse"].astype(np.int64)
        by_maps = suits_maps(scene.lidar, poses) if plan.light == "maps" else np.zeros(len(poses), dtype=bool)
        rendered, rows = [], []
        for light in ("maps", "merging"):
            if not (own := np.flatnonzero(by_maps == (light == "maps"))).size:
                continue
            # Maps have the errors of a few passes.
            options = (_MAP_PASSES, 1.0, None) if light == "maps" else passes
            batches = _batches(self._scene_of(inputs, light), *options)
            if plan.max_time is not None:
                batches = batches.limited(options[0], plan.max_time)
            for part in batches.parts(own.size):
                some = own[part]
                seeds = [plan.seed * 2**20 + int(pulse) for pulse in pulses[some]]
                rendered.append(batches.render(poses.part(some), seeds))
                rows.append(some)
        joined = ReceivedShots.joined(rendered, np.argsort(np.concatenate(rows)))
        attributes = scene.attributes(used=batches.used_values, passes=int(joined.passes.max()))
        known = {**truth_coordinates(sea, scene.lidar, poses), "shot_passes": ("shot", joined.passes)}
        series = scene.dataset(joined, attributes).assign_coords(known)
        return series, 1e9 / C0 * (further - further % width), joined.errors


def scene_of(plan: FlightPlan) -> SceneSource:
    """Return a flight's scene source, with its instrument.

    Raises UserError if it cannot be read, or lacks a parameter.
    """
    source = read_source(plan.scene, plan.parameters, plan.instrument, plan.stated_origin)
    for name in POSE_PARAMETERS:
        if name not in source.values:
            raise UserError(f"scene {plan.scene} has no parameter {name}, which the flight sets")
    return source


@functools.lru_cache(maxsize=2)
def _infrared(renderer: FlightRenderer, bins: int) -> FlightRenderer:
    """Return the renderer for a flight's infrared pulses, with so many time bins."""
    plan = renderer.plan.of_infrared()
    scene = scene_of(plan)
    return FlightRenderer(plan, scene, TimeAxis(0.0, float(scene.values["bin_width_ns"]), bins))


@functools.lru_cache(maxsize=4)
def _shot_scene(
    renderer: FlightRenderer, angle_deg: float, height: float, x: float, y: float, axis: TimeAxis, light: str
) -> ShotScene:
    """Return the loaded scene with a group's lidar."""
    from mitransient_lidar.rendering.shots.scene import ShotScene

    params = {**renderer.plan.parameters, "off_nadir_deg": angle_deg, "altitude": height}
    return ShotScene(renderer.scene, params, np.array([[x, y]]), axis=axis, check=False, light=light)


@functools.lru_cache(maxsize=256)
def _turned_lines(
    renderer: FlightRenderer, angle_deg: float, height: float, x: float, y: float, axis: TimeAxis, turn_deg: float
) -> LinesOfSight:
    """Return lines of sight for a group's lidar, with pixels turned about the receiver's axis [deg]."""
    from mitransient_lidar.rendering.describe import lines_of_sight

    scene = _shot_scene(renderer, angle_deg, height, x, y, axis, renderer.plan.light)
    return lines_of_sight(scene.lidar, turn_deg)


@functools.lru_cache(maxsize=4)
def _batches(scene: ShotScene, passes: int, share: float, error: float | None) -> ShotBatches:
    """Return a scene's shots in batches; its solids and buffers serve all."""
    return scene.batches(passes, share, error)


def _single(values: xr.DataArray, dtype: npt.DTypeLike = np.float32) -> Array:
    """Return a shot array, without its dimension's name."""
    # Without the coordinates, which take longer than the values.
    array = Array.of(values.variable.transpose("shot", ...), dtype)
    return array._replace(dims=tuple(dim for dim in array.dims if dim != "shot"))


def _per_pixel(value: Any, shots: int, pixels: int) -> Array:
    """Return the gain, a number or one for each pixel, of all shots."""
    values = np.broadcast_to(np.asarray(value, dtype=np.float64), (shots, pixels))
    return Array(("pixel",), np.array(values), described("gain"))
