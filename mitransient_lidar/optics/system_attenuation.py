"""What the column signal of a lidar decays with: between beam attenuation c and diffuse attenuation Kd."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite_array

SPOT_COEFFICIENT = 0.85
"""How fast the system attenuation falls from c to Kd with the spot's diameter in attenuation lengths."""


def system_attenuation(attenuation: npt.ArrayLike, kd: npt.ArrayLike, spot_diameter: npt.ArrayLike) -> FloatArray:
    """Attenuation coefficient with which a lidar's column signal decays, one way.

    Parameters
    ----------
    attenuation : array_like
        Beam attenuation coefficient c [1/m], at least `kd`.
    kd : array_like
        Diffuse attenuation coefficient Kd of downwelling irradiance [1/m], at least 0.
    spot_diameter : array_like
        Diameter D of the spot on the sea surface that the lidar lights and sees [m], at least 0.

    Returns
    -------
    ndarray
        K = Kd + (c - Kd) exp(-0.85 c D) [1/m], of the broadcast shape of the parameters. Without its geometric
        factors the signal goes as exp(-2 K s) with the distance s in the water.

    Raises
    ------
    ValueError
        If a value is negative or not finite, or kd exceeds attenuation.

    Notes
    -----
    Gordon (1982), Appl. Opt. 21, 2996, doi:10.1364/AO.21.002996, solved the transfer by Monte Carlo for a level sea.
    The signal then decays exponentially over four attenuation lengths, with c where the radius R of the spot that the
    receiver sees is far below 1/c, and with Kd where c R is above 5 to 6; between them, he says, K depends on all of c
    and the volume scattering function. The formula is a fit that later authors use for such results, such as Churnside
    (2013), Opt. Eng. 53, 051405, doi:10.1117/1.OE.53.5.051405, eq. 5. It takes the spot's diameter, and so comes within
    1 % of Kd (of c - Kd, that is) at c R = 2.7 already.

    Use it for an order of magnitude. The field of view and the beam are one spot in it, and Kd is no strict limit
    either: by Phillips and Koerber (1984), Aust. J. Phys. 37, 75, the signal in a large field of view decays with the
    absorption coefficient, which is below Kd.
    """
    c = _non_negative("attenuation", attenuation)
    diffuse = _non_negative("kd", kd)
    diameter = _non_negative("spot_diameter", spot_diameter)
    beam, diffuse, diameter = np.broadcast_arrays(c, diffuse, diameter)
    if np.any(diffuse > beam):
        worst = np.argmax(diffuse - beam)
        raise ValueError(f"kd = {diffuse.flat[worst]:g} must not exceed attenuation = {beam.flat[worst]:g}")
    return np.asarray(diffuse + (beam - diffuse) * np.exp(-SPOT_COEFFICIENT * beam * diameter))


def _non_negative(name: str, values: npt.ArrayLike) -> FloatArray:
    array = finite_array(name, values)
    if np.any(array < 0):
        raise ValueError(f"{name} = {array.min():g} must not be negative")
    return array
