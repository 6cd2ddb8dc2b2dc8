"""Phase-function plugin ``two_term_henyey_greenstein``: a forward and a backward Henyey-Greenstein lobe."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.parameters.water import TWO_TERM_HENYEY_GREENSTEIN
from mitransient_lidar.physics.water.phase import henyey_greenstein_backscatter_ratio
from mitransient_lidar.plugins.bases import DeclaredProperties, closed, register
from mitransient_lidar.transport.medium.tabulated_phase import deflect, henyey_greenstein, sample_henyey_greenstein


@closed
class TwoTermHenyeyGreenstein(mi.PhaseFunction):
    r"""Two-term Henyey-Greenstein phase function (``two_term_henyey_greenstein``).

    .. parameters::

    .. math:: p = w\, p_{HG}(g_f) + (1 - w)\, p_{HG}(-g_b)

    (Haltrin 2002, doi:10.1364/AO.41.001022). Mean cosine :math:`w g_f - (1-w) g_b`.

    .. example::

        {'type': 'two_term_henyey_greenstein', 'weight': 0.98, 'g_forward': 0.93, 'g_backward': 0.3}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        super().__init__(props)
        self.weight, self.g_forward, self.g_backward = map(props.read, ("weight", "g_forward", "g_backward"))
        forward, backward = (henyey_greenstein_backscatter_ratio(g) for g in (self.g_forward, -self.g_backward))
        self.backscatter_ratio = self.weight * forward + (1 - self.weight) * backward
        self.m_flags = mi.PhaseFunctionFlags.Anisotropic.value

    def eval_pdf(
        self, ctx: mi.PhaseFunctionContext, mei: mi.MediumInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Spectrum, mi.Float]:
        """Return the phase function [1/sr] of a direction, as value and density."""
        value = self._value(dr.dot(-mei.wi, wo))
        return mi.Spectrum(value), value

    def sample(
        self,
        ctx: mi.PhaseFunctionContext,
        mei: mi.MediumInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
        """Sample a direction distributed as the phase function."""
        forward, backward = (sample_henyey_greenstein(sample2.x, g) for g in (self.g_forward, -self.g_backward))
        cosine = dr.select(sample1 < self.weight, forward, backward)
        wo = deflect(mi.Frame3f(-mei.wi), 0.5 * (1 - cosine), dr.two_pi * sample2.y)
        return wo, mi.Spectrum(1), self._value(cosine)

    def _value(self, cosine: mi.Float) -> mi.Float:
        forward, backward = (henyey_greenstein(cosine, g) for g in (self.g_forward, -self.g_backward))
        return self.weight * forward + (1 - self.weight) * backward


register("phase", TWO_TERM_HENYEY_GREENSTEIN, TwoTermHenyeyGreenstein)
