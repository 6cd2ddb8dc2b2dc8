"""Phase-function plugin ``sea_water``: scattering by pure sea water."""

from __future__ import annotations

from functools import partial

from mitransient_lidar.core.parameters.water import SEA_WATER
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.physics.water.seawater import water_phase_function
from mitransient_lidar.plugins.bases import DeclaredProperties, register
from mitransient_lidar.plugins.phase.tabulated import TabulatedPhaseFunction


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


register("phase", SEA_WATER, SeaWater)
