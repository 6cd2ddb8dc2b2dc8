"""Emitter plugin ``lidar_transmitter``: a pulsed laser beam."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.optics.checks import in_range, positive
from mitransient_lidar.optics.pulse import Pulse
from mitransient_lidar.transport.fields import Sector
from mitransient_lidar.transport.pose import Pose


class LidarTransmitter(mi.Emitter):
    r"""Pulsed laser transmitter (``lidar_transmitter``).

    ======================  =========  ==============================================================================
    Parameter               Type       Meaning
    ======================  =========  ==============================================================================
    altitude                float      Height above the mean sea level [m], positive. Default: 200
    off_nadir_deg           float      Angle of the axis from the vertical, towards +x [deg], 0 to 89.9. Default: 20
    shot_x, shot_y          float      Where the axis meets the mean sea level [m]. Default: 0
    to_world                transform  Instead of the four above: any position and direction, as from ``lookat``
    pulse_energy_mj         float      Energy of the emitted pulse [mJ], positive. Default: 5
    optical_efficiency      float      Share of that energy which leaves the optics, above 0 to 1. Default: 0.9
    beam_profile            string     ``gaussian`` or ``top_hat``. Default: ``gaussian``
    divergence_mrad         float      Full angle [mrad] between the points where the irradiance of a Gaussian beam has
                                       fallen to e^-1/2 of its peak (its sigma is half of it); the full angle of a
                                       top-hat beam. Positive. Default: 10
    divergence_fwhm_mrad,   float      The same beam by its full width at half maximum, or at e^-2 of the peak
    divergence_1e2_mrad                (Gaussian only); give one of the three
    wavelength_nm           float      Vacuum wavelength [nm], 300 to 1100; kept with the result. Default: 532
    pulse_fwhm_ns           float      Full width at half maximum of a Gaussian pulse [ns], positive. Default: 5
    pulse_file              string     Instead: text file with two columns, time [ns] and power (any unit)
    ======================  =========  ==============================================================================

    The beam leaves one point. Its energy per tangent-plane area is a Gaussian

    .. math:: g(g_x, g_y) = \exp(-(g_x^2 + g_y^2) / 2\sigma^2) / (2 \pi \sigma^2)

    and the radiant intensity follows from :math:`d\Omega = (1 + g_x^2 + g_y^2)^{-3/2}\, dg_x\, dg_y`, so that the
    beam's energy is exactly the pulse's. The pulse's shape enters when waveforms are formed, not in the transport.

    .. code-block:: xml

        <emitter type="lidar_transmitter">
            <float name="altitude" value="200"/>
            <float name="off_nadir_deg" value="20"/>
            <float name="divergence_mrad" value="10"/>
        </emitter>

    .. code-block:: python

        {'type': 'lidar_transmitter', 'altitude': 200.0, 'off_nadir_deg': 20.0, 'divergence_mrad': 10.0}
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.pose = Pose.from_properties(props)
        self.pulse_energy = 1e-3 * positive("pulse_energy_mj", props.get("pulse_energy_mj", 5.0))
        self.optical_efficiency = in_range("optical_efficiency", props.get("optical_efficiency", 0.9), 1e-12, 1.0)
        self.wavelength_nm = in_range("wavelength_nm", props.get("wavelength_nm", 532.0), 300.0, 1100.0)
        self.beam_profile = props.get("beam_profile", "gaussian")
        if self.beam_profile not in ("gaussian", "top_hat"):
            raise ValueError(f"beam_profile = {self.beam_profile!r} must be 'gaussian' or 'top_hat'")
        self.divergence = _divergence(props, self.beam_profile)
        if "pulse_file" in props:
            try:
                self.pulse = Pulse.from_file(props["pulse_file"])
            except OSError as error:
                raise ValueError(f"pulse_file = {props['pulse_file']!r} cannot be read: {error.strerror}") from error
        else:
            self.pulse = Pulse.gaussian(positive("pulse_fwhm_ns", props.get("pulse_fwhm_ns", 5.0)))
        self.m_needs_sample_2 = False
        self.m_flags = mi.EmitterFlags.DeltaPosition.value

    @property
    def energy(self) -> float:
        """Energy that leaves the optics [J]."""
        return self.pulse_energy * self.optical_efficiency

    @property
    def angular_spread(self) -> float:
        """Root-mean-square angle of the beam along each transverse axis [rad]."""
        half = 0.5 * self.divergence
        return half if self.beam_profile == "gaussian" else half / 2

    def intensity(self, direction: mi.Vector3f) -> mi.Float:
        """Return the radiant intensity [J/sr] in a unit direction of the world."""
        gx, gy, cos_axis = self.pose.tangent(direction)
        # d(omega) = cos^3 dg: the tangent-plane density is divided by that.
        density = self.tangent_density(gx, gy) / (cos_axis * cos_axis * cos_axis)
        return dr.select(cos_axis > 0, self.energy * density, 0)

    def tangent_density(self, gx: mi.Float, gy: mi.Float) -> mi.Float:
        """Return the share of the energy per tangent-plane area [1/rad^2]."""
        half = 0.5 * self.divergence
        if self.beam_profile == "top_hat":
            return dr.select(gx * gx + gy * gy <= half**2, mi.Float(1 / (np.pi * half**2)), 0)
        return dr.exp(-(gx * gx + gy * gy) / (2 * half**2)) / (2 * np.pi * half**2)

    def sample_tangent(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers in the unit square to tangent-plane points distributed as the beam's energy."""
        half = 0.5 * self.divergence
        if self.beam_profile == "top_hat":
            return Sector(outer=half).sample(u)
        # 1 - u lies in (0, 1], so that the logarithm is finite.
        radius = half * dr.sqrt(-2 * dr.log(1 - u.x))
        sin, cos = dr.sincos(dr.two_pi * u.y)
        return radius * cos, radius * sin

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
        return ds, mi.Spectrum(self.intensity(-ds.d) / (ds.dist * ds.dist)) & active

    def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Float:
        """Return 0: a point cannot be hit by chance."""
        return mi.Float(0)

    def eval_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Spectrum:
        """Return the energy per area normal to the connection [J/m^2]."""
        return mi.Spectrum(self.intensity(-ds.d) / (ds.dist * ds.dist)) & active

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        """Return 0: the laser has no surface."""
        return mi.Spectrum(0)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """Return the laser's position as a bounding box, which keeps it out of the scene's extent."""
        return mi.ScalarBoundingBox3f()

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose no parameters: a changed transmitter is loaded anew."""

    def to_string(self) -> str:
        """Return a description."""
        return (
            f"LidarTransmitter[origin={self.pose.origin.tolist()}, energy={self.energy:g} J, "
            f"{self.beam_profile} {1e3 * self.divergence:g} mrad]"
        )


def _divergence(props: mi.Properties, profile: str) -> float:
    """Return the beam's divergence [rad] as the project defines it, from whichever definition was given."""
    # Ratio of each definition's full width to the e^-1/2 full width (2 sigma) of a Gaussian.
    widths = {
        "divergence_mrad": 1.0,
        "divergence_fwhm_mrad": np.sqrt(2 * np.log(2)),
        "divergence_1e2_mrad": 2.0,
    }
    given = [name for name in widths if name in props]
    if len(given) > 1:
        raise ValueError(f"lidar_transmitter: give one of {' and '.join(given)}, not both")
    name = given[0] if given else "divergence_mrad"
    if profile == "top_hat" and name != "divergence_mrad":
        raise ValueError(f"{name} describes a Gaussian beam; a top-hat beam takes divergence_mrad, its full angle")
    value = positive(name, props.get(name, 10.0))
    return 1e-3 * in_range(name, value, 0.0, 1000.0) / float(widths[name])


mi.register_emitter("lidar_transmitter", lambda props: LidarTransmitter(props))
