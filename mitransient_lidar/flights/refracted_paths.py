"""Pulse paths through the sea surface to points in the water, and error propagation to the points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, Plan
from mitransient_lidar.core.validation import BoolArray, FloatArray, finite_array
from mitransient_lidar.flights.sea_surface import Facets, SurfaceModel
from mitransient_lidar.physics.lidar.level_sea import cos_in_water, refract

_CLEARLY = 2.0  #: Ratio of errors from which a pulse's own surface replaces a plane through several.


@dataclass(frozen=True)
class PoseErrors(Plan):
    """Standard deviations of a flight's known poses, by default typical for post-processed surveys."""

    roll_deg: Annotated[float, Option("Roll", 0, unit="deg")] = 0.0025
    pitch_deg: Annotated[float, Option("Pitch", 0, unit="deg")] = 0.0025
    heading_deg: Annotated[float, Option("Heading", 0, unit="deg")] = 0.005
    horizontal_m: Annotated[float, Option("Position in each horizontal direction", 0, unit="m")] = 0.03
    height_m: Annotated[float, Option("Position in height", 0, unit="m")] = 0.05
    range_m: Annotated[float, Option("Calibration of the range", 0, unit="m")] = 0.01

    def rotations(self, forward: npt.ArrayLike | None, shots: int) -> FloatArray:
        """Return the rotation vectors of roll, pitch and heading by one standard deviation [rad], shape (3, shots, 3).

        Roll turns about the horizontal part of `forward`, shape (3,) or (shots, 3), pitch about the horizontal
        direction across it, heading about the vertical. With equal errors of roll and pitch any direction will do.

        Raises UserError if `forward` is vertical, of another shape, or missing where roll and pitch have different
        errors.
        """
        if forward is None:
            if self.roll_deg != self.pitch_deg:
                raise UserError(
                    f"roll_deg = {self.roll_deg:g} and pitch_deg = {self.pitch_deg:g} differ: the forward axis of the "
                    "platform must be given"
                )
            forward = (1.0, 0.0, 0.0)
        given = finite_array("forward", forward)
        if given.shape not in ((3,), (shots, 3)):
            raise UserError(f"forward of shape {given.shape} must have the shape (3,) or ({shots}, 3)")
        along = np.broadcast_to(given, (shots, 3)) * [1.0, 1.0, 0.0]
        length = np.linalg.norm(along, axis=-1, keepdims=True)
        if np.any(length == 0):
            raise UserError(f"forward of pulse {int(np.argmin(length))} must not be vertical")
        along = along / length
        up = np.broadcast_to([0.0, 0.0, 1.0], along.shape)
        angles = np.radians([self.roll_deg, self.pitch_deg, self.heading_deg])
        return np.asarray(angles[:, None, None] * np.stack([along, np.cross(up, along), up]))


class Timing(NamedTuple):
    """What n points' echoes state, all in metres with shape (n,)."""

    surface_range: FloatArray  #: Distance in air to the surface.
    surface_noise: FloatArray  #: Its standard error by noise.
    surface_method: FloatArray  #: Its error by the few places that return light.
    echo_noise: FloatArray  #: Standard error by noise of the distance in air that the arrival of the echo means.
    depth: FloatArray  #: Depth of a level sea, 0 for a point on the surface.
    depth_method: FloatArray  #: Standard deviation of its method error.


