"""BSDF plugin ``retroreflector``: a surface that reflects light towards its source."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.parameters.bottom import RETROREFLECTOR
from mitransient_lidar.plugins.bases import DeclaredProperties, SampledBSDF, register
from mitransient_lidar.transport.medium.tabulated_phase import deflect


class Retroreflector(SampledBSDF):
    r"""Retro-reflecting surface (``retroreflector``).

    .. parameters::

    For reflective sheeting, beads and prisms on a target. Light that arrives from the direction :math:`\omega_i` leaves
    about the same direction,

    .. math:: f(\omega_i, \omega_o) = R \left[ \frac{(1-s)\, D(\gamma)}{\max(\cos\theta_i, \cos\theta_o)}
              + \frac{s}{\pi} \right], \quad D(\gamma) = \frac{\kappa\, e^{\kappa (\cos\gamma - 1)}}
              {2\pi (1 - e^{-2\kappa})}, \quad \kappa = \frac{1}{4 \sin^2(w/4)},

    with the angle :math:`\gamma` between the two, the reflectance *R*, the diffuse share *s* and the width *w*. *D* is
    the Gaussian of the sphere (Fisher 1953, doi:10.1098/rspa.1953.0064), normalised over all directions. The BSDF is
    reciprocal, and reflects at most *R*. A narrow lobe with :math:`\sigma = w/2` loses the share :math:`0.4\,\sigma
    \tan\theta_i` at oblique incidence, more where a part falls behind the surface. Straight back it reflects
    :math:`(1-s) R / (2\pi\sigma^2)` per steradian at any angle; real prisms and beads reflect less beyond about 30
    degrees.

    It reflects on the side of its normal only; ``twosided`` makes it reflect on both. A lobe much narrower than the
    beam's spread under water, about 1 degree, causes noise.

    .. example::

        {'type': 'retroreflector', 'reflectance': 0.6, 'width_deg': 2.0, 'diffuse_share': 0.1}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        kinds = mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DiffuseReflection
        super().__init__(props, *(kind.value | mi.BSDFFlags.FrontSide.value for kind in kinds))
        self.reflectance, self.diffuse_share = props.read("reflectance"), props.read("diffuse_share")
        self.width = math.radians(props.read("width_deg"))
        self._concentration = 0.25 / math.sin(0.25 * self.width) ** 2
        self._mass = -math.expm1(-2 * self._concentration)

    def draw(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, sample1: mi.Float, sample2: mi.Point2f
    ) -> tuple[mi.Vector3f, mi.UInt32]:
        """Draw directions from lobe and Lambertian share."""
        lobe, diffuse = self._shares(ctx)
        in_lobe = sample1 * (lobe + diffuse) < lobe
        s = -dr.log(dr.maximum(1 - sample2.x * self._mass, dr.epsilon(mi.Float))) / (2 * self._concentration)
        back = deflect(mi.Frame3f(si.wi), dr.minimum(s, 1), dr.two_pi * sample2.y)
        wo = dr.select(in_lobe, back, mi.warp.square_to_cosine_hemisphere(sample2))
        return wo, dr.select(in_lobe, mi.UInt32(0), mi.UInt32(1))

    def eval_pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Color1f, mi.Float]:
        """Return BSDF times cosine, and density [1/sr]."""
        lobe, diffuse = self._shares(ctx)
        cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        active = active & (cos_i > 0) & (cos_o > 0)
        # From the difference between the directions: the cosine of a small angle is 1 to rounding.
        peak = self._concentration / (2 * dr.pi * self._mass)
        density = peak * dr.exp(-0.5 * self._concentration * dr.squared_norm(wo - si.wi))
        lambertian = cos_o * dr.inv_pi
        value = lobe * density * cos_o / dr.maximum(cos_i, cos_o) + diffuse * lambertian
        pdf = (lobe * density + diffuse * lambertian) / max(lobe + diffuse, 1e-30)
        return mi.Color1f(dr.select(active, self.reflectance * value, 0)), dr.select(active, pdf, 0)

    def _shares(self, ctx: mi.BSDFContext) -> tuple[float, float]:
        """Return the shares of lobe and Lambertian part, 0 where the context disables them."""
        glossy = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0)
        diffuse = ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 1)
        return (1 - self.diffuse_share) * glossy, self.diffuse_share * diffuse


register("bsdf", RETROREFLECTOR, Retroreflector)
