"""Echo points: from pulse poses and echo times to coordinates with standard deviations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.analysis.waveforms.depth_errors import mean_slope
from mitransient_lidar.analysis.waveforms.echo_detection import EchoClass, has_echo
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import BoolArray, FloatArray, IntArray, finite_array, in_range
from mitransient_lidar.flights.refracted_paths import PoseErrors, RefractedPaths, Timing
from mitransient_lidar.flights.sea_surface import SurfaceModel
from mitransient_lidar.physics.lidar.pose import Pose
from mitransient_lidar.results.attributes import PointClass, flagged, label
from mitransient_lidar.results.geometry import optional_number

_PER_NS = 0.5e-9 * C0  # distance in air per nanosecond of a two-way time [m/ns]
_ORTHONORMAL = 1e-6  # largest error of lengths and products of the directions of a pose
_SMALLEST_DESCENT = 1e-3  # least vertical component of a line of sight that meets the sea


#: Echoes of `echo_table.extract` that are points, and their classes in the water.
ECHOES = {"surface": PointClass.SURFACE, "target": PointClass.OBJECT, "bottom": PointClass.BOTTOM}

#: Classes of points that are timed in air and not of the sea.
IN_AIR = {EchoClass.LAND: PointClass.GROUND, EchoClass.ABOVE: PointClass.UNCLASSIFIED}

_OF_ECHOES = ("depth_m", "depth_m_stderr", "depth_m_method_error", "time_ns_stderr", "amplitude", "flags")
_OF_SURFACES = ("surface_time_ns", "surface_time_ns_stderr", "surface_time_ns_method_error")


def positions(
    echoes: xr.Dataset,
    poses: Pose,
    angle_x: npt.ArrayLike,
    angle_y: npt.ArrayLike,
    *,
    refractive_index: float,
    group_index: float,
    surface: SurfaceModel | None = None,
    errors: PoseErrors | None = None,
    forward: npt.ArrayLike | None = None,
    view_x: npt.ArrayLike = 0.0,
    view_y: npt.ArrayLike = 0.0,
    time_s: npt.ArrayLike | None = None,
) -> xr.Dataset:
    """Compute the points of echoes.

    `echoes`: echoes from `echo_table.extract` with one estimator and depths from the surface echo, corrected by
    `depth_correction.correct_depths` or not. Over ``shot`` and ``pixel``, or ``row`` and ``column``. `poses`: pulse
    poses, with arrays of shape (shots, 3). `angle_x`, `angle_y`: tangent-plane angles of the pixels' lines of sight
    [rad], +angle_y to the left; they broadcast to (shots, pixels). Those of results are ``sight_x`` and ``sight_y``.
    `refractive_index`, `group_index`: indices of the water, 1 to 2 and 1 to 3. `surface`: the sea; by default, level at
    z = 0, with the slopes in the echoes' attributes. `errors`: pose standard deviations; by default `PoseErrors`.
    `forward`: platform's forward axis, not vertical, shape (3,) or (shots, 3). Needed where roll and pitch have
    different errors. `view_x`, `view_y`: standard deviations of a pixel's light about its line of sight [rad], at least
    0; they broadcast to (shots, pixels). `time_s`: times of the pulses [s], shape (shots,). A surface with planes needs
    them.

    Result: over ``point``, ordered by shot, pixel and arrival: ``x``, ``y``, ``z`` [m], ``kind`` (`PointClass`),
    ``depth`` [m] below the local surface, ``intensity`` (amplitude, in the unit of the echoes), the standard deviations
    ``x_uncertainty``, ``y_uncertainty``, ``vertical_uncertainty`` (of z), ``horizontal_uncertainty`` (root of the sum
    of the variances of x and y) and ``depth_uncertainty`` [m], ``shot``, ``pixel``, ``return_number``,
    ``number_of_returns``, ``flags``, ``echo`` (its place in `ECHOES`, -1 without an echo) and, with `time_s`,
    ``gps_time`` [s]. Land and objects above the water are timed in air: their depth is negative. A waveform without an
    echo has one point in class 45, where its line of sight meets the sea, with NaN as depth and intensity. Raises
    `UserError` if shapes do not agree, a pose is not orthonormal, a line of sight does not descend to the sea, or a
    value is out of range; or if the echoes lack a variable, have several estimators, or depths from the mean sea level.

    A point is at o + R d + s w, as of `RefractedPaths`: R is the range of the pixel's surface arrival, from which
    depths count, or with planes the plane's range. Over a level sea its z is that of the surface less the depth.

    Errors are propagated to first order and are independent: position, attitude and range of the lidar; arrivals of
    surface and echo; the depth's method error; surface height and slopes; and the light's place in the pixel. The
    depth's method error includes the parts by surface arrival and slopes, so that only its rest counts beside them.
    """
    table = _Table.of(echoes)
    errors = PoseErrors() if errors is None else errors
    angles = (_of_pixels(name, given, table.shape) for name, given in (("angle_x", angle_x), ("angle_y", angle_y)))
    pulses = _checked(poses, table.shape[0])
    direction = pulses.directions(np.stack(list(angles), axis=-1))
    for row, column in np.argwhere(direction[..., 2] > -_SMALLEST_DESCENT)[:1]:
        raise UserError(f"the line of sight of pulse {row}, pixel {column}, must descend to the sea")
    indices = in_range("refractive_index", refractive_index, 1, 2), in_range("group_index", group_index, 1, 3)
    if surface is None:
        surface = SurfaceModel(
            slope_deviation=mean_slope(echoes.attrs, _beam_width(echoes, pulses.origin[..., 2] / -direction[..., 2]))
        )
    times = np.zeros(table.shape[0]) if time_s is None else finite_array("time_s", time_s)
    if times.shape != table.shape[:1]:
        raise UserError(f"time_s of shape {times.shape} must have one time for each of {table.shape[0]} pulses")
    if time_s is None and surface.points is not None:
        raise UserError("a surface with planes needs the times of the pulses: give time_s")
    views = [_of_pixels(name, given, table.shape) for name, given in (("view_x", view_x), ("view_y", view_y))]
    if (least := min(float(view.min()) for view in views)) < 0:
        raise UserError(f"view_x and view_y must not be negative, but one is {least:g}")
    rotations = errors.rotations(forward, table.shape[0])

    shot, pixel, echo = table.points()
    kind = table.kinds(shot, pixel, echo)
    dry = np.isin(kind, [*IN_AIR.values()])
    timing = table.timing(shot, pixel, echo, dry, -direction[shot, pixel, 2])
    paths = RefractedPaths.trace(
        *(pulses.origin[shot, 0], direction[shot, pixel], timing, ((echo > 0) & ~dry, echo < 0)),
        *(indices, surface, times[shot]),
    )
    sides = np.stack(
        [view[shot, pixel, None] * side[shot, 0] for view, side in zip(views, (pulses.far, pulses.left), strict=True)]
    )
    variance = paths.variance(errors, rotations[:, shot], sides, surface.slope_deviation)
    x, y, z = paths.place.T
    sigma_x, sigma_y, sigma_z = np.sqrt(variance).T
    number, count = numbered_returns(shot, pixel)
    depth_errors = (table.value(f"depth_m_{kind}", shot, pixel, echo) for kind in ("stderr", "method_error"))
    values = {
        "x": x,
        "y": y,
        "z": z,
        "kind": kind.astype(np.uint8),
        # The surface from which depths count, estimated from all pixels of the shot; its own echo may be later.
        "depth": np.where(echo == 0, 0.0, table.value("depth_m", shot, pixel, echo)),
        "intensity": table.value("amplitude", shot, pixel, echo),
        "x_uncertainty": sigma_x,
        "y_uncertainty": sigma_y,
        "horizontal_uncertainty": np.hypot(sigma_x, sigma_y),
        "vertical_uncertainty": sigma_z,
        "depth_uncertainty": np.hypot(*depth_errors),
        "shot": shot,
        "pixel": pixel,
        "return_number": number,
        "number_of_returns": count,
        "flags": table.values["flags"][shot, pixel, np.maximum(echo, 0)].astype(np.int64),
        "echo": echo.astype(np.int8),
    }
    if time_s is not None:
        values["gps_time"] = times[shot]
    points = xr.Dataset({name: ("point", value) for name, value in values.items()})
    points = label(points, "points", intensity=echoes["amplitude"].attrs.get("units", ""))
    points["kind"].attrs.update(flagged(PointClass))
    return points.assign_attrs(surface_level_m=surface.level, surface_level_error_m=surface.level_error)


def fit_surface(points: xr.Dataset, slope_deviation: float, radius: float = 2.0) -> SurfaceModel:
    """Fit the sea to the surface points of a flight.

    `points`: points from `positions` over the whole flight; with planes they need ``gps_time``. `slope_deviation`,
    `radius`: as for `SurfaceModel.fit`.

    Raises `UserError` as `SurfaceModel.fit`, or if ``gps_time`` is missing.
    """
    own = points.isel(point=points["kind"].values == PointClass.SURFACE)
    if radius > 0 and "gps_time" not in own:
        raise UserError(f"radius = {radius:g}: planes need the times of the pulses, gps_time")
    place = np.stack([own[name].values for name in "xyz"], axis=-1)
    time = own["gps_time"].values if "gps_time" in own else np.zeros(len(place))
    error = own["vertical_uncertainty"].values
    return SurfaceModel.fit(place, error, time, slope_deviation=slope_deviation, radius=radius)


def _checked(poses: Pose, shots: int) -> Pose:
    """Return pulse poses with vectors of shape (shots, 1, 3), or refuse them."""
    vectors = {name: finite_array(name, getattr(poses, name)) for name in ("origin", "axis", "far", "left")}
    for name, value in vectors.items():
        if value.shape != (shots, 3):
            raise UserError(f"{name} of shape {value.shape} must have the shape ({shots}, 3), a vector a pulse")
    checked = Pose(**{name: value[:, None] for name, value in vectors.items()})
    frame = checked.frame[:, 0]
    skew = np.abs(frame @ frame.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) > _ORTHONORMAL
    if skew.any():
        raise UserError(f"axis, far and left of pulse {int(np.argmax(skew))} must be orthonormal")
    return checked


@dataclass(frozen=True, eq=False)
class _Table:
    """Echoes: surface, target and bottom values, shape (shots, pixels, 3), or the surface's, (shots, pixels)."""

    values: dict[str, FloatArray]
    shape: tuple[int, int]

    @classmethod
    def of(cls, echoes: xr.Dataset) -> _Table:
        """Read the echoes."""
        missing = [name for name in (*_OF_ECHOES, *_OF_SURFACES) if name not in echoes]
        if missing:
            raise UserError(f"the echoes lack {missing[0]}: they must be those of echo_table.extract")
        if "estimator" in echoes.dims:
            raise UserError("the echoes have several estimators: select one")
        if "mean sea level" in echoes["depth_m"].attrs.get("long_name", ""):
            raise UserError("the depths are from the mean sea level: they must be from the surface echo")
        pixels = ("row", "column") if "row" in echoes.dims else ("pixel",)
        if set(echoes["depth_m"].dims) != {"shot", *pixels, "echo"}:
            raise UserError(
                f"the echoes have the dimensions {', '.join(map(str, echoes.dims))}: they need shot and pixel"
            )
        chosen = echoes.sel(echo=list(ECHOES))
        values = {name: chosen[name].transpose("shot", *pixels, "echo").values for name in _OF_ECHOES}
        values |= {name: chosen[name].transpose("shot", *pixels).values for name in _OF_SURFACES}
        for name in {"class", "time_ns"} & set(chosen):
            values[name] = chosen[name].transpose("shot", *pixels, "echo").values
        shots = echoes.sizes["shot"]
        shape = shots, values["surface_time_ns"].size // max(shots, 1)
        last = {name: () if name in _OF_SURFACES else (len(ECHOES),) for name in values}
        return cls({name: value.reshape(*shape, *last[name]) for name, value in values.items()}, shape)

    def points(self) -> tuple[IntArray, IntArray, IntArray]:
        """Return shot, pixel and echo of all points, in order; a waveform without an echo has -1."""
        found = has_echo(self.values["flags"].astype(np.int64)) & np.isfinite(self.values["depth_m"])
        found &= np.isfinite(self.values["surface_time_ns"])[..., None]
        if "class" in self.values:
            found |= np.isin(self.values["class"], [*IN_AIR]) & np.isfinite(self.values["time_ns"])
        silent = ~found.any(axis=-1, keepdims=True)
        shot, pixel, echo = np.nonzero(np.concatenate([silent, found], axis=-1))
        if "time_ns" in self.values:
            # Objects above the water arrive before its surface.
            order = np.lexsort((np.nan_to_num(self.values["time_ns"][shot, pixel, echo - 1]), pixel, shot))
            shot, pixel, echo = shot[order], pixel[order], echo[order]
        return shot, pixel, echo - 1

    def kinds(self, shot: IntArray, pixel: IntArray, echo: IntArray) -> IntArray:
        """Return the `PointClass` of points."""
        kind = np.array([*ECHOES.values(), PointClass.NO_ECHO])[echo]
        for of_echo, of_point in IN_AIR.items() if "class" in self.values else ():
            own = (echo >= 0) & (self.values["class"][shot, pixel, echo] == of_echo)
            kind = np.where(own, of_point, kind)
        return kind

    def value(self, name: str, shot: IntArray, pixel: IntArray, echo: IntArray) -> FloatArray:
        """Return a quantity of points, NaN without an echo."""
        return np.where(echo >= 0, self.values[name][shot, pixel, echo], np.nan)

    def timing(self, shot: IntArray, pixel: IntArray, echo: IntArray, dry: BoolArray, cosine: FloatArray) -> Timing:
        """Return what the times of points mean; errors that are not known count as 0.

        `dry` points have their own range; the cosine belongs to their line of sight from the vertical.
        """
        surface = [_PER_NS * self.values[name][shot, pixel] for name in _OF_SURFACES]
        noise = _PER_NS * self.values["time_ns_stderr"][shot, pixel, echo]
        depth, method = (self.values[name][shot, pixel, echo] for name in ("depth_m", "depth_m_method_error"))
        wet = (echo > 0) & ~dry
        if dry.any():
            own = _PER_NS * self.values["time_ns"][shot, pixel, echo], noise, method / cosine
            surface = [np.where(dry, *pair) for pair in zip(own, surface, strict=True)]
        behind = [np.where(wet, np.nan_to_num(one), 0.0) for one in (noise, depth, method)]
        return Timing(surface[0], *map(np.nan_to_num, surface[1:]), *behind)


