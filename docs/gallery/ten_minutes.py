"""Tutorial: from one shot to an image in ten minutes
==================================================

A laser pulse from an aircraft passes a wavy sea, is reflected by a bottom at 8 m and returns. This tutorial renders
what four pixels receive, records it with a noisy receiver, measures the echoes, retrieves slope, bottom and water
from them, and ends with a gated image.
"""

# %%
# 1. Render
# ---------
#
# ``fig09_2x2`` is a shipped scene, the system in a published study. It sends 5 mJ in 5 ns from 200 m, 20 degrees off
# nadir, at 3 m/s wind, and sees 30 mrad in 2x2 pixels. A render consists of independent passes; their spread gives the
# standard error. With ``target_error=0.01`` instead of ``passes`` it stops at that accuracy.

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar
from mitransient_lidar.plots.palette import pixel_colours
from mitransient_lidar.rendering.shots.truth import SeaMap

shot = mitransient_lidar.render("fig09_2x2", passes=8, seed=1)
print("dimensions:", dict(shot.sizes))
print(f"standard error of a bin (median): {100 * shot.error_median:.1f} %")

# %%
figure, axis = plt.subplots(figsize=(7, 3.6), layout="constrained")
for pixel, colour in zip(shot.pixel.values, pixel_colours(4), strict=True):
    power, error = 1e6 * shot.waveform.sel(pixel=pixel), 1e6 * shot.waveform_stderr.sel(pixel=pixel)
    axis.fill_between(shot.time, power - error, power + error, color=colour, alpha=0.3, linewidth=0)
    axis.semilogy(shot.time, power, color=colour, linewidth=1, label=str(pixel))
axis.set(xlabel="time (ns)", ylabel="power (µW)", xlim=(1400, 1525), ylim=(1e-2, 300))
axis.legend(frameon=False)
plt.show()

# %%
# From left to right: the surface comes first; the near pixels (blue, black) receive it 4 ns before the far pixels, as
# their range is shorter. It is no spike. At this angle few facets reflect to the lidar, and the weak surface echo
# merges with the water's backscatter behind it. The straight line is the water column, steeper with more attenuation.
# At 8 m the bottom echo rises above it. Bands of one standard error are drawn, too thin to see before the last
# nanoseconds.
#
# 2. Receive
# ----------
#
# The power so far has only the errors of rendering. A receiver turns it into a voltage: photons, gain, amplifier,
# digitiser. Seven chains have names, and each instrument has its own; here are 200 shots with an avalanche photodiode.
# **All shots are at the same frozen sea:** they differ only in noise.

recorded = mitransient_lidar.record(shot, "apd", shots=200, seed=1)
print(f"at the limit of the amplifier: {100 * float(recorded.saturated.mean()):.0f} % of the samples")

# %%
# Always check ``saturated`` first. Microwatts are too much for a gain of 150, and the signal from surface to bottom is
# clipped. A filter of optical density 1.7, which transmits 2 %, helps; light is linear, so nothing needs to be rendered
# again.

recorded = mitransient_lidar.record(shot, "apd", shots=200, seed=1, optical_density=1.7)
print(f"at the limit of the amplifier: {100 * float(recorded.saturated.mean()):.0f} % of the samples")
snr = recorded.snr.sel(time=slice(1485, 1510)).max("time")
print(f"signal-to-noise ratio at the bottom: {snr.values.round(1)}")

# %%
red = recorded.sel(pixel="red")
figure, (left, right) = plt.subplots(1, 2, figsize=(7, 3), layout="constrained")
left.plot(red.time, 1e3 * red.signal.isel(shot=0), color="0.6", label="one shot")
left.plot(red.time, 1e3 * red.signal_mean, color="C0", linewidth=1, label="mean in closed form")
left.set(xlabel="time (ns)", ylabel="signal of pixel red (mV)")
left.legend(frameon=False)
right.plot(red.time, red.snr, color="C0")
right.set(xlabel="time (ns)", ylabel="signal-to-noise ratio of one shot")
plt.show()

