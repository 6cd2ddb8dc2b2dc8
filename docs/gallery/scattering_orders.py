"""Light by its number of scatterings
==================================

Many lidar equations assume that each echo is scattered once. In turbid water most of the light has been scattered
several times: by small angles, and once by a large angle.
"""

import matplotlib.pyplot as plt

import mitransient_lidar

# %%
# Turbid water with c = 0.9 1/m and b = 0.7 1/m over a bottom at 6 m, in one 30 mrad pixel.

WATER = {"attenuation": 0.9, "scattering": 0.7, "backscattering": 0.014, "bottom_depth": 6}
found = mitransient_lidar.scattering(
    "table1", {**WATER, "layout": "1x1", "spectrum": "flat"}, orders=6, passes=4, seed=1
)

# %%
# The last order contains all higher orders.

waveform = found.waveform.isel(pixel=0).sum("reversals")
total = waveform.sum("order")
figure, axis = plt.subplots(figsize=(7, 4), layout="constrained")
axis.semilogy(total.time, 1e6 * total, color="k", label="all")
for number, order in enumerate(waveform.order.values):
    last = number == waveform.sizes["order"] - 1
    label = f"{order} or more" if last else str(order)
    one = waveform.isel(order=number)
    axis.semilogy(one.time, 1e6 * one.where(one > 0), label=label, color=plt.cm.viridis(number / 6), linewidth=1.2)
axis.set(xlabel="time (ns)", ylabel="power (µW)", xlim=(1405, 1500), ylim=(1e-2, 500))
axis.legend(frameon=False, title="scatterings", ncols=2, loc="lower center")
plt.show()

for when, name in ((1429, "1 m"), (1458, "4 m"), (1477, "the bottom")):
    shares = 100 * (waveform / total).sel(time=when, method="nearest")
    few, many = float(shares[:2].sum()), float(shares[6])
    print(f"near {name}: orders 0 and 1 have {few:.0f} %, orders above 5 {many:.0f} % of the light")

# %%
# **What to see.** Light without scattering is the surface echo, and a trace of the bottom. Light scattered once is
# the brightest part just below the surface and decays with c; each further order begins later and decays more slowly.
# From 4 m on most light, and four fifths of the bottom echo, have been scattered six times or more. The sum decays far
# more slowly than c.
