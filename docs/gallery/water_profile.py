"""A profile of the water from a file
==================================

A probe that is lowered through the water measures its absorption, attenuation and backscattering against depth. The
file of the cast, a table or NetCDF, is the ``profile`` of a scene; layers that follow it are chosen automatically.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar

# %%
# This example's cast is computed: clear water above, and turbid water below 4.5 m.

depth = np.linspace(0, 12, 49)
turbid = 1 / (1 + np.exp(-(depth - 4.5) / 0.4))
cast = np.column_stack([depth, 0.12 + 0.05 * turbid, 0.25 + 0.45 * turbid, 0.003 + 0.012 * turbid])

with tempfile.TemporaryDirectory() as folder:
    file = Path(folder) / "cast.csv"
    np.savetxt(file, cast, delimiter=",", header="depth_m,a532,c532,bb532", comments="")
    profile = mitransient_lidar.read_profile(file)
    shot = mitransient_lidar.render(
        "table1", params={"profile": file, "spectrum": "flat", "layout": "1x1"}, passes=8, pass_share=1 / 8, seed=1
    )

layers = profile.layers()
print(f"{layers.count} layers; c from {layers.attenuation.min():.2f} to {layers.attenuation.max():.2f} 1/m")

# %%
# Beside the profile (grey: c of the layers) the waveform, against the depth along the axis: its logarithm falls with
# the attenuation, and rises with the backscattering.

figure, (left, right) = plt.subplots(1, 2, figsize=(7, 4), sharey=True, layout="constrained")
tops = [*layers.layer_tops, 12]
left.stairs(layers.attenuation, tops, orientation="horizontal", baseline=None, color="0.75", linewidth=5)
left.plot(profile.attenuation, profile.depth, label="c, attenuation")
left.plot(profile.absorption, profile.depth, label="a, absorption")
left.plot(10 * profile.backscattering, profile.depth, label="10 bb, backscattering")
left.set(xlabel="coefficient (1/m)", ylabel="depth (m)", ylim=(10, -1))
left.legend(frameon=False, fontsize="small")
pixel = shot.isel(pixel=0)
right.semilogx(1e6 * pixel.waveform, (pixel.time - pixel.surface_time) * pixel.depth_per_ns)
right.set(xlabel="power (µW)", xlim=(1, 500))
plt.show()

# %%
# **What to see.** The backscatter rises between 3 and 5 m, where the turbid water begins, and then falls more steeply
# than above. The bottom echo at 8 m follows. The layers (grey) follow the profile. The 5 ns pulse, and the 10 mrad beam
# at 20 degrees, make the waveform rise longer than the profile.
