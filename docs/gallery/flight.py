"""A flight and its point cloud
============================

A circular scanner on a drone, 75 m above a slope. Every pulse is rendered in its own pose and recorded; echoes
become points with their uncertainty, in LAS files.
"""

import tempfile

import matplotlib.pyplot as plt

import mitransient_lidar

# %%
# A flight is a TOML file or a dict; ``mitransient-lidar fly palmer`` renders a shipped one. Here are 48 pulses, at 14
# degrees from nadir, over a level sea with ripples.

FLIGHT = {
    "scene": "flight",
    "instrument": "riegl_vq840gl",
    "corrections": "auto",
    "target_error": 0.2,
    "still_sea": True,
    "parameters": {
        **{"jerlov": "1C", "spectrum": "flat", "bottom_depth": 4, "bottom_slope_x_deg": 3},
        **{"bottom_ripple_height": 0, "cube_size": 0.5},
    },
    "platform": {
        **{
            "kind": "lines",
            "start": [-5.0, 0.0],
            "heading_deg": 90.0,
            "speed": 10.0,
            "height": 75.0,
            "duration_s": 1.0,
        },
        "noise": {"roll_deg": 0.2, "pitch_deg": 0.2, "yaw_deg": 0.5, "correlation_s": 0.5},
    },
    "scanner": {"kind": "palmer", "nadir_angle_deg": 14.0, "rate_hz": 2.0},
    "pulses": {"rate_hz": 48.0, "most": 48},
}

SURFACE, BOTTOM = 41, 40  # classes of LAS for water surface and bottom

# %%
# Pulses are rendered by processes, as many at a time as there are workers.

with tempfile.TemporaryDirectory() as folder:
    points = mitransient_lidar.fly(FLIGHT, folder, workers=1).load()

figure, (left, right) = plt.subplots(1, 2, figsize=(7, 3.5), layout="constrained")
for kind, name, colour in ((SURFACE, "water surface", "tab:blue"), (BOTTOM, "bottom", "tab:orange")):
    own = points.where(points.kind == kind, drop=True)
    error = own.z - own.true_z
    rms = float((error**2).mean() ** 0.5)
    stated = float(own.vertical_uncertainty.median())
    print(f"{name}: {own.z.size} points, rms error {100 * rms:.1f} cm, stated {100 * stated:.1f} cm")
    left.plot(own.x, own.y, ".", color=colour, label=name)
    right.plot(own.x, own.z, ".", color=colour)
left.set(xlabel="east (m)", ylabel="north (m)", aspect="equal")
left.legend(frameon=False, fontsize="small")
right.set(xlabel="east (m)", ylabel="height (m)")
plt.show()

# %%
# **What to see.** Left, the points on the sea, and those on the bottom, which lie outside them, as the beams go on
# outwards in the water. Right, from the side: the points on the level sea at 0, and the bottom that rises by 3 degrees
# towards the east. About one pulse in twelve finds no bottom.
