"""Fit the water and the bottom to a waveform
==========================================

``fit`` varies parameters of a scene until its waveform matches the measured waveform, by weighted least squares with
the derivatives of the renders. It also states the errors of the parameters.
"""

import matplotlib.pyplot as plt

import mitransient_lidar

# %%
# The measurement is a render's record with receiver noise. Its parameters count as unknown.

SCENE = {"layout": "1x1", "spectrum": "flat"}
TRUTH = {"attenuation": 0.34, "bottom_reflectance": 0.14}
shot = mitransient_lidar.render("table1", params={**SCENE, **TRUTH}, passes=8, seed=3)
data = mitransient_lidar.record(shot, "apd", gain="auto", seed=1)

# %%
# The fit begins at the scene's values, 0.3 1/m and 0.1. It uses few passes here, and states what they add to the
# errors.

fitted = mitransient_lidar.fit(
    data, "table1", list(TRUTH), params=SCENE, start={"attenuation": 0.3, "bottom_reflectance": 0.1}, passes=4
)
for name, truth in TRUTH.items():
    one = fitted.sel(parameter=name)
    print(
        f"{name}: {float(one.value):.4f} +- {float(one.stderr):.4f} ({float(one.stderr_by_model):.4f} by the model)",
        end="",
    )
    print(f", start {float(one.start)}, truth {truth}")
print(f"chi-squared {fitted.chi_squared:.0f}, expected {fitted.expected:.0f}; {fitted.renders} renders")

# %%
one = fitted.isel(pixel=0)
figure, (upper, lower) = plt.subplots(2, 1, figsize=(7, 4.5), sharex=True, height_ratios=(2, 1), layout="constrained")
upper.plot(one.time, 1e3 * one.measured, ".", color="0.6", label="record")
upper.plot(one.time, 1e3 * one.fitted, color="C0", linewidth=1, label="fit")
upper.legend(frameon=False)
upper.set_ylabel("signal (mV)")
lower.axhline(0, color="0.7", linewidth=0.7)
lower.plot(one.time, one.residual, ".", markersize=3)
lower.set(xlabel="time (ns)", ylabel="residual / error")
plt.show()

# %%
# **What to see.** The fit goes through the record from the surface to the bottom, where the residuals are noise, most
# within two standard deviations. Before and after, the noise is less than a digitiser step: the record is constant, and
# so is its difference from the fit.
