"""A loaded scene's sea, bottoms, targets and layers within a water box about its lidar's footprints."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray, IntArray
from mitransient_lidar.loading.scenes import LoadedScene
from mitransient_lidar.loading.variants import alone
from mitransient_lidar.physics.lidar.level_sea import LevelSea
from mitransient_lidar.physics.sea.sea_mesh import grid_faces
from mitransient_lidar.rendering.describe import SAMPLED_TICKS, surface_points
from mitransient_lidar.transport.opaque import aligned_ray
from mitransient_lidar.transport.plugin_types import Transmitter
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.probe import first_along
from mitransient_lidar.transport.scene import WaterScene
from mitransient_lidar.transport.scene_parts import find_receiver, find_solids
from mitransient_lidar.transport.sensor.outlines import pixel_outlines
from mitransient_lidar.transport.sensor.pixels import PixelArray
from mitransient_lidar.transport.solids import box_of, scene_of_shapes

#: Points along a side at which sea and bottoms are drawn, and reflectances of targets are read.
_POINTS, _FEW = 129, 17

#: Most triangles of a target, and fewest parts of a mesh of which some are left out.
_MOST_FACES, _MANY_PARTS = 20_000, 100

#: Half of the box of water over the footprints' sides and over the depth, and height of the air in it over the depth.
_PER_FOOTPRINT, _PER_DEPTH, _AIR = 0.75, 0.6, 0.12


@dataclass(frozen=True)
class Relief:
    """Height z [m] and reflectance [1] of a sea or bottom as seen from above, on grid lines x and y [m].

    They have the shape (len(y), len(x)) and are NaN where the shape is not; the reflectance of a sea is NaN.
    """

    name: str
    is_sea: bool
    x: FloatArray
    y: FloatArray
    z: FloatArray
    reflectance: FloatArray


@dataclass(frozen=True)
class Solid:
    """Points of a target [m], (n, 3), its triangles, and its mean reflectance as seen from above.

    A shape may be known by points alone. `share` is the kept triangles' share.
    """

    name: str
    points: FloatArray
    faces: IntArray
    reflectance: float
    share: float = 1.0


@dataclass(frozen=True)
class SceneGeometry:
    """What a scene is in three dimensions, in its coordinates [m]."""

    name: str  #: Name of the scene, and of its instrument.
    box: FloatArray  #: Lowest and highest corner of the water about the footprints, shape (2, 3).
    lidar: dict[str, FloatArray]  #: Where laser and receiver are, by name.
    #: Sea and bottoms (`WaterScene.bottoms`) at even points of the box, and the targets that reach into it.
    reliefs: list[Relief]
    solids: list[Solid]
    #: Depths between layers of the water [m], with attenuations above and below each [1/m], shape (n, 3).
    layers: FloatArray
    bundles: list[Bundle]  #: Beam and pixels.

    @property
    def spacing(self) -> float:
        """Distance of the points of sea and bottoms [m]."""
        return float(np.ptp(self.box[:, :2], axis=0).max()) / (_POINTS - 1)


@alone
def scene_geometry(loaded: LoadedScene) -> SceneGeometry:
    """Return a loaded scene's geometry, as its renderer's rays meet it.

    Raises UserError as `scene_parts.find_solids`.
    """
    scene = find_solids(loaded.scene, find_receiver(loaded.sensor))
    transmitter = next((one for one in loaded.scene.emitters() if isinstance(one, Transmitter)), None)
    bundles, at = bundles_of(scene, transmitter), scene.frame_origin
    poses = {"receiver": scene.receiver.pose} | ({"laser": transmitter.pose} if transmitter else {})
    lidar = {name: pose.in_scene(pose.origin) for name, pose in poses.items()}
    lit = [loop[1:].reshape(-1, 3) for bundle in bundles for loop in bundle.loops] or [np.stack(list(lidar.values()))]
    low, high = (find(np.concatenate(lit) - at, axis=0) for find in (np.min, np.max))
    seas = scene.sea_heights or (0.0, 0.0)
    low[2], high[2] = min(low[2], seas[0]), max(high[2], seas[1])
    half = np.maximum(_PER_FOOTPRINT * (high - low), _PER_DEPTH * (high[2] - low[2]))[:2]
    middle = 0.5 * (low + high)[:2]
    low[:2], high[:2] = middle - half, middle + half
    reliefs = [_relief(scene, shape, low, high, True) for shape in scene.surfaces]
    reliefs += [_relief(scene, shape, low, high, False) for shape in scene.bottoms]
    drawn = [shape for shape in scene.targets if np.all(box_of(shape)[0] < high) and np.all(box_of(shape)[1] > low)]
    heights = [relief.z for relief in reliefs] + [np.array([box[2] for box in box_of(shape)]) for shape in drawn]
    # Land and targets in the air within the box count, too.
    low[2], high[2] = (
        find(np.concatenate([[edge], *(height.ravel() for height in heights)]))
        for find, edge in ((np.nanmin, low[2]), (np.nanmax, high[2]))
    )
    air = _AIR * (high[2] - low[2])
    box = np.stack([low, high]) + np.outer([-0.4 * air, air], [0, 0, 1]) + at
    solids = [_solid(scene, shape) for shape in drawn]
    instrument = loaded.source.instrument if loaded.source else None
    name = f"{loaded.name}, {instrument}" if instrument else loaded.name
    return SceneGeometry(name, box, lidar, reliefs, solids, _layers(scene, box), bundles)


def _looked_at(scene: WaterScene, shape: mi.Shape, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return height [m] and diffuse reflectance for a shape's highest point at places in the frame.

    They are NaN where the shape is not; so are reflectances of what has no diffuse part, such as metal.
    """
    low, high = box_of(shape)
    origins = np.stack([x.ravel(), y.ravel(), np.full(x.size, high[2] + 1.0)], axis=1)
    down = np.tile([0.0, 0.0, -1.0], (x.size, 1))
    ray = aligned_ray(origins, down, np.full(x.size, high[2] - low[2] + 2.0))
    hit = scene_of_shapes([shape], scene.groups).ray_intersect(ray)
    met = np.array(hit.is_valid())
    is_diffuse = met & np.array((hit.bsdf().flags() & mi.BSDFFlags.DiffuseReflection.value) > 0)
    reflectance = np.array(hit.bsdf().eval_diffuse_reflectance(hit, hit.is_valid()), np.float64)[0]
    height = np.where(met, np.array(hit.p.z, np.float64), np.nan)
    return height.reshape(x.shape), np.where(is_diffuse, reflectance, np.nan).reshape(x.shape)


