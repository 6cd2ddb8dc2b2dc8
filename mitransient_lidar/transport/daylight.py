"""What pictures by daylight need: sun, sky and the receiver's view of a scene, found and checked once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.optics.checks import finite, in_range
from mitransient_lidar.optics.daylight import LARGEST_SUN_ZENITH_DEG
from mitransient_lidar.transport.opaque import opaque_point
from mitransient_lidar.transport.pixels import PixelArray, parse_layout
from mitransient_lidar.transport.receiving import Receiver, View, solid_angle_factor
from mitransient_lidar.transport.streams import pass_streams, stratified_point
from mitransient_lidar.transport.system import (
    WaterScene,
    check_layers,
    find_receiver,
    find_water,
    largest_slope_variance,
)

#: Points along each axis of the field of view, at least, that measure the pixels' solid angles.
_LATTICE = 4096

#: Largest angle between the sun and where a clear sky was told that it is [deg].
_SAME_DIRECTION_DEG = 0.05

#: Rays that look for what lies beside the surface patch.
_RAYS = 2**14

#: Points along each axis that normalise a sky.
_SKY_POINTS = 1024


def read_direction(props: mi.Properties, prefix: str = "") -> tuple[float, NDArray[np.float64]]:
    """Read ``zenith_deg`` and ``azimuth_deg`` of the sun, and return the zenith angle [deg] and its unit direction.

    Raises
    ------
    ValueError
        When an angle is out of range.
    """
    name = f"{prefix}zenith_deg"
    zenith = in_range(name, props.get(name, 40.0), 0.0, LARGEST_SUN_ZENITH_DEG)
    azimuth = np.radians(finite(f"{prefix}azimuth_deg", props.get(f"{prefix}azimuth_deg", 0.0)))
    sin, cos = np.sin(np.radians(zenith)), np.cos(np.radians(zenith))
    return zenith, np.array([sin * np.cos(azimuth), sin * np.sin(azimuth), cos])


def uniform_sky(direction: mi.Vector3f, sun: mi.Vector3f) -> mi.Float:
    """Return the shape of an even sky."""
    return mi.Float(1)


def overcast_sky(direction: mi.Vector3f, sun: mi.Vector3f) -> mi.Float:
    """Return the shape of a thickly overcast sky: three times as bright at the zenith as at the horizon.

    Moon and Spencer 1942, Illuminating Engineering 37, 707; the cardioidal sky.
    """
    return 1 + 2 * direction.z


def clear_sky(direction: mi.Vector3f, sun: mi.Vector3f) -> mi.Float:
    """Return the shape of a clear sky, bright around the sun and at the horizon.

    Harrison and Coombes 1988, equations 3 to 5 (doi:10.1016/0038-092X(88)90072-2), without the factor that depends on
    the sun's zenith angle alone.
    """
    cosine = dr.dot(direction, sun)
    # The arc cosine loses what is next to the sun.
    angle = 2 * dr.safe_asin(0.5 * dr.norm(direction - sun))
    around = 1.63 + 53.7 * dr.exp(-5.49 * angle) + 2.04 * dr.square(cosine) * sun.z
    return around * (1 - dr.exp(-0.19 / dr.maximum(direction.z, 1e-6)))


#: Shapes of skies by their names.
SKIES: dict[str, Callable[[mi.Vector3f, mi.Vector3f], mi.Float]] = {
    "clear": clear_sky,
    "overcast": overcast_sky,
    "uniform": uniform_sky,
}


def shape_irradiance(name: str, sun: NDArray[np.float64]) -> float:
    """Return the irradiance on a level plane of a sky as its shape gives it, by the midpoint rule."""
    index = dr.arange(mi.UInt32, _SKY_POINTS**2)
    cosine2 = (mi.Float(index % _SKY_POINTS) + 0.5) / _SKY_POINTS
    sin, cos = dr.sincos(dr.two_pi * (mi.Float(index // _SKY_POINTS) + 0.5) / _SKY_POINTS)
    level = dr.sqrt(1 - cosine2)
    direction = mi.Vector3f(level * cos, level * sin, dr.sqrt(cosine2))
    shape = SKIES[name](direction, mi.Vector3f(sun.tolist()))
    return float(np.pi * np.mean(np.array(shape, dtype=np.float64)))


@dataclass(frozen=True)
class DaylightScene(WaterScene):
    """A scene that sun and sky light.

    Attributes
    ----------
    sun, sky
        The ``sun`` and the ``sky`` plugins, None where there is none; at least one is there.
    """

    sun: mi.Emitter | None
    sky: mi.Emitter | None

    @classmethod
    def from_scene(cls, scene: mi.Scene, sensor: mi.Sensor) -> DaylightScene:
        """Find the parts in a loaded scene; a ``lidar_transmitter`` may be there and is left out.

        Raises
        ------
        ValueError
            When a part is missing, of a foreign kind, or there is more than one where one is allowed.
        """
        receiver = find_receiver(sensor)
        found: dict[str, mi.Emitter] = {}
        for emitter in scene.emitters():
            kind = getattr(emitter, "daylight", None)
            if kind is None and not hasattr(emitter, "pulse_energy"):
                raise ValueError("emitters: passive imaging knows sun, sky and lidar_transmitter; there is another one")
            if kind in found:
                raise ValueError(f"emitters: the scene has more than one {kind}; allowed is one")
            if kind is not None:
                found[kind] = emitter
        if not found:
            raise ValueError("emitters: passive imaging needs a sun or a sky, and the scene has neither")
        sun, sky = found.get("sun"), found.get("sky")
        if sun is not None and sky is not None and sky.distribution == "clear":
            _check_sun(sun, sky)
        water, surfaces = find_water(scene)
        if receiver.pose.origin[2] <= 0:
            raise ValueError("altitude: the receiver must be above the mean sea level z = 0")
        if water is not None:
            check_layers(scene, surfaces, water)
        return cls(scene, receiver, water, surfaces, largest_slope_variance(surfaces), sun, sky)

    def sky_radiance(self, direction: mi.Vector3f) -> mi.Float:
        """Return the radiance of the sky in a direction [W m^-2 sr^-1 nm^-1]; 0 below the horizon."""
        return mi.Float(0) if self.sky is None else self.sky.radiance(direction)

    def sun_directions(self, u: mi.Point2f) -> mi.Vector3f:
        """Map uniform numbers to directions of the sun's disc; without a sun to the zenith."""
        return mi.Vector3f(0, 0, 1) if self.sun is None else self.sun.sample(u)