def _of_pixels(name: str, given: npt.ArrayLike, shape: tuple[int, int]) -> FloatArray:
    """Return values for every pulse and pixel; an array of rows and columns counts as pixels."""
    values = finite_array(name, given)
    if values.size == shape[1]:
        values = values.reshape(-1)
    try:
        return np.broadcast_to(values, shape)
    except ValueError:
        raise UserError(f"{name} of shape {np.shape(given)} must broadcast to {shape}, pulses and pixels") from None


def _beam_width(echoes: xr.Dataset, ranges: FloatArray) -> float:
    """Return the beam diameter on the sea [m], or the view's if that is smaller."""
    widths = [optional_number(echoes.attrs, f"{name}_mrad") for name in ("divergence", "field_of_view")]
    return 1e-3 * float(np.median(ranges)) * min((one for one in widths if one is not None), default=0.0)


def numbered_returns(shot: IntArray, pixel: IntArray) -> tuple[IntArray, IntArray]:
    """Return point numbers within each shot and pixel, which follow each other, and their count."""
    starts = np.flatnonzero(np.r_[True, (np.diff(shot) != 0) | (np.diff(pixel) != 0)][: shot.size])
    counts = np.diff(np.r_[starts, shot.size])
    return np.arange(shot.size) - np.repeat(starts, counts) + 1, np.repeat(counts, counts)
