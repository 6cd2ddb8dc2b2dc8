"""Counting photons
================

A photon counter that is dead for some nanoseconds after each event sees the first photons of a shot best. The counts of
many shots then show too early and too weak an echo.
"""

import matplotlib.pyplot as plt

import mitransient_lidar

# %%
# One pixel over 5 m of water. A filter before the counter leaves a share of the light: here two optical densities.

shot = mitransient_lidar.render(
    "table1",
    params={"layout": "1x1", "spectrum": "flat", "bottom_depth": 5, "pulse_fwhm_ns": 2, "bin_width_ns": 0.5},
    passes=8,
    pass_share=1 / 8,
    seed=1,
)

# %%
# ``record`` draws the counts of single shots; their mean, dead time included, is also known in closed form.

SHOTS = 1000
records = {density: mitransient_lidar.record(shot, "spad", SHOTS, 1, optical_density=density) for density in (4, 6)}

figure, axes = plt.subplots(2, 1, figsize=(7, 5), sharex=True, layout="constrained")
for axis, (density, record) in zip(axes, records.items(), strict=True):
    counts = record.signal.isel(pixel=0).mean("shot")
    expected = record.signal_mean.isel(pixel=0)
    axis.step(record.time, counts, where="mid", color="0.6", label=f"mean of {SHOTS} shots")
    axis.plot(record.time, expected, color="C0", linewidth=1, label="closed form")
    axis.set(ylabel="counts a bin", title=f"optical density {density}")
    print(f"density {density}: {float(counts.sum()):.2f} counts a shot, in closed form {float(expected.sum()):.2f}")
    late = {"light": shot.waveform.isel(pixel=0), "counts": expected}
    peaks = {name: float(one.sel(time=slice(1455, 1470)).idxmax("time")) for name, one in late.items()}
    print(f"    peak at the bottom: light {peaks['light']:.2f} ns, counts {peaks['counts']:.2f} ns")
axes[1].set(xlabel="time (ns)", xlim=(1405, 1490))
axes[1].legend(frameon=False)
plt.show()

# %%
# **What to see.** Through the weaker filter every shot's first photon comes with the first surface light. The counter
# is then dead for 30 ns, counts once more in the column, and again 30 ns later. These three groups show the dead time
# and not the sea. Through the stronger filter, surface and bottom are two peaks, with few counts after the surface, as
# many shots have just counted it. The bottom is still too early, since the first photon of its echo counts.
