"""Reflectance of bottoms by name."""

from __future__ import annotations

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import in_range, is_number, shown
from mitransient_lidar.physics.water.data_tables import read_columns

#: Names in the order of the columns of the table.
NAMES = ("coral_sand", "green_algae", "brown_algae", "red_algae")

#: Wavelengths of the table [nm].
WAVELENGTH_RANGE = (400.0, 700.0)


def bottom_reflectance(name: str, value: object, wavelength_nm: float = 532.0) -> float:
    """Return the reflectance of a bottom given as a number or by its name.

    Parameters
    ----------
    name
        Name of the parameter, for messages.
    value
        Number from 0 to 1, or its text, or one of `NAMES`.
    wavelength_nm
        Wavelength of a bottom by name [nm], 400 to 700.

    Returns
    -------
    float
        Reflectance, 0 to 1; for a name linear between the values of the table, 10 nm apart.

    Raises
    ------
    UserError
        If the value is none of these, or a number lies outside its range.

    Notes
    -----
    Reflectance of irradiance by clean coral sand, the green alga Boodlea, brown algae (mean of Turbinaria and
    Sargassum) and red algae (mean of Porolithon and Corallinaceae), from figure 6 of Maritorena, Morel and Gentili
    (1994), Limnol. Oceanogr. 39, 1689, doi:10.4319/lo.1994.39.7.1689. Single samples: other sands and algae differ by
    factors.
    """
    if not isinstance(value, str) or is_number(value):
        return in_range(name, value, 0.0, 1.0)
    if value not in NAMES:
        raise UserError(f"{name} = {shown(value)} must be a number from 0 to 1, or one of {', '.join(NAMES)}")
    wavelength = in_range("wavelength_nm", wavelength_nm, *WAVELENGTH_RANGE)
    wavelengths, *reflectances = read_columns("bottom_reflectance.csv")
    return float(np.interp(wavelength, wavelengths, reflectances[NAMES.index(value)]))
