"""The wake of a ship
==================

A ship leaves waves, whose pattern Kelvin explained, and a plume of bubbles. The lidar that crosses the wake sees the
bubbles as bright water below the surface.
"""

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar

# %%
# The ship of the scene ``ship_wake``: 20 m long, 6 m/s towards +y, now 60 m past the shot at the origin.

x, y = np.arange(-60, 60.1, 0.5), np.arange(-60, 80.1, 0.5)
heights = mitransient_lidar.kelvin_wake(x, y, speed=6, bearing=np.pi / 2, length=20, ship_y=60)

# %%
# The same sea and place with and without the ship.

options = {"passes": 8, "pass_share": 1 / 16, "seed": 1}
shots = {
    "in the wake": mitransient_lidar.render("ship_wake", params={"layout": "1x1"}, **options),
    "without the ship": mitransient_lidar.render(
        "ship_wake", params={"layout": "1x1", "plume_scattering": 0, "wake_speed": 0}, **options
    ),
}

figure, (left, right) = plt.subplots(1, 2, figsize=(7, 3.6), width_ratios=(1, 1.4), layout="constrained")
limit = np.quantile(np.abs(heights), 0.995)
image = left.imshow(
    100 * heights, extent=(-60, 60, -60, 80), origin="lower", cmap="RdBu_r", vmin=-100 * limit, vmax=100 * limit
)
left.plot(0, 0, "k+", markersize=10)
left.set(xlabel="x (m)", ylabel="y (m)")
figure.colorbar(image, ax=left, label="height (cm)", shrink=0.8)
for name, shot in shots.items():
    right.semilogy(shot.time, 1e6 * shot.waveform.isel(pixel=0), label=name)
right.set(xlabel="time (ns)", ylabel="power (µW)", xlim=(1405, 1520), ylim=(0.1, None))
right.legend(frameon=False)
plt.show()

start = float(shots["in the wake"].surface_time[0])
for depth in (1, 4):
    time = start + depth / float(shots["in the wake"].depth_per_ns[0])
    wake, clear = (float(shot.waveform.isel(pixel=0).sel(time=time, method="nearest")) for shot in shots.values())
    print(f"power at {depth} m with the ship over that without: {wake / clear:.2f}")

# %%
# **What to see.** The wake has transverse waves on the track and diverging ones at its sides. In it (blue) the record
# begins earlier, on a crest, and the bubbles of the upper 2 m are bright. Below them the water, and the bottom at 8
# m, are darker than without the ship: the bubbles scatter light away on both ways.
