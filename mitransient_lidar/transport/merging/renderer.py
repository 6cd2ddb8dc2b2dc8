"""Passes of bidirectional rendering: light and sensor paths, merged in cells and on patches."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import require_memory
from mitransient_lidar.transport.laser import BeamSampler
from mitransient_lidar.transport.merging.layout import PATCH_PER_CELL, PHOTONS, MergingLayout, MergingOptions
from mitransient_lidar.transport.merging.merge import ConnectionRates, WaterConnections, merge_in_water, merge_on_solids
from mitransient_lidar.transport.merging.patches import SolidPatches, foreshortening
from mitransient_lidar.transport.merging.photon_map import PhotonBuffer, PhotonMap
from mitransient_lidar.transport.merging.segments import PATHS_OF_GROUP, SegmentBuffer, memory_of_path
from mitransient_lidar.transport.opaque import changed, opaque
from mitransient_lidar.transport.paths.passes import PassRenderer, PathClasses, ReceivedLight
from mitransient_lidar.transport.paths.random_walk import RandomWalk, RandomWalkPath
from mitransient_lidar.transport.paths.refracted_connection import connect_laser, perturbed_to_laser
from mitransient_lidar.transport.paths.volpath import VolpathOptions, trace_connected
from mitransient_lidar.transport.probe import Probe
from mitransient_lidar.transport.rng import Shots, tiled
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.sensor.receiver import IMAGE_PIXELS
from mitransient_lidar.transport.solids import met_shape

#: Numbers of the random streams within a pass; the path tracer has number 3.
_COMMON_STREAM, _LIGHT_STREAM, _SENSOR_STREAM = 0, 1, 2
_MERGE_STREAM, _CONNECTION_STREAM, _SOLID_CONNECTION_STREAM, _TURN_STREAM = 4, 5, 6, 7

#: Default numbers of paths and photons in a pass.
_PATHS, _PATHS_PER_PIXEL, _MOST_PATHS = 2**15, 16, 2**21
_PHOTONS_FOR_IMAGES = 2**16

#: Sensor paths for each path of the path tracer, which adds the light that merging leaves out, where that is very weak.
_PATHS_PER_COMPLEMENT_PATH = 16

_COMPLEMENT_PATHS = 1024  # least number of path tracer paths in a pass over all shots
_POINTS_OF_LIGHT = 0.8  #: Expected points on a light path, relative to a straight one, to scale the connection rate.

_CAPACITY_MARGIN = 1.25  #: Capacity for segments and hits over the need of the last pass.

#: One in this many image paths is merged at its points in the water: they took half the time, and bottoms and targets
#: need more paths. Where paths are few, passes have more, as their light takes time, too.
_EVERY_IN_IMAGES, _PATHS_PER_IMAGE_PIXEL, _PATHS_OF_IMAGE = 2, 32, 2**20


def paths_of_pass(options: MergingOptions, pixels: int) -> int:
    """Return the number of sensor paths in a pass for a number of pixels."""
    paths = min(max(_PATHS, _PATHS_PER_PIXEL * pixels), _MOST_PATHS)
    if pixels >= IMAGE_PIXELS:
        paths = max(min(_PATHS_PER_IMAGE_PIXEL * pixels, _PATHS_OF_IMAGE), paths)
    return options.paths_per_pass or paths


class MergingRenderer(PassRenderer):
    """Renders passes of a scene with water by merging, with its own layout or another scene's."""

    def __init__(
        self,
        scene: LidarScene,
        classes: PathClasses,
        options: MergingOptions,
        layout: MergingLayout | None = None,
        connections: bool = True,
    ) -> None:
        pixels = scene.receiver.pixels.count
        probe = Probe(scene)
        self.layout = layout.of_scene_alike(scene) if layout else MergingLayout.of_probe(probe, options)
        super().__init__(scene, classes, paths_of_pass(options, pixels), self.layout.cell_sides, probe)
        self.photons = options.photons_per_pass or (_PHOTONS_FOR_IMAGES if pixels >= IMAGE_PIXELS else PHOTONS)
        self._connections = connections
        self._merges_solids = not scene.has_shared_gaps if options.solids == "auto" else options.solids == "merged"
        self._beam = BeamSampler(scene.transmitter, scene.receiver, self.layout.spread)

    @property
    def path_count(self) -> int:
        """Number of paths in a pass from receiver and laser."""
        return self.paths + self.photons

    @property
    def memory(self) -> tuple[float, float]:
        """Memory of light and paths, which all pixels need [bytes]."""
        return self._memory_of(1, self.paths, self.layout.light_segments, self.layout.sensor_segments), 0.0

    def _memory_of(self, shots: int, paths: int, light: float, sensor: float) -> float:
        """Return the memory of a pass with segments of light and of the receiver's paths, for each of them [bytes]."""
        layout, sums = self.layout, self.scene.perturbations.count
        points = layout.reach / layout.spacing
        of_light = self.photons * memory_of_path(light, points, sums, layout.hits)
        return shots * (of_light + paths // self._every(paths) * memory_of_path(sensor, points, sums))

    @property
    def used_values(self) -> dict[str, float]:
        """Values used for parameters of the integrator that may be automatic; lengths in metres."""
        lengths = {"cell_size": self.layout.patches.width / PATCH_PER_CELL, "point_spacing": self.layout.spacing}
        return {"paths_per_pass": self.paths, "photons_per_pass": self.photons, **lengths}

    def scaled(self, share: float) -> MergingRenderer:
        """Return a renderer for passes with a share of the paths, with the same layout and buffers."""
        paths, photons = (max(round(share * count), 1) for count in (self.paths, self.photons))
        return changed(self, paths=paths, photons=photons)

    def for_smoothing(self, share: float) -> MergingRenderer:
        """Return a renderer for smoothed images; the light, which many pixels share, keeps more of its paths."""
        return changed(
            self, paths=max(round(share * self.paths), 1), photons=max(round(np.cbrt(share) * self.photons), 1)
        )

    def for_differences(self) -> MergingRenderer:
        """Return a renderer with wider cells, between which less light moves."""
        return changed(self, layout=self.layout.coarse())

    def of_shots(self, scene: LidarScene, shots: int) -> MergingRenderer:
        """Return a renderer for a number of shots that meet a scene in parts."""
        return changed(self, scene=scene, layout=self.layout.of_shots(scene, shots, self.photons))

    def repeated(self, scene: LidarScene, copies: int) -> MergingRenderer:
        """Return a renderer of each shot several times in turn, which meet a scene in parts."""
        return changed(self, scene=scene, layout=tiled(self.layout, copies))

    def trace(self, received: ReceivedLight, shots: Shots, paths: int) -> None:
        """Trace the paths of one pass, and add their light."""
        while not self._attempt(received, shots, paths):
            received.clear()
            dr.flush_malloc_cache()  # with the buffers that were too small

    def _attempt(self, received: ReceivedLight, shots: Shots, paths: int) -> bool:
        """Trace one pass; return False, with larger capacities, when a buffer was too small."""
        scene, layout = self.scene, self.layout
        self._fit_segments(shots, paths)
        shifts = shots.uniform(_COMMON_STREAM, 6)
        cells = layout.cells.of_pass(mi.Point4f(shifts[:4]))
        patches = layout.patches.of_pass(scene, mi.Point2f(shifts[4:]))
        points_per_path = _POINTS_OF_LIGHT * layout.reach / layout.spacing
        rates = ConnectionRates.of_pass(scene, cells, self.photons, points_per_path, self._connections)
        light = self._trace_light(received, shots, patches, rates)
        found = None if light is None else self._trace_sensor(received, shots, paths, patches, rates, light.on_patches)
        if light is None or found is None:
            return False
        segments, points = found
        if points > 0:
            self._join(received, shots, segments, points, patches, rates, light)
        # The path tracer adds the light that merging leaves out.
        if self._merges_solids and not scene.has_specular_or_dry_solids:
            paths = max(paths // _PATHS_PER_COMPLEMENT_PATH, _COMPLEMENT_PATHS // shots.count)
        complement = VolpathOptions(complement_only=True, connects_solids=not self._merges_solids)
        trace_connected(scene, self.sampler, complement, received, shots, paths)
        return True

    def _fit_segments(self, shots: Shots, paths: int) -> None:
        """Cut the segment capacities to the memory; raise `UserError` if it cannot hold what a pass needs."""
        layout, count = self.layout, shots.count
        needed, wanted = layout.least_segments, (layout.light_segments, layout.sensor_segments)
        least, most = (self._memory_of(count, paths, *each) for each in (needed, wanted))
        what = f"{count * self.photons} photons and {count * paths} paths"
        taken = require_memory(what, most, "take fewer photons_per_pass or paths_per_pass", least)
        if taken < most:
            share = (taken - least) / (most - least)
            layout.light_segments, layout.sensor_segments = np.add(needed, share * np.subtract(wanted, needed)).tolist()

    def _every(self, paths: int) -> int:
        """Return of how many receiver paths one is merged in the water."""
        is_imager = self.scene.receiver.is_imager
        return _EVERY_IN_IMAGES if is_imager and paths % (_EVERY_IN_IMAGES * PATHS_OF_GROUP) == 0 else 1

    def _trace_light(
        self, received: ReceivedLight, shots: Shots, patches: SolidPatches, rates: ConnectionRates
    ) -> _StoredLight | None:
        """Trace light from the laser; return it, or None when a buffer was too small."""
        layout, lanes, count = self.layout, shots.paths(self.photons), shots.count * self.photons
        scene, patches, rates_of_paths = lanes.pick((self.scene, patches, rates))
        rng = shots.streams(_LIGHT_STREAM, lanes)
        capacity = int(layout.light_segments * count)
        segments = SegmentBuffer(scene, self.classes, layout.spacing, self.photons, capacity, shots.count)
        hits = PhotonBuffer(int(layout.hits * count), self.photons, self.classes, shots.count, scene.perturbations)
        angles, energy = self._beam.sample(lanes.number, self.photons, rng)
        offset = opaque(layout.spacing) * rng.next_float32()
        path = RandomWalkPath.walking(scene, scene.transmitter_pose, angles, energy, offset)
        path.sums = scene.perturbations.at_laser(path.sums, scene.transmitter.profile, angles.x, angles.y)
        walk = RandomWalk(scene, mi.TransportMode.Importance, scene.receiver_pose, scene.axis.path_end, rates_of_paths)

        def store(path: RandomWalkPath, si: mi.SurfaceInteraction3f, active: mi.Bool) -> None:
            if not self._merges_solids:
                return
            # Light may pass a null interface and meet another solid: only one hit of a path can be connected.
            once = ~mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Null)
            connectable = active & once & path.before_first_solid
            patch = patches.locate(si)
            even = path.throughput / foreshortening(dr.abs(dr.dot(si.n, path.direction)), patch.cosine)
            hits.add(path, even, si.p, patch, active, connectable)

        path = walk.run(path, rng, segments, on_solid=store, past_solids=self._merges_solids)
        received.rays = dr.sum(mi.Float64(path.rays))
        dr.schedule(received.rays)
        points, wanted = segments.finalize()
        on_patches, met = hits.sort(shots.count * patches.buckets, shots)
        if wanted > segments.capacity or met > hits.capacity:
            # One more, against rounding.
            layout.least_segments = (wanted + 1) / count, layout.least_segments[1]
            layout.light_segments = max(layout.light_segments, _CAPACITY_MARGIN * layout.least_segments[0])
            layout.hits = max(layout.hits, _CAPACITY_MARGIN * met / count)
            return None
        in_cells = None
        if points > 0:
            index = dr.arange(mi.UInt32, points)
            light, cells = segments.points(index), segments.lanes(index).pick(rates.cells)
            cell = cells.locate(light.point, light.direction, light.unscattered)
            place = shots.count << cells.bits, cell.bucket, cell.tag
            position, u = dr.dot(light.point, light.direction), segments.random(index, shots)
            in_cells = PhotonMap(light, *place, position, u, layout.photons_of_cell, self.classes)
        return _StoredLight(in_cells, segments, points, on_patches, hits)

    def _trace_sensor(
        self,
        received: ReceivedLight,
        shots: Shots,
        paths: int,
        patches: SolidPatches,
        rates: ConnectionRates,
        light: PhotonMap | None,
    ) -> tuple[SegmentBuffer, int] | None:
        """Trace paths from the receiver, and merge them with light on solids.

        Return their segments and the number of points, or None when a buffer was too small.
        """
        layout, lanes, count = self.layout, shots.paths(paths), shots.count * paths
        scene, patches_of_paths, rates_of_paths = lanes.pick((self.scene, patches, rates))
        rng = shots.streams(_SENSOR_STREAM, lanes)
        start = self.sampler.sample_shots(lanes, paths, rng)
        every = self._every(paths)
        count //= every
        capacity = int(layout.sensor_segments * count)
        # At random in each pass, as the places of paths in the view are the same in all.
        turn = mi.UInt32(every * lanes.pick(shots.uniform(_TURN_STREAM, 1)[0])) if every > 1 else None
        segments = SegmentBuffer(scene, self.classes, layout.spacing, paths, capacity, shots.count, every, turn)
        offset = opaque(layout.spacing) * rng.next_float32()
        path = RandomWalkPath.walking(scene, scene.receiver_pose, start.angles, start.weight, offset)
        path.pixel = start.pixel
        walk = RandomWalk(scene, mi.TransportMode.Radiance, scene.transmitter_pose, scene.axis.path_end, rates_of_paths)

        def connect(path: RandomWalkPath, si: mi.SurfaceInteraction3f, active: mi.Bool) -> None:
            radiance, length = connect_laser(scene, si, active)
            path.rays += dr.select(active, mi.UInt32(1), 0)
            energy = path.throughput * radiance
            # No scattering event, and one reversal.
            order, reversals, solid = mi.UInt32(0), mi.UInt32(1), self.classes.solid(met_shape(si))
            sums, length = scene.perturbations.at_solid(path.sums, met_shape(si)), path.length + length
            sums = perturbed_to_laser(scene, sums, si.p, si, active)
            received.receive(path.pixel, order, reversals, solid, length, energy, radiance > 0, sums=sums)

        random = shots.streams(_MERGE_STREAM, lanes)
        merge = merge_on_solids(patches_of_paths, received, light, rates.on_solids, random)
        path = walk.run(path, rng, segments, on_solid=merge, on_first_hit=connect, past_solids=False)
        received.rays += dr.sum(mi.Float64(path.rays))
        dr.schedule(received.rays)
        points, wanted = segments.finalize()
        if wanted > segments.capacity:
            layout.least_segments = layout.least_segments[0], (wanted + 1) / count
            layout.sensor_segments = _CAPACITY_MARGIN * layout.least_segments[1]
            return None
        return segments, points

    def _join(
        self,
        received: ReceivedLight,
        shots: Shots,
        segments: SegmentBuffer,
        points: int,
        patches: SolidPatches,
        rates: ConnectionRates,
        light: _StoredLight,
    ) -> None:
        """Merge the receiver's points with light in their cells, and connect some of them."""
        if light.in_cells is not None:
            index = dr.arange(mi.UInt32, points)
            cells = segments.lanes(index).pick(rates.cells)
            merge_in_water(self.scene, received, segments.points(index), cells, light.in_cells, rates.in_water)
        if rates.per_path:
            connections = WaterConnections(self.scene, received, rates, segments, shots)
            if light.points > 0:
                connections.to_light(light.segments, _CONNECTION_STREAM)
            if light.on_patches is not None:
                connections.to_solids(light.hits, patches, _SOLID_CONNECTION_STREAM)


@dataclass(frozen=True)
class _StoredLight:
    """Light in a pass: its points in cells and by number, and its hits on solids, on patches and by number."""

    in_cells: PhotonMap | None
    segments: SegmentBuffer
    points: int
    on_patches: PhotonMap | None
    hits: PhotonBuffer
