"""Attenuation of the column and the field of view
===============================================

A narrow receiver loses light that is scattered even a little: its column decays almost with the beam attenuation c. A
wide receiver keeps this light in view, and its column decays with about the absorption.
"""

import matplotlib.pyplot as plt

import mitransient_lidar

# %%
# A narrow 0.5 mrad beam on level water with c = 0.3 1/m and a = 0.15 1/m. It is nearly without ripples, which would
# refract light out of a narrow view as well.

SCENE = {"divergence_mrad": 0.5, "bottom_depth": 12, "spectrum": "flat", "slope_variance": 2e-5}
found = mitransient_lidar.scattering("table1", SCENE, fov_mrad=[1, 5, 20, 80], passes=4, seed=1)

# %%
# K is half the power's decay along the path in the water.

figure, axis = plt.subplots(figsize=(7, 3.6), layout="constrained")
axis.errorbar(found.scaled_radius, found.effective_attenuation, found.effective_attenuation_stderr, fmt="o-", capsize=3)
axis.axhline(found.attrs["attenuation"], color="0.5", linestyle="--")
axis.axhline(found.attrs["absorption"], color="0.5", linestyle=":")
axis.text(1, found.attrs["attenuation"] + 0.004, "attenuation c", ha="center")
axis.text(1, found.attrs["absorption"] + 0.004, "absorption a", ha="center")
axis.set(
    xscale="log",
    xlabel="c times radius of the spot in view",
    ylabel="attenuation of the column K (1/m)",
    ylim=(0.13, 0.32),
)
plt.show()

for field in found.field_of_view.values:
    one = found.sel(field_of_view=field)
    value, error = float(one.effective_attenuation), float(one.effective_attenuation_stderr)
    print(f"{field:g} mrad: K = {value:.3f} +- {error:.3f} 1/m")

# %%
# **What to see.** The wider the view, the slower the column decays. The decay is close to c where the spot in view is
# much smaller than a scattering length, and nearly the absorption where it is larger.
