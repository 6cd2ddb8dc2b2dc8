"""The loaded scene for a shot series: lidar, time bins, batches, labelled results; pilot shots, which show a gain."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
import xarray as xr

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.loading import variants
from mitransient_lidar.loading.scenes import choose_integrator, open_scene
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.sea.realization import PeriodicHeights
from mitransient_lidar.physics.sea.sea_surface import SeaSurface
from mitransient_lidar.rendering.accumulators import described
from mitransient_lidar.rendering.accuracy import ErrorWindow
from mitransient_lidar.rendering.derivatives import path_parameters, perturbations
from mitransient_lidar.rendering.describe import describe_scene, with_lines_of_sight
from mitransient_lidar.rendering.scene_checks import check_scene
from mitransient_lidar.rendering.shots.batches import ReceivedShots, ShotBatches, ShotPoses, check_size
from mitransient_lidar.transport.light_maps.renderer import LightMapRenderer
from mitransient_lidar.transport.paths.passes import PassRenderer, PathClasses, check_solids
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.scene_parts import find_lidar_scene

#: Parameters of the scene that shots replace, and those that they replace to move the target.
AIM, TARGET = ("aim_x", "aim_y"), ("target_x", "target_y")


class ShotScene:
    """The scene for a shot series, at the first one's location; its time bins are reported, and it is checked.

    `scene`, `params`, `instrument`, `sensor`: as for `loading.scenes.open_scene`, with the parameters ``aim_x`` and
    ``aim_y``. `places`: shot locations [m], shape (shots, 2). `target`: distance from the aim to the target [m], which
    moves with the shots; None if it stays. `axis`: time bins instead of automatic ones. `components`, `derivatives`: as
    for `series.render_shots`. `check`: whether to tell the time bins, and to check the scene. `light`: as in
    `series.render_shots`.
    """

    def __init__(
        self,
        scene: Any,
        params: Mapping[str, Any] | None,
        places: FloatArray,
        *,
        instrument: str | None = None,
        sensor: str | None = None,
        target: tuple[float, float] | None = None,
        axis: TimeAxis | None = None,
        components: bool = False,
        derivatives: Sequence[str] | str = (),
        check: bool = True,
        light: str = "merging",
    ) -> None:
        variants.leave_the_gpu("shots are rendered")
        self._open = functools.partial(open_scene, scene, instrument=instrument, sensor=sensor)
        self._params, self._target, self.light = params, target, light
        self._place = float(places[0, 0]), float(places[0, 1])
        self.session = self._open(self._at(*self._place))
        loaded = self.session.scene, self.session.sensor
        if components:
            check_solids(sum(not shape.is_medium_transition() for shape in loaded[0].shapes()))
        self._integrator = choose_integrator(loaded[0], None)
        own = find_lidar_scene(*loaded, shifts=[(float(x), float(y)) for x, y in places - places[0]])
        axis = own.axis if axis is None else _checked_axis(axis, own.axis)
        if check:
            self.session.tell_axis(axis, own.record_end)
        renderer = self._prepare(axis, light)
        renderer = renderer.by_origin() if components else renderer
        self.parameters = path_parameters(renderer, derivatives)  #: By which light is differentiated.
        self._renderer = renderer.perturbed(perturbations(self.parameters)) if self.parameters else renderer
        self.lidar: LidarScene = self._renderer.scene  #: Lidar of the first shot, with time bins for all shots.
        self.companions = self._find_companions()
        bins = self.lidar.receiver.pixels.count, self.lidar.axis.bin_count
        check_size(len(places), *bins, renderer.classes.count if components else 0, len(self.parameters))
        self.window = ErrorWindow.of_probe(renderer.probe)  #: Bins whose errors count, in each pixel.
        if check:
            check_scene(renderer.probe)
        self._described = describe_scene(renderer.probe, self.window, self._renderer.focusing)

    def _prepare(self, axis: TimeAxis, light: str) -> PassRenderer:
        """Return the renderer for the scene's own shot."""
        loaded = self.session.scene, self.session.sensor
        if light == "maps":
            return LightMapRenderer(find_lidar_scene(*loaded, axis=axis), PathClasses())
        renderer: PassRenderer = self._integrator.prepare(*loaded, axis=axis)
        return renderer

    def _at(self, x: float, y: float) -> dict[str, Any]:
        """Return a shot's parameters at a place [m]."""
        target = self._target
        moved = {} if target is None else {"target_x": x + target[0], "target_y": y + target[1]}
        return {**(self._params or {}), "aim_x": x, "aim_y": y, **moved}

    def _find_companions(self) -> list[mi.Shape]:
        """Return the shapes that move with the target's parameters."""
        if self._target is None:
            return []
        params = self._at(*self._place)
        other = self._open({**params, "target_x": params["target_x"] + 1.0}).scene
        pairs = zip(self.session.scene.shapes(), other.shapes(), strict=True)
        return [shape for shape, moved in pairs if shape.bbox().min.x != moved.bbox().min.x]

    def batches(self, passes: int, share: float, error: float | None) -> ShotBatches:
        """Return the shots in batches, for passes with a share of a full pass's paths, or until a relative error."""
        return ShotBatches(self._renderer, self._place, passes, share, error, self.window, self.companions)

    def attributes(self, used: Mapping[str, float], **others: Any) -> dict[str, Any]:
        """Return the series attributes, with other ones."""
        found = self.session.attributes(self.lidar, self._integrator, used, **self._described, **others)
        replaced = (*AIM, *(() if self._target is None else TARGET))
        return {
            name: value
            for name, value in found.items()
            if not name.endswith("_pose") and name not in {f"scene.{each}" for each in replaced}
        }

    def dataset(self, received: ReceivedShots, attributes: Mapping[str, Any]) -> xr.Dataset:
        """Return the labelled result."""
        pixels = self.lidar.receiver.pixels
        dataset = results.build_series(
            *received.whole,
            time=self.lidar.axis,
            pixel_names=pixels.names,
            pixel_centres_mrad=1e3 * pixels.centres(),
            grid=pixels.grid,
            attributes=attributes,
        )
        if received.parts:
            names = self._renderer.classes.names
            dataset = results.add_components(dataset, names, *received.parts).transpose("shot", ...)
        if received.derivatives:
            first = (np.moveaxis(values, 1, 0) for values in received.derivatives)
            dataset = results.add_derivatives(dataset, *described(self.parameters), *first).transpose("shot", ...)
        return with_lines_of_sight(dataset, self.lidar)