def _relief(scene: WaterScene, shape: mi.Shape, low: FloatArray, high: FloatArray, is_sea: bool) -> Relief:
    """Return the part of a shape within the box."""
    x, y = (np.linspace(low[axis], high[axis], _POINTS) for axis in (0, 1))
    z, reflectance = _looked_at(scene, shape, *np.meshgrid(x, y))
    at, value = scene.frame_origin, np.nan if is_sea else reflectance
    return Relief(shape.id(), is_sea, x + at[0], y + at[1], z + at[2], np.broadcast_to(value, z.shape))


def _solid(scene: WaterScene, shape: mi.Shape) -> Solid:
    """Return a target, with fewer triangles where it has many."""
    points, known = surface_points(scene, shape), mi.traverse(shape)
    low, high = box_of(shape)
    grid = np.meshgrid(*(np.linspace(low[axis], high[axis], _FEW) for axis in (0, 1)))
    reflectance = _looked_at(scene, shape, *grid)[1]
    mean = float(np.nanmean(reflectance)) if np.isfinite(reflectance).any() else np.nan
    faces = np.zeros((0, 3), np.int64)
    if "faces" in known:
        faces = np.array(known["faces"]).astype(np.int64).reshape(-1, 3)
    elif len(points) == (SAMPLED_TICKS + 1) ** 2:
        faces = grid_faces(SAMPLED_TICKS + 1, SAMPLED_TICKS + 1).astype(np.int64)
    count = len(faces)
    if count > _MOST_FACES:
        faces, points = thinned(faces, points, _MOST_FACES)
    return Solid(shape.id(), points + scene.frame_origin, faces, mean, len(faces) / count if count else 1.0)


