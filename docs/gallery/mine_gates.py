"""A mine in a gated camera
========================

A camera whose shutter opens for 5 ns sees one slice of the water at a time. The shipped scene ``gated_mine`` has a
sphere of 1 m diameter at 6 m, and a plate on rippled sand at 8 m.
"""

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar

# %%
# 32x32 pixels instead of 128x128, and few passes: the images' grain is the render's error.

stack = mitransient_lidar.render("gated_mine", params={"layout": "32x32"}, passes=4, pass_share=1 / 2, seed=1)
print("dimensions:", dict(stack.sizes))
error = (stack.gate_energy_stderr / stack.gate_energy).where(stack.gate_energy > 0)
print(f"standard error of a pixel in a gate (median): {100 * float(error.median()):.0f} %")

# %%
# Five gates with increasing depth on one scale, and the depth of each pixel's strongest echo.

depths = stack.gate_depth.values
numbers = [int(np.abs(depths - depth).argmin()) for depth in (5.2, 5.8, 6.6, 7.4, 8.0)]
energy = 1e15 * stack.gate_energy
half = 0.5 * float(stack.attrs["scene.field_of_view_mrad"])
figure, axes = plt.subplots(2, 3, figsize=(7, 5), sharex=True, sharey=True, layout="constrained")
for axis, number in zip(axes.flat, numbers, strict=False):
    image = axis.imshow(
        energy.isel(gate=number), extent=(half, -half, -half, half), vmin=0, vmax=np.quantile(energy, 0.99)
    )
    axis.set_title(f"gate at {depths[number]:.1f} m", fontsize="medium")
figure.colorbar(image, ax=axes[0, :], label="energy (fJ)")
found = mitransient_lidar.depth_image(stack)
depth = np.where(found.confidence > 0.99, found.depth, np.nan)
image = axes[1, 2].imshow(depth, extent=(half, -half, -half, half), cmap="cividis_r")
axes[1, 2].set_title("echo depth, white: none", fontsize="medium")
figure.colorbar(image, ax=axes[1, :], label="depth (m)")
figure.supxlabel("to the left (mrad)", fontsize="medium")
figure.supylabel("away from nadir (mrad)", fontsize="medium")
plt.show()

print(f"shallowest echo {np.nanmin(depth):.2f} m, median {np.nanmedian(depth):.2f} m")

# %%
# **What to see.** Gates before the sphere show its top, then its disc in front of dark water. At 6.6 m only water is
# visible. Deeper gates open on the plate (left), then on the sand, on which the sphere is a shadow. The depth image
# shows the sphere's top at 5.5 m and the plate just above the sand. Some pixels at the edge, which the beam hardly
# lights, have no depth (white).
