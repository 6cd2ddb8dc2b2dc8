"""BSDF plugin ``leaf``: a leaf, which reflects and transmits diffuse light."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.bottom import LEAF
from mitransient_lidar.plugins.bases import DeclaredProperties, SampledBSDF, register


class Leaf(SampledBSDF):
    r"""Plant leaf (``leaf``).

    .. parameters::

    Either side reflects the share *R* and transmits the share *T* of the arriving light, both evenly over the
    directions on their side (bi-Lambertian, as in Verhoef 1984, doi:10.1016/0034-4257(84)90057-9):

    .. math:: f = \frac{R}{\pi} \text{ on the side of the light}, \quad f = \frac{T}{\pi} \text{ on the other side}.

    Between two media (``int_ior`` above 1, such as foam on the sea) light from the back, where the index is n,
    transmits :math:`T / n^2`, as reciprocity requires of diffuse light.

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
        reflected, transmitted = self._shares(ctx)
        back = sample1 * (reflected + transmitted) < reflected
        wo = mi.warp.square_to_cosine_hemisphere(sample2)
        up = (mi.Frame3f.cos_theta(si.wi) > 0) == back
        return mi.Vector3f(wo.x, wo.y, dr.select(up, wo.z, -wo.z)), dr.select(back, mi.UInt32(0), mi.UInt32(1))

    def eval_pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Color1f, mi.Float]:
        """Return BSDF times cosine, and density [1/sr]."""
        reflected, transmitted = self._shares(ctx)
        cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
        share = dr.select(cos_i * cos_o > 0, mi.Float(reflected), mi.Float(transmitted))
        value = dr.select(active & (cos_i != 0), share * dr.abs(cos_o) * dr.inv_pi, 0)
        # Light from the back: `wi` is where radiance goes, and where importance comes from.
        slower = (cos_i * cos_o < 0) & ((cos_i > 0) == (ctx.mode == mi.TransportMode.Radiance))
        pdf = value / max(reflected + transmitted, 1e-30)
        return mi.Color1f(dr.select(slower, value / self._index**2, value)), pdf

    def _shares(self, ctx: mi.BSDFContext) -> tuple[float, float]:
        """Return reflectance and transmittance, 0 where the context disables them."""
        reflects = ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0)
        transmits = ctx.is_enabled(mi.BSDFFlags.DiffuseTransmission, 1)
        return self.reflectance * reflects, self.transmittance * transmits


register("bsdf", LEAF, Leaf)
