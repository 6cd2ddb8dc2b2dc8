"""A flight and its point cloud
============================

A scanner on a drone, 75 m above a sandy slope with a cube on it. Every pulse is rendered in its own pose over moving
waves and recorded; echoes become points with their uncertainty, in LAS files.
"""

import tempfile

import matplotlib.pyplot as plt
import numpy as np

import mitransient_lidar

# %%
# A flight is a TOML file or a dict; ``mitransient-lidar fly drone_strip`` renders the shipped one. Here are 96 pulses.

FLIGHT = {
    "scene": "flight",
    "instrument": "riegl_vq840gl",
    "corrections": "auto",
    "target_error": 0.2,
    "still_sea": True,
    "parameters": {"jerlov": "1C", "wind_speed": 3, "bottom_depth": 4, "cube_depth": 3.5, "spectrum": "flat"},
    "platform": {
        **{"kind": "lines", "start": [-2.0, 0.0], "heading_deg": 90.0, "speed": 4.0, "height": 75.0, "duration_s": 1.0},
        "noise": {"roll_deg": 0.5, "pitch_deg": 0.5, "yaw_deg": 1.0, "correlation_s": 0.5},
    },
    "scanner": {"kind": "oscillating", "half_angle_deg": 15.0, "rate_hz": 4.0},
    "pulses": {"rate_hz": 96.0, "most": 96},
}

SURFACE, BOTTOM = 41, 40  # classes of LAS for water surface and bottom

# %%
# Pulses are rendered by new processes, which import this script: the call stands below this condition.

if __name__ == "__main__":
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
        right.plot(own.y, own.z, ".", color=colour)
    left.set(xlabel="east (m)", ylabel="north (m)", aspect="equal")
    left.legend(frameon=False, fontsize="small")
    right.set(xlabel="north (m)", ylabel="height (m)")
    plt.show()
    print(f"{int(np.count_nonzero(points.true_target))} points on the cube")
