"""Scene parts as paths meet them; `transport.scene_parts` finds them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Self, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.gate_train import GatePlan, GateTrain, range_time_ns
from mitransient_lidar.physics.lidar.level_sea import LevelSea, refract_level
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.transport.medium.water import IndexLayers, Water
from mitransient_lidar.transport.opaque import is_one_of, opaque, opaque_point
from mitransient_lidar.transport.perturbations import Perturbations
from mitransient_lidar.transport.plugin_types import SeaShape, Transmitter
from mitransient_lidar.transport.pose import KernelPose, RelativePose
from mitransient_lidar.transport.sensor.receiver import Receiver
from mitransient_lidar.transport.solids import box_of, children, scene_of_shapes

#: Height above all shapes from which paths start there instead of at the lidar, and height of these points [m].
_FAR, _CLEARANCE = 1e4, 1.0

_ROUNDING = 2.0**-21  #: Largest intersection rounding error over the coordinates.
_FACET_PER_WAVE = 0.25  #: Length over which slopes change, over the shortest wavelength.
_BOTTOM_PER_LARGEST = 0.25  #: Smallest bottom side over the largest solid's side.


_LEVEL = 1e-3  #: Smallest cosine from the vertical of an axis under water that has depths.

Vector = TypeVar("Vector", mi.Vector3f, mi.Point3f, mi.Normal3f)


@dataclass(frozen=True)
class ScenePart:
    """Shapes that shots meet at a place of their own.

    Points in the lidar's frame are turned about the vertical and then displaced [m] to the shapes. The cosine and sine
    of the angle are `turn`. Without `turn` they are only displaced.
    """

    OF_SHOTS = ("displacement", "turn")

    shapes: mi.Scene
    displacement: mi.Vector3f
    turn: mi.Vector2f | None = None

    def ray(self, ray: mi.Ray3f) -> mi.Ray3f:
        """Return rays in the lidar's frame among the shapes."""
        moved = mi.Ray3f(ray)
        if self.turn is not None:
            moved.o, moved.d = (_turned(vector, self.turn) for vector in (ray.o, ray.d))
        moved.o += self.displacement
        return moved


