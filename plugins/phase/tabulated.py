"""Base class of the phase-function plugins that use a table."""

from __future__ import annotations

import mitsuba as mi

from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.plugins.bases import closed
from mitransient_lidar.transport.medium.tabulated_phase import NumberedPhase, TabulatedPhase


@closed
class TabulatedPhaseFunction(mi.PhaseFunction):
    """Phase function that is evaluated and sampled from a `PowerLawTable`, exact in the forward peak."""

    def __init__(self, props: mi.Properties, table: PowerLawTable) -> None:
        super().__init__(props)
        self.tabulated = TabulatedPhase(table)
        self.backscatter_ratio = table.backscatter_ratio
        self.m_flags = mi.PhaseFunctionFlags.Anisotropic.value

    def eval_pdf(
        self, ctx: mi.PhaseFunctionContext, mei: mi.MediumInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Spectrum, mi.Float]:
        """Return the phase function [1/sr] of a direction, as value and density."""
        return NumberedPhase(self.tabulated, mi.UInt32(0)).eval_pdf(ctx, mei, wo, active)

    def sample(
        self,
        ctx: mi.PhaseFunctionContext,
        mei: mi.MediumInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
        """Sample a direction distributed as the phase function."""
        return NumberedPhase(self.tabulated, mi.UInt32(0)).sample(ctx, mei, sample1, sample2, active)
