"""Phase-function plugin ``sea_water``: scattering by pure sea water."""

from __future__ import annotations

from functools import partial

import mitsuba as mi

from mitransient_lidar.core.validation import in_range
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.physics.water.seawater import DEPOLARISATION, water_phase_function
from mitransient_lidar.plugins.bases import recorded
from mitransient_lidar.plugins.phase.tabulated import TabulatedPhaseFunction


class SeaWater(TabulatedPhaseFunction):
    r"""Phase function of pure sea water (``sea_water``).

    ==============  =====  =============================================================================================
    Parameter       Type   Meaning
    ==============  =====  =============================================================================================
    depolarisation  float  Depolarisation ratio of light scattered at 90 degrees, 0 (Rayleigh's function) to 0.2.
                           Default: 0.039 (Zhang, Hu and He 2009, doi:10.1364/OE.17.005698)
    ==============  =====  =============================================================================================

    :math:`p \propto 1 + \frac{1 - \delta}{1 + \delta} \cos^2 \theta` (Morel 1974), with a backscatter ratio of 0.5.
    The parameter ``water_scattering`` of ``layered_water`` mixes it with the function of particles.

    .. code-block:: xml

        <phase type="sea_water"/>

    .. code-block:: python

        {'type': 'sea_water'}
    """

    def __init__(self, props: mi.Properties) -> None:
        self.depolarisation = in_range("depolarisation", props.get("depolarisation", DEPOLARISATION), 0.0, 0.2)
        phase = partial(water_phase_function, depolarisation=self.depolarisation)
        super().__init__(props, PowerLawTable.from_function(phase))

    def to_string(self) -> str:
        """Return a description."""
        return f"SeaWater[depolarisation={self.depolarisation:g}]"


mi.register_phase("sea_water", recorded(SeaWater))