@dataclass(frozen=True)
class WaterScene:
    """Receiver, water and sea surface in a scene."""

    OF_SHOTS: ClassVar[tuple[str, ...]] = ("parts", "receiver_poses")

    mitsuba_scene: mi.Scene  #: The Mitsuba scene.
    receiver: Receiver  #: Pose, aperture and pixels of the sensor.
    water: Water | None  #: Its water, or None in a scene without water.
    surfaces: list[mi.Shape]  #: Shapes that bound the water, with it as interior medium.
    slope_variance: float  #: Total slope variance of the sea, for sampling surface connections.
    #: Scene parts at locations that differ between shots, in place of `mitsuba_scene`; none for a single shot.
    parts: tuple[ScenePart, ...] = field(default=(), kw_only=True)
    #: Pose of the receiver in each shot, where they differ.
    receiver_poses: KernelPose | None = field(default=None, kw_only=True)
    #: Changes of water and solids whose effect on each path is summed.
    perturbations: Perturbations = field(default_factory=Perturbations, kw_only=True)
    groups: tuple[mi.Shape, ...] = field(default=(), kw_only=True)  #: Shape groups that instances repeat.
    #: Whether a BSDF has an attribute that Mitsuba interpolates between vertices (`on_shapes`).
    interpolates: bool = field(default=False, kw_only=True)

    def with_parts_of(self, shapes: Sequence[mi.Shape]) -> Self:
        """Return a scene in parts without the parts that hold none of the shapes; the same one if all hold none."""
        parts = [part for part in self.parts if any(one is shape for one in part.shapes.shapes() for shape in shapes)]
        return replace(self, parts=tuple(parts)) if parts else self

    @property
    def receiver_pose(self) -> KernelPose:
        """Receiver pose for paths."""
        return self.receiver_poses or self.receiver.pose

    @property
    def frame_origin(self) -> FloatArray:
        """Origin of the ray coordinates, in the scene as it is given [m], (3,)."""
        return self.receiver.pose.frame_origin

    @property
    def solids(self) -> list[mi.Shape]:
        """All shapes that do not bound the water: bottoms and targets."""
        return solids_of(self.mitsuba_scene, self.surfaces)

    @property
    def seas(self) -> list[SeaShape]:
        """The ``ocean_surface`` shapes that bound the water."""
        return [surface for surface in self.surfaces if isinstance(surface, SeaShape)]

    def mean_slopes(self, shots: int) -> FloatArray:
        """Return the mean sea slopes along x and y under each shot's lidar [1], shape (shots, 2)."""
        slope = complex(*self.seas[0].sea.slope) if self.seas else 0j
        slopes = np.full(shots, slope)
        turns = [part.turn for part in self.parts if part.turn is not None]
        if turns:
            cos, sin = np.array(turns[0], np.float64)
            slopes = slopes * (cos - 1j * sin)
        return np.stack([slopes.real, slopes.imag], axis=-1)

    @property
    def bottoms(self) -> list[mi.Shape]:
        """Solids that are the bottom, or a part of it; all others are targets.

        A bottom's bounding box has a shorter horizontal side of at least the field of view's width at its distance, and
        at least a quarter of the largest solid's.
        """
        boxes = [box_of(solid) for solid in self.solids]
        sides = [float((high - low)[:2].min()) for low, high in boxes]
        origin, field_of_view = self.receiver.pose.origin, self.receiver.pixels.field_of_view
        widths = [field_of_view * float(np.linalg.norm(np.clip(origin, *box) - origin)) for box in boxes]
        smallest = _BOTTOM_PER_LARGEST * max(sides, default=0.0)
        rows = zip(self.solids, sides, widths, strict=True)
        return [solid for solid, side, width in rows if side >= max(width, smallest)]

    @cached_property
    def bottoms_alone(self) -> mi.Scene:
        """Scene of the bottoms."""
        return scene_of_shapes(self.bottoms, self.groups)

    @cached_property
    def solids_alone(self) -> mi.Scene | None:
        """Scene of the solids, None without any."""
        return scene_of_shapes(self.solids, self.groups) if self.solids else None

    @property
    def targets(self) -> list[mi.Shape]:
        """Solids that are not `bottoms`."""
        bottoms = self.bottoms
        return [solid for solid in self.solids if not any(solid is bottom for bottom in bottoms)]

    @property
    def empty_heights(self) -> tuple[float, float]:
        """Heights of the highest solid's top and the sea's lowest point: no shape lies between [m]."""
        highest = max((float(solid.bbox().max.z) for solid in self.solids), default=-np.inf)
        return highest, -np.inf if self.sea_heights is None else self.sea_heights[0]

    @property
    def sea_heights(self) -> tuple[float, float] | None:
        """Lowest and highest point of the sea [m], None without one."""
        boxes = [surface.bbox() for surface in self.surfaces]
        return (min(float(box.min.z) for box in boxes), max(float(box.max.z) for box in boxes)) if boxes else None

    @property
    def has_specular_or_dry_solids(self) -> bool:
        """Whether a solid has a mirror-like part, or rises above the lowest point of the sea."""
        return self.has_specular_solids or self.has_dry_solids

    @property
    def has_specular_solids(self) -> bool:
        """Whether a solid has a mirror-like part."""
        return self._have_solids(mi.BSDFFlags.DeltaReflection.value | mi.BSDFFlags.DeltaTransmission.value)

    @property
    def has_dry_solids(self) -> bool:
        """Whether a solid rises above the lowest point of the sea."""
        lowest, _ = self.sea_heights or (0.0, 0.0)
        return any(float(solid.bbox().max.z) > lowest for solid in self.solids)

    @property
    def has_shared_gaps(self) -> bool:
        """Whether a solid has gaps, finer than patches, through which both laser and receiver look."""
        return any(getattr(solid, "shares_gaps", False) for solid in self.solids)

    @property
    def has_veils(self) -> bool:
        """Whether a solid lets a part of the light pass unchanged, such as a mask."""
        return self._have_solids(mi.BSDFFlags.Null.value)

    def _have_solids(self, flags: int) -> bool:
        """Return whether a solid's BSDF has one of the flags."""
        grouped = [shape for group in self.groups for shape in children(group)]
        return any(int(shape.bsdf().flags()) & flags for shape in (*self.solids, *grouped))

    @property
    def facet_size(self) -> float:
        """Length over which slopes of the sea surface change [m].

        A quarter of the shortest waves that the beam needs or, if longer, the cell side. In other plugins' meshes it is
        the mean side of a cell, a triangle pair. Shorter waves for an image's pixels, and cells finer than their waves,
        do not count.
        """
        sizes = [
            max(surface.sea.cell_size, _FACET_PER_WAVE * surface.sea.beam_wave)
            if isinstance(surface, SeaShape)
            else float(np.sqrt(2 * surface.surface_area()[0] / surface.face_count()))
            for surface in self.surfaces
            if surface.is_mesh()
        ]
        return min(sizes, default=np.inf)

    @property
    def required_water(self) -> Water:
        """The water, for a scene that has one."""
        if self.water is None:
            raise UserError("the scene has no water: give its surface a layered_water as interior medium")
        return self.water

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
        arrays = layers.refractive_index, layers.boundaries, layers.group_index
        return LevelSea(*(tuple(map(float, each)) for each in arrays))

    def gate_train(self, plan: GatePlan) -> GateTrain:
        """Return the gates of a plan at their times, which waves do not change.

        Raises UserError if they start at a depth, and the receiver's axis does not meet the mean sea level, or is level
        under water.
        """
        pose, start = self.receiver.pose, plan.start
        meets_sea = bool(self.surfaces) and pose.looks_down
        if plan.given == "gate_start_range":
            to_sea = pose.ground_range if meets_sea else 0.0 if pose.submerged else np.inf
            start = range_time_ns(start, to_sea, self.group_index)
        elif plan.given == "gate_start_depth":
            if not meets_sea and not (pose.submerged and abs(pose.axis[2]) > _LEVEL):
                what = "the axis of the receiver does not meet it" if self.surfaces else "the scene has none"
                raise UserError(
                    f"gate_start_depth = {start:g} m counts from the mean sea level, and {what}: give gate_start_ns"
                )
            if pose.submerged:
                begin, above, down = 0.0, start + float(pose.origin[2]), -float(pose.axis[2])
            else:
                begin, above = 2e9 / C0 * pose.ground_range, start
                down = -float(refract_level(pose.axis, self.refractive_index)[2])
            start = begin + above / (0.5e-9 * C0 / self.group_index * down)
        return replace(plan.train, start_ns=start)

    def relative(self, pose: KernelPose) -> RelativePose:
        """Return a pose relative to the scene's reference point, as path lengths are."""
        return RelativePose(pose, self.receiver.pose.nearby_point())

    def first_points(self, pose: KernelPose, angles: mi.Point2f, direction: mi.Vector3f) -> tuple[mi.Point3f, mi.Float]:
        """Return where paths from a pose start [m], at tangent-plane angles, and their relative lengths there [m].

        Paths from more than 10 km above the scene start 1 m above all shapes. Traced from farther away in single
        precision, rays would pass between the sea's triangles: 1.6 % from 500 km at 20 degrees.
        """
        origin, relative = pose.point, self.relative(pose)
        top = float(self.mitsuba_scene.bbox().max.z) + _CLEARANCE
        if pose.lanes is not None or pose.origin[2] - top < _FAR:
            return origin, relative.distance(origin)
        on_axis = RelativePose(pose, pose.nearby_point())
        point = dr.select(direction.z < 0, on_axis.at_height(angles, direction, top), origin)
        return point, relative.distance(point)

    def ray_intersect(self, ray: mi.Ray3f, active: mi.Bool | bool = True) -> mi.SurfaceInteraction3f:
        """Return the first ray intersections."""
        if not self.parts:
            return self.mitsuba_scene.ray_intersect(ray, active)
        nearest, shift = dr.zeros(mi.PreliminaryIntersection3f), mi.Vector3f(0)
        nearest.t = dr.inf
        turn = mi.Vector2f(1, 0)
        for part in self.parts:
            moved = part.ray(ray)
            # Intersections beyond a shape in another part do not matter.
            moved.maxt = dr.minimum(ray.maxt, nearest.t)
            found = part.shapes.ray_intersect_preliminary(moved, active=active)
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

    def on_shapes(self, si: mi.SurfaceInteraction3f) -> mi.SurfaceInteraction3f:
        """Return intersections at their places on the shapes of parts, between whose vertices BSDFs interpolate."""
        if not (self.parts and self.interpolates):
            return si
        found = mi.SurfaceInteraction3f(si)
        for part in self.parts:
            place = part.ray(mi.Ray3f(si.p, si.n)).o
            found.p = dr.select(is_one_of(si.shape, part.shapes.shapes()), place, found.p)
        return found

    def ray_test(self, ray: mi.Ray3f, active: mi.Bool | bool = True) -> mi.Bool:
        """Return whether rays are blocked."""
        if not self.parts:
            return self.mitsuba_scene.ray_test(ray, active)
        blocked = mi.Bool(False)
        for part in self.parts:
            blocked |= part.shapes.ray_test(part.ray(ray), active & ~blocked)
        return blocked

    def look_through(self, ray: mi.Ray3f, active: mi.Bool) -> tuple[mi.SurfaceInteraction3f, mi.Float, mi.Float]:
        """Return the first intersections of rays behind veils, their distances [m], and the share that veils let pass.

        Where nothing passes the intersection is that with a veil.
        """
        if not self.has_veils:
            si = self.ray_intersect(ray, active)
            return si, si.t, mi.Float(1)

        def step(
            ray: mi.Ray3f, si: mi.SurfaceInteraction3f, before: mi.Float, share: mi.Float, looking: mi.Bool
        ) -> tuple[mi.Ray3f, mi.SurfaceInteraction3f, mi.Float, mi.Float, mi.Bool]:
            si = dr.select(looking, self.ray_intersect(ray, looking), si)
            passed = si.bsdf().eval_null_transmission(self.on_shapes(si), looking & si.is_valid())[0]
            looking &= si.is_valid() & (passed > 0)
            share = dr.select(looking, share * passed, share)
            beyond = self.spawn_ray(si, ray.d).o
            skipped = dr.dot(beyond - ray.o, ray.d)
            before = dr.select(looking, before + skipped, before)
            ray.o, ray.maxt = dr.select(looking, beyond, ray.o), dr.select(looking, ray.maxt - skipped, ray.maxt)
            return ray, si, before, share, looking & (ray.maxt > 0)

        state = mi.Ray3f(ray), dr.zeros(mi.SurfaceInteraction3f), mi.Float(0), mi.Float(1), mi.Bool(active)
        _, si, before, share, _ = dr.while_loop(state, lambda *state: state[-1], step, label="veils")
        return si, before + si.t, share

    def share_along(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Float:
        """Return the share of the light along rays that no shape blocks."""
        if not self.has_veils:
            return dr.select(self.ray_test(ray, active), mi.Float(0), 1)
        si, _, share = self.look_through(ray, active)
        return dr.select(si.is_valid(), 0, share)

    def spawn_ray(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> mi.Ray3f:
        """Return rays that leave surfaces, from points beside them so that they do not meet these again.

        Mitsuba's own offset grows with the distance from the world's origin. At 250 m it is 2 cm, and a path to a
        bottom and back loses 0.2 ns. This offset grows with the distance from the scene's reference point, and with
        coordinate rounding.
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
        if self.sea_heights is None:
            return mi.Bool(False)
        lowest, highest = self.sea_heights
        # A margin of a millimetre for points that lie on the surface to rounding.
        return dr.select(in_water, z > opaque(highest + 1e-3), z < opaque(lowest - 1e-3))

    def is_empty(self, z: mi.Float) -> mi.Bool:
        """Return whether heights [m] lie in `empty_heights`: lines between two of them meet no shape."""
        lowest, highest = (opaque(z) for z in self.empty_heights)
        return (z > lowest) & (z < highest)

    def is_surface(self, shape: mi.ShapePtr) -> mi.Bool:
        """Return whether a shape bounds the water."""
        return is_one_of(shape, self.surfaces)


@dataclass(frozen=True)
class LidarScene(WaterScene):
    """A scene with a transmitter, and a receiver that records the time of arrival."""

    OF_SHOTS = (*WaterScene.OF_SHOTS, "transmitter_poses")

    transmitter: Transmitter  #: The ``lidar_transmitter``.
    axis: TimeAxis  #: Time bins of the record.
    gates: GatePlan | None  #: Gates of the ``time_gated_film``, or None.
    record_end: str = ""  #: Source of the last light in the record, where the scene decides its end.
    #: Pose of the transmitter in each shot, where they differ.
    transmitter_poses: KernelPose | None = field(default=None, kw_only=True)

    @property
    def transmitter_pose(self) -> KernelPose:
        """Transmitter pose for paths."""
        return self.transmitter_poses or self.transmitter.pose

    @property
    def submerged(self) -> bool:
        """Whether laser and receiver are under water."""
        return bool(self.transmitter.pose.submerged)

    @property
    def reference_length(self) -> float:
        """Length from laser to receiver by the reference point [m], which all lengths of paths leave out."""
        return float(sum(self.relative(each.pose).range for each in (self.transmitter, self.receiver)))


def _turned(vector: Vector, turn: mi.Vector2f) -> Vector:
    """Return vectors or points turned about the vertical, by angles with this cosine and sine."""
    (x, y, z), (cos, sin) = vector, turn
    return type(vector)(dr.fma(cos, x, -sin * y), dr.fma(sin, x, cos * y), z)


def solids_of(scene: mi.Scene, surfaces: list[mi.Shape]) -> list[mi.Shape]:
    """Return the shapes that are not among the surfaces of the water."""
    return [shape for shape in scene.shapes() if not any(shape is surface for surface in surfaces)]
