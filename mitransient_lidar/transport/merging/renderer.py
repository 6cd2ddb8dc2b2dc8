"""Passes of bidirectional rendering: light and sensor paths, merged in cells and on patches."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.transport.laser.beam_sampler import BeamSampler
from mitransient_lidar.transport.merging.cells import Region, SurfaceHeights, WaterCells, WaterGrid
from mitransient_lidar.transport.merging.merge import merge_in_water, merge_on_solids, store_points
from mitransient_lidar.transport.merging.patches import SolidPatches, solids_of_several_levels
from mitransient_lidar.transport.merging.photon_map import PhotonBuffer, PhotonMap
from mitransient_lidar.transport.merging.segments import SegmentBuffer
from mitransient_lidar.transport.merging.spherical_cells import SphericalCells, SphericalGrid, reach_under_water
from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.passes import PassRecord, PassRenderer
from mitransient_lidar.transport.path_classes import PathClasses
from mitransient_lidar.transport.random_walk import RandomWalk, RandomWalkPath
from mitransient_lidar.transport.refracted_connection import connect_laser
from mitransient_lidar.transport.rng import pass_streams
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.sensor.receiver import SensorSampler
from mitransient_lidar.transport.volpath import VolpathOptions, trace_connected

#: Numbers of the random streams within a pass; the path tracer has the next one.
_COMMON_STREAM, _LIGHT_STREAM, _SENSOR_STREAM = 0, 1, 2

#: Points from the surface to the bottom, or to the depth that the end of the record allows. In images, half as many
#: points take a third less time and increase the water's variance by a half: more paths are better there.
_POINTS_PER_PATH, _POINTS_PER_IMAGE_PATH = 20, 10

#: Default numbers of paths and photons of a pass.
_PATHS, _PATHS_PER_PIXEL, _MOST_PATHS = 2**15, 16, 2**21
_PHOTONS, _PHOTONS_FOR_IMAGES = 2**15, 2**16

#: Number of pixels from which a receiver is an imager.
_IMAGE_PIXELS = 4096

#: Width of the cells at the surface, over the beam's standard deviation there and over the side of the sea's facets.
_CELL_PER_FOOTPRINT, _CELL_PER_FACET = 0.0125, 0.05

#: Width of the cells of a lidar under water, from which that of patches follows, over the beam's standard deviation.
_CELL_PER_BEAM = 0.05

#: Growth of the width with depth, over the width at the surface: per metre, for the blur of light patterns by ripples,
#: and per scattering length, for that by scattering.
_GROWTH_PER_METRE, _GROWTH_PER_SCATTERING = 0.4, 0.5

#: Width of the patches of solids, over the width of the cells at the surface.
_PATCH_PER_CELL = 3.2

#: Thickness of the cells, over the distance of points and over the attenuation length.
_THICKNESS_PER_SPACING, _THICKNESS_PER_ATTENUATION = 0.35, 0.3

#: Sensor paths for each path of the path tracer, which adds the light that merging leaves out, where that is very weak.
_PATHS_PER_COMPLEMENT_PATH = 16

#: Capacity for segments and hits over the need of the last pass.
_CAPACITY_MARGIN = 1.25


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
    uneven
        Solids of several levels.
    grid
        Layout of the cells.
    spacing
        Distance between points along a path [m].
    patch_width
        Width of the patches of solids [m].
    light_segments, sensor_segments, hits
        Capacities for segments and hits of solids of each path; they grow when a pass needs more.
    """

    region: Region
    uneven: list[mi.Shape]
    grid: WaterGrid | SphericalGrid
    spacing: float
    patch_width: float
    light_segments: float
    sensor_segments: float
    hits: float = 2.0

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
        is_image = scene.receiver.pixels.count >= _IMAGE_PIXELS
        spacing = options.point_spacing or reach / (_POINTS_PER_IMAGE_PATH if is_image else _POINTS_PER_PATH)
        column = scene.water.column
        thickness = _THICKNESS_PER_SPACING * finest
        attenuation, scattering = float(column.attenuation.max()), float(column.scattering.max())
        if attenuation > 0:
            thickness = min(thickness, _THICKNESS_PER_ATTENUATION / attenuation)
        # Rounded, so that other shots use the same kernels.
        segments = 0.5 * np.ceil(3 * (1 + scattering * reach)) + 1
        pose = scene.transmitter.pose
        if scene.submerged:
            width = options.cell_size or _CELL_PER_BEAM * scene.transmitter.angular_spread * nearest
            grid: WaterGrid | SphericalGrid = SphericalGrid(scene, thickness)
            return cls(region, uneven, grid, spacing, _PATCH_PER_CELL * width, segments, segments)
        footprint = scene.transmitter.angular_spread * float(np.linalg.norm(pose.ground_point() - pose.origin))
        width = options.cell_size or min(_CELL_PER_FOOTPRINT * footprint, _CELL_PER_FACET * scene.facet_size)
        growth = width * (_GROWTH_PER_METRE + _GROWTH_PER_SCATTERING * float(column.scattering.min()))
        grid = WaterGrid(scene, SurfaceHeights(scene, region), width, growth, thickness, reach)
        return cls(region, uneven, grid, spacing, _PATCH_PER_CELL * width, segments, segments)


def paths_of_pass(options: MergingOptions, pixels: int) -> int:
    """Return the number of sensor paths of a pass for a number of pixels."""
    return options.paths_per_pass or min(max(_PATHS, _PATHS_PER_PIXEL * pixels), _MOST_PATHS)


