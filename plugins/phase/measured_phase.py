"""Phase-function plugin ``measured_phase``: a table of angles and values from a file."""

from __future__ import annotations

import logging

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.water import MEASURED_PHASE
from mitransient_lidar.physics.water.phase_table import read_phase_table
from mitransient_lidar.plugins.bases import DeclaredProperties, register
from mitransient_lidar.plugins.phase.tabulated import TabulatedPhaseFunction

logger = logging.getLogger(__name__)

#: Largest relative normalisation error without a warning.
_TOLERATED = 0.02


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


register("phase", MEASURED_PHASE, MeasuredPhase)
