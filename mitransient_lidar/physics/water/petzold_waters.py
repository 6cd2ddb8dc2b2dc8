"""The waters that Petzold measured, as phase functions."""

from __future__ import annotations

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.water.data_tables import PhaseFunction, log_log_phase, read_columns

PETZOLD_WATERS = {
    "clear": (0.114, 0.037),
    "coastal": (0.179, 0.219),
    "turbid": (0.366, 1.824),
    "autec_7": (0.082, 0.117),
    "autec_9": (0.122, 0.043),
    "haoce_5": (0.195, 0.275),
    "nuc_2200": (0.337, 1.583),
    "nuc_2240": (0.125, 1.205),
}
"""Absorption and scattering (a, b) [1/m] of Petzold's waters at 530 nm, those of pure water included."""


def petzold_water(name: str) -> PhaseFunction:
    """Phase function of one of Petzold's waters as a function of the angle [rad].

    Parameters
    ----------
    name : str
        ``clear`` (station AUTEC 8, Tongue of the Ocean, Bahamas), ``coastal`` (HAOCE 11, channel off Santa Catalina,
        California), ``turbid`` (NUC 2040, San Diego harbour), or another station: ``autec_7``, ``autec_9``,
        ``haoce_5`` (Avalon Cove, Catalina), ``nuc_2200`` or ``nuc_2240``.

    Returns
    -------
    callable
        Function from angles [rad], 0 to pi, to p [1/sr], normalised to 1; infinite at 0. Between the tabulated angles
        ln p is linear in ln theta; below 0.1 degree the power law of the first two angles continues, with exponents of
        -1.19 to -1.60.

    Raises
    ------
    UserError
        If the name is unknown.

    Notes
    -----
    Petzold (1972), Volume scattering functions for selected ocean waters, Scripps Institution of Oceanography, SIO Ref.
    72-78, measured in green light (a band of 75 nm about 514 nm). Molecules and particles were measured together: do
    not add the scattering of sea water. There are no measurements below 0.17 degree, in the harbour below 0.09, where
    the report extrapolates with a power law.

    With this interpolation the tables of ``clear``, ``coastal`` and ``turbid`` integrate to 0.0372, 0.2189 and 1.820
    1/m; the report's own sums are 0.0373, 0.2193 and 1.824. Mean cosines are 0.871, 0.947 and 0.920, and bb/b is
    0.0442, 0.0134 and 0.0200.
    """
    if name not in PETZOLD_WATERS:
        raise UserError(f"name = {name!r} must be one of {', '.join(PETZOLD_WATERS)}")
    columns = read_columns("petzold_waters.csv")
    return log_log_phase(columns[0], columns[1 + list(PETZOLD_WATERS).index(name)])
