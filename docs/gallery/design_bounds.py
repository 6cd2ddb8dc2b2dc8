"""Comparing receivers by Cramér–Rao bounds
========================================

The Cramér–Rao bound is the smallest standard deviation that any unbiased estimate from one shot can have. It compares
designs without an estimator.
"""

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar

# %%
# Water and bottom of ``table1`` from an avalanche photodiode behind each pixel: one pixel, 2x2, or four strips.

NAMES = ["attenuation", "scattering", "bottom_reflectance"]
found = mitransient_lidar.bounds(
    "table1",
    {"spectrum": "flat"},
    free=NAMES,
    over={"layout": ["1x1", "2x2", "1x4"]},
    receiver="apd",
    gain="auto",
    renders=2,
    passes=2,
    seed=1,
)

# %%
# Bounds relative to the bounds of the single pixel.

figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
place = np.arange(len(NAMES))
for number, design in enumerate(found.design.values):
    axis.bar(place + 0.25 * (number - 1), found.ratio.sel(design=design), 0.22, label=design)
    bounds = found.bound.sel(design=design)
    print(f"{design}:", ", ".join(f"{name} {float(bounds.sel(parameter=name)):.2g}" for name in NAMES))
axis.set_xticks(place, NAMES)
axis.set_ylabel("bound over that of one pixel")
axis.legend(frameon=False, ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.15))
plt.show()

# %%
# **What to see.** The strips across the range determine attenuation and scattering better than 2x2 pixels, and 2x2
# pixels better than one pixel. For the bottom reflectance the layout matters little.
