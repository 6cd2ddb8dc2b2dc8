"""From clear to turbid water
==========================

Jerlov's types order waters by their clarity. The same lidar and bottom in three of them, and the attenuation that the
column shows in each.
"""

import matplotlib.pyplot as plt

import mitransient_lidar

# %%
# ``jerlov`` stands for all coefficients of the water; ``mitransient-lidar scenes water jerlov 1C`` prints them.

options = {"passes": 8, "pass_share": 1 / 16, "seed": 1}
shots = {
    water: mitransient_lidar.render("table1", params={"jerlov": water, "spectrum": "flat"}, **options)
    for water in ("IB", "1C", "5C")
}

# %%
# ``retrieve`` finds absorption and backscattering from the column of the summed pixels.

figure, axis = plt.subplots(figsize=(7, 3.6), layout="constrained")
for water, shot in shots.items():
    total = shot.waveform.sum("pixel")
    axis.semilogy(shot.time, 1e6 * total, label=f"Jerlov {water}")
    found = mitransient_lidar.retrieve(shot)
    estimate, error = float(found.absorption), float(found.absorption_stderr)
    truth = mitransient_lidar.water_of("jerlov", water).absorption
    print(f"{water}: absorption {estimate:.3f} +- {error:.3f} 1/m, truth {truth:.3f}")
axis.set(xlabel="time (ns)", ylabel="power of all pixels (µW)", xlim=(1405, 1520), ylim=(0.1, 3000))
axis.legend(frameon=False)
plt.show()

# %%
# **What to see.** More turbid water is brighter just below the surface and decays faster: the curves cross. The bottom
# echo at 8 m is more than a hundred times higher in IB than in 5C, where it hardly rises above the water.
