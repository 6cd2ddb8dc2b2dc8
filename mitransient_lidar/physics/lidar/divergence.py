"""Definitions of beam divergence."""

from __future__ import annotations

import math

from mitransient_lidar.core.parameters.fields import Read

#: Ratio of each definition's full width to a Gaussian beam's e^-1/2 full width (2 sigma).
WIDTHS = {"divergence_mrad": 1.0, "divergence_fwhm_mrad": math.sqrt(2 * math.log(2)), "divergence_1e2_mrad": 2.0}


def read_divergence(read: Read, is_top_hat: bool = False) -> float | None:
    """Read a beam's divergence from one of its three parameters.

    Parameters
    ----------
    read
        Reader of the plugin parameters.
    is_top_hat
        Whether the irradiance is even up to the beam's edge instead of Gaussian.

    Returns
    -------
    float or None
        Full angle [rad] between the points where the irradiance has fallen to e^-1/2 of its peak; None if no parameter
        is given.

    Raises
    ------
    UserError
        If the value is out of range.

    Notes
    -----
    A Gaussian exp(-r^2/(2 sigma^2)) has fallen to e^-1/2, to a half and to e^-2 at diameters of 2 sigma, 2 sqrt(2 ln 2)
    sigma = 2.355 sigma and 4 sigma. A top-hat beam has its full irradiance up to its edge and none beyond: all three
    are its full angle.
    """
    given = read.given(*WIDTHS)
    return 1e-3 * read(given[0]) / (1.0 if is_top_hat else WIDTHS[given[0]]) if given else None
