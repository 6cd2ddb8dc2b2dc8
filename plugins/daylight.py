"""Emitter plugins ``sun`` and ``sky``: daylight."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.bottom import SKY, SUN
from mitransient_lidar.physics.lidar.clear_sky import clear_sky_irradiance
from mitransient_lidar.plugins.bases import DeclaredProperties, EmitterWithoutExtent, register
from mitransient_lidar.transport.daylight.scene import SKIES, direction_of, relative_irradiance
from mitransient_lidar.transport.medium.tabulated_phase import deflect, half_angle


@register("emitter", SUN)
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


@register("emitter", SKY)
class Sky(EmitterWithoutExtent):
    r"""Sky (``sky``).

    .. parameters::

    The upper half of an infinite sphere; the lower half is black. The radiance distribution (for ``clear`` by Harrison
    and Coombes 1988, doi:10.1016/0038-092X(88)90072-2) is scaled to the irradiance. The sun itself is the plugin
    ``sun``, whose angles a clear sky must share. The lidar integrators leave the sky out.

    .. example::

        {'type': 'sky', 'distribution': 'clear', 'sun_zenith_deg': 40.0}
    """

    #: Daylight kind, by which integrators identify it.
    daylight = "sky"

    def __init__(self, props: DeclaredProperties) -> None:
        super().__init__(props)
        self.distribution = props.read("distribution")
        for name in ("sun_zenith_deg", "sun_azimuth_deg"):
            if name in props and self.distribution != "clear":
                raise UserError(f"{name} = {props[name]:g} is for distribution = 'clear': leave it out")
        zenith = props.read("sun_zenith_deg")
        self.sun = direction_of(zenith, props.read("sun_azimuth_deg"))
        if "irradiance" not in props and self.distribution != "clear":
            raise UserError(f"irradiance is missing: a sky of distribution = {self.distribution!r} needs it")
        wavelength = props.read("wavelength_nm")
        clear = None if "irradiance" in props else clear_sky_irradiance(zenith, wavelength_nm=wavelength)
        self.irradiance = props.read("irradiance", clear and clear.diffuse)
        self._scale = self.irradiance / relative_irradiance(self.distribution, self.sun)
        self.m_needs_sample_2 = True
        self.m_flags = mi.EmitterFlags.Infinite.value

    def radiance(self, direction: mi.Vector3f) -> mi.Float:
        """Return the radiance in a unit direction [W m^-2 sr^-1 nm^-1]; 0 below the horizon."""
        shape = SKIES[self.distribution](direction, mi.Vector3f(self.sun.tolist()))
        return dr.select(direction.z > 0, self._scale * shape, 0)

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Draw a direction in proportion to its cosine from the vertical; the weight is radiance over density."""
        ds = self.distant_sample(it, mi.warp.square_to_cosine_hemisphere(sample))
        ds.pdf = mi.warp.square_to_cosine_hemisphere_pdf(ds.d)
        weight = dr.select(ds.pdf > 0, self.radiance(ds.d) / ds.pdf, 0)
        return ds, mi.Spectrum(weight) & active

    def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Float:
        """Return the density [1/sr] with which a direction is drawn."""
        return dr.select(ds.d.z > 0, mi.warp.square_to_cosine_hemisphere_pdf(ds.d), 0)

    def eval_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Spectrum:
        """Return the radiance in a direction [W m^-2 sr^-1 nm^-1]."""
        return mi.Spectrum(self.radiance(ds.d)) & active

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        """Return the radiance on a ray that leaves the scene [W m^-2 sr^-1 nm^-1]."""
        return mi.Spectrum(self.radiance(-si.wi)) & active
