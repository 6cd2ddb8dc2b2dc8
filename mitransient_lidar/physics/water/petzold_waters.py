"""Petzold's three measured waters as phase functions."""

from __future__ import annotations

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.water.data_tables import PhaseFunction, log_log_phase, read_columns

PETZOLD_WATERS = {"clear": (0.114, 0.037), "coastal": (0.179, 0.219), "turbid": (0.366, 1.824)}
"""Absorption and scattering (a, b) [1/m] of Petzold's waters at 530 nm, those of pure water included."""


def petzold_water(name: str) -> PhaseFunction:
    """Phase function of one of Petzold's waters as a function of the angle [rad].

    Parameters
    ----------
    name : str
        ``clear`` (Tongue of the Ocean, Bahamas), ``coastal`` (channel off Santa Catalina, California) or ``turbid``
        (San Diego harbour).

    Returns
    -------
    callable
        Function from angles [rad], 0 to pi, to p [1/sr], normalised to 1; infinite at 0. Between the tabulated angles
        ln p is linear in ln theta; below 0.1 degree the power law of the first two angles continues, with the exponents
        -1.191, -1.546 and -1.338.

    Raises
    ------
    UserError
        If the name is unknown.

    Notes
    -----
    Petzold (1972), Volume scattering functions for selected ocean waters, Scripps Institution of Oceanography, SIO Ref.
    72-78: stations AUTEC 8, HAOCE 11 and NUC 2040, measured in green light (a band of 75 nm about 514 nm). Molecules
    and particles were measured together: do not add the scattering of sea water. There are no measurements below 0.17
    degree, in the harbour below 0.09, where the report extrapolates with a power law.

    With this interpolation the tables integrate to 0.0372, 0.2189 and 1.820 1/m; the report's own sums are 0.0373,
    0.2193 and 1.824. Mean cosines are 0.871, 0.947 and 0.920, and bb/b is 0.0442, 0.0134 and 0.0200.
    """
    if name not in PETZOLD_WATERS:
        raise UserError(f"name = {name!r} must be one of {', '.join(PETZOLD_WATERS)}")
    columns = read_columns("petzold_waters.csv")
    return log_log_phase(columns[0], columns[1 + list(PETZOLD_WATERS).index(name)])
