"""Phase-function plugin ``fournier_forand``: the standard phase function of natural water."""

from __future__ import annotations

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.water import FOURNIER_FORAND
from mitransient_lidar.physics.water.phase import fournier_forand_backscatter_ratio, fournier_forand_parameters
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.plugins.bases import DeclaredProperties, register
from mitransient_lidar.plugins.phase.tabulated import TabulatedPhaseFunction


class FournierForand(TabulatedPhaseFunction):
    r"""Fournier-Forand phase function (``fournier_forand``).

    .. parameters::

    Scattering by particles with a power-law size distribution (Fournier and Forand 1994; closed form of Fournier and
    Jonasz 1999). A backscatter ratio alone picks index and slope on the line
    :math:`n = 1.01 + 0.1542 (\mu - 3)` (Mobley, Sundman and Boss 2002, doi:10.1364/AO.41.001035).

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


register("phase", FOURNIER_FORAND, FournierForand)