def thinned(faces: IntArray, points: FloatArray, most: int) -> tuple[IntArray, FloatArray]:
    """Return at most so many triangles of a mesh, and the points that they use.

    Of a mesh in many parts, such as leaves, whole parts are left out evenly. Others' points are joined within cubes,
    whose sides grow until few enough triangles are left.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = faces[:, [0, 1, 1, 2]].reshape(-1, 2).T
    shape = (len(points), len(points))
    parts, part = connected_components(coo_array((np.ones(pairs.shape[1]), tuple(pairs)), shape), directed=False)
    if parts >= _MANY_PARTS:
        own = part.astype(np.int64)[faces[:, 0]]
        faces = faces[own * most // len(faces) != (own + 1) * most // len(faces)][:most]
    side = float(np.ptp(points, axis=0).max()) / most
    while len(faces) > most:
        side *= 1.5
        _, first, joined = np.unique(np.floor(points / side), axis=0, return_index=True, return_inverse=True)
        faces, points = joined.reshape(-1)[faces], points[first]
        faces = faces[(np.diff(np.sort(faces, axis=1), axis=1) > 0).all(axis=1)]
        faces = np.unique(faces, axis=0)
    used, index = np.unique(faces, return_inverse=True)
    return index.reshape(-1, 3), points[used]


def _layers(scene: WaterScene, box: FloatArray) -> FloatArray:
    """Return the layers of `SceneGeometry` within the box."""
    if scene.water is None:
        return np.zeros((0, 3))
    column = scene.water.column
    rows = np.stack([column.layer_tops[1:], column.attenuation[:-1], column.attenuation[1:]], axis=1)
    return np.asarray(rows[-rows[:, 0] > box[0, 2]])


#: Largest number of pixels that are bundles of their own, and of lines of an imager's pixels along a side.
_MOST_PIXELS, _MOST_LINES = 64, 17

#: Length of rays that meet nothing under water, and depth of those from the air in a scene without solids [m].
_REACH, _DEPTH = 20.0, 10.0

_SMALLEST_DESCENT = 1e-3  #: Smallest sine below the horizon of rays that are followed.


@dataclass(frozen=True, eq=False)
class Bundle:
    """Rays along a beam's or a pixel's outlines, refracted as by a level sea."""

    name: str  #: What the outline is of.
    kind: str  #: ``beam``, ``pixel``, or ``lines`` between the pixels of an imager.
    azimuth: float  #: Direction of the axis of the lidar, from +x to +y [rad].
    angles: tuple[float, float]  #: Full angles along angle_x and angle_y [rad].
    #: Points x, y, z of each outline in the scene [m], shape (levels, n, 3): the lidar, the sea surface, boundaries of
    #: index layers, and the solid that the ray meets first, or the depth at which it ends.
    loops: list[FloatArray]

    def size(self, level: int) -> tuple[float, float]:
        """Return the lengths of the footprint at a level along and across the lidar's azimuth [m]."""
        points = np.concatenate([loop[level, :, :2] for loop in self.loops])
        cos, sin = np.cos(self.azimuth), np.sin(self.azimuth)
        return float(np.ptp(points @ (cos, sin))), float(np.ptp(points @ (-sin, cos)))


def bundles_of(scene: WaterScene, transmitter: Transmitter | None) -> list[Bundle]:
    """Return the bundles for all pixels, or for an imager its view and lines between its pixels, and for the beam.

    Rays that do not go down from a lidar in the air are left out, and so are bundles with such rays alone.
    """
    pose, pixels = scene.receiver.pose, scene.receiver.pixels
    outlines = [("pixel", name, pose, lines) for name, lines in _regions(pixels)]
    if pixels.grid is not None and pixels.sides is not None:
        blocks = " × ".join(str(_step(count)) for count in pixels.grid)
        radius = 0.5 * pixels.field_of_view if pixels.field_of_view_shape == "circle" else np.inf
        outlines.append(
            ("lines", f"lines between blocks of {blocks} pixels", pose, _lines(pixels.grid, pixels.sides, radius))
        )
    if transmitter is not None:
        for share, lines in transmitter.profile.outlines():
            name = "rim of the beam" if share == 1 else f"beam, {100 * share:.0f} % of its peak irradiance"
            outlines.append(("beam", name, transmitter.pose, lines))
    found = []
    for kind, name, origin, lines in outlines:
        # All at once: each call loads shapes and compiles kernels.
        points = traced(scene, origin, np.concatenate(lines))
        parts = np.split(points, np.cumsum([len(line) for line in lines])[:-1], axis=1)
        loops = [part[:, np.isfinite(part[-1, :, 0])] for part in parts]
        if loops := [loop for loop in loops if loop.shape[1]]:
            angles = np.ptp(np.concatenate(lines), axis=0)
            found.append(Bundle(name, kind, float(pose.azimuth), (float(angles[0]), float(angles[1])), loops))
    return found


