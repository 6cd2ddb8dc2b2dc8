"""Results of given waveforms."""

import numpy as np

from mitransient_lidar import results
from mitransient_lidar.physics.lidar.time_axis import TimeAxis


def made(power, stderr=0.0, *, start=1400.0, step=0.5, names=None, centres=None, grid=None, **attributes):
    """Return a result of powers and their standard errors [W], shape (pixel, time), in bins from a start on [ns]."""
    power = np.asarray(power, dtype=np.float64)
    stderr = np.broadcast_to(np.asarray(stderr, dtype=np.float64), power.shape)
    return results.build(
        *(1e-9 * step * power, 1e-9 * step * stderr, power, stderr),
        time=TimeAxis(start, step, power.shape[1]),
        pixel_names=[] if grid else names or [f"p{i}" for i in range(len(power))],
        pixel_centres_mrad=np.zeros((len(power), 2)) if centres is None else centres,
        grid=grid,
        attributes=attributes,
    )
