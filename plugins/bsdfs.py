"""BSDF plugins: bottoms by name, retro-reflectors, leaves, and rough water whose slopes are not Gaussian."""

from __future__ import annotations

import math
from abc import abstractmethod

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.bottom import GRAM_CHARLIER_DIELECTRIC, LEAF, RETROREFLECTOR, SEDIMENT
from mitransient_lidar.physics.sea.cox_munk import GramCharlierSeries
from mitransient_lidar.physics.water.sediments import HapkeSurface, bottom_reflectance
from mitransient_lidar.plugins.bases import DeclaredProperties, closed, register
from mitransient_lidar.transport.medium.tabulated_phase import deflect
from mitransient_lidar.transport.medium.water_phases import create_object
from mitransient_lidar.transport.opaque import opaque


@closed
class SampledBSDF(mi.BSDF):
    """BSDF that is evaluated with its density, and draws directions from one or two components."""

    def __init__(self, props: DeclaredProperties, *components: int) -> None:
        super().__init__(props)
        self.m_components, self.m_flags = list(components), components[0] | components[-1]

    def shares(self, ctx: mi.BSDFContext, *values: float) -> list[float]:
        """Return values of the components, 0 where the context disables them."""
        sides = mi.BSDFFlags.FrontSide.value | mi.BSDFFlags.BackSide.value
        kinds = [mi.BSDFFlags(one & ~sides) for one in self.m_components]
        return [value * ctx.is_enabled(kinds[index], index) for index, value in enumerate(values)]

    @abstractmethod
    def draw(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, sample1: mi.Float, sample2: mi.Point2f
    ) -> tuple[mi.Vector3f, mi.UInt32]:
        """Draw directions with the density of `eval_pdf`; return them and the numbers of their components."""

    @abstractmethod
    def eval_pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Color1f, mi.Float]:
        """Return BSDF times cosine, and density [1/sr]."""

    def sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.BSDFSample3f, mi.Color1f]:
        """Sample a direction; return it and BSDF times cosine over its density."""
        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo, bs.sampled_component = self.draw(ctx, si, sample1, sample2)
        bs.eta = 1.0
        first, last = mi.UInt32(self.m_components[0]), mi.UInt32(self.m_components[-1])
        bs.sampled_type = dr.select(bs.sampled_component == 0, first, last)
        value, bs.pdf = self.eval_pdf(ctx, si, bs.wo, active)
        return bs, dr.select(bs.pdf > 0, value / bs.pdf, 0)

    def eval(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> mi.Color1f:
        """Return BSDF times cosine [1/sr]."""
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> mi.Float:
        """Return the density with which `sample` draws a direction [1/sr]."""
        return self.eval_pdf(ctx, si, wo, active)[1]


_PARTICLES = ("lobe_asymmetry", "backward_share", "opposition_amplitude", "opposition_width")  #: Particle parameters.


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


register("bsdf", SEDIMENT, Sediment)(_create)


@register("bsdf", RETROREFLECTOR)
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
    :math:`(1-s) R / (2\pi\sigma^2)` per steradian at any angle. Real prisms and beads reflect less beyond about 30
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
        lobe, diffuse = self.shares(ctx, 1 - self.diffuse_share, self.diffuse_share)
        in_lobe = sample1 * (lobe + diffuse) < lobe
        s = -dr.log(dr.maximum(1 - sample2.x * self._mass, dr.epsilon(mi.Float))) / (2 * self._concentration)
        back = deflect(mi.Frame3f(si.wi), dr.minimum(s, 1), dr.two_pi * sample2.y)
        wo = dr.select(in_lobe, back, mi.warp.square_to_cosine_hemisphere(sample2))
        return wo, dr.select(in_lobe, mi.UInt32(0), mi.UInt32(1))

    def eval_pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Color1f, mi.Float]:
        """Return BSDF times cosine, and density [1/sr]."""
        lobe, diffuse = self.shares(ctx, 1 - self.diffuse_share, self.diffuse_share)
        cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        active = active & (cos_i > 0) & (cos_o > 0)
        # From the difference between the directions: the cosine of a small angle is 1 to rounding.
        peak = self._concentration / (2 * dr.pi * self._mass)
        density = peak * dr.exp(-0.5 * self._concentration * dr.squared_norm(wo - si.wi))
        lambertian = cos_o * dr.inv_pi
        value = lobe * density * cos_o / dr.maximum(cos_i, cos_o) + diffuse * lambertian
        pdf = (lobe * density + diffuse * lambertian) / max(lobe + diffuse, 1e-30)
        return mi.Color1f(dr.select(active, self.reflectance * value, 0)), dr.select(active, pdf, 0)


