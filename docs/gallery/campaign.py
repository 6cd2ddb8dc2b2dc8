"""A campaign of labelled waveforms
================================

A campaign renders a scene with many values of its parameters into one store, which trains a classifier or
tests a method. This one has 8 runs; the same lines make a hundred thousand, on a laptop or a cluster.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar

# %%
# Parameters that vary are ranges, lists or expressions with others; ``fixed`` has the others. A receiver records each
# run, and the echoes are sought in its noisy signal.

CAMPAIGN = {
    "scene": "table1",
    "target_error": 0.2,
    "keep": ["waveform", "echoes", "truth"],
    "receiver": "apd",
    "gain": "auto",
    "fixed": {"layout": "1x1", "spectrum": "flat"},
    "parameters": {
        "bottom_depth": {"low": 2.0, "high": 14.0},
        "attenuation": {"low": 0.15, "high": 1.0, "scale": "log"},
        "scattering": "0.6 * attenuation",
        "backscattering": "0.02 * scattering",
    },
    "design": {"kind": "sobol", "count": 8, "seed": 1},
}

# %%
# Runs are rendered by processes, as many at a time as there are workers.

with tempfile.TemporaryDirectory() as folder:
    data = mitransient_lidar.campaign(CAMPAIGN, Path(folder) / "bottoms.zarr", workers=1).load()
bottom = data.sel(echo="bottom").isel(pixel=0)
error = bottom.echo_depth_m - bottom.true_bottom_depth
stated = np.hypot(bottom.echo_depth_m_stderr, bottom.echo_depth_m_method_error)
optical = bottom.attenuation * bottom.bottom_depth
print(f"{data.sizes['run']} runs, {int(np.isfinite(error).sum())} bottoms found")
print(f"error of the depths found: median {100 * float(error.median()):+.1f} cm")

figure, (left, right) = plt.subplots(1, 2, figsize=(7, 3.4), layout="constrained")
for run in range(4):
    one = data.isel(run=run, pixel=0)
    label = f"{float(one.bottom_depth):.1f} m, c = {float(one.attenuation):.2f} /m"
    left.semilogy(one.time, 1e6 * one.waveform.where(one.waveform > 0), label=label, linewidth=1)
left.set(xlabel="time (ns)", ylabel="power (µW)", xlim=(1400, 1580), ylim=(0.1, 5000))
left.legend(frameon=False, fontsize="small")
right.errorbar(optical, 100 * error, 100 * stated, fmt="o")
right.axhline(0, color="0.6", linestyle="--")
right.set(xlabel="attenuation times depth", ylabel="error of the depth (cm)")
plt.show()

# %%
# **What to see.** Left, four campaign runs: deep bottoms in turbid water are weak. Right, what the shipped detector
# finds in all records: most depths are some centimetres to a decimetre too deep, as scattered light arrives late. Bars
# are the stated errors, one standard deviation of noise and method.
