"""The parts of a loaded scene that the integrators need, found and checked once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.gate_train import GatePlan
from mitransient_lidar.physics.lidar.level_sea import LevelSea
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.sea.resolution import Instrument
from mitransient_lidar.transport.medium.index_layers import IndexLayers
from mitransient_lidar.transport.opaque import is_one_of, opaque, opaque_point
from mitransient_lidar.transport.perturbations import Perturbations
from mitransient_lidar.transport.pose import Pose, RelativePose
from mitransient_lidar.transport.rng import Lanes
from mitransient_lidar.transport.sensor.receiver import Receiver
from mitransient_lidar.transport.sensor.records import fitted_record, submerged_record

#: Total slope variance assumed for a surface without a known one: a broad distribution covers any sea.
_UNKNOWN_SLOPE_VARIANCE = 0.04

#: Vertical component of an axis under water above which it looks up.
_SMALLEST_RISE = 0.1

#: Height above all shapes from which paths start there instead of at the lidar, and height of these points [m].
_FAR, _CLEARANCE = 1e4, 1.0

#: Largest rounding error of intersections over their coordinates.
_ROUNDING = 2.0**-21

#: Length over which slopes change, over the shortest wavelength.
_FACET_PER_WAVE = 0.25

#: Smallest side of a bottom, over that of the largest solid.
_BOTTOM_PER_LARGEST = 0.25


SceneT = TypeVar("SceneT", bound="WaterScene")
Vector = TypeVar("Vector", mi.Vector3f, mi.Point3f, mi.Normal3f)


@dataclass(frozen=True)
class ScenePart:
    """Shapes that shots meet at a place of their own.

    Points of the lidar's frame are turned about the vertical, by an angle whose cosine and sine are `turn`, and then
    displaced [m] to the shapes. Without `turn` they are only displaced.
    """

    shapes: mi.Scene
    displacement: mi.Vector3f
    turn: mi.Vector2f | None = None

    def of(self, lanes: Lanes) -> ScenePart:
        """Return the part with the displacement of each lane."""
        turn = None if self.turn is None else lanes.pick(self.turn)
        return ScenePart(self.shapes, lanes.pick(self.displacement), turn)

    def ray(self, ray: mi.Ray3f) -> mi.Ray3f:
        """Return rays of the lidar's frame among the shapes."""
        moved = mi.Ray3f(ray)
        if self.turn is not None:
            moved.o, moved.d = (_turned(vector, self.turn) for vector in (ray.o, ray.d))
        moved.o += self.displacement
        return moved


