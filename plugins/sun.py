"""Emitter plugin ``sun``: the sun's disc."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.parameters.bottom import SUN
from mitransient_lidar.physics.lidar.clear_sky import clear_sky_irradiance
from mitransient_lidar.plugins.bases import DeclaredProperties, EmitterWithoutExtent, register
from mitransient_lidar.transport.daylight.scene import direction_of
from mitransient_lidar.transport.medium.tabulated_phase import deflect, half_angle


class Sun(EmitterWithoutExtent):
    r"""Sun (``sun``).

    .. parameters::

    A disc at infinity of the uniform radiance :math:`E / (\pi \sin^2 r)`. ``passive_volpath`` draws one point of it for
    each path; the lidar integrators leave it out. Mitsuba's own integrators sample the disc, and do not meet it by
    chance.

    .. example::

        {'type': 'sun', 'zenith_deg': 40.0, 'azimuth_deg': 120.0}
    """

    #: Daylight kind, by which integrators identify it.
    daylight = "sun"

    def __init__(self, props: DeclaredProperties) -> None:
        super().__init__(props)
        self.zenith_deg = props.read("zenith_deg")
        self.direction = direction_of(self.zenith_deg, props.read("azimuth_deg"))
        wavelength = props.read("wavelength_nm")
        clear = None if "irradiance" in props else clear_sky_irradiance(self.zenith_deg, wavelength_nm=wavelength)
        self.irradiance = props.read("irradiance", clear and clear.direct_normal)
        radius = props.read("angular_radius_deg")
        # sin^2 of half the radius, as the cosine of so small an angle is 1 to rounding.
        self._edge = float(np.sin(0.5 * np.radians(radius)) ** 2)
        self._radiance = self.irradiance / (np.pi * np.sin(np.radians(radius)) ** 2)
        #: Irradiance that each direction of `sample` represents [W m^-2 nm^-1].
        self.sampled_irradiance = float(self._radiance * 4 * np.pi * self._edge)
        self.m_needs_sample_2 = True
        self.m_flags = mi.EmitterFlags.Infinite.value | mi.EmitterFlags.DeltaDirection.value

    def radiance(self, direction: mi.Vector3f) -> mi.Float:
        """Return the radiance in a unit direction [W m^-2 sr^-1 nm^-1]: even within the disc, 0 outside."""
        inside = half_angle(direction, mi.Vector3f(self.direction.tolist())) <= self._edge
        return dr.select(inside, mi.Float(self._radiance), 0)

    def sample(self, u: mi.Point2f) -> mi.Vector3f:
        """Map uniform numbers to directions uniform in the disc's solid angle."""
        frame = mi.Frame3f(mi.Vector3f(self.direction.tolist()))
        return dr.normalize(deflect(frame, u.x * self._edge, dr.two_pi * u.y))

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Draw a direction of the disc; the weight is the irradiance normal to it [W m^-2 nm^-1]."""
        ds = self.distant_sample(it, self.sample(sample))
        ds.delta, ds.pdf = True, 1.0
        return ds, self.eval_direction(it, ds, active)

    def eval_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Spectrum:
        """Return the irradiance that a direction of the disc represents [W m^-2 nm^-1]."""
        return mi.Spectrum(self.sampled_irradiance) & active


register("emitter", SUN, Sun)
