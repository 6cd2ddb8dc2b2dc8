"""Measured slope variances of the sea."""

from __future__ import annotations

from mitransient_lidar.core.validation import in_range

#: Largest wind speed of all models of the sea [m/s].
MAX_WIND_SPEED = 30.0


def cox_munk(wind_speed: float) -> tuple[float, float]:
    """Slope variances of a clean sea after Cox and Munk.

    Parameters
    ----------
    wind_speed : float
        Wind speed [m/s], 0 to 30. Measured between 1 and 14 m/s, at a height of 12.5 m; extrapolated linearly. The
        difference from the wind at 10 m is below their error.

    Returns
    -------
    upwind, crosswind : float
        Slope variances [1]. At zero wind the regression gives 0.003 crosswind.

    Notes
    -----
    Cox and Munk (1954), J. Opt. Soc. Am. 44, 838, doi:10.1364/JOSA.44.000838: 3.16e-3 W and 0.003 + 1.92e-3 W.
    """
    wind = in_range("wind_speed", wind_speed, 0, MAX_WIND_SPEED)
    return 3.16e-3 * wind, 0.003 + 1.92e-3 * wind
