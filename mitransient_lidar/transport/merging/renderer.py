"""Passes of bidirectional rendering: light and sensor paths, merged in cells and on patches."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray, require_memory
from mitransient_lidar.physics.lidar.refraction import refract_level
from mitransient_lidar.transport.laser.beam_sampler import BeamSampler
from mitransient_lidar.transport.merging.cells import MOST_BUCKET_BITS, RefractedProfile, WaterCells, WaterGrid
from mitransient_lidar.transport.merging.connect import ConnectionRates, WaterConnections
from mitransient_lidar.transport.merging.merge import merge_in_water, merge_on_solids, store_points
from mitransient_lidar.transport.merging.patches import MOST_SIDE_BITS, SolidPatches, solids_of_several_levels
from mitransient_lidar.transport.merging.photon_map import PHOTONS_OF_CELL, PhotonBuffer, PhotonMap
from mitransient_lidar.transport.merging.region import Region, SurfaceHeights, beam_entries, least_cell, least_patch
from mitransient_lidar.transport.merging.rings import CORE_PER_SPREAD, BeamRings, cell_widths
from mitransient_lidar.transport.merging.segments import SegmentBuffer, memory_of_path
from mitransient_lidar.transport.merging.spherical_cells import SphericalCells, SphericalGrid, reach_under_water
from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.passes import PassRecord, PassRenderer
from mitransient_lidar.transport.path_classes import PathClasses
from mitransient_lidar.transport.random_walk import RandomWalk, RandomWalkPath
from mitransient_lidar.transport.refracted_connection import connect_laser, perturbed_to_laser
from mitransient_lidar.transport.rng import Shots
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.sensor.receiver import IMAGE_PIXELS, SensorSampler
from mitransient_lidar.transport.solids import met_shape
from mitransient_lidar.transport.volpath import VolpathOptions, trace_connected

#: Numbers of the random streams within a pass; the path tracer has number 3.
_COMMON_STREAM, _LIGHT_STREAM, _SENSOR_STREAM = 0, 1, 2
_MERGE_STREAM, _CONNECTION_STREAM, _SOLID_CONNECTION_STREAM = 4, 5, 6

#: Points from the surface to the bottom, or to the depth that the end of the record allows. In images, half as many
#: points take a third less time and increase the water's variance by a half: more paths are better there.
_POINTS_PER_PATH, _POINTS_PER_IMAGE_PATH = 14, 10

#: Default numbers of paths and photons of a pass.
_PATHS, _PATHS_PER_PIXEL, _MOST_PATHS = 2**15, 16, 2**21
_PHOTONS, _PHOTONS_FOR_IMAGES = 2**15, 2**16

#: Width of the cells at the surface, over the beam's standard deviation there, over the side of the sea's facets, and
#: over the diameter of the field of view, which ripples widen with depth: of larger cells, few would hold the light
#: that is seen.
_CELL_PER_FOOTPRINT, _CELL_PER_FACET, _CELL_PER_VIEW = 0.025, 0.05, 0.02

_CELL_PER_BEAM = 0.05  # width of the cells of a lidar under water, over the beam's standard deviation

#: Growth of the width with depth, over the width at the surface: per metre, for the blur of light patterns by ripples,
#: and per scattering length, for that by scattering.
_GROWTH_PER_METRE, _GROWTH_PER_SCATTERING = 0.4, 0.5

_PATCH_PER_CELL = 3.2  # width of the patches of solids, over that of the cells at the surface

#: Thickness of the cells, over the distance of points and over the attenuation length.
_THICKNESS_PER_SPACING, _THICKNESS_PER_ATTENUATION = 0.5, 0.3

#: Thickness of the uppermost cells, over the depth at which the sea doubles the variance of the beam, over the depth at
#: which neighbouring facets move light by their own side, and over the attenuation length; the last one for beams from
#: whose width scattered light is lost within a cell.
_UPPERMOST_PER_SPREAD, _UPPERMOST_PER_FACET, _UPPERMOST_PER_ATTENUATION = 0.25, 0.1, 0.05

#: Distance on the sea from which light reaches the view in the water, over the standard deviation by which ripples
#: displace light, and over the depth, for scattering.
_SPREAD_PER_BLUR, _SPREAD_PER_DEPTH = 3.0, 0.5

_LEAST_ATTENUATION = 1e-6  # against division by zero [1/m]

#: Sensor paths for each path of the path tracer, which adds the light that merging leaves out, where that is very weak.
_PATHS_PER_COMPLEMENT_PATH = 16

_COMPLEMENT_PATHS = 1024  # least number of paths of the path tracer in a pass of all shots

#: Bits of the number of buckets of a shot above those of its number of photons: of cells, and of patches along both
#: sides.
_BITS_OF_CELLS, _SIDE_BITS_OF_PATCHES = 5, 3

#: Largest width of the cells and patches of shots of few photons, over that of full passes: it halves their noise, and
#: changes the water's signal by 0.3 % in the published geometry.
_WIDEST = 2.0

#: For differences of scenes, width of cells over the least one of a scene, number of photons that are kept of full
#: ones, and width of patches over that of a scene. The noise of differences is that of light that moves from cell to
#: cell, and falls as cells grow. These ones change the signal of the water by 0.2 % in the published geometry, and by
#: up to 2 % in narrow beams.
_COARSE, _PHOTONS_OF_COARSE, _COARSE_PATCHES = 8.0, 32, 2.0

#: Points of a light path that are expected, over those of a straight one, to scale the rate of connections.
_POINTS_OF_LIGHT = 0.8

#: Largest capacity for segments of a path before a pass has needed more: light that is scattered more often is weak;
#: and capacity for segments and hits over the need of the last pass.
_MOST_SEGMENTS, _CAPACITY_MARGIN = 64.0, 1.25


@dataclass(frozen=True)
class MergingOptions:
    """Options of merging, documented in the plugin ``lidar_merging``; None or 0 selects the default."""

    paths_per_pass: int | None = None
    photons_per_pass: int | None = None
    cell_size: float = 0.0
    point_spacing: float = 0.0


@dataclass
class MergingLayout:
    """Points and cells of a scene, and the capacity of buffers for each path.

    Attributes
    ----------
    region
        Region of the sea that is lit or seen.
    entry
        Where the beam meets the sea, relative to where it meets its mean level [m], shape (3,).
    uneven
        Solids of several levels.
    grid
        Layout of the cells.
    rings
        Rings about the beam, for patches.
    spacing
        Distance between points along a path [m].
    reach, depth
        Mean distance in the water along the axis to a solid or to the record's end, and its depth [m].
    patch_width, least_patch
        Width of the patches of solids on the axis at the surface, and the least one on the solids [m].
    growth
        Growth of unscattered light with depth by ripples [1/m].
    widening
        Largest growth of cells and patches with depth, of those that a narrow view limits at the surface.
    spread
        Distance from the view, on the sea, from which light reaches the view in the water [m].
    light_segments, sensor_segments, hits
        Capacities for segments and hits of solids of each path; they grow when a pass needs more.
    least_segments
        Segments of each path of light and of sensors that a pass has been found to need, or one.
    side_bits
        Logarithm to base 2 of the number of buckets of patches along one side.
    widens
        Whether cells and patches are wider for shots of few photons: their width is automatic.
    photons_of_cell
        Number of photons that are kept of full cells.
    """

    region: Region
    entry: FloatArray
    uneven: list[mi.Shape]
    grid: WaterGrid | SphericalGrid
    rings: BeamRings
    spacing: float
    reach: float
    depth: float
    patch_width: float
    least_patch: float
    growth: float | None
    light_segments: float
    sensor_segments: float
    hits: float = 2.0
    least_segments: tuple[float, float] = (1.0, 1.0)
    widening: float = 1.0
    spread: float = 0.0
    side_bits: int = MOST_SIDE_BITS
    photons_of_cell: int = PHOTONS_OF_CELL
    widens: bool = True

    def of_shots(self, scene: LidarScene, shots: int, photons: int) -> MergingLayout:
        """Return the layout of shots that meet a scene in parts, with a number of photons each."""
        bits = math.ceil(math.log2(photons))
        wider = min((_PHOTONS / photons) ** (1 / 3), _WIDEST) if self.widens else 1.0
        side_bits = min(MOST_SIDE_BITS, -(-(bits + _SIDE_BITS_OF_PATCHES) // 2))
        grid, rings = self.grid, self.rings
        if isinstance(grid, WaterGrid):
            entries = beam_entries(scene, shots)
            heights = SurfaceHeights(scene, self.region, self.depth, entries[:, :2] - self.entry[:2])
            buckets = min(MOST_BUCKET_BITS, max(bits + _BITS_OF_CELLS, grid.bits_z + 2))
            axes = None if scene.transmitter_poses is None else scene.transmitter_poses.axis
            rings = grid.rings.of_entries(entries, axes, scene.mean_slopes(shots))
            grid = grid.of_shots(heights, rings, max(wider, 1.0), buckets)
        # A copy has capacities of its own.
        uneven = solids_of_several_levels(scene, self.region, shots)
        patch_width = self.patch_width * max(wider, 1.0)
        return replace(self, grid=grid, rings=rings, uneven=uneven, side_bits=side_bits, patch_width=patch_width)

    def repeated(self, copies: int) -> MergingLayout:
        """Return the layout of each shot several times in turn."""
        grid, rings = self.grid, self.rings
        if isinstance(grid, WaterGrid):
            grid = grid.repeated(copies)
            rings = grid.rings
        return replace(self, grid=grid, rings=rings)

    def coarse(self) -> MergingLayout:
        """Return a layout with the same points and wider cells, for differences of scenes."""
        grid = self.grid.of_even_width(_COARSE) if isinstance(self.grid, WaterGrid) else self.grid
        width = _COARSE_PATCHES * self.patch_width
        return replace(self, grid=grid, patch_width=width, photons_of_cell=_PHOTONS_OF_COARSE)

    def of_scene_alike(self, scene: LidarScene) -> MergingLayout:
        """Return the same points and cells for a scene that differs a little, whose solids may be other objects.

        Cells go with the beam, as the sea refracts it, with the sea surface and with the solids where they end: most
        light of the same random numbers stays in its cell, and light near a surface that moves is right.
        """
        uneven, grid = solids_of_several_levels(scene, self.region), self.grid
        if not isinstance(grid, WaterGrid):
            return replace(self, uneven=uneven)
        rings = grid.rings.alike(scene.transmitter.pose, beam_entries(scene), scene.mean_slopes(1))
        heights = SurfaceHeights(scene, self.region, self.depth)
        return replace(self, uneven=uneven, grid=grid.moved(heights, rings), rings=rings)

    @classmethod
    def of_scene(cls, scene: LidarScene, sampler: SensorSampler, options: MergingOptions) -> MergingLayout:
        """Choose points and cells for a scene."""
        if scene.submerged:
            region, reach, nearest = reach_under_water(scene, sampler)
        else:
            region = Region.of_scene(scene, sampler)
            reach = region.track_length(scene)
        uneven = solids_of_several_levels(scene, region)
        finest = options.point_spacing or reach / _POINTS_PER_PATH
        is_image = scene.receiver.pixels.count >= IMAGE_PIXELS
        spacing = options.point_spacing or reach / (_POINTS_PER_IMAGE_PATH if is_image else _POINTS_PER_PATH)
        column = scene.required_water.column
        thickness = _THICKNESS_PER_SPACING * finest
        attenuation, scattering = float(column.attenuation.max()), float(column.scattering.max())
        if attenuation > 0:
            thickness = min(thickness, _THICKNESS_PER_ATTENUATION / attenuation)
        # Rounded, so that other shots use the same kernels.
        segments = min(0.5 * np.ceil(3 * (1 + scattering * reach)) + 1, _MOST_SEGMENTS)
        pose = scene.transmitter.pose
        if scene.submerged:
            spread = scene.transmitter.angular_spread * nearest
            width = cell_widths(options.cell_size, spread, 0.0)[0] or _CELL_PER_BEAM * spread
            grid: WaterGrid | SphericalGrid = SphericalGrid(scene, thickness)
            rings = BeamRings(pose, spread, 1.0, 0.0)
            depth = nearest * max(-float(pose.axis[2]), 0.0) - float(pose.origin[2])
            patches = _PATCH_PER_CELL * width, least_patch(scene)
            return cls(
                *(region, np.zeros(3), uneven, grid, rings, spacing, reach, depth, *patches, None, segments, segments),
                widens=not options.cell_size,
            )
        footprint = scene.transmitter.angular_spread * pose.ground_range
        entries = beam_entries(scene)
        rings = BeamRings(pose, footprint, scene.refractive_index, tilt=scene.mean_slopes(1)).of_entries(entries)
        # Cells are longer along the azimuth of the beam: the mean of their sides counts.
        facet = scene.facet_size * float(np.sqrt(max(-pose.axis[2], 0.0)))
        view = scene.receiver.pixels.field_of_view * scene.receiver.pose.ground_range
        given, longest = cell_widths(options.cell_size, footprint, attenuation * bool(pose.axis[2] < 0))
        widest = given or min(_CELL_PER_FOOTPRINT * footprint, _CELL_PER_FACET * facet)
        width = given or min(max(_CELL_PER_VIEW * view, least_cell(scene, reach)), widest)
        growth = _GROWTH_PER_METRE + _GROWTH_PER_SCATTERING * float(column.scattering.min())
        core = CORE_PER_SPREAD * footprint
        depth = reach * -float(refract_level(pose.axis, scene.refractive_index)[2])
        heights = SurfaceHeights(scene, region, depth)
        beam = scene.transmitter.profile
        squares = np.square([np.cos(beam.rotation), np.sin(beam.rotation)])
        spreads = np.sqrt([squares @ np.square(beam.spreads), squares[::-1] @ np.square(beam.spreads)])
        along, across = (spreads * footprint / scene.transmitter.angular_spread).tolist()
        profile = RefractedProfile(scene, (along, across))
        uppermost = min(
            _UPPERMOST_PER_SPREAD * profile.depth,
            _UPPERMOST_PER_FACET * scene.facet_size / profile.shift_by_facets,
            max(_UPPERMOST_PER_ATTENUATION / max(float(column.attenuation[0]), _LEAST_ATTENUATION), footprint),
        )
        # The standard deviation of even light in the field of view is a quarter of its diameter.
        by_ripples = profile.growth(most=0.25 * view)
        grid = WaterGrid(
            *(rings, heights, profile, min(width, longest) / core, growth, thickness, uppermost, reach),
            view_growth=by_ripples,
            widening=min(widest, longest) / min(width, longest),
        )
        patches = _PATCH_PER_CELL * width, least_patch(scene)
        return cls(
            *(region, entries[0], uneven, grid, rings, spacing, reach, depth, *patches, by_ripples, segments, segments),
            widening=widest / width,
            spread=(_SPREAD_PER_BLUR * profile.blur + _SPREAD_PER_DEPTH) * depth,
            widens=not options.cell_size,
        )


def paths_of_pass(options: MergingOptions, pixels: int) -> int:
    """Return the number of sensor paths of a pass for a number of pixels."""
    return options.paths_per_pass or min(max(_PATHS, _PATHS_PER_PIXEL * pixels), _MOST_PATHS)


class MergingRenderer(PassRenderer):
    """Renders passes of a scene with water by merging, with its own layout or that of another scene."""

    def __init__(
        self,
        scene: LidarScene,
        classes: PathClasses,
        options: MergingOptions,
        layout: MergingLayout | None = None,
        connections: bool = True,
    ) -> None:
        pixels = scene.receiver.pixels.count
        super().__init__(scene, classes, paths_of_pass(options, pixels))
        photons = _PHOTONS_FOR_IMAGES if pixels >= IMAGE_PIXELS else _PHOTONS
        self.photons = options.photons_per_pass or photons
        self.layout = layout.of_scene_alike(scene) if layout else MergingLayout.of_scene(scene, self.sampler, options)
        self._connections = connections
        self._beam = BeamSampler(scene.transmitter, scene.receiver, self.layout.spread)

    @property
    def path_count(self) -> int:
        """Number of paths of a pass from receiver and laser."""
        return self.paths + self.photons

    @property
    def used_values(self) -> dict[str, float]:
        """Values used for parameters of the integrator that may be automatic; lengths in metres."""
        lengths = {"cell_size": self.layout.patch_width / _PATCH_PER_CELL, "point_spacing": self.layout.spacing}
        return {"paths_per_pass": self.paths, "photons_per_pass": self.photons, **lengths}

    def scaled(self, share: float) -> MergingRenderer:
        """Return a renderer of passes with a share of the paths, with the same layout and buffers."""
        scaled = copy.copy(self)
        scaled.paths, scaled.photons = (max(round(share * count), 1) for count in (self.paths, self.photons))
        return scaled

    def for_differences(self) -> MergingRenderer:
        """Return a renderer with wider cells, between which less light moves."""
        coarse = copy.copy(self)
        coarse.layout = self.layout.coarse()
        return coarse

    def of_shots(self, scene: LidarScene, shots: int) -> MergingRenderer:
        """Return a renderer of a number of shots that meet a scene in parts."""
        moved = copy.copy(self)
        moved.scene, moved.layout = scene, self.layout.of_shots(scene, shots, self.photons)
        return moved

    def repeated(self, scene: LidarScene, copies: int) -> MergingRenderer:
        """Return a renderer of each shot several times in turn, which meet a scene in parts."""
        several = copy.copy(self)
        several.scene, several.layout = scene, self.layout.repeated(copies)
        return several

    def trace(self, record: PassRecord, shots: Shots, paths: int) -> None:
        """Trace the paths of one pass into a record."""
        while not self._attempt(record, shots, paths):
            record.clear()
            dr.flush_malloc_cache()  # with the buffers that were too small

    def _attempt(self, record: PassRecord, shots: Shots, paths: int) -> bool:
        """Trace one pass; return False, with larger capacities, when a buffer was too small."""
        scene, layout = self.scene, self.layout
        self._fit_segments(shots, paths)
        shifts = shots.uniform(_COMMON_STREAM, 6)
        cells = layout.grid.cells(mi.Point4f(shifts[:4]))
        patches = SolidPatches(
            *(scene, layout.region, layout.rings, layout.depth, layout.patch_width),
            mi.Point2f(shifts[4:]),
            *(layout.uneven, layout.side_bits, layout.least_patch, layout.growth, layout.widening),
        )
        points_per_path = _POINTS_OF_LIGHT * layout.reach / layout.spacing
        rates = ConnectionRates.of_pass(scene, cells, self.photons, points_per_path, self._connections)
        light = self._trace_light(record, shots, cells, patches, rates)
        if light is None or not self._trace_sensor(record, shots, paths, cells, patches, rates, light):
            return False
        # The path tracer adds the light that merging leaves out.
        if not scene.has_specular_or_dry_solids:
            paths = max(paths // _PATHS_PER_COMPLEMENT_PATH, _COMPLEMENT_PATHS // shots.count)
        trace_connected(scene, self.sampler, VolpathOptions(complement_only=True), record, shots, paths)
        return True

    def _fit_segments(self, shots: Shots, paths: int) -> None:
        """Cut the capacities for segments to the memory; raise `UserError` if it cannot hold what a pass needs."""
        layout, count, sums = self.layout, shots.count, self.scene.perturbations.count
        points = layout.reach / layout.spacing

        def size(light: float, sensor: float) -> float:
            of_light = self.photons * memory_of_path(light, points, sums, layout.hits)
            return count * (of_light + paths * memory_of_path(sensor, points, sums))

        needed, wanted = layout.least_segments, (layout.light_segments, layout.sensor_segments)
        least, most = size(*needed), size(*wanted)
        what = f"{count * self.photons} photons and {count * paths} paths"
        taken = require_memory(what, most, "take fewer photons_per_pass or paths_per_pass", least)
        if taken < most:
            share = (taken - least) / (most - least)
            layout.light_segments, layout.sensor_segments = np.add(needed, share * np.subtract(wanted, needed)).tolist()

    def _trace_light(
        self,
        record: PassRecord,
        shots: Shots,
        cells: WaterCells | SphericalCells,
        patches: SolidPatches,
        rates: ConnectionRates,
    ) -> _StoredLight | None:
        """Trace light from the laser; return it, or None when a buffer was too small."""
        layout, lanes, count = self.layout, shots.paths(self.photons), shots.count * self.photons
        scene, patches, rng = self.scene.of(lanes), patches.of(lanes), shots.streams(_LIGHT_STREAM, lanes)
        capacity = int(layout.light_segments * count)
        segments = SegmentBuffer(scene, self.classes, layout.spacing, self.photons, capacity, shots.count)
        hits = PhotonBuffer(int(layout.hits * count), self.photons, self.classes, shots.count, scene.perturbations)
        angles, energy = self._beam.sample(lanes.number, self.photons, rng)
        offset = opaque(layout.spacing) * rng.next_float32()
        path = RandomWalkPath.start(scene, scene.transmitter_pose, angles, energy, offset)
        path.sums = scene.perturbations.at_laser(path.sums, scene.transmitter.profile, angles.x, angles.y)
        walk = RandomWalk(scene, mi.TransportMode.Importance, scene.receiver_pose, scene.axis.path_end, rates.of(lanes))

        def store(
            path: RandomWalkPath, si: mi.SurfaceInteraction3f, inverse_density: mi.Float, active: mi.Bool
        ) -> None:
            # Light may pass a null interface and meet another solid: only one hit of a path can be connected.
            once = ~mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Null)
            hits.add(path, si.p, patches.locate(si), active, active & once & path.before_first_solid)

        path = walk.run(path, rng, mi.UInt32(0), segments, on_solid=store, past_solids=True)
        record.rays = dr.sum(mi.Float64(path.rays))
        dr.schedule(record.rays)
        points, wanted = segments.finalize()
        on_patches, met = hits.sort(shots.count * patches.buckets, shots)
        if wanted > segments.capacity or met > hits.capacity:
            # One more, against rounding.
            layout.least_segments = (wanted + 1) / count, layout.least_segments[1]
            layout.light_segments = max(layout.light_segments, _CAPACITY_MARGIN * layout.least_segments[0])
            layout.hits = max(layout.hits, _CAPACITY_MARGIN * met / count)
            return None
        in_cells = store_points(segments, points, cells, self.classes, shots, layout.photons_of_cell)
        return _StoredLight(in_cells, segments, points, on_patches, hits)

    def _trace_sensor(
        self,
        record: PassRecord,
        shots: Shots,
        paths: int,
        cells: WaterCells | SphericalCells,
        patches: SolidPatches,
        rates: ConnectionRates,
        light: _StoredLight,
    ) -> bool:
        """Trace paths from the receiver and join them with light; return False when a buffer was too small."""
        layout, lanes, count = self.layout, shots.paths(paths), shots.count * paths
        scene, patches_of_paths = self.scene.of(lanes), patches.of(lanes)
        rng = shots.streams(_SENSOR_STREAM, lanes)
        start = self.sampler.sample_shots(lanes, paths, rng)
        capacity = int(layout.sensor_segments * count)
        segments = SegmentBuffer(scene, self.classes, layout.spacing, paths, capacity, shots.count)
        offset = opaque(layout.spacing) * rng.next_float32()
        path = RandomWalkPath.start(scene, scene.receiver_pose, start.angles, start.weight, offset)
        walk = RandomWalk(
            scene, mi.TransportMode.Radiance, scene.transmitter_pose, scene.axis.path_end, rates.of(lanes)
        )

        def connect(path: RandomWalkPath, si: mi.SurfaceInteraction3f, active: mi.Bool) -> None:
            radiance, length = connect_laser(scene, si, active)
            path.rays += dr.select(active, mi.UInt32(1), 0)
            energy = path.throughput * radiance
            # No scattering event, and one reversal.
            order, reversals, solid = mi.UInt32(0), mi.UInt32(1), self.classes.solid(met_shape(si))
            sums, length = scene.perturbations.at_solid(path.sums, met_shape(si)), path.length + length
            sums = perturbed_to_laser(scene, sums, si.p, si, active)
            record.receive(start.pixel, order, reversals, solid, length, energy, radiance > 0, sums=sums)

        of_merges = shots.streams(_MERGE_STREAM, lanes)
        merge = merge_on_solids(patches_of_paths, record, light.on_patches, start.pixel, rates.on_solids, of_merges)
        path = walk.run(path, rng, start.pixel, segments, on_solid=merge, on_first_hit=connect, past_solids=False)
        record.rays += dr.sum(mi.Float64(path.rays))
        dr.schedule(record.rays)
        points, wanted = segments.finalize()
        if wanted > segments.capacity:
            layout.least_segments = layout.least_segments[0], (wanted + 1) / count
            layout.sensor_segments = _CAPACITY_MARGIN * layout.least_segments[1]
            return False
        if points == 0:
            return True
        if light.in_cells is not None:
            index = dr.arange(mi.UInt32, points)
            cells = cells.of(segments.lanes(index))
            merge_in_water(scene, record, segments.points(index), cells, light.in_cells, rates.in_water)
        if rates.per_path:
            connections = WaterConnections(self.scene, record, rates, segments, shots)
            if light.points > 0:
                connections.to_light(light.segments, _CONNECTION_STREAM)
            if light.on_patches is not None:
                connections.to_solids(light.hits, patches, _SOLID_CONNECTION_STREAM)
        return True


@dataclass(frozen=True)
class _StoredLight:
    """Light of a pass: its points in cells and by number, and its hits of solids on patches and by number."""

    in_cells: PhotonMap | None
    segments: SegmentBuffer
    points: int
    on_patches: PhotonMap | None
    hits: PhotonBuffer
