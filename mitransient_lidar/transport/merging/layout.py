"""Where light and receiver paths are merged: points along paths, cells in the water, and patches on solids."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.level_sea import refract_level
from mitransient_lidar.transport.merging.cells import MOST_BUCKET_BITS, RefractedProfile, SphericalCells, WaterCells
from mitransient_lidar.transport.merging.patches import MOST_SIDE_BITS, SolidPatches, solids_of_several_levels
from mitransient_lidar.transport.merging.photon_map import PHOTONS_OF_CELL
from mitransient_lidar.transport.merging.region import Region, SurfaceHeights, beam_entries, reach_under_water
from mitransient_lidar.transport.merging.rings import CORE_PER_SPREAD, BeamRings, cell_widths
from mitransient_lidar.transport.probe import Probe
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.sensor.receiver import IMAGE_PIXELS

#: Points from the surface to the bottom, or to the depth that the end of the record allows. In images, half as many
#: points take a third less time and increase the water's variance by a half: more paths are better there.
_POINTS_PER_PATH, _POINTS_PER_IMAGE_PATH = 14, 10

PHOTONS = 2**15  #: Photons in a full pass.

#: Cell width at the surface, relative to the beam's standard deviation there, to the sea's facet side, and to the
#: field-of-view diameter, which ripples widen with depth: few larger cells would contain the visible light.
_CELL_PER_FOOTPRINT, _CELL_PER_FACET, _CELL_PER_VIEW = 0.025, 0.05, 0.02

_CELL_PER_BEAM = 0.05  # cell width for a lidar under water, over the beam's standard deviation

#: Growth of the width with depth, relative to the width at the surface: per metre, as ripples blur light patterns, and
#: per scattering length, as scattering blurs them.
_GROWTH_PER_METRE, _GROWTH_PER_SCATTERING = 0.4, 0.5

PATCH_PER_CELL = 3.2  # patch width on solids, over the cell width at the surface

#: Cell thickness, over the point distance and over the attenuation length.
_THICKNESS_PER_SPACING, _THICKNESS_PER_ATTENUATION = 0.5, 0.3

#: Thickness of the uppermost cells: over the depth at which the sea doubles the beam's variance, over the depth at
#: which neighbouring facets move light by their own side, and over the attenuation length. The last one is for beams so
#: narrow that scattered light leaves them within a cell.
_UPPERMOST_PER_SPREAD, _UPPERMOST_PER_FACET, _UPPERMOST_PER_ATTENUATION = 0.25, 0.1, 0.05

#: Distance on the sea from which light reaches the view in the water: over the standard deviation by which ripples
#: displace light, and over the depth, for scattering.
_SPREAD_PER_BLUR, _SPREAD_PER_DEPTH = 3.0, 0.5

_LEAST_ATTENUATION = 1e-6  # against division by zero [1/m]

#: Least patch width over the largest solid's size, eight times the rounding of positions on it. Least cell width over
#: the largest coordinate of the lidar's spot and of the water below, where a narrow view limits the cells.
_PATCH_PER_SOLID, _CELL_PER_COORDINATE = 2**-22, 2**-21

#: Extra bits for a shot's buckets, beyond the bits for its photons: for cells, and for patches along both sides.
_BITS_OF_CELLS, _SIDE_BITS_OF_PATCHES = 5, 3

#: Largest cell and patch width for shots with few photons, relative to full passes: it halves their noise, and changes
#: the water's signal by 0.3 % in the published geometry.
_WIDEST = 2.0

#: For differences between scenes: cell width over a scene's least one, number of photons kept in full cells, and patch
#: width over a scene's. Light that moves from cell to cell causes the noise of differences, which falls as cells grow.
#: These cells change the water's signal by 0.2 % in the published geometry, and by up to 2 % in narrow beams.
_COARSE, _PHOTONS_OF_COARSE, _COARSE_PATCHES = 8.0, 32, 2.0

#: Largest capacity for segments of a path before a pass has needed more: light that is scattered more often is weak.
_MOST_SEGMENTS = 64.0


@dataclass(frozen=True)
class MergingOptions:
    """Merging options, documented in the plugin ``lidar_merging``; None or 0 selects the default."""

    paths_per_pass: int | None = None
    photons_per_pass: int | None = None
    cell_size: float = 0.0
    point_spacing: float = 0.0
    solids: str = "auto"


@dataclass
class MergingLayout:
    """Points, cells and patches in a scene, and buffer capacities per path."""

    OF_SHOTS = ("cells", "patches")

    entry: FloatArray  #: Where the beam meets the sea, relative to where it meets its mean level [m], shape (3,).
    #: Cells in the water, and patches on solids.
    cells: WaterCells | SphericalCells
    patches: SolidPatches
    #: Distance between points along a path [m], and mean distance in the water along the axis to a solid or to the
    #: record's end [m].
    spacing: float
    reach: float
    #: Capacities for segments and solid hits per path; they grow when a pass needs more.
    light_segments: float
    sensor_segments: float
    hits: float = 2.0
    #: Segments per path of light and of sensors that a pass has needed, or one.
    least_segments: tuple[float, float] = (1.0, 1.0)
    spread: float = 0.0  #: Distance from the view, on the sea, from which light reaches the view in the water [m].
    photons_of_cell: int = PHOTONS_OF_CELL  #: Number of photons kept in full cells.
    widens: bool = True  #: Whether cells and patches are wider for shots with few photons: their width is automatic.

    def of_shots(self, scene: LidarScene, shots: int, photons: int) -> MergingLayout:
        """Return the layout for shots that meet a scene in parts, each with a number of photons."""
        bits = math.ceil(math.log2(photons))
        wider = max(min((PHOTONS / photons) ** (1 / 3), _WIDEST), 1.0) if self.widens else 1.0
        cells, patches, rings = self.cells, self.patches, self.patches.rings
        if isinstance(cells, WaterCells):
            entries = beam_entries(scene, shots)
            heights = SurfaceHeights(scene, patches.region, patches.depth, entries[:, :2] - self.entry[:2])
            buckets = min(MOST_BUCKET_BITS, max(bits + _BITS_OF_CELLS, cells.bits_z + 2))
            axes = None if scene.transmitter_poses is None else scene.transmitter_poses.axis
            rings = rings.of_entries(entries, axes, scene.mean_slopes(shots))
            cells = cells.of_shots(heights, rings, wider, buckets)
        patches = replace(
            patches,
            scene=scene,
            rings=rings,
            uneven=solids_of_several_levels(scene, patches.region, shots),
            side_bits=min(MOST_SIDE_BITS, -(-(bits + _SIDE_BITS_OF_PATCHES) // 2)),
            width=patches.width * wider,
        )
        # A copy has its own capacities.
        return replace(self, cells=cells, patches=patches)

    def cell_sides(self, depths: FloatArray) -> FloatArray:
        """Return the cells' sides below a sea [m], as in `WaterCells.sides`."""
        assert isinstance(self.cells, WaterCells)
        return self.cells.sides(depths)

    def coarse(self) -> MergingLayout:
        """Return a layout with the same points and wider cells, for differences of scenes."""
        cells = self.cells.of_even_width(_COARSE) if isinstance(self.cells, WaterCells) else self.cells
        patches = replace(self.patches, width=_COARSE_PATCHES * self.patches.width)
        return replace(self, cells=cells, patches=patches, photons_of_cell=_PHOTONS_OF_COARSE)

    def of_scene_alike(self, scene: LidarScene) -> MergingLayout:
        """Return the same points and cells for a scene that differs a little, whose solids may be other objects.

        Cells follow the beam, as the sea refracts it, the sea surface, and the solids where they end. Most light from
        the same random numbers thus stays in its cell, and light near a moving surface is right.
        """
        cells, region, rings = self.cells, self.patches.region, self.patches.rings
        if isinstance(cells, WaterCells):
            rings = rings.alike(scene.transmitter.pose, beam_entries(scene), scene.mean_slopes(1))
            cells = cells.moved(SurfaceHeights(scene, region, self.patches.depth), rings)
        uneven = solids_of_several_levels(scene, region)
        return replace(self, cells=cells, patches=replace(self.patches, scene=scene, rings=rings, uneven=uneven))

    @classmethod
    def of_probe(cls, probe: Probe, options: MergingOptions) -> MergingLayout:
        """Choose points and cells for the scene of a probe."""
        scene = probe.scene
        if scene.submerged:
            region, reach, nearest = reach_under_water(probe)
        else:
            region = Region.of_probe(probe)
            reach = region.track_length(scene)
        finest = options.point_spacing or reach / _POINTS_PER_PATH
        is_image = scene.receiver.pixels.count >= IMAGE_PIXELS
        spacing = options.point_spacing or reach / (_POINTS_PER_IMAGE_PATH if is_image else _POINTS_PER_PATH)
        column, pose = scene.required_water.column, scene.transmitter.pose
        thickness = _THICKNESS_PER_SPACING * finest
        attenuation, scattering = float(column.attenuation.max()), float(column.scattering.max())
        if attenuation > 0:
            thickness = min(thickness, _THICKNESS_PER_ATTENUATION / attenuation)
        sides = [np.max(np.array(solid.bbox().max) - np.array(solid.bbox().min)) for solid in scene.solids]
        solids: dict[str, Any] = {"uneven": solids_of_several_levels(scene, region)}
        solids["least"] = float(_PATCH_PER_SOLID * max(sides, default=0.0))
        # Rounded, so that other shots use the same kernels.
        segments = min(0.5 * np.ceil(3 * (1 + scattering * reach)) + 1, _MOST_SEGMENTS)
        points: dict[str, Any] = {"spacing": spacing, "reach": reach, "widens": not options.cell_size}
        points |= {"light_segments": segments, "sensor_segments": segments}
        if scene.submerged:
            spread = scene.transmitter.angular_spread * nearest
            width = cell_widths(options.cell_size, spread, 0.0)[0] or _CELL_PER_BEAM * spread
            depth = max(-float(pose.origin[2]) - nearest * float(pose.axis[2]), 0.0)
            rings = BeamRings(pose, spread, 1.0, 0.0)
            patches = SolidPatches(scene, region, rings, depth, PATCH_PER_CELL * width, **solids)
            return cls(np.zeros(3), SphericalCells(scene, thickness), patches, **points)
        footprint = scene.transmitter.angular_spread * pose.ground_range
        entries = beam_entries(scene)
        rings = BeamRings(pose, footprint, scene.refractive_index, tilt=scene.mean_slopes(1)).of_entries(entries)
        # Cells are longer along the beam's azimuth: the mean of their sides counts.
        facet = scene.facet_size * float(np.sqrt(max(-pose.axis[2], 0.0)))
        view = scene.receiver.pixels.field_of_view * scene.receiver.pose.ground_range
        given, longest = cell_widths(options.cell_size, footprint, attenuation * bool(pose.axis[2] < 0))
        widest = given or min(_CELL_PER_FOOTPRINT * footprint, _CELL_PER_FACET * facet)
        spots = [each.pose.ground_point()[:2] for each in (scene.transmitter, scene.receiver)]
        least = _CELL_PER_COORDINATE * float(np.abs(spots).max() + reach)
        width = given or min(max(_CELL_PER_VIEW * view, least), widest)
        growth = _GROWTH_PER_METRE + _GROWTH_PER_SCATTERING * float(column.scattering.min())
        depth = reach * -float(refract_level(pose.axis, scene.refractive_index)[2])
        heights, profile = SurfaceHeights(scene, region, depth), RefractedProfile.of_scene(scene, footprint)
        uppermost = min(
            _UPPERMOST_PER_SPREAD * profile.depth,
            _UPPERMOST_PER_FACET * scene.facet_size / profile.shift_by_facets,
            max(_UPPERMOST_PER_ATTENUATION / max(float(column.attenuation[0]), _LEAST_ATTENUATION), footprint),
        )
        # The standard deviation of even light in the field of view is a quarter of its diameter.
        by_ripples, core = profile.growth(most=0.25 * view), CORE_PER_SPREAD * footprint
        cells = WaterCells(
            *(rings, heights, profile, min(width, longest) / core, growth, thickness, uppermost, reach),
            view_growth=by_ripples,
            widening=min(widest, longest) / min(width, longest),
        )
        solids |= {"growth": by_ripples, "widening": widest / width}
        patches = SolidPatches(scene, region, rings, depth, PATCH_PER_CELL * width, **solids)
        spread = (_SPREAD_PER_BLUR * profile.blur + _SPREAD_PER_DEPTH) * depth
        return cls(entries[0], cells, patches, spread=spread, **points)
