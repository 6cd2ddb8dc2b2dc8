"""Phase-function plugin ``measured_phase``: a user's table of angles and values."""

from __future__ import annotations

import logging

import drjit as dr
import mitsuba as mi

from mitransient_lidar.optics.user_phase import read_phase_table
from mitransient_lidar.transport.phase import TabulatedPhase, deflect, half_angle

logger = logging.getLogger(__name__)

#: Share by which a table may miss the normalisation without a warning.
_TOLERATED = 0.02


class MeasuredPhase(mi.PhaseFunction):
    r"""Measured phase function (``measured_phase``).

    =========  ======  =================================================================================================
    Parameter  Type    Meaning
    =========  ======  =================================================================================================
    filename   string  Text file of two columns: scattering angle [deg], increasing, at least 10, the last 170 or more;
                       and value [1/sr]. Any other unit serves, a volume scattering function too: the values are
                       normalised, with a warning when they were off by more than 2 %
    =========  ======  =================================================================================================

    Interpolated in log-log, and continued below the first angle with the power of the first two
    (`mitransient_lidar.optics.user_phase.read_phase_table`). Sampled exactly into the forward peak.

    .. code-block:: xml

        <phase type="measured_phase">
            <string name="filename" value="harbour.csv"/>
        </phase>

    .. code-block:: python

        {'type': 'measured_phase', 'filename': 'harbour.csv'}
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        if "filename" not in props:
            raise ValueError("measured_phase: filename is missing: the file of angles and values")
        self.filename = props["filename"]
        table, integral = read_phase_table(self.filename)
        if abs(integral - 1) > _TOLERATED:
            logger.warning(
                "%s: the values integrate to %.3g over the sphere; they are normalised", self.filename, integral
            )
        self.tabulated = TabulatedPhase(table)
        self.backscatter_ratio = table.backscatter_ratio
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
        return f"MeasuredPhase[{self.filename}]"


mi.register_phase("measured_phase", lambda props: MeasuredPhase(props))