def _regions(pixels: PixelArray) -> Iterator[tuple[str, list[FloatArray]]]:
    """Yield the pixels' names and outlines (angle_x, angle_y) [rad], or for many pixels the field of view's."""
    if pixels.grid is None and pixels.count <= _MOST_PIXELS:
        yield from zip((f"pixel {name}" for name in pixels.names), pixel_outlines(pixels), strict=True)
        return
    azimuth = np.linspace(0, 2 * np.pi, 185)  # with the corners of a square
    angles = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    if pixels.field_of_view_shape in ("square", "rectangle"):
        angles /= np.abs(angles).max(axis=1, keepdims=True)
    sides = np.array(pixels.sides or (pixels.field_of_view,) * 2)
    yield f"field of view of {pixels.count} pixels", [0.5 * sides * angles]


def _step(count: int) -> int:
    """Return the number of pixel rows or columns between two lines."""
    return -(-count // (_MOST_LINES - 1))


def _lines(grid: tuple[int, int], sides: tuple[float, float], radius: float) -> list[FloatArray]:
    """Return evenly chosen lines between an imager's rows and columns within a radius [rad]."""
    edges = [
        side * (np.unique([*range(0, count, _step(count)), count]) / count - 0.5)
        for count, side in zip(grid, sides, strict=True)
    ]
    found = []
    for axis in (0, 1):
        along = np.linspace(edges[1 - axis][0], edges[1 - axis][-1], 65)
        for place in edges[axis]:
            line = np.stack([np.full_like(along, place), along][:: 1 - 2 * axis], axis=-1)
            line = line[np.hypot(*line.T) <= radius]
            found += [line] * (len(line) > 1)
    return found


def traced(scene: WaterScene, pose: KernelPose, angles: FloatArray) -> FloatArray:
    """Follow rays from a pose at tangent-plane angles [rad], shape (n, 2): points as of `Bundle.loops`.

    They meet the sea at its waves, which do not turn them: they are refracted as by a level sea. Points are NaN for
    rays that do not go down from a pose in the air.
    """
    rays = pose.directions(angles)
    if pose.submerged:
        start = np.broadcast_to(pose.origin, rays.shape)
        ends = first_along(scene, [start, start + _REACH * rays], [*scene.solids, *scene.surfaces])
        ends = np.where(np.isfinite(ends), ends, start + _REACH * rays)
        return np.asarray(np.stack([start, start, ends]) + scene.frame_origin)
    falls = rays[:, 2] < -_SMALLEST_DESCENT
    rays = np.where(falls[:, None], rays, [0.0, 0.0, -1.0])
    start = np.broadcast_to(pose.origin, rays.shape)
    sea, bottoms = scene.level_sea, [float(solid.bbox().min.z) - 1.0 for solid in scene.solids]
    trough = scene.sea_heights[0] - 0.01 if scene.sea_heights else 0.0
    lowest = min(bottoms, default=trough - _DEPTH)
    levels = [0.0, *(-boundary for boundary in sea.boundaries if -boundary > lowest), min(lowest, -0.01)]

    def at(water: LevelSea, z: float) -> FloatArray:
        return np.insert(water.at_height(pose.origin, rays, z), 2, z, axis=1)

    corners = [start, *(at(sea, z) for z in levels)]
    ends = first_along(scene, corners)
    ends = np.where(np.isfinite(ends), ends, corners[-1])
    on_sea = first_along(scene, [start, at(LevelSea((1.0,)), trough)], scene.surfaces)
    corners[1], corners[-1] = np.where(np.isfinite(on_sea), on_sea, corners[1]), ends
    # Where a ray has met a solid it stays.
    corners[1:] = [np.where(corner[:, 2:] < ends[:, 2:], ends, corner) for corner in corners[1:]]
    return np.where(falls[:, None], np.stack(corners) + scene.frame_origin, np.nan)
