"""The sea by daylight
===================

Sun and sky shine through the same sea, into the same receiver. ``render_passive`` renders their radiance. With the
width of a filter it also gives the background power on the lidar's detector.
"""

import matplotlib.pyplot as plt
import numpy as np

from mitransient_lidar import render_passive
from mitransient_lidar.plots.drawing import plain_logarithms

# %%
# ``passive_sea`` looks 35 degrees off nadir at a bottom 8 m deep, with a white plate and a dark sphere. The sun stands
# 40 degrees from the vertical, ahead and to the left. 40x40 pixels.

image = render_passive("passive_sea", {"layout": "40x40"}, passes=8, seed=1, filter_width_nm=1.0)
error = float((image.radiance_stderr / image.radiance).median())
power = float(image.background_power.sum())
print(
    f"radiance {1e3 * float(image.radiance.mean()):.1f} mW/(m^2 sr nm), standard error of a pixel {100 * error:.0f} %"
)
print(f"background in a filter of 1 nm: {1e6 * power:.1f} µW in all pixels")

# %%
# Glitter is several times brighter than the water: the scale is logarithmic.

half = 0.5 * float(image.attrs["scene.field_of_view_mrad"])
figure, axis = plt.subplots(figsize=(6, 5), layout="constrained")
drawn = axis.imshow(1e3 * image.radiance, extent=(half, -half, -half, half), cmap="gray", norm="log")
axis.set(xlabel="to the left (mrad)", ylabel="away from nadir (mrad)")
bar = figure.colorbar(drawn, label="radiance (mW m⁻² sr⁻¹ nm⁻¹), logarithmic")
plain_logarithms(bar.long_axis)
plt.show()

row, column = np.unravel_index(np.argmax(image.radiance.values), image.radiance.shape)
print(f"brightest pixel: {1e3 * float(image.radiance[row, column]):.0f} mW/(m^2 sr nm) in row {row}, column {column}")

# %%
# **What to see.** Left of the centre, the plate shines through 8 m of water. Right of it, the sphere and its shadow by
# the sun are dark. Near the left and lower edges waves mirror the sun, which stands on the left: single pixels are up
# to four times brighter than the water.
