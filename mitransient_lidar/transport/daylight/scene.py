"""A scene lit by sun and sky: its parts, skies' radiance distributions, and sun directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.transport.plugin_types import Daylight, SkyEmitter, SunEmitter, Transmitter
from mitransient_lidar.transport.scene import WaterScene
from mitransient_lidar.transport.scene_parts import find_receiver, find_solids, fit_seas

_SAME_DIRECTION_DEG = 0.05  #: Largest angle between the sun and the sun of a clear sky [deg].


@dataclass(frozen=True)
class DaylightScene(WaterScene):
    """A scene lit by sun and sky."""

    #: The ``sun`` and the ``sky`` plugins, None where there is none; at least one is present.
    sun: SunEmitter | None
    sky: SkyEmitter | None

    @classmethod
    def from_scene(cls, scene: mi.Scene, sensor: mi.Sensor) -> DaylightScene:
        """Find the parts in a loaded scene. A ``lidar_transmitter`` may be present and is ignored.

        Raises UserError when a part is missing, not supported, or there are several where one is allowed.
        """
        fit_seas(scene)
        receiver = find_receiver(sensor)
        found: dict[str, mi.Emitter] = {}
        for emitter in scene.emitters():
            if isinstance(emitter, Daylight):
                if emitter.daylight in found:
                    raise UserError(f"emitters: the scene has more than one {emitter.daylight}; allowed is one")
                found[emitter.daylight] = emitter
            elif not isinstance(emitter, Transmitter):
                raise UserError("emitters: passive imaging allows sun, sky and lidar_transmitter; there is another one")
        if not found:
            raise UserError("emitters: passive imaging needs a sun or a sky, and the scene has neither")
        sun, sky = found.get("sun"), found.get("sky")
        if sun is not None and sky is not None and sky.distribution == "clear":
            _check_sun(sun, sky)
        if receiver.pose.origin[2] <= 0:
            raise UserError("altitude: the receiver must be above the mean sea level z = 0")
        return cls(**vars(find_solids(scene, receiver)), sun=sun, sky=sky)

    def sky_radiance(self, direction: mi.Vector3f) -> mi.Float:
        """Return the radiance of the sky in a direction [W m^-2 sr^-1 nm^-1]; 0 below the horizon."""
        return mi.Float(0) if self.sky is None else self.sky.radiance(direction)

    def sun_directions(self, u: mi.Point2f) -> mi.Vector3f:
        """Map uniform numbers to directions of the sun's disc, or to the zenith without a sun."""
        return mi.Vector3f(0, 0, 1) if self.sun is None else self.sun.sample(u)


def _check_sun(sun: SunEmitter, sky: SkyEmitter) -> None:
    """Refuse a clear sky with another direction of the sun."""
    apart = float(np.degrees(2 * np.arcsin(0.5 * np.linalg.norm(sun.direction - sky.sun))))
    if apart > _SAME_DIRECTION_DEG:
        raise UserError(
            f"sun_zenith_deg and sun_azimuth_deg of the clear sky put the sun {apart:.3g} degrees from where it is: "
            "they must be the sun's own zenith_deg and azimuth_deg"
        )


_QUADRATURE_POINTS = 1024  #: Points along each axis of the quadrature that normalises a sky.


def direction_of(zenith_deg: float, azimuth_deg: float) -> NDArray[np.float64]:
    """Return the unit direction of a zenith angle and an azimuth from +x towards +y [deg]."""
    zenith, azimuth = np.radians((zenith_deg, azimuth_deg))
    return np.array([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])


def uniform_distribution(direction: mi.Vector3f, sun: mi.Vector3f) -> mi.Float:
    """Return a uniform sky's relative radiance."""
    return mi.Float(1)


def overcast_distribution(direction: mi.Vector3f, sun: mi.Vector3f) -> mi.Float:
    """Return the relative radiance of an overcast sky: three times as bright at the zenith as at the horizon.

    Cardioidal sky of Moon and Spencer 1942, Illuminating Engineering 37, 707.
    """
    return 1 + 2 * direction.z


def clear_distribution(direction: mi.Vector3f, sun: mi.Vector3f) -> mi.Float:
    """Return the relative radiance of a clear sky, bright around the sun and at the horizon.

    Harrison and Coombes 1988, equations 3 to 5 (doi:10.1016/0038-092X(88)90072-2), without the factor that depends on
    the sun's zenith angle alone.
    """
    cosine = dr.dot(direction, sun)
    # The arc cosine is inaccurate next to the sun.
    angle = 2 * dr.safe_asin(0.5 * dr.norm(direction - sun))
    around = 1.63 + 53.7 * dr.exp(-5.49 * angle) + 2.04 * dr.square(cosine) * sun.z
    return around * (1 - dr.exp(-0.19 / dr.maximum(direction.z, 1e-6)))


#: Relative radiance by distribution name.
SKIES: dict[str, Callable[[mi.Vector3f, mi.Vector3f], mi.Float]] = {
    "clear": clear_distribution,
    "overcast": overcast_distribution,
    "uniform": uniform_distribution,
}


def relative_irradiance(name: str, sun: NDArray[np.float64]) -> float:
    """Return the irradiance on a level plane by a relative radiance distribution, with the midpoint rule."""
    n = _QUADRATURE_POINTS
    index = dr.arange(mi.UInt32, n**2)
    cosine2 = (mi.Float(index % n) + 0.5) / n
    sin, cos = dr.sincos(dr.two_pi * (mi.Float(index // n) + 0.5) / n)
    level = dr.sqrt(1 - cosine2)
    direction = mi.Vector3f(level * cos, level * sin, dr.sqrt(cosine2))
    radiance = SKIES[name](direction, mi.Vector3f(sun.tolist()))
    return float(np.pi * np.mean(np.array(radiance, dtype=np.float64)))