@dataclass(frozen=True, eq=False)
class RefractedPaths:
    """Paths o + R d + s w of n points: a leg in air and, behind the surface, one in the water.

    With the normal m of the surface, Snell's law is w = d/n + (c/n - c_w) m. Here c = -d . m and c_w^2 = 1 - (1 -
    c^2)/n^2. The length in the water is s = (T - R)/n_g with T = R_s + n_g D/cos(theta_w): R_s and D are surface range
    and depth by the echoes, theta_w is a level sea's refracted angle.
    """

    origin: FloatArray  #: Position of the lidar o [m], shape (n, 3).
    #: Unit directions d and w, shape (n, 3).
    direction: FloatArray
    refracted: FloatArray
    #: R and s [m], shape (n,); s is 0 for points on the surface.
    distance: FloatArray
    length: FloatArray
    facets: Facets  #: Surface where the paths cross it.
    #: Whether a point is in the water, and whether R is that of the facets instead of R_s.
    in_water: BoolArray
    on_model: BoolArray
    timing: Timing  #: What the echoes say.
    #: Refractive and group index of the water.
    index: float
    group_index: float

    @classmethod
    def trace(
        cls,
        origin: FloatArray,
        direction: FloatArray,
        timing: Timing,
        classes: tuple[BoolArray, BoolArray],
        indices: tuple[float, float],
        surface: SurfaceModel,
        time_s: FloatArray,
    ) -> RefractedPaths:
        """Trace paths.

        `origin`, `direction`: positions [m] and unit directions that go down, shape (n, 3). `timing`: what the echoes
        say. `classes`: whether a point is in the water, and whether its pulse has no echo, shape (n,). `indices`:
        refractive and group index. `surface`: the sea. Points in the water are beyond its planes, if it has some, but
        beyond R_s where its error is below half the plane height's. Points from pulses without an echo are on the
        surface. `time_s`: times [s], shape (n,).
        """
        (in_water, silent), (n, group) = classes, indices
        on_model = silent | (in_water & (surface.points is not None))
        level = (surface.level - origin[:, 2]) / direction[:, 2]
        distance = np.where(silent, level, timing.surface_range)
        place = origin + distance[:, None] * direction
        facets = surface.at(place[:, :2], time_s)
        own = np.hypot(timing.surface_noise, timing.surface_method) * -direction[:, 2]
        on_model = silent | (on_model & ~((own > 0) & (_CLEARLY * own < facets.height_error)))
        # Where the line of sight meets the plane at `place`.
        normal = np.column_stack([-facets.slope, np.ones(len(place))])
        above = place[:, 2] - facets.height
        distance = np.where(on_model, distance - above / _dot(normal, direction), distance)
        cos_level = cos_in_water(direction[:, 2], n)
        arrival = timing.surface_range + group * timing.depth / cos_level
        length = np.where(in_water, (arrival - distance) / group, 0.0)
        refracted = refract(direction, normal, n)
        return cls(origin, direction, refracted, distance, length, facets, in_water, on_model, timing, n, group)

    @property
    def place(self) -> FloatArray:
        """The points [m], shape (n, 3)."""
        return self.origin + self.distance[:, None] * self.direction + self.length[:, None] * self.refracted

    def variance(
        self, errors: PoseErrors, rotations: FloatArray, sides: FloatArray, slope_deviation: float
    ) -> FloatArray:
        """Return the variances of x, y and z [m^2], shape (n, 3), to first order in independent errors.

        `errors`: pose standard deviations. `rotations`: rotation vectors for roll, pitch and heading by one standard
        deviation [rad], shape (3, n, 3). `sides`: standard deviations of pixel light about the line of sight as vectors
        [rad], shape (2, n, 3). `slope_deviation`: standard deviation of slopes in the depth's method error [1].
        """
        d, w, n = self.direction, self.refracted, self.index
        normal = np.column_stack([-self.facets.slope, np.ones(len(d))])
        wet, model = self.in_water[:, None], self.on_model[:, None]
        # The point moves by this if the distance in air grows by 1 m and the arrival stays.
        with_distance = d - np.where(wet, w / self.group_index, 0.0)
        with_arrival = np.where(wet, w / self.group_index, 0.0)
        to_plane = _dot(normal, d)[:, None]

        def turned(change: FloatArray) -> FloatArray:
            """Return what a change of d does to the point."""
            hit = np.where(model, -self.distance[:, None] * _dot(normal, change)[:, None] / to_plane, 0.0)
            bent = self.length[:, None] * _bent(d, normal, n, change)
            return np.asarray(self.distance[:, None] * change + hit * with_distance + bent)

        def moved(change: FloatArray) -> FloatArray:
            """Return what a change of the lidar's position does to the point."""
            hit = np.where(model, -(normal @ change)[:, None] / to_plane, 0.0)
            return np.asarray(change + hit * with_distance)

        deviations = errors.horizontal_m, errors.horizontal_m, errors.height_m
        columns = [deviation * moved(one) for deviation, one in zip(deviations, np.eye(3), strict=True)]
        columns += [turned(np.cross(rotation, d)) for rotation in rotations]
        # A later surface and a later echo by as much: the calibration of the range.
        columns.append(errors.range_m * np.where(model, with_arrival, d))
        timing = self.timing
        own = np.where(model, 0.0, with_distance)
        columns += [timing.surface_noise[:, None] * own, timing.surface_method[:, None] * own]
        columns.append(timing.echo_noise[:, None] * with_arrival)
        columns.append(self.facets.height_error[:, None] * np.where(model, with_distance / to_plane, 0.0))
        slopes = [self.length[:, None] * one for one in _tilted(d, normal, n)]
        columns += [error[:, None] * one for error, one in zip(self.facets.slope_error.T, slopes, strict=True)]
        cos_level = cos_in_water(d[:, 2], n)
        by_surface = timing.surface_method * cos_level / self.group_index
        by_slopes = slope_deviation**2 * sum(one[:, 2] ** 2 for one in slopes)
        rest = np.maximum(timing.depth_method**2 - by_surface**2 - by_slopes, 0.0)
        columns.append(np.where(wet, (np.sqrt(rest) / cos_level)[:, None] * w, 0.0))
        for side in sides:
            # Along the level surface: the method errors hold what the extent of the pixel does to the times.
            change = side - _dot(side, d)[:, None] * d
            level = self.distance[:, None] * (change - d * (change[:, 2:] / d[:, 2:]))
            columns.append(level + self.length[:, None] * _bent(d, normal, n, change))
        return np.asarray(sum(column**2 for column in columns))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the scalar products of vectors, shape (n,)."""
    return np.asarray(np.einsum("ni,ni->n", a, b))


def _factor(direction: FloatArray, unit: FloatArray, n: float) -> FloatArray:
    """Return the factor f = c/n - c_w of the unit normals in refracted directions, shape (N,)."""
    c = -_dot(direction, unit)
    return np.asarray(c / n - cos_in_water(c, n))


def _bent(direction: FloatArray, normal: FloatArray, n: float, change: FloatArray) -> FloatArray:
    """Return the refracted direction's change with the direction in air, both shape (N, 3)."""
    unit = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return np.asarray(change / n - (_slope_of_factor(direction, unit, n) * _dot(change, unit))[:, None] * unit)


def _tilted(direction: FloatArray, normal: FloatArray, n: float) -> list[FloatArray]:
    """Return derivatives of the refracted direction by surface rises towards +x and +y, shape (N, 3)."""
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    unit = normal / size
    factor = _factor(direction, unit, n)
    derivatives = []
    for axis in range(2):
        change = -np.eye(3)[axis] / size
        change = change - _dot(change, unit)[:, None] * unit
        by_angle = _slope_of_factor(direction, unit, n) * _dot(direction, change)
        derivatives.append(factor[:, None] * change - by_angle[:, None] * unit)
    return derivatives


def _slope_of_factor(direction: FloatArray, unit: FloatArray, n: float) -> FloatArray:
    """Return df/dc = (1 - c/(n c_w))/n for `_factor`'s factor f, shape (N,)."""
    c = -_dot(direction, unit)
    return np.asarray((1 - c / (n * cos_in_water(c, n))) / n)