# %%
# The noise is largest where the signal is: it is shot noise, increased by the multiplication. The ratio therefore grows
# with the square root of the light. The mean of n shots has sqrt(n) times this ratio while the sea does not change.
#
# 3. Measure the echoes
# ---------------------
#
# ``echoes`` returns surface, column, target and bottom echoes for every pixel and shot. They have time, depth,
# amplitude, energy and width with their errors, and flags (0 without a problem). It also returns the column's
# attenuation.

echoes = mitransient_lidar.echoes(recorded)
first = echoes.isel(shot=0).sel(echo=["surface", "bottom"])
columns = ["time_ns", "time_ns_stderr", "depth_m", "depth_m_stderr", "width_ns", "flags"]
print(first[columns].reset_coords(drop=True).to_dataframe().round(3).to_string())

# %%
# The surfaces' flag 1 means that their echoes are weaker than three of their errors. At 3 m/s and 20 degrees most
# facets reflect past the receiver. Their times are the column's starts.
#
# Are the stated errors correct? Compare them with the spread over the 200 shots.

bottom = echoes.sel(echo="bottom")
for name, text in (("time_ns", "time of the bottom (ns)"), ("depth_m", "depth (m)")):
    spread = bottom[name].std("shot", ddof=1).values
    stated = bottom[f"{name}_stderr"].median("shot").values
    print(f"{text}: spread {spread.round(3)}, stated {stated.round(3)}")
print(f"mean depth (m): {bottom.depth_m.mean('shot').values.round(3)}")

# %%
figure, axis = plt.subplots(figsize=(7, 2.8), layout="constrained")
for pixel, colour in zip(bottom.pixel.values, pixel_colours(4), strict=True):
    axis.hist(bottom.depth_m.sel(pixel=pixel), np.arange(7.95, 8.15, 0.005), color=colour, histtype="step", label=pixel)
axis.axvline(8, color="0.5", linestyle="--")
axis.set(xlabel="depth of the bottom (m)", ylabel="shots")
axis.legend(frameon=False)
plt.show()

# %%
# The bottom times spread about as stated. The depths' stated errors are about three times the shots' spread, on
# purpose. A depth is the time from the surface to the bottom, and the surface is the weaker echo. It hardly exceeds the
# column, so that a surface with an echo and one without, a nanosecond apart in time, fit almost equally well. The fit
# takes the mean over both and includes the difference in its error. This part is nearly the same in every shot: it does
# not appear in the spread, and averaging shots does not remove it.
#
# The groups also differ from the dashed line by centimetres. The waves over each pixel refract the beam and are higher
# or lower than the mean sea, which the depth axis does not include.
#
# 4. Retrieve
# -----------
#
# ``retrieve`` combines the pixels. The truth is known here: the scene states bottom and water, and ``SeaMap`` has the
# waves' mean slope over the footprint.

found = mitransient_lidar.retrieve(shot)
sea = SeaMap.of_scene(mitransient_lidar.open_scene("fig09_2x2").scene)
along, across = sea.slope_at(0.0, 0.0)
names = ("bottom_depth", "bottom_reflectance", "attenuation", "scattering", "backscattering")
depth, rho, c, b, bb = (float(shot.attrs[f"scene.{name}"]) for name in names)
value = {name: float(one) for name, one in found.items() if one.ndim == 0}
value["depth"] = float(found.depth_m.sel(correction="slope"))
value["reflectance"] = float(found.reflectance.sel(correction="column"))