def _checked_axis(axis: TimeAxis, own: TimeAxis) -> TimeAxis:
    """Return given time bins; raise `UserError` if they leave out light in the automatic ones."""
    margin = 0.05 * (own.end_ns - own.start_ns)
    if own.start_ns < axis.start_ns - margin or own.end_ns > axis.end_ns + margin:
        raise UserError(
            f"the record of {axis.start_ns:g} to {axis.end_ns:g} ns leaves out light: it must hold {own.start_ns:g} to "
            f"{own.end_ns:g} ns"
        )
    return axis


PILOTS, _WITHIN = 128, 200.0  #: Most pilot shots, and farthest place of theirs along x and y [m].

#: Passes of pilot shots by merging and by light maps, and the relative error for which a merged pass has paths.
MERGED_PASSES, _MAP_PASSES, _ERROR = 4, 2, 0.1

_GOLDEN = 0.5 + 0.5 * math.sqrt(5)  #: Ratio whose multiples spread over a circle evenly, however many they are.


def pilot_sea(sea: SeaSurface | None, count: int) -> tuple[FloatArray, FloatArray] | None:
    """Return where pilot shots meet the sea, as `ShotPoses.other_sea`: the same in all flights and forecasts.

    Waves come from all directions: which one a survey meets is not known when a gain is chosen. None for a sea that is
    not alike everywhere.
    """
    if sea is None or not isinstance(sea.waves, PeriodicHeights) or sea.wake is not None:
        return None
    places = np.random.default_rng(0).uniform(-_WITHIN, _WITHIN, (count, 2))
    azimuth = 2 * np.pi * np.arange(count) / _GOLDEN
    return places, np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)


def pilots_over(loaded: ShotScene, depth: FloatArray, bottom: float, first_seed: int) -> xr.Dataset:
    """Return pilot shots' light over a flat bottom.

    `loaded`: the scene, for light by maps or by merging. `depth`: bottom depths below each shot [m], at most `bottom`,
    shape (PILOTS,); without effect on merged light. `bottom`: depth of the scene's bottom [m]. `first_seed`: the first
    shot's seed.
    """
    from mitransient_lidar.rendering.shots.batches import ShotPoses, share_for_error
    from mitransient_lidar.rendering.shots.truth import sea_of

    poses = ShotPoses(np.zeros((PILOTS, 2)), other_sea=pilot_sea(sea_of(loaded.session.scene), PILOTS))
    if loaded.light == "maps":
        return rendered(
            loaded, loaded.batches(_MAP_PASSES, 1.0, None), replace(poses, raised=bottom - depth), first_seed
        )
    return rendered(loaded, loaded.batches(MERGED_PASSES, share_for_error(_ERROR), None), poses, first_seed)


def rendered(loaded: ShotScene, batches: ShotBatches, poses: ShotPoses, first_seed: int) -> xr.Dataset:
    """Return the light for any number of shots, as a series contains it."""
    from mitransient_lidar.rendering.shots.batches import ReceivedShots

    numbers = first_seed + np.arange(len(poses))
    parts = [batches.render(poses.part(part), numbers[part].tolist()) for part in batches.parts(len(poses))]
    attributes = loaded.attributes(used=batches.used_values, passes=batches.passes)
    series: xr.Dataset = loaded.dataset(ReceivedShots.joined(parts), attributes)
    return series
