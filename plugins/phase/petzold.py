"""Phase-function plugin ``petzold``: measured phase functions for natural waters."""

from __future__ import annotations

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.water import PETZOLD
from mitransient_lidar.physics.water.phase import PETZOLD_WATERS, petzold_average_particle, petzold_water
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.plugins.bases import DeclaredProperties, register
from mitransient_lidar.plugins.phase.tabulated import TabulatedPhaseFunction

_AVERAGE = "average_particle"


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


register("phase", PETZOLD, Petzold)
