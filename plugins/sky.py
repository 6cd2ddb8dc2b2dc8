"""Emitter plugin ``sky``: diffuse daylight."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.bottom import SKY
from mitransient_lidar.physics.lidar.clear_sky import clear_sky_irradiance
from mitransient_lidar.plugins.bases import DeclaredProperties, EmitterWithoutExtent, register
from mitransient_lidar.transport.daylight.scene import SKIES, direction_of, relative_irradiance


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


register("emitter", SKY, Sky)
