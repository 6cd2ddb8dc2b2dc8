"""Sensitivity of a waveform to water and bottom
=============================================

A render can differentiate every bin with respect to scene parameters, from the same paths. If the derivatives differ in
shape, a record can determine the parameters separately.
"""

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar

# %%
# Attenuation c, scattering b and backscattering bb, each with the other two held fixed, and the bottom reflectance.

NAMES = ["attenuation", "scattering", "backscattering", "bottom_reflectance"]
shot = mitransient_lidar.render(
    "table1", params={"layout": "1x1", "spectrum": "flat"}, derivatives=NAMES, passes=8, pass_share=1 / 8, seed=1
)

# %%
# In percent of the power, for a one percent larger parameter.

power = shot.waveform.isel(pixel=0)
lit = power > 1e-3 * power.max()
figure, (upper, lower) = plt.subplots(2, 1, figsize=(7, 5.5), sharex=True, layout="constrained")
upper.semilogy(power.time, 1e6 * power.where(lit), color="k")
upper.set_ylabel("power (µW)")
for name in NAMES:
    change = shot.waveform_derivative.sel(parameter=name).isel(pixel=0) * float(shot.attrs[f"scene.{name}"]) / power
    lower.plot(power.time, change.where(lit), label=name)
lower.axhline(0, color="0.7", linewidth=0.7)
lower.set(xlabel="time (ns)", ylabel="change (%) for 1 % more", xlim=(1410, 1520))
lower.legend(frameon=False, fontsize="small")
plt.show()

# %%
# A check in closed form: light from the bottom has travelled at least twice the slant path in the water. With the angle
# theta in the water, 1 % more c thus removes about 2 c d / cos(theta) percent of it.

cosine = np.sqrt(1 - (np.sin(np.radians(20)) / 1.34) ** 2)
peak = power.sel(time=slice(1480, None)).idxmax("time")
at_peak = (shot.waveform_derivative.isel(pixel=0) / power).sel(time=peak)
print(f"1 % more attenuation at the bottom: {0.3 * float(at_peak.sel(parameter='attenuation')):+.2f} %")
print(f"by the slant path alone: {-2 * 0.3 * 8 / cosine:+.2f} %")

# %%
# **What to see.** Attenuation removes more light the later it arrives. Scattering at fixed c replaces absorption:
# forward-scattered light stays in view. Backscattering raises the whole column and weakens the bottom echo a little.
# Only the bottom echo depends on the reflectance. The four curves differ in shape: a record can determine the
# parameters separately.
