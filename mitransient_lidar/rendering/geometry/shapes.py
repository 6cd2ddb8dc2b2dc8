"""Sea, bottoms, targets and layers of a loaded scene within a box of water about the footprints of its lidar."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray, IntArray
from mitransient_lidar.loading.exclusive import alone
from mitransient_lidar.loading.scenes import LoadedScene
from mitransient_lidar.physics.sea.sea_mesh import grid_faces
from mitransient_lidar.rendering.describe import SAMPLED_TICKS, surface_points
from mitransient_lidar.rendering.geometry.bundles import Bundle, bundles_of
from mitransient_lidar.transport.opaque import aligned_ray
from mitransient_lidar.transport.plugin_types import Transmitter
from mitransient_lidar.transport.scene import WaterScene
from mitransient_lidar.transport.scene_parts import find_receiver, find_solids
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

    A shape may be known by points alone. `share` is that of the triangles that are kept.
    """

    name: str
    points: FloatArray
    faces: IntArray
    reflectance: float
    share: float = 1.0


@dataclass(frozen=True)
class SceneGeometry:
    """What a scene is in three dimensions, in its coordinates [m].

    Attributes
    ----------
    name
        Name of the scene, and of its instrument.
    box
        Lowest and highest corner of the water about the footprints, shape (2, 3).
    lidar
        Where laser and receiver are, by name.
    reliefs, solids
        Sea and bottoms (`WaterScene.bottoms`) at even points of the box, and the targets that reach into it.
    layers
        Depths between layers of the water [m], with attenuations above and below each [1/m], shape (n, 3).
    bundles
        Beam and pixels.
    """

    name: str
    box: FloatArray
    lidar: dict[str, FloatArray]
    reliefs: list[Relief]
    solids: list[Solid]
    layers: FloatArray
    bundles: list[Bundle]

    @property
    def spacing(self) -> float:
        """Distance of the points of sea and bottoms [m]."""
        return float(np.ptp(self.box[:, :2], axis=0).max()) / (_POINTS - 1)


@alone
def scene_geometry(loaded: LoadedScene) -> SceneGeometry:
    """Return the geometry of a loaded scene, as rays of its renderer meet it.

    Raises
    ------
    UserError
        As `scene_parts.find_solids`.
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
    """Return height [m] and diffuse reflectance of the highest point of a shape at places of the frame.

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

    Of a mesh in many parts, such as leaves, whole parts are left out evenly. The points of others are joined within
    cubes, of sides that grow until the triangles that are left are few enough.
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
