"""Phase-function plugin ``petzold``: measured average phase function of ocean particles."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitransient_lidar.optics.phase import petzold_average_particle
from mitransient_lidar.optics.phase_table import PowerLawTable
from mitransient_lidar.transport.phase import TabulatedPhase, deflect, half_angle


class Petzold(mi.PhaseFunction):
    r"""Petzold's average-particle phase function (``petzold``).

    The table of Mobley et al. (1993), doi:10.1364/AO.32.007484, after Petzold's (1972) measurements, interpolated in
    log-log and normalised; below 0.1 degrees it goes on as :math:`\theta^{-1.346}`. Backscatter ratio 0.0183, mean
    cosine 0.924. The plugin has no parameters.

    .. code-block:: xml

        <phase type="petzold"/>

    .. code-block:: python

        {'type': 'petzold'}
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.tabulated = TabulatedPhase(PowerLawTable.from_function(petzold_average_particle()))
        self.backscatter_ratio = self.tabulated.table.backscatter_ratio
        self.m_flags = mi.PhaseFunctionFlags.Anisotropic.value

    def eval_pdf(
        self, ctx: mi.PhaseFunctionContext, mei: mi.MediumInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Spectrum, mi.Float]:
        """Return the phase function [1/sr] of a direction, which is its density, too."""
        value = self.tabulated.eval(half_angle(-mei.wi, wo))
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
        s = self.tabulated.sample(sample1, sample2.x)
        wo = deflect(mi.Frame3f(-mei.wi), s, dr.two_pi * sample2.y)
        return wo, mi.Spectrum(1), self.tabulated.eval(s)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose no parameters: a changed phase function is loaded anew."""

    def to_string(self) -> str:
        """Return a description."""
        return "Petzold[]"


mi.register_phase("petzold", lambda props: Petzold(props))
