"""Layers of the water
===================

Where the water changes with depth, so does the slope of the waveform. Pixels that each see a part of the footprint
show the step within a shorter time than one pixel that sees all of it.
"""

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar
from mitransient_lidar.plots.palette import pixel_colours

# %%
# The published case: c = 0.9 1/m down to 3 m, and 0.5 1/m below it.

options = {"passes": 8, "pass_share": 1 / 8, "seed": 1}
flat = {"spectrum": "flat"}
single = mitransient_lidar.render("fig15_1x1", params=flat, **options)
four = mitransient_lidar.render("fig15_2x2", params=flat, **options)

# %%
# Local attenuation along the path: minus half the log power's derivative by the path in the water.

SPEED = 0.299792458 / float(four.attrs["scene.group_index"])  # of light in the water, m/ns


def local_attenuation(waveform):
    """Return the attenuation [1/m] of a waveform over time, from differences over 4 ns."""
    lit = waveform.sel(time=slice(1420, 1485))
    smooth = np.log(lit.rolling(time=3, center=True).mean())
    return -smooth.differentiate("time") / SPEED


figure, (upper, lower) = plt.subplots(2, 1, figsize=(7, 5.5), sharex=True, layout="constrained")
curves = [("1x1", single.waveform.isel(pixel=0), "0.5")]
curves += [
    (name, four.waveform.sel(pixel=name), colour)
    for name, colour in zip(four.pixel.values, pixel_colours(4), strict=True)
]
for name, waveform, colour in curves:
    upper.semilogy(waveform.time, 1e6 * waveform, color=colour, label=name)
    decay = local_attenuation(waveform)
    lower.plot(decay.time, decay, color=colour)
    step = float(decay.sel(time=slice(1438, 1462)).idxmax("time"))
    print(f"{name}: decay {float(decay.sel(time=1435, method='nearest')):.2f} 1/m above, fastest at {step:.1f} ns")
upper.set(ylabel="power (µW)", ylim=(0.1, 500))
upper.legend(frameon=False, ncols=5)
lower.set(xlabel="time (ns)", ylabel="decay of the power (1/m)", xlim=(1425, 1480), ylim=(0.2, 0.8))
plt.show()

# %%
# **What to see.** Above and below the boundary the power decays evenly, below more slowly. At the boundary it falls to
# half, as the lower water scatters less. The decay then has a peak: first in the near pixels (blue, black), four
# nanoseconds later in the far pixels. The single pixel's peak lies between, and is lower and wider.
