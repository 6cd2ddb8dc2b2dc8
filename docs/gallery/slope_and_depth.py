"""Slopes of waves, and depths through them
========================================

Waves tilt the surface under each shot: the beam is refracted elsewhere, and the four pixels receive the surface echo at
other times. ``retrieve`` estimates slope and height of the surface from the pixels, and corrects the depth.
"""

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar

# %%
# Random places on one sea at 6 m/s, seen with 2x2 pixels. ``render_shots`` renders them together and adds the truth.

shots = mitransient_lidar.render_shots(
    "fig09_2x2",
    {"wind_speed": 6, "bottom_depth": 5, "field_of_view_mrad": 15},
    count=24,
    passes=4,
    pass_share=1 / 16,
    seed=3,
)
found = mitransient_lidar.retrieve(shots)

# %%
# Estimates against the truth: slope along the line of sight, and depth below the mean sea level.

depth, stated = found.depth_m, found.depth_m_stderr
truth = shots.true_bottom_depth
for correction in ("level", "slope"):
    error = 100 * (depth.sel(correction=correction) - truth)
    print(f"{correction}: mean error {float(error.mean()):+.1f} cm, rms {float((error**2).mean() ** 0.5):.1f} cm")
known = np.isfinite(found.slope_along)
correlation = np.corrcoef(found.slope_along[known], shots.true_slope_along[known])[0, 1]
print(f"slope along: correlation with the truth {correlation:.2f} over {int(known.sum())} shots")

figure, (left, right) = plt.subplots(1, 2, figsize=(7, 3.4), layout="constrained")
left.errorbar(shots.true_slope_along, found.slope_along, found.slope_along_stderr, fmt="o", markersize=4, linewidth=0.8)
left.axline((0, 0), slope=1, color="0.6", linestyle="--")
left.set(xlabel="true slope along", ylabel="retrieved slope along")
for correction, marker in (("level", "s"), ("slope", "o")):
    one = depth.sel(correction=correction)
    right.errorbar(
        shots.true_slope_along,
        100 * (one - truth),
        100 * stated.sel(correction=correction),
        fmt=marker,
        markersize=4,
        linewidth=0.8,
        label=correction,
    )
right.axhline(0, color="0.6", linestyle="--")
right.set(xlabel="true slope along", ylabel="error of the depth (cm)")
right.legend(frameon=False, title="correction")
plt.show()

# %%
# **What to see.** The retrieved slopes follow the true slopes, which are averages over the beam's footprint. Depths
# through a level sea at its mean height (squares) scatter with the waves. Corrected by the sea's slope and height
# (circles) they scatter less. They lie some centimetres too deep, as scattered light arrives late. Bars are stated
# standard errors.
