"""One, two by two and four pixels
===============================

The published multipixel model compares three receivers behind the same aperture: one pixel, a square of 2x2, and four
strips across the range direction (1x4). The field of view of 30 mrad is the same circle in all of them.
"""

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar
from mitransient_lidar.plots.palette import pixel_colours

# %%
# A layout is one scene parameter. All three renders have the same sea, with 3 m/s wind, and the same passes: eight,
# each with a sixteenth of the usual paths.

shots = {
    layout: mitransient_lidar.render("table1", params={"layout": layout}, passes=8, pass_share=1 / 16, seed=1)
    for layout in ("1x1", "2x2", "1x4")
}

# %%
# Pixel 0 (red) is far and left, 1 (green) far and right, 2 (blue) and 3 (black) near; of the strips, 0 is the farthest.

figure, axes = plt.subplots(1, 3, figsize=(7, 3), sharey=True, layout="constrained")
for axis, (layout, shot) in zip(axes, shots.items(), strict=True):
    for pixel, colour in zip(shot.pixel.values, pixel_colours(shot.sizes["pixel"]), strict=True):
        axis.semilogy(shot.time, 1e6 * shot.waveform.sel(pixel=pixel), color=colour, label=str(pixel), linewidth=1)
    axis.set(title=layout, xlabel="time (ns)", xlim=(1405, 1520), ylim=(0.1, 500))
    axis.legend(frameon=False, fontsize="small", loc="lower center")
axes[0].set_ylabel("power (µW)")
plt.show()

# %%
# The pixels share one circle, so that their energies add up to the single pixel's energy, within both renders' errors.
# Pixel errors are added, as one render's pixels share their photons.

single = shots["1x1"].impulse_response
for layout in ("2x2", "1x4"):
    energy = shots[layout].impulse_response.sum("pixel")
    share = shots[layout].impulse_response.sum("time") / energy.sum("time")
    ratio = float(energy.sum() / single.sum())
    print(f"{layout}: sum over single pixel {ratio:.3f}, shares of the pixels {np.round(share.values, 3)}")
    peak = shots[layout].waveform.sel(time=slice(1480, None)).idxmax("time")
    print(f"    highest bins of the bottom echo (ns): {peak.values}")

# %%
# **What to see.** Near pixels (blue, black) receive surface and bottom before the far pixels: their range is shorter.
# The strips separate the bottom echoes further than the squares, and the outer strips, which are smaller, receive less.
# The single pixel has the sum of all, and its bottom echo rises longer.