@dataclass(frozen=True)
class WaterScene:
    """Receiver, water and sea surface of a scene.

    Attributes
    ----------
    mitsuba_scene
        The Mitsuba scene.
    receiver
        Pose, aperture and pixels of the sensor.
    water
        The ``layered_water``, or None in a scene without water.
    surfaces
        Shapes that bound the water, with it as interior medium.
    slope_variance
        Total slope variance of the sea, for the sampling of surface connections.
    parts
        Parts of the scene at places that differ between shots, in place of `mitsuba_scene`; none for a single shot.
    receiver_poses
        Pose of the receiver in each shot, where they differ.
    perturbations
        Changes of water and solids whose effect on each path is summed.
    """

    mitsuba_scene: mi.Scene
    receiver: Receiver
    water: Any
    surfaces: list[mi.Shape]
    slope_variance: float
    parts: tuple[ScenePart, ...] = field(default=(), kw_only=True)
    receiver_poses: Pose | None = field(default=None, kw_only=True)
    perturbations: Perturbations = field(default_factory=Perturbations, kw_only=True)

    def of(self: SceneT, lanes: Lanes) -> SceneT:
        """Return the scene as the shots of lanes meet it, in the frame of the lidar."""
        if not self.parts:
            return self
        poses = None if self.receiver_poses is None else self.receiver_poses.of(lanes)
        return replace(self, parts=tuple(part.of(lanes) for part in self.parts), receiver_poses=poses)

    @property
    def receiver_pose(self) -> Pose:
        """Pose of the receiver for paths."""
        return self.receiver_poses or self.receiver.pose

    @property
    def solids(self) -> list[mi.Shape]:
        """All shapes that do not bound the water: bottoms and targets."""
        return _solids(self.mitsuba_scene, self.surfaces)

    @property
    def bottoms(self) -> list[mi.Shape]:
        """Solids that are the bottom, or a part of it; all others are targets.

        The shorter horizontal side of a bottom's bounding box is at least the width of the field of view at its
        distance, and at least a quarter of that of the largest solid.
        """
        boxes = [np.array([solid.bbox().min, solid.bbox().max], dtype=np.float64) for solid in self.solids]
        sides = [float((high - low)[:2].min()) for low, high in boxes]
        origin, field_of_view = self.receiver.pose.origin, self.receiver.pixels.field_of_view
        widths = [field_of_view * float(np.linalg.norm(np.clip(origin, *box) - origin)) for box in boxes]
        smallest = _BOTTOM_PER_LARGEST * max(sides, default=0.0)
        rows = zip(self.solids, sides, widths, strict=True)
        return [solid for solid, side, width in rows if side >= max(width, smallest)]

    @property
    def targets(self) -> list[mi.Shape]:
        """Solids that are not `bottoms`."""
        bottoms = self.bottoms
        return [solid for solid in self.solids if not any(solid is bottom for bottom in bottoms)]

    @property
    def clear_water(self) -> tuple[float, float]:
        """Heights of the top of the highest solid and of the lowest point of the sea: no shape lies between [m]."""
        highest = max((float(solid.bbox().max.z) for solid in self.solids), default=-np.inf)
        return highest, min((float(surface.bbox().min.z) for surface in self.surfaces), default=-np.inf)

    @property
    def has_specular_or_dry_solids(self) -> bool:
        """Whether a solid has a mirror-like part, or rises above the lowest point of the sea."""
        lowest = min((float(surface.bbox().min.z) for surface in self.surfaces), default=0.0)
        mirror = mi.BSDFFlags.DeltaReflection.value | mi.BSDFFlags.DeltaTransmission.value
        return any(int(solid.bsdf().flags()) & mirror or float(solid.bbox().max.z) > lowest for solid in self.solids)

    @property
    def facet_size(self) -> float:
        """Length over which slopes of the sea surface change [m].

        A quarter of the shortest waves that the beam needs or, if longer, the side of a cell; in meshes of other
        plugins the mean side of a cell, a pair of triangles. Waves that are shorter for the pixels of an image, and
        cells that are finer than their waves, do not count.
        """
        sizes = [
            max(surface.cell_size, _FACET_PER_WAVE * surface.beam_wave)
            if hasattr(surface, "beam_wave")
            else float(np.sqrt(2 * surface.surface_area()[0] / surface.face_count()))
            for surface in self.surfaces
            if surface.is_mesh()
        ]
        return min(sizes, default=np.inf)

    @property
    def refractive_index(self) -> float:
        """Refractive index of the top index layer, 1 without water."""
        return float(self.water.refractive_index) if self.water is not None else 1.0

    @property
    def group_index(self) -> float:
        """Group index of the top index layer, 1 without water."""
        return float(self.water.group_index) if self.water is not None else 1.0

    @property
    def index_layers(self) -> IndexLayers | None:
        """Index layers of the water, None without water."""
        return self.water.index_layers if self.water is not None else None

    @property
    def level_sea(self) -> LevelSea:
        """The water with its mean sea level, without waves; as air without water."""
        layers = self.index_layers
        if layers is None:
            return LevelSea((1.0,))
        return LevelSea(tuple(map(float, layers.refractive_index)), tuple(map(float, layers.boundaries)))

    def relative(self, pose: Pose) -> RelativePose:
        """Return a pose relative to the reference point of the scene, as lengths of paths are."""
        return RelativePose(pose, self.receiver.pose.nearby_point())

    def first_points(self, pose: Pose, angles: mi.Point2f, direction: mi.Vector3f) -> tuple[mi.Point3f, mi.Float]:
        """Return where paths from a pose start [m], at tangent-plane angles, and their relative lengths there [m].

        Paths from more than 10 km above the scene start 1 m above all shapes: traced from farther away in single
        precision, rays would pass between the triangles of the sea, 1.6 % of them from 500 km at 20 degrees.
        """
        origin, relative = pose.point, self.relative(pose)
        top = float(self.mitsuba_scene.bbox().max.z) + _CLEARANCE
        if pose.lanes is not None or pose.origin[2] - top < _FAR:
            return origin, relative.distance(origin)
        on_axis = RelativePose(pose, pose.nearby_point())
        point = dr.select(direction.z < 0, on_axis.at_height(angles, direction, top), origin)
        return point, relative.distance(point)

    def ray_intersect(self, ray: mi.Ray3f, active: mi.Bool | bool = True) -> mi.SurfaceInteraction3f:
        """Return the first intersections of rays."""
        if not self.parts:
            return self.mitsuba_scene.ray_intersect(ray, active)
        nearest, shift = dr.zeros(mi.PreliminaryIntersection3f), mi.Vector3f(0)
        nearest.t = dr.inf
        turn = mi.Vector2f(1, 0)
        for part in self.parts:
            found = part.shapes.ray_intersect_preliminary(part.ray(ray), active=active)
            is_nearer = found.t < nearest.t
            nearest = dr.select(is_nearer, found, nearest)
            shift = dr.select(is_nearer, part.displacement, shift)
            if part.turn is not None:
                turn = dr.select(is_nearer, part.turn, turn)
        is_turned = any(part.turn is not None for part in self.parts)
        moved = ScenePart(self.mitsuba_scene, shift, turn if is_turned else None).ray(ray)
        si = nearest.compute_surface_interaction(moved, active=active)
        si.p -= shift
        if is_turned:
            back = mi.Vector2f(turn.x, -turn.y)
            si.p, si.n, si.dp_du, si.dp_dv = (_turned(each, back) for each in (si.p, si.n, si.dp_du, si.dp_dv))
            frame = si.sh_frame
            frame.s, frame.t, frame.n = (_turned(each, back) for each in (frame.s, frame.t, frame.n))
            si.sh_frame = frame
        return si

    def ray_test(self, ray: mi.Ray3f, active: mi.Bool | bool = True) -> mi.Bool:
        """Return whether rays are blocked."""
        if not self.parts:
            return self.mitsuba_scene.ray_test(ray, active)
        blocked = mi.Bool(False)
        for part in self.parts:
            blocked |= part.shapes.ray_test(part.ray(ray), active & ~blocked)
        return blocked

    def spawn_ray(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> mi.Ray3f:
        """Return rays that leave surfaces, from points beside them so that they do not meet these again.

        Mitsuba's own offset grows with the distance from the origin of the world: 250 m away it is 2 cm, and 0.2 ns of
        the way to a bottom and back are lost. This one grows with that from the reference point of the scene, and with
        the rounding of coordinates.
        """
        reference = self.receiver.pose.nearby_point()
        farthest = opaque(float(np.abs(reference).max()))
        for part in self.parts:
            farthest = dr.maximum(farthest, dr.max(dr.abs(part.displacement)))
        size = dr.max(dr.abs(si.p - opaque_point(reference)))
        offset = dr.fma(farthest, _ROUNDING, (1 + size) * mi.math.RayEpsilon)
        return mi.Ray3f(dr.fma(dr.mulsign(offset, dr.dot(si.n, direction)), si.n, si.p), direction)

    def outside_surface(self, z: mi.Float, in_water: mi.Bool) -> mi.Bool:
        """Return whether a height [m] can be reached outside the surface mesh only: wet above it, or dry below it."""
        if not self.surfaces:
            return mi.Bool(False)
        boxes = [surface.bbox() for surface in self.surfaces]
        lowest, highest = min(float(box.min.z) for box in boxes), max(float(box.max.z) for box in boxes)
        # A margin of a millimetre for points that lie on the surface to rounding.
        return dr.select(in_water, z > opaque(highest + 1e-3), z < opaque(lowest - 1e-3))

    def is_clear(self, z: mi.Float) -> mi.Bool:
        """Return whether heights [m] lie in `clear_water`: lines between two of them meet no shape."""
        lowest, highest = (opaque(z) for z in self.clear_water)
        return (z > lowest) & (z < highest)

    def is_surface(self, shape: mi.ShapePtr) -> mi.Bool:
        """Return whether a shape bounds the water."""
        return is_one_of(shape, self.surfaces)


@dataclass(frozen=True)
class LidarScene(WaterScene):
    """A scene with a transmitter, and a receiver that records the time of arrival.

    Attributes
    ----------
    transmitter
        The ``lidar_transmitter``.
    axis
        Time bins of the record.
    gates
        Gates of the ``time_gated_film``, or None.
    transmitter_poses
        Pose of the transmitter in each shot, where they differ.
    """

    transmitter: Any
    axis: TimeAxis
    gates: GatePlan | None
    transmitter_poses: Pose | None = field(default=None, kw_only=True)

    def of(self, lanes: Lanes) -> LidarScene:
        """Return the scene as the shots of lanes meet it, in the frame of the lidar."""
        moved = super().of(lanes)
        poses = self.transmitter_poses
        return moved if poses is None else replace(moved, transmitter_poses=poses.of(lanes))

    @property
    def transmitter_pose(self) -> Pose:
        """Pose of the transmitter for paths."""
        return self.transmitter_poses or self.transmitter.pose

    @property
    def submerged(self) -> bool:
        """Whether laser and receiver are under water."""
        return bool(self.transmitter.pose.submerged)

    @property
    def reference_length(self) -> float:
        """Length from laser to receiver by the reference point [m], which all lengths of paths leave out."""
        return float(sum(self.relative(each.pose).range for each in (self.transmitter, self.receiver)))

    @classmethod
    def from_scene(
        cls,
        scene: mi.Scene,
        sensor: mi.Sensor,
        receiver: Receiver | None = None,
        shifts: Iterable[tuple[float, float]] = ((0.0, 0.0),),
        axis: TimeAxis | None = None,
    ) -> LidarScene:
        """Find the parts in a loaded scene; sun and sky are ignored. `receiver` replaces the sensor's own.

        A record of automatic time bins is that of `axis`, or holds the light of all positions of the lidar, above water
        displaced by `shifts` (x, y) [m].

        Raises
        ------
        UserError
            When a part is missing, not supported, or there are several where one is allowed.
        """
        fit_seas(scene)
        receiver = receiver or find_receiver(sensor)
        film = sensor.film()
        if not hasattr(film, "time_start_ns"):
            raise UserError("film: the lidar integrators need a time_gated_film inside the sensor")
        emitters = [emitter for emitter in scene.emitters() if not hasattr(emitter, "daylight")]
        transmitters = [emitter for emitter in emitters if hasattr(emitter, "pulse_energy")]
        if len(transmitters) != 1 or len(emitters) != 1:
            raise UserError(
                f"emitters: the scene has {len(emitters)} of which {len(transmitters)} are lidar_transmitter; "
                "allowed is exactly one lidar_transmitter, besides sun and sky"
            )
        water, surfaces, variance = find_water(scene)
        parts = WaterScene(scene, receiver, water, surfaces, variance)
        submerged = _check_place(parts, transmitters[0])
        if not submerged:
            _check_cells(surfaces, transmitters[0])
        if axis is None and not film.is_fixed:
            # The record is that of the sensor, whatever replaces its receiver; the scene may have been edited.
            own = replace(parts, receiver=find_receiver(sensor))
            found = (own, transmitters[0], film)
            film.fit(*(submerged_record(*found) if submerged else fitted_record(*found, shifts)))
        return cls(scene, receiver, water, surfaces, variance, transmitters[0], axis or film.axis, film.gates)


def _turned(vector: Vector, turn: mi.Vector2f) -> Vector:
    """Return vectors or points turned about the vertical, by angles with this cosine and sine."""
    (x, y, z), (cos, sin) = vector, turn
    return type(vector)(dr.fma(cos, x, -sin * y), dr.fma(sin, x, cos * y), z)


def find_receiver(sensor: mi.Sensor) -> Receiver:
    """Return the receiver of a sensor plugin; raise UserError when the sensor has none."""
    receiver = getattr(sensor, "receiver", None)
    if not isinstance(receiver, Receiver):
        raise UserError("sensor: the lidar integrators need a multipixel_receiver or pixel_fov")
    return receiver


def fit_seas(scene: mi.Scene, model: mi.Scene | None = None) -> None:
    """Set the automatic values of each ``ocean_surface`` from the lasers and receivers of the scene, once.

    A plugin does not know its siblings while a scene loads: this is done for loaded scenes, before they are used. With
    the lasers and receivers of a `model` instead, the meshes of both scenes have the same cells and waves.
    """
    instruments = []
    for emitter in (model or scene).emitters():
        if hasattr(emitter, "pulse_energy") and (place := _seen_sea(emitter.pose)):
            spreads = emitter.angular_spread, emitter.widest_angular_spread
            instruments.append(Instrument.laser(*place, spreads))
        elif hasattr(emitter, "pulse_energy"):
            instruments.append(_without_sea(emitter.pose))
    for sensor in (model or scene).sensors():
        receiver = getattr(sensor, "receiver", None)
        if isinstance(receiver, Receiver) and (place := _seen_sea(receiver.pose)):
            pixels = receiver.pixels
            side = float(np.sqrt(pixels.area / pixels.count))
            instruments.append(Instrument.receiver(*place, pixels.field_of_view, side))
    if any([shape.fit(instruments) for shape in scene.shapes() if hasattr(shape, "ripple_variance")]):
        scene.parameters_changed([])


def _seen_sea(pose: Pose) -> tuple[tuple[float, float], float, float] | None:
    """Return where the axis meets the mean sea level [m], the height above or below it [m], and its slope [rad].

    The slope is the angle from the vertical. None for a pose under water that does not look up.
    """
    height, off_vertical = abs(float(pose.origin[2])), pose.off_nadir_deg
    if not pose.submerged:
        spot = pose.ground_point()
    elif pose.axis[2] > _SMALLEST_RISE:
        spot, off_vertical = pose.origin + pose.axis * (height / float(pose.axis[2])), 180.0 - off_vertical
    else:
        return None
    return (float(spot[0]), float(spot[1])), height, float(np.deg2rad(min(off_vertical, 89.9)))


def _without_sea(pose: Pose) -> Instrument:
    """Return an instrument that needs no waves: those above it when it looks down under water."""
    place = float(pose.origin[0]), float(pose.origin[1])
    return Instrument(place, abs(float(pose.origin[2])), 0.0, True, 0.0, np.inf)


def find_water(scene: mi.Scene) -> tuple[Any, list[mi.Shape], float]:
    """Return water, surfaces and slope variance of a scene, see `WaterScene`.

    The slope variance is that of the roughest surface, or a typical one without ``ocean_surface``.

    Raises
    ------
    UserError
        When a medium is not supported or in the wrong place, or there are several.
    """
    surfaces: list[mi.Shape] = []
    waters: list[mi.Medium] = []
    for shape in scene.shapes():
        if not shape.is_medium_transition():
            continue
        if shape.exterior_medium() is not None:
            raise UserError(f"shape {shape.id()!r}: the water must be its interior medium and its exterior empty")
        water = shape.interior_medium()
        if not hasattr(water, "flight"):
            raise UserError(f"shape {shape.id()!r}: its interior medium must be layered_water")
        surfaces.append(shape)
        if not any(water is other for other in waters):
            waters.append(water)
    for shape in scene.shapes():
        if hasattr(shape, "ripple_variance") and shape not in surfaces:
            raise UserError(f"ocean_surface {shape.id()!r}: needs a layered_water as its interior medium")
    if len(waters) > 1:
        raise UserError(f"media: the scene has {len(waters)} layered_water; allowed is one that shapes share")
    for water in waters:
        _check_layers(scene, surfaces, water)
    variances = [shape.slope_variance for shape in surfaces if getattr(shape, "has_ripples", False)]
    return (waters[0] if waters else None), surfaces, float(max(variances, default=_UNKNOWN_SLOPE_VARIANCE))


def _solids(scene: mi.Scene, surfaces: list[mi.Shape]) -> list[mi.Shape]:
    """Return the shapes that are not among the surfaces of the water."""
    return [shape for shape in scene.shapes() if not any(shape is surface for surface in surfaces)]


def _check_place(scene: WaterScene, transmitter: Any) -> bool:
    """Return whether laser and receiver are under water.

    Refuse both on the sea level, on different sides of the sea, or in layers of different indices.
    """
    heights = [float(each.pose.origin[2]) for each in (transmitter, scene.receiver)]
    if min(heights) > 0:
        return False
    if max(heights) >= 0 or scene.water is None:
        raise UserError(
            f"altitude: transmitter and receiver at z = {heights[0]:g} m and {heights[1]:g} m must both be above the "
            "mean sea level z = 0, or both under water"
        )
    if scene.index_layers is not None and scene.index_layers.count > 1:
        raise UserError("refractive_index changes with depth: a lidar under water needs one index")
    trough = min(float(surface.bbox().min.z) for surface in scene.surfaces)
    for each in (transmitter, scene.receiver):
        origin = opaque_point(each.pose.origin)
        above = scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(0, 0, 1)))
        if each.pose.origin[2] > trough and not (above.is_valid() & scene.is_surface(above.shape))[0]:
            raise UserError(
                f"altitude = {each.pose.origin[2]:g} must be below the surface of the waves, whose lowest trough is at "
                f"{trough:.3g} m"
            )
    return True