@register("bsdf", LEAF)
class Leaf(SampledBSDF):
    r"""Plant leaf (``leaf``).

    .. parameters::

    Either side reflects the share *R* and transmits the share *T* of the arriving light, both evenly over the
    directions on their side (bi-Lambertian, as in Verhoef 1984, doi:10.1016/0034-4257(84)90057-9):

    .. math:: f = \frac{R}{\pi} \text{ on the side of the light}, \quad f = \frac{T}{\pi} \text{ on the other side}.

    Between two media (``int_ior`` above 1, such as foam on the sea) light from the back, where the index is n,
    transmits :math:`T / n^2`. Reciprocity requires this of diffuse light.

    .. example::

        {'type': 'leaf', 'reflectance': 0.08, 'transmittance': 0.1}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        sides = mi.BSDFFlags.FrontSide.value | mi.BSDFFlags.BackSide.value
        kinds = mi.BSDFFlags.DiffuseReflection, mi.BSDFFlags.DiffuseTransmission
        super().__init__(props, *(kind.value | sides for kind in kinds))
        self.reflectance, self.transmittance = props.read("reflectance"), props.read("transmittance")
        self._index = props.read("int_ior")
        if self.reflectance + self.transmittance > 1:
            raise UserError(
                f"reflectance = {self.reflectance:g} and transmittance = {self.transmittance:g} of a leaf must be at "
                "most 1 together"
            )

    def draw(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, sample1: mi.Float, sample2: mi.Point2f
    ) -> tuple[mi.Vector3f, mi.UInt32]:
        """Draw a side, and a direction in proportion to its cosine."""
        reflected, transmitted = self.shares(ctx, self.reflectance, self.transmittance)
        back = sample1 * (reflected + transmitted) < reflected
        wo = mi.warp.square_to_cosine_hemisphere(sample2)
        up = (mi.Frame3f.cos_theta(si.wi) > 0) == back
        return mi.Vector3f(wo.x, wo.y, dr.select(up, wo.z, -wo.z)), dr.select(back, mi.UInt32(0), mi.UInt32(1))

    def eval_pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Color1f, mi.Float]:
        """Return BSDF times cosine, and density [1/sr]."""
        reflected, transmitted = self.shares(ctx, self.reflectance, self.transmittance)
        cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        share = dr.select(cos_i * cos_o > 0, mi.Float(reflected), mi.Float(transmitted))
        value = dr.select(active & (cos_i != 0), share * dr.abs(cos_o) * dr.inv_pi, 0)
        # Light from the back: `wi` is where radiance goes, and where importance comes from.
        slower = (cos_i * cos_o < 0) & ((cos_i > 0) == (ctx.mode == mi.TransportMode.Radiance))
        pdf = value / max(reflected + transmitted, 1e-30)
        return mi.Color1f(dr.select(slower, value / self._index**2, value)), pdf


_TERMS = ("c21", "c03", "c40", "c22", "c04")


@register("bsdf", GRAM_CHARLIER_DIELECTRIC)
class GramCharlierDielectric(SampledBSDF):
    r"""Rough dielectric whose slopes have a Gram-Charlier series (``gram_charlier_dielectric``).

    .. parameters::

    The ripples of an ``ocean_surface`` with ``slope_distribution`` ``gram_charlier``. Its slope density, over *x* along
    v and *y* against u in standard deviations, is the Gaussian rough dielectric density (Walter et al. 2007,
    doi:10.2312/EGWR/EGSR07/195-206) times

    .. math:: 1 - \tfrac{c_{21}}{2} (x^2 - 1) y - \tfrac{c_{03}}{6} (y^3 - 3 y) + \tfrac{c_{40}}{24} (x^4 - 6 x^2 + 3)
              + \tfrac{c_{22}}{4} (x^2 - 1) (y^2 - 1) + \tfrac{c_{04}}{24} (y^4 - 6 y^2 + 3)

    (Cox and Munk 1954, doi:10.1364/JOSA.44.000838). Smith's masking by facets, for one direction with the angle
    :math:`\theta`, follows from this density, too. With the slope's skewness *s*, excess kurtosis *k* and standard
    deviation :math:`\sigma` in the direction, and :math:`a = \cot\theta / \sigma`,

    .. math:: \frac{1}{G_1} = 1 + \frac{1}{a} \left[ \varphi(a) \left( 1 + \tfrac{s}{6} a + \tfrac{k}{24} (a^2 - 1)
              \right) - a\, Q(a) \right],

    with the normal density :math:`\varphi` and its tail *Q*. Directions are drawn from the Gaussian facets that are
    visible, and weighted by the ratio of the densities. Where the series is negative, the density is 0.

    .. example::

        {'type': 'gram_charlier_dielectric', 'variance_u': 0.02, 'variance_v': 0.015, 'c03': -0.16}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        variances = list(map(props.read, ("variance_u", "variance_v")))
        series = GramCharlierSeries(*map(props.read, _TERMS))
        inside, outside = props.read("int_ior"), props.read("ext_ior")
        roughness = {f"alpha_{axis}": math.sqrt(2 * one) for axis, one in zip("uv", variances, strict=True)}
        self._index = opaque(inside / outside)
        self._gaussian = create_object(
            "roughdielectric", distribution="beckmann", int_ior=inside, ext_ior=outside, **roughness
        )
        super().__init__(props, *map(self._gaussian.flags, range(self._gaussian.component_count())))
        self.set_slopes((variances[0], variances[1]), series)

    def set_slopes(self, variances: tuple[float, float], series: GramCharlierSeries) -> None:
        """Set slope variances along and across u, and the series of slopes over their standard deviations."""
        series.require_positive("give smaller terms, or ripples of a larger share of the slopes")
        self.variances, self.series = variances, series
        buffers = mi.traverse(self._gaussian)
        for axis, variance in zip("uv", variances, strict=True):
            buffers[f"alpha_{axis}.value"] = math.sqrt(2 * variance)
        buffers.update()
        self._u, self._v = (opaque(math.sqrt(variance)) for variance in variances)
        self._terms = GramCharlierSeries(*(opaque(getattr(series, name)) for name in _TERMS))
        # The density that is cut off where it is negative.
        self._scale = opaque(1 / (1 + series.negative_share))

    def sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.BSDFSample3f, mi.Color1f]:
        """Sample a direction as for Gaussian slopes; return it and BSDF times cosine over its density."""
        bs, weight = self._gaussian.sample(ctx, si, sample1, sample2, active)
        return bs, weight * self._ratio(si.wi, bs.wo)

    def eval_pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Color1f, mi.Float]:
        """Return BSDF times cosine, and density [1/sr]."""
        value, pdf = self._gaussian.eval_pdf(ctx, si, wo, active)
        return value * self._ratio(si.wi, wo), pdf

    def _ratio(self, wi: mi.Vector3f, wo: mi.Vector3f) -> mi.Float:
        """Return the BSDF's ratio to the BSDF with Gaussian slopes."""
        cos_i, cos_o = mi.Frame3f.cos_theta(wi), mi.Frame3f.cos_theta(wo)
        # Generalised half vector (Walter et al. 2007, equations 13 and 16), on the upper side.
        index = dr.select(cos_i > 0, self._index, dr.rcp(self._index))
        normal = wi + wo * dr.select(cos_i * cos_o > 0, 1, index)
        rise = dr.select(normal.z != 0, dr.rcp(normal.z), 0)
        facets = dr.maximum(self._terms.ratio(normal.y * rise / self._v, normal.x * rise / self._u), 0)
        return self._scale * facets * self._visible(wi) * self._visible(wo)

    def _visible(self, direction: mi.Vector3f) -> mi.Float:
        """Return the ratio of Smith's masking to the masking by Gaussian slopes."""
        up = dr.mulsign(direction, direction.z)
        along_u, along_v = up.x * self._u, up.y * self._v
        spread2 = dr.square(along_u) + dr.square(along_v)
        # Without a slope across the direction there is no masking.
        inverse = dr.select(spread2 > 0, dr.rsqrt(spread2), 0)
        a = dr.select(spread2 > 0, up.z * inverse, dr.inf)
        skewness, kurtosis = self._terms.along(along_v * inverse, -along_u * inverse)
        density = dr.exp(-0.5 * dr.square(a)) / math.sqrt(2 * math.pi)
        tail = 0.5 * (1 - dr.erf(a * dr.sqrt(0.5)))
        safe = dr.clip(a, 1e-4, 1e4)
        gaussian = dr.maximum(density - safe * tail, 0) / safe
        more = density * (skewness * safe / 6 + kurtosis * (safe * safe - 1) / 24) / safe
        return (1 + gaussian) / (1 + dr.maximum(gaussian + more, 0))
