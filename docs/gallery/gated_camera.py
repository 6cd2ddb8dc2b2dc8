"""Frames of a gated camera
========================

From light to digital numbers: the mine of ``gated_mine``, moored at 9 m over a bottom at 12 m, in frames of the camera
``icmos``. The :doc:`guide </guide/gated_cameras>` has the same steps as commands.
"""

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar

# %%
# Ten 4 ns gates from 8 m on, and 0.5 µJ pulses; 16 passes, so that the light is smoother than the frames.

params = {"target_depth": 9, "target_x": 2.2, "bottom_depth": 12, "pulse_energy_mj": 0.0005, "layout": "32x32"}
params |= {"paths_per_pass": 2**14, "photons_per_pass": 2**14}
gates = {"gate_start_depth": 8, "gate_width_ns": 4, "gate_step_ns": 4, "gate_count": 10}
stack = mitransient_lidar.render("gated_mine", params={**params, **gates}, passes=16, seed=1)
frames = mitransient_lidar.record(stack, "icmos", shots=64, seed=1)
print(f"{frames.sizes['frame']} frames, {frames.signal.dtype}; largest SNR of a pixel: {float(frames.snr.max()):.2f}")

# %%
# The gate with the mine's echo (above) and the gate with its shadow on the sand (below). From left to right: photons
# without noise, one frame, and the mean over all frames.

photon = 6.626e-34 * 2.998e8 / 532e-9  # J
half = 0.5 * float(stack.attrs["scene.field_of_view_mrad"])
figure, axes = plt.subplots(2, 3, figsize=(7, 4.6), sharex=True, sharey=True, layout="constrained")
for row, number in zip(axes, (1, 9), strict=True):
    signal = frames.signal.isel(gate=number) - frames.dark_level
    images = {
        f"photons, gate {number}": stack.gate_energy.isel(gate=number) / photon,
        "one frame (DN)": signal.isel(frame=0),
        "mean of 64 (DN)": signal.mean("frame"),
    }
    for axis, (title, image) in zip(row, images.items(), strict=True):
        high = float(np.quantile(image, 0.995))
        drawn = axis.imshow(image, extent=(half, -half, -half, half), vmin=0, vmax=high, cmap="gray")
        axis.set_title(title, fontsize="medium")
        figure.colorbar(drawn, ax=axis, shrink=0.8)
figure.supxlabel("to the left (mrad)", fontsize="medium")
figure.supylabel("away from nadir (mrad)", fontsize="medium")
plt.show()

# %%
# The probability that the best weighted sum of all pixels and gates shows the mine, with one false alarm in 1000. Few
# paths and renders here: with more, the limits are closer.

few = {**params, **gates, "paths_per_pass": 2**12, "photons_per_pass": 2**12}
found = mitransient_lidar.detect("gated_mine", few, receiver="icmos", renders=3, passes=16, seed=1)
needed = float(found.frames_needed)
print(f"one frame of each gate: P_d = {float(found.detection.sel(frames=1)):.2f}; frames for 0.9: {needed:.0f}")
figure, (left, right) = plt.subplots(1, 2, figsize=(7, 2.8), layout="constrained")
image = left.imshow(
    found.filter_weight.isel(gate=9),
    extent=(half, -half, -half, half),
    cmap="RdBu_r",
    norm=plt.matplotlib.colors.CenteredNorm(),
)
left.set(title="weights in gate 9 (1/DN)", xlabel="to the left (mrad)", ylabel="away from nadir (mrad)")
figure.colorbar(image, ax=left)
right.plot(found.gate_depth, found.gate_detection.sel(adjoining=1), "o-", label="one gate alone")
right.axhline(float(found.detection.sel(frames=1)), color="C1", label="all gates")
right.set(xlabel="middle of the gate (m)", ylabel="probability of detection", ylim=(0, 1.02))
right.legend()
plt.show()

# %%
# **What to see.** A pixel has less than one photoelectron, so that a frame alone is mostly dark. The mean over 64
# frames shows the mine and, deeper, its shadow on the sand. The weights are negative there: the filter counts missing
# light. Thus all gates together detect more than the best single gate.
