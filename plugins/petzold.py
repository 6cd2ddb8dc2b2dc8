"""Phase-function plugin ``petzold``: measured average phase function of ocean particles."""

from __future__ import annotations

import mitsuba as mi
from mitransient_lidar.plugins.tabulated import TabulatedPhaseFunction

from mitransient_lidar.optics.phase import petzold_average_particle
from mitransient_lidar.optics.phase_table import PowerLawTable


class Petzold(TabulatedPhaseFunction):
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
        super().__init__(props, PowerLawTable.from_function(petzold_average_particle()))

    def to_string(self) -> str:
        """Return a description."""
        return "Petzold[]"


mi.register_phase("petzold", lambda props: Petzold(props))
