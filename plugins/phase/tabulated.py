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
        self.tabulated = self.functions = TabulatedPhase(table)
        self.number = mi.UInt32(0)
        self.backscatter_ratio = table.backscatter_ratio
        self.m_flags = mi.PhaseFunctionFlags.Anisotropic.value

    eval_pdf, sample = NumberedPhase.eval_pdf, NumberedPhase.sample
