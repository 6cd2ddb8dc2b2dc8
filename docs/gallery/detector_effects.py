"""Detector effects on an echo
===========================

A photomultiplier adds delayed charge, a sinking baseline, a blind amplifier and the jitter of a shot. This script shows
their effect on a bottom at 15 m, each at a typical size, and how often they cause a false bottom.
"""

import logging
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar
from mitransient_lidar.physics.receiver.receiver_files import RECEIVERS
from mitransient_lidar.physics.receiver.shot_jitter import ShotJitter

logging.disable(logging.WARNING)  # of saturated surface echoes, which are intended here

# %%
# One pixel over a bottom at 15 m, and over a bottom at 40 m that is too faint to be seen.

options = {"layout": "1x1", "time_start_ns": 1370, "bin_count": 400}
near, far = (
    mitransient_lidar.render("table1", params={**options, "bottom_depth": depth}, passes=8, pass_share=1 / 8, seed=1)
    for depth in (15, 40)
)

# %%
# A tail has 1e-3 of the surface's peak and decays in 300 ns. Its share of the charge is 1e-3 times 300 ns divided by
# the echo's duration (energy divided by peak). Ions arrive at the cathode 150 ns late, with 2 % of the charge.

light = near.waveform.isel(pixel=0)
duration = float(light.sum() / light.max())
plain = RECEIVERS["pmt"]
detector, amplifier = plain.detector, plain.amplifier


def tail(fraction, decay, delay=0.0):
    """Return the tube with delayed charge."""
    changed = replace(detector, tail_fractions=(fraction,), tail_decays_ns=(decay,), tail_delays_ns=(delay,))
    return replace(plain, detector=changed)


receivers = {
    "none": plain,
    "tail, 1e-4 of the peak, 300 ns": tail(1e-4 * 300 / duration, 300.0),
    "tail, 1e-3 of the peak, 300 ns": tail(1e-3 * 300 / duration, 300.0),
    "ions, 2 % after 150 ns": tail(0.02, 20.0, 150.0),
    "coupling, 5 us": replace(plain, amplifier=replace(amplifier, coupling_ns=5e3)),
    "blind for 100 ns": replace(plain, amplifier=replace(amplifier, limit_v=1.5, recovery_ns=100.0)),
    "energy, 5 %": replace(plain, jitter=ShotJitter(energy_rms=0.05)),
    "trigger, 0.1 ns": replace(plain, jitter=ShotJitter(trigger_ns=0.1)),
    "clock, 0.1 ns": replace(plain, jitter=ShotJitter(clock_ns=0.1)),
}

# %%
# Two hundred shots of each, with the gain that keeps the whole record in range, and with ten times this gain. The
# latter clips the surface echo, as a deep channel does. Depths are against the mean sea level, which shows the trigger.

SHOTS = 200


def bottoms(shot, receiver, gain):
    """Return depths [m], heights [V] and attenuations [1/m] that are measured in records of a shot."""
    record = mitransient_lidar.record(shot, receiver, SHOTS, 1, gain=gain)
    table = mitransient_lidar.echoes(record, "gaussian", depth_from="mean").isel(pixel=0)
    bottom = table.sel(echo="bottom")
    return bottom.depth_m.values, bottom.amplitude.values, table.attenuation.values


auto = mitransient_lidar.record(near, plain, 1, gain="auto").attrs["gain"]
for factor in (1, 10):
    print(f"gain {factor} x auto")
    print(f"{'':31s} {'found':>6} {'bias (mm)':>10} {'sd (mm)':>8} {'height sd (%)':>14} {'K (1/m)':>8} {'false':>6}")
    reference = None
    for name, receiver in receivers.items():
        depth, height, attenuation = bottoms(near, receiver, factor * auto)
        true = np.abs(depth - 15) < 1
        false = np.isfinite(bottoms(far, receiver, factor * auto)[0])
        columns = ["-", "-", "-"]
        if true.any():
            reference = depth[true].mean() if reference is None else reference
            spread = height[true].std() / height[true].mean()
            bias, deviation = 1e3 * (depth[true].mean() - reference), 1e3 * depth[true].std()
            columns = [f"{bias:.1f}", f"{deviation:.1f}", f"{100 * spread:.1f}"]
        column = f"{np.nanmean(attenuation):.3f}" if np.isfinite(attenuation).mean() > 0.5 else "-"
        print(
            f"{name:31s} {true.mean():6.2f} {columns[0]:>10} {columns[1]:>8} {columns[2]:>14} {column:>8} "
            f"{false.mean():6.2f}"
        )

# %%
# The mean signals over the deep bottom, behind ten times the gain.

names = {
    "tail, 1e-3 of the peak, 300 ns": "-",
    "ions, 2 % after 150 ns": "-",
    "coupling, 5 us": "-",
    "blind for 100 ns": "-",
    "none": "--",
}
figure, axis = plt.subplots(figsize=(7, 4), layout="constrained")
for name, style in names.items():
    signal = mitransient_lidar.record(far, receivers[name], 1, gain=10 * auto).signal_mean.isel(pixel=0)
    axis.plot(signal.time, 1e3 * signal, style, color="black" if name == "none" else None, label=name)
axis.set(
    xlabel="time (ns)",
    ylabel="signal (mV), linear below 2 mV, logarithmic above",
    yscale="symlog",
    xlim=(1400, 1770),
    ylim=(-100, 1e5),
)
axis.legend(frameon=False, ncols=2)
plt.show()

# %%
# **What to see.** The signal is clipped at 1 V for 53 ns. A tail changes the depth by millimetres and makes no false
# bottoms, as it has no peak. Late ions repeat surface and column after 150 ns. This light counts as a bottom in half
# the records without one, and reduces the depth by 3 to 4 cm. Through a coupling capacitor the baseline falls by 4 mV,
# or 42 mV behind ten times the gain. This shifts the depth by 2 cm and makes the column seem to decay faster. An
# amplifier that is blind for 100 ns misses the bottom where the surface overloads it. Energy changes the echo's height
# and not its depth; trigger and clock add about 1 cm to depths against the mean sea level.