def _check_cells(surfaces: list[mi.Shape], transmitter: Any) -> None:
    """Refuse waves in cells longer than the beam is wide: a shot would meet a single slope."""
    spot = transmitter.pose.ground_point()
    footprint = 2 * transmitter.angular_spread * float(np.linalg.norm(spot - transmitter.pose.origin))
    for surface in surfaces:
        cell = getattr(surface, "cell_size", np.inf)
        if np.isfinite(cell) and cell > footprint:
            raise UserError(
                f"cell_size = {cell:.3g} m is coarser than the beam's footprint on the sea, {footprint:.3g} m: "
                "it must be finer, or 'auto'"
            )


def _check_layers(scene: mi.Scene, surfaces: list[mi.Shape], water: Any) -> None:
    """Refuse water layers below all solids, and index layers that begin within the waves."""
    lowest = min((float(solid.bbox().min.z) for solid in _solids(scene, surfaces)), default=-np.inf)
    for solid in _solids(scene, surfaces):
        if float(solid.bbox().min.z) == lowest >= 0:
            raise UserError(
                f"shape {solid.id()!r} at z = {lowest:g} m is the lowest one: a bottom must lie below the mean sea "
                "level, at a depth greater than 0"
            )
    deepest = float(water.column.layer_tops[-1])
    if not water.from_profile and -deepest <= lowest:
        raise UserError(f"layer_tops = {deepest:g} m is a layer below the bottom: it must be less than {-lowest:g} m")
    trough = min(float(surface.bbox().min.z) for surface in surfaces)
    for boundary in water.index_layers.boundaries[:1]:
        if -boundary >= trough:
            raise UserError(
                f"refractive_index changes at {boundary:g} m, within the waves: "
                f"it must do so below their troughs, {-trough:.3g} m"
            )