def _check_sun(sun: mi.Emitter, sky: mi.Emitter) -> None:
    """Refuse a clear sky that is bright around another place than where the sun is."""
    apart = float(np.degrees(2 * np.arcsin(0.5 * np.linalg.norm(sun.direction - sky.sun))))
    if apart > _SAME_DIRECTION_DEG:
        raise ValueError(
            f"sun_zenith_deg and sun_azimuth_deg of the clear sky put the sun {apart:.3g} degrees from where it is: "
            "they must be the sun's own zenith_deg and azimuth_deg"
        )


class FieldSampler:
    """Samples the receiver's field of view evenly, whatever a laser would light of it.

    Samples are stratified. Where the optics blur, the place on the detector is drawn first, and the direction that it
    gets light from then.

    Parameters
    ----------
    receiver
        Pose, aperture and pixels.
    """

    def __init__(self, receiver: Receiver) -> None:
        self.receiver = receiver

    def sample(self, index: mi.UInt32, count: int, rng: mi.PCG32) -> View:
        """Sample one view for each path; its weight is the solid angle for which it stands [sr].

        Parameters
        ----------
        index
            Number of the path, 0 to count - 1.
        count
            Number of paths.
        rng
            Random numbers of the paths.
        """
        pixels = self.receiver.pixels
        px, py = pixels.sample(stratified_point(index, count, rng))
        gx, gy = px, py
        if self.receiver.blur is not None:
            dx, dy = self.receiver.blur.sample(mi.Point2f(rng.next_float32(), rng.next_float32()))
            gx, gy = px - dx, py - dy
        pixel, here = pixels.pixel_at(px, py, rng.next_float32())
        weight = pixels.area / count * solid_angle_factor(px, py)
        return View(self.receiver.pose.direction(gx, gy), pixel, dr.select(here > 0, weight, 0))


def pixel_solid_angles(pixels: PixelArray) -> NDArray[np.float64]:
    """Return the solid angle of each pixel [sr], shape (pixels,), counted on a fine lattice of the field of view.

    Whole cells of a layout are exact, other pixels within about a thousandth of the width of the lattice's cells over
    their own.
    """
    # A whole number of points in every cell of a layout.
    cells = parse_layout(pixels.layout) if pixels.layout[0].isdigit() else (1, 1)
    rows, columns = (cell * -(-_LATTICE // cell) for cell in cells)
    index = dr.arange(mi.UInt32, rows * columns)
    full = pixels.field_of_view
    gx = full * (0.5 - (mi.Float(index // columns) + 0.5) / rows)
    gy = full * ((mi.Float(index % columns) + 0.5) / columns - 0.5)
    u = mi.Float(index * mi.UInt32(2654435769) >> 8) * 2**-24
    pixel, here = pixels.pixel_at(gx, gy, u)
    found = dr.zeros(mi.Float64, pixels.count)
    # Of pixels that overlap one is told for all.
    dr.scatter_add(found, mi.Float64(here * solid_angle_factor(gx, gy)), pixel, here > 0)
    return np.array(found) * full**2 / (rows * columns)


def share_beside_surface(system: DaylightScene, view: FieldSampler) -> float:
    """Return the share of the field of view that looks down beside the surface patch, where nothing is known."""
    if not system.surfaces:
        return 0.0
    seen = view.sample(dr.arange(mi.UInt32, _RAYS), _RAYS, pass_streams(0, 0, _RAYS))
    ray = mi.Ray3f(opaque_point(system.receiver.pose.origin), seen.direction)
    si = system.scene.ray_intersect(ray, seen.weight > 0)
    beside = ~si.is_valid() & (seen.direction.z < 0)
    beside |= si.is_valid() & system.beside_surface(si.p.z, mi.Bool(False))
    weight = np.array(seen.weight, dtype=np.float64)
    return float(weight[np.array(beside)].sum() / max(weight.sum(), 1e-300))
