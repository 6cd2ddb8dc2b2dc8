"""The parts of a lidar scene that the integrators need, found and checked once."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.transport.opaque import is_one_of, opaque
from mitransient_lidar.transport.receiving import Receiver
from mitransient_lidar.transport.sorting import Sorting
from mitransient_lidar.transport.strata import Strata

#: Total slope variance assumed for a surface that does not tell its own: a broad lobe serves any sea.
_UNKNOWN_SLOPE_VARIANCE = 0.04


@dataclass(frozen=True)
class WaterScene:
    """Receiver, water and sea surface of a Mitsuba scene, whatever lights it.

    Attributes
    ----------
    scene
        The Mitsuba scene.
    receiver
        Pose, aperture and pixels of the sensor.
    water
        The ``layered_water``, or None in a scene without any.
    surfaces
        Shapes that have the water as interior medium.
    slope_variance
        Total slope variance of the sea, which shapes the proposals of the surface connection.
    """

    scene: mi.Scene
    receiver: Receiver
    water: mi.Medium | None
    surfaces: list[mi.Shape]
    slope_variance: float

    @property
    def solids(self) -> list[mi.Shape]:
        """All shapes that do not bound the water."""
        return [shape for shape in self.scene.shapes() if not any(shape is surface for surface in self.surfaces)]

    @property
    def has_unmerged_solids(self) -> bool:
        """Whether a solid has a mirror-like part, or rises above the lowest point of the sea."""
        lowest = min((float(surface.bbox().min.z) for surface in self.surfaces), default=0.0)
        mirror = mi.BSDFFlags.DeltaReflection.value | mi.BSDFFlags.DeltaTransmission.value
        return any(int(solid.bsdf().flags()) & mirror or float(solid.bbox().max.z) > lowest for solid in self.solids)

    @property
    def facet_size(self) -> float:
        """Side of the squares of which the sea surface's triangles are halves where the lidar looks [m].

        Their average for a mesh that does not tell it.
        """
        sizes = [
            getattr(surface, "cell_size", None) or float(np.sqrt(2 * surface.surface_area()[0] / surface.face_count()))
            for surface in self.surfaces
            if surface.is_mesh()
        ]
        return min(sizes, default=np.inf)

    @property
    def refractive_index(self) -> float:
        """Refractive index of the water, of its first stratum, 1 without water."""
        return self.water.refractive_index if self.water is not None else 1.0

    @property
    def strata(self) -> Strata | None:
        """Strata of the water, None without water."""
        return self.water.strata if self.water is not None else None

    @property
    def group_index(self) -> float:
        """Group index of the water, of its first stratum, 1 without water."""
        return self.water.group_index if self.water is not None else 1.0

    def beside_surface(self, z: mi.Float, in_water: mi.Bool) -> mi.Bool:
        """Return whether a height [m] can only be reached beside the surface: wet above it, or dry below it."""
        if not self.surfaces:
            return mi.Bool(False)
        boxes = [surface.bbox() for surface in self.surfaces]
        lowest, highest = min(float(box.min.z) for box in boxes), max(float(box.max.z) for box in boxes)
        # A millimetre of room for points that lie on the surface to rounding.
        return dr.select(in_water, z > opaque(highest + 1e-3), z < opaque(lowest - 1e-3))

    def is_surface(self, shape: mi.ShapePtr) -> mi.Bool:
        """Return whether a shape bounds the water."""
        return is_one_of(shape, self.surfaces)


@dataclass(frozen=True)
class LidarScene(WaterScene):
    """A scene with a transmitter and a receiver that records when its light comes back.

    Attributes
    ----------
    transmitter
        The ``lidar_transmitter``.
    film
        The receiver's ``time_gated_film``.
    sorting
        Classes by which the received light is told apart, or None.
    """

    transmitter: mi.Emitter
    film: mi.Film
    sorting: Sorting | None = None

    @classmethod
    def from_scene(cls, scene: mi.Scene, sensor: mi.Sensor, orders: int = 0) -> LidarScene:
        """Find the parts in a loaded scene; `orders` of scattering are told apart, 0 for none.

        Sun and sky may be there, too: they do not pulse, and are left out.

        Raises
        ------
        ValueError
            When a part is missing, of a foreign kind, or there is more than one where one is allowed.
        """
        receiver = find_receiver(sensor)
        film = sensor.film()
        if not hasattr(film, "add_transient"):
            raise ValueError("film: the lidar integrators need a time_gated_film inside the sensor")
        emitters = [emitter for emitter in scene.emitters() if not hasattr(emitter, "daylight")]
        transmitters = [emitter for emitter in emitters if hasattr(emitter, "pulse_energy")]
        if len(transmitters) != 1 or len(emitters) != 1:
            raise ValueError(
                f"emitters: the scene has {len(emitters)} of which {len(transmitters)} are lidar_transmitter; "
                "allowed is exactly one lidar_transmitter, beside sun and sky"
            )
        water, surfaces = find_water(scene)
        if receiver.pose.origin[2] <= 0 or transmitters[0].pose.origin[2] <= 0:
            raise ValueError("altitude: transmitter and receiver must be above the mean sea level z = 0")
        _check_cells(surfaces, transmitters[0])
        if water is not None:
            check_layers(scene, surfaces, water)
        variance = largest_slope_variance(surfaces)
        sorting = Sorting(orders) if orders > 0 else None
        return cls(scene, receiver, water, surfaces, variance, transmitters[0], film, sorting)

    def prepare_film(self) -> None:
        """Clear the film and make room for the pixels, or for their classes."""
        pixels, energy = self.receiver.pixels, self.transmitter.energy
        if self.sorting is None:
            self.film.prepare_pixels(pixels.count, energy, pixels.grid)
        else:
            self.film.prepare_pixels(pixels.count * self.sorting.classes, energy)


def find_receiver(sensor: mi.Sensor) -> Receiver:
    """Return what the integrators need of a sensor; raise ValueError when it is of a foreign kind."""
    receiver = getattr(sensor, "receiver", None)
    if not isinstance(receiver, Receiver):
        raise ValueError("sensor: the lidar integrators need a multipixel_receiver or pixel_fov")
    return receiver


def find_water(scene: mi.Scene) -> tuple[mi.Medium | None, list[mi.Shape]]:
    """Return the water of a scene, None without any, and the shapes that have it as interior medium.

    Raises
    ------
    ValueError
        When a medium is of a foreign kind or in the wrong place, or there is more than one.
    """
    surfaces: list[mi.Shape] = []
    waters: list[mi.Medium] = []
    for shape in scene.shapes():
        if not shape.is_medium_transition():
            continue
        if shape.exterior_medium() is not None:
            raise ValueError(f"shape {shape.id()!r}: the water must be its interior medium and its exterior empty")
        water = shape.interior_medium()
        if not hasattr(water, "flight"):
            raise ValueError(f"shape {shape.id()!r}: its interior medium must be layered_water")
        surfaces.append(shape)
        if not any(water is other for other in waters):
            waters.append(water)
    for shape in scene.shapes():
        if hasattr(shape, "ripple_variance") and shape not in surfaces:
            raise ValueError(f"ocean_surface {shape.id()!r}: needs a layered_water as its interior medium")
    if len(waters) > 1:
        raise ValueError(f"media: the scene has {len(waters)} layered_water; allowed is one that shapes share")
    return (waters[0] if waters else None), surfaces


def largest_slope_variance(surfaces: list[mi.Shape]) -> float:
    """Return the total slope variance of the roughest surface; a usual one where none tells its own."""
    variances = [shape.slope_variance for shape in surfaces if getattr(shape, "has_ripples", False)]
    return max(variances, default=_UNKNOWN_SLOPE_VARIANCE)


def _check_cells(surfaces: list[mi.Shape], transmitter: mi.Emitter) -> None:
    """Refuse waves in cells longer than the beam is wide: a shot would see a single slope."""
    spot = transmitter.pose.ground_point()
    footprint = 2 * transmitter.angular_spread * float(np.linalg.norm(spot - transmitter.pose.origin))
    for surface in surfaces:
        cell = getattr(surface, "cell_size", np.inf)
        if np.isfinite(cell) and cell > footprint:
            raise ValueError(
                f"cell_size = {cell:.3g} m is coarser than the beam's footprint on the sea, {footprint:.3g} m: "
                "it must be finer, or 'auto'"
            )


def check_layers(scene: mi.Scene, surfaces: list[mi.Shape], water: mi.Medium) -> None:
    """Refuse layers below all solids, and strata that begin within the waves."""
    solids = [shape for shape in scene.shapes() if not any(shape is surface for surface in surfaces)]
    lowest = min((float(solid.bbox().min.z) for solid in solids), default=-np.inf)
    deepest = float(water.column.tops[-1])
    if not water.from_profile and -deepest <= lowest:
        raise ValueError(f"tops = {deepest:g} m is a layer below the bottom: it must be less than {-lowest:g} m")
    trough = min(float(surface.bbox().min.z) for surface in surfaces)
    for edge in water.strata.edges[:1]:
        if -edge >= trough:
            raise ValueError(
                f"refractive_index changes at {edge:g} m, within the waves: "
                f"it must do so below their troughs, {-trough:.3g} m"
            )
