"""BSDF plugin ``gram_charlier_dielectric``: a rough surface of water whose slopes are not Gaussian."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.parameters.bottom import GRAM_CHARLIER_DIELECTRIC
from mitransient_lidar.physics.sea.cox_munk import GramCharlierSeries
from mitransient_lidar.plugins.bases import DeclaredProperties, SampledBSDF, register
from mitransient_lidar.transport.medium.nested_objects import create_object
from mitransient_lidar.transport.opaque import opaque

_TERMS = ("c21", "c03", "c40", "c22", "c04")


class GramCharlierDielectric(SampledBSDF):
    r"""Rough dielectric whose slopes have a Gram-Charlier series (``gram_charlier_dielectric``).

    .. parameters::

    The ripples of an ``ocean_surface`` with ``slope_distribution`` ``gram_charlier``. Its slope density, over *x* along
    v and *y* against u in standard deviations, is the Gaussian rough dielectric density (Walter et al. 2007,
    doi:10.2312/EGWR/EGSR07/195-206) times

    .. math:: 1 - \tfrac{c_{21}}{2} (x^2 - 1) y - \tfrac{c_{03}}{6} (y^3 - 3 y) + \tfrac{c_{40}}{24} (x^4 - 6 x^2 + 3)
              + \tfrac{c_{22}}{4} (x^2 - 1) (y^2 - 1) + \tfrac{c_{04}}{24} (y^4 - 6 y^2 + 3)

    (Cox and Munk 1954, doi:10.1364/JOSA.44.000838). Smith's masking by facets, of one direction with the angle
    :math:`\theta`, is that of this density, too: with skewness *s* and excess kurtosis *k* of the slope in the
    direction, its standard deviation :math:`\sigma` and :math:`a = \cot\theta / \sigma`,

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


register("bsdf", GRAM_CHARLIER_DIELECTRIC, GramCharlierDielectric)
