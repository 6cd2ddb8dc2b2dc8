"""Phase-function plugins for water and particles."""

from __future__ import annotations

import logging
from functools import partial

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.water import (
    FOURNIER_FORAND,
    MEASURED_PHASE,
    PETZOLD,
    SEA_WATER,
    TWO_TERM_HENYEY_GREENSTEIN,
)
from mitransient_lidar.physics.water.phase import (
    PETZOLD_WATERS,
    fournier_forand_backscatter_ratio,
    fournier_forand_parameters,
    henyey_greenstein_backscatter_ratio,
    petzold_average_particle,
    petzold_water,
)
from mitransient_lidar.physics.water.phase_table import PowerLawTable, read_phase_table
from mitransient_lidar.physics.water.seawater import water_phase_function
from mitransient_lidar.plugins.bases import DeclaredProperties, closed, register
from mitransient_lidar.transport.medium import tabulated_phase


@closed
class TabulatedPhaseFunction(mi.PhaseFunction):
    """Phase function that is evaluated and sampled from a `PowerLawTable`, exact in the forward peak."""

    def __init__(self, props: mi.Properties, table: PowerLawTable) -> None:
        super().__init__(props)
        self.tabulated = self.functions = tabulated_phase.TabulatedPhase(table)
        self.number = mi.UInt32(0)
        self.backscatter_ratio = table.backscatter_ratio
        self.m_flags = mi.PhaseFunctionFlags.Anisotropic.value

    eval_pdf, sample = tabulated_phase.NumberedPhase.eval_pdf, tabulated_phase.NumberedPhase.sample


@register("phase", FOURNIER_FORAND)
class FournierForand(TabulatedPhaseFunction):
    r"""Fournier-Forand phase function (``fournier_forand``).

    .. parameters::

    Scattering by particles with a power-law size distribution (Fournier and Forand 1994; closed form of Fournier and
    Jonasz 1999). A backscatter ratio alone picks index and slope. They lie on the line :math:`n = 1.01 + 0.1542 (\mu -
    3)` (Mobley, Sundman and Boss 2002, doi:10.1364/AO.41.001035).

    The function has a singularity at 0 degrees. It is tabulated as power laws of :math:`s = \sin^2(\theta/2)` over
    twelve decades and sampled exactly, including angles below 2 microradian.

    .. example::

        {'type': 'fournier_forand', 'backscatter_ratio': 0.04}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        if "refractive_index" in props or "junge_slope" in props:
            if "backscatter_ratio" in props or not ("refractive_index" in props and "junge_slope" in props):
                raise UserError("fournier_forand: give backscatter_ratio, or both refractive_index and junge_slope")
            self.refractive_index = props.read("refractive_index")
            self.junge_slope = props.read("junge_slope")
        else:
            self.refractive_index, self.junge_slope = fournier_forand_parameters(props.read("backscatter_ratio"))
        super().__init__(props, PowerLawTable.fournier_forand(self.refractive_index, self.junge_slope))
        self.backscatter_ratio = fournier_forand_backscatter_ratio(self.refractive_index, self.junge_slope)


logger = logging.getLogger(__name__)

_TOLERATED = 0.02  #: Largest relative normalisation error without a warning.


@register("phase", MEASURED_PHASE)
class MeasuredPhase(TabulatedPhaseFunction):
    r"""Measured phase function (``measured_phase``).

    .. parameters::

    Interpolated in log-log, and extrapolated below the first angle with the power law of the first two
    (`mitransient_lidar.physics.water.phase_table.read_phase_table`).

    .. example::

        {'type': 'measured_phase', 'filename': 'harbour.csv'}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        if "filename" not in props:
            raise UserError("measured_phase: filename is missing: the file of angles and values")
        self.filename = props["filename"]
        table, integral = read_phase_table(self.filename)
        if abs(integral - 1) > _TOLERATED:
            logger.warning(
                "%s: the values integrate to %.3g over the sphere; they are normalised", self.filename, integral
            )
        super().__init__(props, table)


_AVERAGE = "average_particle"


@register("phase", PETZOLD)
class Petzold(TabulatedPhaseFunction):
    r"""Petzold's measured phase functions (``petzold``).

    .. parameters::

    Measured by Petzold (1972) about 514 nm, interpolated in log-log and normalised, with power laws below 0.1 degrees.
    The average particle is the table in Mobley et al. (1993), doi:10.1364/AO.32.007484, with a backscatter ratio of
    0.0183 and a mean cosine of 0.924. The waters include scattering by pure water.

    .. example::

        {'type': 'petzold', 'water': 'coastal'}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        self.water = props.read("water")
        if self.water != _AVERAGE and self.water not in PETZOLD_WATERS:
            raise UserError(f"water = {self.water!r} must be one of {', '.join([_AVERAGE, *PETZOLD_WATERS])}")
        measured = petzold_average_particle() if self.water == _AVERAGE else petzold_water(self.water)
        super().__init__(props, PowerLawTable.from_function(measured))


@register("phase", SEA_WATER)
class SeaWater(TabulatedPhaseFunction):
    r"""Phase function of pure sea water (``sea_water``).

    .. parameters::

    :math:`p \propto 1 + \frac{1 - \delta}{1 + \delta} \cos^2 \theta` (Morel 1974), with a backscatter ratio of 0.5.
    The ``layered_water`` parameter ``water_scattering`` mixes it with the particles' function.

    .. example::

        {'type': 'sea_water'}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        self.depolarisation = props.read("depolarisation")
        phase = partial(water_phase_function, depolarisation=self.depolarisation)
        super().__init__(props, PowerLawTable.from_function(phase))


@register("phase", TWO_TERM_HENYEY_GREENSTEIN)
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
        forward, backward = (
            tabulated_phase.sample_henyey_greenstein(sample2.x, g) for g in (self.g_forward, -self.g_backward)
        )
        cosine = dr.select(sample1 < self.weight, forward, backward)
        wo = tabulated_phase.deflect(mi.Frame3f(-mei.wi), 0.5 * (1 - cosine), dr.two_pi * sample2.y)
        return wo, mi.Spectrum(1), self._value(cosine)

    def _value(self, cosine: mi.Float) -> mi.Float:
        forward, backward = (tabulated_phase.henyey_greenstein(cosine, g) for g in (self.g_forward, -self.g_backward))
        return self.weight * forward + (1 - self.weight) * backward
