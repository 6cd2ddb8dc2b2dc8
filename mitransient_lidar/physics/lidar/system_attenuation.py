"""Lidar system attenuation: the decay of the column signal, between beam and diffuse attenuation."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, non_negative_array

SPOT_COEFFICIENT = 0.85
"""Rate at which the system attenuation falls from c to Kd with the spot diameter in attenuation lengths."""


def system_attenuation(attenuation: npt.ArrayLike, kd: npt.ArrayLike, spot_diameter: npt.ArrayLike) -> FloatArray:
    """One-way attenuation coefficient of a lidar's column signal.

    Parameters
    ----------
    attenuation : array_like
        Beam attenuation coefficient c [1/m], at least `kd`.
    kd : array_like
        Diffuse attenuation coefficient Kd of downwelling irradiance [1/m], at least 0.
    spot_diameter : array_like
        Diameter D of the spot on the sea surface that the lidar illuminates and views [m], at least 0.

    Returns
    -------
    ndarray
        K = Kd + (c - Kd) exp(-0.85 c D) [1/m], in the broadcast shape of the parameters. Without its geometric factors
        the signal is proportional to exp(-2 K s) with the distance s in the water.

    Notes
    -----
    Gordon (1982), Appl. Opt. 21, 2996, doi:10.1364/AO.21.002996, solved the transfer by Monte Carlo for a level sea.
    The signal decays exponentially over four attenuation lengths. It decays with c where the radius R of the spot in
    view is far below 1/c, and with Kd where c R is above 5 to 6. Between them K depends on c and the whole volume
    scattering function. The formula is a fit by which later authors represent such results, such as Churnside (2013),
    Opt. Eng. 53, 051405, doi:10.1117/1.OE.53.5.051405, eq. 5. It uses the spot's diameter and therefore reaches Kd to
    within 1 % of c - Kd at c R = 2.7 already.

    The result is an order of magnitude. The formula does not distinguish the field of view from the beam. Nor is Kd a
    strict limit: by Phillips and Koerber (1984), Aust. J. Phys. 37, 75, the signal in a large field of view decays with
    the absorption coefficient, which is below Kd.
    """
    c, diffuse, diameter = np.broadcast_arrays(
        non_negative_array("attenuation", attenuation),
        non_negative_array("kd", kd),
        non_negative_array("spot_diameter", spot_diameter),
    )
    if np.any(diffuse > c):
        worst = np.argmax(diffuse - c)
        raise UserError(f"kd = {diffuse.flat[worst]:g} must not exceed attenuation = {c.flat[worst]:g}")
    return np.asarray(diffuse + (c - diffuse) * np.exp(-SPOT_COEFFICIENT * c * diameter))
