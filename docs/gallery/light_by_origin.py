"""Light by its origin
===================

Which part of a waveform is surface, water, target or bottom? With ``components`` a render keeps them apart: each path
counts where the light was last turned.
"""

import matplotlib.pyplot as plt

import mitransient_lidar

# %%
# A 1.5 m target at 8 m, in the published scene with 2x2 pixels, here with one.

shot = mitransient_lidar.render(
    "fig13_2x2", params={"layout": "1x1", "spectrum": "flat"}, components=True, passes=8, pass_share=1 / 8, seed=1
)

parts = shot.waveform_by_origin.isel(pixel=0)
figure, axis = plt.subplots(figsize=(7, 3.6), layout="constrained")
axis.semilogy(shot.time, 1e6 * shot.waveform.isel(pixel=0), color="k", linewidth=2, label="all")
for origin in parts.origin.values:
    one = parts.sel(origin=origin)
    axis.semilogy(shot.time, 1e6 * one.where(one > 0), label=str(origin))
axis.set(xlabel="time (ns)", ylabel="power (µW)", ylim=(1e-3, 500), xlim=(1395, 1590))
axis.legend(frameon=False)
plt.show()

energy = shot.impulse_response_by_origin.sum(("pixel", "time"))
total = float(shot.impulse_response.sum())
for origin in energy.origin.values:
    print(f"{origin}: {100 * float(energy.sel(origin=origin)) / total:.1f} % of the energy")
print(f"sum of the parts over all: {float(energy.sum()) / total:.6f}")

# %%
# **What to see.** The surface echo is lower than the water's light that begins at the same time. The target echo stands
# on the water column; behind it, rare paths make a noisy tail. The water's light ends at the bottom. The bottom's light
# arrives until long after its echo, scattered on its way.