class MergingRenderer(PassRenderer):
    """Renders passes of a scene with water by merging, with its own layout or that of another scene."""

    def __init__(
        self, scene: LidarScene, classes: PathClasses, options: MergingOptions, layout: MergingLayout | None = None
    ) -> None:
        pixels = scene.receiver.pixels.count
        super().__init__(scene, classes, paths_of_pass(options, pixels))
        photons = _PHOTONS_FOR_IMAGES if pixels >= _IMAGE_PIXELS else _PHOTONS
        self.photons = options.photons_per_pass or photons
        self.layout = layout or MergingLayout.of_scene(scene, self.sampler, options)
        self._beam = BeamSampler(scene.transmitter, scene.receiver)

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

    def trace(self, record: PassRecord, seed: int, paths: int) -> None:
        """Trace the paths of one pass into a record."""
        while not self._attempt(record, seed, paths):
            record.clear()

    def _attempt(self, record: PassRecord, seed: int, paths: int) -> bool:
        """Trace one pass; return False, with larger capacities, when a buffer was too small."""
        scene, layout = self.scene, self.layout
        common = np.random.default_rng([seed, _COMMON_STREAM]).random(5, np.float32)
        shifts = [dr.opaque(mi.Float, float(shift)) for shift in common]
        cells = layout.grid.cells(mi.Point3f(shifts[:3]))
        patches = SolidPatches(scene, layout.region, layout.patch_width, mi.Point2f(shifts[3:]), layout.uneven)
        light = self._trace_light(record, seed, cells, patches)
        if light is None or not self._trace_sensor(record, seed, paths, cells, patches, *light):
            return False
        # The path tracer adds the light that merging leaves out.
        if not scene.has_specular_or_dry_solids:
            paths = max(paths // _PATHS_PER_COMPLEMENT_PATH, 1024)
        trace_connected(scene, self.sampler, VolpathOptions(complement_only=True), record, seed, paths)
        return True

    def _trace_light(
        self, record: PassRecord, seed: int, cells: WaterCells | SphericalCells, patches: SolidPatches
    ) -> tuple[PhotonMap | None, PhotonMap | None] | None:
        """Trace light from the laser; return photons in cells and on patches, or None when a buffer was too small."""
        scene, layout, count = self.scene, self.layout, self.photons
        rng = pass_streams(seed, _LIGHT_STREAM, count)
        segments = SegmentBuffer(scene.water, self.classes, layout.spacing, int(layout.light_segments * count))
        hits = PhotonBuffer(int(layout.hits * count), self.classes)
        angles, energy = self._beam.sample(dr.arange(mi.UInt32, count), count, rng)
        offset = opaque(layout.spacing) * rng.next_float32()
        path = RandomWalkPath.start(scene, scene.transmitter.pose, angles, energy, offset)
        walk = RandomWalk(
            *(scene, mi.TransportMode.Importance, scene.receiver.pose, scene.axis.path_end, cells.relative_volume)
        )

        def store(path: RandomWalkPath, si: mi.SurfaceInteraction3f, active: mi.Bool) -> None:
            hits.add(path, patches.locate(si), active)

        path = walk.run(path, rng, mi.UInt32(0), segments, on_solid=store, past_solids=True)
        record.rays = dr.sum(mi.Float64(path.rays))
        dr.schedule(record.rays)
        points, wanted = segments.finalize()
        on_patches, met = hits.sort(SolidPatches.buckets)
        if wanted > segments.capacity or met > hits.capacity:
            layout.light_segments = max(layout.light_segments, _CAPACITY_MARGIN * wanted / count)
            layout.hits = max(layout.hits, _CAPACITY_MARGIN * met / count)
            return None
        return store_points(segments, points, cells, self.classes), on_patches

    def _trace_sensor(
        self,
        record: PassRecord,
        seed: int,
        count: int,
        cells: WaterCells | SphericalCells,
        patches: SolidPatches,
        in_water: PhotonMap | None,
        on_patches: PhotonMap | None,
    ) -> bool:
        """Trace paths from the receiver and merge them with light; return False when a buffer was too small."""
        scene, layout = self.scene, self.layout
        rng = pass_streams(seed, _SENSOR_STREAM, count)
        start = self.sampler.sample(dr.arange(mi.UInt32, count), count, rng)
        segments = SegmentBuffer(scene.water, self.classes, layout.spacing, int(layout.sensor_segments * count))
        offset = opaque(layout.spacing) * rng.next_float32()
        path = RandomWalkPath.start(scene, scene.receiver.pose, start.angles, start.weight, offset)
        walk = RandomWalk(
            *(scene, mi.TransportMode.Radiance, scene.transmitter.pose, scene.axis.path_end, cells.relative_volume)
        )

        def connect(path: RandomWalkPath, si: mi.SurfaceInteraction3f, active: mi.Bool) -> None:
            radiance, length = connect_laser(scene, si, active)
            path.rays += dr.select(active, mi.UInt32(1), 0)
            energy = path.throughput * radiance
            # No scattering event, and one reversal.
            record.receive(start.pixel, mi.UInt32(0), mi.UInt32(1), path.length + length, energy, radiance > 0)

        merge = merge_on_solids(patches, record, on_patches, start.pixel, rng)
        path = walk.run(path, rng, start.pixel, segments, on_solid=merge, on_first_hit=connect, past_solids=False)
        record.rays += dr.sum(mi.Float64(path.rays))
        dr.schedule(record.rays)
        points, wanted = segments.finalize()
        if wanted > segments.capacity:
            layout.sensor_segments = max(layout.sensor_segments, _CAPACITY_MARGIN * wanted / count)
            return False
        if in_water is not None and points > 0:
            index = dr.arange(mi.UInt32, points)
            u = mi.sample_tea_float32(index, dr.opaque(mi.UInt32, seed & 0xFFFFFFFF))
            merge_in_water(scene, record, segments.points(index), cells, in_water, u)
        return True