print(f"slope along:    {value['slope_along']:+.3f} +- {value['slope_along_stderr']:.3f}    truth {along:+.3f}")
print(f"slope across:   {value['slope_across']:+.3f} +- {value['slope_across_stderr']:.3f}    truth {across:+.3f}")
print(f"depth (m):      {value['depth']:.3f}    truth {depth:.3f}")
print(f"reflectance:   {value['reflectance']:.4f}    truth {rho:.4f}")
print(f"a (1/m):        {value['absorption']:.4f}    truth {c - b:.4f}")
print(f"bb (1/m):       {value['backscattering']:.5f}    truth {bb:.5f}")
low, high = value["attenuation_low"], value["attenuation_high"]
print(f"c (1/m):        {value['attenuation']:.2f}, {low:.2f} to {high:.2f}    truth {c:.2f}")

# %%
# How good are these estimates?
#
# - **Slope.** The scene's wind is known: the estimate uses the surface echoes' times and strengths, and the slopes that
#   such a sea has. At 3 m/s these are 0.02 and 0.01, averaged over the footprint, and the column hides the surface
#   echoes. The errors are hardly smaller than the sea's slopes. Rougher seas give more: see :ref:`slopes of waves
#   <sphx_glr_auto_gallery_slope_and_depth.py>`.
# - **Depth** is within 0.15 m. Its error comes from the sea and the method, not from noise.
# - **Absorption and backscattering** come within a few percent and the **reflectance** within a tenth, as
#   efficiencies and the pulse's energy are known exactly here; the rest is light that the waves focus, which the
#   estimates leave out. For a real system 15 % are assumed by default.
# - **c** is an estimate from typical waters. In a wide view the column decays with absorption; light scattered forward
#   stays in view. The bounds hold for ratios of backscattering to scattering from 0.3 to 3 %; the scene has 4 %, and c
#   is just below them.
#
# 5. Gate
# -------
#
# An imager with short gates receives light from one slice of water at a time. ``gated_mine`` has a sphere of 1 m at 6
# m, and a plate on rippled sand at 8 m; 128x128 pixels and 20 gates. Here are 48x48 pixels, and two of the gates.

stack = mitransient_lidar.render("gated_mine", params={"layout": "48x48"}, passes=4, seed=1)
figure, axes = plt.subplots(1, 2, figsize=(7, 3.4), layout="constrained")
for axis, depth in zip(axes, (5.75, 7.7), strict=True):
    number = int(abs(stack.gate_depth - depth).argmin("gate"))
    energy = 1e18 * stack.gate_energy.isel(gate=number)
    image = axis.imshow(energy, extent=(10, -10, -10, 10), cmap="magma")
    axis.set(title=f"gate {number}: {float(energy.gate_depth):.2f} m", xlabel="to the left (mrad)")
    figure.colorbar(image, ax=axis, label="energy (aJ)", shrink=0.75)
    error = stack.gate_energy_stderr.isel(gate=number) / stack.gate_energy.isel(gate=number)
    print(f"gate {number}: standard error of a pixel (median) {100 * float(error.median()):.0f} %")
axes[0].set_ylabel("away from nadir (mrad)")
plt.show()

# %%
# **What to see.** Left, the gate opens on the sphere: a disc on almost black water. Right, two metres deeper, it opens
# on the sand. The disc has become a shadow, in the same place because laser and receiver are in the same place. Next to
# it the plate is brightest. The far half is still dark: light of equal travel time lies on a sphere about the lidar,
# which meets the near sand first. The pixels' grain is the error of four passes; an image for a report takes a minute.
#
# What next
# ---------
#
# - **Your own scene:** ``mitransient-lidar scenes copy fig09_2x2 mine.xml``, change the parameters at its top, and
#   ``mitransient_lidar.render("mine.xml", target_error=0.02)``.
# - **Many shots:** ``render_shots`` and the commands ``find-shots`` and ``shots`` cover a sea, whose waves
#   are the noise that this tutorial leaves out.
# - **Files:** ``mitransient_lidar.save(shot, "shot.nc")`` writes, ``mitransient_lidar.open("shot.nc")`` reads; EXR
#   stacks, too.
# - **Without Python:** ``mitransient-lidar render``, ``retrieve``, ``gates`` and more; ``--help`` lists them.
