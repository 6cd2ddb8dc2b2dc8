"""Emitter plugins: a pulsed laser beam (``lidar_transmitter``), and daylight (``sun`` and ``sky``)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.bottom import SKY, SUN
from mitransient_lidar.core.parameters.lidar import LIDAR_TRANSMITTER
from mitransient_lidar.physics.lidar.clear_sky import clear_sky_irradiance
from mitransient_lidar.physics.lidar.level_sea import WIDTHS, read_divergence
from mitransient_lidar.physics.lidar.pulse import Pulse
from mitransient_lidar.plugins.bases import DeclaredProperties, EmitterWithoutExtent, read_pose, register
from mitransient_lidar.transport.daylight.renderer import SKIES, direction_of, relative_irradiance
from mitransient_lidar.transport.laser import BeamProfile, GaussianBeam, ImageBeam, TopHatBeam
from mitransient_lidar.transport.medium.tabulated_phase import deflect, half_angle
from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.sensor.image_sampling import read_image


@register("emitter", LIDAR_TRANSMITTER)
class LidarTransmitter(EmitterWithoutExtent):
    r"""Pulsed laser transmitter (``lidar_transmitter``).

    .. parameters::

    The beam leaves one point. Its energy per tangent-plane area is a Gaussian

    .. math:: g(g_x, g_y) = \exp(-(g_x^2 + g_y^2) / 2\sigma^2) / (2 \pi \sigma^2)

    (+angle_x is away from nadir, +angle_y to the left, along +y), with a sigma for each axis when it is elliptic. An
    image beam is even within each cell. The radiant intensity follows from :math:`d\Omega = (1 + g_x^2 +
    g_y^2)^{-3/2}\, dg_x\, dg_y`. The pulse's shape is applied to waveforms, not in the transport.

    Laser and receiver are both above the sea or both under water. Under water, angles are angles in the water: behind a
    flat window, the angles in air divided by the refractive index. Radiance is radiance in the water, and the
    efficiencies contain the window's losses; ``two_way_atmospheric_transmittance`` is a further factor, to be set to 1.
    Water around such a lidar has one refractive and one group index. Light that reaches the surface from below is
    reflected and refracted, and returns from targets in the air.

    From orbit, lengths are relative to the distance from a point near the scene, and rays start just above it. Times
    are then accurate to a millimetre of range in single precision.

    .. example::

        {'type': 'lidar_transmitter', 'altitude': 200.0, 'off_nadir_deg': 20.0, 'divergence_mrad': 10.0}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        super().__init__(props)
        read = props.read
        self.pose = read_pose(props)
        self.pulse_energy = 1e-3 * read("pulse_energy_mj")
        self.optical_efficiency, self.wavelength_nm = read("optical_efficiency"), read("wavelength_nm")
        #: Energy that leaves the optics [J].
        self.energy = self.pulse_energy * self.optical_efficiency
        self.beam_profile = read("beam_profile")
        self.profile = _profile(props, self.beam_profile)
        #: Full beam angle [rad] as in ``divergence_mrad``; for an image twice its widest rms angle.
        self.divergence = self.profile.divergence[0]
        #: Root-mean-square angles of the beam [rad]: the narrowest, which cells must resolve, and the widest.
        self.angular_spread, self.widest_angular_spread = min(self.profile.spreads), max(self.profile.spreads)
        if "pulse_file" in props:
            self.pulse = Pulse.from_file(props["pulse_file"])
        else:
            self.pulse = Pulse.gaussian(read("pulse_fwhm_ns"))
        self.m_needs_sample_2 = False
        self.m_flags = mi.EmitterFlags.DeltaPosition.value

    def intensity(self, direction: mi.Vector3f) -> mi.Float:
        """Return the radiant intensity [J/sr] in a unit direction of the world."""
        return self.intensity_at(*self.pose.tangent(direction))

    def intensity_at(self, angle_x: mi.Float, angle_y: mi.Float, cos_axis: mi.Float) -> mi.Float:
        """Return the radiant intensity [J/sr] at a tangent-plane point whose direction has a cosine with the axis."""
        # d(omega) = cos^3 d(angle_x) d(angle_y).
        density = self.tangent_density(angle_x, angle_y) / (cos_axis * cos_axis * cos_axis)
        return dr.select(cos_axis > 0, opaque(self.energy) * density, 0)

    def tangent_density(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Float:
        """Return the share of the energy per tangent-plane area [1/rad^2]."""
        return self.profile.density(angle_x, angle_y)

    def sample_tangent(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers in the unit square to tangent-plane points distributed as the beam's energy."""
        return self.profile.sample(u)

    def sample_ray(
        self, time: mi.Float, sample1: mi.Float, sample2: mi.Point2f, sample3: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Sample a ray of the beam; its weight is the emitted energy [J]."""
        ray = mi.Ray3f(mi.Point3f(self.pose.origin.tolist()), self.pose.direction(*self.sample_tangent(sample3)))
        ray.time = time
        return ray, mi.Spectrum(self.energy) & active

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Connect a point to the laser; the weight is the energy per area normal to the connection [J/m^2]."""
        ds = dr.zeros(mi.DirectionSample3f)
        ds.p = mi.Point3f(self.pose.origin.tolist())
        ds.n = mi.Normal3f(self.pose.axis.tolist())
        ds.time = it.time
        ds.delta = True
        ds.pdf = 1.0
        ds.emitter = mi.EmitterPtr(self)
        offset = ds.p - it.p
        ds.dist = dr.norm(offset)
        ds.d = offset / ds.dist
        return ds, self.eval_direction(it, ds, active)

    def eval_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Spectrum:
        """Return the energy per area normal to the connection [J/m^2]."""
        return mi.Spectrum(self.intensity(-ds.d) / (ds.dist * ds.dist)) & active


def _profile(props: DeclaredProperties, kind: str) -> BeamProfile:
    """Return the beam profile that the parameters describe."""
    read = props.read
    image_names = ("profile_file", "profile_mrad")
    for name in (*WIDTHS, "divergence_across_mrad", "ellipse_deg") if kind == "image" else image_names:
        if name in props:
            raise UserError(f"{name} does not go with beam_profile = {kind!r}")
    if kind == "image":
        for name in image_names:
            if name not in props:
                raise UserError(f"{name} is missing: beam_profile = 'image' needs it")
        image = read_image("profile_file", props["profile_file"])
        return ImageBeam(image, 1e-3 * read("profile_mrad"))
    divergence = read_divergence(read, kind == "top_hat") or 1e-3 * read("divergence_mrad")
    along = across = 0.5 * divergence
    if "divergence_across_mrad" in props:
        if any(name != "divergence_mrad" for name in read.given(*WIDTHS)):
            raise UserError("divergence_across_mrad goes with divergence_mrad, not with another definition of width")
        across = 0.5e-3 * read("divergence_across_mrad")
    elif "ellipse_deg" in props:
        raise UserError("ellipse_deg needs divergence_across_mrad: a circular beam cannot be turned")
    rotation = float(np.deg2rad(read("ellipse_deg")))
    return (TopHatBeam if kind == "top_hat" else GaussianBeam)(along, across, rotation)


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
