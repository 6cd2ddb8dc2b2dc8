"""BSDF plugin ``sediment``: a bottom by reflectance or name, Lambertian or with an opposition effect."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.bottom import SEDIMENT
from mitransient_lidar.physics.water.sediments import HapkeSurface, bottom_reflectance
from mitransient_lidar.plugins.bases import DeclaredProperties, SampledBSDF, register
from mitransient_lidar.transport.medium.nested_objects import create_object
from mitransient_lidar.transport.opaque import opaque

#: Particle parameters.
_PARTICLES = ("lobe_asymmetry", "backward_share", "opposition_amplitude", "opposition_width")


class Sediment(SampledBSDF):
    r"""Bottom by reflectance or name (``sediment``).

    .. parameters::

    With ``lambertian`` it reflects as Mitsuba's ``diffuse``. With ``hapke`` it reflects, at the angle *g* between the
    directions to source and receiver,

    .. math:: f = \frac{w}{4\pi (\mu_i + \mu_o)} \left[ (1 + B(g))\, p(g) + H(\mu_i) H(\mu_o) - 1 \right], \quad
              B(g) = \frac{B_0}{1 + \tan(g/2)/h},

    .. math:: p(g) = \frac{s\,(1-b^2)}{(1 - 2b\cos g + b^2)^{3/2}} + \frac{(1-s)(1-b^2)}{(1 + 2b\cos g + b^2)^{3/2}},

    where :math:`\mu` are cosines with the normal, *w* the particle albedo, and *H* Hapke's approximation of
    Chandrasekhar's function (Hapke 2002, doi:10.1006/icar.2002.6853). The opposition effect by shadows follows Hapke
    1986, doi:10.1016/0019-1035(86)90108-9. The albedo *w* is chosen to give the ``reflectance``. A lidar sees the peak
    at *g* = 0 by its own light. A level bottom's echo is :math:`\pi f / R` times the echo of a Lambertian bottom with
    the reflectance *R*. This is 1.29 at vertical incidence with the defaults and *R* = 0.1. Roughness, porosity and
    coherent backscattering are left out.

    The defaults for the opposition effect are the example in figure 8.15 of Hapke's book (1993), which DISORT uses. No
    published values for particles under water were found: give measured ones. Submerged carbonate sands lit vertically
    were nearly Lambertian, and at oblique incidence brightest towards the source (Zhang et al. 2003,
    doi:10.4319/lo.2003.48.1_part_2.0380). `physics.water.sediments` lists the reflectances by name; mud is not among
    them.

    It reflects on the side of its normal only; ``twosided`` makes it reflect on both.

    .. example::

        {'type': 'sediment', 'model': 'hapke', 'reflectance': 'coral_sand'}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        super().__init__(props, mi.BSDFFlags.DiffuseReflection.value | mi.BSDFFlags.FrontSide.value)
        particles = _particles(props)
        if "single_scattering_albedo" in props:
            albedo = props.read("single_scattering_albedo")
            #: Reflection (`physics.water.sediments.HapkeSurface`).
            self.surface = particles.of_albedo("single_scattering_albedo", albedo)
        else:
            self.surface = particles.of_reflectance("reflectance", _reflectance(props))
        self._albedo, self._r0 = opaque(self.surface.albedo), opaque(self.surface.diffusive_reflectance)
        self._asymmetry, self._backward, self._amplitude, self._width = (
            opaque(getattr(self.surface, name)) for name in _PARTICLES
        )

    @property
    def used_values(self) -> dict[str, float]:
        """Single-scattering albedo of the particles, and reflectance at vertical incidence."""
        return {"single_scattering_albedo": self.surface.albedo, "reflectance": self.surface.reflectance()}

    def draw(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, sample1: mi.Float, sample2: mi.Point2f
    ) -> tuple[mi.Vector3f, mi.UInt32]:
        """Draw directions in proportion to their cosines."""
        return mi.warp.square_to_cosine_hemisphere(sample2), mi.UInt32(0)

    def eval_pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Color1f, mi.Float]:
        """Return BSDF times cosine, and density [1/sr]."""
        cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        active = active & (cos_i > 0) & (cos_o > 0) & ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0)
        # sin^2(g/2), from the difference between the directions: the cosine of a small angle is 1 to rounding.
        s = dr.minimum(0.25 * dr.squared_norm(wo - si.wi), 1)
        b, width = self._asymmetry, self._width
        # tan(g/2) = sin / cos, without a quotient that is infinite.
        sine, cosine = dr.sqrt(s), dr.sqrt(1 - s)
        surge = self._amplitude * width * cosine / (width * cosine + sine)
        backward, forward = ((1 - b * b) * dr.rsqrt((1 - b) ** 2 + 4 * b * part) ** 3 for part in (s, 1 - s))
        once = (1 + surge) * dr.fma(self._backward, backward - forward, forward)
        often = self._h_function(cos_i) * self._h_function(cos_o) - 1
        value = self._albedo * dr.inv_four_pi * (once + often) * cos_o / (cos_i + cos_o)
        return mi.Color1f(dr.select(active, value, 0)), dr.select(active, cos_o * dr.inv_pi, 0)

    def _h_function(self, cosine: mi.Float) -> mi.Float:
        """Return the surface's H function (`HapkeSurface.h_function`)."""
        x, r0 = dr.maximum(cosine, 1e-6), self._r0
        return dr.rcp(1 - self._albedo * x * (r0 + (0.5 - r0 * x) * dr.log(1 + dr.rcp(x))))


class LambertianSediment(SampledBSDF):
    """Lambertian `Sediment` model: Mitsuba's ``diffuse``, with parameters that a result can contain."""

    def __init__(self, props: DeclaredProperties) -> None:
        if "single_scattering_albedo" in props:
            albedo = props["single_scattering_albedo"]
            raise UserError(f"single_scattering_albedo = {albedo} needs model = 'hapke': give reflectance")
        # A scene may give the particles for either model.
        _particles(props)
        reflectance = _reflectance(props)
        self._diffuse = create_object("diffuse", reflectance=reflectance)
        super().__init__(props, *self._diffuse.m_components)
        #: Reflectance, a number also where the parameter is a name.
        self.used_values = {"reflectance": reflectance}

    draw = Sediment.draw

    def eval_pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Color1f, mi.Float]:
        """Return BSDF times cosine, and density [1/sr]."""
        return self._diffuse.eval_pdf(ctx, si, wo, active)

    def eval_diffuse_reflectance(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Color1f:
        """Return the reflectance."""
        return self._diffuse.eval_diffuse_reflectance(si, active)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose ``reflectance``, as ``diffuse`` does."""
        self._diffuse.traverse(callback)


def _reflectance(props: DeclaredProperties) -> float:
    """Return the reflectance at vertical incidence."""
    return bottom_reflectance("reflectance", props.read("reflectance", 0.1), props.read("wavelength_nm"))


def _particles(props: DeclaredProperties) -> HapkeSurface:
    """Return a particle surface without its albedo."""
    return HapkeSurface(0.0, *map(props.read, _PARTICLES))


def _create(props: DeclaredProperties) -> mi.BSDF:
    """Return the BSDF for the parameter ``model``."""
    return Sediment(props) if props.read("model") == "hapke" else LambertianSediment(props)


register("bsdf", SEDIMENT, _create, Sediment)
