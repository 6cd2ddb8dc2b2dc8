"""Results with derivatives of closed-form waveforms, as `render` returns them."""

import numpy as np

from mitransient_lidar import results
from mitransient_lidar.physics.lidar.time_axis import TimeAxis

#: Power of one photon in a bin of 1 ns at 532 nm [W].
PHOTON = 6.62607015e-34 * 299792458 / 532e-9 / 1e-9


def result(waveform, derivatives, *, errors=None, values=None, width=1.0, **attributes):
    """Return a result of powers [W], shape (pixel, time), with derivatives by name, of the same shape.

    `errors` are the standard errors of the derivatives, by name, 0 by default.
    """
    power = np.atleast_2d(np.asarray(waveform, dtype=float))
    pixels, bins = power.shape
    made = results.build(
        1e-9 * width * power,
        np.zeros_like(power),
        power,
        np.zeros_like(power),
        time=TimeAxis(1400.0, width, bins),
        pixel_names=["red", "green", "blue", "black"][:pixels],
        pixel_centres_mrad=np.arange(2 * pixels).reshape(-1, 2),
        attributes={"scene": "made", **attributes},
    )
    names = list(derivatives)
    over = ("parameter", "pixel", "time")
    slopes = np.stack([np.broadcast_to(derivatives[name], power.shape) for name in names])
    spread = np.stack([np.broadcast_to((errors or {}).get(name, 0.0), power.shape) for name in names])
    made = made.assign(waveform_derivative=(over, slopes), waveform_derivative_stderr=(over, spread))
    return made.assign_coords(
        parameter=names,
        parameter_value=("parameter", [float((values or {}).get(name, 1.0)) for name in names]),
        parameter_units=("parameter", ["1/m"] * len(names)),
        parameter_method=("parameter", ["score"] * len(names)),
    )
